"""Gaussians of a capture in the user's world, and of any batch, with corrected cameras and tone curves."""

import functools
import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from ghgs_capture.agreement import CORRECTION, doubt_of_cameras, doubt_of_masks
from ghgs_capture.capture import Capture
from ghgs_capture.crops import Photograph
from ghgs_lit.config.keys import lookup
from ghgs_lit.config.options import image_size
from ghgs_lit.errors import require
from ghgs_lit.execution import Predictor
from ghgs_lit.geometry.frame import Frame
from ghgs_lit.method.model import GHGS
from ghgs_lit.method.rounds.coarse import FILLED
from ghgs_lit.method.rounds.gains import log_gammas
from ghgs_lit.refinement import CameraRefinement, Refinement, Report, pixels_moved
from ghgs_lit.rendering import Renderer
from ghgs_lit.types import Batch, Gaussians, Prediction
from ghgs_lit.weights.checkpoint import read_config
from ghgs_lit.weights.reading import SHIPPED, file_of

#: Log gamma of all channels, beside the median camera's, above which a camera has a tone curve of
#: its own, and how many times as large in one as in another: what light and wrong depths do
#: differs between them.
_OWN = 0.1
_UNLIKE = 2.0


@dataclass(frozen=True)
class CapturePrediction:
    """A prediction with the batch that the model saw."""

    #: photographs or crops around the subject, masks and cameras, corrected where asked
    batch: Batch
    prediction: Prediction  #: of this batch, in the world and unit of its cameras
    #: pixels that correcting cameras moved the subject by in each photograph
    moved: tuple[float, ...] = ()
    #: share of the subject that refining masks changed in each crop
    changed: tuple[float, ...] = ()
    refined: Report | None = None  #: what refining the Gaussians gained, where asked; depths stay
    #: doubts, by the refinement that ``auto`` chose
    why: dict[str, str] = field(default_factory=dict)
    #: gammas of cameras that were undone, by name
    tones: dict[str, float] = field(default_factory=dict)

    @property
    def gaussians(self) -> Gaussians:
        return self.prediction.gaussians


@torch.no_grad()
def predict(
    capture: Capture,
    model: Predictor | GHGS | str | Path = SHIPPED,
    size: int | tuple[int, int] | None = None,
    refine_cameras: int | Literal["auto"] = "auto",
    refine_masks: int | Literal["auto"] = "auto",
    refine: int = 0,
    renderer: Renderer | None = None,
    tones: Mapping[str, float] | Literal["auto"] = "auto",
) -> CapturePrediction:
    """The Gaussians of a capture, in the user's world.

    Args:
        capture: photographs of one instant with masks and cameras, in any unit of length.
        model: a predictor or its stages in evaluation mode, or a checkpoint (kept in memory for further
            calls): a path, or the one that comes with the package.
        size: side or (height, width) of the crops that the model sees, in pixels; None: as it was
            trained (checkpoints only).
        refine_cameras: most rounds that correct the cameras until the photographs agree
            (:class:`ghgs_lit.refinement.CameraRefinement`); 0: none; ``auto``: 4 where silhouettes
            contradict one another.
        refine_masks: pixels of a crop by which masks may be wrong; mattes are then searched in the
            photographs (:func:`ghgs_lit.data.matting.refine_matte`). 0: masks are right; ``auto``:
            4 where photographs show other outlines.
        refine: steps that bring the Gaussians nearer to the photographs, such as 15; 0: none.
        renderer: what refining draws with; None: that of the device.
        tones: gammas of cameras, by name, that are undone first; ``auto``: of those that have one
            of their own beside the others, by a first prediction.

    Returns:
        The prediction with the crops, on the model's device, and what was corrected and why.

    Raises:
        InputError: the checkpoint cannot be used, or the size does not fit the model.
    """
    if isinstance(model, GHGS):
        model = Predictor(model)
    if not isinstance(model, Predictor):
        path = file_of(model)
        model = _model(path, path.stat().st_mtime_ns)
        size = crop_size(size, read_config(path), model)
    require(size is not None, "size", "a size in pixels beside a model that is no checkpoint", size)
    refining = refine_cameras, refine_masks, refine
    keys = model, image_size("size", size), *refining, renderer or Renderer()
    result = _predicted(capture if tones == "auto" else without_tones(capture, tones), *keys)
    if tones != "auto":
        return replace(result, tones=dict(tones))
    tones = own_tones(result.batch, result.gaussians)
    if not tones:
        return result
    return replace(_predicted(without_tones(capture, tones), *keys), tones=tones)


def _predicted(
    capture: Capture,
    model: Predictor,
    size: tuple[int, int],
    refine_cameras: int | Literal["auto"],
    refine_masks: int | Literal["auto"],
    refine: int,
    renderer: Renderer,
) -> CapturePrediction:
    """:func:`predict` of photographs with their colours as they are.

    Args:
        capture: photographs of one instant.
        model: in evaluation mode.
        size: (height, width) of the crops in pixels.
        refine_cameras: as for :func:`predict`.
        refine_masks: as for :func:`predict`.
        refine: as for :func:`predict`.
        renderer: what refining draws with.

    Returns:
        As of :func:`predict`, without ``tones``.
    """
    why = {}
    if refine_masks == "auto":
        why["refine_masks"] = doubt_of_masks(capture, size)
        refine_masks = CORRECTION if why["refine_masks"] else 0
    batch = capture.batch(size, refine_masks)
    changed = ()
    if refine_masks:
        given = capture.batch(size).alpha
        changed = tuple(((batch.alpha - given).abs().sum((-2, -1)) / given.sum((-2, -1)))[0].tolist())
    if refine_cameras == "auto":
        why["refine_cameras"] = doubt_of_cameras(capture, batch)
        refine_cameras = CORRECTION if why["refine_cameras"] else 0
    batch = batch.to(next(model.model.parameters()).device)
    forward = functools.partial(in_frame, model)
    result = predict_batch(batch, model, renderer, refine_cameras, refine, forward)
    return replace(result, changed=changed, why={name: doubt for name, doubt in why.items() if doubt})


def in_frame(model: Predictor, batch: Batch) -> Prediction:
    """Predict in the subject's frame, whatever the weights, so that a capture may have any unit.

    Args:
        model: in evaluation mode.
        batch: photographs, masks and cameras.

    Returns:
        The prediction in the world of the batch's cameras.
    """
    # Weights with compat=release do not enter a frame of their own.
    frame = Frame.of(batch)
    return frame.leave(model(frame.enter(batch)), batch.cameras.extrinsics.dtype)


def predict_batch(
    batch: Batch,
    model: Predictor,
    renderer: Renderer,
    refine_cameras: int = 0,
    refine: int = 0,
    forward: Callable[[Batch], Prediction] | None = None,
) -> CapturePrediction:
    """The Gaussians of a batch of one subject, which keeps its targets.

    Args:
        batch: photographs, masks and cameras, on the model's device.
        model: in evaluation mode.
        renderer: draws what :class:`ghgs_lit.refinement.CameraRefinement` and
            :class:`ghgs_lit.refinement.Refinement` compare.
        refine_cameras: most rounds of ``CameraRefinement``; 0: none.
        refine: steps of ``Refinement``; 0: none.
        forward: predicts a batch without targets; None: the model.

    Returns:
        The prediction, with the batch as corrected.
    """
    forward = forward or model
    moved = ()
    refined = None
    if refine_cameras:
        given = batch
        batch = CameraRefinement(refine_cameras, model, renderer)(batch)
        moved = tuple(pixels_moved(given, batch)[0])
    inputs = replace(batch, targets=None)
    prediction = forward(inputs)
    if refine:
        refinement = Refinement(refine, renderer)
        before = prediction.gaussians
        prediction = replace(prediction, gaussians=refinement(before, batch))
        refined = refinement.report(before, prediction.gaussians, inputs, lambda b: forward(b).gaussians)
    return CapturePrediction(batch, prediction, moved, refined=refined)


def trained_size(config: Mapping[str, Any]) -> int | tuple[int, int]:
    """Size of the photographs that a checkpoint's model was trained with.

    Args:
        config: of the checkpoint. A training from coarse to fine saw larger photographs than those
            in which its stages know a subject (``rounds.height``): the latter count, for larger
            ones are asked for. Of imported weights the encoder's position embedding counts.

    Returns:
        Side or (height, width) in pixels.
    """
    size = lookup(config, "data.size") or lookup(config, "encoder.image_size") or 518
    known = lookup(config, "rounds.height")
    if not isinstance(known, int):
        return size
    patch = lookup(config, "encoder.patch_size")
    side = int(known / FILLED) // patch * patch
    return side if side < min(image_size("size", size)) else size


def crop_size(
    size: int | tuple[int, int] | None, config: Mapping[str, Any], model: Predictor
) -> tuple[int, int]:
    """Size of the crops that a checkpoint's model sees.

    Warns of sizes larger than in training, which make results worse, not sharper, where the model
    does not work from coarse to fine (``rounds.height``).

    Args:
        size: side or (height, width) in pixels; None: as the model was trained.
        config: of the checkpoint.
        model: that of the checkpoint.

    Returns:
        (height, width) in pixels.

    Raises:
        InputError: the model cannot take this size.
    """
    trained = image_size("size", trained_size(config))
    height, width = trained if size is None else image_size("size", size)
    multiple = model.side_multiple
    expected = f"sides divisible by the patch size {multiple}"
    require(height % multiple == width % multiple == 0, "size", expected, (height, width))
    is_coarse_to_fine = model.model.rounds.height is not None
    if not is_coarse_to_fine and (height > trained[0] or width > trained[1]):
        warnings.warn(
            f"size: {height} x {width} is larger than the {trained[0]} x {trained[1]} of the training, which"
            " makes results worse, not sharper",
            stacklevel=3,
        )
    return height, width


@functools.lru_cache(maxsize=1)
def _model(path: Path, changed: int) -> Predictor:
    return Predictor.from_checkpoint(path)


def own_tones(batch: Batch, gaussians: Gaussians) -> dict[str, float]:
    """Find cameras with a tone curve of their own.

    Two photographs do not tell which of them has it.

    Args:
        batch: photographs of one subject.
        gaussians: predicted from the batch.

    Returns:
        Their gammas, about, by name.
    """
    if len(batch.views[0]) < 3:
        return {}
    tones = {}
    for name, logs in zip(batch.views[0], log_gammas(gaussians, batch)[0].tolist(), strict=True):
        least, middle, most = sorted(logs, key=abs)
        if abs(least) > _OWN and abs(most) < _UNLIKE * abs(least) and min(logs) * max(logs) > 0:
            tones[name] = math.exp(middle)
    return tones


def without_tones(capture: Capture, tones: Mapping[str, float]) -> Capture:
    """Undo tone curves.

    Args:
        capture: photographs as they are.
        tones: gammas above 0 by camera.

    Returns:
        The capture with these gammas undone; photographs of other cameras stay.
    """
    if not tones:
        return capture
    photographs = (_without(one, tones.get(one.name, 1.0)) for one in capture.photographs)
    return replace(capture, photographs=tuple(photographs))


def _without(photograph: Photograph, gamma: float) -> Photograph:
    levels = np.round(255 * (np.arange(256) / 255) ** (1 / gamma)).astype(np.uint8)
    return replace(photograph, image=levels[photograph.image])
