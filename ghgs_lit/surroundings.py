"""What surrounds the stages: layers that a batch enters before them and its prediction
leaves after them.

:func:`surroundings` gives the layers of a batch, the outermost first: photographs are checked and
masks follow mattes (:class:`CheckedPhotographs`); the world becomes metres around the subject
(:class:`SubjectFrame`); photographs get a black border up to whole patches (:class:`Border`). The
prediction goes through them in reverse: the border is cut off, and Gaussians, depths and points are
brought back to the cameras' world. :class:`ModelOptions` (``conf/model``) choose the layers. Checks
of values are findings, which :meth:`ghgs_lit.method.model.GHGS.plan` reads together with all else that a
GPU must be waited for."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool
from pydantic import Field
from torch import Tensor

from ghgs_lit.config.options import Options, Text
from ghgs_lit.errors import require
from ghgs_lit.geometry.frame import Frame
from ghgs_lit.geometry.masks import with_matte
from ghgs_lit.geometry.padding import Padding, pad_to_patches
from ghgs_lit.types import Batch, Prediction

#: Colours may leave [0, 1] by this much, as resizing does.
_ROUNDING = 1e-3

#: A field, what was expected of it, and which elements [B] or views [B, V] violate it.
Finding = tuple[str, str, Tensor]


def findings_of(batch: Batch, patch_size: int, values: bool = True) -> list[Finding]:
    """What is expected of a batch's values, and where they violate it, without waiting for a GPU.

    Args:
        batch: its targets are not checked.
        patch_size: must divide height and width, in pixels.
        values: check every value, too: one NaN in the background leaves no Gaussian.

    Returns:
        A finding for each check, violated or not.

    Raises:
        InputError: a shape or a dtype is wrong.
    """
    _check_shapes(batch, patch_size)
    return _findings_of_cameras(batch) + (_findings_of_values(batch) if values else [])


def any_bad(findings: Sequence[Finding]) -> Bool[Tensor, ""]:
    """Whether anything is violated."""
    return torch.stack([bad.any() for _, _, bad in findings]).any()


def refuse(findings: Sequence[Finding]) -> None:
    """Refuse a batch for the first field that violates what is expected of it, if any does.

    Args:
        findings: of the batch; a GPU is waited for.

    Raises:
        InputError: names the field, what was expected of it, and where it is violated.
    """
    for name, expected, bad in findings:
        found = f"others at {bad.nonzero().tolist()} (element, view)"
        require(not bool(bad.any()), f"batch.{name}", expected, found)


def _check_shapes(batch: Batch, patch_size: int) -> None:
    """InputError: a shape or a dtype of the batch is not what the stages work on."""
    colored = batch.images.dim() == 5 and batch.images.shape[2] == 3
    require(colored, "batch.images", "[B, V, 3, H, W]", tuple(batch.images.shape))
    for name in ("images", "depths", "alpha", "log_gains"):
        tensor = getattr(batch, name)
        floating = tensor is None or tensor.is_floating_point()
        require(floating, f"batch.{name}", "floating-point values", tensor is not None and tensor.dtype)
    require(batch.masks.dtype == torch.bool, "batch.masks", "dtype torch.bool", batch.masks.dtype)
    b, v, _, height, width = batch.images.shape
    require(v >= 2, "batch.images", "2 views or more", v)
    divisible = height % patch_size == width % patch_size == 0
    expected = f"sides divisible by the patch size {patch_size} (or model.pad=multiple)"
    require(divisible, "batch.images", expected, (height, width))
    shapes = dict.fromkeys(("masks", "alpha", "depths"), (b, v, height, width)) | {"log_gains": (b, v, 3)}
    for name, shape in shapes.items():
        tensor = getattr(batch, name)
        fits = tensor is None or tensor.shape == shape
        require(fits, f"batch.{name}", str(shape), tensor is not None and tuple(tensor.shape))
    cameras = batch.cameras
    require(cameras.shape == (b, v), "batch.cameras", f"cameras of shape {(b, v)}", tuple(cameras.shape))
    size = (cameras.height, cameras.width)
    require(size == (height, width), "batch.cameras", f"the images' size {(height, width)}", size)


def _findings_of_cameras(batch: Batch) -> list[Finding]:
    """Checks of cameras and masks, which are always made."""
    findings = [
        (f"cameras.{name}", "finite values", ~getattr(batch.cameras, name).isfinite().flatten(2).all(-1))
        for name in ("intrinsics", "extrinsics")
    ]
    focal = batch.cameras.intrinsics.diagonal(dim1=-2, dim2=-1)[..., :2]
    findings.append(("cameras.intrinsics", "focal lengths above 0", ~(focal > 0).all(-1)))
    findings.append(("masks", "the subject in one view at least", ~batch.masks.flatten(1).any(1)))
    return findings


def _findings_of_values(batch: Batch) -> list[Finding]:
    """Checks of every value of photographs, mattes, depths and bodies."""
    within = "finite values within [0, 1]"
    findings = [("images", within, _beyond(batch.images, 1.0))]
    if batch.alpha is not None:
        findings.append(("alpha", within, _beyond(batch.alpha, 1.0)))
    if batch.depths is not None:
        expected = "finite depths of 0 or more metres"
        findings.append(("depths", expected, _beyond(batch.depths, torch.finfo().max)))
    if batch.body_vertices:
        infinite = torch.stack([~vertices.isfinite().all() for vertices in batch.body_vertices])
        findings.append(("body_vertices", "finite coordinates", infinite))
    return findings


def _beyond(values: Tensor, highest: float) -> Tensor:
    """Views of ``values`` [B, V, ...] with a NaN or a value outside 0 to ``highest``,
    up to rounding."""
    values = values.flatten(2)
    if values.device.type == "cpu":  # where aminmax takes twenty times as long
        low, high = values.amin(-1), values.amax(-1)
    else:
        low, high = values.aminmax(dim=-1)
    # Negated, because comparisons with NaN are false.
    return ~((low >= -_ROUNDING) & (high <= highest + _ROUNDING))


class ModelOptions(Options):
    """Preparation of photographs before the stages, and of predictions after them."""

    group = "model"
    name: Text = "paper"
    """Name of the combination of stages, for tables."""
    pad: Literal["none", "multiple"] = "none"
    """multiple: photographs get a black border up to the next multiple of the patch size, which is
    cut off again; none: their sides must be multiples."""
    frame: Literal["subject", "world"] = "subject"
    """subject: the stages work in metres around the subject, whatever the world's unit, origin and
    axes; world: in coordinates as they are given."""
    matte: float | None = Field(None, ge=0, le=0.5)
    """Pixels that show a larger share of the subject become Gaussians, whose colours and opacities
    know that share; null: masks decide, mattes are ignored."""
    capture: Literal["auto", "off"] = "auto"
    """auto: on CUDA, predictions and training steps of scenes of one size class are recorded as
    CUDA graphs and played back; off: every operator is called each time."""


class Surrounding:
    """A layer around the stages for one batch; :meth:`leave` may use what :meth:`enter` found.

    Attributes:
        findings: what :meth:`enter` expects of values, to be read later.
    """

    findings: Sequence[Finding] = ()

    def enter(self, batch: Batch) -> Batch:
        """The batch for the inner layers."""
        return batch

    def leave(self, prediction: Prediction) -> Prediction:
        """The prediction of the inner layers for the outer ones."""
        return prediction


def entered(
    options: ModelOptions, patch_size: int, checks_values: bool, batch: Batch
) -> tuple[Sequence[Surrounding], Batch, list[Finding]]:
    """The batch inside of all layers.

    Args:
        options: as of :func:`surroundings`.
        patch_size: as of :func:`surroundings`.
        checks_values: as of :func:`surroundings`.
        batch: outside of all layers.

    Returns:
        The layers, the outermost first; the batch; what is expected of values, to be read later.

    Raises:
        InputError: a shape or a dtype is wrong.
    """
    around = surroundings(options, patch_size, checks_values)
    findings: list[Finding] = []
    for layer in around:
        batch = layer.enter(batch)
        findings += layer.findings
        layer.findings = ()
    return around, batch, findings


def left(around: Sequence[Surrounding], prediction: Prediction) -> Prediction:
    """The prediction outside of all layers.

    Args:
        around: the layers, the outermost first.
        prediction: of the stages.
    """
    for layer in reversed(around):
        prediction = layer.leave(prediction)
    return prediction


@dataclass
class CheckedPhotographs(Surrounding):
    """Photographs to be checked; masks are thresholds of soft mattes, if any.

    Args:
        side_multiple: number of pixels that must divide height and width.
        checks_values: check every value, too.
        least_matte: pixels that show a larger share of the subject are its mask, 0 to 0.5;
            None: masks stay.
    """

    side_multiple: int
    checks_values: bool
    least_matte: float | None

    def enter(self, batch: Batch) -> Batch:
        self.findings = findings_of(batch, self.side_multiple, self.checks_values)
        return with_matte(batch, self.least_matte)


@dataclass
class SubjectFrame(Surrounding):
    """Metres around the subject inside, the cameras' world outside
    (:mod:`ghgs_lit.geometry.frame`).

    Attributes:
        frame: of the batch that entered.
        dtype: of its cameras.
    """

    frame: Frame | None = None
    dtype: torch.dtype | None = None

    def enter(self, batch: Batch) -> Batch:
        self.frame = Frame.of(batch)
        self.dtype = batch.cameras.extrinsics.dtype
        return self.frame.enter(batch)

    def leave(self, prediction: Prediction) -> Prediction:
        return self.frame.leave(prediction, self.dtype)


@dataclass
class Border(Surrounding):
    """Photographs padded to whole patches inside (:mod:`ghgs_lit.geometry.padding`).

    Args:
        patch_size: of the encoder, in pixels.
    """

    patch_size: int
    padding: Padding | None = None

    def enter(self, batch: Batch) -> Batch:
        self.padding = pad_to_patches(batch.masks, self.patch_size)
        return batch if self.padding is None else self.padding.pad_batch(batch)

    def leave(self, prediction: Prediction) -> Prediction:
        return prediction if self.padding is None else self.padding.cut_prediction(prediction)


def side_multiple(options: ModelOptions, patch_size: int) -> int:
    """The number of pixels that must divide height and width of photographs.

    Args:
        options: with a border, any size will do.
        patch_size: of the encoder, in pixels.
    """
    return 1 if options.pad == "multiple" else patch_size


def surroundings(options: ModelOptions, patch_size: int, checks_values: bool) -> Sequence[Surrounding]:
    """The layers around the stages for one batch, the outermost first.

    Args:
        options: choose the layers.
        patch_size: of the encoder, in pixels.
        checks_values: refuse NaN and values out of range, too.
    """
    return [
        CheckedPhotographs(side_multiple(options, patch_size), checks_values, options.matte),
        *([SubjectFrame()] if options.frame == "subject" else []),
        *([Border(patch_size)] if options.pad == "multiple" else []),
    ]
