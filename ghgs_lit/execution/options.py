"""Options of pre- and postprocessing around the stages (``conf/model``)."""

from typing import Literal

from pydantic import Field

from ghgs_lit.config.options import Options, Text


class ModelOptions(Options):
    """Pre- and postprocessing around the stages."""

    group = "model"
    name: Text = "paper"
    """Name of the model, for tables."""
    pad: Literal["none", "multiple"] = "none"
    """multiple: pad images with black to the next multiple of the patch size, and crop predictions; none:
    image sides must be multiples."""
    frame: Literal["subject", "world"] = "subject"
    """Coordinates of the stages: subject: metres around the subject, whatever the world's unit, origin and
    axes; world: as given."""
    matte: float | None = Field(None, ge=0, le=0.5)
    """Pixels with a larger matte become Gaussians, and the matte enters their colours and opacities; null:
    use masks and ignore mattes."""
    capture: Literal["auto", "off"] = "auto"
    """auto: on CUDA, capture predictions and training steps of each shape bucket as a CUDA graph and replay
    it; off: launch every operator."""

    def side_multiple(self, patch_size: int) -> int:
        """Number of pixels that must divide height and width of input views: the encoder's patch size, or 1
        with padding."""
        return 1 if self.pad == "multiple" else patch_size
