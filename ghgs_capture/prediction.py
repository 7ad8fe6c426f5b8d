"""Predict the Gaussians of a capture, in the user's world, or of any batch of one subject.

Masks, cameras and tone curves are corrected before, and Gaussians refined after the prediction."""

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
from ghgs_lit.refinement import CameraRefinement, Refinement, pixels_moved
from ghgs_lit.rendering import Renderer
from ghgs_lit.types import Batch, Gaussians, Prediction
from ghgs_lit.weights.checkpoint import read_config
from ghgs_lit.weights.reading import SHIPPED, file_of

#: Log gamma of every channel, relative to the median camera, above which a camera has a different tone
#: curve, and the largest ratio between its channels: effects of light and of wrong depths differ more.
_OWN = 0.1
_UNLIKE = 2.0


@dataclass(frozen=True)
class CapturePrediction:
    """A prediction with the batch that the model saw."""

    #: photographs or crops around the subject, masks and cameras, with any corrections
    batch: Batch
    prediction: Prediction  #: for this batch, in the world and unit of its cameras
    #: pixels by which correcting the cameras moved the subject in each photograph
    moved: tuple[float, ...] = ()
    #: share of the subject that refining masks changed in each crop
    changed: tuple[float, ...] = ()
    #: reasons of ``auto``, by name of the refinement that it chose
    why: dict[str, str] = field(default_factory=dict)
    #: gammas that were undone, by camera
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
    """Predict the Gaussians of a capture, in the user's world.

    Args:
        capture: photographs of one instant with masks and cameras, in any unit of length.
        model: a predictor or its stages in evaluation mode, or a checkpoint (cached for further calls):
            a path, or ``shipped`` for that of this package.
        size: side or (height, width) of the model's input crops in pixels; None: the size of its
            training (checkpoints only).
        refine_cameras: maximum number of rounds that correct the cameras until the photographs agree
            (:class:`ghgs_lit.refinement.CameraRefinement`); 0: none; ``auto``: 4 if silhouettes
            contradict one another.
        refine_masks: pixels of a crop by which outlines of masks may be wrong; mattes are then estimated
            from the photographs (:func:`ghgs_lit.data.matting.refine_matte`). 0: masks are used
            unchanged; ``auto``: 4 if photographs show other outlines.
        refine: optimisation steps of the Gaussians towards the photographs, such as 15; 0: none.
        renderer: renders the comparisons of refinements; None: the default for the device.
        tones: gammas to undo first, by camera; ``auto``: those of cameras that differ from the others
            in a first prediction.

    Returns:
        The prediction with the crops, on the model's device, and the corrections with their reasons.

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
    result = _predict_once(capture if tones == "auto" else without_tones(capture, tones), *keys)
    if tones != "auto":
        return replace(result, tones=dict(tones))
    tones = find_tones(result.batch, result.gaussians)
    if not tones:
        return result
    return replace(_predict_once(without_tones(capture, tones), *keys), tones=tones)


def _predict_once(
    capture: Capture,
    model: Predictor,
    size: tuple[int, int],
    refine_cameras: int | Literal["auto"],
    refine_masks: int | Literal["auto"],
    refine: int,
    renderer: Renderer,
) -> CapturePrediction:
    """:func:`predict` without correction of tone curves."""
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
    """Predict in the subject's frame with any weights, so that a capture may have any unit of length.

    Args:
        model: in evaluation mode.
        batch: photographs, masks and cameras.

    Returns:
        The prediction in the world of the batch's cameras.
    """
    # Models with compat=release do not convert to the subject's frame themselves.
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
    """Predict the Gaussians of a batch of one subject, with optional refinement.

    Args:
        batch: photographs, masks and cameras, on the model's device; targets are kept.
        model: in evaluation mode.
        renderer: renders the comparisons of :class:`ghgs_lit.refinement.CameraRefinement` and
            :class:`ghgs_lit.refinement.Refinement`.
        refine_cameras: maximum number of rounds of ``CameraRefinement``; 0: none.
        refine: steps of ``Refinement``; 0: none.
        forward: predicts a batch without targets; None: ``model``.

    Returns:
        The prediction with the corrected batch.
    """
    forward = forward or model
    moved = ()
    if refine_cameras:
        given = batch
        batch = CameraRefinement(refine_cameras, model, renderer)(batch)
        moved = tuple(pixels_moved(given, batch)[0])
    prediction = forward(replace(batch, targets=None))
    if refine:
        gaussians = Refinement(refine, renderer)(prediction.gaussians, batch)
        prediction = replace(prediction, gaussians=gaussians)
    return CapturePrediction(batch, prediction, moved)


def trained_size(config: Mapping[str, Any]) -> int | tuple[int, int]:
    """Size of the input images that a checkpoint's model was trained with.

    For a coarse-to-fine model, it is the size at which a subject has the height of the coarse round
    (``rounds.height``) if the training images were larger; larger sizes must be requested. For imported
    weights without a data set, it is the size of the encoder's position embedding.

    Args:
        config: configuration of the checkpoint.

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
    """Size of the input crops for a checkpoint's model.

    Warns of sizes larger than in training, which make results worse, not sharper, unless the model
    works from coarse to fine (``rounds.height``).

    Args:
        size: side or (height, width) in pixels; None: the size of the training.
        config: configuration of the checkpoint.
        model: model of the checkpoint.

    Returns:
        (height, width) in pixels.

    Raises:
        InputError: a side is not divisible by the model's patch size.
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


def find_tones(batch: Batch, gaussians: Gaussians) -> dict[str, float]:
    """Find cameras with a different tone curve from the others.

    Needs three cameras: with two it is undecidable which one differs.

    Args:
        batch: photographs of one subject.
        gaussians: predicted from the batch.

    Returns:
        The approximate gammas of these cameras, by name.
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
    """Undo tone curves of photographs.

    Args:
        capture: photographs with their tone curves.
        tones: gammas above 0 by camera; photographs of other cameras are unchanged.
    """
    if not tones:
        return capture
    photographs = (_undo_gamma(one, tones.get(one.name, 1.0)) for one in capture.photographs)
    return replace(capture, photographs=tuple(photographs))


def _undo_gamma(photograph: Photograph, gamma: float) -> Photograph:
    levels = np.round(255 * (np.arange(256) / 255) ** (1 / gamma)).astype(np.uint8)
    return replace(photograph, image=levels[photograph.image])
