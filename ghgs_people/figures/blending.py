"""Soft masks, and blending of colours with them."""

import numpy as np


def smoothstep(low: float, high: float, x: np.ndarray) -> np.ndarray:
    """Smooth step from 0 to 1, with slope 0 at both ends.

    Args:
        low: value of ``x`` up to which the result is 0; above ``high`` for a falling step.
        high: value of ``x`` from which the result is 1.
        x: any shape.

    Returns:
        3 t^2 - 2 t^3 in the shape of ``x``, where t goes from 0 at ``low`` to 1 at ``high``.
    """
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3 - 2 * t)


def bump(x: np.ndarray, centre: float, width: float) -> np.ndarray:
    """A Gaussian, exp(-((x - centre) / width)^2).

    Args:
        x: any shape.
        centre: position of the maximum, 1.
        width: distance from the centre at which it is 1 / e.
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
        amount: fraction of the light that is removed there, 0 to 1.

    Returns:
        [k, 3].
    """
    return colour * (1 - amount * mask)[:, None]
