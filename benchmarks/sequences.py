"""People in motion, each instant predicted alone (exact) and from the last one (temporal).

    python benchmarks/sequences.py [data.size=252] [--every 12] [--people p2000015,a2000001]

Renders eight frozen sequences (minutes), of people that no training reaches; the target is half-way
between two of four inputs. Prints for each person, and on average, PSNR (whole and in the box),
flicker along the motion of the surface, on average and between the worst two instants, and at fixed
pixels of the box (in thousandths of white), tOF (by how many pixels of the box optical flow differs
from that of the photographs; Chu et al. 2020, TecoGAN; OpenCV's Farneback), and seconds of an
instant with its render. A black render has the flicker and the flow of the photographs themselves.
"""

import argparse
from collections.abc import Callable
from itertools import pairwise
from statistics import mean

import cv2
import numpy as np
import torch
from moving_people import MovingPerson
from torch import Tensor

from ghgs_lit import GHGS
from ghgs_lit.cli.inputs import build_data, build_renderer, pick_device
from ghgs_lit.config import run_of
from ghgs_lit.data.batches import BatchBuilder
from ghgs_lit.data.datamodule import PhotographsDataModule
from ghgs_lit.data.reader import PhotographCache
from ghgs_lit.data.sampling import SampleSpec, evaluation_samples
from ghgs_lit.evaluation.measure import Estimate, Method, ModelMethod, measure
from ghgs_lit.metrics import ImageMetrics
from ghgs_lit.metrics.flicker import flicker, flicker_in_place
from ghgs_lit.metrics.regions import box_of
from ghgs_lit.rendering import Renderer
from ghgs_lit.runs import results
from ghgs_lit.types import Batch, Cameras, Prediction

#: What is frozen, with the people's own motion, the default rig and lights: people,
#: and instants of each.
PEOPLE = "p2000003,p2000006,p2000012,p2000015,a2000001,a2000006,a2000011,a2000016"
INSTANTS = 24
_DATA = (
    "data=synthetic", "data.size=252", "data.render.positions=[0,2,4,8,12]", "data.render.views=[0]",
    "views=v4", "targets=cameras", "targets.positions=[2]", "metrics.lpips=off",
)  # fmt: skip
#: Factor and decimals of what is printed.
_COLUMNS = {
    "psnr": (1, 2),
    "psnr_box": (1, 2),
    "flicker": (1e3, 2),
    "worst": (1e3, 2),
    "in_place": (1e3, 2),
    "tof": (1, 3),
    "seconds": (1, 3),
}


def black(batch: Batch) -> Estimate:
    return Estimate(torch.zeros_like(batch.targets.images))


def temporal(model: GHGS, renderer: Renderer, every: int) -> Callable[[Batch], Prediction]:
    from ghgs_capture.temporal import Temporal

    return Temporal(model, every, renderer)


def frozen(data: PhotographsDataModule, person: str) -> tuple[MovingPerson, list[SampleSpec]]:
    """The photographs of a person, and the sample of each instant."""
    reader = MovingPerson(person, INSTANTS, data.dataset.camera_rig(), data.dataset.render)
    samples = evaluation_samples(
        reader.subjects, data.views.evaluation_count, [data.targets], data.dataset.ring, data.seed
    )
    return reader, samples


def measured(
    method: Method,
    reader: MovingPerson,
    samples: list[SampleSpec],
    metrics: ImageMetrics,
    device: torch.device,
) -> dict[str, float | None]:
    """Means over the instants of a person."""
    stored = PhotographCache(reader, None)
    builder, targets, images = BatchBuilder(stored, stored), [], []

    def recorded(batch: Batch) -> Estimate:
        estimate = method(batch)
        images.append(estimate.image[0].clamp(0, 1))
        targets.append(batch.targets)
        return estimate

    batches = (builder.batch([sample]) for sample in samples)
    rows = measure(recorded, "", batches, metrics, device)
    found = {column: results.mean(row.get(column) for row in rows) for column in _COLUMNS}
    photographs, masks = ([getattr(t, name)[0] for t in targets] for name in ("images", "masks"))
    errors = [image - photograph for image, photograph in zip(images, photographs, strict=True)]
    in_place = [
        flicker_in_place(torch.stack(pair), torch.stack(seen)).mean().item()
        for pair, seen in zip(pairwise(errors), pairwise(masks), strict=True)
    ]
    instants = [
        surface(reader, sample, error, target.cameras[0])
        for sample, error, target in zip(samples, errors, targets, strict=True)
    ]
    flickers = [value for pair in pairwise(instants) for value in flicker_between(*pair)]
    flows = [[flow(*pair) for pair in pairwise(each)] for each in (images, photographs)]
    boxes = [box_of(first | second)[0].cpu().numpy() for first, second in pairwise(masks)]
    off = [
        np.linalg.norm(one - other, axis=-1)[box].mean()
        for one, other, box in zip(*flows, boxes, strict=True)
    ]
    means = {"flicker": flickers, "in_place": in_place, "tof": map(float, off)}
    return found | {name: results.mean(values) for name, values in means.items()} | {"worst": max(flickers)}


def surface(
    reader: MovingPerson, sample: SampleSpec, errors: Tensor, cameras: Cameras
) -> tuple[Tensor, Tensor, Tensor, Cameras]:
    """Errors [t, 3, h, w] of an instant, points of the surface,
    true depths [t, h, w] and cameras."""
    views = (reader.read_view(sample.subject, *photo, depth=True) for photo in sample.targets)
    depths = np.stack([view.depth for view in views])
    return errors, errors.new_tensor(reader.surfaces[sample.subject]), errors.new_tensor(depths), cameras


def flicker_between(before: tuple, after: tuple) -> list[float]:
    """Flicker of each target between two instants of :func:`surface`."""
    *arrays, cameras = zip(before, after, strict=True)
    matrices = (torch.stack([getattr(c, name) for c in cameras]) for name in ("intrinsics", "extrinsics"))
    both = Cameras(*matrices, cameras[0].height, cameras[0].width)
    return flicker(*map(torch.stack, arrays), both).tolist()


def flow(*pair: Tensor) -> np.ndarray:
    """Pixels [h, w, 2] by which the first of targets [t, 3, h, w] moves between two instants."""
    grey = [(255 * image[0].mean(0)).round().byte().cpu().numpy() for image in pair]
    return cv2.calcOpticalFlowFarneback(*grey, None, 0.5, 3, 15, 3, 5, 1.2, 0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--checkpoint", default="shipped")
    parser.add_argument("--every", type=int, default=0, help="temporal: instants of a new prediction; 0: no")
    parser.add_argument("--people", default=PEOPLE)
    parser.add_argument("overrides", nargs="*", help="of `ghgs evaluate`, such as data.size=140")
    options = parser.parse_intermixed_args()
    run = run_of("evaluate", [*_DATA, *options.overrides])
    device, data = pick_device(run.device), build_data(run)
    renderer, metrics = build_renderer(run, device), run.metrics.build().to(device)
    model = GHGS.from_checkpoint(options.checkpoint, device).eval()
    methods: dict[str, Method] = {"exact": ModelMethod(model, renderer), "black": black}
    if options.every:
        methods["temporal"] = ModelMethod(temporal(model, renderer, options.every), renderer)
    print("| person | method | " + " | ".join(_COLUMNS) + " |\n|---|---" + "|---" * len(_COLUMNS) + "|")
    found: dict[str, list[dict]] = {}
    for person in options.people.split(","):
        reader, samples = frozen(data, person)
        for name, method in methods.items():
            if name == "temporal":
                method.model.reset()
            found.setdefault(name, []).append(measured(method, reader, samples, metrics, device))
            print(line(person, name, found[name][-1]), flush=True)
    for name, rows in found.items():
        print(line("mean", name, {column: mean(row[column] for row in rows) for column in _COLUMNS}))


def line(person: str, name: str, values: dict[str, float]) -> str:
    cells = [f"{factor * values[column]:.{digits}f}" for column, (factor, digits) in _COLUMNS.items()]
    return f"| {person} | {name} | " + " | ".join(cells) + " |"


if __name__ == "__main__":
    main()
