"""``ghgs predict``: turn photographs into a splat and the other files of ``formats``."""

import contextlib
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from ghgs_capture import export
from ghgs_capture.backgrounds import BACKGROUND_INSTANTS, Backgrounds
from ghgs_capture.capture import Capture
from ghgs_capture.export.reports import REPORT
from ghgs_capture.folder import CaptureFolder
from ghgs_capture.prediction import CapturePrediction, crop_size, predict, predict_batch, without_tones
from ghgs_capture.rig import INSTANTS, Rig, correct_rig, spread
from ghgs_capture.verbs.photographs import capture_folder, check_cameras
from ghgs_lit.cli import inputs
from ghgs_lit.cli.runtime import announce, output_dir, write_config
from ghgs_lit.errors import InputError, require
from ghgs_lit.execution import Predictor
from ghgs_lit.files import resolve_path
from ghgs_lit.parsing import read_json
from ghgs_lit.rendering import Renderer
from ghgs_lit.weights.checkpoint import read_config

if TYPE_CHECKING:  # importing Lightning takes seconds
    from ghgs_capture.verbs import Predict

#: PSNR in dB, in the subject's box, below which the rendering of an input view is poor.
LOW_PSNR = 25.0


@torch.no_grad()
def run(verb: "Predict") -> None:
    """Predict the user's photographs, or a subject of a data set, and write the files."""
    directory = output_dir() if verb.out is None else resolve_path(verb.out)
    is_capture = verb.images is not None or verb.cameras is not None
    verb = verb if is_capture else inputs.with_trained_data(verb)
    verb = verb.replace(**inputs.model_of(verb.checkpoint, verb))
    (predict_photographs if is_capture else predict_subject)(verb, directory)
    announce(directory)


def predict_subject(run: "Predict", directory: Path) -> None:
    """Predict a subject of a data set and write its files.

    Args:
        run: with the checkpoint's model options.
        directory: where files are written.

    Raises:
        InputError: there is no such subject, or an option does not apply to data sets.
    """
    expected = "0 without images=...: photographs of data sets are on black"
    require(run.refine_masks in (0, "auto"), "refine_masks", expected, run.refine_masks)
    output = export.output_options(run)
    device = inputs.pick_device(run.device)
    renderer = inputs.build_renderer(run, device)
    model = inputs.load_predictor(run.plain, run.checkpoint, device, run.precision)
    data = inputs.build_data(run)
    inputs.check_size(data, model)
    write_config(run, directory)
    data.prepare_data([run.split])
    names = list(data.subjects(run.split))
    numbers = {str(number): name for number, name in enumerate(names)}
    subject = run.subject if run.subject in names else numbers.get(run.subject)
    expected = f"0 to {len(names) - 1} or a name such as {names[0]}"
    require(subject is not None, "subject", expected, run.subject)
    batch = data.evaluation_batch(subject, run.split, targets=run.targets).to(device)
    rounds = 0 if run.refine_cameras == "auto" else run.refine_cameras
    result = predict_batch(batch, model, renderer, rounds, run.refine)
    write_result(directory, result, renderer, run.checkpoint, output)


def predict_photographs(run: "Predict", directory: Path) -> None:
    """Predict each instant of a folder of photographs and write its files.

    If there are several instants, each gets a folder, next to files that cover all of them.

    Args:
        run: with the checkpoint's model options.
        directory: where files are written.

    Raises:
        InputError: no instant can be read, or a file or option is wrong.
    """
    folder = capture_folder(run)
    output = export.output_options(run)
    directories, together = _free_places(folder, output, directory)
    if run.check_cameras:
        check_cameras(folder)
    device = inputs.pick_device(run.device)
    renderer = inputs.build_renderer(run, device)
    model = inputs.load_predictor(run.plain, run.checkpoint, device, run.precision)
    size = crop_size(run.size, read_config(run.checkpoint), model)
    write_config(run, directory)
    refining: dict[str, Any] = {
        "refine_cameras": run.refine_cameras,
        "refine_masks": run.refine_masks,
        "refine": run.refine,
        "tones": run.refine_tones or {},
    }
    count = 0
    rig = None
    backgrounds = Backgrounds({})
    if together:
        shared = estimate_shared(folder, model, size, refining, renderer)
        refining["tones"], backgrounds, rig = shared
        refining["refine_cameras"] = 0
    begin = time.perf_counter()
    for given in read_captures(folder):
        capture = mend_masks(backgrounds, given)
        capture = rig.apply(capture) if rig else capture
        result = predict(capture, model, size, **refining, renderer=renderer)
        place = directories[capture.name]
        write_result(place, result, renderer, run.checkpoint, output)
        if together:
            print(place, flush=True)
            together.add(place, result.batch, result.prediction, renderer)
        count += 1
        if count == 1:
            _warn_of(place)
    left_out = len(folder.instants) - count
    require(count > 0, str(folder.images), "an instant that can be read", f"none of {left_out}")
    if together:
        together.write(directory)
        print(f"{count} instants, {count / (time.perf_counter() - begin):.3g} a second", flush=True)
    if left_out:
        print(f"left out: {left_out} of {len(folder.instants)} instants", flush=True)


def _warn_of(directory: Path) -> None:
    """Print the tone curves in a prediction's report, and whether input views are rendered poorly."""
    report = read_json(directory / REPORT)
    for name, gamma in report.get("tones", {}).items():
        print(
            f"photograph {name} has a gamma of about {gamma:.2f} beside the others:"
            " undone (refine_tones=0 leaves it)",
            flush=True,
        )
    quality = [psnr for psnr in report["psnr_box_of_inputs"].values() if psnr is not None]
    if quality and min(quality) < LOW_PSNR:
        print(
            f"photographs come back at {min(quality):.1f} to {max(quality):.1f} dB only, sound ones at 30 or"
            f" more: mostly cameras or masks are off; {directory / export.SHEET} shows where",
            flush=True,
        )


def _moved_line(moved: Mapping[str, float]) -> str:
    """Message about corrected cameras: pixels by which the subject moved in each photograph."""
    return f"refine_cameras: moved by {', '.join(f'{name} {p:.2f}' for name, p in moved.items())} pixels"


def _free_places(
    folder: CaptureFolder, output: export.OutputOptions, directory: Path
) -> tuple[dict[str, Path], export.Instants | None]:
    """Directory of each instant by name, and the files that cover several instants (None for one).

    Raises InputError if writing would replace an input or a file that no prediction wrote."""
    several = len(folder.instants) > 1
    read = folder.input_files
    directories = {name: directory / name if several else directory for name in folder.instants}
    together = export.Instants(output) if several else None
    for name, path in directories.items():
        export.require_free(path, export.output_files(output, list(folder.paths[name])), read)
    if together:
        export.require_free(directory, together.files, read)
    return directories, together


def estimate_shared(
    folder: CaptureFolder,
    model: Predictor,
    size: tuple[int, int],
    refining: Mapping[str, Any],
    renderer: Renderer,
) -> tuple[Mapping[str, float], Backgrounds, Rig | None]:
    """Estimate tone curves, static backgrounds and corrected cameras of a sequence from some instants.

    Args:
        folder: folder with several instants.
        model: in evaluation mode.
        size: (height, width) of the crops in pixels.
        refining: ``refine_cameras``, ``refine_masks`` and ``tones`` as for
            :func:`ghgs_capture.prediction.predict`.
        renderer: renders the comparisons of the refinement.

    Returns:
        Gammas by camera (from the first instant), backgrounds, and corrected cameras (None if they
        remain unchanged).
    """
    begin = time.perf_counter()
    names = folder.instants
    captures = []
    rounds = refining["refine_cameras"]
    masks = refining["refine_masks"]
    tones = refining["tones"]
    is_needed = bool(rounds or masks or tones)
    count = BACKGROUND_INSTANTS if masks else INSTANTS
    for name in spread(names, count) if is_needed else ():
        with contextlib.suppress(InputError):  # this instant is left out
            captures.append(Capture(name, folder.photographs(name)))
    if tones == "auto":
        plain = {"refine_cameras": 0, "refine_masks": 0, "renderer": renderer}
        tones = predict(captures[0], model, size, **plain).tones if captures else {}
    backgrounds = Backgrounds.of(captures if masks else [])
    captures = spread(captures, INSTANTS)
    mended = [without_tones(backgrounds.apply(capture), tones) for capture in captures]
    rig = correct_rig(mended, model, size, rounds, masks, renderer) if captures and rounds else None
    if rig is not None:
        why = f"; {rig.why} (refine_cameras=0 leaves them)" if rig.why else ""
        took = time.perf_counter() - begin
        print(f"{_moved_line(rig.moved)} in all instants{why}; {took:.3g} s", flush=True)
    return tones, backgrounds, rig


def mend_masks(backgrounds: Backgrounds, given: Capture) -> Capture:
    """Correct masks by static backgrounds and print which ones changed.

    Args:
        backgrounds: without any, nothing changes.
        given: an instant.
    """
    capture = backgrounds.apply(given)
    both = zip(given.photographs, capture.photographs, strict=True)
    if mended := [after.name for before, after in both if after is not before]:
        line = f"instant {given.name}: the background mends masks of {', '.join(mended)}"
        print(f"{line} (refine_masks=0 leaves them)", flush=True)
    return capture


def read_captures(folder: CaptureFolder, names: Sequence[str] | None = None) -> Iterator[Capture]:
    """Read instants of a folder one by one, decoding the next one in the background.

    If there are several, those that cannot be read are left out with a message.

    Args:
        folder: folder with one or several instants.
        names: names of the instants; None: all.

    Raises:
        InputError: the only instant cannot be read.
    """
    names = folder.instants if names is None else names
    several = len(folder.instants) > 1
    with ThreadPoolExecutor(1) as pool:
        following = pool.submit(folder.photographs, names[0])
        for name, after in zip(names, [*names[1:], None], strict=True):
            photographs = ()
            missing = folder.missing[name]
            try:
                photographs = following.result()
            except InputError as error:
                if not several:
                    raise
                print(f"instant {name} is left out: {error}", flush=True)
            if after is not None:
                following = pool.submit(folder.photographs, after)
            if not photographs:
                continue
            for camera, why in missing.items() if several else ():
                print(f"instant {name} is without {camera}: {why}", flush=True)
            yield Capture(name, photographs)


def write_result(
    directory: Path,
    result: CapturePrediction,
    renderer: Renderer,
    checkpoint: str,
    options: export.OutputOptions,
) -> None:
    """Write the files of a prediction and print which corrections were made.

    Args:
        directory: where files are written.
        result: prediction of one subject.
        renderer: renders the images in the files.
        checkpoint: name of the weights, for the report.
        options: formats and their options.
    """
    facts: dict[str, Any] = {"checkpoint": checkpoint, "why": result.why}
    why = {name: f"; {doubt} ({name}=0 leaves it)" for name, doubt in result.why.items()}
    if result.changed:
        shares = ", ".join(f"{share:.1%}" for share in result.changed)
        print(f"refine_masks: changed by {shares} of the subject{why.get('refine_masks', '')}", flush=True)
        facts["refine_masks"] = list(result.changed)
    if result.moved:
        facts["refine_cameras"] = dict(zip(result.batch.views[0], result.moved, strict=True))
        print(_moved_line(facts["refine_cameras"]) + why.get("refine_cameras", ""), flush=True)
    if result.batch.log_gains is not None:
        gains = result.batch.log_gains[0].exp().tolist()
        facts["gains"] = dict(zip(result.batch.views[0], gains, strict=True))
    if result.tones:
        facts["tones"] = result.tones
    export.write_prediction(directory, result.batch, result.prediction, renderer, options, facts)
