"""Photographs, renders, errors and depths side by side, as pictures [h, w, 3] RGB uint8, and coloured
point clouds for a viewer in 3D."""

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from ghgs_lit.files import write_atomically
from ghgs_lit.types import Batch, Prediction

_LETTERS = 22  # Height of letters: the narrowest tile's width over this, ...
_LEAST_LETTERS = 10  # ... at least, in pixels
_GAP = 2
ERROR_GAIN = 4.0  #: Factor of errors before they are shown
BODY_COLOR = (0.25, 0.5, 0.95)

Cloud = tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]  #: Positions and colours


@cache
def palette(name: str) -> np.ndarray:
    """Colours of a colour map of matplotlib.

    Args:
        name: Such as ``viridis``.

    Returns:
        256 RGB colours [256, 3] uint8.
    """
    import matplotlib

    return (matplotlib.colormaps[name](np.linspace(0, 1, 256))[:, :3] * 255).astype(np.uint8)


def to_uint8(image: Tensor) -> np.ndarray:
    """A picture of an image.

    Args:
        image: RGB [3, h, w]; values outside [0, 1] are clamped,
            those that are not finite are black or white.

    Returns:
        Picture [h, w, 3] uint8.
    """
    image = image.detach().float().cpu().nan_to_num(0).clamp(0, 1)
    return (image * 255).round().byte().permute(1, 2, 0).numpy()


def colorize(values: Tensor, low: float, high: float, name: str, valid: Tensor | None = None) -> np.ndarray:
    """Values in colours of a palette.

    Args:
        values: Any numbers [h, w].
        low: Value of the first colour.
        high: Value of the last colour.
        name: Of the palette.
        valid: Where values are shown [h, w]; black elsewhere. None: everywhere.

    Returns:
        Picture [h, w, 3] uint8.
    """
    values = values.detach().float().cpu()
    scaled = ((values - low) / max(high - low, 1e-9)).nan_to_num(0).clamp(0, 1)
    picture = palette(name)[(scaled * 255).round().long().numpy()]
    if valid is not None:
        picture = picture * valid.cpu().numpy()[..., None].astype(np.uint8)
    return picture


def error_map(image: Tensor, target: Tensor) -> np.ndarray:
    """A picture of the mean absolute error over the channels, times ``ERROR_GAIN``.

    Args:
        image: RGB [3, h, w] in [0, 1].
        target: The same for the truth.

    Returns:
        Picture [h, w, 3] uint8.
    """
    return colorize((image - target).abs().mean(0) * ERROR_GAIN, 0, 1, "inferno")


def _caption_lines(caption: str, width: int, font: ImageFont.FreeTypeFont) -> list[str]:
    """Break a caption at its spaces into lines no wider than its tile; longer words stay as they are."""
    lines = []
    for word in caption.split():
        longer = f"{lines[-1]} {word}" if lines else word
        if lines and font.getlength(longer) <= width:
            lines[-1] = longer
        else:
            lines.append(word)
    return lines


def row(tiles: Sequence[np.ndarray], captions: Sequence[str]) -> np.ndarray:
    """Tiles side by side, each below its caption.

    Args:
        tiles: Pictures [h, w, 3] uint8 of any sizes.
        captions: One for each tile; long ones take several lines, and what is wider than its tile is cut.

    Returns:
        Picture [h, w, 3] uint8.
    """
    letters = max(_LEAST_LETTERS, min(tile.shape[1] for tile in tiles) // _LETTERS)
    font = ImageFont.load_default(letters)
    texts = [
        _caption_lines(caption, tile.shape[1] - 2 * _GAP, font)
        for tile, caption in zip(tiles, captions, strict=True)
    ]
    line_height = letters + 4
    above = line_height * max(len(lines) for lines in texts)
    height = max(tile.shape[0] for tile in tiles) + above
    width = sum(tile.shape[1] for tile in tiles) + _GAP * (len(tiles) - 1)
    canvas = Image.new("RGB", (width, height), (24, 24, 24))
    left = 0
    for tile, lines in zip(tiles, texts, strict=True):
        strip = Image.new("RGB", (tile.shape[1], above), (24, 24, 24))
        draw = ImageDraw.Draw(strip)
        for number, line in enumerate(lines):
            draw.text((_GAP, 1 + number * line_height), line, fill=(230, 230, 230), font=font)
        canvas.paste(strip, (left, 0))
        canvas.paste(Image.fromarray(tile), (left, above))
        left += tile.shape[1] + _GAP
    return np.asarray(canvas)


def stack(rows: Sequence[np.ndarray]) -> np.ndarray:
    """Rows below one another, padded on the right.

    Args:
        rows: Pictures [h, w, 3] uint8.

    Returns:
        Picture [h, w, 3] uint8.
    """
    width = max(r.shape[1] for r in rows)
    return np.concatenate([np.pad(r, ((0, _GAP), (0, width - r.shape[1]), (0, 0))) for r in rows])


def _depth_rows(
    batch: Batch, element: int, depth: Tensor | None, depth_valid: Tensor | None
) -> list[np.ndarray]:
    """A row of predicted and a row of true depths of one subject, in the same colours.

    Captions say which depth is red (near) and which is blue.

    Args:
        batch: With masks, and depths where they are known.
        element: Number of the subject in the batch.
        depth: Predicted depths [B, V, H, W], metres; None: no row of them.
        depth_valid: Where they are defined [B, V, H, W]; None: in the masks.

    Returns:
        Up to two pictures [h, w, 3] uint8.
    """
    masks = batch.masks[element]
    maps = {}
    if depth is not None:
        maps["depth"] = (depth[element], masks if depth_valid is None else masks & depth_valid[element])
    if batch.depths is not None:
        maps["true depth"] = (batch.depths[element], masks & (batch.depths[element] > 0))
    if not maps:
        return []
    ends = []  # 1st and 99th percentile of each view's (true, if known) depths
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
    """A picture of one subject: inputs, their depths, then target, render and error of each target.

    Args:
        batch: photographs, masks, and depths and targets where they are known.
        image: renders of the targets [B, T, 3, h, w]; without targets, renders of the inputs, which
            then stand below them with their errors; None: no renders.
        element: number of the subject in the batch.
        depth: predicted depths [B, V, H, W] in the unit of the cameras, as in captions (of data sets:
            metres); None: no row of them.
        depth_valid: where they are defined [B, V, H, W]; None: in the masks.

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
    # three tiles for each target; many targets in an about square picture
    in_row = 3 * max(1, round((len(tiles) / 9) ** 0.5))
    for first in range(0, len(tiles), in_row):
        part = slice(first, first + in_row)
        rows.append(row(tiles[part], captions[part]))
    return stack(rows)


def save_png(picture: np.ndarray, path: Path) -> None:
    """Write a picture as a PNG, whole or not at all.

    Args:
        picture: RGB [h, w, 3] uint8.
        path: Of the file.
    """
    write_atomically(path, lambda temporary: Image.fromarray(picture).save(temporary, format="PNG"))


def clouds(batch: Batch, prediction: Prediction, element: int, limit: int = 6000) -> dict[str, Cloud]:
    """Point clouds of one subject.

    ``points``: unprojected pixels in their colours; ``body``: body vertices, where the data
    has them; ``points_and_body``: both, whose distance the Chamfer term measures. Empty
    clouds are left out.

    Args:
        batch: Photographs, masks and bodies are read.
        prediction: Of that batch.
        element: Number of the subject in the batch.
        limit: Largest number of points and of vertices.

    Returns:
        Positions [n, 3] in metres and colours [n, 3] in [0, 1] by name.
    """
    valid = prediction.points.valid[element] & batch.masks[element]
    colors = batch.images[element].movedim(1, -1)
    parts = {"points": (prediction.points.pixels[element][valid], colors[valid])}
    if batch.body_vertices is not None:
        body = batch.body_vertices[element]
        parts["body"] = (body, body.new_tensor(BODY_COLOR).expand(len(body), 3))
    parts = {name: _thinned(cloud, limit) for name, cloud in parts.items()}
    if "body" in parts:
        pairs = zip(parts["points"], parts["body"], strict=True)
        parts["points_and_body"] = tuple(torch.cat(pair) for pair in pairs)
    return {name: cloud for name, cloud in parts.items() if len(cloud[0])}


def _thinned(cloud: Cloud, limit: int) -> Cloud:
    positions, colors = (part.detach().float().cpu() for part in cloud)
    finite = positions.isfinite().all(-1)
    positions = positions[finite]
    colors = colors[finite].nan_to_num(0).clamp(0, 1)
    step = max(1, -(-len(positions) // limit))
    return positions[::step], colors[::step]
