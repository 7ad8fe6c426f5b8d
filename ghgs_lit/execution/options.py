"""Options of pre- and postprocessing around the stages (``conf/model``)."""

from typing import Literal

from pydantic import Field

from ghgs_lit.config.options import Options, Text


class ModelOptions(Options):
    """Preparation of input views before the stages, and of predictions after them."""

    group = "model"
    name: Text = "paper"
    """Name of the combination of stages, for tables."""
    pad: Literal["none", "multiple"] = "none"
    """multiple: pad images with black up to the next multiple of the patch size, and crop
    predictions again; none: their sides must be multiples."""
    frame: Literal["subject", "world"] = "subject"
    """subject: the stages work in metres around the subject, whatever the world's unit, origin and
    axes; world: in coordinates as they are given."""
    matte: float | None = Field(None, ge=0, le=0.5)
    """Pixels that show a larger share of the subject become Gaussians, and the share is part of
    their colours and opacities; null: masks decide, mattes are ignored."""
    capture: Literal["auto", "off"] = "auto"
    """auto: on CUDA, predictions and training steps of one shape bucket are captured as a CUDA graph
    and replayed; off: every operator is called each time."""

    def side_multiple(self, patch_size: int) -> int:
        """The number of pixels that must divide height and width of input views; 1 with padding.

        Args:
            patch_size: of the encoder, in pixels.
        """
        return 1 if self.pad == "multiple" else patch_size
