"""Preprocessing of a batch (masks from mattes, metres around the subject, a black border up to whole
patches) and its inverse for predictions."""

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
    """Preprocessing of a batch, recorded so that it can be inverted in its prediction.

    Attributes:
        dtype: of the cameras that were given.
        frame: of the subjects; None: the world's.
        padding: of the input views; None: they had whole patches.
    """

    dtype: torch.dtype
    frame: Frame | None
    padding: Padding | None

    def undo(self, prediction: Prediction) -> Prediction:
        """The prediction in the pixels and the world of the batch that was given, without tokens."""
        prediction = replace(prediction, tokens=None)
        if self.padding is not None:
            prediction = self.padding.cut_prediction(prediction)
        return prediction if self.frame is None else self.frame.leave(prediction, self.dtype)


def preprocess(
    batch: Batch, options: ModelOptions, patch_size: int, checks_values: bool
) -> tuple[Batch, Preprocessing, list[Finding]]:
    """The preprocessed batch.

    Args:
        batch: in the cameras' world.
        options: of the preprocessing.
        patch_size: of the encoder, in pixels.
        checks_values: check every value, too.

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


def without_targets(batch: Batch) -> Batch:
    """The batch with what the stages read alone, and nothing that was computed from it.

    Args:
        batch: with or without a border.
    """
    bare = replace(
        batch, cameras=replace(batch.cameras), targets=None, body_vertices=None, subjects=(), views=()
    )
    inner = getattr(batch, "photographs", None)
    return bare if inner is None else replace(bare, photographs=without_targets(inner))
