"""The verbs of the framework: their summaries, keys and entry points.

The module that does the work is imported only when the verb runs, so that ``ghgs --help`` imports no
large library.
"""

from typing import Annotated, Literal

from pydantic import Field

from ghgs_lit.cli.verb import Budgets, Measured, Training, Verb
from ghgs_lit.config.nodes import PerScene, Texts, Timing
from ghgs_lit.config.options import Count, PathText, Seed, Text, name_type


class Train(Training):
    """Train the paper's model, or model=hull or model=recurrent, and evaluate it."""

    work = "ghgs_lit.cli.train.run"
    example = "ghgs train data=synthetic trainer.max_time=00:00:10:00"
    begins_run = True
    opens = ("resume", "init_from")
    reads_data = True

    token_budgets: Budgets | None = None
    """Tokens that the encoder receives in a training step, sampled from this list: all, window (around
    the subject), or a number (patches kept around the subject). One checkpoint then serves all presets of
    skip."""
    init_from: PathText | None = None
    """Checkpoint whose weights to start from."""
    init_strict: bool = False
    """Whether all weights of init_from must fit and cover the whole model (or its whole encoder)."""
    allow_random_encoder: bool = False
    """Allow random weights in an encoder that is not trained, for experiments."""
    dry_run: bool = False
    """Print which runs would start, their outputs and what is missing, and run nothing."""

    def run(self) -> object:
        if self.dry_run:
            from ghgs_lit.cli import rehearsal

            return rehearsal.plan(self)
        return super().run()


class Pretext(Training):
    """Train the semantic branch of an encoder on the parts of built-in people."""

    work = "ghgs_lit.cli.pretext.run"
    example = "ghgs pretext data=synthetic data/rig=varied trainer.max_time=00:00:15:00"
    begins_run = True
    reads_data = True


class Evaluate(Measured):
    """Evaluate a checkpoint or the baselines."""

    work = "ghgs_lit.cli.evaluate.run"
    example = "ghgs evaluate checkpoint=runs/train/.../checkpoints/last.ckpt"
    opens = ("checkpoint",)
    reads_data = True
    has_trained_data = True

    checkpoint: PathText | None = None
    """Checkpoint to evaluate; null: baselines only."""
    refine_cameras: int = Field(0, ge=0, le=100)
    """Maximum number of rounds that correct the input cameras before each prediction; 0: none."""
    refine: int = Field(0, ge=0, le=10000)
    """Optimization steps towards the input views after each prediction; 0: none."""
    baselines: Texts = ()
    """Baselines, from nearest_view, hull, photo_depth, true_depth and per_scene; or all."""
    per_scene: PerScene = PerScene()
    """3D Gaussian splatting optimized on each subject's input views."""


class Benchmark(Measured):
    """Compare run time and error of the presets of skip, by stage."""

    work = "ghgs_lit.cli.benchmark.run"
    example = "ghgs benchmark checkpoint=runs/train/.../checkpoints/last.ckpt presets=[none,exact,balanced]"

    checkpoint: PathText | None = None
    """Checkpoint to run; null: random weights, for which only run times and differences are meaningful."""
    presets: Annotated[tuple[Text, ...], Field(min_length=1)] = ("none", "exact", "balanced", "fast")
    """Names of files in conf/skip; none, the reference, is always measured."""
    knobs: Annotated[dict | None, name_type("a mapping of lists or null")] = None
    """Lists of values by key, such as {recalibration.k: [4, 8]}; each preset is measured with every
    combination."""
    split: Literal["train", "val", "bench", "sealed"] = "val"
    """Split of the data; bench, sealed: fixed people of data=synthetic."""
    subjects: Count | None = 4
    """Number of subjects, taken from the start of the split and rounded up to whole batches; null: all."""
    timing: Timing = Timing()
    """How run times are measured."""


class Stress(Verb):
    """Test every stage on adversarial inputs against float64."""

    work = "ghgs_lit.cli.stress.run"
    example = "ghgs stress quick=true"

    quick: bool = False
    """Run some thousand cases within a minute."""
    stages: tuple[Text, ...] | None = None
    """Names of stages, as printed by a run; null: all."""


class Table(Verb):
    """Collect the runs of a sweep into one of the paper's tables."""

    work = "ghgs_lit.cli.table.run"
    example = "ghgs table runs=runs/train/sweep_..."

    runs: Annotated[
        PathText | Annotated[tuple[PathText, ...], Field(min_length=1)],
        name_type("a path or a list of paths"),
    ]
    """Directory of a sweep, or a list of directories."""
    layout: Literal["ablation", "table1", "table2", "table3", "table4"] = "ablation"
    """ablation: four rows, 3 to 5 views | table1: data sets | table2: 3 to 5 views | table3: NeRF
    methods | table4: the paper's ablation."""
    columns: Texts | None = None
    """Metrics, such as [psnr_box, ssim_box], of which the first is tested for significance; null: psnr,
    ssim, lpips (flip where a run lacks lpips)."""
    by: Texts = ()
    """Configuration keys whose values get separate rows, such as [optimizer.lr]."""
    reported: bool = True
    """Also print the numbers reported in the paper (not with layout=ablation)."""
    unit: Text | None = None
    """Where subjects are frames of people: regular expression whose group matches the person's name."""


class Prepare(Verb):
    """Render scans as training data, or create the built-in people."""

    work = "ghgs_lit.cli.prepare.run"
    example = "ghgs prepare task=render data=scans data.source=scans data.root=rendered"

    task: Literal["render", "check"] = "render"
    """render: render missing subjects. check: read every image and camera once."""
    seed: Seed = 0
    """Seed of the samples that task=check reads."""


class Import(Verb):
    """Convert published weights to a checkpoint."""

    work = "ghgs_lit.cli.weights.run_import"
    example = "ghgs import vggt=facebook/VGGT-1B release=release.pth out=release.ckpt"

    vggt: PathText | None = None
    """facebook/VGGT-1B, or its weights file (.safetensors or .pt)."""
    release: PathText | None = None
    """The authors' checkpoint; null: the file contains only the encoder, for init_from of a training."""
    out: PathText
    """Path of the checkpoint to write."""
    dtype: Literal["float32", "bfloat16", "float16"] = "float32"
    """Data type of the encoder in the checkpoint; the heads are float32."""
    overwrite: bool = False
    """Replace an existing file."""


class Export(Verb):
    """Convert a checkpoint to a small one for prediction."""

    work = "ghgs_lit.cli.weights.run_export"
    example = "ghgs export checkpoint=checkpoints/last.ckpt inference=small.ckpt"
    opens = ("checkpoint",)

    checkpoint: PathText
    """Checkpoint of ``ghgs train`` or ``ghgs import``."""
    inference: PathText
    """File with only weights and configuration, a checkpoint for ``ghgs predict``."""
    dtype: Literal["float16", "bfloat16", "float32"] = "float16"
    """Data type of its weights."""
    overwrite: bool = False
    """Replace an existing file."""
