"""The verbs that work on a user's photographs: what each is for, its keys,
and where its work begins.

The module that does the work is imported when the verb runs: ``ghgs --help`` waits for no library.
"""

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from ghgs_lit.cli.verb import Device, Measured, Training, Verb
from ghgs_lit.config.nodes import SequenceOptions, Texts, Turntable
from ghgs_lit.config.options import CropSize, PathText, Positive, Text

Axis = Literal["y", "-y", "z"]


class OfPhotographs(Verb):
    """The user's photographs and their cameras."""

    reads_at_once: ClassVar[bool] = False  #: whether photographs are decoded beside the imports
    images: PathText | None = None
    """Folder of photographs or videos named after their cameras;
    of such folders: one for each instant."""
    cameras: PathText | None = None
    """Their calibration: JSON, transforms.json, COLMAP, YAML of OpenCV or EasyMocap,
    TOML of Pose2Sim."""
    masks: PathText | None = None
    """Folder of masks; null: backgrounds, segment, <name>_mask.png, those of the calibration,
    or alpha."""
    backgrounds: PathText | None = None
    """Folder of photographs without the subject."""
    segment: Text | None = None
    """rembg: masks by that package."""

    def require_files(self) -> None:
        """As of every verb; photographs that are read at once are then decoded beside
        the imports."""
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
    """The one that comes with the package, or a file of ``ghgs train`` or ``ghgs import``."""
    check_cameras: bool = True
    """Refuse cameras that the masks contradict (``ghgs doctor task=cameras`` says more)."""
    size: CropSize | None = None
    """Side or [height, width] of what the model sees, in pixels; null: as it was trained. At most
    2072, four times the published 518: memory grows with its square."""
    refine_masks: Literal["auto"] | Annotated[int, Field(ge=0, le=64)] = "auto"
    """Pixels of size that masks may be off by: photographs say where outlines are; 0: none; auto: 4
    where photographs contradict the masks (of images alone, not of a data set)."""
    refine_cameras: Literal["auto"] | Annotated[int, Field(ge=0, le=100)] = "auto"
    """Rounds, at most, that correct the cameras until the photographs agree; 0: none; auto: 4 where
    silhouettes contradict the cameras (of images alone, not of a data set)."""
    refine_tones: Literal["auto", 0] = "auto"
    """auto: undo the tone curve that a single camera has beside the others (of images alone);
    0: leave it."""
    refine: int = Field(0, ge=0, le=10000)
    """Steps of optimisation towards the photographs after the prediction, such as 15; 0: none."""
    out: PathText | None = None
    """Folder for the results; null: that of this run."""
    subject: Text = "0"
    """Without images: name of the subject, or its number in the split."""
    split: Literal["train", "val"] = "val"
    """Without images: where the subject is."""
    formats: Texts = ("ply", "html", "turntable", "depth", "inputs")
    """What is written: ply, html, turntable, depth, inputs; with the extra formats:
    compressed_ply, spz, sog; with the extra video: mp4; or all."""
    up: Axis | None = None
    """Axis that points up in all files, such as -y for SuperSplat; null: that of the cameras' world."""
    smooth: bool = False
    """Gaussians in files are as large as the photographs' pixels: no gaps on larger screens."""
    turntable: Turntable = Turntable()
    """Pictures around the subject."""
    sequence: SequenceOptions = SequenceOptions()
    """Which instants count, and how the videos of cameras fit together."""


class View(Predict):
    """A page in the browser to look around in a prediction."""

    work = "ghgs_capture.verbs.view.run"
    example = "ghgs view path=runs/predict/..."
    opens = ()
    reads_data = False
    reads_at_once = False

    path: PathText | None = None
    """A directory of ``ghgs predict`` (its formats ply and inputs), or a PLY;
    null: predict first."""
    checkpoint: PathText | None = None
    """Without path: a checkpoint, as for ``ghgs predict``;
    null: the one that comes with the package."""
    formats: Texts = ("ply", "inputs")
    """What is written, as for ``ghgs predict``."""
    host: Text = "127.0.0.1"
    """Address to listen at: this machine only; 0.0.0.0 opens the page to the network."""
    port: int = Field(8080, ge=0, le=65535)
    """The next free one is taken where it is in use."""
    seconds: Positive | None = None
    """The page is closed after so long; null: never."""


class Adapt(OfPhotographs, Training):
    """Train the weights of the package further on the instants of your capture, in minutes."""

    work = "ghgs_capture.verbs.adapt.run"
    example = "ghgs adapt cameras=cameras.json images=photographs masks=masks out=mine.ckpt"
    opens = ("checkpoint",)

    checkpoint: PathText = "shipped"
    """The weights to start from."""
    minutes: float = Field(3, gt=0, le=1440)
    """Minutes of training."""
    out: PathText | None = None
    """File for the weights; null: adapted.ckpt in the run's directory."""


class Doctor(OfPhotographs):
    """Whether cameras and masks fit together, and what this machine lacks."""

    work = "ghgs_capture.verbs.doctor.run"
    example = "ghgs doctor task=cameras images=photographs cameras=cameras.json masks=masks"
    reads_at_once = True

    task: Literal["cameras", "machine"] = "cameras"
    """cameras: whether photographs, masks and calibration fit together, and what would fit.
    machine: what there is, and what is missing for which feature."""
    device: Device = "auto"
    """Of task=machine."""
