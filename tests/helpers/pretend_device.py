"""A pretend accelerator: tensors with device ``pretend:0`` and CPU data, which cannot mix with CPU tensors.

Code that runs on it also runs on a GPU, as far as devices are concerned; device-to-host
synchronisations of a GPU are counted. It is stricter than CUDA in one respect: an index on the CPU
raises an error, because CUDA copies it at every call.

    with pretend_device() as log:
        model.to(DEVICE)(batch.to(DEVICE))
    print(log.waits)

PyTorch's interface for backends in Python is experimental; it is only used in this file. A process
has one accelerator: tests of this one are skipped if CUDA is available.
"""

import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import SkipTest, mock

import torch
from torch import library
from torch.nn import functional
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.backend_registration import _DummyBackendModule, _setup_privateuseone_for_python_backend

import ghgs_lit
from ghgs_lit.ops import dispatch

_PACKAGE = str(Path(ghgs_lit.__file__).parent)

#: Operators that accept tensors of both devices, as on CUDA.
_COPIES = ("aten::_to_copy", "aten::copy_", "aten::_copy_from")
#: Operators that accept no number (a tensor without dimensions) on the CPU; all others do.
_WITHOUT_NUMBERS = ("aten::cat", "aten::stack", "aten::index_copy", "aten::scatter", "aten::gather")
#: Operators after which CUDA's host waits for the device, because it needs a value or a size.
_WAITING = (
    "aten::_local_scalar_dense",
    "aten::bincount",
    "aten::equal",
    "aten::masked_select",
    "aten::nonzero",
    "aten::unique_consecutive",
    "aten::unique_dim",
    "aten::_unique2",
)
#: Operators without work on the device: views and new memory.
_WITHOUT_WORK = (
    *(
        "view",
        "_unsafe_view",
        "select",
        "slice",
        "expand",
        "permute",
        "transpose",
        "unsqueeze",
        "squeeze",
        "t",
    ),
    *("split", "split_with_sizes", "unbind", "alias", "as_strided", "detach", "diagonal", "unfold"),
    *("empty", "empty_strided", "empty_like", "new_empty"),
)
_INDEXING = ("aten::index", "aten::index_put", "aten::index_put_", "aten::_unsafe_index")


class Log:
    """Operator calls on the pretend device, and waits of the host.

    Args:
        by_line: attribute calls to lines of the package (slow).

    Attributes:
        calls: number of calls by (operator, line).
        waits: number of waits by (reason, line), without copies that do not wait.
    """

    def __init__(self, by_line: bool = False):
        self.by_line = by_line
        self.clear()

    def clear(self) -> None:
        """Reset all counts."""
        self.calls: Counter[tuple[str, str]] = Counter()
        self.waits: Counter[tuple[str, str]] = Counter()

    @property
    def launches(self) -> int:
        """Number of calls that start work on the device: all but views and new memory."""
        return sum(
            n for (name, _), n in self.calls.items() if name.removeprefix("aten::") not in _WITHOUT_WORK
        )

    def add(self, name: str, reason: str | None) -> None:
        """Count a call and, with a ``reason``, a wait."""
        line = _line() if self.by_line else ""
        if not _inside_attention:
            self.calls[name, line] += 1
        if reason is not None:
            self.waits[reason, line] += 1


def _line() -> str:
    """The innermost running line of the package; ``backward`` inside autograd."""
    frame = sys._getframe(1)
    while frame is not None:
        file = frame.f_code.co_filename
        if file.startswith(_PACKAGE):
            return f"{file.removeprefix(_PACKAGE).lstrip('/')}:{frame.f_lineno}"
        frame = frame.f_back
    return "backward"


_logs: list[Log] = []
_inside_attention: list[bool] = []


@contextmanager
def _attention_is_one_call() -> Iterator[None]:
    """Count attention as one call: CUDA has a fused kernel for all uses in this package."""
    attention = functional.scaled_dot_product_attention

    def counted(*args, **kwargs):
        for log in _logs:
            log.add("aten::scaled_dot_product_attention", None)
        _inside_attention.append(True)
        try:
            return attention(*args, **kwargs)
        finally:
            _inside_attention.pop()

    functional.scaled_dot_product_attention = counted
    try:
        yield
    finally:
        functional.scaled_dot_product_attention = attention


class _Backend(_DummyBackendModule):
    """The interface that autocast and the autograd engine expect of a backend."""

    def get_amp_supported_dtype(self) -> list[torch.dtype]:
        return [torch.bfloat16, torch.float16]

    def is_autocast_enabled(self) -> bool:
        return False


# Registered as "pretend" below.
CPU, DEVICE = torch.device("cpu"), torch.device("privateuseone", 0)


class PretendTensor(torch.Tensor):
    """A tensor on the pretend device; ``inner`` holds its values."""

    @staticmethod
    def __new__(cls, inner: torch.Tensor) -> "PretendTensor":
        tensor = torch.Tensor._make_wrapper_subclass(
            cls,
            inner.shape,
            strides=inner.stride(),
            storage_offset=inner.storage_offset(),
            dtype=inner.dtype,
            device=DEVICE,
        )
        tensor.inner = inner
        return tensor

    __torch_function__ = torch._C._disabled_torch_function_impl

    def tolist(self):
        return self.cpu().tolist()

    def data_ptr(self):
        return self.inner.data_ptr()

    def __deepcopy__(self, memo):
        """Copy by clone: PyTorch's implementation copies the storage, which is empty."""
        copied = memo[id(self)] = self.detach().clone().requires_grad_(self.requires_grad)
        if hasattr(self, "_is_param"):
            copied._is_param = True
        return copied

    def numpy(self, *, force: bool = False):
        raise TypeError(f"can't convert a tensor on {DEVICE} to numpy ({_line()}): copy it with cpu() first")

    def __reduce_ex__(self, protocol):
        """Save the values, as CUDA tensors do for machines without CUDA."""
        return self.inner.__reduce_ex__(protocol)

    def __repr__(self, **_) -> str:
        return f"pretend({self.inner!r})"

    @classmethod
    def __torch_dispatch__(cls, function, types, args=(), kwargs=None):
        return _call(function, args, kwargs or {})


class _Mode(TorchDispatchMode):
    """Intercepts factories, which have no tensor of the device among their arguments."""

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        return _call(function, args, kwargs or {})


@contextmanager
def pretend_device(by_line: bool = False) -> Iterator[Log]:
    """Within the context, ``device="pretend"`` works for every function of PyTorch; yields the log of
    its calls."""
    if torch.cuda.is_available():
        raise SkipTest("the pretend device needs a process without CUDA (CUDA_VISIBLE_DEVICES=)")
    log = Log(by_line)
    _logs.append(log)
    try:
        with _Mode(), _attention_is_one_call(), mock.patch.object(dispatch, "DEVICES", {DEVICE.type}):
            yield log
    finally:
        _logs.remove(log)


def _call(function, args, kwargs):
    """Run an operator on the values of its arguments; its result is on the device that CUDA would choose."""
    name = function.name().split(".")[0]
    tensors = list(_tensors((args, *kwargs.values())))
    is_here = any(isinstance(value, PretendTensor) for value in tensors)
    if is_here:
        _refuse_strangers(name, tensors)
    to_here = is_here
    if kwargs.get("device") is not None:
        to_here = torch.device(kwargs["device"]).type == DEVICE.type
        kwargs = {**kwargs, "device": CPU if to_here else kwargs["device"]}
        if kwargs.get("pin_memory"):
            kwargs["pin_memory"] = False
    if is_here or to_here:
        reason = _reason_to_wait(name, args, kwargs, to_here)
        for log in _logs:
            log.add(name, reason)
    bare = {key: _mapped(value, _inner) for key, value in kwargs.items()}
    if function.namespace == "ghgs_lit":
        # Plain PyTorch instead of CUDA kernels; autograd, off here, must compute its gradients.
        function = dispatch.OPERATORS[name.removeprefix("ghgs_lit::")].plain
        with torch._C._SetExcludeDispatchKeyGuard(torch._C.DispatchKey.AutogradFunctionality, False):
            return _mapped(function(*_mapped(args, _inner), **bare), PretendTensor)
    result = function(*_mapped(args, _inner), **bare)
    if function._schema.is_mutable:
        written = _written(function, args, kwargs)
        _require_same_size(name, written)
        if function._schema.returns and written:
            return written[0] if len(written) == 1 else tuple(written)
    return _mapped(result, PretendTensor) if to_here else result


def _tensors(values) -> Iterator[torch.Tensor]:
    """Tensors among arguments of an operator, whose only containers are lists and tuples."""
    for value in values:
        if isinstance(value, torch.Tensor):
            yield value
        elif isinstance(value, list | tuple):
            yield from _tensors(value)


def _mapped(value, function):
    """``value`` with ``function`` applied to its tensors."""
    if isinstance(value, torch.Tensor):
        return function(value)
    return type(value)(_mapped(v, function) for v in value) if isinstance(value, list | tuple) else value


def _inner(tensor: torch.Tensor) -> torch.Tensor:
    return tensor.inner if isinstance(tensor, PretendTensor) else tensor


def _refuse_strangers(name: str, tensors: list[torch.Tensor]) -> None:
    strangers = [value for value in tensors if not isinstance(value, PretendTensor)]
    if name not in _WITHOUT_NUMBERS:
        strangers = [value for value in strangers if value.dim() > 0]
    if strangers and name not in _COPIES:
        shapes = [tuple(value.shape) for value in strangers]
        raise RuntimeError(f"{name}: expected all tensors on {DEVICE}; found {shapes} on the CPU ({_line()})")


def _reason_to_wait(name, args, kwargs, to_here: bool) -> str | None:
    """Reason for a device-to-host synchronisation of CUDA in this call; None: it does not wait."""
    if name in _WAITING:
        return name.removeprefix("aten::")
    if name in _INDEXING:
        masks = sum(x is not None and x.dtype in (torch.bool, torch.uint8) for x in args[1])
        return "boolean index" if masks else None
    if name not in _COPIES:
        return None
    source, target = (args[1], args[0]) if name == "aten::copy_" else (args[0], None)
    from_here = isinstance(source, PretendTensor)
    to_here = to_here if target is None else isinstance(target, PretendTensor)
    if from_here == to_here:
        return None
    if not to_here:
        return "copy to the host"
    waits = not (kwargs.get("non_blocking") or (len(args) > 2 and args[2] is True))
    # A number is passed to the kernel as an argument.
    return "copy to the device" if waits and source.dim() > 0 else None


def _written(function, args, kwargs) -> list[torch.Tensor]:
    """Arguments that an operator changes in place and returns."""
    arguments = function._schema.arguments
    values = [*args, *(kwargs.get(argument.name) for argument in arguments[len(args) :])]
    written = [
        value
        for argument, value in zip(arguments, values, strict=True)
        if argument.alias_info is not None and argument.alias_info.is_write
    ]
    return [value for value in written if isinstance(value, torch.Tensor)]


def _require_same_size(name: str, tensors: list[torch.Tensor]) -> None:
    for tensor in tensors:
        if isinstance(tensor, PretendTensor) and tensor.inner.shape != tensor.shape:
            raise NotImplementedError(f"{name} changes the size of a tensor on {DEVICE} ({_line()})")


def _empty_strided(size, stride, *, dtype=None, layout=None, device=None, pin_memory=None):
    return PretendTensor(torch.empty_strided(size, stride, dtype=dtype, device=CPU))


def _empty(size, *, dtype=None, layout=None, device=None, pin_memory=None, memory_format=None):
    return PretendTensor(torch.empty(size, dtype=dtype, device=CPU, memory_format=memory_format))


def _copy_from(source, target, non_blocking=False):
    return _call(torch.ops.aten.copy_.default, (target, source), {"non_blocking": non_blocking})


# On import: autograd starts no thread for a device registered after a process's first backward pass.
if not torch.cuda.is_available():
    _setup_privateuseone_for_python_backend("pretend", _Backend())
    # Indexing by lists and a few others call these from C++, not through the mode.
    _library = library.Library("aten", "IMPL")
    _library.impl("empty_strided", _empty_strided, "PrivateUse1")
    _library.impl("empty.memory_format", _empty, "PrivateUse1")
    _library.impl("_copy_from", _copy_from, "PrivateUse1")
