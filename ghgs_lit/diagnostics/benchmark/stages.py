"""Probes of the stages of a forward pass: seconds, peak memory and FLOPs."""

from collections.abc import Iterable
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Any

import torch
from torch.utils.flop_counter import FlopCounterMode, sdpa_backward_flop_count, sdpa_flop_count

from ghgs_lit.evaluation.measure import Renderer
from ghgs_lit.execution import Predictor
from ghgs_lit.method.model import GHGS, STAGES
from ghgs_lit.method.rounds import NoRounds
from ghgs_lit.ops.attention import attend
from ghgs_lit.runtime.allocation import can_forget_peak, forget_peak, resident_bytes, return_free_memory
from ghgs_lit.runtime.watching import Inputs, Stopwatch, Watcher, inside
from ghgs_lit.runtime.watching import watched as stages_watched
from ghgs_lit.types import Batch, Prediction, Rendering

ROUNDS = "rounds"
RENDER = "render"
TOTAL = "total"
OTHER = "other"  #: Work outside of stages: checks, padding
#: Modules of parts of stages, by ``<stage>.<part>``.
PARTS = {"encoder.patch_tokens": "encoder.aggregator.patch_embed"}
#: All timed names in the order of the data flow; those without a dot add up to ``total``.
NAMES = (*STAGES[:1], *PARTS, *STAGES[1:], ROUNDS, RENDER, OTHER, TOTAL)


class SecondsProbe(Stopwatch):
    """Times of the stages and of the rest."""

    def seconds(self) -> dict[str, float]:
        """Seconds by name, in the order of :data:`NAMES`."""
        known = super().seconds()
        known[OTHER] = known[TOTAL] - sum(known[name] for name in top_level(known))
        return {name: known[name] for name in NAMES if name in known}


def top_level(names: Iterable[str]) -> list[str]:
    """Names of whole stages, without parts, ``other`` and ``total``."""
    return [name for name in names if "." not in name and name not in (OTHER, TOTAL)]


def watched(model: GHGS, probe: Watcher) -> AbstractContextManager[None]:
    """Context in which a probe watches the stages of a model and their parts.

    Args:
        model: has the stages.
        probe: is called when they begin and end.
    """
    names = [*STAGES, *([] if isinstance(model.rounds, NoRounds) else [ROUNDS])]
    return stages_watched(model, {name: name for name in names} | PARTS, probe)


@torch.inference_mode()
def forward(
    predictor: Predictor, renderer: Renderer, batch: Batch, probe: Watcher
) -> tuple[Prediction, Rendering]:
    """Predict the Gaussians of a batch and render its targets under a probe.

    Args:
        predictor: with a model in evaluation mode.
        renderer: draws the targets.
        batch: with targets, which the model does not see.
        probe: is called when stages, rendering and the whole begin and end.
    """
    with watched(predictor.model, probe), inside(TOTAL, probe):
        prediction = predictor(replace(batch, targets=None))
        with inside(RENDER, probe):
            rendering = renderer(prediction.gaussians, batch.targets.cameras)
    return prediction, rendering


class PeakProbe(Watcher):
    """Peak memory of each stage: of the process on a CPU, of all tensors on CUDA.

    Systems without Linux's counters have none.

    Args:
        device: where the model runs.

    Attributes:
        peaks: most bytes by stage beyond those held when the first stage began, such as weights and
            photographs.
    """

    def __init__(self, device: torch.device):
        self.device = device
        self.peaks: dict[str, int] = {}
        self._open: list[str] = []
        self._base = 0

    def begin(self, stage: str, inputs: Inputs = ((), {})) -> None:
        if self.is_available:
            if self._open:
                self._note()
            else:
                self._base = self.held()
            self.reset()
            self._open.append(stage)

    def end(self, stage: str, result: Any = None) -> None:
        if self.is_available:
            self._note()
            self._open.pop()
            self.reset()

    def _note(self) -> None:
        peak = self.peak() - self._base
        for stage in self._open:
            self.peaks[stage] = max(self.peaks.get(stage, 0), peak)

    @property
    def is_available(self) -> bool:
        """Whether the system has counters whose peak can be reset."""
        return self.device.type == "cuda" or can_forget_peak()

    def held(self) -> int:
        """Bytes held now."""
        if self.device.type == "cuda":
            return torch.cuda.memory_allocated(self.device)
        return_free_memory()
        return resident_bytes()

    def peak(self) -> int:
        """Most bytes since the last :meth:`reset`."""
        is_cuda = self.device.type == "cuda"
        return torch.cuda.max_memory_allocated(self.device) if is_cuda else resident_bytes("VmHWM")

    def reset(self) -> None:
        """Forget the peak."""
        if self.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(self.device)
        else:
            return_free_memory()  # what an earlier stage freed does not count
            forget_peak()


#: FLOPs of attention on a CPU, which PyTorch's counter does not know.
_CPU_ATTENTION = {
    attend.packet: lambda q, k, v, *_, **__: sdpa_flop_count(q, k, v),
    torch.ops.aten._scaled_dot_product_flash_attention_for_cpu: (
        lambda q, k, v, *_, **__: sdpa_flop_count(q, k, v)
    ),
    torch.ops.aten._scaled_dot_product_flash_attention_for_cpu_backward: (
        lambda gradient, q, k, v, *_, **__: sdpa_backward_flop_count(gradient, q, k, v)
    ),
}


class FlopsProbe(Watcher):
    """Context that counts multiplications and additions of products by stage.

    The encoder's compiled kernel counts, too; the rasterizer does not.

    Attributes:
        flops: number by stage.
    """

    def __init__(self) -> None:
        self.flops: dict[str, int] = {}
        self._counter = FlopCounterMode(display=False, custom_mapping=_CPU_ATTENTION)
        self._open: list[int] = []

    def begin(self, stage: str, inputs: Inputs = ((), {})) -> None:
        self._open.append(self._so_far())

    def end(self, stage: str, result: Any = None) -> None:
        self.flops[stage] = self.flops.get(stage, 0) + self._so_far() - self._open.pop()

    def __enter__(self) -> "FlopsProbe":
        self._counter.__enter__()
        return self

    def __exit__(self, *details: Any) -> None:
        self._counter.__exit__(*details)

    def _so_far(self) -> int:
        return self._counter.get_total_flops()
