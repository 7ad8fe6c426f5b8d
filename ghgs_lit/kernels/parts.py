"""Dividing work into parts that fit in memory."""

import torch


def at_once(device: torch.device, cpu: int, gpu: int) -> int:
    """How much is worked on at once: a CPU wants parts as large as its cache, a GPU few calls. ``device``:
    where the work is done. ``cpu``, ``gpu``: the limits."""
    return cpu if device.type == "cpu" else gpu


def even_parts(count: int, most: int) -> list[slice]:
    """Slices of at most ``most`` of ``count`` rows, of equal size (a small last part would be slow)."""
    parts = max(1, -(-count // max(1, most)))
    return [slice(count * i // parts, count * (i + 1) // parts) for i in range(parts)]
