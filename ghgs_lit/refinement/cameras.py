"""Correction of a capture's cameras until its input images agree.

First, poses and focal lengths are optimised until silhouettes are consistent
(:mod:`ghgs_lit.refinement.coherence`); the result is discarded where a prediction does not confirm
the gain, as with wrong masks. Then the Gaussians of the other views are rendered with each view's
camera, whose pose is optimised until the render matches the image (bundle adjustment as in BARF, Lin
et al., ICCV 2021). The pose of the rig as a whole is not observable: only relative motions of cameras
are estimated (:mod:`ghgs_lit.geometry.rotations`)."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghgs_lit.errors import require
from ghgs_lit.geometry.frame import HEIGHT, Frame
from ghgs_lit.geometry.masks import coverage, on_black
from ghgs_lit.geometry.precision import exact
from ghgs_lit.geometry.projection import at_least_float32, project
from ghgs_lit.geometry.rotations import apply_motions, remove_common_motion, rigid
from ghgs_lit.refinement.coherence import coherent_cameras
from ghgs_lit.types import Batch, Cameras, Gaussians, Prediction, Rendering

Renderer = Callable[..., Rendering]
#: One number per element of a batch.
Numbers = Float[Tensor, " B"]
#: A selection of cameras.
Which = Bool[Tensor, "B V"]

_STEPS = 15  #: Steps of the optimiser in a round
_RATE = 0.006  #: Initial learning rate: radians, and half heights of the subject
_OUTLINE = 0.5  #: Weight of silhouettes; that of colours is 1
_SAME = 0.05  #: Largest difference in metres of depths of one surface
_STAY = 4.0  #: Weight of the squared motion
#: Relative decrease of the loss required to accept the cameras of the first round, and those from
#: silhouettes: exact cameras reach up to 0.01 (0.02 from above), cameras off by a pixel 0.02 to 0.2.
_FIRST = 0.02
#: The same for the cameras of a later round.
_LATER = 0.01
#: With ``_TELLING`` cameras or more (fewer silhouettes constrain them less), a silhouette distance
#: below ``_EXACT`` pixels implies errors of at most half a pixel: the first round must gain
#: ``_DOUBTED``.
_TELLING = 4
_EXACT = 1.5e-4
_DOUBTED = 0.05


@dataclass(frozen=True)
class _Views:
    """The ``n`` views of a batch, each with the Gaussians predicted from its element's other views;
    ``owner``: the view that each of these Gaussians is rendered in."""

    gaussians: Gaussians
    owner: Int[Tensor, " N"]
    cameras: Cameras
    photographs: Float[Tensor, "n 3 H W"]
    silhouettes: Float[Tensor, "n H W"]
    depths: Float[Tensor, "n H W"]


class CameraRefinement:
    """Optimise the cameras of a batch: ``refinement(batch) -> Batch``.

    Args:
        rounds: largest number of rounds of prediction and correction, 1 or more. The cameras of an
            element stay from the first round on that does not improve the agreement of its images.
        predict: predicts from a batch, as a model does.
        renderer: renders Gaussians, with gradients.
        shared: the elements of a batch are instants of one rig, with common motions of its cameras.

    Raises:
        InputError: ``rounds`` is below 1.
    """

    def __init__(
        self, rounds: int, predict: Callable[[Batch], Prediction], renderer: Renderer, shared: bool = False
    ):
        require(rounds >= 1, "refine_cameras", "1 or more rounds", rounds)
        self.rounds = rounds
        self.predict = predict
        self.renderer = renderer
        self.shared = shared

    def __call__(self, batch: Batch) -> Batch:
        """Correct the input cameras of a batch of two or more views; targets are unchanged, and so are
        the cameras of elements that do not improve."""
        frame = Frame.of(batch).shared if self.shared else Frame.of(batch)
        inside, moved, free, first = self._make_coherent(frame.enter(batch))
        for _ in range(self.rounds):
            with torch.no_grad():
                prediction = self.predict(inside)
            worth = torch.where(moved, _LATER, first)
            cameras, is_better = self._correct(prediction, inside, free, worth)
            if not bool(is_better.any()):
                break
            inside = replace(inside, cameras=cameras)
            moved = moved | is_better
        # A round trip through the frame is not exact: unmoved cameras are copied.
        left = frame.leave_cameras(inside.cameras, batch.cameras)
        return replace(batch, cameras=_choose(moved[:, None] & free, left, batch.cameras))

    @torch.no_grad()
    def _make_coherent(self, batch: Batch) -> tuple[Batch, Bool[Tensor, " B"], Which, Numbers]:
        """Make silhouettes consistent, where a prediction confirms the gain.

        Args:
            batch: in the subject's frame.

        Returns:
            The batch with these cameras; which elements they improve [B]; which cameras may be
            wrong [B, V] (all, unless silhouettes and prediction agree on a few); the gain required
            of the first round [B].
        """
        cameras, free, distance = coherent_cameras(batch, self.shared)
        are_right = (distance < _EXACT) & (batch.masks.shape[1] >= _TELLING)
        first = torch.where(are_right, _DOUBTED, _FIRST)
        is_better = self._confirm(batch, cameras)
        shared = ~is_better & ~free.all(1)
        if bool(shared.any()):  # the few suspected cameras were not confirmed: move all of them
            together, _, _ = coherent_cameras(batch, self.shared, alone=False)
            cameras = _choose(shared[:, None], together, cameras)
            free = free | shared[:, None]
            is_better = torch.where(shared, self._confirm(batch, cameras), is_better)
        free = free | ~is_better[:, None]
        cameras = _choose(is_better[:, None] & free, cameras, batch.cameras)
        return replace(batch, cameras=cameras), is_better, free, first

    def _confirm(self, batch: Batch, cameras: Cameras) -> Bool[Tensor, " B"]:
        """Which elements' predictions agree better with ``cameras``; False where these are unchanged."""
        moved = (cameras.extrinsics != batch.cameras.extrinsics).flatten(1).any(1)
        if not bool(moved.any()):
            return moved
        before, after = map(self._disagreement, (batch, replace(batch, cameras=cameras)))
        return moved & (after < (1 - _FIRST) * before)

    def _disagreement(self, batch: Batch) -> Numbers:
        views = _views(self.predict(batch), batch)
        return self._loss(self.renderer(views.gaussians, views.cameras, background=0.0), views, batch)

    def _loss(self, drawn: Rendering, views: _Views, batch: Batch) -> Numbers:
        """L1 of colours and silhouettes per pixel of each element's subject [B]; with ``shared``, the
        mean over elements."""
        image = drawn.image[:, 0]
        alpha = drawn.alpha[:, 0, 0]
        # Where the other views do not see the surface, the render shows what lies behind it.
        same = (drawn.depth.detach()[:, 0, 0] - views.depths).abs() < _SAME
        errors = same * (image - views.photographs).abs().mean(1)
        errors = errors + _OUTLINE * (alpha - views.silhouettes).abs()
        shape = batch.masks.shape[:2]
        subject, errors = (each.reshape(*shape, -1).sum((1, 2)) for each in (views.silhouettes, errors))
        loss = errors / torch.where(subject > 0, subject, 1)
        return loss.mean().expand(len(loss)) if self.shared else loss

    def _correct(
        self, prediction: Prediction, batch: Batch, free: Which, worth: Numbers
    ) -> tuple[Cameras, Bool[Tensor, " B"]]:
        """Optimise the free cameras in one round.

        Args:
            prediction: prediction of ``batch``.
            batch: in the subject's frame.
            free: which cameras may move.
            worth: relative decrease of the loss required of each element [B].

        Returns:
            Cameras, unchanged for elements that gain less; and which elements gain that much [B].
        """
        cameras = batch.cameras
        losses = []
        views = _views(prediction, batch)
        axes = cameras.extrinsics[..., 2, :3]
        rigs = 1 if self.shared else len(axes)
        raw = torch.zeros(rigs, axes.shape[1], 6, dtype=axes.dtype, device=axes.device, requires_grad=True)
        # A negligible epsilon, because gradients shrink with the size of the images.
        optimizer = torch.optim.Adam([raw], lr=_RATE, betas=(0.8, 0.95), eps=1e-15)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, _STEPS, 0.05 * _RATE)
        for _ in range(_STEPS):
            with exact(axes.device.type), torch.enable_grad():
                motion = _restrict_to_free(raw.expand(len(axes), -1, -1), axes, free)
                drawn = self.renderer(_move_gaussians(views, motion), views.cameras, background=0.0)
                losses.append(self._loss(drawn, views, batch))
                optimizer.zero_grad()
                (losses[-1].sum() + _STAY * motion.square().sum()).backward()
                optimizer.step()
            schedule.step()
        is_better = losses[-1].detach() < (1 - worth) * losses[0].detach()
        with exact(axes.device.type):
            motion = _restrict_to_free(raw.detach().expand(len(axes), -1, -1), axes, free)
            extrinsics = apply_motions(cameras.extrinsics, motion, axes.new_zeros(3), HEIGHT / 2)
        corrected = replace(cameras, extrinsics=extrinsics)
        return _choose(is_better[:, None] & free, corrected, cameras), is_better


def _restrict_to_free(motions: Float[Tensor, "B V 6"], axes: Float[Tensor, "B V 3"], free: Which) -> Tensor:
    """Set motions of fixed cameras to 0; where all are free, remove the common motion."""
    all_are = free.all(1)[:, None, None]
    return torch.where(all_are, remove_common_motion(motions, axes), motions * free[..., None])


def _choose(which: Which, first: Cameras, second: Cameras) -> Cameras:
    """Take each camera from ``first`` where ``which`` (broadcast to [B, V]) is True, else from
    ``second``."""
    which = which[..., None, None]
    lenses = torch.where(which, first.intrinsics, second.intrinsics)
    poses = torch.where(which, first.extrinsics, second.extrinsics)
    return replace(first, intrinsics=lenses, extrinsics=poses)


def pixels_moved(before: Batch, after: Batch) -> list[list[float]]:
    """Root mean square motion, in pixels, of the corners of a box around the subject in each view
    [B][V], caused by a correction of cameras.

    Args:
        before: the batch with the given cameras.
        after: the batch with the corrected ones.
    """
    frame = Frame.of(before)
    corners = HEIGHT / 2 * torch.cartesian_prod(*[torch.tensor([-1.0, 1.0], device=before.masks.device)] * 3)
    seen = []
    for batch in (before, after):
        cameras = frame.enter(batch).cameras
        shape = (*cameras.extrinsics.shape[:2], len(corners))
        lenses, poses = (
            matrix[:, :, None].expand(*shape, -1, -1) for matrix in (cameras.intrinsics, cameras.extrinsics)
        )
        seen.append(project(corners.to(lenses).expand(*shape, 3), lenses, poses)[0])
    return (seen[0] - seen[1]).square().sum(-1).mean(-1).sqrt().tolist()


def _views(prediction: Prediction, batch: Batch) -> _Views:
    """Make each view a separate element with the Gaussians of its element's other views."""
    b, v = batch.masks.shape[:2]
    gaussians = prediction.gaussians.detach()
    element = gaussians.image // v
    kept = [((element == i // v) & (gaussians.image != i)).nonzero()[:, 0] for i in range(b * v)]
    counts = tuple(map(len, kept))
    others = gaussians.select(torch.cat(kept), counts)
    if others.metre is not None:
        others = replace(others, metre=others.metre.repeat_interleave(v))
    owner = torch.repeat_interleave(torch.tensor(counts, device=element.device))
    cameras = batch.cameras
    lenses, poses = (matrix.flatten(0, 1)[:, None] for matrix in (cameras.intrinsics, cameras.extrinsics))
    apart = Cameras(lenses, poses, cameras.height, cameras.width)
    maps = (at_least_float32(on_black(batch)), coverage(batch), prediction.depth.detach())
    return _Views(others, owner, apart, *(each.flatten(0, 1) for each in maps))


def _move_gaussians(views: _Views, motion: Float[Tensor, "B V 6"]) -> Gaussians:
    """Move the Gaussians of each view instead of its camera; their orientations stay."""
    rotations, shifts = (value.flatten(0, 1)[views.owner] for value in rigid(motion, HEIGHT / 2))
    means = (rotations @ views.gaussians.means[..., None])[..., 0] + shifts
    return replace(views.gaussians, means=means)
