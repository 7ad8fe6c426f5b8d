"""Compile a kernel with Numba and keep its machine code on disk for as long as it is right."""

import hashlib
import warnings
from functools import cache
from pathlib import Path

import llvmlite.binding
import numba

# Kernels are called from Python only, helpers from kernels only: no other way in is compiled.
_OPTIONS = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}


def _sources_digest() -> str:
    """Digest of every source file that the machine code of a kernel depends on."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()


_DIGEST = _sources_digest()


def kernel(function):
    """Compile ``function`` on first use; it runs without the interpreter lock.

    Numba's cache notices a changed file, but neither changed globals nor other modules whose code was
    inlined, and installers may keep a file's time stamp. So cached code here is stamped with the digest
    of all sources of this package. Without a writable place for a cache, kernels compile in each process.
    """
    try:
        compiled = numba.njit(cache=True, **_OPTIONS)(function)
        compiled._cache._cache_file._source_stamp = _DIGEST
    except (RuntimeError, AttributeError):
        compiled = numba.njit(**_OPTIONS)(function)
    return compiled


def helper(function):
    """A function that kernels call; it is compiled into them."""
    return numba.njit(forceinline=True, no_cpython_wrapper=True, **_OPTIONS)(function)


@cache
def warn_of_narrow_vectors() -> None:
    """Warn, once in a process, where vectors are narrower than 256 bits.

    The kernels fall back to what the machine has: LLVM splits their vectors, and the image is the same.
    """
    names = numba.config.CPU_FEATURES
    if names is None:
        names = llvmlite.binding.get_host_cpu_features().flatten()
    if "+avx2" not in names and "+sve" not in names:
        warnings.warn(
            "renderer=cpu: this processor has no vectors of 256 bits or more (AVX2, AVX-512, SVE); "
            "the rasterizer splits its own and takes several times as long",
            RuntimeWarning,
            stacklevel=2,
        )
