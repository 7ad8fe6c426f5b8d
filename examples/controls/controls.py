"""Recalibration with controls: can an experiment detect effects of 3D neighbours and semantic consistency?

    export GHGS_PLUGINS=examples/controls/controls.py
    ghgs train --config-dir examples/controls/conf sweep=controls

An ablation can only separate its rows if a row that must lose loses, and one that must win wins. Both
use ground truth (depths and bodies of built-in people), so they are a plug-in, which nobody enables
by accident, and not options of the package.
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

#: Residual in metres that becomes a value of 1 in the tokens, whose channels are of that order.
RESIDUAL_UNIT = 0.05
#: Repetitions of the residual's three coordinates in the channels of a token.
COPIES = 8


@dataclass(frozen=True)
class KnownPoints(Points):
    """Points with ground truth of their tokens.

    Attributes:
        residual: from the point of a token to the true surface, in metres; 0 if unknown.
        shares: shares of body parts in the patch of a token.
    """

    residual: Float[Tensor, "N 3"]
    shares: Float[Tensor, "N p"]


@register("unprojection", "known")
class KnownUnprojection(Unprojection):
    """The package's unprojection, with ground truth in addition."""

    def __call__(self, depth_maps: DepthMaps, tokens: Tokens, batch: Batch) -> KnownPoints:
        """Points of pixels and tokens.

        Args:
            depth_maps: as predicted.
            tokens: of the encoder.
            batch: with true depths and bodies in the world frame of the cameras, which all stages must share.

        Raises:
            InputError: the data has no depths or no bodies.
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
    """The package's recalibration with ground-truth part features, followed by a control."""

    control: Literal["none", "shuffled", "residual"] = "none"
    """Change of recalibrated tokens: none | shuffled: the tokens of a subject are permuted (must lose)
    | residual: some channels are the residual from the token's point to the true surface (must win)"""

    def build(self, dim_latent: int) -> "Control":
        return Control(self, dim_latent)


class Control(Recalibration):
    """:class:`Recalibration` whose semantic features are square roots of true shares of parts.

    Their cosine is the overlap of two distributions, similar to that of a trained branch: the most
    similar patch of another view shows the same part in 80 % of the cases.
    """

    def __init__(self, options: ControlOptions, dim_latent: int):
        super().__init__(options, dim_latent)
        self.control = options.control
        # a hook, so that measured neighbourhoods use these features, too
        self.register_forward_pre_hook(_insert_parts)

    def forward(self, tokens: Tokens, points: KnownPoints, plan) -> Tokens:
        """Recalibrate tokens, then change them as ``control`` specifies.

        Args:
            tokens: of the encoder, with part features.
            points: of :class:`KnownUnprojection`.
            plan: as in :class:`Recalibration`.
        """
        tokens = super().forward(tokens, points, plan)
        change = {"none": _keep, "shuffled": _shuffle, "residual": _insert_residual}[self.control]
        return change(tokens, points, self.takes_part(points))


def _insert_parts(stage: Control, inputs: tuple) -> tuple:
    """Inputs of the stage with part features."""
    tokens, points, plan = inputs
    expected = "kind: known, which tells this recalibration what is true"
    require(isinstance(points, KnownPoints), "unprojection", expected, type(points).__name__)
    return dataclasses.replace(tokens, semantic=points.shares.sqrt()), points, plan


def _keep(tokens: Tokens, points: KnownPoints, is_subject: Bool[Tensor, " N"]) -> Tokens:
    return tokens


def _shuffle(tokens: Tokens, points: KnownPoints, is_subject: Bool[Tensor, " N"]) -> Tokens:
    """Permute the tokens of each subject, equally in all layers and all runs."""
    element = tokens.image // tokens.grid[1]
    order = torch.arange(len(element), device=element.device)
    for number in range(tokens.grid[0]):
        own = (is_subject & (element == number)).nonzero()[:, 0]
        turn = torch.randperm(len(own), generator=torch.Generator().manual_seed(0)).to(own.device)
        order[own] = own[turn]
    return dataclasses.replace(tokens, latent=tuple(layer[order] for layer in tokens.latent))


def _insert_residual(tokens: Tokens, points: KnownPoints, is_subject: Bool[Tensor, " N"]) -> Tokens:
    """Replace the first channels of tokens by the true residual."""
    said = (points.residual / RESIDUAL_UNIT).repeat(1, COPIES)
    layers = []
    for layer in tokens.latent:
        layers.append(torch.cat((said.to(layer.dtype), layer[:, said.shape[1] :]), dim=1))
    return dataclasses.replace(tokens, latent=tuple(layers))
