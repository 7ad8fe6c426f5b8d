"""Muon: orthogonal steps for matrices, AdamW for all other parameters.

Muon orthogonalises the step of a matrix (K. Jordan et al., 2024, github.com/KellerJordan/Muon), so
that it changes all directions equally, not only the few that dominate the gradient. Step lengths
follow J. Liu et al., "Muon is Scalable for LLM Training", 2025.

``torch.optim.Muon`` takes the same steps matrix by matrix, in bfloat16, and rejects weights of
convolutions. Here these are matrices with one row per output channel, products are float32, and
matrices of similar size are multiplied in one batch. Of the 134 matrices of the weights that come with
the package, PyTorch's Muon accepts 61, for which it launches 1 403 kernels; this module launches 133
for all weights."""

from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

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
#: Matrices with a smaller side of at most this size are padded to powers of two and share products.
PADDED_SIDE = 128
#: Smallest side of padded matrices.
LEAST_PADDED = 16


def is_matrix(parameter: nn.Parameter) -> bool:
    """Whether Muon updates a parameter: a matrix, or the weight of a convolution with its first
    dimension as rows, that has at least 3 rows and 3 columns."""
    if parameter.dim() < 2:
        return False
    rows = parameter.shape[0]
    return min(rows, parameter.numel() // max(rows, 1)) >= SMALLEST_SIDE


def orthogonalize(matrices: Sequence[Tensor]) -> list[Tensor]:
    """Orthogonalise matrices approximately: replace their singular values by values of 0.7 to 1.2.

    Padding with zeros does not change singular vectors, so small matrices of many sizes are padded and
    share the iterations. A result depends, within rounding, on the other matrices.

    Args:
        matrices: matrices of any sizes, float32 or wider, with one dtype and device.

    Returns:
        Matrices of the same sizes. Singular values below 1e-3 of a matrix's largest one become less
        than 1; zeros stay 0."""
    results = list(matrices)
    small = []
    by_shape: dict[torch.Size, list[int]] = {}
    for number, matrix in enumerate(matrices):
        if min(matrix.shape) <= PADDED_SIDE:
            small.append(number)
        else:
            by_shape.setdefault(matrix.shape, []).append(number)
    for numbers in by_shape.values():
        stacked = torch.stack([matrices[number] for number in numbers])
        for number, result in zip(numbers, _orthogonalize_stack(stacked), strict=True):
            results[number] = result
    if small:
        for number, result in zip(small, _orthogonalize_small([matrices[n] for n in small]), strict=True):
            results[number] = result
    return results


def _orthogonalize_small(matrices: list[Tensor]) -> list[Tensor]:
    """Orthogonalise matrices with a side of at most :data:`PADDED_SIDE`."""
    packing = _packing(tuple(tuple(matrix.shape) for matrix in matrices), matrices[0].device)
    values = torch.cat([*(matrix.reshape(-1) for matrix in matrices), matrices[0].new_zeros(1)])
    products = []
    for places in packing.places:
        padded = values.index_select(0, places.view(-1)).view(places.shape)
        products.append(_orthogonalize_stack(padded).reshape(-1))
    values = torch.cat(products).index_select(0, packing.back)
    parts = values.split([matrix.numel() for matrix in matrices])
    return [part.view(matrix.shape) for part, matrix in zip(parts, matrices, strict=True)]


class _Packing(NamedTuple):
    """Indices that map matrices to padded matrices, and back.

    Args:
        places: for each padded size, [n, rows, columns] with the index of each value in the
            concatenated matrices; the index after the last one is for padding zeros.
        back: index of each value in the concatenated padded matrices."""

    places: tuple[Tensor, ...]
    back: Tensor


@lru_cache(maxsize=4)
def _packing(shapes: tuple[tuple[int, int], ...], device: torch.device) -> _Packing:
    """Compute the packing of matrices; cached, as shapes are the same in almost all steps."""
    classes: dict[tuple[int, int], list[Tensor]] = {}
    first = 0
    for shape in shapes:
        places = torch.arange(first, first + shape[0] * shape[1], dtype=torch.int32).view(shape)
        first += places.numel()
        wide = places if shape[0] <= shape[1] else places.mT
        side = max(_power_of_two(wide.shape[0]), LEAST_PADDED)
        # On a CPU the cost is padding, on a GPU it is the number of products.
        width = _power_of_two(wide.shape[1]) if device.type == "cpu" else 0
        classes.setdefault((side, width), []).append(wide)
    padded = []
    for (side, _), members in classes.items():
        width = max(wide.shape[1] for wide in members)
        places = torch.full((len(members), side, width), first, dtype=torch.int32)
        for number, wide in enumerate(members):
            places[number, : wide.shape[0], : wide.shape[1]] = wide
        padded.append(places)
    order = torch.cat([places.view(-1) for places in padded]).long()
    back = torch.empty(first + 1, dtype=torch.int32)
    back[order] = torch.arange(len(order), dtype=torch.int32)
    return _Packing(tuple(places.to(device) for places in padded), back[:-1].to(device))


def _power_of_two(count: int) -> int:
    """The smallest power of two that is at least ``count``."""
    return 1 << (count - 1).bit_length()


def _orthogonalize_stack(matrices: Tensor) -> Tensor:
    """Orthogonalise matrices [n, R, C] by polynomials of the smaller Gram matrices."""
    if matrices.shape[1] > matrices.shape[2]:
        return _orthogonalize_stack(matrices.mT).mT
    a, b, c = COEFFICIENTS
    largest = torch.linalg.vector_norm(matrices, torch.inf, dim=(1, 2), keepdim=True)
    # Prevents an underflow of squares.
    matrices = matrices / largest.clamp(min=torch.finfo(matrices.dtype).tiny)
    gram = matrices @ matrices.mT
    square = gram.diagonal(dim1=1, dim2=2).sum(-1)[:, None, None]  # squared Frobenius norms
    square = square.clamp(min=1)  # less only for zeros, as the largest value is 1
    gram = gram / square
    factor = square.rsqrt() * torch.eye(gram.shape[-1], dtype=gram.dtype, device=gram.device)
    for iteration in range(ITERATIONS):
        # The polynomial is a + rest; baddbmm adds the part with a.
        rest = torch.baddbmm(gram, gram, gram, beta=b, alpha=c)
        factor = torch.baddbmm(factor, rest, factor, beta=a)
        if iteration < ITERATIONS - 1:
            gram = torch.baddbmm(gram, rest, gram, beta=a)
            gram = torch.baddbmm(gram, gram, rest, beta=a)
    return factor @ matrices


def _layout(weight: Tensor) -> torch.memory_format:
    """Memory layout of a weight."""
    is_last = weight.dim() == 4 and not weight.is_contiguous()
    return torch.channels_last if is_last else torch.contiguous_format


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
        """Take a step, and remove the gradients of matrices.

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
            written = [*moved, *self._states(moved)]
            numbers = [item for group in self.param_groups for item in group.items() if item[0] != "params"]
            key = tuple((name, _place(value)) for name, value in numbers), tuple(map(_place, written))
            self.graphs(partial(self._move, moved), gradients, key, written)
        for parameter, gradient in zip(moved, gradients, strict=True):
            parameter.grad = None if is_matrix(parameter) else gradient
        return loss

    def _states(self, moved: Sequence[nn.Parameter]) -> list[Tensor]:
        """The optimizer's state tensors of parameters, which a step writes."""
        return [value for parameter in moved for value in self.state.get(parameter, {}).values()]

    def _move(self, moved: Sequence[nn.Parameter], gradients: Sequence[Tensor]) -> None:
        """Take a step with these gradients, one per parameter, such as the inputs of a captured graph."""
        for parameter, gradient in zip(moved, gradients, strict=True):
            parameter.grad = gradient
        for group in self.param_groups:
            if group["orthogonal"]:
                self._step_matrices(group)
        super().step()

    def _step_matrices(self, group: dict[str, Any]) -> None:
        """Update the matrices, and remove their gradients, so that AdamW skips them."""
        moved = [parameter for parameter in group["params"] if parameter.grad is not None]
        if not moved:
            return
        for parameter in moved:
            state = self.state[parameter]
            if not state:  # AdamW requires ``step`` when it loads a state; Muon does not use it
                state.update(step=torch.zeros(()), momentum=torch.zeros_like(parameter))
        gradients = [parameter.grad for parameter in moved]
        averages = [self.state[parameter]["momentum"] for parameter in moved]
        torch._foreach_lerp_(averages, gradients, 1 - MOMENTUM)
        directions = torch._foreach_lerp(gradients, averages, MOMENTUM)  # Nesterov momentum
        directions = [direction.flatten(1) for direction in directions]
        steps = orthogonalize(directions)
        torch._foreach_mul_(steps, [-ROOT_MEAN_SQUARE * max(step.shape) ** 0.5 for step in steps])
        torch._foreach_mul_(steps, group["lr"])
        torch._foreach_mul_(moved, 1 - group["lr"] * group["weight_decay"])
        # PyTorch would add steps whose memory layout differs from their weights' one by one.
        shaped = []
        for step, weight in zip(steps, moved, strict=True):
            shaped.append(step.view_as(weight).contiguous(memory_format=_layout(weight)))
        torch._foreach_add_(moved, shaped)
        for parameter in moved:
            parameter.grad = None
