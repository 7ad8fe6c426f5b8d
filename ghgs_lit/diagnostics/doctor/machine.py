"""Facts about this machine, and optional extras that are missing."""

import importlib.metadata
import os
import re
from collections.abc import Iterator

import torch
from rich.filesize import decimal

from ghgs_lit.diagnostics.benchmark.machine import machine_facts
from ghgs_lit.rendering import gsplat_backend

DISTRIBUTION = "ghgs-lit"

Line = tuple[str, str]


def machine_lines(device: torch.device) -> list[Line]:
    """Facts about the machine, as pairs of name and value."""
    facts = machine_facts(device)
    versions = (DISTRIBUTION, "torch", "lightning", "numpy", "numba", "gsplat")
    return [
        ("versions", ", ".join(f"{name} {_version(name) or 'none'}" for name in versions)),
        ("platform", facts["platform"]),
        ("processor", f"{facts['processor']}, vectors {facts['vectors']}"),
        ("threads", f"{facts['threads']} of {facts['cores']} cores"),
        ("memory", decimal(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))),
        *_gpus(),
        ("renderer", _gsplat_state()),
        ("compiled kernels", os.environ.get("NUMBA_CACHE_DIR") or "beside the package's sources"),
    ]


def missing_extras() -> Iterator[Line]:
    """Yield each incomplete extra of the package with the command that installs it."""
    wanted: dict[str, list[str]] = {}
    if _version(DISTRIBUTION) is None:  # run from its sources
        yield DISTRIBUTION, "not installed, so that its extras are not known: pip install -e ."
        return
    for requirement in importlib.metadata.requires(DISTRIBUTION) or []:
        extra = re.search(r"extra == ['\"]([\w-]+)['\"]", requirement)
        if extra and extra[1] != "dev":
            wanted.setdefault(extra[1], []).append(re.match(r"[\w.-]+", requirement)[0])
    for extra, names in wanted.items():
        absent = [name for name in names if _version(name) is None]
        if absent:
            yield extra, f"{', '.join(absent)} missing: pip install '{DISTRIBUTION}[{extra}]'"


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _gpus() -> list[Line]:
    if not torch.cuda.is_available():
        return [("GPU", f"none that PyTorch can use (built for CUDA {torch.version.cuda})")]
    found = []
    for number in range(torch.cuda.device_count()):
        free, total = map(decimal, torch.cuda.mem_get_info(number))
        name = torch.cuda.get_device_properties(number).name
        found.append((f"GPU {number}", f"{name}, {free} free of {total}, CUDA {torch.version.cuda}"))
    return found


def _gsplat_state() -> str:
    try:
        gsplat_backend.load()
    except gsplat_backend.BackendUnavailable as error:
        return f"cpu ({error})"
    return "gsplat"
