"""The picture and the turntable of the README: ``python scripts/hero.py docs/hero.png docs/turntable.webp``.

A built-in person who was not trained on, photographed from four sides before white, exposed as photographs of
a real capture are (0.40 of full brightness), and the prediction from
directions half-way between the cameras. The model sees crops of the size that it was trained with.
"""

import argparse
import dataclasses
import math
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw

from ghgs_capture.capture import Capture
from ghgs_capture.crops import Photograph
from ghgs_capture.prediction import predict, trained_size
from ghgs_lit import GHGS
from ghgs_lit.cli.inputs import build_data
from ghgs_lit.config import run_of
from ghgs_lit.rendering import Renderer
from ghgs_lit.types import Batch, Gaussians
from ghgs_lit.visualization.pictures import to_uint8
from ghgs_lit.visualization.turntable import orbit, subject_points
from ghgs_lit.weights.checkpoint import read_checkpoint

SIDE, WIDTH, BRIGHTER, FRAMES = 512, 320, 1.55, 36
#: Where the picture looks from, degrees from the first photograph,
#: which is 90 degrees from the second.
BETWEEN = (45, 135, 225, 315)


def photographs(person: int) -> Batch:
    overrides = [
        "data=synthetic",
        f"data.people={{train: 1, val: {person + 1}}}",
        f"data.size={2 * SIDE - 16}",
        "data.render.positions=[0,4,8,12]",
        "data.render.views=[0,3]",
        "targets.training_views=[0,3]",
    ]
    data = build_data(run_of("prepare", overrides))
    data.prepare_data()
    return data.evaluation_batch(list(data.subjects("val"))[person], views=4)


def on_white(batch: Batch) -> list[np.ndarray]:
    colors = (batch.images[0] * BRIGHTER).clamp(0, 1)
    return [to_uint8(color + 1 - alpha) for color, alpha in zip(colors, batch.alpha[0], strict=True)]


def closer(picture: np.ndarray, matte: np.ndarray) -> Image.Image:
    """The subject of a photograph, as high as half of the picture less a margin."""
    rows, columns = (np.nonzero((matte > 127).any(axis))[0] for axis in (1, 0))
    height = round((rows[-1] - rows[0]) * 1.12)
    top, left = (rows[0] + rows[-1] - height) // 2, (columns[0] + columns[-1] - height * WIDTH // SIDE) // 2
    box = (left, top, left + height * WIDTH // SIDE, top + height)
    return Image.fromarray(picture).crop(box).resize((WIDTH // 2, SIDE // 2), Image.Resampling.LANCZOS)


def turned(gaussians: Gaussians, capture: Batch, degrees: list[float]) -> list[np.ndarray]:
    """Renders of :data:`SIDE` pixels from directions around the subject."""
    angles = torch.tensor(degrees, dtype=torch.float64) * (math.pi / 180)
    cameras = orbit(capture.cameras[0], angles, subject_points(gaussians))
    intrinsics = cameras.intrinsics.clone()
    intrinsics[:, :2] *= SIDE / cameras.height
    cameras = dataclasses.replace(cameras, intrinsics=intrinsics, height=SIDE, width=SIDE)
    drawn = (Renderer()(gaussians, cameras[i : i + 1][None], background=1.0) for i in range(len(angles)))
    return [to_uint8(one.image[0, 0]) for one in drawn]


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("picture", type=Path)
    parser.add_argument("turntable", type=Path)
    parser.add_argument("--checkpoint", default="shipped")
    parser.add_argument("--person", type=int, default=0, help="number in the split val")
    options = parser.parse_args()
    batch = photographs(options.person)
    shown, shares = on_white(batch), (255 * batch.alpha[0]).round().byte().numpy()
    matrices = batch.cameras.intrinsics[0].double().numpy(), batch.cameras.extrinsics[0].double().numpy()
    views = zip(batch.views[0], shown, shares, *matrices, strict=True)
    capture = Capture("person", tuple(Photograph(*view) for view in views))
    size = trained_size(read_checkpoint(options.checkpoint)["config"])
    result = predict(capture, GHGS.from_checkpoint(options.checkpoint), size)
    canvas = Image.new("RGB", (WIDTH * (1 + len(BETWEEN)), SIDE), "white")
    for place, (picture, share) in enumerate(zip(shown, shares, strict=True)):
        canvas.paste(closer(picture, share), (place % 2 * WIDTH // 2, place // 2 * SIDE // 2))
    beside = (SIDE - WIDTH) // 2
    for place, picture in enumerate(turned(result.gaussians, result.batch, list(BETWEEN))):
        middle = Image.fromarray(picture[:, beside : beside + WIDTH])
        canvas.paste(middle, ((1 + place) * WIDTH, 0))
    pen = ImageDraw.Draw(canvas)
    pen.text((8, SIDE - 16), "four photographs", "black")
    for place, angle in enumerate(BETWEEN):
        pen.text(((1 + place) * WIDTH + 8, 8), f"prediction, half-way: {angle} degrees", "black")
    canvas.save(options.picture, optimize=True)
    frames = turned(result.gaussians, result.batch, [360 * i / FRAMES for i in range(FRAMES)])
    first, *others = (Image.fromarray(frame) for frame in frames)
    first.save(options.turntable, save_all=True, append_images=others, duration=80, loop=0, quality=80)


if __name__ == "__main__":
    main()
