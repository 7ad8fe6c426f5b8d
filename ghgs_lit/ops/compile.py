"""Compilation of kernels with Numba; machine code is cached on disk until the sources change."""

import contextlib
import hashlib
import multiprocessing
import sys
from functools import cache
from pathlib import Path

import llvmlite.binding
import numba
from numba.core import event, types
from numba.core.caching import FunctionCache

# Kernels are only called from Python and helpers only from kernels:
# no other entry points are needed.
_OPTIONS = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
#: Numba types of kernel arguments: contiguous float32 arrays, indexed by number of dimensions, and
#: integers.
FLOATS = [types.Array(types.float32, dimensions, "C") for dimensions in range(6)]
NUMBER = types.int64


class _Cache(FunctionCache):
    """Numba's cache of one function; replaces files that are unreadable or built from other sources."""

    def __init__(self, py_func):
        super().__init__(py_func)
        self._cache_file._source_stamp = _digest(Path(py_func.__code__.co_filename).parent)

    def load_overload(self, sig, target_context):
        try:
            return super().load_overload(sig, target_context)
        except Exception:  # damaged pickles raise anything
            with contextlib.suppress(OSError):
                self.flush()
            return None

    def save_overload(self, sig, data):
        with contextlib.suppress(OSError):  # such as a full disk: the kernel runs without a file
            super().save_overload(sig, data)


class FirstCompilation(event.Listener):
    """Prints one line at the first compilation of the main process; worker processes print nothing."""

    is_said = multiprocessing.parent_process() is not None

    def on_start(self, event):
        if not self.is_said:
            print("compiling kernels for this processor (up to a minute, once) ...", file=sys.stderr)
        self.is_said = True

    def on_end(self, event):
        """Do nothing: Numba requires the method."""


event.register("numba:compile", FirstCompilation())


@cache
def _digest(folder: Path) -> str:
    """Digest of the sources that a kernel in ``folder`` depends on: those of this package, of ``folder``
    and of its parent, since kernels use no constants of other files."""
    digest = hashlib.sha256()
    rooms = (Path(__file__).parent, folder, folder.parent)
    for path in sorted(set().union(*(room.glob("*.py") for room in rooms))):
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()


def kernel(function):
    """Compile ``function`` on first use, to run without the interpreter lock.

    Numba's cache detects a changed file, but not changed globals or changes in modules whose code was
    inlined, and installers may keep a file's time stamp. Cached code is therefore stamped with the
    digest of all sources that it can depend on. Without a writable cache folder, each process
    compiles again.

    Args:
        function: called from Python only, with numbers and contiguous arrays.

    Returns:
        Numba's dispatcher, with the signature of ``function``.
    """
    compiled = numba.njit(**_OPTIONS)(function)
    with contextlib.suppress(RuntimeError):  # no folder for the cache
        compiled._cache = _Cache(function)
    return compiled


def kernel_for(*argument_types):
    """Decorate a kernel that has one signature and is compiled at the first call.

    The kernel rejects other signatures: another array layout would only cause another compilation.

    Args:
        argument_types: Numba types of the arguments, such as ``FLOATS[2]`` and :data:`NUMBER`.

    Returns:
        A decorator that replaces a function by a function without arguments that returns the compiled
        :func:`kernel`.
    """

    def decorate(function):
        @cache
        def compiled():
            dispatcher = kernel(function)
            dispatcher.compile(argument_types)
            dispatcher.disable_compile()
            return dispatcher

        return compiled

    return decorate


def helper(function):
    """Decorate a function that is only called in kernels, into which it is inlined."""
    return numba.njit(forceinline=True, no_cpython_wrapper=True, **_OPTIONS)(function)


def processor_features() -> set[str]:
    """LLVM names of the processor features that kernels may use, such as ``avx512bf16``.

    These are the features of this processor with the changes of ``NUMBA_CPU_FEATURES``: ``-avx512f``
    selects the kernels for AVX2. If ``NUMBA_CPU_NAME`` is set as well, they are only the features
    listed in ``NUMBA_CPU_FEATURES``.
    """
    changes = numba.config.CPU_FEATURES
    is_own = numba.config.CPU_NAME is None or changes is None
    host = llvmlite.binding.get_host_cpu_features() if is_own else {}
    features = {name for name, is_there in host.items() if is_there}
    for change in filter(None, (changes or "").split(",")):
        (features.add if change[0] == "+" else features.discard)(change[1:])
    return features
