"""The verbs of the framework: what each is for, its keys, and where its work begins.

The module that does the work is imported when the verb runs: ``ghgs --help`` waits for no library.
"""

from typing import Annotated, Literal

from pydantic import Field

from ghgs_lit.cli.verb import Budgets, Measured, Training, Verb
from ghgs_lit.config.nodes import Check, PairedTest, PerScene, Texts, Timing
from ghgs_lit.config.options import Count, PathText, Seed, Text, Words, Workers


class Train(Training):
    """Train the paper's model, or model=hull or model=recurrent, and evaluate it."""

    work = "ghgs_lit.cli.train.run"
    example = "ghgs train data=synthetic trainer.max_time=00:00:10:00"
    begins_run = True
    opens = ("resume", "init_from")
    reads_data = True

    token_budgets: Budgets | None = None
    """What the encoder sees in a training step, drawn from this list: all, window (around the
    subject), or a number (patches around the subject that stay). One checkpoint then serves all
    presets of skip."""
    init_from: PathText | None = None
    """A checkpoint whose weights to start from."""
    init_strict: bool = False
    """Whether all weights of init_from must fit,
    and be all that the model has (or all of its encoder)."""
    allow_random_encoder: bool = False
    """Whether an encoder that does not learn may be random, to try things out."""
    dry_run: bool = False
    """Print what would be run, how long it takes and where it goes, and run nothing."""

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
    """Measure a checkpoint or the baselines."""

    work = "ghgs_lit.cli.evaluate.run"
    example = "ghgs evaluate checkpoint=runs/train/.../checkpoints/last.ckpt"
    opens = ("checkpoint",)
    reads_data = True
    has_trained_data = True

    checkpoint: PathText | None = None
    """A checkpoint; null: baselines alone."""
    refine_cameras: int = Field(0, ge=0, le=100)
    """Rounds, at most, that correct the inputs' cameras before each prediction; 0: none."""
    refine: int = Field(0, ge=0, le=10000)
    """Steps of optimisation towards the inputs after each prediction; 0: none."""
    baselines: Texts = ()
    """Of black, nearest_view, body_depth, hull, photo_depth, true_depth, per_scene, untrained;
    or all."""
    per_scene: PerScene = PerScene()
    """3D Gaussian splatting on each subject's inputs."""


class Benchmark(Measured):
    """Run time against error of the presets of skip, by stage."""

    work = "ghgs_lit.cli.benchmark.run"
    example = "ghgs benchmark checkpoint=runs/train/.../checkpoints/last.ckpt presets=[none,exact,balanced]"

    checkpoint: PathText | None = None
    """null: random weights, of which only run times and differences mean something."""
    presets: Annotated[tuple[Text, ...], Field(min_length=1)] = ("none", "exact", "balanced", "fast")
    """Names of files of conf/skip; none, which the others are compared with, is always measured,
    too."""
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


class Stress(Verb):
    """Every stage on adversarial inputs, against float64."""

    work = "ghgs_lit.cli.stress.run"
    example = "ghgs stress quick=true"

    quick: bool = False
    """Some thousand cases within a minute."""
    stages: tuple[Text, ...] | None = None
    """Names of stages, as a run prints them; null: all."""
    families: tuple[Text, ...] | None = None
    """Names of families of inputs, as stress.md lists them; null: all."""
    workers: Workers | None = None
    """Processes; null: one for each processor, 0: this one."""


class Table(Verb):
    """Collect a sweep into the paper's table."""

    work = "ghgs_lit.cli.table.run"
    example = "ghgs table runs=runs/train/sweep_..."

    runs: Annotated[
        PathText | Annotated[tuple[PathText, ...], Field(min_length=1)], Words("a path or a list of paths")
    ]
    """The directory of a sweep, or a list of directories."""
    layout: Literal["ablation", "table1", "table2", "table3", "table4"] = "ablation"
    """ablation: four rows, 3 to 5 views | table1: data sets | table2: 3 to 5 views | table3: NeRF
    methods | table4: the paper's ablation."""
    columns: Texts | None = None
    """Metrics, such as [psnr_box, ssim_box];
    null: psnr, ssim, lpips (flip where a run has no lpips)."""
    by: Texts = ()
    """Configuration keys whose values get rows of their own, such as [optimizer.lr]."""
    subjects: Text | None = None
    """A regular expression: subjects whose whole names match are shown,
    such as a.* (people in action); null: all."""
    others: PathText | tuple[PathText, ...] = ()
    """JSON files with results of other methods (docs/tables.md), for table1, table2 and table3."""
    reported: bool = True
    """Also print the paper's own numbers (not with layout=ablation)."""
    test: PairedTest = PairedTest()
    """The test between rows."""


class Prepare(Verb):
    """Render scans into training data, or make the built-in people."""

    work = "ghgs_lit.cli.prepare.run"
    example = "ghgs prepare task=render data=scans data.source=scans data.root=rendered"

    task: Literal["render", "check"] = "render"
    """render: render what is missing. check: read every photograph and camera once."""
    check: Check = Check()
    """What task=check expects of data."""
    seed: Seed = 0
    """Of the samples that task=check draws."""


class Import(Verb):
    """Published weights to a checkpoint."""

    work = "ghgs_lit.cli.weights.run_import"
    example = "ghgs import vggt=facebook/VGGT-1B release=release.pth out=release.ckpt"

    vggt: PathText | None = None
    """facebook/VGGT-1B, or its file (.safetensors or .pt)."""
    release: PathText | None = None
    """The authors' checkpoint; null: the file holds the encoder alone,
    for init_from of a training."""
    out: PathText
    """File of the checkpoint."""
    dtype: Literal["float32", "bfloat16", "float16"] = "float32"
    """Of the encoder in the checkpoint; the heads are float32."""
    overwrite: bool = False
    """Replace a file that exists."""


class Export(Verb):
    """A checkpoint to a small one for prediction, or to the published names."""

    work = "ghgs_lit.cli.weights.run_export"
    example = "ghgs export checkpoint=checkpoints/last.ckpt inference=small.ckpt"
    opens = ("checkpoint",)

    checkpoint: PathText
    """A checkpoint of ``ghgs train`` or ``ghgs import``."""
    vggt: PathText | None = None
    """File for the encoder, .safetensors or .pt; null: not written."""
    release: PathText | None = None
    """File for all other stages, .pth; null: not written."""
    inference: PathText | None = None
    """File with weights and configuration alone, a checkpoint for ``ghgs predict``;
    null: not written."""
    dtype: Literal["float16", "bfloat16", "float32"] = "float16"
    """Of the weights in it."""
    overwrite: bool = False
    """Replace files that exist."""
