"""Description of this machine."""

import os
import platform
from pathlib import Path
from typing import Any

import torch
from rich.filesize import decimal

from ghgs_lit.rendering import gsplat_backend
from ghgs_lit.runs.results import version_of
from ghgs_lit.runtime.cores import allowed_cores

DISTRIBUTION = "ghgs-lit"

Line = tuple[str, str]


def processor_name() -> str:
    """Model name of the processor, on Linux; elsewhere the name that Python reports."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def machine_facts(device: torch.device) -> dict[str, Any]:
    """Processor, vector width, cores, threads, device and version of PyTorch, as plain data.

    Args:
        device: that models run on.
    """
    return {
        "processor": processor_name(),
        "vectors": torch.backends.cpu.get_cpu_capability(),
        "cores": allowed_cores(),
        "threads": torch.get_num_threads(),
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu",
        "platform": platform.platform(),
        "torch": torch.__version__,
    }


def in_words(machine: dict[str, Any]) -> str:
    """:func:`machine_facts` on one line."""
    device = "" if machine["device"] == "cpu" else f"{machine['device']}, "
    cores = f"{machine['threads']} of {machine['cores']} cores"
    return f"{device}{machine['processor']} ({machine['vectors']}, {cores}), torch {machine['torch']}"


def machine_lines(device: torch.device) -> list[Line]:
    """Facts about the machine, as pairs of name and value.

    Args:
        device: that models run on.
    """
    facts = machine_facts(device)
    versions = (DISTRIBUTION, "torch", "lightning", "numpy", "numba", "gsplat")
    return [
        ("versions", ", ".join(f"{name} {version_of(name) or 'none'}" for name in versions)),
        ("platform", facts["platform"]),
        ("processor", f"{facts['processor']}, vectors {facts['vectors']}"),
        ("threads", f"{facts['threads']} of {facts['cores']} cores"),
        ("memory", decimal(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))),
        *_gpus(),
        ("renderer", _gsplat_state()),
        ("compiled kernels", os.environ.get("NUMBA_CACHE_DIR") or "next to the package's sources"),
    ]


def _gpus() -> list[Line]:
    if not torch.cuda.is_available():
        built = f"built for CUDA {torch.version.cuda}" if torch.version.cuda else "built without CUDA"
        return [("GPU", f"none that PyTorch can use ({built})")]
    lines = []
    for number in range(torch.cuda.device_count()):
        free, total = map(decimal, torch.cuda.mem_get_info(number))
        name = torch.cuda.get_device_properties(number).name
        lines.append((f"GPU {number}", f"{name}, {free} free of {total}, CUDA {torch.version.cuda}"))
    return lines


def _gsplat_state() -> str:
    try:
        gsplat_backend.load()
    except gsplat_backend.BackendUnavailable as error:
        return f"cpu ({error})"
    return "gsplat"
