"""What the model refuses to work on, in one line that names the field."""

import torch
from torch import Tensor

from ghgs_lit.errors import require
from ghgs_lit.types import Batch

#: How far resizing may take colours out of [0, 1].
_ROUNDING = 1e-3

#: A field, what was expected of it, and which elements [B] or views [B, V] are not so.
Finding = tuple[str, str, Tensor]


def check_batch(batch: Batch, patch_size: int, values: bool = True) -> None:
    """Refuse a batch that the stages cannot work on.

    Values are looked at together, so that the host waits for a GPU once. InputError: names the field, what
    was expected and what was found, and where.

    Args:
        batch: the inputs; targets are not looked at.
        patch_size: must divide height and width, in pixels.
        values: look also at every value, which would spread through every view: one NaN in the background
            leaves no Gaussian.
    """
    _check_shapes(batch, patch_size)
    findings = _findings_of_cameras(batch) + (_findings_of_values(batch) if values else [])
    if bool(torch.stack([bad.any() for _, _, bad in findings]).any()):
        for name, expected, bad in findings:
            found = f"others at {bad.nonzero().tolist()} (element, view)"
            require(not bool(bad.any()), f"batch.{name}", expected, found)


def _check_shapes(batch: Batch, patch_size: int) -> None:
    require(batch.images.dim() == 5, "batch.images", "[B, V, 3, H, W]", tuple(batch.images.shape))
    for name, tensor in (("images", batch.images), ("depths", batch.depths), ("alpha", batch.alpha)):
        floating = tensor is None or tensor.is_floating_point()
        require(floating, f"batch.{name}", "floating-point values", tensor is not None and tensor.dtype)
    require(batch.masks.dtype == torch.bool, "batch.masks", "dtype torch.bool", batch.masks.dtype)
    b, v, _, height, width = batch.images.shape
    require(v >= 2, "batch.images", "2 views or more", v)
    divisible = height % patch_size == width % patch_size == 0
    expected = f"sides divisible by the patch size {patch_size} (or model.pad=multiple)"
    require(divisible, "batch.images", expected, (height, width))
    for name in ("masks", "alpha"):
        maps, expected = getattr(batch, name), (b, v, height, width)
        fits = maps is None or maps.shape == expected
        require(fits, f"batch.{name}", str(expected), maps is not None and tuple(maps.shape))
    cameras = batch.cameras
    require(cameras.shape == (b, v), "batch.cameras", f"cameras of shape {(b, v)}", tuple(cameras.shape))
    size = (cameras.height, cameras.width)
    require(size == (height, width), "batch.cameras", f"the images' size {(height, width)}", size)


def _findings_of_cameras(batch: Batch) -> list[Finding]:
    found = [
        (f"cameras.{name}", "finite values", ~getattr(batch.cameras, name).isfinite().flatten(2).all(-1))
        for name in ("intrinsics", "extrinsics")
    ]
    focal = batch.cameras.intrinsics.diagonal(dim1=-2, dim2=-1)[..., :2]
    found.append(("cameras.intrinsics", "focal lengths above 0", ~(focal > 0).all(-1)))
    found.append(("masks", "the subject in one view at least", ~batch.masks.flatten(1).any(1)))
    return found


def _findings_of_values(batch: Batch) -> list[Finding]:
    within = "finite values within [0, 1]"
    found = [("images", within, _beyond(batch.images, 1.0))]
    if batch.alpha is not None:
        found.append(("alpha", within, _beyond(batch.alpha, 1.0)))
    if batch.depths is not None:
        expected = "finite depths of 0 or more metres"
        found.append(("depths", expected, _beyond(batch.depths, torch.finfo().max)))
    if batch.body_vertices:
        infinite = torch.stack([~vertices.isfinite().all() for vertices in batch.body_vertices])
        found.append(("body_vertices", "finite coordinates", infinite))
    return found


def _beyond(values: Tensor, highest: float) -> Tensor:
    """Which views of values [B, V, ...] have one outside 0 to ``highest``, up to rounding, or NaN."""
    low, high = values.flatten(2).aminmax(dim=-1)
    # Written so that NaN, which both of them repeat, is not within.
    return ~((low >= -_ROUNDING) & (high <= highest + _ROUNDING))
