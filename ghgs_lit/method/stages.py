"""Interfaces of the stages of the method (paper, Figure 2), which a replacement must implement.

To replace a stage, register the options of a class under a new kind
(:func:`ghgs_lit.config.register`). Stages with weights are modules (``torch.nn.Module``)."""

from typing import Any, Protocol

from jaxtyping import Bool, Float
from torch import Tensor

from ghgs_lit.errors import require
from ghgs_lit.method.plan import Plan
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

#: Nodes of a configuration that a model requires, in the order of the data flow.
STAGES = ("bounds", "encoder", "depth_head", "unprojection", "recalibration", "gaussian_head")

#: Stages with weights whose widths follow the encoder's.
HEADS = ("depth_head", "recalibration", "gaussian_head")

#: Optional nodes of a model, in addition to its stages.
OPTIONS = ("rounds", "skip", "model")


class Bounds(Protocol):
    """Near and far of each pixel's ray; options: ``build()``.

    Attributes:
        is_bounded: False if the stage returns None, which requires a depth head without bounds.
    """

    is_bounded: bool

    def __call__(self, batch: Batch) -> DepthBounds | None:
        """Bounds of all pixels.

        Args:
            batch: masks and cameras are read; images may have any size.

        Returns:
            Near and far [B, V, H, W] in metres; None if ``is_bounded`` is False.
        """


class Encoder(Protocol):
    """Input views to tokens; options: ``build(tokens, margin)``,
    which select the patches (``conf/skip``).

    Attributes:
        dim_latent: width of a layer of the tokens.
        patch_size: side of a patch in pixels.
        bounds_input: whether bounds are an input.
        tokens: which patches have tokens; mutable, like ``margin``, and affects :meth:`keeps`.
        margin: number of patches around these that also have tokens.
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
        plan: Plan,
    ) -> Tokens:
        """Tokens of the patches ``plan.kept``, in the order of image, row, column.

        Args:
            images: in [0, 1]; sides are divisible by ``patch_size``.
            masks: the subject's pixels.
            bounds: bounds of all pixels, used if ``bounds_input``; None in models without bounds.
            plan: selects the patches that become tokens.
        """

    def keeps(self, masks: Bool[Tensor, "B V H W"]) -> Bool[Tensor, "B V h w"]:
        """Patches that have tokens.

        Args:
            masks: the subject's pixels; sides are divisible by ``patch_size``.
        """


class DepthHead(Protocol):
    """Tokens to depths; options: ``build(dim_latent)``.

    Attributes:
        is_bounded: whether depths lie between bounds, which are then required.
    """

    is_bounded: bool

    def __call__(self, tokens: Tokens, batch: Batch, bounds: DepthBounds | None, plan: Plan) -> DepthMaps:
        """Depths of all pixels; only those within ``plan.depth_windows`` need to be meaningful.

        Args:
            tokens: of the encoder.
            batch: images, masks and cameras are read.
            bounds: bounds of all pixels; None if ``is_bounded`` is False.
            plan: selects the pixels that need depths.

        Returns:
            Depths [B, V, H, W] in metres, between the bounds if any, and a mask of valid pixels.
        """


class Unprojection(Protocol):
    """Depths to points in the world; options: ``build()``."""

    def __call__(self, depth_maps: DepthMaps, tokens: Tokens, batch: Batch) -> Points:
        """Points of all pixels and of all tokens.

        Args:
            depth_maps: in metres.
            tokens: tokens of the encoder; their patches get points, too.
            batch: cameras are read.
        """


class Recalibration(Protocol):
    """Tokens to tokens; options: ``build(dim_latent)``.

    Attributes:
        tokens: ``all``: background tokens are recalibrated, too, so that all pixels need depths;
            ``subject``: only tokens of the subject.
    """

    tokens: DecodedPixels

    def __call__(self, tokens: Tokens, points: Points, plan: Plan) -> Tokens:
        """Recalibrate the layers of tokens.

        Args:
            tokens: tokens of the encoder.
            points: points of pixels and tokens in the world, in metres.
            plan: tokens in ``peers`` with valid points are recalibrated.
        """


class GaussianHead(Protocol):
    """Tokens to Gaussians in two steps; options: ``build(dim_latent)``.

    The first step may return any type, but rounds require
    :class:`ghgs_lit.method.heads.attributes.RawGaussians`.

    Attributes:
        channels: width of the descriptors in the raw attributes.
    """

    channels: int

    def __call__(
        self, tokens: Tokens, batch: Batch, points: Points, depth_maps: DepthMaps, plan: Plan
    ) -> Any:
        """Predict raw attributes of the valid pixels in ``plan.subject``, the input of :meth:`activate`.

        Args:
            tokens: recalibrated tokens.
            batch: images, masks and cameras are read.
            points: points of pixels in the world, in metres.
            depth_maps: in metres.
            plan: selects the pixels that become Gaussians, and the windows to decode.
        """

    def activate(self, raw: Any, batch: Batch, points: Points, depth_maps: DepthMaps) -> Gaussians:
        """Convert raw attributes to Gaussians with the indices of their pixels.

        Args:
            raw: result of the first step, possibly changed by rounds.
            batch: images, mattes and cameras are read.
            points: points of pixels in the world, in metres, possibly moved by rounds.
            depth_maps: depths of these points, in metres.
        """


#: Interface of each stage.
INTERFACES = dict(
    zip(STAGES, (Bounds, Encoder, DepthHead, Unprojection, Recalibration, GaussianHead), strict=True)
)


class Renderer(Protocol):
    """Gaussians to images; options: ``build()``."""

    def __call__(self, gaussians: Gaussians, cameras: Cameras) -> Rendering:
        """Render Gaussians of B elements, in the world of the cameras [B, T].

        Returns:
            Images [B, T, C, h, w], with alpha and depth [B, T, 1, h, w].
        """


class Loss(Protocol):
    """The training objective; options: ``build()``.

    Attributes:
        reads_depths: whether true depths must be loaded.
    """

    reads_depths: bool

    def __call__(
        self, prediction: Prediction, rendering: Rendering, batch: Batch
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the scalar that training minimises, and its terms by name.

        Args:
            prediction: prediction of the model.
            rendering: its Gaussians rendered from the targets' cameras.
            batch: images and targets, and bodies and depths if the data set has them.
        """


def require_bounds(bounds: Bounds, encoder: Encoder, depth_head: DepthHead, rounds: Any) -> None:
    """Reject stages that require bounds in a model without them, and vice versa.

    Args:
        bounds: the bounds stage.
        encoder: may take bounds as an input.
        depth_head: predicts depths with or without bounds.
        rounds: require bounds; None: no rounds.

    Raises:
        InputError: stages are incompatible; the message names the option.
    """
    head = f"a depth head {'between' if depth_head.is_bounded else 'without'} bounds"
    expected = "none with depth_head.parameterization=inverse_linear, box or hull with all others"
    fits = bounds.is_bounded == depth_head.is_bounded
    require(fits, "bounds", expected, f"{type(bounds).__name__} with {head}")
    sees = encoder.bounds_input and not bounds.is_bounded
    require(not sees, "encoder.bounds_input", "false where bounds is none", True)
    require(rounds is None or bounds.is_bounded, "rounds", "a model with bounds", "bounds.kind=none")
