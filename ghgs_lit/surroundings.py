"""What surrounds the stages: a batch is prepared on its way in, a prediction brought back on its way out."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Literal

import torch
from jaxtyping import Bool
from pydantic import Field
from torch import Tensor

from ghgs_lit.batch_checks import check_batch
from ghgs_lit.config.options import Options, Text
from ghgs_lit.geometry.frame import Frame
from ghgs_lit.geometry.mattes import with_matte
from ghgs_lit.geometry.padding import pad_to_patches
from ghgs_lit.kernels.precision import precision_of
from ghgs_lit.skipping import AutoSkip
from ghgs_lit.stages import Encoder
from ghgs_lit.types import Batch, Decision, Prediction


class ModelOptions(Options):
    """What happens to photographs before the stages see them, and to predictions after them."""

    group = "model"
    name: Text = "paper"
    """Name of the combination of stages, for tables."""
    pad: Literal["none", "multiple"] = "none"
    """multiple: photographs get a black border up to the next multiple of the patch size, which is cut off
    again; none: their sides must be multiples."""
    frame: Literal["subject", "world"] = "subject"
    """subject: the stages work in metres around the subject, whatever the world's unit, origin and axes;
    world: in coordinates as they are given."""
    matte: float | None = Field(None, ge=0, le=0.5)
    """Pixels that show a larger share of the subject become Gaussians, whose colours and opacities know that
    share; null: masks decide, mattes are ignored."""


class Surrounding:
    """One layer around the stages, of one batch: what it knows from entering it uses when leaving."""

    def enter(self, batch: Batch) -> Batch:
        """The batch as what lies inside sees it."""
        return batch

    def leave(self, prediction: Prediction) -> Prediction:
        """What lies inside predicts, as what lies outside sees it."""
        return prediction


class Checks(Surrounding):
    """Refuses what the stages cannot work on (:func:`check_batch`)."""

    def __init__(self, side_multiple: int, values: bool) -> None:
        self.side_multiple, self.values = side_multiple, values

    def enter(self, batch: Batch) -> Batch:
        check_batch(batch, self.side_multiple, self.values)
        return batch


class Mattes(Surrounding):
    """Masks become those of soft mattes (:mod:`ghgs_lit.geometry.mattes`)."""

    def __init__(self, least: float | None) -> None:
        self.least = least

    def enter(self, batch: Batch) -> Batch:
        return with_matte(batch, self.least)


class SubjectFrame(Surrounding):
    """Metres around the subject inside, the cameras' world outside (:mod:`ghgs_lit.geometry.frame`)."""

    def enter(self, batch: Batch) -> Batch:
        self.frame, self.dtype = Frame.of(batch), batch.cameras.extrinsics.dtype
        return self.frame.enter(batch)

    def leave(self, prediction: Prediction) -> Prediction:
        return self.frame.leave(prediction, self.dtype)


class Border(Surrounding):
    """Photographs of whole patches inside (:mod:`ghgs_lit.geometry.padding`)."""

    def __init__(self, patch_size: int) -> None:
        self.patch_size = patch_size

    def enter(self, batch: Batch) -> Batch:
        self.padding = pad_to_patches(batch.masks, self.patch_size)
        return batch if self.padding is None else self.padding.pad_batch(batch)

    def leave(self, prediction: Prediction) -> Prediction:
        return prediction if self.padding is None else self.padding.cut_prediction(prediction)


def side_multiple(options: ModelOptions, patch_size: int) -> int:
    """What height and width of photographs must be divisible by, in pixels."""
    return 1 if options.pad == "multiple" else patch_size


def surroundings(options: ModelOptions, patch_size: int, checks_values: bool) -> Sequence[Surrounding]:
    """All that surrounds the stages for one batch, from the outside to the inside."""
    return [
        Checks(side_multiple(options, patch_size), checks_values),
        Mattes(options.matte),
        *([SubjectFrame()] if options.frame == "subject" else []),
        *([Border(patch_size)] if options.pad == "multiple" else []),
    ]


@contextmanager
def computing(
    precision: str, auto: AutoSkip | None, encoder: Encoder, masks: Bool[Tensor, "B V H W"]
) -> Iterator[tuple[tuple[Decision, ...], Bool[Tensor, "B V h w"] | None]]:
    """How much is computed while the context lasts: in which precision, and which patches take part.

    Args:
        precision: one of :data:`ghgs_lit.kernels.precision.PRECISIONS`.
        auto: chooses what the encoder sees of each subject (``skip=auto``); None: the encoder does itself.

    Yields:
        The choices, and the patches that take part, None where the encoder decides.
    """
    decisions, kept = ((), None) if auto is None else auto.decide(encoder, masks)
    with precision_of(precision, torch.device(masks.device)):
        yield decisions, kept
