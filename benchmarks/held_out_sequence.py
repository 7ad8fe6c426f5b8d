"""Each camera of a rig held out over a sequence, predicted from the others: what is found once, and kept.

    python benchmarks/held_out_sequence.py photographs cameras.json --out held_out_sequence

Cameras are corrected with all photographs (the calibration is theirs), in each instant or once, as
`ghgs predict` does; so are colour gains, with a mean of 1 over those that predict. Prints for each way, over
all instants and cameras, PSNR of the photograph on black, whole and in the box of the subject; in the box of
masks that the background mended; and there of the photograph as it is, the render before the background,
which asks no mask. Flicker in place (thousandths of white) of the first and of the last; the share of
instants that were predicted anew; CPU seconds of an instant without the rig's. A black render has the flicker
of the photographs. What is done stays in --out, and is not done again.
"""

import argparse
import dataclasses
import time
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ghgs_capture.backgrounds import Backgrounds
from ghgs_capture.capture import Capture
from ghgs_capture.doubts import CORRECTION, doubt_of_cameras, doubt_of_masks
from ghgs_capture.folder import CaptureFolder
from ghgs_capture.prediction import crop_size, in_frame
from ghgs_capture.rig import INSTANTS, Rig, corrected_rig
from ghgs_capture.temporal import Temporal
from ghgs_lit import GHGS
from ghgs_lit.data.view import area_image
from ghgs_lit.metrics.flicker import flicker_in_place
from ghgs_lit.metrics.functional import box_of, decibels, mean_over, psnr
from ghgs_lit.refinement import CameraRefinement
from ghgs_lit.rendering import Renderer
from ghgs_lit.rounds.gains import divided
from ghgs_lit.types import Batch, Cameras, Prediction
from ghgs_lit.weights.checkpoint import read_checkpoint
from ghgs_lit.weights.reading import file_of

#: Which masks, cameras and colour gains, and of how many instants one is predicted anew.
WAYS = {
    "cameras as given": ("given", "given", "each", 1),
    "cameras once": ("given", "once", "each", 1),
    "cameras once, temporal": ("given", "once", "each", 8),
    "cameras once, backgrounds": ("mended", "once", "each", 1),
    "cameras once, backgrounds, temporal": ("mended", "once", "each", 8),
    "cameras and gains once": ("given", "once", "once", 1),
    "cameras and gains once, temporal": ("given", "once", "once", 8),
    "cameras and gains once, backgrounds": ("mended", "once", "once", 1),
    "cameras and gains once, backgrounds, temporal": ("mended", "once", "once", 8),
    "each instant by itself": ("given", "each", "each", 1),
}
COLUMNS = ("whole", "box", "mended", "photograph", "flicker", "flicker_photograph", "anew", "seconds")


class Measured:
    """A sequence, and what was found of it so far."""

    def __init__(self, images: Path, cameras: Path, out: Path, checkpoint: str):
        self.folder, self.out, path = CaptureFolder(images, cameras), out, file_of(checkpoint)
        self.model, self.renderer = GHGS.from_checkpoint(path).eval(), Renderer()
        self.size = crop_size(None, read_checkpoint(path)["config"], self.model)
        self.names = self.folder.instants
        out.mkdir(parents=True, exist_ok=True)

    def kept(self, name: str, make: Callable[[], Any]) -> Any:
        path = self.out / f"{name}.pt"
        if not path.exists():
            torch.save(make(), path.with_suffix(".part"))
            path.with_suffix(".part").rename(path)
        return torch.load(path, weights_only=False)

    def spread(self, count: int) -> list[Capture]:
        names = [self.names[round((len(self.names) - 1) * i / (count - 1))] for i in range(count)]
        return [Capture(name, self.folder.photographs(name)) for name in names]

    def shared(self) -> tuple[Backgrounds, Rig | None, float]:
        """Backgrounds, rig, and their CPU seconds."""
        begin, captures = time.process_time(), self.spread(INSTANTS)
        backgrounds = Backgrounds.of(captures)
        captures = [backgrounds.applied(capture) for capture in captures]
        rig = corrected_rig(captures, self.model, self.size, "auto", "auto", self.renderer)
        return backgrounds, rig, time.process_time() - begin

    def batches(self, masks: str, cameras: str) -> list[tuple[Batch, np.ndarray, float]]:
        """The batch, intrinsics [v, 3, 3] of the photographs, and CPU seconds of each instant."""
        backgrounds, rig, _ = self.kept("shared", self.shared)

        def batch(name: str) -> tuple[Batch, np.ndarray, float]:
            capture, begin = Capture(name, self.folder.photographs(name)), time.process_time()
            capture = backgrounds.applied(capture) if masks == "mended" else capture
            if cameras == "once" and rig:
                capture = dataclasses.replace(rig, gains={}).applied(capture)
            given = found = capture.batch(self.size, CORRECTION if doubt_of_masks(capture, self.size) else 0)
            if cameras == "each" and doubt_of_cameras(capture, given):
                found = CameraRefinement(CORRECTION, self.model, self.renderer)(given)
            zoom = (found.cameras.intrinsics / given.cameras.intrinsics)[0, :, 0, 0].numpy()
            lenses = np.stack([photograph.intrinsics for photograph in capture.photographs])
            lenses[:, [0, 1], [0, 1]] *= zoom[:, None]
            return found, lenses, time.process_time() - begin

        return [self.kept(f"batch_{masks}_{cameras}_{name}", partial(batch, name)) for name in self.names]

    def truth(self) -> list[list[dict[str, Tensor]]]:
        """Of each instant and camera: photographs on black and as they are, masks and background, halved."""
        behind, mending = Backgrounds.of(self.spread(25)), self.kept("shared", self.shared)[0]
        found = []
        for name in self.names:
            given = Capture(name, self.folder.photographs(name))
            both = zip(given.photographs, mending.applied(given).photographs, strict=True)
            found.append([_truth(p, mended.matte, behind.cameras[p.name]) for p, mended in both])
        return found

    @torch.no_grad()
    def rows(
        self, masks: str, cameras: str, gains: str, view: int, everies: tuple[int, ...]
    ) -> list[np.ndarray]:
        """The columns [n, 8] of a held-out camera, for each of some ``every`` of :class:`Temporal`."""
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
                known[name] = in_frame(self.model, batch), time.process_time() - begin
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


def with_gains_of(rig: Rig | None, batch: Batch) -> Batch:
    """Photographs divided by the rig's gains, whose mean over these cameras is 1; as they are where it has
    none."""
    if not rig or not rig.gains:
        return batch
    logs = np.log([rig.gains[name] for name in batch.views[0]])
    return divided(batch, torch.from_numpy(logs - logs.mean(0)).to(batch.images)[None])


def compared(image: Tensor, alpha: Tensor, truth: dict[str, Tensor]) -> tuple[list[float], tuple]:
    """PSNR of four kinds, and the errors on black and before the background [3, h, w]."""
    composed = image + (1 - alpha) * truth["behind"]
    off = (composed - truth["photograph"]) * truth["known"]
    seen = box_of(truth["mended"][None]) & truth["known"]
    found = [
        psnr(image[None], truth["subject"][None]),
        psnr(image[None], truth["subject"][None], box_of(truth["mask"][None])),
        psnr(image[None], truth["subject_mended"][None], box_of(truth["mended"][None])),
        decibels(mean_over(off.square().mean(0)[None], seen)),
    ]
    return [value.item() for value in found], (image - truth["subject"], off)


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


def _truth(photograph: Any, mended: np.ndarray, behind: Any) -> dict[str, Tensor]:
    sides = [side // 2 for side in photograph.mask.shape]

    def halved(image: np.ndarray) -> Tensor:
        small = torch.from_numpy(area_image(image.astype(np.uint8), *sides))
        return small.movedim(-1, 0).float() / 255 if small.dim() == 3 else small

    found = {"photograph": halved(photograph.image), "behind": halved(behind.image.clip(0, 255).round())}
    found["known"] = halved(behind.known * np.uint8(255)) > 250
    for end, matte in (("", photograph.matte), ("_mended", mended)):
        found[f"subject{end}"] = halved(np.round(photograph.image * (matte[..., None] / 255.0)))
    return found | {"mask": halved(photograph.matte) > 127, "mended": halved(mended) > 127}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("images", type=Path, help="a folder for each instant, with masks beside photographs")
    parser.add_argument("cameras", type=Path)
    parser.add_argument("--checkpoint", default="shipped")
    parser.add_argument("--out", type=Path, default=Path("held_out_sequence"))
    options = parser.parse_args()
    measured = Measured(options.images, options.cameras, options.out, options.checkpoint)
    views = range(len(measured.folder.paths[measured.names[0]]))
    print("| | " + " | ".join(COLUMNS) + " |\n|---" + "|---" * len(COLUMNS) + "|")
    print(
        line("black", [measured.kept(f"rows_black_{view}", partial(measured.black, view)) for view in views])
    )
    for kind in dict.fromkeys(way[:3] for way in WAYS.values()):
        named = {name: way[3] for name, way in WAYS.items() if way[:3] == kind}
        found = [
            measured.kept(
                f"rows_{'_'.join(kind)}_{view}", partial(measured.rows, *kind, view, tuple(named.values()))
            )
            for view in views
        ]
        for name, rows in zip(named, zip(*found, strict=True), strict=True):
            print(line(name, rows), flush=True)
    rig, seconds = measured.kept("shared", measured.shared)[1:]
    print(f"rig: {seconds:.0f} s; moved by {rig and rig.moved} pixels, gains {rig and rig.gains}")


def line(name: str, rows: Sequence[np.ndarray]) -> str:
    """Means over instants and cameras, and of the box by camera."""
    means = " | ".join(f"{value:.2f}" for value in np.nanmean(rows, (0, 1)))
    return f"| {name} | {means} | {' '.join(f'{each[:, 1].mean():.2f}' for each in rows)}"


if __name__ == "__main__":
    main()
