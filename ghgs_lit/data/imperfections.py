"""Imperfections of captures: exposure and colour of single cameras, masks, calibration, cut subjects.

The count of random numbers that a function samples does not depend on its limits.
"""

import dataclasses
import math

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghgs_lit.errors import require
from ghgs_lit.extents import extents
from ghgs_lit.geometry.masks import signed_distance, unmultiply
from ghgs_lit.geometry.projection import look_at_point, project, unproject
from ghgs_lit.geometry.rotations import (
    apply_motions,
    motions_between,
    quaternion_to_matrix,
    remove_common_motion,
)
from ghgs_lit.types import Batch, Cameras

# Stored colours are linear light to the power 1/2.2.
_GAMMA = 2.2
# Width of the bumps of a ragged outline in pixels.
_BUMP = 6
# Patches of backgrounds: number along a side, and maximum deviation of their colours.
_PATCHES = ((3, 0.35), (12, 0.15), (40, 0.06))
_NOISE = 0.02  # standard deviation of single pixels


def sample_color_gains(
    views: int, exposure: float, white_balance: float, rng: np.random.Generator
) -> Float[np.ndarray, "V 3"]:
    """Sample factors of stored colours with a geometric mean of 1 over cameras, as images show only
    differences between cameras.

    Args:
        views: number of cameras V.
        exposure: maximum deviation of a camera in stops, at least 0.
        white_balance: maximum deviation of red and of blue from green in stops, at least 0.

    Returns:
        Factors [V, 3] above 0.
    """
    deviation = rng.uniform(-1, 1, (views, 3))
    deviation -= deviation.mean(0)
    deviation /= np.maximum(1, np.abs(deviation).max(0))
    red, green, blue = (deviation * (white_balance, exposure, white_balance)).T
    return 2 ** (np.stack((green + red, green, green + blue), -1) / _GAMMA)


def sample_tone_powers(views: int, gamma: float, rng: np.random.Generator) -> Float[np.ndarray, " V"]:
    """Sample powers of stored colours with a geometric mean of 1 over cameras.

    Args:
        views: number of cameras V.
        gamma: maximum absolute natural logarithm of a power, at least 0.
    """
    deviation = rng.uniform(-1, 1, views)
    deviation -= deviation.mean()
    return np.exp(gamma * deviation / max(1, np.abs(deviation).max()))


def change_tones(
    images: Float[Tensor, "B V 3 h w"], alpha: Float[Tensor, "B V h w"] | None, powers: Float[Tensor, "B V"]
) -> Float[Tensor, "B V 3 h w"]:
    """Raise the colours of each view to a power, without their multiplication by mattes.

    Args:
        images: colours in [0, 1], premultiplied by ``alpha`` if given.
        alpha: mattes in [0, 1]; None: pixels show either the subject or black.
        powers: powers above 0.
    """
    powers = powers[..., None, None, None]
    if alpha is None:
        return images**powers
    shares = alpha[:, :, None]
    return unmultiply(images, shares) ** powers * shares


def perturb_mask(
    mask: Bool[np.ndarray, "h w"],
    offset: float,
    ragged: float,
    hole: float,
    hole_chance: float,
    rng: np.random.Generator,
) -> Bool[np.ndarray, "h w"]:
    """Add the errors of a segmentation to a mask; it stays unchanged if it would become empty.

    Args:
        mask: [h, w], true on the subject.
        offset: maximum growth or shrinkage in pixels, at least 0.
        ragged: maximum height of bumps of the outline in pixels, at least 0.
        hole: maximum diameter of a missing round piece, as a fraction of the subject's height.
        hole_chance: probability of a missing piece, in [0, 1].
    """
    grow, height, missing, size, place = rng.uniform(size=5)
    bumps = rng.uniform(-1, 1, [side // _BUMP + 2 for side in mask.shape])
    if not mask.any():
        return mask
    rows, columns = np.nonzero(mask)
    result = mask.copy()
    if offset or ragged:
        margin = math.ceil(offset + ragged) + 1
        window = tuple(
            slice(max(0, lines.min() - margin), lines.max() + 1 + margin) for lines in (rows, columns)
        )
        part = mask[window]
        sides = [_BUMP * side for side in bumps.shape]
        noise = _stretch(torch.from_numpy(bumps), *sides).numpy()
        noise = noise[: mask.shape[0], : mask.shape[1]][window]
        result[window] = signed_distance(part) + (2 * grow - 1) * offset + height * ragged * noise > 0
    if missing < hole_chance:
        middle = int(place * len(rows))
        radius = size * hole * (rows.max() - rows.min() + 1) / 2
        v, u = np.ogrid[: mask.shape[0], : mask.shape[1]]
        result &= (v - rows[middle]) ** 2 + (u - columns[middle]) ** 2 >= radius**2
    return result if result.any() else mask


def sample_backgrounds(
    views: int, height: int, width: int, rng: np.random.Generator
) -> Float[np.ndarray, "V 3 h w"]:
    """Sample a background for each camera: cloudy patterns of large and small patches.

    Args:
        views: number of cameras V.

    Returns:
        Colours [V, 3, h, w] float32 in [0, 1].
    """
    base = torch.from_numpy(0.5 + rng.uniform(-0.2, 0.2, (views, 3, 1, 1)))
    noise = torch.from_numpy(rng.standard_normal((views, 3, height, width)))
    colors = noise.float().mul_(_NOISE).add_(base.float())
    for cells, deviation in _PATCHES:
        patches = torch.from_numpy(rng.uniform(-deviation, deviation, (views, 3, cells, cells)))
        colors += _stretch(patches.float(), height, width)
    return colors.clamp_(0, 1).numpy()


def _stretch(patches: Float[Tensor, "*batch m n"], height: int, width: int) -> Float[Tensor, "*batch h w"]:
    """Interpolate patches bilinearly, with the centres of outer patches at the centres of outer pixels."""
    channels = patches.reshape(1, -1, *patches.shape[-2:])
    pixels = F.interpolate(channels, (height, width), mode="bilinear", align_corners=True)
    return pixels.reshape(*patches.shape[:-2], height, width)


def perturb_cameras(
    cameras: Cameras, masks: Bool[Tensor, "V H W"], pixels: float, rng: np.random.Generator
) -> Cameras:
    """Add calibration errors to cameras: a rotation, a translation across the axis, and a change of the
    focal length.

    A camera's error, at most ``pixels``, is the root mean square motion of the corners of its mask's
    box (of the image for an empty mask) at the subject's distance. The common error of all cameras is
    removed, because images show only differences between cameras.

    Args:
        cameras: true cameras [V].
        pixels: maximum error in pixels, above 0.

    Returns:
        Cameras [V] of the same sizes and dtypes.

    Raises:
        InputError: the point that the cameras look at is not in front of all of them.
    """
    count = len(masks)
    directions = torch.from_numpy(rng.standard_normal((count, 6)))
    wanted = pixels * torch.from_numpy(rng.uniform(size=count))
    lenses = cameras.intrinsics.double()
    poses = cameras.extrinsics.double()
    distances = (poses[:, 2, :3] * look_at_point(cameras)).sum(-1) + poses[:, 2, 3]
    expected = "cameras that look at the subject"
    require(bool((distances > 0).all()), "augmentation.calibration", expected, distances.tolist())
    corners = _corners(masks)

    def perturb(errors: Tensor) -> tuple[Tensor, Tensor]:
        """Intrinsics and extrinsics with errors [V, 6], which are approximately in pixels."""
        focal = lenses[:, 1, 1]
        half = max(cameras.height, cameras.width) / 2
        turn = errors[:, :3] / 2 / torch.stack((focal, focal, torch.full_like(focal, half)), -1)
        rotation = quaternion_to_matrix(torch.cat((torch.ones(count, 1, dtype=turn.dtype), turn), -1))
        pose = poses.clone()
        lens = lenses.clone()
        pose[:, :3] = rotation @ poses[:, :3]
        pose[:, :2, 3] += errors[:, 3:5] * (distances / focal)[:, None]
        lens[:, [0, 1], [0, 1]] *= 1 + errors[:, 5:] / half
        return lens, pose

    points = unproject(
        corners, distances[:, None].expand(-1, 4), _repeat_for_corners(lenses), _repeat_for_corners(poses)
    )

    # Far from the world's origin these differ from ``corners`` by rounding.
    true = project(points, _repeat_for_corners(lenses), _repeat_for_corners(poses))[0]

    def measure_error(lens: Tensor, pose: Tensor) -> Tensor:
        moved = project(points, _repeat_for_corners(lens), _repeat_for_corners(pose))[0]
        return (moved - true).square().sum(-1).mean(-1).sqrt()

    errors = wanted[:, None] * directions / directions.norm(dim=-1, keepdim=True)
    for _ in range(3):  # converges fast, as the size is nearly proportional to the errors
        errors = errors * (wanted / measure_error(*perturb(errors)))[:, None]
    lens, pose = _remove_common_error(cameras, *perturb(errors))
    largest = measure_error(lens, pose).amax()
    if largest > pixels:
        lens, pose = _remove_common_error(cameras, *perturb(errors * (pixels / largest)))
    return Cameras(lens.to(cameras.intrinsics), pose.to(cameras.extrinsics), cameras.height, cameras.width)


def _corners(masks: Bool[Tensor, "V H W"]) -> Float[Tensor, "V 4 2"]:
    """Corners of the boxes around masks in pixels; those of the image for an empty mask."""
    masks = torch.where(masks.any((1, 2), keepdim=True), masks, True)
    boxes = [([one.left, one.right], [one.top, one.bottom]) for one in extents(masks)]
    return torch.stack([torch.cartesian_prod(*map(torch.tensor, box)) for box in boxes]).double()


def _repeat_for_corners(matrices: Float[Tensor, "V n m"]) -> Float[Tensor, "V 4 n m"]:
    return matrices[:, None].expand(-1, 4, -1, -1)


def _remove_common_error(
    cameras: Cameras, lens: Float[Tensor, "V 3 3"], pose: Float[Tensor, "V 4 4"]
) -> tuple[Float[Tensor, "V 3 3"], Float[Tensor, "V 4 4"]]:
    """Remove the common part of the errors of cameras; returns float64 intrinsics and extrinsics."""
    true = cameras.extrinsics.double()
    middle = look_at_point(cameras).double()
    motions = remove_common_motion(motions_between(true, pose, middle), true[:, 2, :3])
    both = [0, 1]
    zoom = lens[:, both, both] / cameras.intrinsics.double()[:, both, both]
    lens = lens.clone()
    lens[:, both, both] /= zoom.mean(0)
    return lens, apply_motions(true, motions, middle)


#: Minimum and maximum share of a cut subject's height that remains: down to the waist or the ankles.
_SHOWN = 0.45, 0.95


def cut_subjects(batch: Batch, chance: float, rngs: list[np.random.Generator]) -> Batch:
    """Cut a share of the subjects by the frame's lower edge.

    Half of them are cut in all inputs and targets at about the same height, so that no target shows
    legs that no input shows; the others in some inputs, at different heights. Images move down in their
    frames, and principal points move with them.

    Args:
        batch: a batch with at least two views.
        chance: share of the subjects that are cut, in [0, 1].
        rngs: random generator of each element.
    """
    views = batch.masks.shape[1]
    shares = np.ones(batch.masks.shape[:2])
    ends = np.ones(len(rngs))
    for b, rng in enumerate(rngs):
        is_cut, everywhere, height, *others = rng.uniform(size=3 + 2 * views)
        chosen, heights = np.reshape(others, (2, views))
        low, high = _SHOWN
        if is_cut >= chance:
            continue
        if everywhere < 0.5:
            shares[b] = ends[b] = low + (high - low) * height
        else:
            some = (chosen < 0.5) | (chosen == chosen.min())
            some[chosen.argmax()] = False  # at least one stays whole
            shares[b, some] = (low + (high - low) * heights)[some]
    rows = _rows_down(batch.masks, shares)
    maps = {name: _move_down(getattr(batch, name), rows) for name in ("images", "masks", "depths", "alpha")}
    targets = batch.targets
    if targets is not None:
        lower = _rows_down(targets.masks, np.broadcast_to(ends[:, None], targets.masks.shape[:2]))
        moved = {name: _move_down(getattr(targets, name), lower) for name in ("images", "masks")}
        cameras = _move_centers(targets.cameras, lower)
        targets = dataclasses.replace(targets, **moved, cameras=cameras)
    return dataclasses.replace(batch, **maps, cameras=_move_centers(batch.cameras, rows), targets=targets)


def _rows_down(masks: Bool[Tensor, "B V H W"], shares: Float[np.ndarray, "B V"]) -> Int[Tensor, "B V"]:
    """Rows by which images move down so that the given share of the mask's height remains."""
    moved = []
    for seen, share in zip(extents(masks.flatten(0, 1)), shares.flatten(), strict=True):
        end = math.ceil(seen.top + share * (seen.bottom - seen.top))
        moved.append(masks.shape[2] - end if seen.count and share < 1 else 0)
    return torch.tensor(moved).reshape(shares.shape)


def _move_down(maps: Tensor | None, rows: Int[Tensor, "B V"]) -> Tensor | None:
    """Move each of ``maps`` [B, V, ..., H, W] down by its number of rows, with zeros above."""
    if maps is None:
        return None
    moved = torch.zeros_like(maps)
    for old, new, down in zip(maps.flatten(0, 1), moved.flatten(0, 1), rows.flatten().tolist(), strict=True):
        new[..., down:, :] = old[..., : maps.shape[-2] - down, :]
    return moved


def _move_centers(cameras: Cameras, rows: Int[Tensor, "B V"]) -> Cameras:
    intrinsics = cameras.intrinsics.clone()
    intrinsics[..., 1, 2] += rows.to(intrinsics)
    return dataclasses.replace(cameras, intrinsics=intrinsics)
