"""Pictures to look at: photographs, renders, errors and depths side by side, as RGB uint8 arrays."""

import os
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw
from torch import Tensor

from ghgs_lit.types import Batch

_CAPTION = 14  # height of a caption in pixels
_GAP = 2
ERROR_GAIN = 4.0
"""Mean absolute error of the colours is multiplied by this before it is shown."""


@cache
def palette(name: str) -> np.ndarray:
    import matplotlib

    return (matplotlib.colormaps[name](np.linspace(0, 1, 256))[:, :3] * 255).astype(np.uint8)


def to_uint8(image: Tensor) -> np.ndarray:
    """[3, h, w] in [0, 1] as [h, w, 3]; what lies outside is clamped."""
    image = image.detach().float().cpu().nan_to_num(0).clamp(0, 1)
    return (image * 255).round().byte().permute(1, 2, 0).numpy()


def colorize(values: Tensor, low: float, high: float, name: str, valid: Tensor | None = None) -> np.ndarray:
    """[h, w] numbers as colours between ``low`` and ``high``; black where not ``valid``."""
    values = values.detach().float().cpu()
    scaled = ((values - low) / max(high - low, 1e-9)).nan_to_num(0).clamp(0, 1)
    picture = palette(name)[(scaled * 255).round().long().numpy()]
    if valid is not None:
        picture = picture * valid.cpu().numpy()[..., None].astype(np.uint8)
    return picture


def error_map(image: Tensor, target: Tensor) -> np.ndarray:
    """Mean absolute error over the channels, ``ERROR_GAIN`` times brighter."""
    return colorize((image - target).abs().mean(0) * ERROR_GAIN, 0, 1, "inferno")


def depth_range(depth: Tensor, valid: Tensor) -> tuple[float, float]:
    """1st and 99th percentile of the valid depths; (0, 1) without any."""
    known = depth[valid].detach().float().cpu().numpy()
    low, high = np.quantile(known, [0.01, 0.99]) if known.size else (0.0, 1.0)
    return float(low), float(high)


def depth_map(depth: Tensor, valid: Tensor, limits: tuple[float, float]) -> np.ndarray:
    """A depth map in colours between ``limits`` in metres; near is red, black where not ``valid``."""
    return colorize(-depth, -limits[1], -limits[0], "turbo", valid)


def row(tiles: Sequence[np.ndarray], captions: Sequence[str]) -> np.ndarray:
    """Tiles side by side, each under its caption."""
    height = max(tile.shape[0] for tile in tiles) + _CAPTION
    width = sum(tile.shape[1] for tile in tiles) + _GAP * (len(tiles) - 1)
    canvas = Image.new("RGB", (width, height), (24, 24, 24))
    draw, left = ImageDraw.Draw(canvas), 0
    for tile, caption in zip(tiles, captions, strict=True):
        draw.text((left + 2, 1), caption, fill=(230, 230, 230))
        canvas.paste(Image.fromarray(tile), (left, _CAPTION))
        left += tile.shape[1] + _GAP
    return np.asarray(canvas)


def stack(rows: Sequence[np.ndarray]) -> np.ndarray:
    """Rows below one another, filled up on the right."""
    width = max(r.shape[1] for r in rows)
    return np.concatenate([np.pad(r, ((0, _GAP), (0, width - r.shape[1]), (0, 0))) for r in rows])


def grid(tiles: Sequence[np.ndarray], aspect: float = 1.5) -> np.ndarray:
    """Pictures of one size in rows and columns; the whole is about ``aspect`` times as wide as high."""
    height, width = tiles[0].shape[:2]

    def mismatch(columns: int) -> float:
        rows = -(-len(tiles) // columns)
        return abs(np.log(columns * width / (rows * height) / aspect))

    columns = min(range(1, len(tiles) + 1), key=mismatch)
    gap = np.full((height, 4 * _GAP, 3), 255, np.uint8)
    rows = []
    for start in range(0, len(tiles), columns):
        parts = [part for tile in tiles[start : start + columns] for part in (tile, gap)]
        rows.append(np.concatenate(parts[:-1], axis=1))
    return stack(rows)


def _depth_rows(
    batch: Batch, element: int, depth: Tensor | None, depth_valid: Tensor | None
) -> list[np.ndarray]:
    """Predicted and true depths of one subject's views, in the same colours."""
    masks, maps = batch.masks[element], {}
    if depth is not None:
        maps["depth"] = (depth[element], masks if depth_valid is None else masks & depth_valid[element])
    if batch.depths is not None:
        maps["true depth"] = (batch.depths[element], masks & (batch.depths[element] > 0))
    if not maps:
        return []
    # The truth, where it is known, sets the range.
    limits = [depth_range(d, v) for d, v in zip(*list(maps.values())[-1], strict=True)]
    return [
        row([depth_map(*tile) for tile in zip(*values, limits, strict=True)], [name] * len(limits))
        for name, values in maps.items()
    ]


def sheet(
    batch: Batch,
    image: Tensor,
    element: int = 0,
    depth: Tensor | None = None,
    depth_valid: Tensor | None = None,
) -> np.ndarray:
    """One subject: inputs; their depths, where predicted and where known; target, render and error.

    ``image`` is [B, T, 3, h, w]; ``depth`` and ``depth_valid`` are [B, V, H, W].
    """
    views = batch.views[element] if batch.views else tuple(map(str, range(batch.images.shape[1])))
    rows = [row([to_uint8(i) for i in batch.images[element]], [f"input {name}" for name in views])]
    rows += _depth_rows(batch, element, depth, depth_valid)
    for t, (render, target) in enumerate(zip(image[element], batch.targets.images[element], strict=True)):
        name = batch.targets.names[element][t] if batch.targets.names else str(t)
        tiles = [to_uint8(target), to_uint8(render), error_map(render, target)]
        rows.append(row(tiles, [f"target {name}", "render", f"error x{ERROR_GAIN:g}"]))
    return stack(rows)


def save_png(picture: np.ndarray, path: Path) -> None:
    """Write a PNG aside and rename it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    Image.fromarray(picture).save(aside, format="PNG")
    aside.replace(path)
