"""An interrupted run resumes to the same weights, logs and best checkpoint, with complete files."""

import csv
import shutil
from types import SimpleNamespace

import lightning.pytorch as L
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from ghgs_lit.cli import train as train_verb
from ghgs_lit.config import run_of
from ghgs_lit.errors import InputError
from ghgs_lit.training import GHGSModule, Optimization
from ghgs_lit.training.callbacks import TrainingCost
from ghgs_lit.training.checkpoints import AtomicCheckpointIO, CheckpointOptions
from ghgs_lit.training.loggers import CsvLog, TensorBoardLog, begin
from ghgs_lit.training.start import check_resume, check_start
from ghgs_lit.weights import frozen
from ghgs_lit.weights.checkpoint import read_checkpoint
from tests.helpers.losses import losses_of
from tests.helpers.training import Standin, StepData, _Steps, flat_renderer, held, trainer

STEPS = 16
CONFIG = {"seed": 3, "resume": None, "init_from": None, "optimizer": {"lr": 0.05}}


class PowerCut(Exception):
    pass


class Cut(L.Callback):
    """Aborts the run after step ``at`` or in the validation after it, and records validations."""

    def __init__(self, at: int | None = None, validating: bool = False):
        self.at, self.validating, self.validations = at, validating, []

    def on_train_batch_end(self, trainer, *_):
        if trainer.global_step == self.at and not self.validating:
            raise PowerCut

    def on_validation_batch_end(self, trainer, pl_module, outputs, batch, batch_idx, *_):
        if trainer.global_step == self.at and self.validating:
            raise PowerCut
        if batch_idx == 0:
            self.validations.append(trainer.global_step)


def module() -> GHGSModule:
    # Frozen parameters and randomly sampled points: both depend on the step of the run.
    losses = losses_of({"render_l1": 0.8, "chamfer": 1.0, "depth": 0.5}, chamfer_points=7)
    optimization = Optimization(lr=0.05, warmup=0.1, end_factor=0.0, freeze_until={"shift": 0.4})
    return GHGSModule(Standin(), flat_renderer, losses, optimization, CONFIG)


def fit(folder, cut: Cut, resume=None, every=3, more=(), subject=None, **options):
    torch.manual_seed(11 if resume else 12)  # the state of the global generator must not matter
    best = CheckpointOptions(filename="best", monitor="val/psnr").build()
    last = CheckpointOptions(filename="last", every_n_train_steps=every).build()
    trainer = L.Trainer(
        accelerator="cpu", max_steps=STEPS, max_epochs=-1, default_root_dir=folder,
        plugins=[AtomicCheckpointIO()],
        logger=[CsvLog(folder, name="csv", version="", flush_logs_every_n_steps=1),
                TensorBoardLog(folder, name="tensorboard", version="")],
        callbacks=[cut, best, last, *more], enable_model_summary=False, enable_progress_bar=False,
        num_sanity_val_steps=0, check_val_every_n_epoch=None, val_check_interval=4, log_every_n_steps=1,
        **options,
    )  # fmt: skip
    if resume is not None:
        begin(trainer.loggers, "", torch.load(resume, weights_only=True)["global_step"])
    subject = subject or module()
    trainer.fit(subject, StepData(), ckpt_path=resume)
    return subject


def train_until_cut(folder, cut: Cut, **options):
    """Train until the cut; returns the last checkpoint and its step."""
    with pytest.raises(PowerCut):
        fit(folder, cut, **options)
    last = folder / "checkpoints" / "last.ckpt"
    return last, torch.load(last, weights_only=True)["global_step"]


def rows(folder) -> list[dict[str, str]]:
    with open(folder / "csv" / "metrics.csv", newline="") as file:
        return [{k: v for k, v in row.items() if v} for row in csv.DictReader(file)]


def score(folder) -> tuple[float, int]:
    content = torch.load(folder / "checkpoints" / "best.ckpt", weights_only=True)
    state = next(v for k, v in content["callbacks"].items() if "val/psnr" in k)
    return state["best_model_score"].item(), content["global_step"]


def test_the_best_checkpoint_has_the_highest_psnr(whole):
    """The best checkpoint is that of the highest of four different values."""
    folder, _, validations = whole(1)
    found = [float(row["val/psnr"]) for row in rows(folder) if "val/psnr" in row]
    assert len(set(found)) == len(validations)
    best, step = score(folder)
    assert best == pytest.approx(max(found), rel=1e-6)
    assert step == validations[found.index(max(found))]


@pytest.mark.parametrize(
    ("at", "validating", "every", "accumulate", "saved"),
    [
        (5, False, 3, 1, 3),
        (8, False, 3, 1, 6),
        (8, True, 3, 1, 6),
        (12, True, 3, 1, 9),
        (13, False, 3, 1, 12),
        (10, False, 4, 1, 8),
        (10, False, 3, 2, 9),
    ],
)
def test_a_cut_run_ends_as_the_whole_one_does(whole, tmp_path, at, validating, every, accumulate, saved):
    """Cuts within an epoch of 5 steps, and at or within a validation (every 4 steps). A checkpoint that is
    due at a validation is written after it, as a restart does not repeat it, and none is written between
    two batches of a step, where gradients would be lost."""
    first, options = Cut(at, validating), {"every": every, "accumulate_grad_batches": accumulate}
    last, step = train_until_cut(tmp_path, first, **options)
    assert step == saved  # the cut precedes a checkpoint that is due at the same step
    second = Cut()
    subject = fit(tmp_path, second, resume=last, **options)
    folder, expected, validations = whole(accumulate)
    for a, b in zip(expected.parameters(), subject.parameters(), strict=True):
        assert torch.equal(a, b)
    if accumulate == 1:  # otherwise validations, counted in batches, fall between steps
        assert [s for s in first.validations if s <= step] + second.validations == validations
        assert score(tmp_path) == score(folder)
        assert rows(tmp_path) == rows(folder)


@pytest.mark.parametrize(("accumulate", "cut"), [(2, None), (2, 4), (2, 5), (3, 3), (1, 7)])
def test_every_batch_is_trained_once_and_in_order(tmp_path, monkeypatch, accumulate, cut):
    """No batch is skipped at the end of an epoch whose length is no multiple of the batches of a step."""
    drawn = []
    real = _Steps.__getitem__
    monkeypatch.setattr(_Steps, "__getitem__", lambda self, step: (drawn.append(step), real(self, step))[1])
    in_epoch, last = -(-5 // accumulate), None
    if cut is not None:
        # The checkpoint is from the step before the cut, so the batches of the cut step repeat.
        last, steps = train_until_cut(tmp_path, Cut(cut), every=1, accumulate_grad_batches=accumulate)
        del drawn[steps // in_epoch * 5 + steps % in_epoch * accumulate :]
    fit(tmp_path, Cut(), resume=last, accumulate_grad_batches=accumulate)
    # 16 steps: full epochs of 5 batches, then the rest.
    epochs, rest = divmod(STEPS, in_epoch)
    assert drawn[: 5 * epochs + rest * accumulate] == list(range(5 * epochs + rest * accumulate))


@pytest.mark.parametrize("elsewhere", [False, True])
def test_a_run_with_frozen_weights_resumes_from_one_file_of_them(tmp_path, monkeypatch, elsewhere):
    """A killed run resumes to the weights of an uninterrupted one, also in another folder after the first
    is deleted."""

    def half_frozen():
        subject = module()
        subject.model.depth.requires_grad_(False)
        return subject

    monkeypatch.setattr(frozen, "OWN", 0)
    expected = fit(tmp_path / "whole", Cut(), subject=half_frozen())
    last, _ = train_until_cut(tmp_path / "a", Cut(10), subject=half_frozen())
    assert list(torch.load(last, weights_only=True)["state_dict"]) == ["model.shift"]
    target = tmp_path / ("b" if elsewhere else "a")
    subject = fit(target, Cut(), resume=last, subject=half_frozen())
    assert torch.equal(subject.model.shift, expected.model.shift)
    assert torch.equal(subject.model.depth, module().model.depth)
    if elsewhere:
        shutil.rmtree(tmp_path / "a")
    (kept,) = (target / "checkpoints").glob(frozen.PATTERN)
    assert torch.load(kept, weights_only=True) == {"model.depth": subject.model.depth.detach()}
    for name in ("best", "last"):
        assert read_checkpoint(target / "checkpoints" / f"{name}.ckpt", whole=True)["state_dict"].keys() == {
            "model.depth",
            "model.shift",
        }


def test_a_finished_run_that_is_trained_on_counts_on(tmp_path, monkeypatch):
    """Steps 5 to 8 must not be logged as 6 to 9."""
    monkeypatch.setattr("tests.training.test_resume.STEPS", 4)  # with a validation at its end
    subject = fit(tmp_path, Cut())
    last = tmp_path / "checkpoints" / "last.ckpt"
    subject.trainer.save_checkpoint(last)
    monkeypatch.setattr("tests.training.test_resume.STEPS", 9)
    fit(tmp_path, Cut(), resume=last)
    assert [int(row["step"]) for row in rows(tmp_path) if "loss/total" in row] == list(range(1, 10))
    found = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert [e.step for e in found.Scalars("loss/total")] == list(range(1, 10))


def test_time_that_was_used_stays_used(tmp_path):
    """With a budget of time, the learning rate continues where the checkpoint left off."""
    seen = []

    class Look(Cut):
        def on_train_batch_start(self, trainer, pl_module, *_):
            seen.append(pl_module.used_budget)

        def on_train_batch_end(self, trainer, pl_module, *_):
            timer = next(c for c in trainer.callbacks if type(c).__name__ == "Timer")
            if self.at:
                timer._offset += 200  # as if each step took 200 seconds
            super().on_train_batch_end(trainer, pl_module)

    options = {"max_time": {"seconds": 1000}}
    last, _ = train_until_cut(tmp_path, Look(4), **options)
    seen.clear()
    fit(tmp_path, Look(), resume=last, **options)
    assert seen[:2] == pytest.approx([0.6, 0.6], abs=0.02)  # 3 x 200 s of 1000 s, not 3 of 16 steps
    assert seen[-1] == pytest.approx((STEPS - 1) / STEPS)


def test_a_checkpoint_of_another_model_is_refused_by_its_tensor(tmp_path):
    """Resuming requires the same model and the state of the optimizer; changed settings are reported."""

    class Other(Standin):
        def __init__(self):
            super().__init__()
            self.shift = torch.nn.Parameter(torch.zeros(4))

    path = tmp_path / "a.ckpt"
    content = {"state_dict": {f"model.{k}": v for k, v in Other().state_dict().items()}}
    content |= {"config": CONFIG, "format_version": 1, "global_step": 5, "optimizer_states": []}
    content["lr_schedulers"] = []
    torch.save(content, path)
    with pytest.raises(InputError, match=r"a\.ckpt: shift.*\(3,\).*\(4,\)"):
        check_resume(path, held(Standin()), CONFIG)
    step, changed = check_resume(
        path,
        held(Other()),
        {**CONFIG, "optimizer": {"lr": 0.1}, "resume": str(path), "trainer": {"max_steps": 20}},
    )
    assert (step, changed) == (5, ["optimizer.lr: 0.05 -> 0.1"])
    del content["optimizer_states"]
    torch.save(content, path)
    with pytest.raises(InputError, match=r"a\.ckpt.*optimizer_states.*init_from"):
        check_resume(path, held(Other()), CONFIG)


def test_changed_options_of_the_optimizer_apply(tmp_path, monkeypatch):
    """From the first resumed step on, the schedule applies to the new learning rate."""
    last, _ = train_until_cut(tmp_path, Cut(8))
    changed = module()
    changed.optimization = Optimization(
        lr=0.005, warmup=0.1, end_factor=0.0, betas=(0.5, 0.9), freeze_until={"shift": 0.4}
    )
    monkeypatch.setattr("tests.training.test_resume.module", lambda: changed)
    fit(tmp_path, Cut(), resume=last)
    rates = [float(row["train/learning_rate"]) for row in rows(tmp_path) if "train/learning_rate" in row]
    parts = (
        (Optimization(lr=0.05, warmup=0.1, end_factor=0.0), range(6)),
        (changed.optimization, range(6, STEPS)),
    )
    expected = [part.lr * part.factor(step / STEPS) for part, steps in parts for step in steps]
    assert rates == pytest.approx(expected, rel=1e-5)
    assert changed.optimizers().param_groups[0]["betas"] == (0.5, 0.9)


@pytest.mark.parametrize(("old", "new"), [(None, 2.5), (2.5, None)])
def test_averages_of_another_optimizer_are_refused(tmp_path, old, new):
    """Muon cannot continue from AdamW's averages, nor AdamW from Muon's."""
    before, now = (Optimization(lr=0.05, matrix_scale=scale) for scale in (old, new))
    subject = held(Standin(), now)
    subject._trainer = SimpleNamespace(ckpt_path=tmp_path / "a.ckpt")
    with pytest.raises(InputError, match=r"optimizer\.matrix_scale: expected .*a\.ckpt; found"):
        subject.on_load_checkpoint({"optimizer_states": [before.optimizer(Standin()).state_dict()]})


#: Places in a checkpoint, and the values that damage them; None: deleted.
DAMAGED = [
    ("optimizer_states/0/param_groups/0/params", [0]),
    ("optimizer_states/0/param_groups", 3),
    ("optimizer_states/0/state", None),
    ("lr_schedulers", None),
    ("lr_schedulers/0", 3),
    ("loops", {}),
    ("loops/fit_loop/epoch_loop.batch_progress", 3),
    ("callbacks/TrainingCost", 3),
]


@pytest.mark.parametrize(("place", "value"), DAMAGED)
def test_a_damaged_state_of_training_is_one_line(whole, tmp_path, place, value):
    checkpoint = torch.load(whole(1)[0] / "checkpoints" / "last.ckpt", weights_only=True)
    checkpoint["callbacks"]["TrainingCost"] = TrainingCost().state_dict()
    part = checkpoint
    *before, last = [int(key) if key.isdecimal() else key for key in place.split("/")]
    for key in before:
        part = part[key]
    if value is None:
        del part[last]
    else:
        part[last] = value
    torch.save(checkpoint, tmp_path / "a.ckpt")
    run = trainer(tmp_path, callbacks=[TrainingCost()], plugins=[AtomicCheckpointIO()])
    with pytest.raises(InputError, match=r"a\.ckpt: expected the state of a training run; found \w+:"):
        train_verb.fit(run, module(), StepData(), str(tmp_path / "a.ckpt"), 15, {})


def test_an_optimizer_whose_state_was_damaged_is_refused(tmp_path):
    """Damaged averages of the gradient would otherwise go unnoticed; the file has checksums of all
    tensors."""
    path = tmp_path / "checkpoints" / "last.ckpt"
    fit(tmp_path, Cut())
    step, _ = check_resume(path, held(Standin()), CONFIG)
    assert step == 15
    state = torch.load(path, weights_only=True)["optimizer_states"][0]["state"][0]
    content, average = path.read_bytes(), state["exp_avg"].numpy().tobytes()
    assert content.count(average) == 1
    path.write_bytes(content.replace(average, bytes(reversed(average))))
    with pytest.raises(InputError, match=r"last\.ckpt: expected .* damaged"):
        check_resume(path, held(Standin()), CONFIG)


def test_a_run_counts_the_cost_of_all_its_sessions(tmp_path):
    """Seconds and peak memory of a resumed run are those of all its sessions."""
    first, second = TrainingCost(), TrainingCost()
    last, _ = train_until_cut(tmp_path, Cut(13), more=[first])
    saved = next(v for k, v in torch.load(last, weights_only=True)["callbacks"].items() if "Cost" in k)
    earlier = saved["time_elapsed"]["train"]
    assert 0 < earlier < first.seconds
    assert saved["peak_bytes"] > 2**20
    second.on_train_start = lambda *_: None  # a session whose timer never starts
    fit(tmp_path, Cut(), resume=last, more=[second])
    assert second.seconds == earlier
    third = TrainingCost()
    fit(tmp_path, Cut(), resume=last, more=[third])
    assert third.seconds > earlier
    assert third.peak_bytes >= saved["peak_bytes"]


def test_one_way_to_start(tmp_path):
    """init_from together with resume is ambiguous, except for a run that began with init_from."""
    both = run_of("train", ["resume=elsewhere/last.ckpt", "init_from=a.ckpt"])
    with pytest.raises(InputError, match="init_from"):
        check_start(both, tmp_path)
    check_start(both.replace(resume=str(tmp_path / "checkpoints" / "last.ckpt")), tmp_path)
    check_start(both.replace(resume=None), tmp_path)


@pytest.mark.parametrize(
    ("minutes", "steps", "saved"), [(1e-6, 1000, STEPS), (1000, 5, 15), (1000, 1000, None)]
)
def test_minutes_and_steps_both_count(tmp_path, minutes, steps, saved):
    """Checkpoints are saved by time and by steps, a combination that Lightning's class rejects."""
    by_both = CheckpointOptions(filename="both", minutes=minutes, every_n_train_steps=steps).build()
    fit(tmp_path, Cut(), every=1000, more=[by_both])
    path = tmp_path / "checkpoints" / "both.ckpt"
    assert (torch.load(path, weights_only=True)["global_step"] if path.exists() else None) == saved
