"""AdamW with Muon's orthogonal steps for matrices (K. Jordan et al., 2024, github.com/KellerJordan/Muon).

A step moves all directions of a matrix equally far, not only the few that the gradient is full of. Step
lengths are those of J. Liu et al., "Muon is Scalable for LLM Training", 2025. PyTorch's ``torch.optim.Muon``
takes matrices only; here weights of convolutions are matrices of their output channels, too.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

# Newton-Schulz: odd polynomials that take singular values in (0, 1] close to 1 (Jordan et al.).
COEFFICIENTS = (3.4445, -4.7750, 2.0315)
ITERATIONS = 5
MOMENTUM = 0.95
# AdamW's steps have about this root mean square (Liu et al., section 2.2).
ROOT_MEAN_SQUARE = 0.2
# What has fewer rows or columns (tokens, biases, heads of one or two channels) is left to AdamW.
SMALLEST_SIDE = 3


def is_matrix(parameter: nn.Parameter) -> bool:
    """Whether ``parameter`` is a matrix, or a convolution's weight, with at least 3 rows and columns."""
    if parameter.dim() < 2:
        return False
    rows = parameter.shape[0]
    return min(rows, parameter.numel() // max(rows, 1)) >= SMALLEST_SIDE


def orthogonalized(matrices: Sequence[Tensor]) -> list[Tensor]:
    """The matrices with singular values of about 1 (0.7 to 1.2) in place of their own.

    The polynomials are found from the smaller Gram matrices, for all of one size at once. ``matrices``: of
    any sizes, float32 or wider. Singular values below 1e-3 of the largest end below 1; a matrix of zeros
    stays one.
    """
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
    """What matrices [n, R, C] are multiplied by, from their Gram matrices [n, R, R]."""
    a, b, c = COEFFICIENTS
    square = gram.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None]  # of the Frobenius norm
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
    """Muon for the matrices among ``parameters``, AdamW for all others.

    Args:
        matrix_lr: learning rate of matrices, in units of AdamW's: steps are as long as AdamW's of this rate.
        **options: of AdamW, for the other parameters; weight decay is for both.
    """

    def __init__(self, parameters: Iterable[nn.Parameter], matrix_lr: float, **options: Any):
        parameters = list(parameters)
        others = [p for p in parameters if not is_matrix(p)]
        matrices = [p for p in parameters if is_matrix(p)]
        groups = [{"params": others, "orthogonal": False}]
        groups.append({"params": matrices, "orthogonal": True, "lr": matrix_lr})
        super().__init__([group for group in groups if group["params"]], **options)

    @torch.no_grad()
    def step(self, closure: Callable[[], Tensor] | None = None) -> Tensor | None:
        """One step; the gradients of matrices are used up."""
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
        """Move the matrices, and take their gradients away, so that AdamW leaves them alone."""
        moved = [parameter for parameter in group["params"] if parameter.grad is not None]
        if not moved:
            return
        for parameter in moved:
            state = self.state[parameter]
            if not state:  # AdamW's loading of a state asks for a step
                state.update(step=torch.zeros(()), momentum=torch.zeros_like(parameter))
            state["step"] += 1
        gradients, averages = [p.grad for p in moved], [self.state[p]["momentum"] for p in moved]
        torch._foreach_lerp_(averages, gradients, 1 - MOMENTUM)
        directions = torch._foreach_lerp(gradients, averages, MOMENTUM)  # Nesterov's
        steps = orthogonalized([direction.flatten(1) for direction in directions])
        lengths = [-group["lr"] * ROOT_MEAN_SQUARE * max(step.shape) ** 0.5 for step in steps]
        torch._foreach_mul_(steps, lengths)
        torch._foreach_mul_(moved, 1 - group["lr"] * group["weight_decay"])
        torch._foreach_add_(moved, [x.view_as(p) for x, p in zip(steps, moved, strict=True)])
        for parameter in moved:
            parameter.grad = None
