"""The stages of a forward pass as they are measured: their names, and a pass that is watched."""

import dataclasses
from collections.abc import Iterable
from contextlib import AbstractContextManager

import torch

from ghgs_lit.evaluation.measure import Renderer
from ghgs_lit.kernels.watching import Stopwatch, Watcher, inside
from ghgs_lit.kernels.watching import watched as stages_watched
from ghgs_lit.model import GHGS, STAGES
from ghgs_lit.types import Batch, Prediction, Rendering

ROUNDS, RENDER, TOTAL = "rounds", "render", "total"
#: What lies in no stage: checks, padding.
OTHER = "other"
#: Parts of stages: a name ``<stage>.<part>``, and where the part is in the model.
PARTS = {"encoder.patch_tokens": "encoder.aggregator.patch_embed"}
#: All that is timed, in the order of the data flow. The stages without a dot add up to ``total``.
NAMES = (*STAGES[:1], *PARTS, *STAGES[1:], ROUNDS, RENDER, OTHER, TOTAL)


class SecondsProbe(Stopwatch):
    """The time of each stage and of what lies in none."""

    def seconds(self) -> dict[str, float]:
        """Seconds of each stage, and of ``other``, in the order of :data:`NAMES`."""
        known = super().seconds()
        known[OTHER] = known[TOTAL] - sum(known[name] for name in top_level(known))
        return {name: known[name] for name in NAMES if name in known}


def top_level(names: Iterable[str]) -> list[str]:
    """The names of stages that lie in no other and are not their sum."""
    return [name for name in names if "." not in name and name not in (OTHER, TOTAL)]


def watched(model: GHGS, probe: Watcher) -> AbstractContextManager[None]:
    """Let ``probe`` see the stages of ``model`` and their parts."""
    return stages_watched(model, {name: name for name in (*STAGES, ROUNDS)} | PARTS, probe)


@torch.inference_mode()
def forward(model: GHGS, renderer: Renderer, batch: Batch, probe: Watcher) -> tuple[Prediction, Rendering]:
    """Predict the Gaussians of a batch and render its targets, while ``probe`` watches."""
    with watched(model, probe), inside(TOTAL, probe):
        prediction = model(dataclasses.replace(batch, targets=None))
        with inside(RENDER, probe):
            rendering = renderer(prediction.gaussians, batch.targets.cameras)
    return prediction, rendering
