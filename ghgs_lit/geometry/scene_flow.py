"""Scene flow: how surface points move between two instants, from the photographs of all cameras.

A point keeps its colour in each view that shows it. Its motion follows from image gradients (Lucas
and Kanade, IJCAI 1981), in space and for all views at once (Vedula et al., ICCV 1999), from coarse
to fine images. The equations of a single point may leave directions open, so those of all points
are summed at the nodes of a grid and smoothed over the nodes around, further for coarser images."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghgs_lit.geometry.projection import project, sample, world_to_camera
from ghgs_lit.types import Cameras

#: Metres between the nodes of the grid.
_CELL = 0.08
#: Metres from the middle beyond which points are ignored, to limit the grid.
_REACH = 3.0
#: One point in this many has equations; all points move.
_EVERY = 4
#: Difference of colours at which an equation has half its weight.
_OUTLIER = 0.06
#: Longest step in metres.
_LONGEST = 0.05
#: Damping of steps, absolute.
_STILL = 1e-3
#: Damping of steps, relative to the mean of the matrix's diagonal.
_STIFF = 0.01


class _Level(NamedTuple):
    """A level: how much smaller images are, how often equations spread to the next nodes,
    number of steps."""

    smaller: int
    spread: int
    steps: int


_LEVELS = (_Level(4, 4, 2), _Level(2, 2, 2), _Level(1, 1, 1))


class Instant(NamedTuple):
    """Photographs on black as a :func:`pyramid`, and their cameras in metres."""

    levels: Sequence[Float[Tensor, "V 3 _h _w"]]
    cameras: Cameras


@dataclass(frozen=True)
class _Grid:
    """Nodes around points. ``low``: position of the first.
    ``shape``: their number along z, y and x."""

    low: Float[Tensor, " 3"]
    shape: tuple[int, int, int]

    @classmethod
    def around(cls, points: Float[Tensor, "N 3"]) -> "_Grid":
        low = points.amin(0) - _CELL
        counts = ((points.amax(0) - low) / _CELL).ceil().int() + 2
        return cls(low, tuple(counts.flip(0).tolist()))

    def summed(self, points: Float[Tensor, "n 3"], values: Float[Tensor, "n c"]) -> Float[Tensor, "c z y x"]:
        """Values summed at the nodes nearest to their points.

        Args:
            points: [n, 3] within the grid, in metres.
            values: [n, c] of any unit.

        Returns:
            Sums [c, z, y, x].
        """
        x, y, z = ((points - self.low) / _CELL).round().long().unbind(-1)
        sums = values.new_zeros(self.shape[0] * self.shape[1] * self.shape[2], values.shape[1])
        sums.index_add_(0, (z * self.shape[1] + y) * self.shape[2] + x, values)
        return sums.mT.reshape(-1, *self.shape)

    def at(self, nodes: Float[Tensor, "c z y x"], points: Float[Tensor, "n 3"]) -> Float[Tensor, "n c"]:
        """Values at points, interpolated between nodes.

        Args:
            nodes: values of the nodes [c, z, y, x].
            points: [n, 3] in metres; beyond the grid the nearest nodes count.

        Returns:
            Values [n, c].
        """
        last = points.new_tensor(self.shape[::-1]) - 1
        place = 2 * (points - self.low) / (_CELL * last) - 1
        mixed = F.grid_sample(nodes[None], place[None, None, None], padding_mode="border", align_corners=True)
        return mixed[0, :, 0, 0].mT


def _spread(nodes: Float[Tensor, "c z y x"], times: int) -> Float[Tensor, "c z y x"]:
    """Smooth the nodes ``times`` times: along each axis a quarter of a value goes to
    either side."""
    for _ in range(times):
        for axis in (1, 2, 3):
            size = nodes.shape[axis]
            spread = 0.5 * nodes
            spread.narrow(axis, 1, size - 1).add_(nodes.narrow(axis, 0, size - 1), alpha=0.25)
            spread.narrow(axis, 0, size - 1).add_(nodes.narrow(axis, 1, size - 1), alpha=0.25)
            nodes = spread
    return nodes


def pyramid(images: Float[Tensor, "V 3 H W"]) -> list[Float[Tensor, "V 3 _h _w"]]:
    """Smoothed images of the sizes of :data:`_LEVELS`.

    Args:
        images: photographs on black [V, 3, H, W].

    Returns:
        Images [V, 3, _h, _w], the smallest first.
    """
    views, _, height, width = images.shape
    levels = []
    for smaller, _, _ in _LEVELS:
        # Means of windows that overlap by half; of 3 x 3 pixels at full size.
        side = 2 * smaller if smaller > 1 else 3
        mean = images.new_full((1, 1, side, side), 1 / side**2)
        rim = (side - smaller + 1) // 2
        low = F.conv2d(images.reshape(-1, 1, height, width), mean, stride=smaller, padding=rim)
        levels.append(low.view(views, 3, *low.shape[2:]))
    return levels


def _with_slopes(images: Float[Tensor, "V 3 h w"]) -> Float[Tensor, "V 9 h w"]:
    """Values, and their gradients to the right and down, 0 at the border."""
    maps = images.new_zeros(len(images), 9, *images.shape[2:])
    maps[:, :3] = images
    torch.sub(images[..., 2:], images[..., :-2], out=maps[:, 3:6, :, 1:-1])
    torch.sub(images[..., 2:, :], images[..., :-2, :], out=maps[:, 6:, 1:-1])
    maps[:, 3:] *= 0.5
    return maps


@torch.no_grad()
def scene_flow(
    points: Float[Tensor, "N 3"], shown: Bool[Tensor, "N V"], before: Instant, after: Instant
) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 3"]]:
    """Motion of surface points between two instants.

    Args:
        points: on the surface in the first instant [N, 3], in metres.
        shown: the views that show them there [N, V].
        before: photographs and cameras of the first instant.
        after: those of the second, with the same views in order; a camera stands still, but its
            crop may change.

    Returns:
        Motions [N, 3] in metres, and rotation vectors [N, 3] in radians.
    """
    near = ((points - points.nanmedian(0).values).abs() < _REACH).all(-1) if len(points) else shown.any(-1)
    if not near.any():
        return torch.zeros_like(points), torch.zeros_like(points)
    some = points[::_EVERY]
    seen = (shown & near[:, None])[::_EVERY]
    grid = _Grid.around(points[near])
    index, view = seen.nonzero().unbind(-1)
    moved = points.new_zeros(3, *grid.shape)
    from_, _ = _seen(some[index], view, before.cameras)
    for level, was, now in zip(_LEVELS, before.levels, after.levels, strict=True):
        colors = sample(was, view, from_ / level.smaller)
        maps = _with_slopes(now)
        for _ in range(level.steps):
            at = (some + grid.at(moved, some))[index]
            equations = _equations(at, view, colors, maps, after.cameras, level.smaller)
            sums = _spread(grid.summed(some[index], equations), level.spread)
            moved = moved + _steps(sums)
    return grid.at(moved, points), grid.at(_turns(moved), points)


def _seen(
    points: Float[Tensor, "n 3"], view: Int[Tensor, " n"], cameras: Cameras
) -> tuple[Float[Tensor, "n 2"], Float[Tensor, " n"]]:
    return project(points, cameras.intrinsics[view], cameras.extrinsics[view])


#: Stored entries of a symmetric matrix [3, 3], and the stored entry of each of the nine.
_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_PLACES = (0, 1, 2, 1, 3, 4, 2, 4, 5)


def _equations(
    points: Float[Tensor, "n 3"],
    view: Int[Tensor, " n"],
    colors: Float[Tensor, "n 3"],
    maps: Float[Tensor, "V 9 h w"],
    cameras: Cameras,
    smaller: int,
) -> Float[Tensor, "n 9"]:
    """Normal equations of a step of each point in one view.

    Args:
        points: where they are now [n, 3], in metres.
        view: number of the view of each [n].
        colors: of the points in the first instant [n, 3].
        maps: photographs of the second instant with their gradients (:func:`_with_slopes`).
        cameras: of the second instant, for photographs of full size.
        smaller: how many times smaller ``maps`` are.

    Returns:
        The stored entries of a symmetric matrix (:data:`_PAIRS`) and the right side [n, 9].
    """
    pixels, depth = _seen(points, view, cameras)
    value, right, down = sample(maps, view, pixels / smaller).split(3, -1)
    lens = cameras.intrinsics[view]
    pose = cameras.extrinsics[view]
    inside = world_to_camera(points, pose)
    right = right * (lens[:, 0, :1] / (smaller * depth[:, None]))
    down = down * (lens[:, 1, 1:2] / (smaller * depth[:, None]))
    ahead = -(right * (inside[:, :1] / depth[:, None]) + down * (inside[:, 1:2] / depth[:, None]))
    # One [n, 3] (colours) for each axis of the world; products of many small matrices are slow.
    slopes = [
        right * pose[:, 0, i, None] + down * pose[:, 1, i, None] + ahead * pose[:, 2, i, None]
        for i in range(3)
    ]
    missing = colors - value
    weights = 1 / (1 + (missing / _OUTLIER).square().sum(-1))
    entries = [(slopes[i] * slopes[j]).sum(-1) for i, j in _PAIRS]
    entries += [(slope * missing).sum(-1) for slope in slopes]
    return weights[:, None] * torch.stack(entries, -1)


def _steps(sums: Float[Tensor, "9 z y x"]) -> Float[Tensor, "3 z y x"]:
    entries, right = sums.flatten(1).mT.split((6, 3), 1)
    matrices = entries[:, _PLACES].reshape(-1, 3, 3)
    still = _STILL + _STIFF * matrices.diagonal(dim1=1, dim2=2).mean(1)
    matrices = matrices + still[:, None, None] * torch.eye(3, dtype=sums.dtype, device=sums.device)
    steps = torch.linalg.solve_ex(matrices, right).result
    length = steps.norm(dim=1, keepdim=True)
    return (steps * (_LONGEST / length.clamp(min=_LONGEST))).mT.reshape(3, *sums.shape[1:])


def _turns(moved: Float[Tensor, "3 z y x"]) -> Float[Tensor, "3 z y x"]:
    """Rotation vectors: half the curl of the motion."""
    slopes = torch.gradient(moved, spacing=_CELL, dim=(3, 2, 1))
    x = 0
    y = 1
    z = 2
    turns = [slopes[b][c] - slopes[c][b] for b, c in ((y, z), (z, x), (x, y))]
    return torch.stack(turns) / 2
