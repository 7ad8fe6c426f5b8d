"""Checkpoints whose training state is damaged: one line before anything of it is used."""

import lightning.pytorch as L
import pytest
import torch

from ghgs_lit.errors import InputError
from ghgs_lit.training.checkpoints import CheckpointOptions, StopAtStep
from ghgs_lit.training.cost import TrainingCost
from ghgs_lit.training.restoring import (
    check_optimizer_state,
    check_restored,
    check_schedules,
    check_training_state,
)
from tests.training.test_resume import Cut, fit, module


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """The path of a checkpoint of some steps."""
    folder = tmp_path_factory.mktemp("run")
    fit(folder, Cut(), more=[TrainingCost(), StopAtStep()])
    return folder / "checkpoints" / "last.ckpt"


def check(path, checkpoint):
    """All that a run checks before it resumes."""
    made = module()
    groups = made.optimization.optimizer(made.model).param_groups
    check_training_state(path, checkpoint)
    for state in checkpoint["optimizer_states"]:
        check_optimizer_state(path, state, groups)
    check_schedules(path, checkpoint.get("lr_schedulers"), len(groups))
    best = CheckpointOptions(filename="best", monitor="val/psnr").build()
    quiet = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False}
    trainer = L.Trainer(
        accelerator="cpu", max_steps=1, max_time={"hours": 1}, callbacks=[best, TrainingCost()], **quiet
    )
    trainer.ckpt_path = str(path)
    check_restored(trainer, checkpoint)


def changed(content, keys, value):
    """Set what ``keys`` lead to, or with ... delete it.
    A key of text counts as one that begins with it."""
    *before, last = keys.split("/")
    for key in before:
        content = content[int(key)] if key.isdecimal() else content[named(content, key)]
    last = int(last) if last.isdecimal() else named(content, last)
    if value is ...:
        del content[last]
    else:
        content[last] = value


def named(content, key):
    return next((known for known in content if str(known).startswith(key)), key)


def test_what_a_run_writes_passes(written):
    check(written, torch.load(written, weights_only=True))


def test_a_run_with_a_budget_of_time_goes_on(tmp_path):
    """Its seconds are no whole numbers."""
    fit(tmp_path, Cut(), max_time={"hours": 1})
    path = tmp_path / "checkpoints" / "last.ckpt"
    checkpoint = torch.load(path, weights_only=True)
    assert checkpoint["callbacks"]["Timer"]["time_elapsed"]["train"] % 1 > 0
    check(path, checkpoint)
    checkpoint["callbacks"]["Timer"]["time_elapsed"]["train"] = "long"
    with pytest.raises(InputError, match=r"time_elapsed\.train: expected a number; found 'long'"):
        check(path, checkpoint)


PROGRESS = "loops/fit_loop/epoch_loop.batch_progress"
BEST = "callbacks/Checkpoints{'monitor': 'val"
MOMENTS = "optimizer_states/0/state/1"
NAN = torch.full((3,), torch.nan)


@pytest.mark.parametrize(
    ("keys", "value", "message"),
    [
        ("global_step", -1, "global_step: expected a number of 0 or more; found -1"),
        ("global_step", True, "global_step: expected a number of 0 or more; found True"),
        ("epoch", 10**400, "epoch: expected a number of 0 or more"),
        ("skipped_steps", "many", "skipped_steps: expected a number of 0 or more; found 'many'"),
        ("loops", {}, r"loops: expected a fit_loop; found \[\]"),
        ("loops/fit_loop", [], "loops.fit_loop: expected a mapping; found 'list'"),
        (PROGRESS, 3, "batch_progress: expected a mapping; found 'int'"),
        (f"{PROGRESS}/total", ..., "batch_progress: expected the key 'total'"),
        (f"{PROGRESS}/total/ready", ..., r"batch_progress.total: expected the key 'ready'"),
        (f"{PROGRESS}/current/completed", "4", r"batch_progress.current.completed: expected a number of 0"),
        (f"{PROGRESS}/current/completed", -4, r"batch_progress.current.completed: expected a number of 0"),
        (f"{PROGRESS}/is_last_batch", None, "is_last_batch: expected true or false; found None"),
        ("loops/fit_loop/epoch_loop.state_dict/_batches", [], "_batches_that_stepped: expected a number"),
        (BEST, [], "callbacks.Checkpoints: expected a mapping; found 'list'"),
        (f"{BEST}/best_k_models", ..., "callbacks.Checkpoints: expected the key 'best_k_models'"),
        (f"{BEST}/best_k_models", {3: 1.0}, "best_k_models: expected numbers by name; found {3: 1.0}"),
        (f"{BEST}/best_k_models", {"a": "b"}, "best_k_models: expected numbers by name; found {'a': 'b'}"),
        (f"{BEST}/best_model_score", "high", "best_model_score: expected a number; found 'high'"),
        (f"{BEST}/best_model_path", 3, "best_model_path: expected a str; found 3"),
        (f"{BEST}/kth_value", torch.zeros(2), "kth_value: expected a number; found tensor"),
        ("callbacks/TrainingCost/seconds", "long", "callbacks.TrainingCost.seconds: expected a number"),
        ("callbacks/TrainingCost/peak_bytes", ..., "TrainingCost: expected the key 'peak_bytes'"),
        ("optimizer_states/0", {"param_groups": [3]}, "optimizer_states: expected states with param_groups"),
        ("optimizer_states/0/state", ..., "optimizer_states.state: expected a mapping of parameters"),
        ("optimizer_states/0/param_groups/0/params", [0], r"param_groups: expected .*, \[2\]; found \[1\]"),
        ("optimizer_states/0/param_groups/0/params", 2, r"param_groups: expected .*, \[2\]; found \[None\]"),
        ("optimizer_states/0/param_groups/0/lr", float("nan"), "lr: expected a number .*; found nan"),
        (MOMENTS, 3, "state.1: expected what AdamW or Muon keeps of a parameter; found 'int'"),
        (f"{MOMENTS}/exp_avg_sq", ..., r"state.1: expected what AdamW .*; found \['exp_avg', 'step'\]"),
        (f"{MOMENTS}/exp_avg_sq", torch.zeros(4), r"exp_avg_sq: expected a .* \(3,\); found \(4,\)"),
        (f"{MOMENTS}/exp_avg_sq", NAN, "exp_avg_sq: expected finite numbers; found 'NaN or infinity'"),
        (f"{MOMENTS}/step", NAN, r"step: expected a tensor of shape \(\); found \(3,\)"),
        ("optimizer_states/0/state/7", {}, "state: expected numbers of 2 parameters; found 7"),
        ("lr_schedulers", ..., "lr_schedulers: expected a list of states; found 'NoneType'"),
        ("lr_schedulers/0", 3, "lr_schedulers: expected a mapping; found 'int'"),
        ("lr_schedulers/0/last_epoch", "9", "lr_schedulers.last_epoch: expected that of 1 parameter groups"),
        ("lr_schedulers/0/base_lrs", [], r"lr_schedulers.base_lrs: expected .*; found \[\]"),
        ("lr_schedulers/0/lr_lambdas", ..., "lr_schedulers.lr_lambdas: expected .*; found None"),
    ],
)  # fmt: skip
def test_a_damaged_part_is_named(written, keys, value, message):
    checkpoint = torch.load(written, weights_only=True)
    changed(checkpoint, keys, value)
    with pytest.raises(InputError, match=rf"last\.ckpt: .*{message}"):
        check(written, checkpoint)


def test_a_run_checks_loops_and_callbacks_before_it_loads_them(written, tmp_path):
    checkpoint = torch.load(written, weights_only=True)
    changed(checkpoint, f"{PROGRESS}/current/completed", "4")
    torch.save(checkpoint, tmp_path / "a.ckpt")
    with pytest.raises(
        InputError, match=r"a\.ckpt: loops.*completed: expected a number of 0 or more; found '4'"
    ):
        fit(tmp_path, Cut(), resume=str(tmp_path / "a.ckpt"), more=[StopAtStep()])
