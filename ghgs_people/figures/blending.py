"""Soft masks, and colours mixed by them."""

import numpy as np


def smoothstep(low: float, high: float, x: np.ndarray) -> np.ndarray:
    """Go from 0 to 1, with a slope of 0 at both ends.

    Args:
        low: where it is 0, as it is beyond; above ``high`` for a falling step.
        high: where it is 1, as it is beyond.
        x: any shape.

    Returns:
        3 t^2 - 2 t^3 of the shape of ``x``, t being the share of the way from ``low`` to ``high``.
    """
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3 - 2 * t)


def bump(x: np.ndarray, centre: float, width: float) -> np.ndarray:
    """A Gaussian, exp(-((x - centre) / width)^2).

    Args:
        x: any shape.
        centre: where it is 1.
        width: where it has fallen to 1 / e; beyond two widths it is nearly 0.
    """
    return np.exp(-(((x - centre) / width) ** 2))


def mix(colour: np.ndarray, mask: np.ndarray, ink: np.ndarray | float) -> np.ndarray:
    """Replace colours by another where a mask is 1.

    Args:
        colour: [k, 3].
        mask: [k] in [0, 1].
        ink: the other colour: one number, [3] or [k, 3].

    Returns:
        [k, 3].
    """
    return colour + (ink - colour) * mask[:, None]


def darken(colour: np.ndarray, mask: np.ndarray, amount: float) -> np.ndarray:
    """Darken colours where a mask is 1.

    Args:
        colour: [k, 3].
        mask: [k] in [0, 1].
        amount: share of the light that is taken away there, 0 to 1.

    Returns:
        [k, 3].
    """
    return colour * (1 - amount * mask)[:, None]
