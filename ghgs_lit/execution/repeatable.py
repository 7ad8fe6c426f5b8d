"""What a recording of a GPU's work can repeat, and what it cannot."""

import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

_PACKAGE = Path(__file__).parents[1]
#: Files whose lines say nothing about what was recorded.
_OWN = ("graphs.py", "tape.py", Path(__file__).name)


class NotRecordable(RuntimeError):
    """A function whose work cannot be recorded;
    the message says why, and which line is to blame."""


class Guard(TorchDispatchMode):
    """Refuses what a recording cannot repeat, before it is done.

    That is: reading a value of the device, and copying from the host, whose memory will hold
    something else.

    Attributes:
        kept: memory that was not made inside, by its address.
    """

    def __init__(self) -> None:
        super().__init__()
        self.kept: dict[int, Any] = {}
        self._made: set[int] = set()

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        """Call an operator of PyTorch if it can be played back.

        Args:
            function: the operator.
            types: PyTorch's: classes of the tensors.
            args: its positional arguments.
            kwargs: its named arguments.

        Raises:
            NotRecordable: it cannot.
        """
        kwargs = kwargs or {}
        given = list(_tensors((args, tuple(kwargs.values()))))
        reason = _reason(function, given, args, kwargs)
        if reason is not None:
            raise NotRecordable(f"{reason} by {function.name()} ({_line()})")
        for storage in map(Tensor.untyped_storage, given):
            if storage._cdata not in self._made:
                self.kept[storage._cdata] = storage
        result = function(*args, **kwargs)
        self._made.update(tensor.untyped_storage()._cdata for tensor in _tensors(result))
        return result


def _tensors(value: Any) -> Iterator[Tensor]:
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, (tuple, list)):
        for item in value:
            yield from _tensors(item)


_INDEXING = ("aten::index", "aten::index_put", "aten::index_put_", "aten::_unsafe_index")


def _reason(function: Any, given: list[Tensor], args: tuple, kwargs: dict) -> str | None:
    """Why an operator cannot be played back; None if it can.

    Args:
        function: the operator.
        given: tensors among its arguments.
        args: its positional arguments.
        kwargs: its named arguments.
    """
    name = function.name().split(".")[0]
    if torch.Tag.data_dependent_output in function.tags:
        return "a value is read"
    if name in _INDEXING:
        masks = [index for index in args[1] if index is not None and index.dtype in (torch.bool, torch.uint8)]
        return "a size depends on values" if masks else None
    sized = kwargs.get("output_size") is not None
    if torch.Tag.dynamic_output_shape in function.tags and not sized:
        return "a size depends on values"
    types = {tensor.device.type for tensor in given}
    if name in ("aten::_to_copy", "aten::copy_", "aten::_copy_from") and kwargs.get("device") is not None:
        target = torch.device(kwargs["device"]).type
        types.add(target)
        if target == "cpu" and len(types) > 1:
            return "a value is read"
    copies = len(types) > 1 and (name == "aten::_to_copy" or "copy_" in name)
    # What remains to be seen of torch.tensor(list, device=...).
    copies |= name == "aten::lift_fresh" and types != {"cpu"}
    return "the host's memory is copied" if copies else None


def _line() -> str:
    """The innermost line of the package that is running."""
    lines = [f for f in traceback.extract_stack() if Path(f.filename).is_relative_to(_PACKAGE)]
    lines = [f for f in lines if Path(f.filename).name not in _OWN]
    return f"{Path(lines[-1].filename).name}:{lines[-1].lineno}" if lines else "no line of the package"
