"""Pictures [h, w, 3] RGB uint8 of input images, renders, errors and depths."""

import textwrap
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from ghgs_lit.files import write_atomically
from ghgs_lit.types import Batch

_LETTERS = 22  # Width of the narrowest tile divided by the height of letters
_LEAST_LETTERS = 10  # Least height of letters in pixels
_GAP = 2
_GREY = (24, 24, 24)
ERROR_GAIN = 4.0  #: Factor of errors in pictures


@cache
def palette(name: str) -> np.ndarray:
    """RGB colours [256, 3] uint8 of a matplotlib colour map, such as ``viridis``."""
    import matplotlib

    return (matplotlib.colormaps[name](np.linspace(0, 1, 256))[:, :3] * 255).astype(np.uint8)


def to_uint8(image: Tensor) -> np.ndarray:
    """Convert an RGB image [3, h, w] to a picture [h, w, 3] uint8.

    Values outside [0, 1] are clamped; NaN becomes black, infinity black or white by its sign.
    """
    image = image.detach().float().cpu().nan_to_num(0).clamp(0, 1)
    return (image * 255).round().byte().permute(1, 2, 0).numpy()


def colorize(values: Tensor, low: float, high: float, name: str, valid: Tensor | None = None) -> np.ndarray:
    """Map values [h, w] to colours of a palette, as a picture [h, w, 3] uint8.

    Args:
        values: any numbers [h, w].
        low: value of the first colour.
        high: value of the last colour.
        name: name of the palette.
        valid: pixels to show [h, w], black elsewhere; None: all.
    """
    values = values.detach().float().cpu()
    scaled = ((values - low) / max(high - low, 1e-9)).nan_to_num(0).clamp(0, 1)
    picture = palette(name)[(scaled * 255).round().long().numpy()]
    if valid is not None:
        picture = picture * valid.cpu().numpy()[..., None].astype(np.uint8)
    return picture


def error_map(image: Tensor, target: Tensor) -> np.ndarray:
    """Picture [h, w, 3] uint8 of the mean absolute error over the channels, times :data:`ERROR_GAIN`.

    Args:
        image: RGB [3, h, w] in [0, 1].
        target: ground truth, likewise.
    """
    return colorize((image - target).abs().mean(0) * ERROR_GAIN, 0, 1, "inferno")


def row(tiles: Sequence[np.ndarray], captions: Sequence[str]) -> np.ndarray:
    """Concatenate tiles horizontally, each below its caption.

    Args:
        tiles: pictures [h, w, 3] uint8 of any sizes.
        captions: one per tile, wrapped to its width; words wider than the tile are clipped.

    Returns:
        Picture [h, w, 3] uint8.
    """
    letters = max(_LEAST_LETTERS, min(tile.shape[1] for tile in tiles) // _LETTERS)
    font = ImageFont.load_default(letters)
    texts = []
    for tile, caption in zip(tiles, captions, strict=True):
        columns = max(1, int((tile.shape[1] - 2 * _GAP) / font.getlength("n")))
        texts.append(textwrap.wrap(caption, columns, break_long_words=False))
    above = (letters + 4) * max(1, *map(len, texts))
    height = max(tile.shape[0] for tile in tiles) + above
    width = sum(tile.shape[1] for tile in tiles) + _GAP * (len(tiles) - 1)
    canvas = Image.new("RGB", (width, height), _GREY)
    left = 0
    for tile, lines in zip(tiles, texts, strict=True):
        strip = Image.new("RGB", (tile.shape[1], above), _GREY)
        text = "\n".join(lines)
        ImageDraw.Draw(strip).multiline_text((_GAP, 1), text, fill=(230, 230, 230), font=font, spacing=1)
        canvas.paste(strip, (left, 0))
        canvas.paste(Image.fromarray(tile), (left, above))
        left += tile.shape[1] + _GAP
    return np.asarray(canvas)


def stack(rows: Sequence[np.ndarray]) -> np.ndarray:
    """Concatenate pictures [h, w, 3] uint8 vertically, padded on the right."""
    width = max(r.shape[1] for r in rows)
    return np.concatenate([np.pad(r, ((0, _GAP), (0, width - r.shape[1]), (0, 0))) for r in rows])


def _depth_rows(
    batch: Batch, element: int, depth: Tensor | None, depth_valid: Tensor | None
) -> list[np.ndarray]:
    """A row of predicted and a row of true depths (those given) of one subject, in the same colours;
    captions give the depths shown in red (near) and blue (far)."""
    masks = batch.masks[element]
    maps = {}
    if depth is not None:
        maps["depth"] = (depth[element], masks if depth_valid is None else masks & depth_valid[element])
    if batch.depths is not None:
        maps["true depth"] = (batch.depths[element], masks & (batch.depths[element] > 0))
    if not maps:
        return []
    ends = []  # 1st and 99th percentiles of each view's depths (true ones if known)
    for depths, valid in zip(*list(maps.values())[-1], strict=True):
        known = depths[valid].detach().float().cpu().numpy()
        ends.append(np.quantile(known, [0.01, 0.99]).tolist() if known.size else (0.0, 1.0))
    rows = []
    for name, values in maps.items():
        tiles = zip(*values, ends, strict=True)
        tiles = [colorize(-d, -high, -low, "turbo", valid) for d, valid, (low, high) in tiles]
        rows.append(row(tiles, [f"{name}: red {low:.4g}, blue {high:.4g}" for low, high in ends]))
    return rows


def sheet(
    batch: Batch,
    image: Tensor | None,
    element: int = 0,
    depth: Tensor | None = None,
    depth_valid: Tensor | None = None,
) -> np.ndarray:
    """Picture of one subject: inputs, their depths, then target, render and error of each target view.

    Args:
        batch: images and masks, and depths and targets where known.
        image: renders of the targets [B, T, 3, h, w]; without targets, renders of the inputs, shown
            below these with their errors; None: no renders.
        element: index of the subject in the batch.
        depth: predicted depths [B, V, H, W] in the unit of the cameras, which captions use, too (of
            data sets: metres); None: no such row.
        depth_valid: pixels with a defined depth [B, V, H, W]; None: the masks.

    Returns:
        Picture [h, w, 3] uint8.
    """
    views = batch.views[element] if batch.views else tuple(map(str, range(batch.images.shape[1])))
    rows = [row([to_uint8(i) for i in batch.images[element]], [f"input {name}" for name in views])]
    if image is not None and batch.targets is None:
        pairs = list(zip(image[element], batch.images[element], strict=True))
        rows.append(row([to_uint8(render) for render, _ in pairs], [f"render {name}" for name in views]))
        rows.append(row([error_map(*pair) for pair in pairs], [f"error x{ERROR_GAIN:g}"] * len(pairs)))
    rows += _depth_rows(batch, element, depth, depth_valid)
    if image is None or batch.targets is None:
        return stack(rows)
    tiles = []
    captions = []
    for t, (render, target) in enumerate(zip(image[element], batch.targets.images[element], strict=True)):
        name = batch.targets.names[element][t] if batch.targets.names else str(t)
        tiles += [to_uint8(target), to_uint8(render), error_map(render, target)]
        captions += [f"target {name}", "render", f"error x{ERROR_GAIN:g}"]
    # Three tiles per target; many targets fill a roughly square picture.
    in_row = 3 * max(1, round((len(tiles) / 9) ** 0.5))
    for first in range(0, len(tiles), in_row):
        part = slice(first, first + in_row)
        rows.append(row(tiles[part], captions[part]))
    return stack(rows)


def save_png(picture: np.ndarray, path: Path) -> None:
    """Write a picture [h, w, 3] RGB uint8 as a PNG, atomically."""
    write_atomically(path, lambda temporary: Image.fromarray(picture).save(temporary, format="PNG"))
