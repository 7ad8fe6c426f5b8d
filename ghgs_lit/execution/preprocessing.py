"""Preprocessing of a batch (masks from mattes, the subject's frame, padding to whole patches) and its
inverse for predictions."""

from dataclasses import dataclass, replace

import torch

from ghgs_lit.execution.checks import Finding, findings_of
from ghgs_lit.execution.options import ModelOptions
from ghgs_lit.geometry.frame import Frame
from ghgs_lit.geometry.masks import with_matte
from ghgs_lit.geometry.padding import Padding, pad_to_patches
from ghgs_lit.types import Batch, Prediction


@dataclass(frozen=True)
class Preprocessing:
    """Record of a batch's preprocessing, to invert it in the prediction.

    Attributes:
        dtype: dtype of the original cameras.
        frame: frame of the subjects; None: the world.
        padding: padding of the input views; None: no padding.
    """

    dtype: torch.dtype
    frame: Frame | None
    padding: Padding | None

    def undo(self, prediction: Prediction) -> Prediction:
        """Convert a prediction to the pixels and the world of the original batch, without tokens."""
        prediction = replace(prediction, tokens=None)
        if self.padding is not None:
            prediction = self.padding.cut_prediction(prediction)
        return prediction if self.frame is None else self.frame.leave(prediction, self.dtype)


def preprocess(
    batch: Batch, options: ModelOptions, patch_size: int, checks_values: bool
) -> tuple[Batch, Preprocessing, list[Finding]]:
    """Preprocess a batch.

    Args:
        batch: in the cameras' world.
        options: options of the preprocessing.
        patch_size: patch size of the encoder in pixels.
        checks_values: also check every value.

    Returns:
        The batch, its preprocessing, and findings about its values, to be read later.

    Raises:
        InputError: a shape or a dtype is wrong.
    """
    findings = findings_of(batch, options.side_multiple(patch_size), checks_values)
    dtype = batch.cameras.extrinsics.dtype
    batch = with_matte(batch, options.matte)
    frame = Frame.of(batch) if options.frame == "subject" else None
    batch = batch if frame is None else frame.enter(batch)
    padding = pad_to_patches(batch.masks, patch_size) if options.pad == "multiple" else None
    batch = batch if padding is None else padding.pad_batch(batch)
    return batch, Preprocessing(dtype, frame, padding), findings


def strip_targets(batch: Batch) -> Batch:
    """Copy a batch, padded or not, with only the fields that the stages read, and without cached values."""
    bare = replace(
        batch, cameras=replace(batch.cameras), targets=None, body_vertices=None, subjects=(), views=()
    )
    inner = getattr(batch, "photographs", None)
    return bare if inner is None else replace(bare, photographs=strip_targets(inner))
