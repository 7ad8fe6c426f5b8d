"""Options of nodes that belong to no stage, such as ``turntable`` or ``calibration``."""

from typing import Annotated, Literal

from pydantic import Field

from ghgs_lit.config.options import Count, Index, Options, PathText, Positive, Share, Text, Words

#: One value or several.
Texts = Text | tuple[Text, ...]
#: A number of input views.
Views = Annotated[int, Field(ge=2)]


class Calibration(Options):
    """Corrections of what the file of cameras omits or states wrongly;
    null: as its format defines it."""

    group = "calibration"
    format: Literal["auto", "ghgs", "colmap", "nerfstudio", "opencv", "easymocap", "toml", "qualisys"] = (
        "auto"
    )
    """Format of the file."""
    extrinsics: Literal["world_to_camera", "camera_to_world"] | None = None
    """What the matrices map."""
    axes: Literal["opencv", "opengl"] | None = None
    """Axes of a camera."""
    intrinsics: Literal["pixels", "normalized", "normalized_principal"] | None = None
    """Unit of focal lengths and principal point; normalized: shares of width and height."""
    pixel_centers: Literal["half", "integer"] | None = None
    """Where the first pixel's centre lies: at 0.5 or at 0."""
    resized: Positive | None = None
    """By what the photographs were resized after the calibration."""
    unit: Positive | None = None
    """Metres of one unit of length."""
    exif: Literal["auto", "stored", "shown"] = "auto"
    """Which pixels of a turned photograph the calibration is for."""
    names: Annotated[dict | None, Words("a mapping of photographs to cameras or null")] = None
    """Camera of a photograph with another name: {photograph: camera}."""


class SequenceOptions(Options):
    """Instants to use, and how the videos of cameras are synchronised."""

    group = "sequence"
    start: int | None = 0
    """Number of the first instant; negative: from the end."""
    stop: int | None = None
    """Number of the first one that no longer counts; negative: from the end."""
    step: Count = 1
    """Every so many of them."""
    sync: PathText | Annotated[dict, Words("a mapping of cameras to frames")] | None = None
    """Of videos. null: their frames are numbered alike. {camera: frames} by which it began before
    the others. A CSV (camera,frame,seconds): the frames nearest to those of the first camera."""


class Turntable(Options):
    """Pictures around the subject."""

    frames: int = Field(24, ge=0, le=2000)
    """Number of pictures (0: none); more than 2000 fill a disk before anybody looks."""
    fps: int = Field(12, ge=1, le=1000)
    """Pictures per second of a video; no player shows more than 1000."""


class PerScene(Options):
    """3D Gaussian splatting on each subject's inputs."""

    steps: int = Field(200, ge=1, le=100000)
    """Steps of optimisation; whole scenes are published with 30000."""


class Timing(Options):
    """How run times are measured."""

    repeats: int = Field(9, ge=1, le=1000)
    """Rounds that count, enough of them at 1000;
    each runs all presets, and each begins with another one."""


class Check(Options):
    """What task=check expects of data."""

    min_iou: Share = 0.5
    """Least IoU of a body's silhouette and its mask; below it a camera counts as wrong."""
    min_agreement: Share = 0.9
    """Without bodies: least share of a mask that the subject's other masks and cameras allow."""


class PairedTest(Options):
    """The test between rows, over seeds and subjects together."""

    group = "test"
    against: Literal["full", "best", "none"] = "full"
    """full: the row of the whole method | best: the best row of each column | none: no test."""
    alpha: float = Field(0.05, gt=0, lt=1)
    """Significance level."""
    metrics: Texts | None = None
    """Columns that are tested, all together corrected; null: the first. Others are printed only."""
    unit: Text | None = None
    """Where subjects are frames of people: a regular expression whose group is the
    person's name."""


class EvaluationOptions(Options):
    """What is measured after training and by ``ghgs evaluate``:
    every number of views with every protocol."""

    group = "evaluation"
    views: Views | tuple[Views, ...] | None = None
    """Numbers of input views (the paper's: 3, 4 and 5); of tables, null: those of the layout."""
    targets: Texts | None = ("release", "midway")
    """Names of files in conf/targets, each with its own values (the paper's: release). The
    one that targets= selects has the values of this configuration. Of tables, null: all that
    were measured."""
    split: Text = "val"
    """val: unseen in training | train | bench, sealed: frozen people of data=synthetic."""
    pictures: Index = 4
    """Number of subjects of each protocol that are drawn into pictures/."""
