"""Correct the cameras and colour gains of a static rig jointly over several instants.

A single instant shows one pose, often with a mask error; several instants constrain the cameras better, and
cameras that are constant over a sequence do not flicker."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import torch

from ghgs_capture.agreement import CORRECTION, doubt_of_cameras, doubt_of_masks
from ghgs_capture.capture import Capture
from ghgs_capture.crops import Photograph
from ghgs_lit.execution import Predictor
from ghgs_lit.geometry.frame import Frame
from ghgs_lit.method.rounds import NoRounds
from ghgs_lit.method.rounds.gains import log_gains
from ghgs_lit.refinement import CameraRefinement, pixels_moved
from ghgs_lit.rendering import Renderer
from ghgs_lit.types import Batch, Cameras

INSTANTS = 8  #: Number of instants, spread over a sequence, for correcting its cameras
#: Largest gain of a camera's colours relative to the mean of all cameras; the least is its inverse.
MOST_GAIN = 2.0
#: Median deviation of log gains above which exposures change between instants.
_CHANGING = 0.05


def spread(values: Sequence[Any], count: int) -> list[Any]:
    """Select up to ``count`` (2 or more) values, evenly spread from the first to the last."""
    places = [round((len(values) - 1) * i / (count - 1)) for i in range(count)]
    return [values[place] for place in dict.fromkeys(places)] if len(values) else []


@dataclass(frozen=True)
class Rig:
    """Corrected cameras, and colour gains if found, by name."""

    extrinsics: Mapping[str, np.ndarray]  #: [4, 4] float64, world to camera
    zoom: Mapping[str, float]  #: factor of the focal lengths
    moved: Mapping[str, float]  #: pixels of a crop by which the correction moved the subject
    why: str = ""  #: reason of the correction if ``auto`` chose it
    #: [3], with a geometric mean of 1
    gains: Mapping[str, np.ndarray] = field(default_factory=dict)

    def apply(self, capture: Capture) -> Capture:
        """Replace the cameras of a capture by the corrected ones.

        Args:
            capture: capture of this rig with uncorrected cameras; those that the rig lacks are kept.
        """
        return replace(capture, photographs=tuple(map(self._correct, capture.photographs)))

    def _correct(self, photograph: Photograph) -> Photograph:
        """Correct one camera; a camera that most instants lack is unchanged."""
        pose = self.extrinsics.get(photograph.name, photograph.extrinsics)
        zoom = self.zoom.get(photograph.name, 1.0)
        lens = photograph.intrinsics * [zoom, zoom, 1.0]
        gains = self.gains.get(photograph.name, photograph.gains)
        return replace(photograph, intrinsics=lens, extrinsics=pose, gains=gains)


def correct_rig(
    captures: Sequence[Capture],
    model: Predictor,
    size: tuple[int, int],
    rounds: int | Literal["auto"],
    refine_masks: int | Literal["auto"],
    renderer: Renderer,
) -> Rig | None:
    """Correct the cameras of a rig over several instants jointly.

    Args:
        captures: captures of one rig; only those with the most common set of cameras are used.
        model: in evaluation mode; its predictions are compared with the photographs.
        size: (height, width) of the crops in pixels.
        rounds: maximum number of rounds of :class:`ghgs_lit.refinement.CameraRefinement`; ``auto``: 4 if
            the silhouettes of half of the instants contradict the cameras.
        refine_masks: as for :func:`ghgs_capture.prediction.predict`.
        renderer: renders the comparisons.

    Returns:
        The cameras with their gains; None if they are unchanged.
    """
    names = Counter(_names(capture) for capture in captures).most_common(1)[0][0]
    captures = [capture for capture in captures if _names(capture) == names]
    batches = []
    doubts = []
    for capture in captures:
        masks = refine_masks
        if masks == "auto":
            masks = CORRECTION if doubt_of_masks(capture, size) else 0
        batches.append(capture.batch(size, masks))
        doubts.append(doubt_of_cameras(capture, batches[-1]) if rounds == "auto" else "")
    contradicted = [doubt for doubt in doubts if doubt]
    if rounds == "auto":
        if 2 * len(contradicted) < len(captures):
            return None
        rounds = CORRECTION
    batch = _together(batches).to(next(model.model.parameters()).device)
    corrected = CameraRefinement(rounds, model, renderer, shared=True)(batch)
    before = batch.cameras
    after = corrected.cameras
    if torch.equal(before.extrinsics, after.extrinsics) and torch.equal(before.intrinsics, after.intrinsics):
        return None
    why = f"in {len(contradicted)} of {len(captures)} instants {contradicted[0]}" if contradicted else ""
    extrinsics = after.extrinsics[0].double().cpu().numpy()
    zoom = (after.intrinsics / before.intrinsics)[0, :, 0, 0].tolist()
    moved = np.mean(pixels_moved(batch, corrected), 0).tolist()
    gains = shared_gains(corrected, model)
    by_name = (dict(zip(names, values, strict=True)) for values in (extrinsics, zoom, moved))
    return Rig(*by_name, why, {} if gains is None else dict(zip(names, gains, strict=True)))


@torch.no_grad()
def shared_gains(batch: Batch, model: Predictor) -> np.ndarray | None:
    """Estimate colour gains of cameras: the median over instants, with geometric mean 1 over cameras.

    Args:
        batch: one element per instant, in the world.
        model: in evaluation mode.

    Returns:
        [V, 3] from ``1 / MOST_GAIN`` to ``MOST_GAIN``; None if exposures change between instants, or the
        model does not use gains.
    """
    rounds = model.model.rounds
    if isinstance(rounds, NoRounds) or not rounds.options.gains:
        return None
    batch = Frame.of(batch).enter(batch)
    each = log_gains(model(batch).gaussians, batch)
    logs = each.quantile(0.5, 0)
    if (each - logs).abs().quantile(0.5, 0).max() > _CHANGING:
        return None
    logs = (logs - logs.mean(0)).double()
    scale = (math.log(MOST_GAIN) / logs.abs().amax(0)).clamp(max=1)
    return torch.exp(logs * scale).clamp(1 / MOST_GAIN, MOST_GAIN).cpu().numpy()


def _names(capture: Capture) -> tuple[str, ...]:
    return tuple(photograph.name for photograph in capture.photographs)


def _together(batches: Sequence[Batch]) -> Batch:
    """Concatenate batches of one element with the same views."""
    parts = {}
    for name in ("images", "masks", "alpha"):
        if getattr(batches[0], name) is not None:
            parts[name] = torch.cat([getattr(batch, name) for batch in batches])
    intrinsics = torch.cat([batch.cameras.intrinsics for batch in batches])
    extrinsics = torch.cat([batch.cameras.extrinsics for batch in batches])
    cameras = Cameras(intrinsics, extrinsics, *parts["masks"].shape[2:])
    subjects = tuple(batch.subjects[0] for batch in batches)
    views = tuple(batch.views[0] for batch in batches)
    return Batch(**parts, cameras=cameras, subjects=subjects, views=views)
