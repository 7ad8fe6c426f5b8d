"""Photographs whose frame ends above the subject's feet: portraits, and cameras that are near."""

import dataclasses
import math

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghgs_lit.types import Batch, Cameras, extents

#: Least and greatest share of the subject's height that a frame shows: from the waist to the ankles.
_SHOWN = 0.45, 0.95


def cut(batch: Batch, chance: float, rngs: list[np.random.Generator]) -> Batch:
    """The batch with a share ``chance`` of its subjects cut by the frame's lower edge.

    In one half of them all photographs and all targets end at about the same height, so that nobody is asked
    for legs that no photograph shows; in the other half some of the inputs end, at heights of their own.
    Photographs are moved down in their frames, principal points with them. ``rngs``: one for each element.
    """
    views = batch.masks.shape[1]
    shares, ends = np.ones(batch.masks.shape[:2]), np.ones(len(rngs))
    for b, rng in enumerate(rngs):
        is_cut, everywhere, *drawn = rng.uniform(size=3 + 2 * views)
        height, chosen, heights = drawn[0], np.array(drawn[1 : 1 + views]), np.array(drawn[1 + views :])
        low, high = _SHOWN
        if is_cut >= chance:
            continue
        if everywhere < 0.5:
            shares[b] = ends[b] = low + (high - low) * height
        else:
            some = (chosen < 0.5) | (chosen == chosen.min())
            some[chosen.argmax()] = False  # at least one is whole
            shares[b, some] = (low + (high - low) * heights)[some]
    rows = _rows(batch.masks, shares)
    maps = {name: _lowered(getattr(batch, name), rows) for name in ("images", "masks", "depths", "alpha")}
    targets = batch.targets
    if targets is not None:
        lower = _rows(targets.masks, np.broadcast_to(ends[:, None], targets.masks.shape[:2]))
        targets = dataclasses.replace(
            targets,
            images=_lowered(targets.images, lower),
            masks=_lowered(targets.masks, lower),
            cameras=_with_lower_centers(targets.cameras, lower),
        )
    return dataclasses.replace(
        batch, **maps, cameras=_with_lower_centers(batch.cameras, rows), targets=targets
    )


def _rows(masks: Bool[Tensor, "B V H W"], shares: Float[np.ndarray, "B V"]) -> list[list[int]]:
    """By how many rows photographs move down so that the given share of the mask's height stays."""
    height, views = masks.shape[2], masks.shape[1]
    found = []
    for seen, share in zip(extents(masks.flatten(0, 1)), shares.flatten(), strict=True):
        end = math.ceil(seen.top + share * (seen.bottom - seen.top))
        found.append(height - end if seen.count and share < 1 else 0)
    return [found[start : start + views] for start in range(0, len(found), views)]


def _lowered(maps: Tensor | None, rows: list[list[int]]) -> Tensor | None:
    """``maps`` [B, V, ..., H, W], each moved down by its rows; 0 and False above."""
    if maps is None:
        return None
    moved = torch.zeros_like(maps)
    for b, of_views in enumerate(rows):
        for v, down in enumerate(of_views):
            moved[b, v, ..., down:, :] = maps[b, v, ..., : maps.shape[-2] - down, :]
    return moved


def _with_lower_centers(cameras: Cameras, rows: list[list[int]]) -> Cameras:
    intrinsics = cameras.intrinsics.clone()
    intrinsics[..., 1, 2] += intrinsics.new_tensor(rows)
    return dataclasses.replace(cameras, intrinsics=intrinsics)
