"""Sheets: the content of each row."""

import dataclasses

import numpy as np
import torch

from ghgs_lit.types import Targets
from ghgs_lit.visualization.pictures import row, sheet, to_uint8
from tests.helpers.scenes import make_batch


def test_renders_stand_below_the_photographs_where_there_are_no_targets():
    """Without targets, the sheet shows renders of the inputs and their errors."""
    batch = dataclasses.replace(make_batch(1, 3, 28, 140), depths=None, targets=None)
    renders = batch.images.flip(-1)
    alone, picture = sheet(batch, None), sheet(batch, renders)
    height, gap = len(alone), 2
    assert picture.shape == (3 * height, alone.shape[1], 3)
    assert np.array_equal(picture[:height], alone)
    for view in range(3):
        tile = picture[2 * height - gap - 28 : 2 * height - gap, view * 142 : view * 142 + 140]
        assert np.array_equal(tile, to_uint8(renders[0, view]))
    error = picture[3 * height - gap - 28 : 3 * height - gap, :140].astype(int).sum(-1)
    assert (error[(renders - batch.images)[0, 0].abs().sum(0) == 0] == error.min()).all()


def test_a_caption_stays_above_its_own_tile():
    """Long captions are wrapped, words that are too wide are clipped, and letters scale with tiles."""
    tiles = [np.zeros((20, 100, 3), np.uint8)] * 2
    plain = row(tiles, ["a", ""])
    for caption in ("its mask green, the hull of the other masks red", 40 * "w"):
        picture = row(tiles, [caption, ""])
        text = picture[: len(picture) - 20] != 24
        assert text[:, :100].any()
        assert not text[:, 100:].any()
    assert len(row(tiles, ["its mask green, the hull of the other masks red", ""])) > len(plain)
    large = row([np.zeros((20, 1000, 3), np.uint8)], ["a"])
    assert len(large) - 20 > 2 * (len(plain) - 20)


def test_many_targets_make_no_endless_column():
    """Sixteen targets take six tiles per row, a single one three."""
    batch = dataclasses.replace(make_batch(1, 3, 28, 140), depths=None)
    for count, rows, tiles in ((1, 1, 3), (16, 8, 6)):
        images = torch.rand(1, count, 3, 28, 140)
        masks = torch.ones(1, count, 28, 140, dtype=torch.bool)
        cameras = batch.cameras[:, [0] * count]
        targets = Targets(images, masks, cameras)
        picture = sheet(dataclasses.replace(batch, targets=targets), torch.zeros_like(images))
        height, width = images.shape[-2:]
        below = len(picture) - len(sheet(batch, None))
        assert below in range(rows * height, rows * (height + 2 * 16))
        assert picture.shape[1] == max(tiles * (width + 2) - 2, 3 * 142 - 2)
