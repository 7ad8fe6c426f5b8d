"""Contents of a page, read from the directory of a prediction or from a PLY."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ghgs_capture.calibration import calibrate
from ghgs_capture.export.subject import AXES
from ghgs_capture.formats.matrices import read_matrices
from ghgs_lit.data.images import read_image
from ghgs_lit.errors import InputError, choice, require
from ghgs_lit.geometry.projection import unproject_maps
from ghgs_lit.method.bounds import VisualHull
from ghgs_lit.ply import read_ply
from ghgs_lit.types import Batch, Cameras, Gaussians
from ghgs_lit.visualization.turntable import center_of, subject_points, up_direction

_HULL_POINTS = 50_000


@dataclass(frozen=True)
class Content:
    """Gaussians of one subject; ``batch`` has its photographs,
    masks and cameras where they are known."""

    gaussians: Gaussians
    up: Float[Tensor, "3"]
    batch: Batch | None = None

    @property
    def cameras(self) -> Cameras:
        """The cameras [V] of the photographs."""
        return self.batch.cameras[0]

    @cached_property
    def center(self) -> Float[Tensor, "3"]:
        """The middle of the subject."""
        return center_of(subject_points(self.gaussians), self.cameras)

    @cached_property
    def hull(self) -> np.ndarray:
        """Points [n, 3] of the visual hull: where the rays of the subject's pixels enter it."""
        near = VisualHull(dilation=0.0)(self.batch).near
        points = unproject_maps(near, self.batch.cameras)[self.batch.masks]
        return points[:: -(-max(len(points), 1) // _HULL_POINTS)].numpy()


def read_content(path: str | Path, up: str | None) -> Content:
    """Read what ``ghgs predict`` wrote into a directory (its formats ``ply`` and ``inputs``),
    or a PLY.

    Args:
        path: the directory or the PLY.
        up: the axis ``y``, ``-y`` or ``z`` that points up; None: the up of the cameras, and ``y``
            for a PLY.

    Returns:
        The Gaussians, and of a directory the photographs with their cameras.

    Raises:
        InputError: ``path`` is neither, or a file of it is missing or wrong.
    """
    path = Path(path)
    choice("up", up, (None, *AXES))
    if path.is_file():
        return Content(read_ply(path), torch.tensor(AXES[up or "y"]))
    require(path.is_dir(), f"path={path}", "a directory of ghgs predict or a PLY", "neither")
    for name, wanted in (("gaussians.ply", "ply"), ("cameras.json", "inputs")):
        if not (path / name).exists():
            raise InputError(f"{path / name}: expected a file of ghgs predict formats=[{wanted}]; found none")
    batch = _read_inputs(path)
    direction = up_direction(batch.cameras[0]) if up is None else torch.tensor(AXES[up])
    return Content(read_ply(path / "gaussians.ply"), direction, batch)


def _read_inputs(directory: Path) -> Batch:
    """Photographs, masks and cameras of the format ``inputs``.
    InputError: one is missing or wrong."""
    stored = read_matrices(directory / "cameras.json")
    pictures = []
    cameras = []
    for name, camera in stored.cameras.items():
        file = directory / "inputs" / f"{name}.png"
        inside = file.resolve().parent == (directory / "inputs").resolve()
        require(inside, str(file), f"the photograph of camera {name} in this folder", "a file outside")
        require(file.exists(), str(file), f"the photograph of camera {name}", "none")
        pictures.append(np.asarray(read_image(file).convert("RGBA")))
        cameras.append(calibrate(camera, stored.convention, pictures[-1].shape[:2]))
    shapes = {picture.shape for picture in pictures}
    require(len(shapes) == 1, str(directory / "inputs"), "photographs of one size", sorted(shapes))
    values = torch.from_numpy(np.stack(pictures)).movedim(-1, 1).float()[None] / 255
    intrinsics = torch.from_numpy(np.stack([camera.intrinsics for camera in cameras])).float()[None]
    extrinsics = torch.from_numpy(np.stack([camera.extrinsics for camera in cameras])).float()[None]
    colors = values[:, :, :3]
    alpha = values[:, :, 3:]
    return Batch(
        images=torch.where(alpha > 0, colors * alpha, colors),
        masks=alpha[:, :, 0] > 0.5,
        alpha=alpha[:, :, 0],
        cameras=Cameras(intrinsics, extrinsics, *pictures[0].shape[:2]),
        views=(tuple(stored.cameras),),
    )
