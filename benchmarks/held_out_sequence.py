"""Predict each camera of a rig from the others, over a sequence, and compare with its photographs.

    python benchmarks/held_out_sequence.py photographs cameras.json --out held_out_sequence --step 5 \\
        --adapted odd.ckpt even.ckpt

Cameras are corrected once with all photographs (the calibration is theirs), as in `ghgs predict`; so
are colour gains, with a mean of 1 over the predicting cameras. All ways are compared with the same
masks: those of the sequence, recut where they fail. Photographs whose mask still fails, by the hull
of the others or by the background (`is_contradicted`), are counted but not measured.

Prints means over all instants and cameras: PSNR of the photograph on black, whole and in the box of
the subject; in the box after scaling both images to one brightness; in the box of the original
photograph against the render on the background, which needs no mask; and CPU seconds of an instant
without those of the rig. Intermediate results are cached in --out, so that a stopped run continues;
each instant is logged and written to --out/results.json immediately. `--adapted odd.ckpt even.ckpt`:
weights adapted on the odd instants predict the even ones, and vice versa.
"""

import argparse
import dataclasses
import functools
import json
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from ghgs_capture.agreement import CORRECTION, MISSED, Agreement, doubt_of_masks, reach_of
from ghgs_capture.backgrounds import BACKGROUND_INSTANTS, UNLIKE, Background, Backgrounds
from ghgs_capture.capture import Capture
from ghgs_capture.crops import Photograph, shrink
from ghgs_capture.folder import CaptureFolder
from ghgs_capture.prediction import crop_size, in_frame
from ghgs_capture.rig import INSTANTS, Rig, correct_rig, spread
from ghgs_lit.data.view import area_image
from ghgs_lit.execution import Predictor
from ghgs_lit.files import write_text_atomically
from ghgs_lit.method.rounds.gains import divide_by_gains
from ghgs_lit.metrics.functional import decibels, psnr, psnr_box_40
from ghgs_lit.metrics.regions import box_of, mean_over
from ghgs_lit.rendering import Renderer
from ghgs_lit.types import Batch, Cameras
from ghgs_lit.weights.checkpoint import read_config

#: Masks, cameras, colour gains and weights of each way.
WAYS = {
    "as given": ("given", "given", "each", "shipped"),
    "auto": ("mended", "once", "once", "shipped"),
    "adapted to the capture": ("mended", "once", "once", "adapted"),
}
COLUMNS = ("whole", "box", "box_40", "photograph", "seconds")
BOX = COLUMNS.index("box")
#: Differences (of 255 levels) from the background below which a pixel shows it, and above which not.
SAME, DIFFERENT = 8, 40


class Measured:
    """A sequence and its results so far.

    Args:
        images: folder with a folder for each instant.
        cameras: the calibration.
        out: cache of intermediate results; ``results.json`` is updated after each instant.
        step: measure every ``step``-th instant.
        weights: files of weights by name, ``shipped`` first; of n files, instant i of the sequence is
            predicted by file i modulo n.
    """

    def __init__(self, images: Path, cameras: Path, out: Path, step: int, weights: dict[str, list[str]]):
        self.folder = CaptureFolder(images, cameras)
        self.out = out
        self.weights = weights
        self.models = {name: [_load_model(path) for path in paths] for name, paths in weights.items()}
        self.renderer = Renderer()
        self.size = crop_size(None, read_config(weights["shipped"][0]), self.models["shipped"][0])
        self.names = self.folder.instants[::step]
        self.cameras = [p.name for p in self.folder.photographs(self.names[0])]
        self.results: dict[str, Any] = {"step": step, "weights": weights, "rows": {}}
        out.mkdir(parents=True, exist_ok=True)

    def load_or_make(self, name: str, make: Callable[[], Any]) -> Any:
        path = self.out / f"{name}.pt"
        if not path.exists():
            torch.save(make(), path.with_suffix(".part"))
            path.with_suffix(".part").rename(path)
        return torch.load(path, weights_only=False)

    def log_rows(self, way: str, subject: str, rows: Sequence[Sequence[float]]) -> None:
        """Store the results of all cameras of an instant in the JSON file; log the box's PSNR."""
        columns = (dict(zip(COLUMNS, row, strict=True)) for row in rows)
        self.results["rows"].setdefault(way, {})[subject] = dict(zip(self.cameras, columns, strict=True))
        write_text_atomically(self.out / "results.json", json.dumps(self.results, indent=1))
        print(f"{way}: {subject}: {' '.join(f'{row[BOX]:.2f}' for row in rows)}", file=sys.stderr, flush=True)

    @functools.cached_property
    def shared(self) -> tuple[Backgrounds, Rig | None, float]:
        """Backgrounds, rig, and their CPU seconds."""
        return self.load_or_make("shared", self.find_rig)

    def find_rig(self) -> tuple[Backgrounds, Rig | None, float]:
        begin = time.process_time()
        names = spread(self.folder.instants, BACKGROUND_INSTANTS)
        captures = [Capture(name, self.folder.photographs(name)) for name in names]
        backgrounds = Backgrounds.of(captures)
        captures = [backgrounds.apply(capture) for capture in spread(captures, INSTANTS)]
        rig = correct_rig(captures, self.models["shipped"][0], self.size, "auto", "auto", self.renderer)
        return backgrounds, rig, time.process_time() - begin

    def batch(self, masks: str, cameras: str, name: str) -> tuple[Batch, np.ndarray, float]:
        """The batch, intrinsics [v, 3, 3] of the photographs, and CPU seconds of an instant."""
        backgrounds, rig, _ = self.shared
        capture, begin = Capture(name, self.folder.photographs(name)), time.process_time()
        capture = backgrounds.apply(capture) if masks == "mended" else capture
        if cameras == "once" and rig:
            capture = dataclasses.replace(rig, gains={}).apply(capture)
        found = capture.batch(self.size, CORRECTION if doubt_of_masks(capture, self.size) else 0)
        lenses = np.stack([photograph.intrinsics for photograph in capture.photographs])
        return found, lenses, time.process_time() - begin

    def truth(self, name: str) -> list[dict[str, Any]]:
        """Per camera: the photograph on black and the original, and the verified mask, at half size."""
        backgrounds = self.shared[0]
        capture = backgrounds.apply(Capture(name, self.folder.photographs(name)))
        small = tuple(shrink(p, backgrounds.factors[p.name]) for p in capture.photographs)
        agreement = Agreement.of(Capture(name, small))
        truths = []
        for view, photograph in enumerate(capture.photographs):
            behind = backgrounds.cameras[photograph.name]
            fails = agreement.failed[view] or is_contradicted(
                small[view], behind, agreement.depth_in_others(view)
            )
            truths.append(_truth(photograph, behind, bool(fails)))
        return truths

    @torch.no_grad()
    def render_view(self, way: str, name: str, view: int) -> tuple[Tensor, float]:
        """Render a held-out camera.

        Returns:
            Colours and alpha [4, h, w] at half the photograph's size, uint8, and CPU seconds.
        """
        masks, cameras, gains, weights = WAYS[way]
        rig = self.shared[1]
        truth = self.load_or_make(f"truth_{name}", partial(self.truth, name))[view]
        read = self.load_or_make(f"batch_{masks}_{cameras}_{name}", partial(self.batch, masks, cameras, name))
        batch, lenses, before = read
        models = self.models[weights]
        model = models[self.folder.instants.index(name) % len(models)]
        begin = time.process_time()
        seen = batch.of_views([other for other in range(len(lenses)) if other != view])
        gaussians = in_frame(model, with_gains_of(rig, seen) if gains == "once" else seen).gaussians
        seconds = time.process_time() - begin + before
        shown = self.renderer(gaussians, _half_size_camera(lenses[view], batch, view, truth))
        image = torch.cat([shown.image[0, 0], shown.alpha[0, 0]]).clamp(0, 1)
        return (255 * image).round().byte(), seconds

    def rows(self, way: str) -> np.ndarray:
        """The columns [cameras, n, 5] of each held-out camera; the way ``black`` renders nothing."""
        found: list[list[list[float]]] = []
        for name in self.names:
            found.append([])
            truths = self.load_or_make(f"truth_{name}", partial(self.truth, name))
            for view, truth in enumerate(truths):
                image = torch.zeros(4, *truth["mask"].shape, dtype=torch.uint8)
                seconds = np.nan
                if way != "black":
                    of_weights = "_".join(Path(path).stem for path in self.weights[WAYS[way][3]])
                    place = f"drawn_{way}_{of_weights}_{name}_{self.cameras[view]}"
                    image, seconds = self.load_or_make(place, partial(self.render_view, way, name, view))
                found[-1].append([*compare(*(image.float() / 255).split([3, 1]), truth), seconds])
            self.log_rows(way, name, found[-1])
        return np.array(found).swapaxes(0, 1)


def is_contradicted(photograph: Photograph, behind: Background, inside: np.ndarray) -> bool:
    """Whether the background contradicts a mask, in thick parts of more than ``MISSED`` of its area.

    Such parts show the background inside the mask, or differ from it outside the mask but inside the
    others' hull. The hull alone does not detect half a missing head.

    Args:
        photograph: of the background's size.
        inside: depth in pixels of each pixel inside the hull of the other masks [h, w].
    """
    mask = photograph.mask
    off = ndimage.uniform_filter(np.abs(photograph.image - behind.image).max(-1), 3)
    odds = ndimage.uniform_filter(behind.odds_of(photograph.image), 3)
    keeps = mask & np.where(behind.known, off < SAME, odds < UNLIKE)
    lacks = ~mask & behind.known & (off > DIFFERENT) & (inside > 0)
    parts = (ndimage.binary_opening(part, iterations=reach_of(mask.shape)) for part in (keeps, lacks))
    return max(part.sum() for part in parts) > MISSED * mask.sum()


def with_gains_of(rig: Rig | None, batch: Batch) -> Batch:
    """Divide images by the rig's gains, with a mean of 1 over these cameras; unchanged without gains."""
    if not rig or not rig.gains:
        return batch
    logs = np.log([rig.gains[name] for name in batch.views[0]])
    return divide_by_gains(batch, torch.from_numpy(logs - logs.mean(0)).to(batch.images)[None])


def compare(image: Tensor, alpha: Tensor, truth: dict[str, Tensor]) -> list[float]:
    """PSNR of four kinds in dB, nan where the mask fails."""
    composed = image + (1 - alpha) * truth["behind"]
    off = (composed - truth["photograph"]) * truth["known"]
    box = box_of(truth["mask"][None])
    found = [
        psnr(image[None], truth["subject"][None]),
        psnr(image[None], truth["subject"][None], box),
        psnr_box_40(image[None], truth["subject"][None], truth["mask"][None]),
        decibels(mean_over(off.square().mean(0)[None], box & truth["known"])),
    ]
    return [np.nan if truth["fails"] else value.item() for value in found]


def _load_model(path: str) -> Predictor:
    return Predictor.from_checkpoint(path)


def _half_size_camera(lens: np.ndarray, batch: Batch, view: int, truth: dict[str, Tensor]) -> Cameras:
    lens = torch.from_numpy(lens).clone()
    lens[:2] *= 0.5
    pose = batch.cameras.extrinsics[0, view]
    return Cameras(lens.to(pose)[None, None], pose[None, None], *truth["mask"].shape)


def _truth(photograph: Photograph, behind: Background, fails: bool) -> dict[str, Any]:
    sides = [side // 2 for side in photograph.mask.shape]

    def halve(image: np.ndarray) -> Tensor:
        small = torch.from_numpy(area_image(image.astype(np.uint8), *sides))
        return small.movedim(-1, 0).float() / 255 if small.dim() == 3 else small

    return {
        "photograph": halve(photograph.image),
        "behind": halve(behind.image.clip(0, 255).round()),
        "known": halve(behind.known * np.uint8(255)) > 250,
        "subject": halve(np.round(photograph.image * (photograph.matte[..., None] / 255.0))),
        "mask": halve(photograph.matte) > 127,
        "fails": fails,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("images", type=Path, help="a folder for each instant, with masks beside photographs")
    parser.add_argument("cameras", type=Path)
    parser.add_argument("--out", type=Path, default=Path("held_out_sequence"))
    parser.add_argument("--step", type=int, default=1, help="every how many instants one is measured")
    parser.add_argument("--checkpoint", default="shipped", help="weights of the ways that do not adapt")
    several = "weights of ghgs adapt for this capture; of n, instant i is predicted by number i modulo n"
    parser.add_argument("--adapted", nargs="+", help=several)
    parser.add_argument("--ways", nargs="+", default=list(WAYS), choices=list(WAYS))
    options = parser.parse_args()
    weights = {"shipped": [options.checkpoint]} | ({"adapted": options.adapted} if options.adapted else {})
    measured = Measured(options.images, options.cameras, options.out, options.step, weights)
    print("| | " + " | ".join(COLUMNS) + " | by camera |\n|---" + "|---" * (len(COLUMNS) + 1) + "|")
    for way in ["black", *(way for way in options.ways if WAYS[way][3] in weights)]:
        print(line(way, measured.rows(way)), flush=True)
    rig, seconds = measured.shared[1:]
    truths = [
        measured.load_or_make(f"truth_{name}", partial(measured.truth, name)) for name in measured.names
    ]
    failed = sum(truth["fails"] for each in truths for truth in each)
    print(f"rig: {seconds:.0f} s; moved by {rig and rig.moved} pixels, gains {rig and rig.gains}")
    count = len(measured.cameras) * len(measured.names)
    print(f"{failed} of {count} photographs are not measured: their masks fail")


def line(name: str, rows: np.ndarray) -> str:
    """Format means over instants and cameras, and the box's PSNR by camera."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # columns without a value
        means = " | ".join(f"{value:.2f}" for value in np.nanmean(rows, (0, 1)))
        by_camera = " ".join(f"{np.nanmean(each[:, 1]):.2f}" for each in rows)
    return f"| {name} | {means} | {by_camera} |"


if __name__ == "__main__":
    main()
