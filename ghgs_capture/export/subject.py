"""A subject as exported: Gaussians, photographs and cameras, in the coordinate frame of the files."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghgs_lit.errors import require
from ghgs_lit.geometry.masks import coverage
from ghgs_lit.geometry.rotations import multiply_quaternions, quaternion_to_matrix
from ghgs_lit.refinement import Change, Descent
from ghgs_lit.rendering import Renderer
from ghgs_lit.types import Batch, Cameras, Gaussians, Prediction
from ghgs_lit.visualization.pictures import to_uint8
from ghgs_lit.visualization.turntable import center_of, pixel_size, subject_points, turntable, up_direction

AXES = {"y": (0.0, 1.0, 0.0), "-y": (0.0, -1.0, 0.0), "z": (0.0, 0.0, 1.0)}


def turn(start: Float[Tensor, "3"], end: Float[Tensor, "3"]) -> Float[Tensor, "4"]:
    """Compute the shortest rotation from one direction to another.

    Args:
        start: unit vector.
        end: unit vector; if opposite to ``start``, the rotation is a half turn about some
            perpendicular axis.

    Returns:
        The unit quaternion (w, x, y, z), float64.
    """
    start = start.double()
    end = end.double()
    axis = torch.linalg.cross(start, end)
    quaternion = torch.cat([(1 + start @ end)[None], axis])
    if quaternion.norm() < 1e-7:  # opposite: a half turn about a perpendicular axis
        other = torch.zeros_like(start).index_fill(0, start.abs().argmin(), 1)
        quaternion = torch.cat([start.new_zeros(1), torch.linalg.cross(start, other)])
    return torch.nn.functional.normalize(quaternion, dim=0)


def rotate_world(
    quaternion: Float[Tensor, "4"], gaussians: Gaussians, cameras: Cameras
) -> tuple[Gaussians, Cameras]:
    """Rotate a scene.

    Args:
        quaternion: unit quaternion (w, x, y, z) of the rotation.
        gaussians: with view-independent colours.
        cameras: any number.

    Returns:
        The Gaussians and cameras in the rotated world, with their dtypes.
    """
    quaternion = quaternion.double()
    rotation = quaternion_to_matrix(quaternion)
    means = gaussians.means.double() @ rotation.to(gaussians.means.device).mT
    quaternions = multiply_quaternions(quaternion.to(means.device), gaussians.quaternions.double())
    extrinsics = cameras.extrinsics.double().clone()
    extrinsics[..., :3, :3] = extrinsics[..., :3, :3] @ rotation.to(extrinsics.device).mT
    values = {"means": means.to(gaussians.means.dtype), "quaternions": quaternions.to(gaussians.quaternions)}
    moved = replace(cameras, extrinsics=extrinsics.to(cameras.extrinsics.dtype))
    return replace(gaussians, **values), moved


#: Low-pass, in px^2, of the renderers in other viewers, which are not antialiased
VIEWER_LOW_PASS = 0.3
_SMALLEST = 1e-3  #: Least standard deviation, in pixels
#: Fit of Gaussians to other viewers: changes, steps, cameras around the subject (in addition to the
#: inputs), and views per step
_FIT = {"scales": Change(3.0, 0.15), "opacities": Change(5.0, 0.3), "colors": Change(0.1, 0.006)}
_FIT_STEPS = 32
_AROUND = 8
_AT_ONCE = 2
_WEIGHTS = (1.0, 0.0, 0.1)  #: Of L1, 1 - SSIM (which would double the time) and silhouette


@dataclass(frozen=True)
class OutputOptions:
    """Formats and options of exported files."""

    formats: tuple[str, ...] = ("ply",)  #: keys of :data:`ghgs_capture.export.prediction.FORMATS`
    #: axis (``y``, ``-y``, ``z``) that points up in files; None: files are in the cameras' world
    up: str | None = None
    smooth: bool = False  #: files contain the :func:`smooth` Gaussians
    frames: int = 24  #: images of the turntable
    fps: int = 12  #: images per second of the video


def smooth(gaussians: Gaussians, pixel: float) -> Gaussians:
    """Apply the renderer's image constants to the Gaussians, at the photographs' resolution.

    Variances grow by ``low_pass`` square pixels; with ``antialiased`` opacities decrease accordingly
    (exact for isotropic Gaussians; for others by the geometric mean of their axes).

    Args:
        gaussians: with the renderer's image constants.
        pixel: side of a photograph's pixel at the subject, in the unit of the cameras.

    Returns:
        Gaussians without constants: ``low_pass`` 0, not ``antialiased``.
    """
    variances = gaussians.scales.square()
    wider = variances + gaussians.low_pass * pixel**2
    opacities = gaussians.opacities
    if gaussians.antialiased:
        ratio = variances / torch.where(wider > 0, wider, 1.0)
        opacities = opacities * ratio.prod(-1).pow(1 / 3)
    return replace(gaussians, scales=wider.sqrt(), opacities=opacities, low_pass=0.0, antialiased=False)


def for_other_renderers(gaussians: Gaussians, pixel: float) -> Gaussians:
    """Convert Gaussians to the image constants of 3D Gaussian Splatting's renderer.

    It always adds 0.3 px^2 and does not reduce opacity. The excess at the photographs' resolution is
    subtracted from the variances; Gaussians that our renderer draws below 0.3 px^2 become points.

    Args:
        gaussians: with our renderer's image constants.
        pixel: side of a photograph's pixel at the subject, in the unit of the cameras.

    Returns:
        Gaussians that render alike there; the given ones if their constants are already the same.
    """
    if gaussians.low_pass == VIEWER_LOW_PASS and not gaussians.antialiased:
        return gaussians
    drawn = smooth(gaussians, pixel)
    variances = drawn.scales.square() - VIEWER_LOW_PASS * pixel**2
    scales = variances.clamp(min=(_SMALLEST * pixel) ** 2).sqrt()
    return replace(drawn, scales=scales, low_pass=VIEWER_LOW_PASS)


def fit(theirs: Gaussians, ours: Gaussians, cameras: Sequence[Cameras], renderer: Renderer) -> Gaussians:
    """Optimise Gaussians in ``_FIT_STEPS`` steps so that their renderings match those of others.

    Args:
        theirs: Gaussians with the image constants of another renderer.
        ours: Gaussians whose renderings are the targets.
        cameras: sets of cameras [n], used in turn.
        renderer: renders both; must support gradients.

    Returns:
        ``theirs`` with changed scales, opacities and colours.
    """
    drawn = [renderer(ours, some[None], background=0.0) for some in cameras]
    search = Descent(theirs, None, _FIT)
    for step in range(_FIT_STEPS):
        lap, among = divmod(step, len(cameras))
        seen = cameras[among]
        wanted = drawn[among]
        count = seen.extrinsics.shape[0]
        # Far apart, so that a step covers different sides.
        views = [(lap + part * max(count // _AT_ONCE, 1)) % count for part in range(_AT_ONCE)]
        part = (wanted.image[:, views], wanted.alpha[:, views], seen[views][None])
        search.step(renderer, part, _WEIGHTS)
    return search.gaussians


@dataclass(frozen=True)
class ExportedSubject:
    """One subject. Lengths are in the unit of the cameras; ``up`` is the upward unit vector.

    ``images`` are premultiplied by ``mattes`` (by the masks if the batch has no mattes). ``dropped`` is
    the number of removed Gaussians that were not finite."""

    name: str
    views: tuple[str, ...]
    gaussians: Gaussians
    dropped: int
    cameras: Cameras
    images: Float[Tensor, "V 3 H W"]
    masks: Bool[Tensor, "V H W"]
    mattes: Float[Tensor, "V H W"]
    up: Float[Tensor, "3"]
    renderer: Renderer
    options: OutputOptions

    @cached_property
    def stored(self) -> Gaussians:
        """Gaussians for the PLY, which stores their image constants; :func:`smooth` with ``smooth``
        (as in Mip-Splatting, Yu et al. 2024), so that larger screens show no gaps."""
        return smooth(self.gaussians, self.pixel) if self.options.smooth else self.gaussians

    @cached_property
    def for_other_renderers(self) -> Gaussians:
        """Gaussians for files without image constants, fitted to our renderings of the input views and
        of views all around."""
        if self.options.smooth:
            return self.stored
        converted = for_other_renderers(self.gaussians, self.pixel)
        if converted is self.gaussians or not len(converted):
            return converted
        around = turntable(self.cameras, _AROUND, self.body)
        return fit(converted, self.gaussians, (self.cameras, around), self.renderer)

    @cached_property
    def body(self) -> Float[Tensor, "n 3"]:
        """Points that images of the whole subject must contain."""
        return subject_points(self.gaussians)

    @property
    def center(self) -> Float[Tensor, "3"]:
        """Point that the cameras of the page and of the turntable orbit."""
        return center_of(self.body, self.cameras)

    @property
    def pixel(self) -> float:
        """Side of a photograph's pixel at the subject, in the unit of the cameras."""
        return pixel_size(self.cameras, self.center)

    @cached_property
    def turntable(self) -> list[np.ndarray]:
        """Images [h, w, 3] uint8 from all around."""
        orbit = turntable(self.cameras, self.options.frames, self.body)
        seen = (orbit[frame : frame + 1][None] for frame in range(self.options.frames))
        return [to_uint8(self.renderer(self.gaussians, cameras).image[0, 0]) for cameras in seen]


def export_subject(
    batch: Batch, prediction: Prediction, renderer: Renderer, options: OutputOptions
) -> ExportedSubject:
    """Convert the prediction for a batch of one subject to the frame of the files (``options.up``).

    Gaussians that are not finite are dropped.

    Args:
        batch: photographs, masks and cameras of one subject.
        prediction: prediction for this batch, in the world of its cameras.
        renderer: renders the images in the files.
        options: kept with the subject.

    Returns:
        The subject, on the device of the prediction.

    Raises:
        InputError: the batch has several subjects.
    """
    count = len(batch.images)
    require(count == 1, "write_prediction", "a batch of one subject", count)
    cameras = batch.cameras[0]
    gaussians = prediction.gaussians.detach()
    finite = gaussians.is_finite
    kept = int(finite.sum())
    dropped = len(gaussians) - kept
    gaussians = gaussians.select(finite, (kept,)) if dropped else gaussians
    up = up_direction(cameras)
    if options.up is not None:
        end = up.new_tensor(AXES[options.up])
        gaussians, cameras = rotate_world(turn(up, end), gaussians, cameras)
        up = end
    return ExportedSubject(
        name=batch.subjects[0] if batch.subjects else "subject",
        views=batch.views[0] if batch.views else tuple(map(str, range(batch.images.shape[1]))),
        gaussians=gaussians,
        dropped=dropped,
        cameras=cameras,
        images=batch.images[0],
        masks=batch.masks[0],
        mattes=coverage(batch)[0],
        up=up,
        renderer=renderer,
        options=options,
    )


def file_names(views: Sequence[str]) -> list[str]:
    """Convert names of photographs to valid file names that differ even if case is ignored."""
    names: dict[str, str] = {}
    for view in views:
        name = "".join(c if c.isalnum() or c in "-_." else "_" for c in view)
        while name.casefold() in names:
            name += "_"
        names[name.casefold()] = name
    return list(names.values())
