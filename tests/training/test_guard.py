"""Guard against steps that are not finite: it names the stage, saves the batch, and skips the step or
stops the run, with the same decision in all processes."""

import csv
import dataclasses
import json
import re
from pathlib import Path

import lightning.pytorch as L
import pytest
import torch
from lightning.pytorch.plugins.precision import MixedPrecision
from torch import nn
from torch.utils.data import DataLoader

from ghgs_lit.errors import InputError
from ghgs_lit.rendering import Renderer
from ghgs_lit.training import GHGSModule, Optimization
from ghgs_lit.training.guard import Step, first_fault
from ghgs_lit.training.loggers import CsvLog
from ghgs_lit.types import map_tensors
from tests.helpers.losses import losses_of
from tests.helpers.models import config, make_model
from tests.helpers.processes import run_prepared
from tests.helpers.scenes import training_batch
from tests.helpers.training import Standin, example_batch, flat_renderer, trainer

CONFIG = {"seed": 1}


def spoil_targets(batch):
    """A copy of a batch in which the last subject has an infinite target."""
    images = batch.targets.images.clone()
    images[-1] = torch.inf
    return dataclasses.replace(batch, targets=dataclasses.replace(batch.targets, images=images))


def module(limit=0, depth=1.0) -> GHGSModule:
    options = Optimization(lr=0.05, warmup=0.0, skip_nonfinite=limit)
    return GHGSModule(
        Standin(), flat_renderer, losses_of({"render_l1": 1.0, "depth": depth}), options, CONFIG
    )


def loader(*bad: int, count: int = 6) -> DataLoader:
    batches = [
        spoil_targets(example_batch(seed=s)) if s in bad else example_batch(seed=s) for s in range(count)
    ]
    return DataLoader(batches, batch_size=None, collate_fn=lambda b: b)


class Depths(L.Callback):
    """Records the model's depth after each step."""

    def __init__(self):
        self.seen = []

    def on_train_batch_end(self, run, pl_module, *_):
        self.seen.append(pl_module.model.depth.item())


def test_a_step_that_is_not_finite_is_skipped_and_counted(tmp_path, capsys):
    """A skipped step changes neither weights nor the optimizer, prints one line and is counted in the logs;
    the other steps are trained."""
    depths, subject = Depths(), module(limit=1)
    log = CsvLog(tmp_path, name="csv", version="", flush_logs_every_n_steps=1)
    run = trainer(tmp_path, 6, [depths], logger=log, log_every_n_steps=1)
    run.fit(subject, loader(1, 3))
    moved = [a != b for a, b in zip([2.5, *depths.seen], depths.seen, strict=False)]
    assert moved == [True, False, True, False, True, True]
    assert run.optimizers[0].state[subject.model.depth]["step"] == 4
    with open(tmp_path / "csv" / "metrics.csv", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["train/skipped_steps"]]
    assert [float(row["train/skipped_steps"]) for row in rows] == [0, 0, 1, 1, 2, 2]
    lines = [line for line in capsys.readouterr().out.splitlines() if "skipped" in line]
    assert len(lines) == 2
    assert lines[0].startswith(
        "step 1: expected a finite loss and gradient; found 768 of 1536 values are not finite in the batch;"
        " its batch is in "
    )
    assert [path.name for path in (tmp_path / "faults").iterdir()] == ["step_of_process_0.pt"]
    run.save_checkpoint(tmp_path / "end.ckpt")
    resumed = module(limit=1)
    trainer(tmp_path, 7).fit(resumed, loader(count=8), ckpt_path=tmp_path / "end.ckpt")
    assert resumed.guard.skipped == 2


def test_the_run_stops_after_the_allowed_steps_in_a_row(tmp_path):
    """A diverged run must not continue for days."""
    subject = module(limit=2)
    with pytest.raises(InputError, match="step 4: "):
        trainer(tmp_path, 6).fit(subject, loader(0, 2, 3, 4))
    with pytest.raises(InputError, match=r"step 1: .* in the batch; "):
        trainer(tmp_path, 6).fit(module(), loader(1))


def test_one_part_of_an_accumulated_step_is_enough(tmp_path):
    """The gradients of the other parts are dropped, too, as the sum is not finite."""
    depths = Depths()
    run = trainer(tmp_path, 3, [depths], accumulate_grad_batches=2)
    run.fit(module(limit=1), loader(2))
    assert depths.seen[1] == depths.seen[2] == depths.seen[3] != depths.seen[5]


def test_with_a_scaled_loss_the_guard_leaves_overflows_to_the_scaler(tmp_path):
    """The guard handles losses that are not finite at any scale; overflows of scaled gradients are left to
    the scaler, which uses them to find its scale."""
    scaler = torch.amp.GradScaler("cpu", init_scale=2.0**127)
    subject, depths = module(limit=1, depth=100.0), Depths()
    run = trainer(tmp_path, 4, [depths], plugins=[MixedPrecision("16-mixed", "cpu", scaler)])
    run.fit(subject, loader(3))
    assert subject.guard.skipped == 1
    assert scaler.get_scale() < 2.0**127
    assert depths.seen[2] == depths.seen[3]


STAGES = ("bounds", "encoder", "depth_head", "unprojection", "recalibration", "gaussian_head")
STAGES += ("renderer", "losses")


def real_module(folder, *overrides) -> GHGSModule:
    losses = losses_of({"render_l1": 0.8, "render_ssim": 0.2, "chamfer": 1.0, "depth": 1.0})
    renderer = Renderer(backend="cpu")
    subject = GHGSModule(
        make_model(*overrides), renderer, losses, Optimization(lr=0.01), config(*overrides)
    ).train()
    subject._trainer = trainer(folder, 1)
    return subject


@pytest.mark.parametrize("overrides", [(), ("model=paper", "skip=none"), ("skip=balanced",)])
def test_an_ordinary_step_has_no_fault(tmp_path, overrides):
    """Values that are infinite on purpose must not be reported, and gradients of the weights must stay
    unchanged."""
    subject = real_module(tmp_path, *overrides)
    assert first_fault(subject, Step(training_batch(2), 1)) == ""
    assert all(p.grad is None for p in subject.parameters())
    assert not any(m._forward_hooks or m._forward_pre_hooks for m in subject.modules())


def nan(value):
    return map_tensors(value, lambda t: t * torch.nan if t.is_floating_point() else t)


def infinite_slope(value):
    return map_tensors(value, lambda t: t + (t - t.detach()).abs().sqrt() if t.requires_grad else t)


#: Where the gradient is first not finite if a stage's result has an infinite slope.
SLOPES = {
    "encoder": "gradient of encoder",
    "depth_head": "gradient of the result of encoder",
    "unprojection": "gradient of the result of depth_head",
    "recalibration": "gradient of the result of encoder",
    "gaussian_head": "gradient of the result of recalibration",
    "renderer": "gradient of the result of rounds",
    "losses": "gradient of the result of renderer",
}


@pytest.mark.parametrize(
    ("stage", "change", "place"),
    [(stage, nan, f"result of {stage}") for stage in STAGES]
    + [(stage, infinite_slope, place) for stage, place in SLOPES.items()],
)
def test_the_place_where_values_are_first_not_finite_is_named(tmp_path, stage, change, place):
    """Stages that such a value reaches later, or its gradient in the backward pass, are not named."""
    subject = real_module(tmp_path)
    owner = subject if stage in ("renderer", "losses") else subject.model
    part = getattr(owner, stage)
    if isinstance(part, nn.Module):
        part.register_forward_hook(lambda part, inputs, result: change(result))
    else:
        setattr(owner, stage, lambda *inputs: change(part(*inputs)))
    fault = first_fault(subject, Step(training_batch(), 1))
    assert re.search(rf" in the {place}\b", fault)


def test_a_weight_that_is_not_finite_is_named_and_the_batch_saved_as_plain_data(tmp_path):
    """Stages whose inputs are already NaN are not named."""
    subject, name = real_module(tmp_path), "gaussian_head.scale_header.2.weight"
    subject.model.get_parameter(name).data.view(-1)[0] = torch.nan
    batches = DataLoader([training_batch(2)], batch_size=None, collate_fn=lambda b: b)
    with pytest.raises(InputError, match=f"weights {name}; its batch is in"):
        trainer(tmp_path, 2).fit(subject, batches)
    content = torch.load(tmp_path / "faults" / "step_of_process_0.pt", weights_only=True)
    assert torch.equal(content["batch"]["images"], training_batch(2).images)
    assert name in content["fault"]


class Written(Depths):
    """Writes each process's skipped steps and depths at the end."""

    def on_train_end(self, run, pl_module):
        place = Path(run.default_root_dir) / f"end_{run.global_rank}"
        place.write_text(json.dumps([pl_module.guard.skipped, self.seen]))


class Own(torch.utils.data.DataLoader):
    """Loader in which step 1 of the second process is not finite."""

    def __iter__(self):
        return iter(loader(1) if torch.distributed.get_rank() == 1 else loader())


def train_in_two_processes(folder):
    torch.set_num_threads(1)
    options = {"devices": 2, "strategy": "ddp_fork", "use_distributed_sampler": False}
    trainer(folder, 3, [Written()], **options).fit(module(1), Own([None] * 6, batch_size=None))


def test_two_processes_skip_together(tmp_path):
    """A process that decided alone would wait for the others forever, or train other weights."""
    run_prepared(train_in_two_processes, tmp_path)
    first, second = (json.loads((tmp_path / f"end_{rank}").read_text()) for rank in range(2))
    assert first == second
    skipped, seen = first
    assert skipped == 1
    assert seen[0] == seen[1] != seen[2]
    assert [path.name for path in (tmp_path / "faults").iterdir()] == ["step_of_process_1.pt"]
