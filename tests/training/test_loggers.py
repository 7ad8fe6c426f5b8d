"""Contents of TensorBoard and CSV logs (tags, pictures, HParams), and their continuation."""

import csv
import threading
import time
import warnings

import lightning.pytorch as L
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.backend.event_processing.event_file_loader import EventFileLoader
from tensorboard.plugins.hparams import plugin_data_pb2

from ghgs_lit.config import build
from ghgs_lit.training import GHGSModule, Optimization
from ghgs_lit.training.callbacks import PicturesOptions
from ghgs_lit.training.loggers import (
    CsvLog,
    TensorBoardLog,
    begin,
    close,
    final_numbers,
    hyperparameters,
    log_results,
)
from tests.helpers.losses import losses_of
from tests.helpers.training import Standin, StepData, flat_renderer


def events(folder) -> EventAccumulator:
    found = EventAccumulator(
        str(folder), size_guidance={"images": 0, "tensors": 0, "scalars": 0, "histograms": 0}
    )
    return found.Reload()


def steps_in_files(folder, tag) -> list[int]:
    """Steps of a tag in the files themselves, including those that TensorBoard would hide."""
    found = [e for path in folder.glob("events.*") for e in EventFileLoader(str(path)).Load()]
    return sorted(e.step for e in found for value in e.summary.value if value.tag == tag)


def hparams(folder, tag) -> plugin_data_pb2.HParamsPluginData:
    content = events(folder).SummaryMetadata(tag).plugin_data.content
    return plugin_data_pb2.HParamsPluginData.FromString(content)


def loggers(folder):
    return [
        TensorBoardLog(folder, name="tensorboard", version=""),
        CsvLog(folder, name="csv", version="", flush_logs_every_n_steps=1),
    ]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    subject = GHGSModule(
        Standin(),
        flat_renderer,
        losses_of({"render_l1": 0.8, "chamfer": 1.0}),
        Optimization(lr=0.05, end_factor=0.0),
        {"seed": 1},
    )
    subject.metrics.lpips = lambda image, target: (image - target).abs().mean((1, 2, 3))
    trainer = L.Trainer(
        accelerator="cpu", max_steps=8, max_epochs=-1, default_root_dir=folder, logger=loggers(folder),
        callbacks=[PicturesOptions(subjects=1).build()],
        enable_checkpointing=False, enable_model_summary=False, enable_progress_bar=False,
        num_sanity_val_steps=0, check_val_every_n_epoch=None, val_check_interval=4, log_every_n_steps=2,
    )  # fmt: skip
    trainer.fit(subject, StepData())
    values = {"ablation": "full", "seed": 1, "lr": 0.1}
    log_results(
        trainer.loggers,
        values,
        [
            {"views": 3, "targets": "release", "psnr": 29.0, "ssim": 0.8},
            {"views": 4, "targets": "release", "psnr": 30.0, "ssim": None, "flip": 0.1},
        ],
        "| PSNR |",
        8,
    )
    return folder


def test_tags_are_those_that_the_documentation_lists(run):
    """The tags are exactly those, without the epoch; after eight steps, logged every second, and two
    validations only HParams has a single point."""
    found = events(run / "tensorboard")
    tags = set(found.Tags()["scalars"])
    groups = {tag.split("/")[0] for kind in ("scalars", "images", "histograms") for tag in found.Tags()[kind]}
    assert groups == {"loss", "measured", "train", "val", "view"}
    assert [tag for tag in tags if len(found.Scalars(tag)) < 2] == ["measured/psnr_v4_release"]
    assert tags == {
        "loss/total", "loss/render_l1", "loss/chamfer",
        "train/budget", "train/gaussians", "train/gradient_norm", "train/learning_rate",
        "train/skipped_steps",
        "val/psnr", "val/psnr_box", "val/ssim", "val/depth_error_mm", "val/lpips",
        "measured/psnr_v4_release", "val/surface_mm", "val/psnr_box_40", "val/psnr_edge", "val/spill",
        "val/sharpness",
    }  # fmt: skip


def test_the_numbers_are_those_of_the_steps(run):
    """Values are logged at the number of steps taken."""
    found = events(run / "tensorboard")
    rates = {e.step: e.value for e in found.Scalars("train/learning_rate")}
    assert sorted(rates) == [2, 4, 6, 8]
    assert rates[8] == pytest.approx(0.05 * Optimization(lr=0.05, end_factor=0.0).factor(7 / 8))
    assert [e.value for e in found.Scalars("train/budget")] == pytest.approx([1 / 8, 3 / 8, 5 / 8, 7 / 8])
    # One subject in three views of 8 x 6 pixels.
    assert {event.value for event in found.Scalars("train/gaussians")} == {144.0}
    # Terms are logged unweighted, and the total is their weighted sum.
    terms = [found.Scalars(f"loss/{name}") for name in ("total", "render_l1", "chamfer")]
    for total, l1, chamfer in zip(*terms, strict=True):
        assert total.value == pytest.approx(0.8 * l1.value + chamfer.value, rel=1e-5)


def test_pictures(run):
    """Pictures are logged at each validation."""
    found = events(run / "tensorboard")
    steps = [e.step for e in found.Scalars("val/psnr")]
    assert [e.step for e in found.Images("view/sheet/p0")] == steps == [4, 8]
    assert sorted(path.name for path in (run / "pictures").iterdir()) == ["step_000004", "step_000008"]


def test_the_session_says_what_the_run_is_and_that_it_ended(run):
    """The HParams tab shows a run's settings, final metric and success."""
    folder = run / "tensorboard"
    start = hparams(folder, "_hparams_/session_start_info").session_start_info
    assert start.hparams["ablation"].string_value == "full"
    assert start.hparams["lr"].number_value == 0.1
    assert hparams(folder, "_hparams_/session_end_info").session_end_info.status == 1
    columns = hparams(folder, "_hparams_/experiment").experiment.metric_infos
    assert [column.name.tag for column in columns] == ["measured/psnr_v4_release"]
    found = events(folder)
    assert [(event.step, event.value) for event in found.Scalars("measured/psnr_v4_release")] == [(8, 30)]
    (written,) = found.Tensors("measurement/text_summary")
    assert (written.step, written.tensor_proto.string_val[0]) == (8, b"| PSNR |")


def test_logs_resume_where_the_checkpoint_was(tmp_path):
    """The logs of a resumed run contain each step once, also after a kill while writing."""
    for logger in (first := loggers(tmp_path)):
        for step in range(10):
            logger.log_metrics({"a": step, **({"b": 1} if step % 2 else {})}, step)
        logger.save()
    with open(tmp_path / "csv" / "metrics.csv", "a") as file:
        file.write("7")  # killed while writing
    first[0].experiment.close()
    # TensorBoard sorts files of the same second by their numbers as text: 10 comes before 9.
    time.sleep(1 - time.time() % 1)
    second = loggers(tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # Lightning's warning that files will be deleted would be wrong
        begin(second, "seed: 1\n", 6)
    for logger in second:
        for step in range(6, 8):
            logger.log_metrics({"a": 100 + step, "c": 2}, step)
        logger.save()
    expected = [0, 1, 2, 3, 4, 5, 106, 107]
    with open(tmp_path / "csv" / "metrics.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [float(row["a"]) for row in rows] == expected
    assert [row["b"] for row in rows] == ["", "1", "", "1", "", "1", "", ""]
    assert steps_in_files(tmp_path / "tensorboard", "a") == list(range(1, 9))
    scalars = events(tmp_path / "tensorboard").Scalars("a")
    assert [(e.step, e.value) for e in scalars] == list(enumerate(expected, 1))
    assert [int(row["step"]) for row in rows] == list(range(1, 9))


def test_a_kill_loses_nothing_that_was_logged(tmp_path):
    """Each value is on disk as soon as it is logged, as steps before the checkpoint are not repeated."""
    csv_log, curves = (
        build({"kind": kind}, f"logger.{kind}", save_dir=str(tmp_path)) for kind in ("csv", "tensorboard")
    )
    for logger in (csv_log, curves):
        for step in range(3):
            logger.log_metrics({"loss/total": 1.0}, step)
    assert (tmp_path / "csv" / "metrics.csv").read_text().splitlines()[1:] == ["1.0,1", "1.0,2", "1.0,3"]
    assert steps_in_files(tmp_path / "tensorboard", "loss/total") == [1, 2, 3]
    close([curves])


def test_runs_of_a_sweep_leave_no_threads(tmp_path):
    """Otherwise each run of a long sweep would leak TensorBoard's writer and its memory."""
    before = threading.active_count()
    for number in range(3):
        of_run = loggers(tmp_path / str(number))
        for logger in of_run:
            logger.log_metrics({"a": 1.0}, 0)
            logger.finalize("success")  # as Lightning does when training ends
        log_results(of_run, {"seed": number}, [{"views": 4, "targets": "release", "psnr": 30.0}], "", 1)
        close(of_run)
        assert events(tmp_path / str(number) / "tensorboard").Tensors("measurement/text_summary")
    assert threading.active_count() == before


def test_hyperparameters_are_choices_and_changes():
    """Runs are compared by settings that affect results, not by folders or logging."""
    data = {"size": 140, "people": {"train": 3}}
    config = {"seed": 2, "data": data, "optimizer": {"lr": 0.1, "betas": [0, 1]}}
    choices = {
        "ablation": "full",
        "experiment": None,
        "hydra/output": "ghgs",
        "logger": "csv",
        "encoder": "s",
        "views": "v4",
    }
    overrides = ["ablation=full", "seed=2", "+data.people.train=3", "optimizer.betas=[0,1]"]
    overrides += ["hydra.run.dir=x", "~data.rig", "callbacks.last.every_n_train_steps=3"]
    assert hyperparameters(config, choices, overrides) == {
        "ablation": "full", "seed": 2, "data.people.train": 3, "optimizer.betas": "[0, 1]", "views": "v4",
    }  # fmt: skip
    assert hyperparameters(config, choices, []) == {"seed": 2, "views": "v4"}


def test_final_numbers_name_their_protocol():
    """Metrics of different protocols never share a tag."""
    summary = [
        {"method": "model", "views": 4, "targets": "release", "subjects": 2, "psnr": 30, "seconds": 1.0},
        {"method": "model", "views": 4, "targets": "midway", "subjects": 2, "psnr": 28, "lpips": None},
    ]
    expected = {"measured/psnr_v4_release": 30.0, "measured/psnr_v4_midway": 28.0}
    assert final_numbers(summary) == expected
