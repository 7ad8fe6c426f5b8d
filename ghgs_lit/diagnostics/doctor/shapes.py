"""Running a model without its numbers: floating-point tensors have shapes alone, masks and indices values.

What a pass computes depends on masks, indices and cameras, and on floating-point numbers only where they are
broken. So such a pass does all operations, with their shapes, in no memory; what lives at a time is known.
"""

import weakref
from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensor, FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map_only

_INDEXING = ("aten::index", "aten::index_put", "aten::index_put_", "aten::_index_put_impl_")


class Shapes(TorchDispatchMode):
    """While it is open, operations on tensors of :meth:`empty` need no memory and no time for their numbers.

    Results that are no floating-point numbers get values: a comparison is true where it finds a number that
    is finite and in range, an index is 0. Operations without such tensors are computed.

    Attributes:
        world: in which tensors without values are made.
        live: bytes of tensors that were made while it was open and are still held.
        peak: most of them at one time since it was set to ``live``.
    """

    def __init__(self) -> None:
        super().__init__()
        self.world = FakeTensorMode(allow_non_fake_inputs=True)
        self.live = self.peak = 0
        self._known: dict[int, Any] = {}

    def empty(self, tensor: Tensor) -> Tensor:
        """A tensor of the same shape, dtype and device without values."""
        return self.world.from_tensor(tensor)

    def of(self, shape: Sequence[int]) -> Tensor:
        """A tensor of float32 without values."""
        with self.world:
            return torch.empty(shape)

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        if function is torch.ops.prim.device.default:  # two of three calls
            return args[0].fake_device
        values = tree_leaves((args, kwargs))
        self._count(values, made_here=False)
        is_fake = any(isinstance(value, FakeTensor) for value in values)
        result = self._of_shapes(function, args, kwargs) if is_fake else function(*args, **kwargs)
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
        for storage in (value.untyped_storage() for value in values if isinstance(value, Tensor)):
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
    is_mask = [index is not None and index.dtype == torch.bool for index in indices]
    pairs = zip(indices, is_mask, strict=True)
    return [part for index, mask in pairs for part in (index.nonzero().unbind(1) if mask else [index])]


def _valued(tensor: Tensor, name: str, args: tuple) -> Tensor:
    """Values for a result that is not a floating-point number."""
    if not isinstance(tensor, FakeTensor) or tensor.is_floating_point():
        return tensor
    with_itself = len(args) > 1 and args[0] is args[1]
    true = (name == "aten::eq" and with_itself) or (name == "aten::ne" and not with_itself)
    return torch.full(tensor.shape, true if tensor.dtype == torch.bool else 0, dtype=tensor.dtype)
