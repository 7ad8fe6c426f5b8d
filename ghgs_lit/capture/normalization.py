"""Between the user's world and one in which the subject has a person's size and lies at the origin.

Models know people in metres. A statue of 200 m, a figurine, or a person in millimetres are scaled to that.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from ghgs_lit.data.resampling import area_mask
from ghgs_lit.data.silhouettes import Silhouette, extent, subject_place
from ghgs_lit.types import Batch, DepthBounds, DepthMaps, Gaussians, Points, Prediction

if TYPE_CHECKING:
    from ghgs_lit.capture.capture import Photograph

#: Largest extents that are taken for a person in metres, and what others are scaled to.
PERSON = (0.5, 2.5)
_NORMAL = 1.7
_CELLS = 128


@dataclass(frozen=True)
class Normalization:
    """``normalized = (world - origin) * scale``.

    Attributes:
        origin: [3] float64, in the user's unit.
        scale: of lengths.
        size: the subject's largest extent in the user's unit.
    """

    origin: np.ndarray
    scale: float
    size: float

    def extrinsics(self, extrinsics: np.ndarray) -> np.ndarray:
        """World to camera [4, 4] of the normalized world, float64."""
        moved = extrinsics.copy()
        moved[:3, 3] = (extrinsics[:3, :3] @ self.origin + extrinsics[:3, 3]) * self.scale
        return moved

    def to_user(self, batch: Batch, prediction: Prediction) -> tuple[Batch, Prediction]:
        """A normalized batch without depths and its prediction in the user's world."""
        cameras = batch.cameras
        rotations = cameras.extrinsics[..., :3, :3].double()
        origin = torch.from_numpy(self.origin).to(rotations.device)
        extrinsics = cameras.extrinsics.double().clone()
        extrinsics[..., :3, 3] = extrinsics[..., :3, 3] / self.scale - (rotations * origin).sum(-1)
        cameras = replace(cameras, extrinsics=extrinsics.to(cameras.extrinsics.dtype))
        maps = prediction.depth_maps
        bounds = maps.bounds
        if bounds is not None:
            bounds = DepthBounds(bounds.near / self.scale, bounds.far / self.scale)
        maps = DepthMaps(maps.depth / self.scale, maps.valid, maps.confidence, bounds)
        points = prediction.points
        points = Points(
            self._place(points.pixels), points.valid, self._place(points.tokens), points.tokens_valid
        )
        moved = Prediction(
            gaussians=self.gaussians(prediction.gaussians),
            depth=prediction.depth / self.scale,
            depth_valid=prediction.depth_valid,
            decisions=prediction.decisions,
            points=points,
            depth_maps=maps,
        )
        return replace(batch, cameras=cameras), moved

    def gaussians(self, gaussians: Gaussians) -> Gaussians:
        """Normalized Gaussians in the user's world."""
        return replace(gaussians, means=self._place(gaussians.means), scales=gaussians.scales / self.scale)

    def _place(self, points: torch.Tensor) -> torch.Tensor:
        origin = torch.from_numpy(self.origin).to(points.device)
        return (points.double() / self.scale + origin).to(points.dtype)


def normalization_of(photographs: Sequence["Photograph"]) -> Normalization:
    """From where the masks place the subject, and how large they show it."""
    silhouettes = [coarse(photograph, _CELLS) for photograph in photographs]
    focus, _ = subject_place(silhouettes)
    size = float(np.median([extent(s, focus).max() for s in silhouettes]))
    person = PERSON[0] <= size <= PERSON[1] or not np.isfinite(size) or size == 0
    return Normalization(focus, 1.0 if person else _NORMAL / size, size)


def coarse(photograph: "Photograph", cells: int) -> Silhouette:
    """The silhouette of a photograph in at most ``cells`` along its longer side."""
    shape = np.array(photograph.mask.shape)
    size = np.maximum(np.round(shape * min(cells / shape.max(), 1)).astype(int), 1)
    intrinsics = photograph.intrinsics.copy()
    intrinsics[:2] *= (size / shape)[::-1, None]
    return Silhouette(area_mask(photograph.mask, *size.tolist()), intrinsics, photograph.extrinsics)
