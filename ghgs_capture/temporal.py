"""Prediction of a sequence: Gaussians follow the photographs and are predicted anew now and then.

The Gaussians of the last instant follow the scene flow (:mod:`ghgs_lit.geometry.scene_flow`). A few
gradient steps on the inputs' renders, with one optimiser over the instants, correct its errors and
follow changes of light (as in Luiten et al., 3DV 2024). Every few instants Gaussians are predicted
anew, and take the place of the last ones over some instants, so that nothing pops. Where renders no
longer fit photographs or masks, they do so at once."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghgs_lit.geometry.masks import coverage, on_black
from ghgs_lit.geometry.projection import at_least_float32, project, sample, unproject_maps
from ghgs_lit.geometry.rotations import multiply_quaternions, unit
from ghgs_lit.geometry.scene_flow import Instant, pyramid, scene_flow
from ghgs_lit.refinement.refinement import NEAR, Change, Descent, Renderer, seen_by
from ghgs_lit.types import Batch, Cameras, Gaussians, Prediction, Rendering

_SHOWN = 0.03  #: A view shows Gaussians this near to the rendered surface, in metres
#: Steps at each instant. Means may change more than in ``NEAR``: flow is less exact than a prediction.
_STEPS = 2
_CHANGES = NEAR | {
    "means": Change(10.0, 0.1),
    "scales": Change(1.0, 0.02),
    "colors": Change(0.1, 0.004),
}
#: Of L1, 1 - SSIM (it takes as long as the renders) and the silhouettes' L1.
_WEIGHTS = (0.8, 0.0, 0.1)
_CROSSING = 4  #: Instants in which a new prediction takes the place of the last one
_WORSE = 1.5  #: Times the misfit after a new prediction above which Gaussians do not fit


@dataclass(frozen=True)
class _Last:
    """The last instant, its photographs for the flow,
    and depth [1, V, 1, H, W] of the inputs' renders."""

    batch: Batch
    prediction: Prediction
    levels: list[Tensor]
    depth: Tensor


@dataclass(frozen=True)
class _Crossing:
    """A new prediction on its way: the ``coming`` first Gaussians of a descent are its own, the
    others those before it; ``opacities`` [N] of all by themselves. Shares are of -log(1 - opacity),
    so that both together let as much light through as either."""

    coming: int
    opacities: Tensor
    instants: int

    def shared(self, gaussians: Gaussians, age: int) -> Gaussians:
        """Share opacities between the new prediction and the Gaussians before it.

        Args:
            gaussians: both, the new ones first.
            age: instants since the prediction.

        Returns:
            The Gaussians with opacities of this instant.
        """
        done = (age + 1) / (self.instants + 1)
        come = done * done * (3 - 2 * done)
        shares = torch.full_like(self.opacities, 1 - come)
        shares[: self.coming] = come
        return replace(gaussians, opacities=1 - (1 - self.opacities) ** shares)

    def arrived(self, gaussians: Gaussians) -> Gaussians:
        """End with the new prediction alone.

        Args:
            gaussians: both, the new ones first.

        Returns:
            The new ones with their whole opacities.
        """
        whole = replace(gaussians, opacities=self.opacities)
        return whole.select(slice(self.coming), (self.coming,))


class Temporal:
    """``temporal(batch)``: the prediction of each instant of a sequence in turn.

    An instant that equals the last one has the same prediction, bit for bit. Where one prediction
    takes the place of another there are Gaussians of both.

    Args:
        predict: gives the prediction of a batch of one subject, as a model does.
        every: at least one of so many instants is predicted anew; 1: all are, and nothing is kept.
        renderer: draws the inputs, with gradients.

    Attributes:
        anew: how many instants were predicted anew."""

    def __init__(self, predict: Callable[[Batch], Prediction], every: int, renderer: Renderer):
        self.predict = predict
        self.every = every
        self.renderer = renderer
        self.anew = 0
        self.reset()

    def reset(self) -> None:
        """Forget the last instant, before one that does not follow it."""
        self._last: _Last | None = None
        self._crossing: _Crossing | None = None
        self._age = 0  # instants since the last prediction

    @torch.no_grad()
    def __call__(self, batch: Batch) -> Prediction:
        last = self._last
        if self.every == 1:
            self.anew += 1
            return self.predict(batch)
        if last is not None and _are_equal(last.batch, batch):
            return last.prediction
        levels = pyramid(at_least_float32(on_black(batch))[0])
        fits = True
        before = None
        if last is not None and last.batch.views == batch.views and self._age < self.every:
            self._age += 1
            self._follow(last, batch, levels)
            drawn, misfit = self._improved(batch)
            fits = bool((misfit <= _WORSE * self._misfit).all())
            if fits and self._age < self.every:
                return self._kept(last.prediction, batch, levels, drawn)
            before = self._descent.gaussians if fits else None
        prediction = self.predict(batch)
        # What moves too fast is not followed at every instant.
        self.anew += 1
        self._age = 0 if fits else self.every
        self._crossing = None
        self._descent = Descent(prediction.gaussians, batch, _CHANGES)
        drawn, self._misfit = self._improved(batch)
        if before is not None:
            self._cross(before, batch)
            drawn, _ = self._improved(batch)
        return self._kept(prediction, batch, levels, drawn)

    def _cross(self, before: Gaussians, batch: Batch) -> None:
        """Let the Gaussians take the place of those before over some instants."""
        own = self._descent.gaussians
        both = own.with_more(before)
        instants = min(_CROSSING, self.every - 1)
        self._crossing = _Crossing(len(own), both.opacities, instants)
        changes = {name: change for name, change in _CHANGES.items() if name != "opacities"}
        self._descent = Descent(self._crossing.shared(both, 0), batch, changes)

    def _follow(self, last: _Last, batch: Batch, levels: list[Tensor]) -> None:
        """Move the Gaussians to the instant of ``batch``,
        and those of a new prediction on their way."""
        crossing = self._crossing
        start = _moved(self._descent.start, last, batch, levels)
        if crossing is not None and self._age >= crossing.instants:
            self._descent.start = start
            self._crossing = None
            self._descent = Descent(crossing.arrived(self._descent.gaussians), batch, _CHANGES)
        else:
            self._descent.start = start if crossing is None else crossing.shared(start, self._age)

    def _improved(self, batch: Batch) -> tuple[Rendering, Float[Tensor, " 2"]]:
        """Take some steps of the descent.

        Args:
            batch: photographs, masks and cameras of the instant.

        Returns:
            The inputs' renders before the last step, and their misfit: the error within masks, and
            the share of the subject beyond its mask in the worst view.
        """
        seen = seen_by(batch)
        photographs, silhouettes, _ = seen
        for _ in range(_STEPS):
            drawn = self._descent.step(self.renderer, seen, _WEIGHTS)
        masks = batch.masks[:, :, None]
        error = ((drawn.image - photographs).abs() * masks).sum() / (3 * masks.sum()).clamp(min=1)
        beyond = (drawn.alpha - silhouettes).clamp(min=0).sum((-2, -1))
        beyond = (beyond / silhouettes.sum((-2, -1)).clamp(min=1)).max()
        return drawn, torch.stack((error, beyond))

    def _kept(
        self, prediction: Prediction, batch: Batch, levels: list[Tensor], drawn: Rendering
    ) -> Prediction:
        """Keep the instant, which becomes the last one.

        Args:
            prediction: of this instant; or of the last one, whose Gaussians were moved.
            batch: photographs, masks and cameras of the instant.
            levels: its photographs for the flow, a pyramid.
            drawn: renders of the inputs.

        Returns:
            The prediction with the Gaussians as they are.
        """
        depth = drawn.depth.detach()
        kept = _as_drawn(prediction, self._descent.gaussians, batch, depth[:, :, 0])
        self._last = _Last(batch, kept, levels, depth)
        return kept


def _are_equal(first: Batch, second: Batch) -> bool:
    known = ((b.images, coverage(b), b.cameras.intrinsics, b.cameras.extrinsics) for b in (first, second))
    return all(map(torch.equal, *known))


def _moved(gaussians: Gaussians, last: _Last, batch: Batch, levels: list[Tensor]) -> Gaussians:
    """Move Gaussians by the scene flow between two instants.

    Args:
        gaussians: those of the last instant, where a descent starts.
        last: the last instant; its prediction has as many Gaussians.
        batch: photographs, masks and cameras of the new instant.
        levels: its photographs for the flow, a pyramid.

    Returns:
        The Gaussians with new means and rotations.
    """
    seen = last.prediction.gaussians
    metre = 1.0 if seen.metre is None else float(seen.metre[0])
    # Near the origin and in metres: the world may have any place and unit.
    origin = seen.means.double().nanmedian(0).values if len(seen) else seen.means.new_zeros(3).double()
    points = ((seen.means.double() - origin) / metre).to(levels[0])
    before = Instant(last.levels, _around(last.batch.cameras, origin, metre).to(points.dtype))
    after = Instant(levels, _around(batch.cameras, origin, metre).to(points.dtype))
    shown = _shown(points, before.cameras, (last.depth[0] / metre).to(points))
    moved, turned = scene_flow(points, shown, before, after)
    half = torch.cat((torch.ones_like(turned[:, :1]), turned / 2), -1)
    return replace(
        gaussians,
        means=gaussians.means + (metre * moved).to(gaussians.means),
        quaternions=multiply_quaternions(unit(half).to(gaussians.quaternions), gaussians.quaternions),
    )


def _around(cameras: Cameras, origin: Float[Tensor, " 3"], metre: float) -> Cameras:
    """The cameras [V] of one element in metres around ``origin``."""
    extrinsics = cameras.extrinsics[0].double().clone()
    extrinsics[:, :3, 3] = (extrinsics[:, :3, :3] @ origin + extrinsics[:, :3, 3]) / metre
    return replace(cameras, intrinsics=cameras.intrinsics[0], extrinsics=extrinsics)


def _shown(
    points: Float[Tensor, "N 3"], cameras: Cameras, depth: Float[Tensor, "V 1 H W"]
) -> Bool[Tensor, "N V"]:
    """Which views show points: those whose rendered surface is at the depth of the point."""
    lens = cameras.intrinsics[:, None]
    pose = cameras.extrinsics[:, None]
    pixels, z = project(points.expand(len(depth), -1, -1), lens, pose)
    view = torch.arange(len(depth), device=z.device)[:, None].expand(z.shape)
    return ((z - sample(depth, view, pixels)[..., 0]).abs() < _SHOWN).mT


def _as_drawn(
    prediction: Prediction, gaussians: Gaussians, batch: Batch, depth: Float[Tensor, "1 V H W"]
) -> Prediction:
    """A prediction with other Gaussians, and depths as they are rendered.

    Args:
        prediction: whose other fields stay.
        gaussians: of the same subject.
        batch: masks and cameras of the instant.
        depth: of the rendered inputs; 0: no Gaussian covers the pixel.

    Returns:
        The prediction; subject's pixels that no Gaussian covers have the mean depth of their view.
    """
    valid = batch.masks
    drawn = depth > 0
    # Pixels that no Gaussian covers have the mean depth of their view.
    sums = depth.sum((-2, -1), keepdim=True)
    counts = drawn.sum((-2, -1), keepdim=True)
    mean = torch.where(counts > 0, sums / counts.clamp(min=1), 1)
    depth = torch.where(valid, torch.where(drawn, depth, mean), 1)
    pixels = unproject_maps(depth, batch.cameras).to(prediction.points.pixels)
    points = replace(prediction.points, pixels=pixels, valid=valid)
    maps = replace(prediction.depth_maps, depth=depth, valid=valid, bounds=None)
    changed = {"gaussians": gaussians, "depth": depth, "depth_valid": valid, "points": points}
    return replace(prediction, **changed, depth_maps=maps, rounds=(), drafts=())
