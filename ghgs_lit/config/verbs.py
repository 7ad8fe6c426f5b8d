"""Options of each verb: the keys that ``conf/<verb>.yaml`` sets beside its groups."""

from typing import Annotated, Literal

from pydantic import Field

from ghgs_lit.config.nodes import Check, PairedTest, PerScene, Sequence, Texts, Timing, Turntable
from ghgs_lit.config.options import (
    Count,
    CropSize,
    Index,
    Options,
    Patches,
    Path,
    Positive,
    Seed,
    Text,
    Words,
    Workers,
)

Device = Literal["auto", "cpu", "cuda"]
Precision = Literal["inherit", "float32", "tf32", "bfloat16", "float16", "auto"]
Axis = Literal["y", "-y", "z"]
#: One entry of ``token_budgets``.
Budget = Literal["all", "window"] | Patches
Budgets = Annotated[tuple[Budget, ...], Field(min_length=1)]


class Measured(Options):
    """Keys of verbs that run a model."""

    device: Device = "auto"
    """auto: CUDA where there is one."""
    precision: Precision = "inherit"
    """Of the model's matrix products; inherit: of its weights and inputs."""
    seed: Seed = 1
    """Of the data's random choices and of random weights."""


class Run(Options):
    """Keys of verbs that train."""

    seed: Seed = 1
    """Of weights, of samples and of their order."""
    resume: Literal["auto"] | Path | None = "auto"
    """A checkpoint to go on from; auto: where the run in the directory stands; null: begins anew."""
    overwrite: bool = False
    """Delete the run that is in the directory already."""


class Train(Run):
    """Train a model, then measure it."""

    token_budgets: Budgets | None = None
    """What the encoder sees in a training step, drawn from this list: all, window (around the subject), or a
    number (patches around the subject that stay). One checkpoint then serves all presets of skip."""
    init_from: Path | None = None
    """A checkpoint whose weights to start from."""
    init_strict: bool = False
    """Whether all weights of init_from must fit, and be all that the model has (or all of its encoder)."""
    allow_random_encoder: bool = False
    """Whether an encoder that does not learn may be random, to try things out."""
    dry_run: bool = False
    """Print what would be run, how long it takes and where it goes, and run nothing."""


class Photographs(Options):
    """The user's photographs and their cameras."""

    images: Path | None = None
    """Folder of photographs or videos named after their cameras; of such folders: one for each instant."""
    cameras: Path | None = None
    """Their calibration: JSON, transforms.json, COLMAP, YAML of OpenCV or EasyMocap, TOML of Pose2Sim."""
    masks: Path | None = None
    """Folder of masks; null: backgrounds, segment, <name>_mask.png, those of the calibration, or alpha."""
    backgrounds: Path | None = None
    """Folder of photographs without the subject."""
    segment: Text | None = None
    """rembg: masks by that package."""


class Adapt(Photographs, Run):
    """Train weights further for the cameras of one rig."""

    checkpoint: Path = "shipped"
    """The weights to start from."""
    minutes: float = Field(3, gt=0, le=1440)
    """Minutes of training."""
    out: Path | None = None
    """File for the weights; null: adapted.ckpt in the run's directory."""


class Predict(Photographs, Measured):
    """Turn photographs into a splat and the other files that ``formats`` lists."""

    checkpoint: Path | None = "shipped"
    """The one that comes with the package, or a file of ``ghgs train`` or ``ghgs import``."""
    check_cameras: bool = True
    """Refuse cameras that the masks contradict (``ghgs doctor task=cameras`` says more)."""
    size: CropSize | None = None
    """Side or [height, width] of what the model sees, in pixels; null: as it was trained. At most 2072, four
    times the published 518: memory grows with its square."""
    refine_masks: Literal["auto"] | Annotated[int, Field(ge=0, le=64)] = "auto"
    """Pixels of size that masks may be off by: photographs say where outlines are; 0: none; auto: 4 where
    photographs contradict the masks (of images alone, not of a data set)."""
    refine_cameras: Literal["auto"] | Annotated[int, Field(ge=0, le=100)] = "auto"
    """Rounds, at most, that correct the cameras until the photographs agree; 0: none; auto: 4 where
    silhouettes contradict the cameras (of images alone, not of a data set)."""
    refine_tones: Literal["auto", 0] = "auto"
    """auto: undo the tone curve that a single camera has beside the others (of images alone); 0: leave it."""
    refine: int = Field(0, ge=0, le=10000)
    """Steps of optimisation towards the photographs after the prediction, such as 15; 0: none."""
    out: Path | None = None
    """Folder for the results; null: that of this run."""
    subject: Text | Index = 0
    """Without images: name of the subject, or its number in the split."""
    split: Literal["train", "val"] = "val"
    """Without images: where the subject is."""
    formats: Texts = ("ply", "html", "turntable", "depth", "points", "inputs")
    """What is written: ply, html, turntable, depth, points, inputs, splat; with the extra formats:
    compressed_ply, spz, sog, glb; with the extra video: mp4; or all."""
    up: Axis | None = None
    """Axis that points up in all files; null: they are in the world of the cameras."""
    smooth: bool = False
    """Gaussians in files are as large as the photographs' pixels: no gaps on larger screens."""
    turntable: Turntable = Turntable()
    """Pictures around the subject."""
    sequence: Sequence = Sequence()
    """Which instants count, and how the videos of cameras fit together."""


class View(Predict):
    """A page in the browser with Gaussians, cameras, photographs, point cloud and visual hull."""

    images: Path | Annotated[dict, Words("a folder or a mapping of cameras to devices")] | None = None
    """As for ``ghgs predict``; with live also {camera: number of a device, or address of a stream}, which
    OpenCV opens."""
    path: Path | None = None
    """A directory of ``ghgs predict`` (its formats ply and inputs), or a PLY; null: predict first."""
    checkpoint: Path | None = None
    """Without path: a checkpoint, as for ``ghgs predict``; null: the one that comes with the package."""
    formats: Texts = ("ply", "inputs")
    """What is written, as for ``ghgs predict``."""
    host: Text = "127.0.0.1"
    """Address to listen at: this machine only; 0.0.0.0 opens the page to the network."""
    port: int = Field(8080, ge=0, le=65535)
    """The next free one is taken where it is in use."""
    seconds: Positive | None = None
    """The page is closed after so long; null: never."""
    live: bool = False
    """Show the newest instant of images again and again: of a folder that is being written, of videos at
    their rate, or of cameras. Their calibration is not checked, auto refines nothing, and out gets
    sequence/0000.ply and so on."""
    delay: Positive | None = None
    """Of live: seconds between an instant and its picture after which it is dropped; null: none is."""


class Doctor(Photographs):
    """Diagnose cameras and masks, this machine, or a device."""

    task: Literal["cameras", "machine", "selfcheck"] = "cameras"
    """cameras: whether photographs, masks and calibration fit together, and what would fit. machine: what
    there is, and what is missing for which feature. selfcheck: whether ``device`` computes as the CPU does in
    float64: a table for a bug report."""
    device: Device = "auto"
    """Of task=machine and selfcheck."""
    seed: Seed = 1
    """Of random weights."""
    token_budgets: Budgets | None = None
    """As for ``ghgs train``."""


class Evaluate(Measured):
    """Measure a checkpoint, baselines, or both on the same targets."""

    checkpoint: Path | None = None
    """A checkpoint; null: baselines alone."""
    refine_cameras: int = Field(0, ge=0, le=100)
    """Rounds, at most, that correct the inputs' cameras before each prediction; 0: none."""
    refine: int = Field(0, ge=0, le=10000)
    """Steps of optimisation towards the inputs after each prediction; 0: none."""
    baselines: Texts = ()
    """Of black, nearest_view, body_depth, hull, photo_depth, true_depth, per_scene, untrained; or all."""
    per_scene: PerScene = PerScene()
    """3D Gaussian splatting on each subject's inputs."""


class Benchmark(Measured):
    """Measure run time and error of presets."""

    checkpoint: Path | None = None
    """null: random weights, of which only run times and differences mean something."""
    presets: Annotated[tuple[Text, ...], Field(min_length=1)] = ("none", "exact", "balanced", "fast")
    """Names of files of conf/skip; none, which the others are compared with, is always measured, too."""
    knobs: Annotated[dict | None, Words("a mapping of lists or null")] = None
    """Lists of values by key, such as {recalibration.k: [4, 8]}: each preset is measured with every
    combination."""
    split: Literal["train", "val", "bench", "sealed"] = "val"
    """bench, sealed: frozen people of data=synthetic."""
    subjects: Count | None = 4
    """Number of subjects, the first of the split, rounded up to whole batches; null: all."""
    timing: Timing = Timing()
    """How times are taken."""
    threads: int | None = Field(None, ge=1, le=1024)
    """Threads of PyTorch, of which no machine has more than 1024; null: as many as it chooses."""


class Export(Options):
    """Write a checkpoint under the published names, or a small one for prediction."""

    checkpoint: Path
    """A checkpoint of ``ghgs train`` or ``ghgs import``."""
    vggt: Path | None = None
    """File for the encoder, .safetensors or .pt; null: not written."""
    release: Path | None = None
    """File for all other stages, .pth; null: not written."""
    inference: Path | None = None
    """File with weights and configuration alone, a checkpoint for ``ghgs predict``; null: not written."""
    dtype: Literal["float16", "bfloat16", "float32"] = "float16"
    """Of the weights in it."""
    overwrite: bool = False
    """Replace files that exist."""


class Import(Options):
    """Convert published weights to a checkpoint; the groups describe the model that takes them."""

    vggt: Path | None = None
    """facebook/VGGT-1B, or its file (.safetensors or .pt)."""
    release: Path | None = None
    """The authors' checkpoint; null: the file holds the encoder alone, for init_from of a training."""
    out: Path
    """File of the checkpoint."""
    dtype: Literal["float32", "bfloat16", "float16"] = "float32"
    """Of the encoder in the checkpoint; the heads are float32."""
    overwrite: bool = False
    """Replace a file that exists."""


class Prepare(Options):
    """Render data, or check it."""

    task: Literal["render", "check"] = "render"
    """render: render what is missing. check: read every photograph and camera once, with tables and a
    contact sheet."""
    check: Check = Check()
    """What task=check expects of data."""
    seed: Seed = 0
    """Of the samples that task=check draws."""


class Stress(Options):
    """Compare every stage with float64 on adversarial inputs, forward and backward."""

    quick: bool = False
    """Some thousand cases within a minute."""
    stages: tuple[Text, ...] | None = None
    """Names of stages, as a run prints them; null: all."""
    families: tuple[Text, ...] | None = None
    """Names of families of inputs, as stress.md lists them; null: all."""
    dump: Path | None = None
    """A training step that was not finite, <run>/faults/step_<n>.pt: run it again, and nothing else."""
    workers: Workers | None = None
    """Processes; null: one for each processor, 0: this one."""


class Table(Options):
    """Show the runs below a directory as one of the paper's tables."""

    runs: Annotated[
        Text | Annotated[tuple[Text, ...], Field(min_length=1)], Words("a text or a list of paths")
    ]
    """The directory of a sweep, or a list of directories."""
    layout: Literal["ablation", "table1", "table2", "table3", "table4"] = "ablation"
    """ablation: four rows, 3 to 5 views | table1: data sets | table2: 3 to 5 views | table3: NeRF methods |
    table4: the paper's ablation."""
    columns: Texts | None = None
    """Metrics, such as [psnr_box, ssim_box]; null: psnr, ssim, lpips (flip where a run has no lpips)."""
    by: Texts = ()
    """Configuration keys whose values get rows of their own, such as [optimizer.lr]."""
    others: Texts = ()
    """JSON files with results of other methods (docs/tables.md), for table1, table2 and table3."""
    reported: bool = True
    """Also print the paper's own numbers (not with layout=ablation)."""
    test: PairedTest = PairedTest()
    """The test between rows."""
    illustration: bool = False
    """Add a line: this table illustrates the framework and is not a result."""


VERBS: dict[str, type[Options]] = {
    "adapt": Adapt,
    "benchmark": Benchmark,
    "doctor": Doctor,
    "evaluate": Evaluate,
    "export": Export,
    "import": Import,
    "predict": Predict,
    "prepare": Prepare,
    "pretext": Run,
    "stress": Stress,
    "table": Table,
    "train": Train,
    "view": View,
}
