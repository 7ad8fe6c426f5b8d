"""Correction of poses and focal lengths that makes a capture's silhouettes consistent.

With correct cameras, the ray of every silhouette pixel has a point inside all other silhouettes
(silhouette coherence: Boyer, ACCV 2006; Hernandez, Schmitt and Cipolla, PAMI 2007). With wrong
ones, rays near the outlines have none: Gauss-Newton steps minimise the distance of their best points
from the other silhouettes. This needs neither a model nor surfaces that are visible in two views."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from ghgs_lit.geometry.frame import HEIGHT, subject_center
from ghgs_lit.geometry.masks import coverage
from ghgs_lit.geometry.precision import exact
from ghgs_lit.geometry.rotations import apply_motions, remove_common_motion
from ghgs_lit.refinement.outlines import QUICK, TO, Lens, Outlines, Pose, best_points, gradients_of, rows_of
from ghgs_lit.types import Batch, Cameras

Lenses = Float[Tensor, "K V 3 3"]  #: Intrinsics of ``K`` instants, whose crops differ
Middles = Float[Tensor, "K 3"]  #: Centre of the subject at ``K`` instants
Which = Bool[Tensor, " V"]  #: A selection of cameras

#: Mean distance of rays in pixels below which silhouettes are consistent.
_COHERENT = 5e-4
#: Weight of the squared steps, in pixels, relative to the mean squared distance.
_STAY = 1e-3
#: Factor of that weight for zooms: focal lengths are known better than poses.
_KNOWN = 5.0
#: A set of cameras is suspected if, without it, the distance of the remaining given cameras is below
#: ``_CLEARLY`` times the least distance without any other set (opposite cameras are nearly
#: exchangeable); ``_EXACT`` pixels, which exact cameras reach, are added to both. The set moves alone
#: if this leaves less than ``_COHERENT``, ``_AS_WELL`` times the distance after moving all, or
#: ``_REST`` of the given distance, as with rough masks.
_CLEARLY = 0.25
_EXACT = 5e-5
_AS_WELL = 1.5
_REST = 0.02
_BUMPED = 1e-3  #: Given distance from which this is tried: that of one camera off by a pixel


@dataclass(frozen=True)
class _Phase:
    """Gauss-Newton steps with one kind of residual, for rays up to ``to`` pixels inside their outline.

    First, rays must meet the other silhouettes; the weight of those that miss them by r > ``scale``
    pixels falls with 1 / r. Then (``is_exact``) they must lie as deep in the others as in their
    own silhouette, as outlines from the front and from behind do; beyond ``scale`` the weight
    vanishes (Geman and McClure)."""

    steps: int
    to: float
    scale: float
    is_exact: bool

    def distances(self, depth: Tensor, depth_at_home: Tensor) -> Tensor:
        return depth - depth_at_home if self.is_exact else depth.clamp(max=0)

    def weights(self, r: Tensor) -> Tensor:
        if self.is_exact:
            return 1 / (1 + (r / self.scale) ** 2) ** 2
        return (r < 0) * self.scale / r.abs().clamp(min=self.scale)


_MEET = _Phase(12, TO, 1.0, is_exact=False)
_LIE = _Phase(6, 3.0, 0.3, is_exact=True)


@torch.no_grad()
def contradiction(batch: Batch) -> tuple[Float[Tensor, " B"], Float[Tensor, "B V"]]:
    """Quick check of cameras: mean distance by which rays near outlines miss other silhouettes.

    With exact cameras the distance over all views is up to 0.0025 pixels, with cameras off by 1.5
    pixels 0.007 to 0.09; if one camera is off, that of the others is as for exact cameras.

    Args:
        batch: as for :func:`coherent_cameras`.

    Returns:
        Mean distances in pixels: over all views [B], and over the others without each view [B, V] (0
        for three views or fewer: two nearly always agree).
    """
    of_all = []
    without = []
    for mattes, lens, pose in zip(*_on_cpu(batch), strict=True):
        silhouettes = _Silhouettes((Outlines.of(mattes, QUICK),), pose.new_zeros(1, 3))
        of_all.append(silhouettes.distance(lens[None], pose))
        views = range(len(pose))
        each = [silhouettes.distance(lens[None], pose, (v,)) if len(pose) > 3 else 0.0 for v in views]
        without.append(each)
    return torch.tensor(of_all), torch.tensor(without)


def culprit(without: Sequence[float]) -> int | None:
    """Index of the one view, or set of views, without which the others agree; None if unclear.

    Args:
        without: mean distances in pixels of the others without each; two or more.
    """
    first, second = sorted(range(len(without)), key=without.__getitem__)[:2]
    is_clear = without[first] + _EXACT < _CLEARLY * (without[second] + _EXACT)
    return first if is_clear else None


def _on_cpu(batch: Batch) -> list[Tensor]:
    parts = (coverage(batch), batch.cameras.intrinsics, batch.cameras.extrinsics)
    return [part.float().cpu() for part in parts]


@torch.no_grad()
def coherent_cameras(
    batch: Batch, shared: bool = False, alone: bool = True
) -> tuple[Cameras, Bool[Tensor, "B V"], Float[Tensor, " B"]]:
    """Move cameras until silhouettes are consistent; elements whose silhouettes are keep theirs.

    If moving a minority of the cameras is as good as moving all, the others stay; silhouettes cannot
    distinguish this from smaller relative motions of all cameras.

    Args:
        batch: in the subject's frame (:class:`ghgs_lit.geometry.frame.Frame`).
        shared: the elements are instants of one rig, in one frame, with common motions and zooms.
        alone: allow that only a minority of the cameras moves.

    Returns:
        The cameras; which of them were free to move [B, V]; and the mean distance in pixels by which
        rays near outlines miss other silhouettes with the given cameras [B]: 0 to 0.00014 with
        exact cameras and mattes; with four cameras 0.0001 to 0.0004 if off by up to half a pixel,
        0.002 by one, 0.04 to 0.08 by three; infinite if no silhouette has an outline.
    """
    cameras = batch.cameras
    # On the CPU: steps are many and short, and distance transforms run there anyway.
    mattes, lens, pose = _on_cpu(batch)
    middle = subject_center(batch.masks, cameras).float().cpu() if shared else pose.new_zeros(len(pose), 3)
    each = [slice(None)] if shared else [slice(b, b + 1) for b in range(len(pose))]
    with exact("cpu"):
        rigs = [_align(mattes[part], lens[part], pose[part][0], middle[part], alone) for part in each]
    lenses, poses, free, distances = zip(*rigs, strict=True)
    count = len(pose) // len(rigs)
    device = batch.masks.device
    poses, free = (torch.stack(values).repeat_interleave(count, 0) for values in (poses, free))
    lenses = torch.cat(lenses).to(cameras.intrinsics)
    poses = poses.to(cameras.extrinsics)
    moved = replace(cameras, intrinsics=lenses, extrinsics=poses)
    return moved, free.to(device), torch.tensor(distances, device=device).repeat_interleave(count)


def _align(
    mattes: Float[Tensor, "K V H W"], lens: Lenses, pose: Pose, middle: Middles, alone: bool
) -> tuple[Lenses, Pose, Which, float]:
    """:func:`coherent_cameras` of one rig.

    Args:
        mattes: of K instants [K, V, H, W].
        lens: intrinsics of each instant.
        pose: extrinsics, the same at all instants.
        middle: the subject's centre at each instant, in the frame.
        alone: allow that only a minority of the cameras moves.

    Returns:
        Intrinsics, extrinsics, which cameras were free, and the mean distance in pixels with the
        given cameras.
    """
    silhouettes = _Silhouettes(tuple(Outlines.of(each) for each in mattes), middle)
    every = torch.ones(len(pose), dtype=torch.bool)
    if not any(len(outlines.depth) for outlines in silhouettes.outlines):
        return lens, pose, every, math.inf
    given = silhouettes.equations(lens, pose, _MEET)
    if given.distance < _COHERENT:
        return lens, pose, every, given.distance
    free = every
    cameras, distance = silhouettes.advance(lens, pose, _MEET, every)
    few = _minority(silhouettes, lens, pose) if alone and given.distance > _BUMPED else None
    if few is not None:
        apart, distance_apart = silhouettes.advance(lens, pose, _MEET, few)
        # Two of three views nearly always agree.
        rest = 0.1 * _COHERENT if len(pose) == 3 else max(_COHERENT, _REST * given.distance)
        if distance_apart < max(_AS_WELL * distance, rest):
            cameras = apart
            free = few
    cameras, _ = silhouettes.advance(*cameras, _LIE, free)
    return *cameras, free, given.distance


def _minority(silhouettes: "_Silhouettes", lens: Lenses, pose: Pose) -> Which | None:
    """The smallest set of cameras (fewer than half) without which the others agree; None if unclear."""
    count = len(pose)
    for size in range(1, (count + 1) // 2):
        sets = list(combinations(range(count), size))
        which = culprit([silhouettes.distance(lens, pose, views) for views in sets])
        if which is not None:
            return torch.zeros(count, dtype=torch.bool).index_fill(0, torch.tensor(sets[which]), True)
    return None


class _Equations(NamedTuple):
    """Normal equations of a Gauss-Newton step, and number and total distance of rays before it."""

    normal: Float[Tensor, "n n"]
    right: Float[Tensor, " n"]
    rays: int
    total: float

    @property
    def distance(self) -> float:
        return self.total / max(self.rays, 1)

    def solve(self, free: Which) -> Float[Tensor, "V 7"]:
        """Solve for the step of the free cameras; 0 for the others."""
        index = free.repeat_interleave(7).nonzero()[:, 0]
        steps = torch.linalg.solve(self.normal[index][:, index], self.right[index])
        return torch.zeros_like(self.right).index_copy(0, index, steps).view(-1, 7)


@dataclass(frozen=True)
class _Silhouettes:
    """The silhouettes of each instant, and the centre of its subject in the frame."""

    outlines: tuple[Outlines, ...]
    middle: Middles

    def distance(self, lens: Lenses, pose: Pose, views: Sequence[int] = ()) -> float:
        """Mean distance in pixels by which rays miss other silhouettes, leaving out ``views``."""
        kept = [view for view in range(len(pose)) if view not in views]
        missed = 0.0
        rays = 0
        for outlines, each, middle in zip(self.outlines, lens, self.middle, strict=True):
            some = outlines.of_views(kept)
            placed = _center_poses(pose[kept], middle)
            depth = best_points(some, each[kept], placed, some.view, some.pixels)[2]
            missed = missed - float(depth.clamp(max=0).sum())
            rays = rays + len(depth)
        return missed / max(rays, 1)

    def equations(self, lens: Lenses, pose: Pose, phase: _Phase) -> "_Equations":
        """Normal equations of a Gauss-Newton step of all cameras, summed over the instants."""
        pixel = _pixel(lens, pose)
        parts = zip(self.outlines, lens, self.middle, strict=True)
        each = [_equations(*part, pose, phase, pixel) for part in parts]
        return _Equations(*map(sum, zip(*each, strict=True)))

    def advance(
        self, lens: Lenses, pose: Pose, phase: _Phase, free: Which
    ) -> tuple[tuple[Lenses, Pose], float]:
        """Cameras after the steps of a phase of the ``free`` ones, and the mean distance of rays before the
        last step."""
        are_all = bool(free.all())
        for _ in range(phase.steps):
            equations = self.equations(lens, pose, phase)
            lens, pose = _apply_step(equations.solve(free), lens, pose, are_all)
        return (lens, pose), equations.distance


def _equations(
    outlines: Outlines, lens: Lens, middle: Float[Tensor, " 3"], pose: Pose, phase: _Phase, pixel: Tensor
) -> _Equations:
    """Normal equations of one instant.

    Args:
        outlines: outlines of its silhouettes.
        lens: its intrinsics.
        middle: the subject's centre [3] in the frame.
        pose: extrinsics in the frame.
        phase: the distances to minimise.
        pixel: half the height of the subject in pixels, which scales the unknowns.

    Returns:
        Equations of the motions about the frame's origin and the zooms of all cameras, in units of
        about a pixel.
    """
    count = len(pose)
    pose = _center_poses(pose, middle)
    near = outlines.depth <= phase.to
    view = outlines.view[near]
    depth_at_home = outlines.depth[near]
    points, other, depth = best_points(outlines, lens, pose, view, outlines.pixels[near])
    distances = phase.distances(depth, depth_at_home)
    rays = max(len(distances), 1)
    gradients = gradients_of(outlines, lens, pose, points, other) / pixel
    jacobian = gradients.new_zeros(len(gradients), count, 7)
    index = torch.arange(len(gradients))
    jacobian[index, other] = rows_of(points, gradients, pose[other], middle)
    jacobian[index, view] -= rows_of(points, gradients, pose[view], middle)
    jacobian = jacobian.flatten(1)
    weighted = phase.weights(distances)[:, None] * jacobian
    stay = _STAY * rays * torch.tensor([*[1.0] * 6, _KNOWN]).to(gradients).repeat(count)
    normal = weighted.mT @ jacobian + stay.diag()
    return _Equations(normal, -(weighted.mT @ distances), len(distances), float(distances.abs().sum()))


def _center_poses(pose: Pose, middle: Float[Tensor, " 3"]) -> Pose:
    """Shift poses to the subject's centre, around which rays are searched."""
    return apply_motions(pose, F.pad(middle, (3, 0)).expand(len(pose), 6), pose.new_zeros(3))


def _pixel(lens: Lenses, pose: Pose) -> Float[Tensor, ""]:
    """Half the height of the subject, in pixels."""
    return HEIGHT / 2 * (lens[..., 0, 0] / pose[:, 2, 3]).mean()


def _apply_step(steps: Float[Tensor, "V 7"], lens: Lenses, pose: Pose, are_all: bool) -> tuple[Lenses, Pose]:
    """Apply motions and zooms ``steps`` (in units of about a pixel) to intrinsics and extrinsics; with
    ``are_all``, all cameras are free, and the common motion and zoom are removed."""
    motions, zooms = (steps / _pixel(lens, pose)).split((6, 1), -1)
    if are_all:
        motions = remove_common_motion(motions, pose[:, 2, :3])
        zooms = zooms - zooms.mean(0)
    zoomed = lens.clone()
    zoomed[..., [0, 1], [0, 1]] *= zooms.exp()
    return zoomed, apply_motions(pose, motions, pose.new_zeros(3), HEIGHT / 2)
