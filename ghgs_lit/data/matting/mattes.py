"""Mattes of photographs whose masks are a few pixels off, ragged or have holes.

A mask that is off by a pixel paints the background's colours on the subject's outline, other ones in every
view. The photograph itself says where the subject ends. What tells it is a network (``network.py``) that
learned from generated people before backgrounds of many kinds (``scripts/bake_matting.py``).
"""

import functools
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, UInt8
from safetensors.torch import load_file

from ghgs_lit.data.matting.network import MattingNetwork
from ghgs_lit.geometry.outlines import signed_distance

#: The tensors of the network that comes with the package, in half precision.
WEIGHTS = Path(__file__).with_name("weights.safetensors")
#: Pixels of the background around what may change, which the network sees too.
_AROUND = 16


def refined_matte(
    image: UInt8[np.ndarray, "h w 3"], matte: UInt8[np.ndarray, "h w"], pixels: float
) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]:
    """The subject on black (premultiplied), and its matte.

    Args:
        image: the photograph, with its background; best where the subject is 170 to 330 pixels tall, as in
            training.
        matte: 255 times the share of each pixel that shows the subject, a mask's 0 and 255 for instance.
        pixels: by how much the outline may be wrong, above 0 (8 in training); holes of twice that width are
            filled, too, where the photograph does not speak against it.
    """
    window = _window(matte > 127, int(pixels) + _AROUND)
    colors, given = (torch.from_numpy(part[window] / np.float32(255)) for part in (image, matte))
    with torch.inference_mode():
        found, subject = _network()(colors.permute(2, 0, 1)[None], given[None])
    # Pixels whose nearest one on the other side of the outline is so near.
    is_open = np.abs(signed_distance(matte[window] > 127)) + 0.5 <= pixels
    result = np.zeros_like(image), np.zeros_like(matte)
    kept = given.numpy(), (given[..., None] * colors).numpy()
    alpha = np.where(is_open, found[0].numpy(), kept[0])
    premultiplied = np.where(is_open[..., None], subject[0].permute(1, 2, 0).numpy(), kept[1])
    for whole, part in zip(result, (premultiplied, alpha), strict=True):
        whole[window] = np.round(255 * part)
    return result


@functools.cache
def _network() -> MattingNetwork:
    network = MattingNetwork().eval()
    network.load_state_dict(load_file(WEIGHTS))
    return network.to(memory_format=torch.channels_last)


def _window(inside: Bool[np.ndarray, "h w"], margin: int) -> tuple[slice, slice]:
    """The part of an image around its mask; all of it where the mask is empty."""
    lines = (np.nonzero(inside.any(axis))[0] for axis in (1, 0))
    return tuple(slice(max(n[0] - margin, 0), n[-1] + margin + 1) if len(n) else slice(None) for n in lines)
