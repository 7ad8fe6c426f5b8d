"""Rounds: render the input views, compare renders with images, correct the Gaussians.

A single forward pass never verifies its depths and attributes, although the rasterizer renders the
inputs in milliseconds. In each round, every Gaussian is compared with the images at its current
position (:mod:`ghgs_lit.method.rounds.observation`), and a small network with shared weights moves it
along its ray and changes its raw attributes. Learned optimizers of splats use errors of re-rendered
inputs likewise (G3R, Chen et al., ECCV 2024; ReSplat, Xu et al., 2025)."""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import torch
from jaxtyping import Float, Int
from pydantic import Field
from torch import Tensor, nn

from ghgs_lit.config.options import Options, Width
from ghgs_lit.geometry.precision import exact
from ghgs_lit.geometry.projection import at_least_float32, focal_lengths
from ghgs_lit.method.bounds.rays import ray_directions
from ghgs_lit.method.heads.attributes import RAW_VALUES, RawGaussians
from ghgs_lit.method.heads.gaussian import float32_last
from ghgs_lit.method.rounds.exchange import Exchange, Windows
from ghgs_lit.method.rounds.gains import equalize
from ghgs_lit.method.rounds.observation import SLOPES, observe, slopes
from ghgs_lit.ops.activation import bounded_tanh
from ghgs_lit.ops.linear import Linear
from ghgs_lit.ops.observation import CHANNELS
from ghgs_lit.ops.photo_consistency import consistency_of
from ghgs_lit.ops.round_memory import update_memory
from ghgs_lit.types import Batch, DepthMaps, Gaussians, Points, Prediction, Tokens

#: Largest distance from the current depth that the first round tests, as a fraction of far - near.
REACH = 0.25
#: Channels of a Gaussian's position: between near and far (0 to 1), and far - near.
_PLACE = 2


class Rays(NamedTuple):
    """Flat indices of the Gaussians' pixels, and displacements of their rays per metre of depth."""

    place: Int[Tensor, " N"]
    direction: Float[Tensor, "N 3"]

    @classmethod
    def of(cls, raw: RawGaussians, batch: Batch) -> "Rays":
        """Rays of the Gaussians' pixels."""
        place = raw.image * batch.masks[0, 0].numel() + raw.pixel
        with exact(raw.pixel.device.type):
            return cls(place, ray_directions(batch.cameras).flatten(0, 3)[place])


@dataclass(frozen=True)
class State:
    """Input and output of a round; the first state is the prediction of the stages, before Gaussians are
    activated."""

    raw: RawGaussians
    gaussians: Gaussians | None
    points: Points
    depth_maps: DepthMaps

    def activate_with(self, activate: "Activate", batch: Batch) -> "State":
        """Compute the Gaussians of the raw attributes."""
        gaussians = activate(self.raw, batch, self.points, self.depth_maps)
        return dataclasses.replace(self, gaussians=gaussians)


def prediction_of(states: Sequence[State], tokens: Tokens) -> Prediction:
    """Build the prediction of the last state.

    Args:
        states: states before the first round and after each.
        tokens: tokens of the encoder.
    """
    last = states[-1]
    maps = tuple(state.depth_maps for state in states)
    depth = maps[-1].depth
    valid = maps[-1].valid
    return Prediction(last.gaussians, depth, valid, last.points, maps[-1], maps, tokens)


#: Gaussians from raw attributes at points: ``GaussianHead.activate``.
Activate = Callable[[RawGaussians, Batch, Points, DepthMaps], Gaussians]


#: A number of rounds.
Number = Annotated[int, Field(ge=1, le=32)]


class RoundsOptions(Options):
    """Rounds that render the input views, compare renders with images and correct the Gaussians."""

    group = "rounds"
    count: Number = 2
    """Number of rounds in prediction, up to 32; steps halve with each round."""
    training_counts: Annotated[tuple[Number, ...], Field(min_length=1)] = (1, 2, 3)
    """Numbers of rounds from which each training step samples one, so that any number works."""
    hidden: Width = 48
    """Width of the network."""
    depths: int = Field(8, ge=1, le=4096)
    """Number of depths around the current one at which a round compares the images; 4096 is finer than
    their pixels."""
    gains: bool = True
    """Estimate and remove differences of exposure between cameras first, unless the rig's gains are
    given."""
    exchange: Width | None = 16
    """Feature channels that Gaussians of neighbouring pixels exchange; null: no exchange."""

    slopes: bool = False
    """Whether the gradient of the inputs' error with respect to each Gaussian is an input of a round."""
    height: Literal["auto"] | Annotated[int, Field(ge=14, le=16384)] | None = "auto"
    """Height of the subject in training, or its width if larger, in pixels; auto: four fifths of the
    largest image side in training. Larger images of taller subjects are downsampled for the stages, and
    the resulting depths and tokens initialise the rounds at full size
    (:mod:`ghgs_lit.method.rounds.coarse`); null: never."""

    def build(self, channels: int) -> "Rounds":
        """Build the rounds after a Gaussian head with descriptors of width ``channels``."""
        return Rounds(self, channels)


class NoRounds(nn.Module):
    """Stage of a model without rounds, which predicts the Gaussians of the Gaussian head."""

    height = None

    def forward(self, state: State, activate: Activate, batch: Batch, step: float = 1.0) -> tuple[State, ...]:
        """The only state, with its Gaussians; arguments as for :meth:`Rounds.forward`."""
        return (state.activate_with(activate, batch),)

    def fix_count(self, count: int | None = None) -> AbstractContextManager[None]:
        """Context of a training step; nothing is sampled."""
        return nullcontext()


def _two_layers(inputs: int, wide: int, outputs: int) -> nn.Sequential:
    first = nn.Linear(inputs, wide)
    second = nn.Linear(wide, outputs)
    return nn.Sequential(first, nn.ReLU(inplace=True), second, nn.ReLU(inplace=True))


class Rounds(nn.Module):
    """Corrects Gaussians in several rounds with shared weights; initially changes nothing.

    Each round can change half as much as the one before, depths stay between near and far, and
    attributes within the bounds of their activations: more rounds than in training do not diverge.
    The attribute ``count``, the number of rounds in evaluation, may be changed at any time.

    Args:
        options: options of the rounds.
        channels: width of the Gaussian head's descriptors.
    """

    def __init__(self, options: RoundsOptions, channels: int):
        super().__init__()
        self.options = options
        self.count = options.count
        self._known_count: int | None = None
        hidden = options.hidden
        depths = options.depths
        self.view = _two_layers(CHANNELS, hidden, hidden)
        self.start = Linear(channels, hidden)
        inputs = 4 * hidden + depths + _PLACE + 3 + (SLOPES if options.slopes else 0)
        self.update = _two_layers(inputs, 2 * hidden, hidden)
        self.memory = nn.Linear(hidden, hidden)
        self.exchange = None if options.exchange is None else Exchange(hidden, options.exchange)
        self.change = nn.Sequential(Linear(hidden, 1 + RAW_VALUES))
        nn.init.zeros_(self.change[-1].weight)
        nn.init.zeros_(self.change[-1].bias)

    @property
    def height(self) -> int | None:
        """Height of the subject in training in pixels; None: images are never downsampled, or the height
        is unknown."""
        known = self.options.height
        return None if known == "auto" else known

    def forward(
        self,
        state: State,
        activate: Activate,
        batch: Batch,
        step: float | Float[Tensor, " B"] = 1.0,
    ) -> tuple[State, ...]:
        """Run the rounds; returns the states before the first round and after each.

        Args:
            state: prediction of the stages, with bounds of depths.
            activate: converts raw attributes to Gaussians.
            batch: images, masks and cameras are read.
            step: factor of the first step in depth, for all elements or for each; 1 after a depth head.
                Attributes always take full steps.
        """
        # The next round replaces these Gaussians: the loss needs no gradient of them.
        draft = torch.no_grad()(activate) if self.training else activate
        if state.gaussians is None:
            state = state.activate_with(draft, batch)
        if self.options.gains and batch.log_gains is None:
            gaussians, batch = equalize(state.gaussians, batch, state.raw.real)
            state = dataclasses.replace(state, gaussians=gaussians)
        states = [state]
        memory = torch.tanh(self.start(state.raw.descriptors))
        windows = None if self.exchange is None else Windows.of(state.raw, batch)
        rays = Rays.of(state.raw, batch)
        if isinstance(step, Tensor):
            step = step[state.raw.image // batch.masks.shape[1]]
        count = (self._known_count or self._sample_count()) if self.training else self.count
        for number in range(count):
            share = 0.5**number
            change, memory = self._round(states[-1], batch, rays, memory, windows, share, step * share)
            shown = activate if number == count - 1 else draft
            states.append(_apply_changes(states[-1], shown, batch, rays, *change))
        return tuple(states)

    @contextmanager
    def fix_count(self, count: int | None = None) -> Iterator[None]:
        """Context that fixes the number of rounds of a training step.

        Args:
            count: the number; None: the one already fixed, else a sampled one.
        """
        before = self._known_count
        self._known_count = count or before or self._sample_count()
        try:
            yield
        finally:
            self._known_count = before

    def _sample_count(self) -> int:
        """Sample the number of rounds of a training step."""
        counts = self.options.training_counts
        return counts[int(torch.randint(len(counts), ()))]

    def _round(
        self,
        state: State,
        batch: Batch,
        rays: Rays,
        memory: Float[Tensor, "N h"],
        windows: Windows | None,
        share: float,
        size: float | Float[Tensor, " N"],
    ) -> tuple[tuple[Tensor, Tensor], Tensor]:
        """Compute the changes of one round.

        Args:
            state: state before the round.
            batch: images, masks and cameras are read.
            rays: rays of the Gaussians' pixels.
            memory: features of the previous rounds.
            windows: positions of the Gaussians in maps; None: no exchange.
            share: factor of the changes of attributes.
            size: factor of the largest step in depth, for all Gaussians or for each.

        Returns:
            Changes of depths in metres [N] and of raw attributes [N, c], and the memory for the next
            round.
        """
        gaussians = state.gaussians.detach()
        drawn = None
        steep = []
        if self.options.slopes:
            drawn, *steep = slopes(gaussians, batch, rays.direction, _footprints(state, batch, rays))
        each = observe(gaussians, batch, drawn)
        matches, place, down, up = self._search(state, batch, rays, size * REACH)
        known = torch.cat((matches, place, gaussians.colors, *steep), -1)
        memory = update_memory(self._layers, each, known, memory)
        memory = memory if windows is None else self.exchange(memory, windows)
        change = float32_last(self.change, memory)
        step = bounded_tanh(change[:, 0])
        moved = torch.where(step > 0, up, down) * step
        return (moved, share * change[:, 1:]), memory

    @property
    def _layers(self) -> tuple[nn.Linear, ...]:
        """Weights for :func:`ghgs_lit.ops.round_memory.update_memory`."""
        return self.view[0], self.view[2], self.update[0], self.update[2], self.memory

    @torch.no_grad()
    def _search(
        self, state: State, batch: Batch, rays: Rays, reach: float | Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Photo-consistency of depths around the current ones, within their bounds.

        Args:
            state: state before the round.
            batch: images, masks and cameras are read.
            rays: rays of the Gaussians' pixels.
            reach: largest distance as a fraction of far - near, for all Gaussians or for each.

        Returns:
            Photo-consistency [N, s] at depths from ``down`` metres in front of each Gaussian to ``up``
            metres behind it; position between near and far (0 to 1) and far - near in metres [N, 2];
            ``down`` [N]; ``up`` [N].
        """
        maps = state.depth_maps
        depth, near, far = (
            at_least_float32(values).detach().flatten()[rays.place]
            for values in (maps.depth, maps.bounds.near, maps.bounds.far)
        )
        thickness = far - near
        half = reach * thickness
        share = (depth - near) / torch.where(thickness > 0, thickness, 1)
        # Through rounding, a depth may lie slightly outside its bounds.
        low = torch.minimum(torch.maximum(depth - half, near), depth)
        high = torch.minimum(depth + half, far)
        high = torch.maximum(high, depth)
        matches = consistency_of(batch, rays.place, low, high, self.options.depths)
        return matches, torch.stack((share, thickness), -1), depth - low, high - depth


@torch.no_grad()
def _footprints(state: State, batch: Batch, rays: Rays) -> Tensor:
    """Size [N, 1] of a pixel at each Gaussian's depth, in the unit of depth."""
    focal = focal_lengths(batch.cameras).prod(-1).sqrt().flatten()
    depth = at_least_float32(state.depth_maps.depth).flatten()[rays.place]
    return (depth / focal[state.raw.image])[:, None]


def _apply_changes(
    state: State,
    activate: Activate,
    batch: Batch,
    rays: Rays,
    moved: Float[Tensor, " N"],
    change: Float[Tensor, "N c"],
) -> State:
    """Apply the changes of a round: depths by ``moved`` metres along the rays, raw attributes by
    ``change``."""
    raw = state.raw.add_change(change)
    maps = state.depth_maps
    pixels = state.points.pixels
    if raw.real is not None:
        moved = moved * raw.real
    depth = maps.depth.flatten().index_add(0, rays.place, moved).view_as(maps.depth)
    maps = dataclasses.replace(maps, depth=depth)
    pixels = pixels.flatten(0, 3).index_add(0, rays.place, moved[:, None] * rays.direction).view_as(pixels)
    points = dataclasses.replace(state.points, pixels=pixels)
    return State(raw, activate(raw, batch, points, maps), points, maps)
