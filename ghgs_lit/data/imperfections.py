"""Imperfections of captures: exposure and colour of single cameras, masks, calibration,
cut subjects.

The number of random numbers that a function draws does not depend on its limits.
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
from ghgs_lit.geometry.masks import signed_distance, unmultiplied
from ghgs_lit.geometry.projection import look_at_point, project, unproject
from ghgs_lit.geometry.rotations import after_motions, motions_between, quaternion_to_matrix, without_common
from ghgs_lit.types import Batch, Cameras

# Stored colours are light to the power 1/2.2.
_GAMMA = 2.2
# Width of the bumps of a ragged outline in pixels.
_BUMP = 6
# Patches of backgrounds: number along a side and deviation of colours; noise of single pixels.
_PATCHES = ((3, 0.35), (12, 0.15), (40, 0.06))
_NOISE = 0.02


def draw_color_gains(
    views: int, exposure: float, white_balance: float, rng: np.random.Generator
) -> Float[np.ndarray, "V 3"]:
    """Random factors of stored colours, geometric mean 1 over cameras:
    photographs show only differences.

    Args:
        views: number of cameras V.
        exposure: greatest deviation of a camera in stops, at least 0.
        white_balance: greatest deviation of red and of blue from green in stops, at least 0.
        rng: source of the deviations.

    Returns:
        Factors [V, 3] above 0.
    """
    deviation = rng.uniform(-1, 1, (views, 3))
    deviation -= deviation.mean(0)
    deviation /= np.maximum(1, np.abs(deviation).max(0))
    red, green, blue = (deviation * (white_balance, exposure, white_balance)).T
    return 2 ** (np.stack((green + red, green, green + blue), -1) / _GAMMA)


def draw_tone_powers(views: int, gamma: float, rng: np.random.Generator) -> Float[np.ndarray, " V"]:
    """Random powers of stored colours, geometric mean 1 over cameras.

    Args:
        views: number of cameras V.
        gamma: greatest natural logarithm of a power, at least 0.
        rng: source of the deviations.
    """
    deviation = rng.uniform(-1, 1, views)
    deviation -= deviation.mean()
    return np.exp(gamma * deviation / max(1, np.abs(deviation).max()))


def change_tones(
    images: Float[Tensor, "B V 3 h w"], alpha: Float[Tensor, "B V h w"] | None, powers: Float[Tensor, "B V"]
) -> Float[Tensor, "B V 3 h w"]:
    """Raise the colours of each view to a power; multiplication by mattes is undone before.

    Args:
        images: in [0, 1], multiplied by ``alpha`` if there is one.
        alpha: mattes in [0, 1]; None: pixels are of the subject or black.
        powers: above 0.
    """
    powers = powers[..., None, None, None]
    if alpha is None:
        return images**powers
    shares = alpha[:, :, None]
    return unmultiplied(images, shares) ** powers * shares


def perturb_mask(
    mask: Bool[np.ndarray, "h w"],
    offset: float,
    ragged: float,
    hole: float,
    hole_chance: float,
    rng: np.random.Generator,
) -> Bool[np.ndarray, "h w"]:
    """Mask with the errors of a segmentation; unchanged if nothing would be left of it.

    Args:
        mask: [h, w] bool, true on the subject.
        offset: greatest growth or shrinkage in pixels, at least 0.
        ragged: greatest height of bumps of the outline in pixels, at least 0.
        hole: greatest diameter of a missing round piece, over the subject's height.
        hole_chance: probability of a missing piece, in [0, 1].
        rng: source of the errors; as many numbers are sampled for all limits.

    Returns:
        Mask [h, w] bool.
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


def draw_backgrounds(
    views: int, height: int, width: int, rng: np.random.Generator
) -> Float[np.ndarray, "V 3 h w"]:
    """Random background for each camera: cloudy patterns of large and small patches.

    Args:
        views: number of cameras V.
        height: rows h of a photograph.
        width: columns w of a photograph.
        rng: source of the patterns.

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
    """Patches interpolated linearly, the middles of the outer ones at the middles of the
    outer pixels."""
    channels = patches.reshape(1, -1, *patches.shape[-2:])
    pixels = F.interpolate(channels, (height, width), mode="bilinear", align_corners=True)
    return pixels.reshape(*patches.shape[:-2], height, width)


def perturb_cameras(
    cameras: Cameras, masks: Bool[Tensor, "V H W"], pixels: float, rng: np.random.Generator
) -> Cameras:
    """Cameras with errors: each is rotated, moved across its axis, and has another focal length.

    A camera's error, at most ``pixels``, is the motion of the corners of its mask's box (the
    photograph's for an empty mask) at the subject's distance, root mean square. The common error of
    all cameras is removed, because photographs show only differences between cameras.

    Args:
        cameras: true cameras [V].
        masks: masks of the subject [V, H, W].
        pixels: greatest error in pixels, above 0.
        rng: source of the errors.

    Returns:
        Cameras [V] of the same sizes and dtypes.

    Raises:
        InputError: the point that the cameras look at is not before all of them.
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

    def moved(errors: Tensor) -> tuple[Tensor, Tensor]:
        """Intrinsics and extrinsics after errors [V, 6], each about in pixels."""
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

    points = unproject(corners, distances[:, None].expand(-1, 4), _for_corners(lenses), _for_corners(poses))

    def seen(lens: Tensor, pose: Tensor) -> Tensor:
        """Pixels of the corners, which far from the world's origin differ from ``corners``
        by rounding."""
        return project(points, _for_corners(lens), _for_corners(pose))[0]

    def size(lens: Tensor, pose: Tensor) -> Tensor:
        return (seen(lens, pose) - seen(lenses, poses)).square().sum(-1).mean(-1).sqrt()

    errors = wanted[:, None] * directions / directions.norm(dim=-1, keepdim=True)
    for _ in range(3):  # the size is nearly proportional to the errors
        errors = errors * (wanted / size(*moved(errors)))[:, None]
    lens, pose = _remove_common_error(cameras, *moved(errors))
    largest = size(lens, pose).amax()
    if largest > pixels:
        lens, pose = _remove_common_error(cameras, *moved(errors * (pixels / largest)))
    return Cameras(lens.to(cameras.intrinsics), pose.to(cameras.extrinsics), cameras.height, cameras.width)


def _corners(masks: Bool[Tensor, "V H W"]) -> Float[Tensor, "V 4 2"]:
    """Corners of the boxes around masks, in pixels; those of the photograph for an empty mask."""
    masks = torch.where(masks.any((1, 2), keepdim=True), masks, True)
    corners = []
    for mask in masks:
        columns = mask.any(0).nonzero()[[0, -1], 0] + torch.tensor([0, 1])
        rows = mask.any(1).nonzero()[[0, -1], 0] + torch.tensor([0, 1])
        corners.append(torch.cartesian_prod(columns, rows))
    return torch.stack(corners).double()


def _for_corners(matrices: Float[Tensor, "V n m"]) -> Float[Tensor, "V 4 n m"]:
    return matrices[:, None].expand(-1, 4, -1, -1)


def _remove_common_error(
    cameras: Cameras, lens: Float[Tensor, "V 3 3"], pose: Float[Tensor, "V 4 4"]
) -> tuple[Float[Tensor, "V 3 3"], Float[Tensor, "V 4 4"]]:
    """Float64 intrinsics and extrinsics without the common part of their differences from true cameras."""
    true = cameras.extrinsics.double()
    middle = look_at_point(cameras).double()
    motions = without_common(motions_between(true, pose, middle), true[:, 2, :3])
    both = [0, 1]
    zoom = lens[:, both, both] / cameras.intrinsics.double()[:, both, both]
    lens = lens.clone()
    lens[:, both, both] /= zoom.mean(0)
    return lens, after_motions(true, motions, middle)


#: Least and greatest share of a cut subject's height that remains: down to the waist or the ankles.
_SHOWN = 0.45, 0.95


def cut_subjects(batch: Batch, chance: float, rngs: list[np.random.Generator]) -> Batch:
    """Cut a share of the subjects by the frame's lower edge.

    Half of them are cut in all inputs and targets at about the same height, so that no target
    shows legs that no input shows; the others in some inputs, at different heights. Photographs
    are moved down in their frames, and principal points with them.

    Args:
        batch: of at least two views.
        chance: share of the subjects that are cut, in [0, 1].
        rngs: one for each element.
    """
    views = batch.masks.shape[1]
    shares = np.ones(batch.masks.shape[:2])
    ends = np.ones(len(rngs))
    for b, rng in enumerate(rngs):
        is_cut, everywhere, *drawn = rng.uniform(size=3 + 2 * views)
        height = drawn[0]
        chosen = np.array(drawn[1 : 1 + views])
        heights = np.array(drawn[1 + views :])
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
    """Rows by which photographs move down so that the given share of the mask's height remains."""
    moved = []
    for seen, share in zip(extents(masks.flatten(0, 1)), shares.flatten(), strict=True):
        end = math.ceil(seen.top + share * (seen.bottom - seen.top))
        moved.append(masks.shape[2] - end if seen.count and share < 1 else 0)
    return torch.tensor(moved).reshape(shares.shape)


def _move_down(maps: Tensor | None, rows: Int[Tensor, "B V"]) -> Tensor | None:
    """``maps`` [B, V, ..., H, W], each moved down by its rows, with zeros above."""
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
