"""Flicker of what a method renders of people in motion."""

import numpy as np
import torch
from torch import Tensor

from ghgs_lit.data.batches import BatchBuilder
from ghgs_lit.metrics.flicker import flicker
from ghgs_lit.runs.results import Row
from ghgs_lit.types import Batch, Cameras


class Flickers:
    """Compares each instant with the one before, if that came just before. ``builder``: of the split."""

    def __init__(self, builder: BatchBuilder) -> None:
        self._builder, self._last = builder, ("", ())

    def __call__(self, batch: Batch, image: Tensor) -> list[Row]:
        """For each subject and target of ``image`` [B, T, 3, h, w]: its ``flicker``, where there is one."""
        return [row for element in range(len(image)) for row in self._element(batch, image[element], element)]

    def _element(self, batch: Batch, image: Tensor, element: int) -> list[Row]:
        targets, subject = batch.targets, batch.subjects[element]
        points = self._builder.inputs.reader.read_surface(subject)
        if points is None:
            return [{}] * len(image)
        photos = [map(int, name.split("/")) for name in targets.names[element]]
        depths = np.stack([self._builder.targets.view(subject, *photo).depth for photo in photos])
        errors, cameras = image.clamp(0, 1) - targets.images[element], targets.cameras[element]
        surface = (errors.new_tensor(points), errors.new_tensor(depths))
        (last, before), now = self._last, (errors, *surface, cameras.intrinsics, cameras.extrinsics)
        self._last = (subject, now)
        if last != f"{subject[:-3]}{int(subject[-3:]) - 1:03d}":
            return [{}] * len(image)
        *both, intrinsics, extrinsics = map(torch.stack, zip(before, now, strict=True))
        values = flicker(*both, Cameras(intrinsics, extrinsics, cameras.height, cameras.width))
        return [{"flicker": value} for value in values.tolist()]
