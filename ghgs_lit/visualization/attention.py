"""Pictures of the recalibration's attention, overlaid on the input images."""

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor

from ghgs_lit.errors import require
from ghgs_lit.method.recalibration.inspection import TokenAttention
from ghgs_lit.types import Batch, Points, Tokens
from ghgs_lit.visualization.pictures import palette, row, stack, to_uint8

_SIDE = 224  # minimum height of a tile in pixels
_QUERY = (255, 60, 220)


def choose_token(
    tokens: Tokens, points: Points, element: int, at: tuple[int, int, int] | None = None
) -> int | None:
    """Index of the packed token with a valid point nearest to ``at``; None if its view has none.

    Args:
        tokens: packed tokens of a batch.
        points: their points, some of them invalid.
        element: index of the subject in the batch.
        at: ``(view, row, column)`` on the grid of tokens; None: the centre of the subject in its
            first view.

    Raises:
        InputError: ``at`` is outside the grid.
    """
    views, height, width = tokens.grid[1:]
    if at is not None:
        expected = f"view, row, column below {(views, height, width)}"
        inside = all(0 <= n < end for n, end in zip(at, (views, height, width), strict=True))
        require(inside, "callbacks.pictures.token", expected, list(at))
    view = 0 if at is None else at[0]
    candidates = ((tokens.image == element * views + view) & points.tokens_valid).nonzero()[:, 0]
    if not len(candidates):
        return None
    places = torch.stack((tokens.row[candidates], tokens.column[candidates]), -1).float()
    wanted = places.mean(0) if at is None else places.new_tensor(at[1:])
    return int(candidates[(places - wanted).square().sum(-1).argmin()])


def attention_sheet(batch: Batch, tokens: Tokens, attention: TokenAttention) -> np.ndarray:
    """Picture of a subject's views with the query token (outlined) and its neighbours.

    The first row shows the neighbours, the nearest brightest; captions give their number per view.
    One row per layer shows the weights averaged over heads, the largest brightest, followed by those
    with ``s = 1`` if they differ; captions give the share of each view.

    Args:
        batch: with images of whole patches.
        tokens: packed tokens of the batch.
        attention: attention of one of these tokens.

    Returns:
        Picture [h, w, 3] RGB uint8.
    """
    views = tokens.grid[1]
    element = int(tokens.image[attention.query]) // views
    names = batch.views[element] if batch.views else tuple(map(str, range(views)))
    images = [to_uint8(image) for image in batch.images[element]]
    count = len(attention.neighbors)
    ranks = torch.linspace(1, 0.25, count)
    near = tokens.image[attention.neighbors] % views
    captions = [f"{name}: {int((near == v).sum())} of {count} neighbours" for v, name in enumerate(names)]
    rows = [row(_tiles(images, tokens, attention, ranks), captions)]
    kinds = {"": attention.weights, " without semantics (s = 1)": attention.plain}
    if torch.equal(attention.weights, attention.plain):
        del kinds[" without semantics (s = 1)"]
    for layer in range(len(attention.weights)):
        tiles = []
        captions = []
        for what, all_weights in kinds.items():
            weights = all_weights[layer].float().mean(0).cpu()
            shares = [float(weights[(near == v).cpu()].sum()) for v in range(views)]
            captions += [f"layer {layer}{what}: {100 * share:.0f}% of attention" for share in shares]
            tiles += _tiles(images, tokens, attention, weights / weights.max())
        rows.append(row(tiles, captions))
    return stack(rows)


def _tiles(
    images: list[np.ndarray], tokens: Tokens, attention: TokenAttention, strengths: Tensor
) -> list[np.ndarray]:
    """Overlay the neighbours on each view, with ``strengths`` in [0, 1] as brightness."""
    scale = max(1, -(-_SIDE // images[0].shape[0]))
    side = tokens.patch_size * scale
    views = tokens.grid[1]

    def box(token: int) -> tuple[int, int, int, int]:
        left = int(tokens.column[token]) * side
        top = int(tokens.row[token]) * side
        return left, top, left + side - 1, top + side - 1

    viridis = palette("viridis")
    tiles = []
    for view, image in enumerate(images):
        large = image.repeat(scale, 0).repeat(scale, 1) // 4 * 3
        tile = Image.fromarray(large).convert("RGBA")
        layer = Image.new("RGBA", tile.size)
        draw = ImageDraw.Draw(layer)
        for token, strength in zip(attention.neighbors.tolist(), strengths.tolist(), strict=True):
            if int(tokens.image[token]) % views == view:
                color = tuple(int(c) for c in viridis[round(255 * strength)])
                draw.rectangle(box(token), fill=(*color, 50 + round(120 * strength)))
        if int(tokens.image[attention.query]) % views == view:
            draw.rectangle(box(attention.query), outline=(*_QUERY, 255), width=max(2, scale))
        tiles.append(np.asarray(Image.alpha_composite(tile, layer).convert("RGB")))
    return tiles
