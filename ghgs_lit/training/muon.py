"""Muon: orthogonal steps for matrices, AdamW for all other parameters.

Muon orthogonalises the step of a matrix (K. Jordan et al., 2024, github.com/KellerJordan/Muon), so
that it changes all directions equally, not only the few that dominate the gradient. Step lengths
follow J. Liu et al., "Muon is Scalable for LLM Training", 2025.

``torch.optim.Muon`` takes the same steps matrix by matrix, in bfloat16, and rejects weights of
convolutions. Here these are matrices with one row per output channel, products are float32, and
matrices of one shape are multiplied in one batch: 22 ms instead of 102 a step for the 134 matrices of the
weights that come with the package (one core)."""

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from ghgs_lit.execution.graphs import GraphCache

#: Newton-Schulz iteration: an odd polynomial that moves singular values in (0, 1] close to 1 (Jordan
#: et al.).
COEFFICIENTS = (3.4445, -4.7750, 2.0315)
ITERATIONS = 5
MOMENTUM = 0.95
#: Approximate root mean square of AdamW's steps (Liu et al., section 2.2).
ROOT_MEAN_SQUARE = 0.2
#: Parameters with fewer rows or columns (tokens, biases, heads with one or two channels) use AdamW.
SMALLEST_SIDE = 3


def is_matrix(parameter: nn.Parameter) -> bool:
    """Whether Muon updates a parameter: a matrix, or the weight of a convolution with its first
    dimension as rows, that has at least 3 rows and 3 columns."""
    if parameter.dim() < 2:
        return False
    rows = parameter.shape[0]
    return min(rows, parameter.numel() // max(rows, 1)) >= SMALLEST_SIDE


def orthogonalize(matrices: Sequence[Tensor]) -> list[Tensor]:
    """Orthogonalise matrices approximately: replace their singular values by values of 0.7 to 1.2.

    Args:
        matrices: matrices of any sizes, float32 or wider, with one dtype and device.

    Returns:
        Matrices of the same sizes. Singular values below 1e-3 of a matrix's largest one become less
        than 1; zeros stay 0."""
    # Divided by the largest value first, to prevent an underflow of squares.
    for norm, least in ((torch.inf, torch.finfo(matrices[0].dtype).tiny), (2, 1.0)):
        norms = torch._foreach_norm(matrices, norm)
        torch._foreach_clamp_min_(norms, least)
        matrices = torch._foreach_div(matrices, norms)
    wide = [matrix if matrix.shape[0] <= matrix.shape[1] else matrix.mT for matrix in matrices]
    by_shape: dict[torch.Size, list[int]] = {}
    for number, matrix in enumerate(wide):
        by_shape.setdefault(matrix.shape, []).append(number)
    for numbers in by_shape.values():
        results = _orthogonalize_stack(torch.stack([wide[number] for number in numbers]))
        for number, result in zip(numbers, results, strict=True):
            wide[number] = result if matrices[number].shape == result.shape else result.mT
    return wide


def _orthogonalize_stack(matrices: Tensor) -> Tensor:
    """Orthogonalise matrices [n, R, C] with R <= C and norms of at most 1 by polynomials of their Gram
    matrices."""
    a, b, c = COEFFICIENTS
    for _ in range(ITERATIONS):
        gram = matrices @ matrices.mT
        matrices = torch.baddbmm(matrices, torch.baddbmm(gram, gram, gram, beta=b, alpha=c), matrices, beta=a)
    return matrices


def _place(value: Any) -> Any:
    """A tensor's storage, on which a captured graph depends; any other value unchanged."""
    return value.untyped_storage()._cdata if isinstance(value, Tensor) else value


class Muon(torch.optim.AdamW):
    """Optimizer with Muon for matrices (:func:`is_matrix`), and AdamW for all other parameters.

    Args:
        matrix_lr: learning rate of matrices, whose steps are about as long as AdamW's at this rate. A
            number, or, like AdamW's ``lr``, a scalar tensor on the parameters' device, so that a
            captured step follows the schedule.
        captures: whether steps on a GPU are captured as a CUDA graph.
        **options: options of AdamW; weight decay applies to both."""

    def __init__(
        self,
        parameters: Iterable[nn.Parameter],
        matrix_lr: float | Tensor,
        captures: bool = True,
        **options: Any,
    ):
        parameters = list(parameters)
        others = [p for p in parameters if not is_matrix(p)]
        matrices = [p for p in parameters if is_matrix(p)]
        groups = [{"params": others, "orthogonal": False}]
        groups.append({"params": matrices, "orthogonal": True, "lr": matrix_lr})
        super().__init__([group for group in groups if group["params"]], **options)
        on_gpu = any(parameter.is_cuda for parameter in matrices)
        self.graphs = GraphCache(limit=2) if captures and on_gpu else None

    @torch.no_grad()
    def step(self, closure: Callable[[], Tensor] | None = None) -> Tensor | None:
        """Take a step, and remove all gradients.

        Args:
            closure: recomputes the loss and the gradients before the step.

        Returns:
            The loss of ``closure``; None without one."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        moved = [p for group in self.param_groups for p in group["params"] if p.grad is not None]
        gradients = [parameter.grad for parameter in moved]
        if self.graphs is None:
            self._move(moved, gradients)
        else:
            states = [value for p in moved for value in self.state.get(p, {}).values()]
            numbers = [item for group in self.param_groups for item in group.items() if item[0] != "params"]
            key = tuple((name, _place(value)) for name, value in numbers), tuple(map(_place, moved + states))
            self.graphs(partial(self._move, moved), gradients, key, moved + states)
        for parameter in moved:
            parameter.grad = None
        return loss

    def _move(self, moved: Sequence[nn.Parameter], gradients: Sequence[Tensor]) -> None:
        """Take a step with these gradients, one per parameter, such as the inputs of a captured graph."""
        for parameter, gradient in zip(moved, gradients, strict=True):
            parameter.grad = gradient
        for group in self.param_groups:
            matrices = [parameter for parameter in group["params"] if parameter.grad is not None]
            if group["orthogonal"] and matrices:
                self._move_matrices(matrices, group["lr"], group["weight_decay"])
        super().step()

    def _move_matrices(self, moved: Sequence[nn.Parameter], lr: float | Tensor, weight_decay: float) -> None:
        """Update matrices, and remove their gradients, so that AdamW skips them."""
        for parameter in moved:
            if not self.state[parameter]:  # AdamW requires ``step`` when it loads a state
                self.state[parameter] = {"step": torch.zeros(()), "momentum": torch.zeros_like(parameter)}
        gradients = [parameter.grad for parameter in moved]
        averages = [self.state[parameter]["momentum"] for parameter in moved]
        torch._foreach_lerp_(averages, gradients, 1 - MOMENTUM)
        directions = torch._foreach_lerp(gradients, averages, MOMENTUM)  # Nesterov momentum
        steps = orthogonalize([direction.flatten(1) for direction in directions])
        torch._foreach_mul_(steps, [-ROOT_MEAN_SQUARE * max(step.shape) ** 0.5 for step in steps])
        torch._foreach_mul_(steps, lr)
        torch._foreach_mul_(moved, 1 - lr * weight_decay)
        torch._foreach_add_(moved, [step.view_as(weight) for step, weight in zip(steps, moved, strict=True)])
        for parameter in moved:
            parameter.grad = None
