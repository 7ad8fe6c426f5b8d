"""The Gaussians that a page holds, read back."""

import zlib
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ghgs_lit.prediction.export.page import _NARROW, _WIDE
from ghgs_lit.types import Gaussians


def unpack(data: bytes, pixel: float, center: Tensor, steps: Mapping[str, int], like: Gaussians) -> Gaussians:
    """The Gaussians of :func:`pack`, on the CPU, with the image constants of ``like``."""
    planes = np.frombuffer(zlib.decompress(data), np.uint8).reshape(4 * _WIDE + _NARROW, -1)
    wide = np.ascontiguousarray(planes[: 4 * _WIDE].T).view("<u4").astype(np.int64)
    centers = torch.from_numpy((wide >> 1 ^ -(wide & 1)).cumsum(0))
    narrow = planes[4 * _WIDE :].T.astype(np.int64).cumsum(0)
    narrow[:, [3, 5]] += narrow[:, [4]]
    scales, colors, rotations = (torch.from_numpy(part) for part in np.split(narrow, [3, 7], axis=1))
    turned = _signed(rotations) / steps["rotation"]
    square = turned.square().sum(1, keepdim=True)
    values = {
        "means": center.cpu() + centers * (pixel / steps["center"]),
        "scales": pixel * (_signed(scales) / steps["scale"]).exp(),
        "quaternions": torch.cat([1 - square, 2 * turned], dim=1) / (1 + square),
        "colors": (colors[:, :3] & 255) / 255,
        "opacities": (colors[:, 3] & 255) / steps["opacity"],
    }
    values = {name: value.float() for name, value in values.items()}
    return replace(like, **values, image=None, pixel=None, splits=(len(centers),))


def _signed(numbers: Tensor) -> Tensor:
    """Numbers modulo 256, from -128 to 127."""
    return (numbers + 128 & 255) - 128
