"""Checks of a batch, its preprocessing (masks from mattes, the subject's frame, padding to whole patches)
with the inverse for predictions, and the inputs of a captured graph.

Shapes and dtypes are checked at once; checks of values are *findings*, tensors that are read from the
device together with the plan's statistics. Shapes of the work after a plan (:mod:`ghgs_lit.method.plan`)
depend on its sizes alone, which on a GPU are shape buckets: every batch of a bucket launches the same
kernels."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool
from torch import Tensor

from ghgs_lit.errors import require
from ghgs_lit.execution.options import ModelOptions
from ghgs_lit.extents import Extent
from ghgs_lit.geometry.frame import Frame
from ghgs_lit.geometry.masks import with_matte
from ghgs_lit.geometry.padding import Padding, pad_to_patches
from ghgs_lit.method.plan import Plan, Sizes
from ghgs_lit.method.plan.patches import KeptPatches
from ghgs_lit.types import Batch, DecodedPixels, Prediction

#: Colours may leave [0, 1] by this much, as resizing does.
_ROUNDING = 1e-3

#: A field, the expectation, and the elements [B] or views [B, V] that violate it.
Finding = tuple[str, str, Tensor]


def findings_of(batch: Batch, patch_size: int) -> list[Finding]:
    """Check a batch without a device-to-host synchronisation; returns a finding per check, violated or
    not.

    Args:
        batch: its targets are not checked.
        patch_size: must divide height and width, in pixels.

    Raises:
        InputError: a shape or a dtype is wrong.
    """
    _check_shapes(batch, patch_size)
    return _findings_of_cameras(batch) + _findings_of_values(batch)


def any_bad(findings: Sequence[Finding]) -> Bool[Tensor, ""]:
    """Whether any expectation is violated."""
    return torch.stack([bad.any() for _, _, bad in findings]).any()


def raise_violation(findings: Sequence[Finding]) -> None:
    """Raise an error for the first violated expectation; reads findings with a device-to-host
    synchronisation.

    Raises:
        InputError: the message names the field, the expectation, and the violating elements or views.
    """
    for name, expected, bad in findings:
        found = f"others at {bad.nonzero().tolist()} (element, view)"
        require(not bool(bad.any()), f"batch.{name}", expected, found)


def _check_shapes(batch: Batch, patch_size: int) -> None:
    """Raise InputError for shapes and dtypes that the stages do not support."""
    images = batch.images
    colored = images.dim() == 5 and images.shape[2] == 3
    require(colored, "batch.images", "[B, V, 3, H, W]", tuple(images.shape))
    b, v, _, height, width = images.shape
    maps = (b, v, height, width)
    fields = [("images", images, images.shape), ("alpha", batch.alpha, maps), ("depths", batch.depths, maps)]
    for name, tensor, shape in (*fields, ("log_gains", batch.log_gains, (b, v, 3))):
        if tensor is not None and not tensor.is_floating_point():
            require(False, f"batch.{name}", "floating-point values", tensor.dtype)
        if tensor is not None and tensor.shape != shape:
            require(False, f"batch.{name}", str(shape), tuple(tensor.shape))
    sides = f"sides divisible by the patch size {patch_size} (or model.pad=multiple)"
    cameras = batch.cameras
    shape = tuple(cameras.intrinsics.shape[:-2])
    size = (cameras.height, cameras.width)
    expectations = (
        (batch.masks.dtype == torch.bool, "masks", "dtype torch.bool", batch.masks.dtype),
        (batch.masks.shape == maps, "masks", str(maps), tuple(batch.masks.shape)),
        (v >= 2, "images", "2 views or more", v),
        (height % patch_size == width % patch_size == 0, "images", sides, (height, width)),
        (shape == (b, v), "cameras", f"cameras of shape {(b, v)}", shape),
        (size == (height, width), "cameras", f"the images' size {(height, width)}", size),
    )
    for fits, name, expected, found in expectations:
        if not fits:
            require(fits, f"batch.{name}", expected, found)


def _findings_of_cameras(batch: Batch) -> list[Finding]:
    """Checks of cameras and masks."""
    findings = []
    for name in ("intrinsics", "extrinsics"):
        matrices = getattr(batch.cameras, name)
        findings.append((f"cameras.{name}", "finite values", ~matrices.isfinite().flatten(2).all(-1)))
    focal = batch.cameras.intrinsics.diagonal(dim1=-2, dim2=-1)[..., :2]
    findings.append(("cameras.intrinsics", "focal lengths above 0", ~(focal > 0).all(-1)))
    findings.append(("masks", "the subject in one view at least", ~batch.masks.flatten(1).any(1)))
    return findings


def _findings_of_values(batch: Batch) -> list[Finding]:
    """Checks of every value of images, mattes, depths and bodies: one NaN in the background would leave no
    Gaussian."""
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
    """Views of ``values`` [B, V, ...] with NaN or a value outside [0, ``highest``], up to rounding."""
    values = values.flatten(2)
    if values.device.type == "cpu":  # aminmax takes twenty times as long there
        low, high = values.amin(-1), values.amax(-1)
    else:
        low, high = values.aminmax(dim=-1)
    # Negated, because comparisons with NaN are false.
    return ~((low >= -_ROUNDING) & (high <= highest + _ROUNDING))


@dataclass(frozen=True)
class Preprocessing:
    """Record of a batch's preprocessing, to invert it in the prediction.

    Attributes:
        dtype: dtype of the original cameras.
        frame: frame of the subjects; None: the world.
        padding: padding of the input views; None: no padding.
    """

    dtype: torch.dtype
    frame: Frame | None
    padding: Padding | None

    def undo(self, prediction: Prediction) -> Prediction:
        """Convert a prediction to the pixels and the world of the original batch, without tokens."""
        prediction = replace(prediction, tokens=None)
        if self.padding is not None:
            prediction = self.padding.cut_prediction(prediction)
        return prediction if self.frame is None else self.frame.leave(prediction, self.dtype)


def preprocess(
    batch: Batch, options: ModelOptions, patch_size: int
) -> tuple[Batch, Preprocessing, list[Finding]]:
    """Preprocess a batch.

    Args:
        batch: in the cameras' world.
        options: options of the preprocessing.
        patch_size: patch size of the encoder in pixels.

    Returns:
        The batch, its preprocessing, and findings about its values, to be read later.

    Raises:
        InputError: a shape or a dtype is wrong.
    """
    findings = findings_of(batch, options.side_multiple(patch_size))
    dtype = batch.cameras.extrinsics.dtype
    batch = with_matte(batch, options.matte)
    frame = Frame.of(batch) if options.frame == "subject" else None
    batch = batch if frame is None else frame.enter(batch)
    padding = pad_to_patches(batch.masks, patch_size) if options.pad == "multiple" else None
    batch = batch if padding is None else padding.pad_batch(batch)
    return batch, Preprocessing(dtype, frame, padding), findings


def strip_targets(batch: Batch) -> Batch:
    """Copy a batch, padded or not, with only the fields that the stages read, and without cached values."""
    bare = replace(
        batch, cameras=replace(batch.cameras), targets=None, body_vertices=None, subjects=(), views=()
    )
    inner = getattr(batch, "photographs", None)
    return bare if inner is None else replace(bare, photographs=strip_targets(inner))


@dataclass(frozen=True)
class Scene:
    """The parts of a batch and its plan that the stages read: tensors, and constants of their bucket."""

    batch: Batch
    shown: Bool[Tensor, "B V h w"]
    kept: Bool[Tensor, "B V h w"] | None
    extents: tuple[Extent, ...]
    shown_extents: tuple[Extent, ...]
    patch_size: int
    pixels: DecodedPixels
    tokens: DecodedPixels
    sizes: Sizes
    has_skew: bool

    @classmethod
    def of(cls, batch: Batch, plan: Plan) -> "Scene":
        """Collect the inputs of the stages; fields that only losses read are left out."""
        kept = None if plan.kept.is_whole else plan.kept.mask
        facts = (plan.patch_size, plan.pixels, plan.tokens, plan.sizes, batch.cameras.has_skew)
        return cls(strip_targets(batch), plan.shown, kept, *plan.bucket_extents(), *facts)

    def read(self) -> tuple[Batch, Plan]:
        """Rebuild the batch and its plan without reading values of tensors."""
        batch = strip_targets(self.batch)
        facts = (self.extents, self.shown_extents, self.patch_size, self.pixels, self.tokens, (), self.sizes)
        device = self.shown.device
        if self.kept is None:
            kept = KeptPatches.whole(self.shown.shape, device)
        else:
            kept = KeptPatches(self.kept, device, size=self.sizes.kept)
        plan = Plan(batch.masks, self.shown, kept, *facts)
        batch.note(plan.extents, lambda: plan.subject.index, self.has_skew)
        return batch, plan
