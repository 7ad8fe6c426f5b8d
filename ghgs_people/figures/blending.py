"""Soft masks, and colours mixed by them."""

import numpy as np


def smoothstep(low: float, high: float, x: np.ndarray) -> np.ndarray:
    """0 below `low`, 1 above `high`, smooth between."""
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3 - 2 * t)


def bump(x: np.ndarray, centre: float, width: float) -> np.ndarray:
    """A Gaussian: 1 at `centre`, nearly 0 beyond two widths."""
    return np.exp(-(((x - centre) / width) ** 2))


def mix(colour: np.ndarray, mask: np.ndarray, ink: np.ndarray | float) -> np.ndarray:
    """Colours [k, 3], replaced by `ink` (one number, [3] or [k, 3]) where the mask [k] is 1."""
    return colour + (ink - colour) * mask[:, None]


def darken(colour: np.ndarray, mask: np.ndarray, amount: float) -> np.ndarray:
    """Colours [k, 3], darker by the share `amount` where the mask [k] is 1."""
    return colour * (1 - amount * mask)[:, None]
