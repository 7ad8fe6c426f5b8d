"""``ghgs adapt``: weights for the cameras of one rig, from built-in people who stand in it, or for
one capture, from its own instants."""

import contextlib
import json
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ghgs_capture.calibration import calibrate
from ghgs_capture.capture import Capture
from ghgs_capture.export.maps import camera_entry
from ghgs_capture.folder import CaptureFolder
from ghgs_capture.formats import read_cameras
from ghgs_capture.learning import LISTING, Instants, agrees, splits_of, write_instant
from ghgs_capture.rig import spread
from ghgs_capture.tones import without_tones
from ghgs_capture.verbs import Adapt
from ghgs_capture.verbs.photographs import capture_folder
from ghgs_capture.verbs.predict import mended_by, shared_by
from ghgs_lit.cli.inputs import (
    build_data,
    build_renderer,
    choices,
    given_keys,
    load_model,
    model_of,
    pick_device,
)
from ghgs_lit.cli.runtime import announce, files_to_write, output_dir
from ghgs_lit.cli.train import run_job, train
from ghgs_lit.config import run_of
from ghgs_lit.config.compose import read_option
from ghgs_lit.config.options import PathText
from ghgs_lit.errors import InputError, require
from ghgs_lit.evaluation.measure import ModelMethod
from ghgs_lit.evaluation.report import measure_and_write
from ghgs_lit.files import write_text_atomically
from ghgs_lit.runs.results import read_results
from ghgs_lit.runs.run import RunDirectory
from ghgs_lit.weights.exporting import write_inference
from ghgs_lit.weights.reading import file_of

# Training people are as tall in a photograph as the user's subject, give or take this share.
_SPREAD = 0.1
# Minutes for which the training people of conf/adapt.yaml suffice;
# ten passes over them learn them by heart.
_MINUTES = 3
_INSTANTS = 60  #: Instants, spread over a sequence, that are read to learn from
#: Weights of the loss's terms for instants, of which depth and body are not known.
_WEIGHTS = {"chamfer": 0.0, "depth": 0.0, "silhouette": 0.2}
#: Keys that data sets share, which the instants take from the people's.
_SHARED = ("size", "batch_size", "cache_images_mb", "packed_gb", "resident", "resampling", "workers")
_LEARN_PEOPLE = "(learn=people needs no further ones)"


class Started(Adapt):
    """A training from the weights of ``checkpoint``, with the keys of ``ghgs train`` that it needs."""

    init_from: PathText
    init_strict: bool
    allow_random_encoder: bool
    token_budgets: None = None


def run(verb: Adapt) -> float | str | None:
    """Run the verb; Ctrl-C or SIGTERM interrupts it.

    Args:
        verb: the run.

    Returns:
        Mean PSNR in dB of validation people in the rig or of instants that were not learned from,
        also of a run that is done; ``BUSY`` (:mod:`ghgs_lit.runs.job`): in a sweep, another
        process works on it.
    """
    verb = verb.replace(**model_of(verb.checkpoint, verb))
    files_to_write(verb, ["out"])
    directory = RunDirectory(output_dir())
    return run_job(with_instants(with_rig(verb), directory.path), directory, adapt)


def with_instants(run: Adapt, directory: Path) -> Adapt:
    """Learn from the instants of ``images`` where ``learn`` says so, in place of or beside people.

    Args:
        run: of :func:`with_rig`.
        directory: of the run, where instants are kept.

    Returns:
        The run: of all cameras but one, the inputs, that one is the target.

    Raises:
        InputError: there is one instant, or fewer than three cameras.
    """
    learn = run.learn
    count = len(run.data.cameras)
    instants = [] if run.images is None or learn == "people" else capture_folder(run).instants
    if learn == "people" or (learn == "auto" and (len(instants) < 2 or count < 3)):
        return run
    expected = f"folders of two instants or more {_LEARN_PEOPLE}"
    require(len(instants) > 1, "images", expected, run.images and len(instants))
    require(count > 2, "cameras", f"three cameras or more: one is the target {_LEARN_PEOPLE}", count)
    people = run.plain["data"]
    data = {name: people[name] for name in people if name in _SHARED}
    data |= {"kind": "instants", "name": "instants", "root": str(directory / "instants")}
    data |= {"cameras": list(people["cameras"]), "beside": people if learn == "both" else None}
    weights = run.plain["loss"]["weights"]
    depth = {"depth": weights["depth"]} if learn == "both" else {}
    run = run.replace(data=data, targets={**read_option("targets", "cameras"), "per_step": 1})
    return run.changed(
        views={"training_counts": [count - 1], "evaluation_count": count - 1},
        evaluation={"views": [count - 1], "targets": ["cameras"]},
        loss={"weights": {**weights, **_WEIGHTS, **depth}},
    )


def prepare_instants(run: Adapt) -> None:
    """Write the instants that are learned from, with the masks, cameras and gains of a prediction.

    Those that an interrupted run has written are kept.

    Args:
        run: of :func:`with_instants`.

    Raises:
        InputError: fewer than two instants have masks that agree.
    """
    root = Path(run.data.root)
    if (root / LISTING).exists():
        return
    root.mkdir(parents=True, exist_ok=True)
    folder = capture_folder(run)
    device = _device(run)
    model = load_model(run.plain, run.checkpoint, device)
    size = run.data.size
    refining = dict.fromkeys(("refine_cameras", "refine_masks", "tones"), "auto")
    tones, backgrounds, rig, _ = shared_by(folder, model, size, refining, build_renderer(run, device))
    names = spread(folder.instants, _INSTANTS)
    used = []
    for given in _whole(folder, names, run.data.cameras):
        capture = without_tones(mended_by(backgrounds, given), tones)
        if agrees(capture):
            write_instant(rig.applied(capture) if rig else capture, root, size)
            used.append(given.name)
    print(f"{len(used)} of {len(names)} instants have masks that agree, and are learned from", flush=True)
    write_text_atomically(root / LISTING, json.dumps(splits_of(used)))


def _whole(folder: CaptureFolder, names: Sequence[str], cameras: Sequence[str]) -> Iterator[Capture]:
    """Captures of instants with a photograph of every camera; a line for each of the others."""
    for name in names:
        with contextlib.suppress(InputError):
            capture = Capture(name, folder.photographs(name))
            if {photograph.name for photograph in capture.photographs} == set(cameras):
                yield capture
                continue
        print(f"instant {name} is not learned from: a photograph or mask is missing", flush=True)


def with_rig(run: Adapt) -> Adapt:
    """Place the people of a run in the rig of ``cameras`` or of the data set ``data``.

    All its cameras are inputs unless ``views.training_counts`` is given.

    Args:
        run: as configured.

    Returns:
        The run with cameras, people and views of the rig.

    Raises:
        InputError: a file or the data is bad or missing, or there are not 2 to 8 cameras.
    """
    people = run.plain["data"]
    if people["kind"] != "people_in_rig":
        people = run_of("adapt").plain["data"]
        entries, fill = _cameras_of_data(run)
    elif run.images is None:
        entries = _cameras_of_file(run)
        fill = people["fill"]
    else:
        folder = capture_folder(run)
        photographs = folder.photographs(folder.instants[0])
        entries = {p.name: camera_entry(p.intrinsics, p.extrinsics, p.mask.shape) for p in photographs}
        fill = _fill_of([p.mask for p in photographs])
    count = len(entries)
    require(2 <= count <= 8, "cameras", "2 to 8 cameras, those of the photographs in images=", count)
    is_given = "views.training_counts" in given_keys()
    trained = list(run.views.training_counts) if is_given else [count]
    data = {**people, **_more_people(people, run.minutes), "cameras": entries, "fill": fill}
    views = {"training_counts": trained, "evaluation_count": count}
    return run.replace(data=data).changed(views=views, evaluation={"views": [count]})


def _more_people(data: dict[str, Any], minutes: float) -> dict[str, dict[str, int]]:
    """Numbers of people of each kind, as many more to train on as ``minutes`` exceed three."""
    kinds = [k for k in ("people", "active") if {f"data.{k}", f"data.{k}.train"}.isdisjoint(given_keys())]
    return {k: {**data[k], "train": round(data[k]["train"] * max(1, minutes / _MINUTES))} for k in kinds}


def _cameras_of_data(run: Adapt) -> tuple[dict[str, dict[str, Any]], list[float]]:
    """Input cameras of the first validation subject, and the ``fill`` that its masks suggest."""
    for name in ("images", "cameras"):
        path = getattr(run, name)
        require(path is None, name, "null beside data=<data set>, which has cameras", path)
    data = build_data(run)
    data.prepare_data()
    subjects = list(data.subjects("val"))
    require(subjects != [], "data", "a subject in the split val", subjects)
    batch = data.evaluation_batch(subjects[0])
    cameras = batch.cameras[0]
    masks = batch.masks[0].numpy()
    pairs = zip(cameras.intrinsics.numpy(), cameras.extrinsics.numpy(), strict=True)
    entries = {f"camera_{i}": camera_entry(*pair, masks.shape[1:]) for i, pair in enumerate(pairs)}
    return entries, _fill_of(masks)


def _cameras_of_file(run: Adapt) -> dict[str, dict[str, Any]]:
    """Entries of the calibration that ``cameras`` names.

    Args:
        run: as configured.

    Returns:
        Those of :func:`ghgs_capture.export.maps.camera_entry`, by name.

    Raises:
        InputError: there is no calibration, it has no sizes, or it is wrong.
    """
    require(run.cameras is not None, "cameras", "cameras=<calibration>", None)
    file = read_cameras(run.cameras, run.calibration.format)
    convention = file.convention.with_options(dict(run.calibration))
    entries = {}
    for name, camera in file.cameras.items():
        require(camera.size is not None, camera.origin, "the photographs' size, or images=<folder>", None)
        calibration = calibrate(camera, convention, camera.size)
        entries[name] = camera_entry(calibration.intrinsics, calibration.extrinsics, camera.size)
    return entries


def _fill_of(masks: Sequence[np.ndarray]) -> list[float]:
    """[least, greatest] share of the photograph's height that training people take."""
    tallest = max(np.ptp(np.nonzero(mask.any(1))[0]) / len(mask) for mask in masks)
    return [float(np.clip(tallest * (1 + side * _SPREAD), 0.05, 0.99)) for side in (-1, 1)]


def adapt(run: Adapt, directory: Path, stats: dict[str, Any]) -> float | None:
    """Render people, train and write the weights.

    Args:
        run: of :func:`with_rig`.
        directory: of the run; the weights go there unless ``out`` is given.
        stats: gets the facts of the training, as for :func:`ghgs_lit.cli.train.train`.

    Returns:
        Mean PSNR in dB of validation people after training; None: it was interrupted.
    """
    begin = time.perf_counter()
    learns_instants = isinstance(run.data, Instants)
    if learns_instants:
        prepare_instants(run)
    data = build_data(run)
    data.prepare_data()
    rendered = time.perf_counter() - begin
    device = _device(run)
    method = ModelMethod(load_model(run.plain, run.checkpoint, device), build_renderer(run, device))
    place = directory / "before"
    path = measure_and_write({"model": method}, data, run, place, device, verb="adapt", choices=choices())
    before = read_results(path)["summary"][0]["psnr"]
    del method  # the training needs its memory
    # Stages are frozen at first only where training starts from random weights.
    seconds = 60 * run.plain["minutes"]
    limited = run.changed(trainer={"max_time": {"seconds": seconds}}, optimizer={"freeze_until": {}})
    start = {"init_from": str(file_of(run.checkpoint)), "init_strict": True, "allow_random_encoder": False}
    after = train(Started.of({**limited.plain, **start}), directory, stats)
    if after is None:
        return None
    out = Path(run.out or directory / "adapted.ckpt").expanduser()
    write_inference(directory / "checkpoints" / "last.ckpt", out, "float16")
    count = len(data.subjects("val"))
    measured = f"{count} people that were not trained on, half-way between the cameras"
    if learns_instants:
        measured = f"{count} photographs of instants that were not learned from, each from the other cameras"
    print(
        f"{measured}: {before:.2f} dB before, {after:.2f} dB after"
        f" ({rendered:.0f} s of preparing, {stats['seconds']:.0f} s of training)",
        flush=True,
    )
    if after <= before:
        print(f"no better: checkpoint={run.checkpoint} stays the better one for this rig", flush=True)
    announce(out)
    return after


def _device(run: Adapt) -> torch.device:
    return pick_device("cpu" if run.trainer.accelerator == "cpu" else "auto")
