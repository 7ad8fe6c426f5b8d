"""``ghgs adapt``: fine-tune weights on the instants of one capture."""

import json
from pathlib import Path
from typing import Any

import torch

from ghgs_capture.learning import LISTING, agrees, splits_of, write_instant
from ghgs_capture.prediction import without_tones
from ghgs_capture.rig import spread
from ghgs_capture.verbs import Adapt
from ghgs_capture.verbs.photographs import capture_folder
from ghgs_capture.verbs.predict import estimate_shared, mend_masks, read_captures
from ghgs_lit.cli.inputs import (
    build_data,
    build_renderer,
    choices,
    load_predictor,
    model_of,
    pick_device,
)
from ghgs_lit.cli.runtime import announce, files_to_write, output_dir
from ghgs_lit.cli.train import run_job, train
from ghgs_lit.config.compose import read_option
from ghgs_lit.config.options import PathText
from ghgs_lit.errors import require
from ghgs_lit.evaluation.measure import ModelMethod
from ghgs_lit.evaluation.report import measure_and_write
from ghgs_lit.files import write_text_atomically
from ghgs_lit.runs.results import read_results
from ghgs_lit.runs.run import RunDirectory
from ghgs_lit.weights.checkpoint import write_inference
from ghgs_lit.weights.reading import file_of

_INSTANTS = 60  #: Maximum number of instants, spread over a sequence, to train on
#: Loss weights for instants, which have no reference depth and body.
_WEIGHTS = {"chamfer": 0.0, "depth": 0.0, "silhouette": 0.2}


class Started(Adapt):
    """``Adapt`` with the keys of ``ghgs train`` that start a training from existing weights."""

    init_from: PathText
    init_strict: bool
    allow_random_encoder: bool
    token_budgets: None = None


def run(verb: Adapt) -> float | str | None:
    """Run the verb; Ctrl-C or SIGTERM interrupts it.

    Returns:
        Mean PSNR in dB of the held-out instants, also if the run was already complete; ``BUSY``
        (:mod:`ghgs_lit.runs.job`) if another process of a sweep works on it.
    """
    verb = verb.replace(**model_of(verb.checkpoint, verb))
    files_to_write(verb, ["out"])
    directory = RunDirectory(output_dir())
    return run_job(with_instants(verb, directory.path), directory, adapt)


def with_instants(run: Adapt, directory: Path) -> Adapt:
    """Configure the training for the instants of ``images``: one camera is the target, the others are
    the inputs.

    Args:
        run: the run as configured.
        directory: directory of the run; instants are written to its folder ``instants``.

    Raises:
        InputError: there is only one instant, or fewer than three cameras, or more than eight.
    """
    folder = capture_folder(run)
    require(len(folder.instants) > 1, "images", "folders of two instants or more", len(folder.instants))
    cameras = [photograph.name for photograph in folder.photographs(folder.instants[0])]
    count = len(cameras)
    require(3 <= count <= 8, "cameras", "three to eight cameras, of which one is the target", count)
    others = count - 1
    root = str(directory / "instants")
    run = run.replace(
        data={**run.plain["data"], "root": root, "cameras": cameras},
        targets={**read_option("targets", "cameras"), "per_step": 1},
    )
    return run.with_changes(
        views={"training_counts": [others], "evaluation_count": others},
        evaluation={"views": [others], "targets": ["cameras"]},
        loss={"weights": {**run.plain["loss"]["weights"], **_WEIGHTS}},
    )


def prepare_instants(run: Adapt) -> None:
    """Write the instants to train on, with the masks, cameras and gains that a prediction would use.

    Does nothing if an interrupted run has already written them.

    Args:
        run: from :func:`with_instants`.

    Raises:
        InputError: fewer than two instants have masks that agree.
    """
    root = Path(run.data.root)
    if (root / LISTING).exists():
        return
    root.mkdir(parents=True, exist_ok=True)
    folder = capture_folder(run)
    device = _device(run)
    model = load_predictor(run.plain, run.checkpoint, device)
    size = run.data.size
    refining = dict.fromkeys(("refine_cameras", "refine_masks", "tones"), "auto")
    tones, backgrounds, rig = estimate_shared(folder, model, size, refining, build_renderer(run, device))
    names = spread(folder.instants, _INSTANTS)
    used = []
    for given in read_captures(folder, names):
        if {photograph.name for photograph in given.photographs} != set(run.data.cameras):
            print(f"instant {given.name} is not learned from: its cameras are not those of the first")
            continue
        capture = without_tones(mend_masks(backgrounds, given), tones)
        if agrees(capture):
            write_instant(rig.apply(capture) if rig else capture, root, size)
            used.append(given.name)
    print(f"{len(used)} of {len(names)} instants have masks that agree, and are learned from", flush=True)
    write_text_atomically(root / LISTING, json.dumps(splits_of(used)))


def adapt(run: Adapt, directory: Path, stats: dict[str, Any]) -> float | None:
    """Prepare the instants, train and write the weights.

    Args:
        run: from :func:`with_instants`.
        directory: directory of the run; the weights are written there unless ``out`` is given.
        stats: receives statistics of the training, as for :func:`ghgs_lit.cli.train.train`.

    Returns:
        Mean PSNR in dB of the held-out instants after training; None if it was interrupted.
    """
    prepare_instants(run)
    data = build_data(run)
    data.prepare_data()
    device = _device(run)
    method = ModelMethod(load_predictor(run.plain, run.checkpoint, device), build_renderer(run, device))
    place = directory / "before"
    path = measure_and_write({"model": method}, data, run, place, device, verb="adapt", choices=choices())
    before = read_results(path)["summary"][0]["psnr"]
    del method  # frees memory for the training
    # Stages are frozen at first only where training starts from random weights.
    seconds = 60 * run.plain["minutes"]
    limited = run.with_changes(trainer={"max_time": {"seconds": seconds}}, optimizer={"freeze_until": {}})
    start = {"init_from": str(file_of(run.checkpoint)), "init_strict": True, "allow_random_encoder": False}
    after = train(Started.of({**limited.plain, **start}), directory, stats)
    if after is None:
        return None
    out = Path(run.out or directory / "adapted.ckpt").expanduser()
    write_inference(directory / "checkpoints" / "last.ckpt", out, "float16")
    count = len(data.subjects("val"))
    print(
        f"{count} photographs of instants that were not learned from, each from the other cameras:"
        f" {before:.2f} dB before, {after:.2f} dB after",
        flush=True,
    )
    announce(out)
    return after


def _device(run: Adapt) -> torch.device:
    return pick_device("cpu" if run.trainer.accelerator == "cpu" else "auto")
