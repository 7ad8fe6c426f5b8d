"""Checks of a batch. Shapes and dtypes are checked at once; checks of values are *findings*, which are
read from a device together with all else that a plan needs of it."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool
from torch import Tensor

from ghgs_lit.errors import require
from ghgs_lit.types import Batch

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
