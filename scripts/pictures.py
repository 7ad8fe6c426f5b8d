"""Create the pictures of README and model card: ``python scripts/pictures.py docs``.

``hero.png`` and ``turntable.webp``: a built-in person who was not trained on, photographed from four
sides, and the prediction, rendered half-way between the cameras and all around, on white.
``result.png``: photographs, depths and renderings of two others. ``failures.jpg``: those of
``--people`` with the lowest PSNR half-way between the cameras.
"""

import argparse
import dataclasses
import math
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor
from torchmetrics.functional.image import peak_signal_noise_ratio

from ghgs_lit.cli.inputs import build_data
from ghgs_lit.config import run_of
from ghgs_lit.data.datamodule import PhotographsDataModule
from ghgs_lit.execution import Predictor
from ghgs_lit.rendering import Renderer
from ghgs_lit.types import Batch, Gaussians, Prediction
from ghgs_lit.visualization.pictures import ERROR_GAIN, colorize, error_map, row, stack, to_uint8
from ghgs_lit.visualization.turntable import orbit, subject_points

SIDE, WIDTH, FRAMES = 512, 320, 36
#: Directions of the renders in hero.png, in degrees from the first photograph; the second one is at 90.
BETWEEN = (45, 135, 225, 315)


def people(number: int, size: int) -> PhotographsDataModule:
    """Built-in people of the split val, rendered on first use.

    Args:
        number: number of people.
        size: side of the photographs in pixels.
    """
    overrides = [
        "data=synthetic",
        f"data.people={{train: 1, val: {number}}}",
        f"data.size={size}",
        "data.render.positions=[0,2,4,6,8,10,12,14]",
        "targets=midway",
    ]
    data = build_data(run_of("prepare", overrides))
    data.prepare_data(("val",))
    return data


def render_target(prediction: Prediction, batch: Batch) -> Tensor:
    """Render the first target [3, h, w] of the batch."""
    return Renderer()(prediction.gaussians, batch.targets.cameras[:, :1]).image[0, 0].clamp(0, 1)


def blend_on_white(color: Tensor, alpha: Tensor) -> np.ndarray:
    return to_uint8(color + 1 - alpha)


def box_of(mask: Tensor, ratio: float) -> tuple[slice, slice]:
    """Rows and columns of a box around a subject, with a margin.

    Args:
        mask: [h, w] bool.
        ratio: width over height of the box.
    """
    rows, columns = (torch.nonzero(mask.any(axis))[:, 0] for axis in (1, 0))
    height = min(round(1.12 * float(rows[-1] - rows[0])), mask.shape[0])
    width = min(round(ratio * height), mask.shape[1])
    top = max(0, min(int(rows[0] + rows[-1] - height) // 2, mask.shape[0] - height))
    left = max(0, min(int(columns[0] + columns[-1] - width) // 2, mask.shape[1] - width))
    return slice(top, top + height), slice(left, left + width)


def cut(picture: np.ndarray, box: tuple[slice, slice], size: tuple[int, int]) -> np.ndarray:
    """Crop a picture to a box and resize it to ``size``, (width, height) in pixels."""
    return np.asarray(Image.fromarray(picture[box]).resize(size, Image.Resampling.LANCZOS))


def render_around(gaussians: Gaussians, capture: Batch, degrees: list[float]) -> list[np.ndarray]:
    """Render views of :data:`SIDE` pixels on white from directions around the subject."""
    angles = torch.tensor(degrees, dtype=torch.float64) * (math.pi / 180)
    cameras = orbit(capture.cameras[0], angles, subject_points(gaussians))
    intrinsics = cameras.intrinsics.clone()
    intrinsics[:, :2] *= SIDE / cameras.height
    cameras = dataclasses.replace(cameras, intrinsics=intrinsics, height=SIDE, width=SIDE)
    images = (Renderer()(gaussians, cameras[i : i + 1][None], background=1.0) for i in range(len(angles)))
    return [to_uint8(one.image[0, 0]) for one in images]


def write_hero(batch: Batch, prediction: Prediction, folder: Path) -> None:
    """Write ``hero.png`` and ``turntable.webp``."""
    canvas = Image.new("RGB", (WIDTH * (1 + len(BETWEEN)), SIDE), "white")
    for place, photograph in enumerate(zip(batch.images[0], batch.alpha[0], strict=True)):
        box = box_of(photograph[1] > 0.5, WIDTH / SIDE)
        tile = cut(blend_on_white(*photograph), box, (WIDTH // 2, SIDE // 2))
        canvas.paste(Image.fromarray(tile), (place % 2 * WIDTH // 2, place // 2 * SIDE // 2))
    pen = ImageDraw.Draw(canvas)
    for place, picture in enumerate(render_around(prediction.gaussians, batch, list(BETWEEN))):
        shown = torch.from_numpy((picture < 250).any(-1))
        tile = cut(picture, box_of(shown, WIDTH / SIDE), (WIDTH, SIDE))
        canvas.paste(Image.fromarray(tile), ((1 + place) * WIDTH, 0))
        pen.text(((1 + place) * WIDTH + 8, 4), f"prediction, half-way: {BETWEEN[place]} degrees", "black")
    pen.text((8, SIDE - 14), "four photographs", "black")
    canvas.quantize(256, dither=Image.Dither.NONE).save(folder / "hero.png", optimize=True)
    frames = render_around(prediction.gaussians, batch, [360 * i / FRAMES for i in range(FRAMES)])
    first, *others = (Image.fromarray(frame) for frame in frames)
    first.save(
        folder / "turntable.webp", save_all=True, append_images=others, duration=80, loop=0, quality=80
    )


def result(batch: Batch, prediction: Prediction) -> np.ndarray:
    """Photographs, depths, and target, rendering and error of one person."""
    size = (110, 220)
    rows = []
    boxes = [box_of(mask, 0.5) for mask in batch.masks[0]]
    photographs = zip(batch.images[0], batch.alpha[0], boxes, strict=True)
    rows.append(
        ([cut(blend_on_white(image, alpha), box, size) for image, alpha, box in photographs], "photograph")
    )
    for name, depths in (("depth", prediction.depth[0]), ("true depth", batch.depths[0])):
        tiles = []
        for depth, true, mask, box in zip(depths, batch.depths[0], batch.masks[0], boxes, strict=True):
            near, far = (float(true[mask].quantile(share)) for share in (0.01, 0.99))
            tiles.append(cut(colorize(-depth, -far, -near, "turbo", mask), box, size))
        rows.append((tiles, name))
    pictures = [row(tiles, [name] * len(tiles)) for tiles, name in rows]
    return stack([*pictures, comparison(batch, render_target(prediction, batch), size)])


def comparison(batch: Batch, image: Tensor, size: tuple[int, int]) -> np.ndarray:
    """Target, rendering and error half-way between two cameras, as (width, height) pixels."""
    target = batch.targets.images[0, 0]
    box = box_of(batch.targets.masks[0, 0], size[0] / size[1])
    tiles = [cut(one, box, size) for one in (to_uint8(target), to_uint8(image), error_map(image, target))]
    return row(tiles, ["target", "rendering", f"error x{ERROR_GAIN:g}"])


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--checkpoint", default="shipped")
    parser.add_argument("--people", type=int, default=24, help="of whom failures.jpg has the four worst")
    parser.add_argument("--size", type=int, default=518, help="of photographs, in pixels")
    parser.add_argument("--hero", type=int, default=1, help="number in the split val")
    parser.add_argument("--shown", type=int, nargs=2, default=(0, 2), help="numbers in the split val")
    options = parser.parse_args()
    model = Predictor.from_checkpoint(options.checkpoint)
    data = people(options.people, options.size)
    results, compared = [], []
    for number, name in enumerate(data.subjects("val")):
        batch = data.evaluation_batch(name, views=4, targets=data.targets)
        prediction = model(batch)
        image = render_target(prediction, batch)
        psnr = float(peak_signal_noise_ratio(image, batch.targets.images[0, 0], data_range=1.0))
        compared.append((psnr, comparison(batch, image, (220, 440))))
        print(f"{name}: {psnr:.2f} dB half-way", flush=True)
        if number == options.hero:
            write_hero(batch, prediction, options.folder)
        if number in options.shown:
            results.append(result(batch, prediction))
    height = max(len(picture) for picture in results)
    sides = [np.pad(picture, ((0, height - len(picture)), (0, 16), (0, 0))) for picture in results]
    shown = Image.fromarray(np.concatenate(sides, 1)[:, :-16])
    shown.quantize(256, dither=Image.Dither.NONE).save(options.folder / "result.png", optimize=True)
    worst = sorted(compared, key=lambda one: one[0])[:4]
    both = [np.concatenate([one for _, one in pair], 1) for pair in (worst[:2], worst[2:])]
    Image.fromarray(stack(both)).save(options.folder / "failures.jpg", quality=85)


if __name__ == "__main__":
    main()
