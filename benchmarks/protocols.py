"""What the measuring protocols that papers report give for one method, on the same predictions.

    python benchmarks/protocols.py [checkpoint=shipped] [<key>=<value> ...]

Twelve built-in people are rendered at twice the size of the inputs, which are halved; four input views. Each
row is one way to measure: what region, on which background, in how many bits, at which size.
"""

import dataclasses
import sys
from collections.abc import Callable, Iterator

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ghgs_lit import GHGS
from ghgs_lit.cli.inputs import build_data, build_renderer
from ghgs_lit.config import compose, resolve
from ghgs_lit.data.reader import Reader
from ghgs_lit.geometry.projection import project
from ghgs_lit.metrics import MetricsOptions, psnr, ssim
from ghgs_lit.metrics.functional import box_of
from ghgs_lit.training.pretext.labels import PARTS, vertex_parts
from ghgs_lit.types import Batch, Targets

SIZE = 252
DATA = [
    "data=synthetic", "data.people={train: 1, val: 12}", f"data.size={2 * SIZE}",
    "data.render.positions=[0,2,4,8,12]", "data.render.views=[0,3]", "targets.training_views=[3]",
]  # fmt: skip
PROTOCOLS = {"release": "11.25°", "midway": "half-way"}
#: Named parts of the body whose boxes are measured.
BOXES = {"head": ("head",), "hands": ("left hand", "right hand")}

#: Renders and their opacities, targets, masks and the share of each target's pixel that shows the subject.
Views = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
Values = tuple[Tensor, Tensor]


def halved(images: Tensor) -> Tensor:
    return F.avg_pool2d(images.flatten(0, 1), 2).unflatten(0, images.shape[:2])


def with_halved_inputs(batch: Batch) -> Batch:
    """The batch whose inputs are at half the size; its targets stay as they are."""
    share = batch.masks.float() if batch.alpha is None else batch.alpha
    share = halved(share[:, :, None])[:, :, 0]
    cameras = batch.cameras.resized(SIZE, SIZE)
    return dataclasses.replace(
        batch,
        images=halved(batch.images),
        masks=share >= 0.5,
        alpha=None if batch.alpha is None else share,
        cameras=cameras,
        depths=None,
    )


def part_boxes(batch: Batch, targets: Targets, parts: tuple[str, ...]) -> Tensor:
    """Boxes of the body's parts in the targets, one for each part, as masks [B T, h, w]."""
    found = torch.zeros(*targets.masks.shape, dtype=torch.bool)
    labels = torch.from_numpy(vertex_parts())
    for b, vertices in enumerate(batch.body_vertices):
        for name in parts:
            points = vertices[: len(labels)][labels == PARTS.index(name)]
            for t in range(found.shape[1]):
                camera = targets.cameras[b, t]
                pixels, _ = project(points, camera.intrinsics, camera.extrinsics)
                (left, top), (right, bottom) = pixels.amin(0).int().tolist(), pixels.amax(0).int().tolist()
                rows, columns = slice(max(top, 0), bottom + 1), slice(max(left, 0), right + 1)
                found[b, t, rows, columns] = True
    return found.flatten(0, 1)


def measured(image: Tensor, target: Tensor, region: Tensor | None) -> Values:
    return psnr(image, target, region), ssim(image, target, "reflect", region)


def of_options(**options: object) -> Callable[[Views], Values]:
    """Of the metrics as ``ghgs evaluate`` measures them, in one region."""
    metrics = MetricsOptions(lpips="off", **options).build()
    suffix = "" if options["regions"] == ("image",) else f"_{options['regions'][0]}"

    def measure(views: Views) -> Values:
        image, _, target, mask, _ = views
        found = metrics(image, target, mask)
        return found[f"psnr{suffix}"], found[f"ssim{suffix}"]

    return measure


def on_white(region: Callable[[Tensor], Tensor | None]) -> Callable[[Views], Values]:
    """Renders and targets composited over white by what they leave free."""

    def measure(views: Views) -> Values:
        image, alpha, target, mask, share = views
        return measured((image + 1 - alpha).clamp(0, 1), (target + 1 - share).clamp(0, 1), region(mask))

    return measure


ROWS: dict[str, Callable[[Views], Values]] = {
    "whole image (`metrics=correct`)": of_options(regions=("image",)),
    "box of the subject": of_options(regions=("box",)),
    "pixels of the subject": of_options(regions=("subject",)),
    "crop of 1000 x 500 of 1024 x 1024": of_options(regions=("crop",)),
    "the same, 8 bits (`metrics=files`: GHG, LIFe-GoM)": of_options(protocol="files", regions=("crop",)),
    "whole image, 8 bits": of_options(protocol="files", regions=("image",)),
    "whole image, no clamp (`metrics=release`)": of_options(protocol="release", regions=("image",)),
    "whole image on white": on_white(lambda mask: None),
    "box on white": on_white(box_of),
}


def shares_of(batch: Batch, reader: Reader) -> Tensor:
    """The mattes of the targets [B, T, h, w]."""
    found = [
        [reader.read_view(subject, *map(int, name.split("/")), False).alpha for name in names]
        for subject, names in zip(batch.subjects, batch.targets.names, strict=True)
    ]
    return torch.from_numpy(np.asarray(found)).float()


def rows_of(model: GHGS, renderer: Callable, batch: Batch, reader: Reader) -> Iterator[tuple[str, Values]]:
    """PSNR and SSIM of each target [B T] by row."""
    fine, share = batch.targets, halved(shares_of(batch, reader)[:, :, None])[:, :, 0]
    coarse = Targets(halved(fine.images), share >= 0.5, fine.cameras.resized(SIZE, SIZE))
    gaussians = model(with_halved_inputs(batch)).gaussians
    small, large = (renderer(gaussians, targets.cameras) for targets in (coarse, fine))
    parts = (small.image, small.alpha, coarse.images, coarse.masks, share[:, :, None])
    views = tuple(part.flatten(0, 1) for part in parts)
    for name, row in ROWS.items():
        yield name, row(views)
    image, target = views[0].clamp(0, 1), views[2]
    for name, parts in BOXES.items():
        yield f"box of the {name}", measured(image, target, part_boxes(batch, coarse, parts))
    image, target = large.image.flatten(0, 1).clamp(0, 1), fine.images.flatten(0, 1)
    yield "targets of twice the inputs' size, whole image", measured(image, target, None)
    box = box_of(fine.masks.flatten(0, 1))
    yield "targets of twice the inputs' size, box", measured(image, target, box)


@torch.no_grad()
def main() -> None:
    config = resolve(compose("evaluate", [*DATA, *sys.argv[1:]]))
    model = GHGS.from_checkpoint(config["checkpoint"] or "shipped")
    renderer, data = build_renderer(config, torch.device("cpu")), build_data(config)
    data.prepare_data(["val"])
    reader = data.builder("val").targets.reader
    table: dict[str, list[str]] = {}
    for name in PROTOCOLS:
        targets = {"name": name, "kind": name, "training_views": [3]}
        found: dict[str, list[Tensor]] = {}
        for batch in data.evaluation_loader(views=4, targets=targets, split="val"):
            for row, values in rows_of(model, renderer, batch, reader):
                found.setdefault(row, []).append(torch.stack(values))
        for row, values in found.items():
            quality, similarity = torch.cat(values, 1).nanmean(1).tolist()
            table.setdefault(row, []).append(f"{quality:.2f} / {similarity:.4f}")
    print("| PSNR / SSIM | " + " | ".join(PROTOCOLS.values()) + " |\n|---" + "|---" * len(PROTOCOLS) + "|")
    for row, cells in table.items():
        print(f"| {row} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
