"""Optimisation of predicted Gaussians towards the input photographs.

A few steps suffice, and every change is bounded, so that what no photograph shows stays as
predicted. Inputs that are reproduced say nothing about other views (wrong geometry reproduces them,
too), so :meth:`Refinement.report` holds one out and predicts again from the others."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from ghgs_lit.errors import require
from ghgs_lit.geometry.masks import coverage, on_black
from ghgs_lit.geometry.precision import exact
from ghgs_lit.geometry.projection import world_to_camera
from ghgs_lit.metrics.functional import psnr, ssim
from ghgs_lit.metrics.regions import box_of
from ghgs_lit.types import Batch, Cameras, Gaussians, Rendering

Renderer = Callable[..., Rendering]
Seen = tuple[Tensor, Tensor, Cameras]  #: Photographs on black, silhouettes and cameras


@dataclass(frozen=True)
class Change:
    """The largest change of a value, and the step of Adam near its start."""

    limit: float
    rate: float


#: Changes so small that what no photograph shows stays as predicted.
NEAR = {
    "means": Change(1.0, 0.04),
    "scales": Change(1.0, 0.03),
    "opacities": Change(2.0, 0.04),
    "colors": Change(0.05, 0.001),
}
#: Times that what a pixel lacks of fine detail is added to the colour of its Gaussian at the end.
#: Above 1: a pixel shows its own Gaussian and others, of other photographs too.
DETAIL = 2.0
#: The largest such change of a colour.
DETAIL_LIMIT = 0.1
#: Share of a pixel above which the subject covers it.
WHOLE = 0.99
#: Weights of L1, 1 - SSIM (as in the paper's L_render) and L1 of the silhouette.
Weights = tuple[float, float, float]
WEIGHTS: Weights = (0.8, 0.2, 0.1)


@dataclass(frozen=True)
class Report:
    """PSNR in dB in the subject's box before and after: of the inputs, and (of four or more) of
    one held out."""

    steps: int
    inputs: tuple[float, float]
    held_out: tuple[float, float] | None

    def __str__(self) -> str:
        line = f"refine: {self.steps} steps; in the box, inputs {{:.2f}} -> {{:.2f}} dB".format(*self.inputs)
        if self.held_out is None:
            return line
        return line + "; an input held out, from the others, {:.2f} -> {:.2f} dB".format(*self.held_out)


class Descent:
    """Bounded changes of Gaussians, at first 0, and their optimiser.

    Args:
        gaussians: predicted from ``batch``, each at a pixel of an input.
        batch: None where ``means`` do not change.
        changes: what may change, as for :class:`Refinement`.

    Raises:
        InputError: ``means`` change, but the Gaussians belong to no pixel.
    """

    def __init__(self, gaussians: Gaussians, batch: Batch | None, changes: Mapping[str, Change]):
        self.start = gaussians.detach()
        self.changes = changes
        if "means" in changes:
            require(gaussians.image is not None, "refine", "Gaussians of the inputs' pixels", "others")
            self._footprint = _footprints(self.start, batch)
        self._raw = {n: torch.zeros_like(getattr(self.start, n), requires_grad=True) for n in changes}
        # Without an epsilon: the loss is a mean, whose gradients shrink with images and batch.
        groups = [{"params": [self._raw[name]], "lr": change.rate} for name, change in changes.items()]
        self._optimizer = torch.optim.Adam(groups, betas=(0.9, 0.95), eps=1e-15)

    @property
    @torch.no_grad()
    def gaussians(self) -> Gaussians:
        """The Gaussians as they are now, without a gradient."""
        return self._changed()

    def step(self, renderer: Renderer, seen: Seen, weights: Weights = WEIGHTS) -> Rendering:
        """Take a step towards photographs.

        Args:
            renderer: draws the inputs, with gradients.
            seen: of :func:`seen_by`.
            weights: of L1, 1 - SSIM and L1 of the silhouette.

        Returns:
            The renders before the step.
        """
        with exact(self.start.means.device.type), torch.enable_grad():
            drawn = renderer(self._changed(), seen[2], background=0.0)
            self._optimizer.zero_grad()
            _loss(drawn, *seen[:2], weights).backward()
            self._optimizer.step()
        return drawn

    def _changed(self) -> Gaussians:
        start = self.start
        change = {n: c.limit * torch.tanh(self._raw[n] / c.limit) for n, c in self.changes.items()}
        changed = {name: getattr(start, name) + value for name, value in change.items()}
        if "means" in change:
            changed["means"] = start.means + self._footprint * change["means"]
        if "scales" in change:
            changed["scales"] = start.scales * change["scales"].exp()
        if "opacities" in change:
            # No step could leave an opacity of exactly 0 or 1.
            logit = torch.logit(start.opacities.clamp(1e-4, 1 - 1e-4))
            changed["opacities"] = torch.sigmoid(logit + change["opacities"])
        return replace(start, **changed)


class Refinement:
    """``refinement(gaussians, batch)``: the same Gaussians, nearer to the photographs.

    Splats that overlap blur what they show, and no step of a mean error undoes it: it is small.
    So what is missing of fine detail goes to the colours at last. Low frequencies stay as they are,
    which photographs of other exposures, and wrong geometry, would spoil.

    Args:
        steps: of the optimiser, 1 or more.
        renderer: draws the inputs, with gradients.
        changes: by field, what may change: means in footprints of their pixels, scales by their
            logarithm, opacities by their logit, quaternions, colours. Other fields stay.
        detail: times that fine detail which is missing is added to colours, 0 or more.

    Raises:
        InputError: ``steps`` is below 1.
    """

    def __init__(
        self,
        steps: int,
        renderer: Renderer,
        changes: Mapping[str, Change] = NEAR,
        detail: float = DETAIL,
    ):
        require(steps >= 1, "refine", "1 or more steps", steps)
        self.steps = steps
        self.renderer = renderer
        self.changes = changes
        self.detail = detail

    def __call__(self, gaussians: Gaussians, batch: Batch) -> Gaussians:
        """The refined Gaussians.

        Args:
            gaussians: predicted from ``batch``.
            batch: whose photographs they get nearer to.

        Returns:
            Gaussians in the same order, without a gradient.

        Raises:
            InputError: they do not belong to pixels of ``batch``.
        """
        if self.detail:
            require(gaussians.pixel is not None, "refine", "Gaussians of the inputs' pixels", "others")
        seen = seen_by(batch)
        search = Descent(gaussians, batch, self.changes)
        for _ in range(self.steps):
            search.step(self.renderer, seen)
        return self._detailed(search.gaussians, batch) if self.detail else search.gaussians

    def report(
        self, gaussians: Gaussians, refined: Gaussians, batch: Batch, predict: Callable[[Batch], Gaussians]
    ) -> Report:
        """The gain of a refinement.

        Of four inputs or more the last is held out (two that remain would show too little of a
        person), which takes as long as prediction and refinement.

        Args:
            gaussians: before the refinement.
            refined: after it.
            batch: one element, from which both were predicted.
            predict: gives the Gaussians of a batch, here of the inputs without the last.

        Returns:
            PSNR before and after.
        """
        inputs = tuple(self._psnr(splats, batch) for splats in (gaussians, refined))
        held_out = None
        *seen, hidden = range(batch.images.shape[1])
        if len(seen) > 2:
            others = batch.of_views(seen)
            predicted = predict(others)
            both = predicted, self(predicted, others)
            held_out = tuple(self._psnr(splats, batch.of_views([hidden])) for splats in both)
        return Report(self.steps, inputs, held_out)

    @torch.no_grad()
    def _detailed(self, gaussians: Gaussians, batch: Batch) -> Gaussians:
        """Gaussians whose colours have what their own pixels lack of fine detail: the error there
        without its mean in 3 x 3 pixels, 2 pixels or more within the outline."""
        photographs, silhouettes, cameras = seen_by(batch)
        with exact(gaussians.means.device.type):
            drawn = self.renderer(gaussians, cameras, background=0.0).image
            missing = (photographs - drawn).flatten(0, 1)
            fine = missing - F.avg_pool2d(missing, 3, 1, 1, count_include_pad=False)
        is_inside = -F.max_pool2d(-silhouettes.flatten(0, 1), 5, 1, 2) > WHOLE
        places = gaussians.image * batch.masks[0, 0].numel() + gaussians.pixel
        own = (fine * is_inside).movedim(1, -1).flatten(0, 2)[places]
        change = (self.detail * own).clamp(-DETAIL_LIMIT, DETAIL_LIMIT)
        return replace(gaussians, colors=gaussians.colors + change)

    @torch.no_grad()
    def _psnr(self, gaussians: Gaussians, batch: Batch) -> float:
        photographs, _, cameras = seen_by(batch)
        drawn = self.renderer(gaussians, cameras, background=0.0).image
        images = drawn.flatten(0, 1).clamp(0, 1), photographs.flatten(0, 1)
        return float(psnr(*images, box_of(batch.masks.flatten(0, 1))).mean())


def seen_by(batch: Batch) -> Seen:
    """Photographs on black, silhouettes [B, V, 1, H, W] and cameras of the inputs."""
    return on_black(batch), coverage(batch)[:, :, None], batch.cameras


def _footprints(gaussians: Gaussians, batch: Batch) -> Tensor:
    """Side [N, 1] of a pixel at each Gaussian's depth in its image, in the unit of the world."""
    extrinsics = batch.cameras.extrinsics.flatten(0, 1)
    intrinsics = batch.cameras.intrinsics.flatten(0, 1)
    image = gaussians.image
    dtype = gaussians.means.dtype
    depth = world_to_camera(gaussians.means, extrinsics.to(dtype)[image])[:, 2]
    focal = intrinsics.to(dtype).diagonal(dim1=-2, dim2=-1)[:, :2].prod(-1).sqrt()[image]
    return (depth / focal)[:, None]


def _loss(drawn: Rendering, photographs: Tensor, silhouettes: Tensor, weights: Weights) -> Tensor:
    """Difference of renders and photographs (the paper's L_render, and L1 of silhouettes).

    Args:
        drawn: renders of the inputs.
        photographs: on black [B, V, 3, H, W].
        silhouettes: shares of pixels that show the subject [B, V, 1, H, W].
        weights: of L1, 1 - SSIM (not computed if 0) and L1 of the silhouette.

    Returns:
        A scalar.
    """
    l1, dissimilar, outline = weights
    loss = l1 * (drawn.image - photographs).abs().mean() + outline * (drawn.alpha - silhouettes).abs().mean()
    if not dissimilar:
        return loss
    structure = ssim(drawn.image.flatten(0, 1), photographs.flatten(0, 1), padding="valid").mean()
    return loss + dissimilar * (1 - structure)
