"""Optimization: AdamW or Muon, a linear schedule over the run's budget, gradient clipping.

Muon's steps for matrices are orthogonal (K. Jordan et al., 2024, github.com/KellerJordan/Muon): they change
all directions of a matrix equally, not only the few that dominate the gradient. Step lengths are those of J.
Liu et al., "Muon is Scalable for LLM Training", 2025. Unlike in ``torch.optim.Muon``, weights of convolutions
also count as matrices, with a row for each output channel."""

from collections.abc import Callable, Iterable, Sequence
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor, nn

from ghgs_lit.config.options import Amount, Index, Options, Positive, Share
from ghgs_lit.errors import require

# Newton-Schulz: odd polynomials that take singular values in (0, 1] close to 1 (Jordan et al.).
COEFFICIENTS = (3.4445, -4.7750, 2.0315)
ITERATIONS = 5
MOMENTUM = 0.95
# Approximate root mean square of AdamW's steps (Liu et al., section 2.2).
ROOT_MEAN_SQUARE = 0.2
# Parameters with fewer rows or columns (tokens, biases, heads of one or two channels) are left to AdamW.
SMALLEST_SIDE = 3


def is_matrix(parameter: nn.Parameter) -> bool:
    """Whether ``parameter`` is a matrix, or a convolution's weight, with at least 3 rows and columns."""
    if parameter.dim() < 2:
        return False
    rows = parameter.shape[0]
    return min(rows, parameter.numel() // max(rows, 1)) >= SMALLEST_SIDE


def orthogonalized(matrices: Sequence[Tensor]) -> list[Tensor]:
    """The matrices with their singular values replaced by values of about 1 (0.7 to 1.2). The polynomials are
    computed from the smaller Gram matrices, for all of one size at once. ``matrices``: of any sizes, float32
    or wider. Singular values below 1e-3 of the largest become less than 1; zeros stay 0."""
    wide = [m.mT if m.shape[0] > m.shape[1] else m for m in matrices]
    largest = torch._foreach_norm(wide, torch.inf)
    wide = torch._foreach_div(wide, [x + (x == 0) for x in largest])  # so that no square underflows
    sides: dict[int, list[int]] = {}
    for number, matrix in enumerate(wide):
        sides.setdefault(len(matrix), []).append(number)
    found = list(wide)
    for numbers in sides.values():
        grams = torch.stack([wide[number] @ wide[number].mT for number in numbers])
        for number, polynomial in zip(numbers, _polynomials(grams), strict=True):
            product = polynomial @ wide[number]
            found[number] = product if product.shape == matrices[number].shape else product.mT
    return found


def _polynomials(gram: Tensor) -> Tensor:
    """Factors [n, R, R] of matrices [n, R, C], from their Gram matrices [n, R, R]."""
    a, b, c = COEFFICIENTS
    square = gram.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None]  # squared Frobenius norms
    square = square + (square == 0)
    gram, found = (
        gram / square,
        square.rsqrt() * torch.eye(gram.shape[-1], dtype=gram.dtype, device=gram.device),
    )
    for _ in range(ITERATIONS):
        polynomial = torch.baddbmm(gram, gram, gram, beta=b, alpha=c)
        polynomial.diagonal(dim1=-2, dim2=-1).add_(a)
        found = polynomial @ found
        gram = polynomial @ gram @ polynomial
    return found


class Muon(torch.optim.AdamW):
    """Muon for the matrices among ``parameters``, AdamW for all others. ``matrix_lr``: learning rate of
    matrices; steps are as long as AdamW's with this rate. ``**options``: of AdamW; weight decay is for
    both."""

    def __init__(self, parameters: Iterable[nn.Parameter], matrix_lr: float, **options: Any):
        parameters = list(parameters)
        others = [p for p in parameters if not is_matrix(p)]
        matrices = [p for p in parameters if is_matrix(p)]
        groups = [{"params": others, "orthogonal": False}]
        groups.append({"params": matrices, "orthogonal": True, "lr": matrix_lr})
        super().__init__([group for group in groups if group["params"]], **options)

    @torch.no_grad()
    def step(self, closure: Callable[[], Tensor] | None = None) -> Tensor | None:
        """Take a step; the gradients of matrices are removed."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            if group["orthogonal"]:
                self._step_matrices(group)
        super().step()
        return loss

    def _step_matrices(self, group: dict[str, Any]) -> None:
        """Take a step of the matrices, and remove their gradients, so that AdamW skips them."""
        moved = [parameter for parameter in group["params"] if parameter.grad is not None]
        if not moved:
            return
        for parameter in moved:
            state = self.state[parameter]
            if not state:  # AdamW expects a step when it loads a state
                state.update(step=torch.zeros(()), momentum=torch.zeros_like(parameter))
            state["step"] += 1
        gradients, averages = [p.grad for p in moved], [self.state[p]["momentum"] for p in moved]
        torch._foreach_lerp_(averages, gradients, 1 - MOMENTUM)
        directions = torch._foreach_lerp(gradients, averages, MOMENTUM)  # Nesterov momentum
        steps = orthogonalized([direction.flatten(1) for direction in directions])
        lengths = [-group["lr"] * ROOT_MEAN_SQUARE * max(step.shape) ** 0.5 for step in steps]
        torch._foreach_mul_(steps, lengths)
        torch._foreach_mul_(moved, 1 - group["lr"] * group["weight_decay"])
        torch._foreach_add_(moved, [x.view_as(p) for x, p in zip(steps, moved, strict=True)])
        for parameter in moved:
            parameter.grad = None


BelowOne = Annotated[float, Field(ge=0, lt=1)]
#: AdamW's term in the denominator.
EPS = 1e-8
#: The first learning rate as a fraction of the highest one.
START_FACTOR = 0.04


class Optimization(Options):
    """AdamW or Muon, with a learning rate that rises linearly to ``lr`` and then falls linearly, over the
    used share of the run's budget of steps or of time, whichever is larger."""

    group = "optimizer"
    lr: Positive = 1e-4
    """Highest learning rate."""
    matrix_scale: Positive | None = None
    """Learning rate of matrices, which take Muon's orthogonal steps, in units of lr; null: AdamW for all."""
    betas: tuple[BelowOne, BelowOne] = (0.9, 0.999)
    """AdamW's averages of the gradient and of its square."""
    weight_decay: Amount = 1e-5
    """Decoupled weight decay."""
    warmup: BelowOne = 0.01
    """Share of the run in which the learning rate rises from 0.04 lr to lr."""
    end_factor: Share = 5e-4
    """Last learning rate as a fraction of lr."""
    clip: Positive = 1.0
    """Maximum norm of the gradient."""
    freeze_until: dict[str, Share] = Field({})
    """Beginning of parameter names: share of the run in which these parameters stay unchanged."""
    skip_nonfinite: Index = 0
    """Steps in a row that are not finite and are skipped before the run stops; 0: it stops at the first."""

    def optimizer(self, model: nn.Module, fused: bool = True) -> torch.optim.AdamW:
        """The optimizer of the trained parameters of ``model``. ``fused``: PyTorch's fastest AdamW. It undoes
        the scaling of a loss (``16-mixed``) inside its step, too late for clipping gradients. InputError:
        ``freeze_until`` names no parameter."""
        names = [name for name, _ in model.named_parameters()]
        for prefix in self.freeze_until:
            known = any(name.startswith(prefix) for name in names)
            require(known, f"optimizer.freeze_until.{prefix}", "the beginning of a parameter's name", prefix)
        parameters = [p for p in model.parameters() if p.requires_grad]
        options = {name: getattr(self, name) for name in ("lr", "betas", "weight_decay")}
        options |= {"eps": EPS, "fused": fused}
        if self.matrix_scale is None:
            return torch.optim.AdamW(parameters, **options)
        return Muon(parameters, matrix_lr=self.matrix_scale * self.lr, **options)

    def drop_frozen_gradients(self, model: nn.Module, progress: float) -> None:
        """Remove the gradients of parameters that are frozen at the share ``progress`` of the run, so that
        the optimizer leaves them unchanged, also by weight decay."""
        frozen = tuple(prefix for prefix, share in self.freeze_until.items() if progress < share)
        if not frozen:
            return
        for name, parameter in model.named_parameters():
            if name.startswith(frozen):
                parameter.grad = None

    def factor(self, progress: float) -> float:
        """Learning rate as a fraction of ``lr`` at the share ``progress`` of the budget."""
        if progress < self.warmup:
            return START_FACTOR + (1 - START_FACTOR) * progress / self.warmup
        fall = (progress - self.warmup) / (1 - self.warmup)
        return 1 + (self.end_factor - 1) * min(fall, 1.0)
