"""Tone curves of single cameras (another profile, contrast or picture style): found,
said and undone."""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ghgs_capture.capture import Capture
from ghgs_capture.crops import Photograph
from ghgs_lit.method.rounds.gains import log_gammas
from ghgs_lit.types import Batch, Gaussians

#: Log gamma of all channels, beside the median camera's, above which a camera has a tone curve of
#: its own, and how many times as large in one as in another: what light and wrong depths do
#: differs between them.
_OWN = 0.1
_UNLIKE = 2.0


def own_tones(batch: Batch, gaussians: Gaussians) -> dict[str, float]:
    """Find cameras with a tone curve of their own.

    Two photographs do not tell which of them has it.

    Args:
        batch: photographs of one subject.
        gaussians: predicted from the batch.

    Returns:
        Their gammas, about, by name.
    """
    if len(batch.views[0]) < 3:
        return {}
    tones = {}
    for name, logs in zip(batch.views[0], log_gammas(gaussians, batch)[0].tolist(), strict=True):
        least, middle, most = sorted(logs, key=abs)
        if abs(least) > _OWN and abs(most) < _UNLIKE * abs(least) and min(logs) * max(logs) > 0:
            tones[name] = math.exp(middle)
    return tones


def without_tones(capture: Capture, tones: Mapping[str, float]) -> Capture:
    """Undo tone curves.

    Args:
        capture: photographs as they are.
        tones: gammas above 0 by camera.

    Returns:
        The capture with these gammas undone; photographs of other cameras stay.
    """
    if not tones:
        return capture
    photographs = (_without(one, tones.get(one.name, 1.0)) for one in capture.photographs)
    return replace(capture, photographs=tuple(photographs))


def _without(photograph: Photograph, gamma: float) -> Photograph:
    levels = np.round(255 * (np.arange(256) / 255) ** (1 / gamma)).astype(np.uint8)
    return replace(photograph, image=levels[photograph.image])
