"""Each camera of a rig held out over a sequence, predicted from the others, and a generated person beside it.

    python benchmarks/held_out_sequence.py photographs cameras.json --out held_out_sequence --step 5 \\
        --adapted mine.ckpt --people 2

Cameras are corrected with all photographs (the calibration is theirs), once, as `ghgs predict` does; so are
colour gains, with a mean of 1 over those that predict. All ways are measured against the same masks: those of
the sequence, tested by leaving each view out and cut anew where they fail; photographs whose mask still fails
are not measured, and counted. Prints over all instants and cameras PSNR of the photograph on black, whole and
in the box of the subject; there of images scaled to one brightness; and there of the photograph as it is, the
render before the background, which asks no mask. Flicker in place (thousandths of white) of the first and
of the last; the share of instants that were predicted anew; CPU seconds of an instant without the rig's. A
black render has the flicker of the photographs. Generated people stand in the same rig, with exact masks,
cameras and exposures: what the protocol leaves of sound data. What is done stays in --out, and is not
done again.
"""

import argparse
import dataclasses
import time
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ghgs_capture.agreement import Agreement
from ghgs_capture.backgrounds import BACKGROUND_INSTANTS, Backgrounds
from ghgs_capture.capture import Capture
from ghgs_capture.crops import Photograph
from ghgs_capture.doubts import CORRECTION, doubt_of_masks
from ghgs_capture.folder import CaptureFolder
from ghgs_capture.prediction import crop_size, in_frame
from ghgs_capture.rig import INSTANTS, Rig, corrected_rig, spread
from ghgs_capture.temporal import Temporal
from ghgs_capture.verbs.adapt import with_rig
from ghgs_lit import GHGS
from ghgs_lit.cli.inputs import build_data
from ghgs_lit.config import compose, resolve
from ghgs_lit.data.view import area_image
from ghgs_lit.metrics.flicker import flicker_in_place
from ghgs_lit.metrics.functional import box_of, decibels, mean_over, psnr, psnr_box_40
from ghgs_lit.rendering import Renderer
from ghgs_lit.rounds.gains import divided
from ghgs_lit.types import Batch, Cameras, Prediction
from ghgs_lit.weights.checkpoint import read_config

#: Which masks, cameras and colour gains, whose weights,
#: and of how many instants one is predicted anew.
WAYS = {
    "as given": ("given", "given", "each", "shipped", 1),
    "auto": ("mended", "once", "once", "shipped", 1),
    "auto, temporal": ("mended", "once", "once", "shipped", 8),
    "adapted to the capture": ("mended", "once", "once", "adapted", 1),
}
COLUMNS = ("whole", "box", "box_40", "photograph", "flicker", "flicker_photograph", "anew", "seconds")


class Measured:
    """A sequence, and what was found of it so far."""

    def __init__(self, images: Path, cameras: Path, out: Path, step: int, adapted: str | None):
        self.folder = CaptureFolder(images, cameras)
        self.out = out
        self.models = {"shipped": GHGS.from_checkpoint("shipped").eval()}
        if adapted is not None:
            self.models["adapted"] = GHGS.from_checkpoint(adapted).eval()
        self.renderer = Renderer()
        self.size = crop_size(None, read_config("shipped"), self.models["shipped"])
        self.names = self.folder.instants[::step]
        out.mkdir(parents=True, exist_ok=True)

    def kept(self, name: str, make: Callable[[], Any]) -> Any:
        path = self.out / f"{name}.pt"
        if not path.exists():
            torch.save(make(), path.with_suffix(".part"))
            path.with_suffix(".part").rename(path)
        return torch.load(path, weights_only=False)

    def shared(self) -> tuple[Backgrounds, Rig | None, float]:
        """Backgrounds, rig, and their CPU seconds."""
        begin = time.process_time()
        names = spread(self.folder.instants, BACKGROUND_INSTANTS)
        captures = [Capture(name, self.folder.photographs(name)) for name in names]
        backgrounds = Backgrounds.of(captures)
        captures = [backgrounds.applied(capture) for capture in spread(captures, INSTANTS)]
        rig = corrected_rig(captures, self.models["shipped"], self.size, "auto", "auto", self.renderer)
        return backgrounds, rig, time.process_time() - begin

    def batches(self, masks: str, cameras: str) -> list[tuple[Batch, np.ndarray, float]]:
        """The batch, intrinsics [v, 3, 3] of the photographs, and CPU seconds of each instant."""
        backgrounds, rig, _ = self.kept("shared", self.shared)

        def batch(name: str) -> tuple[Batch, np.ndarray, float]:
            capture, begin = Capture(name, self.folder.photographs(name)), time.process_time()
            capture = backgrounds.applied(capture) if masks == "mended" else capture
            if cameras == "once" and rig:
                capture = dataclasses.replace(rig, gains={}).applied(capture)
            found = capture.batch(self.size, CORRECTION if doubt_of_masks(capture, self.size) else 0)
            lenses = np.stack([photograph.intrinsics for photograph in capture.photographs])
            return found, lenses, time.process_time() - begin

        return [self.kept(f"batch_{masks}_{cameras}_{name}", partial(batch, name)) for name in self.names]

    def truth(self) -> list[list[dict[str, Tensor]]]:
        """Of each instant and camera: photographs on black and as they are, verified masks,
        halved."""
        backgrounds = self.kept("shared", self.shared)[0]
        found = []
        for name in self.names:
            capture = backgrounds.applied(Capture(name, self.folder.photographs(name)))
            agreement = Agreement.of(capture)
            failed = [False] * len(capture.photographs) if agreement is None else agreement.failed
            both = zip(capture.photographs, failed, strict=True)
            found.append([_truth(p, backgrounds.cameras[p.name], bool(fails)) for p, fails in both])
        return found

    @torch.no_grad()
    def rows(
        self, masks: str, cameras: str, gains: str, weights: str, view: int, everies: tuple[int, ...]
    ) -> list[np.ndarray]:
        """The columns [n, 8] of a held-out camera,
        for each of some ``every`` of :class:`Temporal`."""
        known: dict[str, tuple[Prediction, float]] = {}
        rig, spent = self.kept("shared", self.shared)[1], 0.0

        def predict(batch: Batch) -> Prediction:
            """As in the run before, with the seconds that it took there."""
            nonlocal spent
            name = batch.subjects[0]
            if name in known:
                spent += known[name][1]
            else:
                begin = time.process_time()
                known[name] = in_frame(self.models[weights], batch), time.process_time() - begin
            return known[name][0]

        found = []
        for every in everies:
            temporal, rows, errors = Temporal(predict, every, self.renderer), [], []
            truths = (each[view] for each in self.kept("truth", self.truth))
            for (batch, lenses, before), truth in zip(self.batches(masks, cameras), truths, strict=True):
                anew, begin, spent = temporal.anew, time.process_time(), before
                others = [other for other in range(batch.images.shape[1]) if other != view]
                seen = batch.of_views(others)
                gaussians = temporal(with_gains_of(rig, seen) if gains == "once" else seen).gaussians
                seconds = time.process_time() - begin + spent
                drawn = self.renderer(gaussians, _halved(lenses[view], batch, view, truth))
                values, pair = compared(drawn.image[0, 0].clamp(0, 1), drawn.alpha[0, 0], truth)
                errors.append((*pair, truth["mask"]))
                rows.append([*values, np.nan, np.nan, temporal.anew - anew, seconds])
            found.append(with_flicker(rows, errors))
        return found

    def black(self, view: int) -> np.ndarray:
        rows, errors = [], []
        for truth in (each[view] for each in self.kept("truth", self.truth)):
            image = torch.zeros_like(truth["subject"])
            values, pair = compared(image, image[:1], truth)
            errors.append((*pair, truth["mask"]))
            rows.append([*values, np.nan, np.nan, np.nan, np.nan])
        return with_flicker(rows, errors)

    @torch.no_grad()
    def control(self, config: dict[str, Any], weights: str) -> np.ndarray:
        """Columns [cameras, people, 8] of generated people in the rig, each camera held out."""
        data = build_data(config)
        data.prepare_data(["val"])
        rows = []
        for name in data.subjects("val"):
            batch = data.evaluation_batch(name)
            views = range(batch.images.shape[1])
            for view in views:
                begin = time.process_time()
                seen = batch.of_views([other for other in views if other != view])
                gaussians = in_frame(self.models[weights], seen).gaussians
                seconds = time.process_time() - begin
                cameras = batch.of_views([view]).cameras
                image = self.renderer(gaussians, cameras).image[0].clamp(0, 1)
                target, mask = batch.images[0, view : view + 1], batch.masks[0, view : view + 1]
                pair = psnr(image, target), psnr(image, target, box_of(mask))
                values = [value.item() for value in (*pair, psnr_box_40(image, target, mask))]
                rows.append([*values, np.nan, np.nan, np.nan, 1.0, seconds])
        return np.array(rows).reshape(-1, len(views), len(COLUMNS)).swapaxes(0, 1)


def with_gains_of(rig: Rig | None, batch: Batch) -> Batch:
    """Photographs divided by the rig's gains, whose mean over these cameras is 1; as they are where
    it has none."""
    if not rig or not rig.gains:
        return batch
    logs = np.log([rig.gains[name] for name in batch.views[0]])
    return divided(batch, torch.from_numpy(logs - logs.mean(0)).to(batch.images)[None])


def compared(image: Tensor, alpha: Tensor, truth: dict[str, Tensor]) -> tuple[list[float], tuple]:
    """PSNR of four kinds, nan where the mask fails;
    errors on black and before the background [3, h, w]."""
    composed = image + (1 - alpha) * truth["behind"]
    off = (composed - truth["photograph"]) * truth["known"]
    box = box_of(truth["mask"][None])
    found = [
        psnr(image[None], truth["subject"][None]),
        psnr(image[None], truth["subject"][None], box),
        psnr_box_40(image[None], truth["subject"][None], truth["mask"][None]),
        decibels(mean_over(off.square().mean(0)[None], box & truth["known"])),
    ]
    values = [np.nan if truth["fails"] else value.item() for value in found]
    return values, (image - truth["subject"], off)


def with_flicker(rows: list[list[float]], errors: list[tuple]) -> np.ndarray:
    """Rows with the flicker since the instant before; the first has none."""
    for row, pair in zip(rows[1:], pairwise(errors), strict=True):
        *both, masks = (torch.stack(parts)[:, None] for parts in zip(*pair, strict=True))
        row[4:6] = [1e3 * flicker_in_place(each, masks).item() for each in both]
    return np.array(rows)


def _halved(lens: np.ndarray, batch: Batch, view: int, truth: dict[str, Tensor]) -> Cameras:
    lens = torch.from_numpy(lens).clone()
    lens[:2] *= 0.5
    pose = batch.cameras.extrinsics[0, view]
    return Cameras(lens.to(pose)[None, None], pose[None, None], *truth["mask"].shape)


def _truth(photograph: Photograph, behind: Any, fails: bool) -> dict[str, Any]:
    sides = [side // 2 for side in photograph.mask.shape]

    def halved(image: np.ndarray) -> Tensor:
        small = torch.from_numpy(area_image(image.astype(np.uint8), *sides))
        return small.movedim(-1, 0).float() / 255 if small.dim() == 3 else small

    return {
        "photograph": halved(photograph.image),
        "behind": halved(behind.image.clip(0, 255).round()),
        "known": halved(behind.known * np.uint8(255)) > 250,
        "subject": halved(np.round(photograph.image * (photograph.matte[..., None] / 255.0))),
        "mask": halved(photograph.matte) > 127,
        "fails": fails,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("images", type=Path, help="a folder for each instant, with masks beside photographs")
    parser.add_argument("cameras", type=Path)
    parser.add_argument("--out", type=Path, default=Path("held_out_sequence"))
    parser.add_argument("--step", type=int, default=1, help="every how many instants one is measured")
    parser.add_argument("--adapted", help="weights of ghgs adapt for this capture")
    parser.add_argument("--people", type=int, default=2, help="generated people in the rig")
    options = parser.parse_args()
    measured = Measured(options.images, options.cameras, options.out, options.step, options.adapted)
    views = range(len(measured.folder.paths[measured.names[0]]))
    print("| | " + " | ".join(COLUMNS) + " | by camera |\n|---" + "|---" * (len(COLUMNS) + 1) + "|")
    print(
        line("black", [measured.kept(f"rows_black_{view}", partial(measured.black, view)) for view in views])
    )
    for kind in dict.fromkeys(way[:4] for way in WAYS.values()):
        if kind[3] not in measured.models:
            continue
        named = {name: way[4] for name, way in WAYS.items() if way[:4] == kind}
        found = [
            measured.kept(
                f"rows_{'_'.join(kind)}_{view}", partial(measured.rows, *kind, view, tuple(named.values()))
            )
            for view in views
        ]
        for name, rows in zip(named, zip(*found, strict=True), strict=True):
            print(line(name, rows), flush=True)
    said = [f"images={options.images}", f"cameras={options.cameras}", "data.active.val=0"]
    config = with_rig(resolve(compose("adapt", [*said, f"data.people.val={options.people}"])))
    for weights in measured.models:
        rows = measured.kept(f"control_{weights}", partial(measured.control, config, weights))
        print(line(f"generated people, {weights}", rows), flush=True)
    rig, seconds = measured.kept("shared", measured.shared)[1:]
    failed = sum(truth["fails"] for each in measured.kept("truth", measured.truth) for truth in each)
    print(f"rig: {seconds:.0f} s; moved by {rig and rig.moved} pixels, gains {rig and rig.gains}")
    print(f"{failed} of {len(views) * len(measured.names)} photographs are not measured: their masks fail")


def line(name: str, rows: Sequence[np.ndarray]) -> str:
    """Means over instants and cameras, and of the box by camera."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # columns without a value
        means = " | ".join(f"{value:.2f}" for value in np.nanmean(rows, (0, 1)))
        by_camera = " ".join(f"{np.nanmean(each[:, 1]):.2f}" for each in rows)
    return f"| {name} | {means} | {by_camera} |"


if __name__ == "__main__":
    main()
