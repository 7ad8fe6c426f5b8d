"""Compile a kernel with Numba and keep its machine code on disk for as long as it is right."""

import hashlib
from functools import cache
from pathlib import Path

import llvmlite.binding
import numba

# Kernels are called from Python only, helpers from kernels only: no other way in is compiled.
_OPTIONS = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}


@cache
def _digest(folder: Path) -> str:
    """Digest of every source file that the machine code of a kernel in ``folder`` depends on."""
    digest = hashlib.sha256()
    for path in sorted({*Path(__file__).parent.glob("*.py"), *folder.glob("*.py")}):
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()


def kernel(function):
    """Compile ``function`` on first use; it runs without the interpreter lock.

    Numba's cache notices a changed file, but neither changed globals nor other modules whose code was
    inlined, and installers may keep a file's time stamp. So cached code is stamped with the digest of all
    sources of this package and of the kernel's folder. Without a writable place for a cache, kernels
    compile in each process.
    """
    try:
        compiled = numba.njit(cache=True, **_OPTIONS)(function)
        compiled._cache._cache_file._source_stamp = _digest(Path(function.__code__.co_filename).parent)
    except (RuntimeError, AttributeError):
        compiled = numba.njit(**_OPTIONS)(function)
    return compiled


def helper(function):
    """A function that kernels call; it is compiled into them."""
    return numba.njit(forceinline=True, no_cpython_wrapper=True, **_OPTIONS)(function)


def processor_features() -> set[str]:
    """Names that LLVM has for what kernels may use of this processor, such as ``avx512bf16``."""
    names = numba.config.CPU_FEATURES
    if names is None:
        names = llvmlite.binding.get_host_cpu_features().flatten()
    return {name[1:] for name in names.split(",") if name.startswith("+")}
