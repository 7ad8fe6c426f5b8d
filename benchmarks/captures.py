"""Loss of quality by imperfect captures: built-in people, photographed in twelve ways, with the same targets.

    python benchmarks/captures.py model.ckpt
    python benchmarks/captures.py shipped --mend --people 12 --first 4

Each capture has one imperfection, the last one all of them. With ``--mend`` there are other captures,
predicted as given and as corrected automatically by ``ghgs predict``. Photographs have a background
and twice the size of the model's input, and are processed like a user's (``Capture``): cropped to the
subject. Targets are always those of the clean rig, so that a loss is due to the prediction. Prints
PSNR of exact photographs and the loss of each capture, whole and in the box.
"""

import argparse
import dataclasses
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ghgs_capture.capture import Capture
from ghgs_capture.crops import Photograph
from ghgs_capture.prediction import predict, trained_size
from ghgs_lit import GHGS
from ghgs_lit.cli.inputs import build_data, build_renderer, pick_device
from ghgs_lit.config import run_of
from ghgs_lit.config.compose import read_option
from ghgs_lit.config.options import image_size
from ghgs_lit.config.run import Run
from ghgs_lit.data.augmentation import Augmentation
from ghgs_lit.data.datamodule import PhotographsDataModule
from ghgs_lit.data.imperfections import sample_backgrounds
from ghgs_lit.data.sampling import even_positions, subject_rng
from ghgs_lit.evaluation.measure import ModelMethod, measure
from ghgs_lit.execution import Predictor
from ghgs_lit.geometry.masks import signed_distance
from ghgs_lit.geometry.rotations import quaternion_to_matrix
from ghgs_lit.rendering import Renderer
from ghgs_lit.types import Batch
from ghgs_lit.weights.checkpoint import read_checkpoint

_RING, _VIEWS = 16, 4
_EVEN = even_positions(_RING, _VIEWS)
_UNEVEN = [0, 5, 7, 12]
_TARGETS = ("release", "midway")
#: Ratio of the sides of photographs and crops. Limits in pixels refer to crops.
_LARGER = 2
_PIXELS = ("mask_offset", "mask_ragged", "calibration")
_HELD = {"camera_pitch": 6.0, "camera_roll": 8.0, "camera_look_at": 0.08}
_COLORS = {"exposure": 0.5, "white_balance": 0.25}
_OUTLINES = {"mask_offset": 1.5, "mask_ragged": 2.0}
_PIECES = {"mask_hole_chance": 1.0}


@dataclass(frozen=True)
class Imperfection:
    """Difference of a capture: ``data.rig.variation``, positions of the inputs, and :class:`Augmentation`.

    Photographs have exact mattes, or ``masks`` of 0 and 1, dilated by ``grown`` pixels. ``bumped``:
    the only camera with a wrong calibration; None: all are wrong. The first camera is turned by
    ``turned`` pixels, its focal length is multiplied by ``zoom``, and its colours are raised to the
    power ``gamma``.
    """

    rig: Mapping[str, Any] = field(default_factory=dict)
    positions: list[int] = field(default_factory=lambda: _EVEN)
    augmentation: Mapping[str, float] = field(default_factory=dict)
    masks: bool = False
    bumped: int | None = None
    grown: float = 0.0
    turned: float = 0.0
    zoom: float = 1.0
    gamma: float = 1.0


#: Captures of ``--mend``. Names count pixels of photographs, which are twice as large as crops.
MENDED = {
    "exact": Imperfection(),
    "exact masks": Imperfection(masks=True),
    "masks grown by 4 px": Imperfection(masks=True, grown=2.0),
    "masks eroded by 4 px": Imperfection(masks=True, grown=-2.0),
    "one camera turned by 3 px": Imperfection(turned=1.5),
    "one camera turned by 6 px": Imperfection(turned=3.0),
    "all cameras up to 3 px": Imperfection(augmentation={"calibration": 1.5}),
    "one focal length 3 % off": Imperfection(zoom=1.03),
    "one gamma of 1.2": Imperfection(gamma=1.2),
    "one gamma of 0.8": Imperfection(gamma=0.8),
}
CAPTURES = {
    "clean": Imperfection(),
    "ring a third wider": Imperfection({"radius": [2.67, 2.67]}),
    "from 3.4 m, longer lens": Imperfection({"radius": [3.4, 3.4], "fill": [0.7, 0.7]}),
    "20 degrees farther down": Imperfection({"pitch": [-28.0, -28.0]}),
    "rolled, tilted, shifted": Imperfection(_HELD),
    "uneven angles": Imperfection(positions=_UNEVEN),
    "exposure, white balance": Imperfection(augmentation=_COLORS),
    "masks in place of mattes": Imperfection(masks=True),
    "masks off and ragged": Imperfection(augmentation=_OUTLINES, masks=True),
    "masks with holes": Imperfection(augmentation=_PIECES, masks=True),
    "calibration up to 3 px": Imperfection(augmentation={"calibration": 3.0}),
    "one camera up to 6 px": Imperfection(augmentation={"calibration": 6.0}, bumped=2),
    "all at once": Imperfection(
        {"radius": [2.67, 2.67], "pitch": [-28.0, -28.0], "fill": [0.7, 0.7], **_HELD},
        _UNEVEN,
        {**_COLORS, **_OUTLINES, **_PIECES, "calibration": 3.0},
        masks=True,
    ),
}


def data_of(
    capture: Imperfection, people: int, size: list[int], uneven: list[int], rendered: list[int] | None = None
) -> PhotographsDataModule:
    """People in front of a capture's rig; missing ones are rendered, in the ``rendered`` size."""
    # Inputs, and targets next to the first one and half-way to the second one.
    positions = sorted({*_EVEN, *uneven, _EVEN[1] // 2})
    overrides = [
        "data=synthetic",
        "targets.training_views=[0,3]",
        f"data.people={{train: 1, val: {people}}}",
        f"data.size={size}",
        f"data.render.size={rendered or size}",
        f"data.render.positions={positions}",
        "data.render.views=[0,3]",
        f"data.evaluation_positions=[{list(capture.positions)}]",
        *(f"data.rig.variation.{name}={value}" for name, value in capture.rig.items()),
    ]
    data = build_data(run_of("prepare", overrides))
    data.prepare_data()
    return data


def batches(
    capture: Imperfection,
    clean: PhotographsDataModule,
    own: PhotographsDataModule,
    size: tuple[int, int],
) -> Iterator[Batch]:
    """Crops of ``size`` of the photographs of a capture, with the targets of the clean rig."""
    targets = [read_option("targets", name) for name in _TARGETS]
    for batch in clean.evaluation_loader(_VIEWS, targets, batch_size=1):
        subject = batch.subjects[0]
        taken = photograph(capture, own.evaluation_batch(subject, views=_VIEWS))
        seen = taken.batch(size)
        cameras = seen.cameras.to(torch.float32)  # for baselines
        yield dataclasses.replace(seen, cameras=cameras, targets=batch.targets)


def predict_people(
    capture: Imperfection,
    data: tuple[PhotographsDataModule, PhotographsDataModule],
    first: int,
    model: GHGS,
    size: tuple[int, int],
    renderer: Renderer,
    refine: int | str,
) -> Iterator[Batch]:
    """Batches after the preparation by ``predict``, from person ``first`` on, with the targets of the rig."""
    targets = [read_option("targets", name) for name in _TARGETS]
    clean, own = data
    for subject in list(clean.subjects("val"))[first:]:
        taken = photograph(capture, own.evaluation_batch(subject, views=_VIEWS))
        keys = {"refine_cameras": refine, "refine_masks": refine, "tones": refine or {}}
        result = predict(taken, model, size, **keys, renderer=renderer)
        if refine:
            moved = "".join(f" {pixels:.2f}" for pixels in result.moved)
            print(f"  {subject}: {(result.why | result.tones) or 'nothing'}{moved}", flush=True)
        batch = clean.evaluation_batch(subject, views=_VIEWS, targets=targets)
        cameras = result.batch.cameras.to(torch.float32)
        yield dataclasses.replace(result.batch, cameras=cameras, targets=batch.targets)


def photograph(capture: Imperfection, batch: Batch) -> Capture:
    """Capture of one subject, composed with a background, from images on black."""
    subject = batch.subjects[0]
    limits = {k: v * (_LARGER if k in _PIXELS else 1) for k, v in capture.augmentation.items()}
    colors = Augmentation(**{k: v for k, v in limits.items() if k in _COLORS})
    seen, wrong = (
        augmentation.add_imperfections(batch, [subject_rng(0, subject)])
        for augmentation in (colors, Augmentation(**limits))
    )
    behind = sample_backgrounds(_VIEWS, *batch.masks.shape[2:], subject_rng(1, subject))
    images = seen.images + (1 - batch.alpha[:, :, None]) * torch.from_numpy(behind).float()
    images[:, 0] **= capture.gamma
    mattes = wrong.masks.float() if capture.masks else batch.alpha
    if capture.grown:
        grown = [signed_distance(mask.numpy()) + _LARGER * capture.grown > 0 for mask in batch.masks[0]]
        mattes = torch.from_numpy(np.stack(grown)).float()[None]
    pixels = (255 * images[0].movedim(1, -1)).round().byte().numpy()
    shares = (255 * mattes[0]).round().byte().numpy()
    is_wrong = torch.tensor([capture.bumped in (None, view) for view in range(_VIEWS)])[:, None, None]
    matrices = [
        torch.where(is_wrong, getattr(wrong.cameras, name)[0], getattr(batch.cameras, name)[0])
        for name in ("intrinsics", "extrinsics")
    ]
    matrices = [one.double().numpy() for one in matrices]
    _knock(matrices[0][0], matrices[1][0], capture, subject)
    views = zip(batch.views[0], pixels, shares, *matrices, strict=True)
    return Capture(subject, tuple(Photograph(*view) for view in views))


def _knock(lens: np.ndarray, pose: np.ndarray, capture: Imperfection, subject: str) -> None:
    """Turn and zoom one camera in place, about an axis in its image plane that depends on the subject."""
    angle = subject_rng(2, subject).uniform(0, 2 * math.pi)
    turn = math.tan(_LARGER * capture.turned / lens[0, 0] / 2)
    rotation = torch.tensor([1.0, turn * math.cos(angle), turn * math.sin(angle), 0.0], dtype=torch.float64)
    pose[:3] = quaternion_to_matrix(rotation[None])[0].numpy() @ pose[:3]
    lens[[0, 1], [0, 1]] *= capture.zoom


def means(rows: list[dict]) -> dict[str, float]:
    """PSNR by target and region, and the depth error where the method has one, over the subjects."""
    found = {
        f"{target}_{name}": sum(row[name] for row in rows if row["targets"] == target)
        / sum(row["targets"] == target for row in rows)
        for target in _TARGETS
        for name in ("psnr", "psnr_box")
    }
    errors = [row["depth_error_mm"] for row in rows if row.get("depth_error_mm") is not None]
    return found | ({"depth_error_mm": sum(errors) / len(errors)} if errors else {})


def table(results: Mapping[str, dict[str, float]]) -> str:
    """Format the clean rig, and the loss of each capture."""
    clean, single = results["clean"], [n for n in results if n not in ("clean", "all at once")]
    mean = {name: sum(results[n][name] for n in single) / len(single) for name in clean}
    lines = ["| capture | " + " | ".join(clean) + " |", "|---" * (len(clean) + 1) + "|"]
    lines.append("| clean | " + " | ".join(f"{value:.2f}" for value in clean.values()) + " |")
    for name, row in (
        *((n, results[n]) for n in single),
        ("mean", mean),
        ("all at once", results["all at once"]),
    ):
        lines.append(f"| {name} | " + " | ".join(f"{row[k] - clean[k]:+.2f}" for k in clean) + " |")
    return "\n".join(lines)


def measure_mending(
    options: argparse.Namespace, size: tuple[int, int], run: Run, device: torch.device
) -> None:
    """Print the quality of captures as given and as corrected by ``predict``."""
    renderer, model = build_renderer(run, device), Predictor.from_checkpoint(options.checkpoint, device)
    metrics, larger = run.metrics.build().to(device), [_LARGER * side for side in size]
    data = tuple(data_of(Imperfection(), options.people, side, [], larger) for side in (list(size), larger))
    method = ModelMethod(model, renderer)
    for name, capture in MENDED.items():
        print(name, flush=True)
        shown = []
        for refine in (0, "auto"):
            seen = predict_people(capture, data, options.first, model, size, renderer, refine)
            row = means(measure(method, name, seen, metrics, device))
            shown += [f"{row[f'{target}_psnr']:.2f}" for target in _TARGETS]
        print(f"| {name} | {' | '.join(shown)} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--people", type=int, default=8)
    parser.add_argument("--size", type=int, help="side in pixels; none: the checkpoint's")
    parser.add_argument("--mend", action="store_true", help="what predict mends by itself, and nothing else")
    parser.add_argument("--first", type=int, default=0, help="with --mend: people before it take no part")
    options = parser.parse_args()
    if not 0 <= options.first < options.people:
        parser.error(f"--first: expected a person of --people {options.people}; found {options.first}")
    run = run_of("evaluate", ["data=synthetic", "metrics.lpips=off"])
    device = pick_device(run.device)
    size = options.size or trained_size(read_checkpoint(options.checkpoint)["config"])
    size = image_size("size", size)
    if options.mend:
        measure_mending(options, size, run, device)
        return
    renderer, model = build_renderer(run, device), Predictor.from_checkpoint(options.checkpoint, device)
    method, metrics = ModelMethod(model, renderer), run.metrics.build().to(device)
    clean = data_of(CAPTURES["clean"], options.people, list(size), _UNEVEN)
    larger = [_LARGER * side for side in size]
    results = {}
    for name, capture in CAPTURES.items():
        own = data_of(capture, options.people, larger, _UNEVEN)
        seen = batches(capture, clean, own, size)
        results[name] = means(measure(method, name, seen, metrics, device))
    print(f"{options.people} people, {size[0]} x {size[1]}\n{table(results)}")


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    main()
