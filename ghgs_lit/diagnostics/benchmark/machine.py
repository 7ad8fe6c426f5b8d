"""The machine that times were measured on."""

import platform
from pathlib import Path
from typing import Any

import torch

from ghgs_lit.kernels.cores import allowed_cores


def processor_name() -> str:
    """Model name of the processor; on other systems than Linux what Python knows of it."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def machine_facts(device: torch.device) -> dict[str, Any]:
    """Processor, vector width, cores, threads, device and PyTorch's version, as plain data."""
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
