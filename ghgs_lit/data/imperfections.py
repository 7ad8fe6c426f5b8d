"""What goes wrong in captures: exposure and colour of single cameras, masks, calibration, cut subjects.

Each function draws equally many random numbers whatever its limits are.
"""

import dataclasses
import math

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import zoom
from torch import Tensor

from ghgs_lit.errors import require
from ghgs_lit.geometry.masks import signed_distance, unmultiplied
from ghgs_lit.geometry.projection import look_at_point, project, unproject
from ghgs_lit.geometry.rotations import after_motions, motions_between, quaternion_to_matrix, without_common
from ghgs_lit.types import Batch, Cameras, extents

# Stored colours are light to the power 1/2.2.
_GAMMA = 2.2
# Side of the bumps of a ragged outline in pixels.
_BUMP = 6
# Patches of backgrounds: how many along a side, and how much their colours differ. Noise of single pixels.
_PATCHES, _NOISE = ((3, 0.35), (12, 0.15), (40, 0.06)), 0.02


def color_gains(
    views: int, exposure: float, white_balance: float, rng: np.random.Generator
) -> Float[np.ndarray, "V 3"]:
    """What each camera multiplies stored colours by; the geometric mean over the cameras is 1.

    Photographs do not tell which camera is right, so that only differences between cameras can be undone.
    ``exposure``: greatest deviation of a camera in stops. ``white_balance``: greatest deviation of red and of
    blue from green in stops.
    """
    deviation = rng.uniform(-1, 1, (views, 3))
    deviation -= deviation.mean(0)
    deviation /= np.maximum(1, np.abs(deviation).max(0))
    red, green, blue = (deviation * (white_balance, exposure, white_balance)).T
    return 2 ** (np.stack((green + red, green, green + blue), -1) / _GAMMA)


def tone_powers(views: int, gamma: float, rng: np.random.Generator) -> Float[np.ndarray, " V"]:
    """What each camera raises stored colours to; the geometric mean over the cameras is 1.
    ``gamma``: greatest natural logarithm of a power."""
    deviation = rng.uniform(-1, 1, views)
    deviation -= deviation.mean()
    return np.exp(gamma * deviation / max(1, np.abs(deviation).max()))


def toned(
    images: Float[Tensor, "B V 3 h w"], alpha: Float[Tensor, "B V h w"] | None, powers: Float[Tensor, "B V"]
) -> Float[Tensor, "B V 3 h w"]:
    """Photographs whose surfaces' colours are raised to a power of each view. ``alpha``: mattes by which they
    are multiplied; None: there are none."""
    powers = powers[..., None, None, None]
    if alpha is None:
        return images**powers
    shares = alpha[:, :, None]
    return unmultiplied(images, shares) ** powers * shares


def imperfect_mask(
    mask: Bool[np.ndarray, "h w"],
    offset: float,
    ragged: float,
    hole: float,
    hole_chance: float,
    rng: np.random.Generator,
) -> Bool[np.ndarray, "h w"]:
    """A mask as a segmentation might give it; the mask itself where nothing would be left of it.

    Args:
        mask: on the subject; an empty one stays empty.
        offset: greatest number of pixels that it grows or shrinks by.
        ragged: greatest number of pixels that bumps of its outline are high.
        hole: greatest diameter of a round piece that is missing, as a share of the subject's height.
        hole_chance: how often a piece is missing.
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
        noise = zoom(bumps, _BUMP, order=1)[: mask.shape[0], : mask.shape[1]][window]
        result[window] = signed_distance(part) + (2 * grow - 1) * offset + height * ragged * noise > 0
    if missing < hole_chance:
        middle, radius = int(place * len(rows)), size * hole * (rows.max() - rows.min() + 1) / 2
        v, u = np.ogrid[: mask.shape[0], : mask.shape[1]]
        result &= (v - rows[middle]) ** 2 + (u - columns[middle]) ** 2 >= radius**2
    return result if result.any() else mask


def backgrounds(
    views: int, height: int, width: int, rng: np.random.Generator
) -> Float[np.ndarray, "V 3 h w"]:
    """What is behind a subject, another for each camera: cloudy patterns of large and small patches."""
    size = (views, 3, height, width)
    found = 0.5 + rng.uniform(-0.2, 0.2, (views, 3, 1, 1)) + _NOISE * rng.standard_normal(size)
    for cells, deviation in _PATCHES:
        patches = rng.uniform(-deviation, deviation, (views, 3, cells, cells))
        found += zoom(patches, (1, 1, height / cells, width / cells), order=1)
    return found.clip(0, 1)


def miscalibrated(
    cameras: Cameras, masks: Bool[Tensor, "V H W"], pixels: float, rng: np.random.Generator
) -> Cameras:
    """Cameras that are off: each is turned, moved across its axis and has another focal length.

    A camera's error is drawn up to ``pixels``: what the corners of its mask's box move by at the subject's
    distance (root of the mean square). What all cameras share is taken out, as photographs do not tell where
    a rig is: only differences between cameras can be undone. ``masks``: theirs; in place of an empty one
    counts the whole photograph. InputError: no point is before all cameras.
    """
    count = len(masks)
    directions = torch.from_numpy(rng.standard_normal((count, 6)))
    wanted = pixels * torch.from_numpy(rng.uniform(size=count))
    lenses, poses = cameras.intrinsics.double(), cameras.extrinsics.double()
    distances = (poses[:, 2, :3] * look_at_point(cameras)).sum(-1) + poses[:, 2, 3]
    expected = "cameras that look at the subject"
    require(bool((distances > 0).all()), "augmentation.calibration", expected, distances.tolist())
    corners = _corners(masks)

    def moved(errors: Tensor) -> tuple[Tensor, Tensor]:
        """Intrinsics and extrinsics after errors [V, 6], each in pixels about."""
        focal, half = lenses[:, 1, 1], max(cameras.height, cameras.width) / 2
        turn = errors[:, :3] / 2 / torch.stack((focal, focal, torch.full_like(focal, half)), -1)
        rotation = quaternion_to_matrix(torch.cat((torch.ones(count, 1, dtype=turn.dtype), turn), -1))
        pose, lens = poses.clone(), lenses.clone()
        pose[:, :3] = rotation @ poses[:, :3]
        pose[:, :2, 3] += errors[:, 3:5] * (distances / focal)[:, None]
        lens[:, [0, 1], [0, 1]] *= 1 + errors[:, 5:] / half
        return lens, pose

    points = unproject(corners, distances[:, None].expand(-1, 4), _of_each(lenses), _of_each(poses))

    def seen(lens: Tensor, pose: Tensor) -> Tensor:
        """Where cameras see the corners; far from the world's origin not exactly at them."""
        return project(points, _of_each(lens), _of_each(pose))[0]

    def size(lens: Tensor, pose: Tensor) -> Tensor:
        """Errors in pixels."""
        return (seen(lens, pose) - seen(lenses, poses)).square().sum(-1).mean(-1).sqrt()

    errors = wanted[:, None] * directions / directions.norm(dim=-1, keepdim=True)
    for _ in range(3):  # errors grow nearly in proportion
        errors = errors * (wanted / size(*moved(errors)))[:, None]
    lens, pose = _apart(cameras, *moved(errors))
    largest = size(lens, pose).amax()
    if largest > pixels:
        lens, pose = _apart(cameras, *moved(errors * (pixels / largest)))
    return Cameras(lens.to(cameras.intrinsics), pose.to(cameras.extrinsics), cameras.height, cameras.width)


def _corners(masks: Bool[Tensor, "V H W"]) -> Float[Tensor, "V 4 2"]:
    """Corners of the boxes around masks, in pixels; those of the photograph where a mask is empty."""
    masks = torch.where(masks.any((1, 2), keepdim=True), masks, True)
    lines = [mask.any(axis).nonzero()[:, 0] for mask in masks for axis in (0, 1)]
    ends = torch.stack([torch.stack((line[0], line[-1] + 1)) for line in lines]).reshape(len(masks), 2, 2)
    return torch.stack([ends[:, [0, 1], [i, j]] for i in (0, 1) for j in (0, 1)], 1).double()


def _of_each(matrices: Float[Tensor, "V n m"]) -> Float[Tensor, "V 4 n m"]:
    return matrices[:, None].expand(-1, 4, -1, -1)


def _apart(
    cameras: Cameras, lens: Float[Tensor, "V 3 3"], pose: Float[Tensor, "V 4 4"]
) -> tuple[Float[Tensor, "V 3 3"], Float[Tensor, "V 4 4"]]:
    """Intrinsics and extrinsics without what their differences from ``cameras`` have in common."""
    true, middle = cameras.extrinsics.double(), look_at_point(cameras).double()
    motions = without_common(motions_between(true, pose, middle), true[:, 2, :3])
    both = [0, 1]
    zoom = lens[:, both, both] / cameras.intrinsics.double()[:, both, both]
    lens = lens.clone()
    lens[:, both, both] /= zoom.mean(0)
    return lens, after_motions(true, motions, middle)


#: Least and greatest share of the subject's height that a frame shows: from the waist to the ankles.
_SHOWN = 0.45, 0.95


def cut(batch: Batch, chance: float, rngs: list[np.random.Generator]) -> Batch:
    """The batch with a share ``chance`` of its subjects cut by the frame's lower edge.

    In one half of them all photographs and all targets end at about the same height, so that nobody is asked
    for legs that no photograph shows; in the other half some of the inputs end, at heights of their own.
    Photographs are moved down in their frames, principal points with them. ``rngs``: one for each element.
    """
    views = batch.masks.shape[1]
    shares, ends = np.ones(batch.masks.shape[:2]), np.ones(len(rngs))
    for b, rng in enumerate(rngs):
        is_cut, everywhere, *drawn = rng.uniform(size=3 + 2 * views)
        height, chosen, heights = drawn[0], np.array(drawn[1 : 1 + views]), np.array(drawn[1 + views :])
        low, high = _SHOWN
        if is_cut >= chance:
            continue
        if everywhere < 0.5:
            shares[b] = ends[b] = low + (high - low) * height
        else:
            some = (chosen < 0.5) | (chosen == chosen.min())
            some[chosen.argmax()] = False  # at least one is whole
            shares[b, some] = (low + (high - low) * heights)[some]
    rows = _rows(batch.masks, shares)
    maps = {name: _lowered(getattr(batch, name), rows) for name in ("images", "masks", "depths", "alpha")}
    targets = batch.targets
    if targets is not None:
        lower = _rows(targets.masks, np.broadcast_to(ends[:, None], targets.masks.shape[:2]))
        moved = {name: _lowered(getattr(targets, name), lower) for name in ("images", "masks")}
        cameras = _with_lower_centers(targets.cameras, lower)
        targets = dataclasses.replace(targets, **moved, cameras=cameras)
    return dataclasses.replace(
        batch, **maps, cameras=_with_lower_centers(batch.cameras, rows), targets=targets
    )


def _rows(masks: Bool[Tensor, "B V H W"], shares: Float[np.ndarray, "B V"]) -> list[list[int]]:
    """By how many rows photographs move down so that the given share of the mask's height stays."""
    height, views = masks.shape[2], masks.shape[1]
    found = []
    for seen, share in zip(extents(masks.flatten(0, 1)), shares.flatten(), strict=True):
        end = math.ceil(seen.top + share * (seen.bottom - seen.top))
        found.append(height - end if seen.count and share < 1 else 0)
    return [found[start : start + views] for start in range(0, len(found), views)]


def _lowered(maps: Tensor | None, rows: list[list[int]]) -> Tensor | None:
    """``maps`` [B, V, ..., H, W], each moved down by its rows; 0 and False above."""
    if maps is None:
        return None
    moved = torch.zeros_like(maps)
    for b, of_views in enumerate(rows):
        for v, down in enumerate(of_views):
            moved[b, v, ..., down:, :] = maps[b, v, ..., : maps.shape[-2] - down, :]
    return moved


def _with_lower_centers(cameras: Cameras, rows: list[list[int]]) -> Cameras:
    intrinsics = cameras.intrinsics.clone()
    intrinsics[..., 1, 2] += intrinsics.new_tensor(rows)
    return dataclasses.replace(cameras, intrinsics=intrinsics)
