"""Muon: orthogonal steps for matrices, AdamW for everything else.

Muon's steps for matrices are orthogonal (K. Jordan et al., 2024, github.com/KellerJordan/Muon):
they change all directions of a matrix equally, not only the few that dominate the gradient. Step
lengths are those of J. Liu et al., "Muon is Scalable for LLM Training", 2025.

``torch.optim.Muon`` takes the same steps, one matrix after the other, in bfloat16, and refuses
weights of convolutions. Here these are matrices with a row for each output channel, products are
float32, and matrices of one size are multiplied together."""

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from ghgs_lit.execution.graphs import GraphCache

#: Newton-Schulz: odd polynomials that take singular values in (0, 1] close to 1 (Jordan et al.).
COEFFICIENTS = (3.4445, -4.7750, 2.0315)
ITERATIONS = 5
MOMENTUM = 0.95
#: Approximate root mean square of AdamW's steps (Liu et al., section 2.2).
ROOT_MEAN_SQUARE = 0.2
#: Parameters with fewer rows or columns (tokens, biases, heads of one or two channels) are
#: left to AdamW.
SMALLEST_SIDE = 3


def is_matrix(parameter: nn.Parameter) -> bool:
    """Whether Muon moves a parameter.

    Args:
        parameter: of any shape; the first dimension of a convolution's weight counts as rows.

    Returns:
        True for matrices, and weights of convolutions, with at least 3 rows and 3 columns."""
    if parameter.dim() < 2:
        return False
    rows = parameter.shape[0]
    return min(rows, parameter.numel() // max(rows, 1)) >= SMALLEST_SIDE


def orthogonalized(matrices: Sequence[Tensor]) -> list[Tensor]:
    """Replace singular values by values of about 1 (0.7 to 1.2).

    Args:
        matrices: of any sizes, float32 or wider, all of one type on one device; those of one size
            go through the iterations together.

    Returns:
        A matrix of the same size for each. Singular values below 1e-3 of a matrix's largest become
        less than 1; zeros stay 0."""
    by_shape: dict[torch.Size, list[int]] = {}
    for number, matrix in enumerate(matrices):
        by_shape.setdefault(matrix.shape, []).append(number)
    results = list(matrices)
    for numbers in by_shape.values():
        together = _orthogonalized(torch.stack([matrices[number] for number in numbers]))
        for number, result in zip(numbers, together, strict=True):
            results[number] = result
    return results


def _orthogonalized(matrices: Tensor) -> Tensor:
    """:func:`orthogonalized` of matrices [n, R, C], by polynomials of the smaller Gram matrices."""
    if matrices.shape[1] > matrices.shape[2]:
        return _orthogonalized(matrices.mT).mT
    a, b, c = COEFFICIENTS
    largest = torch.linalg.vector_norm(matrices, torch.inf, dim=(1, 2), keepdim=True)
    # no square underflows
    matrices = matrices / largest.clamp(min=torch.finfo(matrices.dtype).tiny)
    gram = matrices @ matrices.mT
    square = gram.diagonal(dim1=1, dim2=2).sum(-1)[:, None, None]  # squared Frobenius norms
    square = square.clamp(min=1)  # below it only for zeros, as the largest value is 1
    gram = gram / square
    factor = square.rsqrt() * torch.eye(gram.shape[-1], dtype=gram.dtype, device=gram.device)
    for iteration in range(ITERATIONS):
        # The polynomial is a + rest; a is added by the products.
        rest = torch.baddbmm(gram, gram, gram, beta=b, alpha=c)
        factor = torch.baddbmm(factor, rest, factor, beta=a)
        if iteration < ITERATIONS - 1:
            gram = torch.baddbmm(gram, rest, gram, beta=a)
            gram = torch.baddbmm(gram, gram, rest, beta=a)
    return factor @ matrices


def _place(value: Any) -> Any:
    """Where a tensor lies, which a recording depends on, or any other value."""
    return value.untyped_storage()._cdata if isinstance(value, Tensor) else value


class Muon(torch.optim.AdamW):
    """Muon for the matrices among parameters, AdamW for all others.

    Args:
        parameters: to be moved.
        matrix_lr: learning rate of matrices, whose steps are as long as AdamW's with this rate. A
            number, or, as AdamW's ``lr``, a tensor without dimensions on the parameters' device, so
            that a recorded step follows the schedule.
        records: whether a GPU's steps are recorded as a CUDA graph.
        **options: of AdamW; weight decay is for both."""

    def __init__(
        self,
        parameters: Iterable[nn.Parameter],
        matrix_lr: float | Tensor,
        records: bool = True,
        **options: Any,
    ):
        others, matrices = [], []
        for parameter in parameters:
            (matrices if is_matrix(parameter) else others).append(parameter)
        groups = [{"params": others, "orthogonal": False}]
        groups.append({"params": matrices, "orthogonal": True, "lr": matrix_lr})
        super().__init__([group for group in groups if group["params"]], **options)
        on_gpu = any(parameter.is_cuda for parameter in matrices)
        self.graphs = GraphCache(limit=2) if records and on_gpu else None

    @torch.no_grad()
    def step(self, closure: Callable[[], Tensor] | None = None) -> Tensor | None:
        """Take a step; the gradients of matrices are removed.

        Args:
            closure: computes the loss and the gradients once more before the step.

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
            written = [*moved, *states]
            numbers = [item for group in self.param_groups for item in group.items() if item[0] != "params"]
            key = tuple((name, _place(value)) for name, value in numbers), tuple(map(_place, written))
            self.graphs(partial(self._move, moved), gradients, key, written)
        for parameter, gradient in zip(moved, gradients, strict=True):
            parameter.grad = None if is_matrix(parameter) else gradient
        return loss

    def _move(self, moved: Sequence[nn.Parameter], gradients: Sequence[Tensor]) -> None:
        """Take a step along gradients that may lie elsewhere than those of the parameters.

        Args:
            moved: parameters.
            gradients: of each.
        """
        for parameter, gradient in zip(moved, gradients, strict=True):
            parameter.grad = gradient
        for group in self.param_groups:
            if group["orthogonal"]:
                self._step_matrices(group)
        super().step()

    def _step_matrices(self, group: dict[str, Any]) -> None:
        """Take a step of the matrices, and remove their gradients, so that AdamW skips them."""
        moved = [parameter for parameter in group["params"] if parameter.grad is not None]
        if not moved:
            return
        for parameter in moved:
            state = self.state[parameter]
            if not state:  # AdamW expects a step when it loads a state; nothing here depends on it
                state.update(step=torch.zeros(()), momentum=torch.zeros_like(parameter))
        gradients = [parameter.grad for parameter in moved]
        averages = [self.state[parameter]["momentum"] for parameter in moved]
        torch._foreach_lerp_(averages, gradients, 1 - MOMENTUM)
        directions = torch._foreach_lerp(gradients, averages, MOMENTUM)  # Nesterov momentum
        steps = orthogonalized([direction.flatten(1) for direction in directions])
        torch._foreach_mul_(steps, [-ROOT_MEAN_SQUARE * max(step.shape) ** 0.5 for step in steps])
        torch._foreach_mul_(steps, group["lr"])
        torch._foreach_mul_(moved, 1 - group["lr"] * group["weight_decay"])
        torch._foreach_add_(moved, [step.view_as(weight) for step, weight in zip(steps, moved, strict=True)])
        for parameter in moved:
            parameter.grad = None
