"""Running a model without its numbers: floating-point tensors have shapes alone, masks and indices values.

What a pass computes depends on masks, indices and cameras (numbers of pixels, tokens and windows), and on
floating-point numbers only where they are broken. So such a pass does all operations, with their shapes, in
no memory; what lives at a time is known.
"""

import weakref
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from types import ModuleType
from typing import Any

import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensor, FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map_only

from ghgs_lit.bounds import cpu as bounds
from ghgs_lit.encoder import cpu as encoder
from ghgs_lit.geometry import chamfer
from ghgs_lit.geometry import cpu as geometry

_INDEXING = ("aten::index", "aten::index_put", "aten::index_put_", "aten::_index_put_impl_")


class Shapes(TorchDispatchMode):
    """While it is open, operations on tensors of :meth:`empty` need no memory and no time for their numbers.

    Results that are no floating-point numbers get values: a comparison is true where it finds a number that
    is finite and in range, an index is 0. Operations without such tensors are computed.

    Attributes:
        live: bytes of tensors that were made while it was open and are still held.
        peak: most of them at one time since :meth:`restart`.
    """

    def __init__(self) -> None:
        super().__init__()
        self.world = FakeTensorMode(allow_non_fake_inputs=True)
        self.live = self.peak = 0
        self._known: dict[int, Any] = {}

    def empty(self, tensor: Tensor) -> Tensor:
        """A tensor of the same shape, dtype and device without values."""
        return self.world.from_tensor(tensor)

    def restart(self) -> None:
        """Forget the peak."""
        self.peak = self.live

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        if function is torch.ops.prim.device.default:  # two of three calls
            return args[0].fake_device
        self._count(tree_leaves((args, kwargs)), made_here=False)
        if any(isinstance(value, FakeTensor) for value in tree_leaves((args, kwargs))):
            result = self._of_shapes(function, args, kwargs)
        else:
            result = function(*args, **kwargs)
        self._count(tree_leaves(result), made_here=True)
        return result

    def _of_shapes(self, function, args, kwargs):
        name = function.name().split(".")[0]
        if name == "aten::_local_scalar_dense":
            return 1.0
        if name in _INDEXING:
            args = (args[0], _whole_indices(args[1]), *args[2:])
        if function._schema.is_mutable and not isinstance(args[0], FakeTensor) and "out" not in kwargs:
            return args[0]
        return tree_map_only(Tensor, lambda x: _valued(x, name, args), function(*args, **kwargs))

    def _count(self, values: list[Any], made_here: bool) -> None:
        """Note the memory of tensors that are seen for the first time; that of arguments was there before."""
        for value in values:
            if not isinstance(value, Tensor):
                continue
            storage = value.untyped_storage()
            key, size = storage._cdata, made_here * storage.nbytes()
            if key not in self._known:
                self._known[key] = weakref.ref(storage, partial(self._freed, key, size))
                self.live += size
                self.peak = max(self.peak, self.live)

    def _freed(self, key: int, size: int, _: Any) -> None:
        self.live -= size
        self._known.pop(key, None)


def _whole_indices(indices: list[Tensor | None]) -> list[Tensor | None]:
    """Masks as the indices that they select."""
    found: list[Tensor | None] = []
    for index in indices:
        is_mask = index is not None and index.dtype == torch.bool
        found += index.nonzero().unbind(1) if is_mask else [index]
    return found


def _valued(tensor: Tensor, name: str, args: tuple) -> Tensor:
    """Values for a result that is not a floating-point number."""
    if not isinstance(tensor, FakeTensor) or tensor.is_floating_point():
        return tensor
    with_itself = len(args) > 1 and args[0] is args[1]
    true = (name == "aten::eq" and with_itself) or (name == "aten::ne" and not with_itself)
    return torch.full(tensor.shape, true if tensor.dtype == torch.bool else 0, dtype=tensor.dtype)


def _sweep(colors, masks, near, *rest):
    *_, shares, _ = rest
    return colors.new_empty(*masks.shape, len(shares))


#: Shapes of what compiled kernels give: module, function, stand-in.
_RESULTS: tuple[tuple[ModuleType, str, Callable], ...] = (
    (encoder, "attend", lambda q, k, v: v.new_empty(q.transpose(1, 2).shape)),
    (geometry, "sweep", _sweep),
    (chamfer, "nearest", lambda queries, references: torch.zeros(len(queries), dtype=torch.long)),
)


@contextmanager
def replaced(module: ModuleType, name: str, value: Any) -> Iterator[None]:
    """An attribute of a module with another value while the context lasts."""
    before = getattr(module, name)
    setattr(module, name, value)
    try:
        yield
    finally:
        setattr(module, name, before)


@contextmanager
def without_kernels(compiled: bool) -> Iterator[None]:
    """Instead of compiled kernels the shapes of their results.

    Args:
        compiled: false for PyTorch's own operators, which run where there are no compiled kernels.
    """
    with ExitStack() as stack:
        for module, name, result in _RESULTS:
            stack.enter_context(replaced(module, name, result))
        if not compiled:
            for module in (bounds, encoder, geometry):
                stack.enter_context(replaced(module, "is_supported", lambda *_: False))
        yield
