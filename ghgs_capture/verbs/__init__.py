"""Verbs for a user's photographs, with their keys.

The module that does the work of a verb is imported when the verb runs, so that ``ghgs --help`` imports
no heavy library.
"""

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from ghgs_lit.cli.verb import Device, Measured, Training, Verb
from ghgs_lit.config.nodes import SequenceOptions, Texts, Turntable
from ghgs_lit.config.options import CropSize, PathText, Positive, Text

Axis = Literal["y", "-y", "z"]


class OfPhotographs(Verb):
    """Keys of verbs that read a user's photographs and cameras."""

    reads_at_once: ClassVar[bool] = False  #: whether photographs are decoded during the imports
    images: PathText | None = None
    """Folder of photographs or videos named after their cameras, or of one such folder for each instant."""
    cameras: PathText | None = None
    """Calibration, a file or folder: JSON, transforms.json, COLMAP, YAML of OpenCV or EasyMocap, TOML of
    Pose2Sim."""
    masks: PathText | None = None
    """Folder of masks. null: the first available source of backgrounds, segment, <name>_mask.png, masks
    that the calibration names, alpha."""
    backgrounds: PathText | None = None
    """Folder of photographs without the subject, named after their cameras."""
    segment: Text | None = None
    """rembg: compute masks with that package."""

    def require_files(self) -> None:
        """Check the files, and with ``reads_at_once`` start decoding photographs in the background."""
        super().require_files()
        if self.reads_at_once and self.images is not None and self.cameras is not None:
            from ghgs_capture.verbs.photographs import begin_to_read

            begin_to_read(self)


class Predict(OfPhotographs, Measured):
    """Turn photographs into a splat, pictures and a page."""

    work = "ghgs_capture.verbs.predict.run"
    example = "ghgs predict images=photographs cameras=cameras.json masks=masks out=splat"
    opens = ("checkpoint",)
    reads_data = True
    reads_at_once = True
    has_trained_data = True

    checkpoint: PathText | None = "shipped"
    """shipped: the weights of this package; else a file of ``ghgs train`` or ``ghgs import``."""
    check_cameras: bool = True
    """Reject cameras that the masks contradict (``ghgs doctor task=cameras`` prints details)."""
    size: CropSize | None = None
    """Side or [height, width] of the model's input in pixels; null: the size of its training. At most
    2072, four times the published 518: memory grows with its square."""
    refine_masks: Literal["auto"] | Annotated[int, Field(ge=0, le=64)] = "auto"
    """Correct outlines of masks by up to this many pixels of the model's input; 0: none; auto: 4 if the
    photographs contradict the masks (with images only, not for a data set)."""
    refine_cameras: Literal["auto"] | Annotated[int, Field(ge=0, le=100)] = "auto"
    """Maximum number of rounds that correct the cameras until the photographs agree; 0: none; auto: 4 if
    silhouettes contradict the cameras (with images only, not for a data set)."""
    refine_tones: Literal["auto", 0] = "auto"
    """auto: undo the tone curve of a camera that differs from the others (with images only); 0: keep it."""
    refine: int = Field(0, ge=0, le=10000)
    """Optimisation steps towards the photographs after the prediction, such as 15; 0: none."""
    out: PathText | None = None
    """Folder for the results; null: the run's directory."""
    subject: Text = "0"
    """Without images: name of the subject, or its index in the split."""
    split: Literal["train", "val"] = "val"
    """Without images: split of the subject."""
    formats: Texts = ("ply", "html", "turntable", "inputs")
    """Formats to write: ply, html, turntable, inputs; with the extra "formats" compressed_ply, spz,
    sog; with the extra "video" mp4; or all."""
    up: Axis | None = None
    """Axis that points up in all files, such as -y for SuperSplat; null: the world of the cameras."""
    smooth: bool = False
    """Widen Gaussians in files to the photographs' pixels, which avoids gaps on larger screens."""
    turntable: Turntable = Turntable()
    """Images rendered around the subject."""
    sequence: SequenceOptions = SequenceOptions()
    """Instants to use, and how the videos of cameras are synchronised."""


class View(Verb):
    """Show a prediction in the browser."""

    work = "ghgs_capture.verbs.view.run"
    example = "ghgs view path=runs/predict/..."

    path: PathText | None = None
    """Directory of ``ghgs predict`` (with its formats ply and inputs), or a PLY."""
    up: Axis | None = None
    """Axis that points up; null: estimated from the cameras, y for a PLY."""
    port: int = Field(8080, ge=0, le=65535)
    """Port of the server on this machine; the next free one if it is in use."""
    seconds: Positive | None = None
    """Time in seconds after which the server stops; null: never."""


class Adapt(OfPhotographs, Training):
    """Fine-tune weights on the instants of your capture, in minutes."""

    work = "ghgs_capture.verbs.adapt.run"
    example = "ghgs adapt cameras=cameras.json images=photographs masks=masks out=mine.ckpt"
    opens = ("checkpoint",)

    checkpoint: PathText = "shipped"
    """Initial weights, as for ``ghgs predict``."""
    minutes: float = Field(3, gt=0, le=1440)
    """Duration of the training in minutes."""
    out: PathText | None = None
    """File for the weights; null: adapted.ckpt in the run's directory."""


class Doctor(OfPhotographs):
    """Check whether cameras and masks fit together, and what this machine lacks."""

    work = "ghgs_capture.verbs.doctor.run"
    example = "ghgs doctor task=cameras images=photographs cameras=cameras.json masks=masks"
    reads_at_once = True

    task: Literal["cameras", "machine"] = "cameras"
    """cameras: check photographs, masks and calibration, and find the convention that fits.
    machine: list hardware and packages, and features for which something is missing."""
    device: Device = "auto"
    """Device of task=machine."""
