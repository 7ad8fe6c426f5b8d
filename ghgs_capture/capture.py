"""A user's photographs of one instant, and their conversion to a model's input batch."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ghgs_capture.crops import Photograph, crop_to_subject
from ghgs_capture.folder import CaptureFolder
from ghgs_lit.errors import require
from ghgs_lit.method.rounds.gains import divide_by_gains
from ghgs_lit.types import Batch, Cameras


@dataclass(frozen=True)
class Capture:
    """Photographs of one instant, two or more."""

    name: str
    photographs: tuple[Photograph, ...]

    @classmethod
    def read(cls, images: str | Path, cameras: str | Path, **options: Any) -> "Capture":
        """Read the photographs and cameras of one instant.

        Args:
            images: the folder; photographs are named after their cameras.
            cameras: the calibration, in one of :data:`ghgs_capture.formats.FORMATS`.
            options: as for :class:`ghgs_capture.folder.CaptureFolder`, such as ``masks``.

        Returns:
            The capture.

        Raises:
            InputError: a file is missing or wrong, or the folder holds several instants.
        """
        folder = CaptureFolder(images, cameras, **options)
        instants = folder.instants
        require(len(instants) == 1, str(images), "one instant (CaptureFolder reads several)", len(instants))
        return cls(instants[0], folder.photographs(instants[0]))

    def batch(self, size: tuple[int, int], refine_masks: int = 0) -> Batch:
        """Crop the photographs around the subject, on a black background, as input of a model.

        Cameras stay in the user's world, in float64 for worlds far from their origin. Photographs are
        divided by the gains of their cameras if the gains of all cameras are known.

        Args:
            size: (height, width) of the crops in pixels.
            refine_masks: pixels of a crop by which outlines of masks may be wrong; mattes are then
                estimated from the photographs (:func:`ghgs_lit.data.matting.refine_matte`). 0: masks
                are used unchanged.

        Returns:
            A batch of one element; images from 0 to 1.
        """
        crops = [crop_to_subject(photograph, size, refine_masks) for photograph in self.photographs]
        stacked = {}
        for name in ("image", "matte", "intrinsics", "extrinsics"):
            stacked[name] = torch.from_numpy(np.stack([getattr(crop, name) for crop in crops]))[None]
        batch = Batch(
            images=stacked["image"].movedim(-1, 2).float() / 255,
            masks=stacked["matte"] > 127,
            cameras=Cameras(stacked["intrinsics"], stacked["extrinsics"], *size),
            alpha=stacked["matte"].float() / 255,
            subjects=(self.name,),
            views=(tuple(crop.name for crop in crops),),
        )
        gains = [crop.gains for crop in crops]
        known = all(values is not None for values in gains)
        return divide_by_gains(batch, torch.from_numpy(np.log(gains)).float()[None]) if known else batch
