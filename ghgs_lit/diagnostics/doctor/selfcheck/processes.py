"""Two processes, each with half of a batch, against one process with all of it."""

import dataclasses
import gc
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn

from ghgs_lit.diagnostics.benchmark.weights import random_model
from ghgs_lit.diagnostics.doctor.selfcheck.model import gradient_row, score, small_batch
from ghgs_lit.diagnostics.doctor.selfcheck.outcome import SKIPPED, Outcome, compared
from ghgs_lit.model import GHGS
from ghgs_lit.types import Batch

#: Both compute in float32; only the order of sums differs.
LIMIT = 1e-4


def two_processes(config: Mapping[str, Any], device: torch.device) -> Iterator[Outcome]:
    """The gradient of both, which DDP averages, is that of one process: by NCCL, on a CPU by gloo."""
    check = "gradient of two processes"
    if device.type == "cuda" and torch.cuda.device_count() < 2:
        yield Outcome(check, SKIPPED, f"needs two GPUs; found {torch.cuda.device_count()}")
        return
    if device.type not in ("cuda", "cpu"):
        yield Outcome(check, SKIPPED, f"no communication between devices of type {device.type}")
        return
    batch = small_batch(config)
    alone = _Scored(config, device)
    for half in _halves(batch):
        (alone(half.to(device)) / 2).backward()
    with tempfile.TemporaryDirectory() as folder:
        torch.multiprocessing.spawn(_process, (config, batch, device.type, folder), nprocs=2)
        found = torch.load(Path(folder) / "gradients", weights_only=True)
    yield compared(check, found, gradient_row(alone), LIMIT)


class _Scored(nn.Module):
    """A model and a loss, so that DDP sees every use of a weight."""

    def __init__(self, config: Mapping[str, Any], device: torch.device):
        super().__init__()
        self.model: GHGS = random_model(config).requires_grad_(True).to(device)

    def forward(self, batch: Batch) -> Tensor:
        return score(self.model(batch).gaussians)


def _halves(batch: Batch) -> list[Batch]:
    return [
        dataclasses.replace(batch, images=batch.images[b], masks=batch.masks[b], cameras=batch.cameras[b])
        for b in (slice(0, 1), slice(1, 2))
    ]


def _process(rank: int, config: Mapping[str, Any], batch: Batch, kind: str, folder: str) -> None:
    """One of the two processes; the first writes its gradients."""
    torch.set_num_threads(1)
    device = torch.device(kind, rank) if kind == "cuda" else torch.device(kind)
    dist.init_process_group(
        "nccl" if kind == "cuda" else "gloo", init_method=f"file://{folder}/meet", rank=rank, world_size=2
    )
    shared = nn.parallel.DistributedDataParallel(_Scored(config, device))
    shared(_halves(batch)[rank].to(device)).backward()
    if rank == 0:
        torch.save(gradient_row(shared.module), f"{folder}/gradients")
    # Before the group: as its last owner, DDP waits for gloo's thread while that waits for Python's lock.
    del shared
    gc.collect()
    dist.destroy_process_group()
