"""Options of nodes that do not belong to a stage, such as ``turntable`` or ``calibration``."""

from typing import Annotated, Literal

from pydantic import Field

from ghgs_lit.config.options import Count, Index, Options, Positive, Text, name_type

#: One value or several.
Texts = Text | tuple[Text, ...]
#: Number of input views.
Views = Annotated[int, Field(ge=2)]


class Calibration(Options):
    """Corrections of values that the camera file omits or states wrongly; null: as defined by its format."""

    group = "calibration"
    format: Literal["auto", "ghgs", "colmap", "nerfstudio", "opencv", "easymocap", "toml"] = "auto"
    """Format of the camera file."""
    extrinsics: Literal["world_to_camera", "camera_to_world"] | None = None
    """Transformation that the matrices describe."""
    axes: Literal["opencv", "opengl"] | None = None
    """Axis convention of a camera."""
    intrinsics: Literal["pixels", "normalized", "normalized_principal"] | None = None
    """Unit of focal lengths and principal point; normalized: fractions of width and height."""
    pixel_centers: Literal["half", "integer"] | None = None
    """Position of the first pixel's centre: half: 0.5; integer: 0."""
    resized: Positive | None = None
    """Factor by which the photographs were resized after calibration."""
    unit: Positive | None = None
    """Length of one unit in metres."""
    exif: Literal["auto", "stored", "shown"] = "auto"
    """Pixels of a rotated photograph that the calibration refers to: as stored or as shown."""
    names: Annotated[dict | None, name_type("a mapping of photographs to cameras or null")] = None
    """Cameras of photographs whose name differs from the camera's: {photograph: camera}."""


class SequenceOptions(Options):
    """Instants to use, and synchronization of the cameras' videos."""

    group = "sequence"
    start: int | None = 0
    """Number of the first instant; negative: counted from the end."""
    stop: int | None = None
    """Number after the last instant (exclusive); negative: counted from the end."""
    step: Count = 1
    """Use every step-th instant."""
    sync: Annotated[dict, name_type("a mapping of cameras to frames")] | None = None
    """Synchronization of videos. null: equal frame numbers are simultaneous. {camera: frames}: number of
    frames by which the camera began before the others."""


class Turntable(Options):
    """Images rendered on a circle around the subject."""

    frames: int = Field(24, ge=0, le=2000)
    """Number of images, at most 2000; 0: none."""
    fps: int = Field(12, ge=1, le=1000)
    """Frames per second of the video, at most 1000."""


class PerScene(Options):
    """3D Gaussian splatting optimized on each subject's input views."""

    steps: int = Field(200, ge=1, le=100000)
    """Optimization steps; published results of whole scenes use 30000."""


class Timing(Options):
    """How run times are measured."""

    repeats: int = Field(9, ge=1, le=1000)
    """Timed rounds; each runs all presets, and each starts with a different preset."""


class EvaluationOptions(Options):
    """Evaluation after training and by ``ghgs evaluate``: every number of views with every target
    protocol."""

    group = "evaluation"
    views: Views | tuple[Views, ...] | None = None
    """Numbers of input views (paper: 3, 4 and 5). For tables, null: those of the layout."""
    targets: Texts | None = ("release", "midway")
    """Names of files in conf/targets, each with its own values (paper: release); the one selected by
    targets= has the values of this configuration. For tables, null: all that were evaluated."""
    split: Text = "val"
    """val: unseen in training | train | bench, sealed: fixed people of data=synthetic."""
    pictures: Index = 4
    """Number of subjects per protocol whose renders are saved in pictures/."""
