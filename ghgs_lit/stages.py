"""The stages of the method (paper, Figure 2): what each takes and gives, and what a replacement must offer.

A class of one's own takes the place of a stage by registering its options under a new kind
(:func:`ghgs_lit.config.register`). Stages with weights are modules (``torch.nn.Module``).
"""

from typing import Any, Protocol

from jaxtyping import Bool, Float
from torch import Tensor

from ghgs_lit.errors import require
from ghgs_lit.types import (
    Batch,
    Cameras,
    DecodedPixels,
    DepthBounds,
    DepthMaps,
    Gaussians,
    Points,
    Prediction,
    Rendering,
    Tokens,
)

#: The nodes of a configuration that a model is built from, in the order of the data flow.
STAGES = ("bounds", "encoder", "depth_head", "unprojection", "recalibration", "gaussian_head")

#: Stages with weights whose widths follow the encoder's.
HEADS = ("depth_head", "recalibration", "gaussian_head")

#: Nodes that a model may have beside its stages.
OPTIONS = ("rounds", "skip", "model")


class Bounds(Protocol):
    """Near and far of each pixel's ray; options: ``build()``.

    ``is_bounded`` is false for a stage that gives None, which goes with depth heads without bounds.
    """

    is_bounded: bool

    def __call__(self, batch: Batch) -> DepthBounds | None:
        """Bounds of all pixels of photographs of any size."""


class Encoder(Protocol):
    """Photographs to tokens; options: ``build(tokens, margin)``, the patches that take part (``conf/skip``).

    ``dim_latent`` is the width of the tokens' layers, ``patch_size`` the side of a patch in pixels,
    ``bounds_input`` says whether bounds are read. ``tokens`` and ``margin`` can be set: ``keeps`` follows.
    """

    dim_latent: int
    patch_size: int
    bounds_input: bool
    tokens: str
    margin: int

    def __call__(
        self,
        images: Float[Tensor, "B V 3 H W"],
        masks: Bool[Tensor, "B V H W"],
        bounds: DepthBounds | None,
        kept: Bool[Tensor, "B V h w"] | None,
    ) -> Tokens:
        """Tokens of the ``kept`` patches (None: those of ``keeps``)."""

    def keeps(self, masks: Bool[Tensor, "B V H W"]) -> Bool[Tensor, "B V h w"]:
        """Patches that take part."""


class DepthHead(Protocol):
    """Tokens to depths; options: ``build(dim_latent)``.

    ``is_bounded`` says whether depths lie between bounds.
    """

    is_bounded: bool

    def __call__(
        self, tokens: Tokens, batch: Batch, bounds: DepthBounds | None, pixels: DecodedPixels
    ) -> DepthMaps:
        """Depths of all pixels; with ``pixels="subject"`` those of the subject are enough."""


class Unprojection(Protocol):
    """Depths to points in the world; options: ``build()``."""

    def __call__(self, depth_maps: DepthMaps, tokens: Tokens, batch: Batch) -> Points:
        """Points of all pixels and of all tokens."""


class Recalibration(Protocol):
    """Tokens to tokens; options: ``build(dim_latent)``.

    ``tokens`` is ``all`` where background tokens take part: all pixels then need a depth; else ``subject``.
    """

    tokens: DecodedPixels

    def __call__(self, tokens: Tokens, points: Points) -> Tokens:
        """The same tokens with other layers."""


class GaussianHead(Protocol):
    """Tokens to Gaussians in two steps; options: ``build(dim_latent)``.

    What the first step gives is the head's own affair, unless rounds correct it: those need
    :class:`ghgs_lit.heads.gaussian.RawGaussians` with descriptors of width ``channels``.
    """

    channels: int

    def __call__(
        self, tokens: Tokens, batch: Batch, points: Points, depth_maps: DepthMaps, pixels: DecodedPixels
    ) -> Any:
        """Raw attributes of the valid pixels."""

    def activate(self, raw: Any, batch: Batch, points: Points, depth_maps: DepthMaps) -> Gaussians:
        """The Gaussians of raw attributes, with the pixels that they belong to."""


class Renderer(Protocol):
    """Gaussians to images; options: ``build()``."""

    def __call__(self, gaussians: Gaussians, cameras: Cameras) -> Rendering:
        """Images of the Gaussians from cameras [B, T]."""


class Loss(Protocol):
    """What training makes small; options: ``build()``.

    ``reads_depths`` says whether true depths are read, which need not be loaded otherwise.
    """

    reads_depths: bool

    def __call__(
        self, prediction: Prediction, rendering: Rendering, batch: Batch
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The number that is made small, and its terms by name."""


def require_bounds(bounds: Bounds, encoder: Encoder, depth_head: DepthHead, rounds: Any) -> None:
    """Refuse stages that need bounds beside one that gives none, and the other way round. InputError: names
    the stage."""
    head = f"a depth head {'between' if depth_head.is_bounded else 'without'} bounds"
    expected = "none with depth_head.parameterization=inverse_linear, box or hull with all others"
    fits = bounds.is_bounded == depth_head.is_bounded
    require(fits, "bounds", expected, f"{type(bounds).__name__} with {head}")
    sees = encoder.bounds_input and not bounds.is_bounded
    require(not sees, "encoder.bounds_input", "false where bounds is none", True)
    require(rounds is None or bounds.is_bounded, "rounds", "a model with bounds", "bounds=none")
