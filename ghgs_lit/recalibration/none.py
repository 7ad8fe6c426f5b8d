"""No recalibration: tokens stay as the encoder gives them."""

from torch import nn

from ghgs_lit.config.options import Options
from ghgs_lit.types import DecodedPixels, Points, Tokens


class NoRecalibrationOptions(Options):
    """Tokens stay as they are: for methods without attention across views behind the encoder."""

    group = "recalibration"

    def build(self, dim_latent: int) -> "NoRecalibration":
        return NoRecalibration()


class NoRecalibration(nn.Module):
    """Gives the tokens back."""

    tokens: DecodedPixels = "subject"

    def forward(self, tokens: Tokens, points: Points) -> Tokens:
        return tokens
