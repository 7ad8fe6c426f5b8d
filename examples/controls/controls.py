"""Recalibration with controls: can this experiment see what 3D neighbours and semantic
consistency do?

    export GHGS_PLUGINS=examples/controls/controls.py
    ghgs train --config-dir examples/controls/conf sweep=controls

Rows of the ablation can be told apart only where a row that must lose loses, and one that must win
wins. Both read what a prediction cannot know (true depths and bodies of built-in people), so they
are a plug-in and no options of the package: nobody meets them by accident.
"""

import dataclasses
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghgs_lit.config import register
from ghgs_lit.errors import require
from ghgs_lit.geometry.unprojection import Unprojection
from ghgs_lit.method.recalibration import Recalibration, RecalibrationOptions
from ghgs_lit.training.pretext import part_shares
from ghgs_lit.types import Batch, DepthMaps, Points, Tokens

#: A residual of this length, in metres, is a value of 1 in the tokens,
#: whose channels are of that order.
RESIDUAL_UNIT = 0.05
#: Channels of a token that hold the residual: its three coordinates, eight times.
COPIES = 8


@dataclass(frozen=True)
class KnownPoints(Points):
    """Points with what is true of their tokens.

    Attributes:
        residual: from the point of a token to where the photographed surface is, in metres;
            0 if unknown.
        shares: of the parts of the body in the patch of a token.
    """

    residual: Float[Tensor, "N 3"]
    shares: Float[Tensor, "N p"]


@register("unprojection", "known")
class KnownUnprojection(Unprojection):
    """As in the package, with the truth beside it."""

    def __call__(self, depth_maps: DepthMaps, tokens: Tokens, batch: Batch) -> KnownPoints:
        """Points of pixels and tokens.

        Args:
            depth_maps: as predicted.
            tokens: of the encoder.
            batch: with true depths and bodies in the cameras' world, which the stages must share.

        Raises:
            InputError: the data knows no depths or no bodies.
        """
        require(batch.depths is not None, "loss", "loss=depth, with which true depths are read", "none")
        points = super().__call__(depth_maps, tokens, batch)
        known = depth_maps.valid & (batch.depths > 0)
        surface = super().__call__(
            dataclasses.replace(depth_maps, depth=batch.depths, valid=known), tokens, batch
        )
        residual = torch.where(surface.tokens_valid[:, None], surface.tokens - points.tokens, 0).detach()
        height, width = tokens.grid[2:]
        patch = (tokens.image * height + tokens.row) * width + tokens.column
        shares = part_shares(batch, tokens.patch_size)[patch]
        return KnownPoints(**vars(points), residual=residual, shares=shares)


@register("recalibration", "control")
class ControlOptions(RecalibrationOptions):
    """The recalibration of the package on features that know parts,
    and what must lose or win after it."""

    control: Literal["none", "shuffled", "residual"] = "none"
    """What is done to recalibrated tokens: none | shuffled: the tokens of a subject change
    places (must lose)
    | residual: some channels say how far the token's point is from the true surface (must win)"""

    def build(self, dim_latent: int) -> "Control":
        return Control(self, dim_latent)


class Control(Recalibration):
    """:class:`Recalibration` whose semantic features are roots of true shares of parts.

    Their cosine is the overlap of two distributions, as that of a trained branch: the most similar
    patch of another view shows the same part in 80 % of the cases.
    """

    def __init__(self, options: ControlOptions, dim_latent: int):
        super().__init__(options, dim_latent)
        self.control = options.control
        # a hook: pictures of attention see these features, too
        self.register_forward_pre_hook(_with_parts)

    def forward(self, tokens: Tokens, points: KnownPoints, plan) -> Tokens:
        """Recalibrated tokens, changed as ``control`` says.

        Args:
            tokens: of the encoder, with features that know parts.
            points: of :class:`KnownUnprojection`.
            plan: as of :class:`Recalibration`.
        """
        tokens = super().forward(tokens, points, plan)
        change = {"none": _unchanged, "shuffled": _shuffled, "residual": _with_residual}[self.control]
        return change(tokens, points, self.takes_part(points))


def _with_parts(stage: Control, inputs: tuple) -> tuple:
    """Inputs of the stage with features that know parts."""
    tokens, points, plan = inputs
    expected = "kind: known, which tells this recalibration what is true"
    require(isinstance(points, KnownPoints), "unprojection", expected, type(points).__name__)
    return dataclasses.replace(tokens, semantic=points.shares.sqrt()), points, plan


def _unchanged(tokens: Tokens, points: KnownPoints, is_subject: Bool[Tensor, " N"]) -> Tokens:
    return tokens


def _shuffled(tokens: Tokens, points: KnownPoints, is_subject: Bool[Tensor, " N"]) -> Tokens:
    """Tokens of each subject in a random order, the same in all layers and in all runs."""
    element = tokens.image // tokens.grid[1]
    order = torch.arange(len(element), device=element.device)
    for number in range(tokens.grid[0]):
        own = (is_subject & (element == number)).nonzero()[:, 0]
        turn = torch.randperm(len(own), generator=torch.Generator().manual_seed(0)).to(own.device)
        order[own] = own[turn]
    return dataclasses.replace(tokens, latent=tuple(layer[order] for layer in tokens.latent))


def _with_residual(tokens: Tokens, points: KnownPoints, is_subject: Bool[Tensor, " N"]) -> Tokens:
    """Tokens whose first channels are the true residual."""
    said = (points.residual / RESIDUAL_UNIT).repeat(1, COPIES)
    layers = []
    for layer in tokens.latent:
        layers.append(torch.cat((said.to(layer.dtype), layer[:, said.shape[1] :]), dim=1))
    return dataclasses.replace(tokens, latent=tuple(layers))
