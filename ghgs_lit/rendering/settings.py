"""The constants that define the image; the defaults are gsplat's."""

import math
from collections.abc import Callable
from dataclasses import dataclass

from ghgs_lit.errors import require


@dataclass(frozen=True)
class RasterSettings:
    """The constants of the image, the same in all backends.

    Each pixel composites Gaussians in the order of their float32 depth, ties by index. A Gaussian has
    ``alpha = min(alpha_max, opacity exp(-sigma))`` with ``sigma`` half its squared Mahalanobis distance
    from the pixel's centre; it is skipped where ``alpha < alpha_min`` or ``sigma > extent^2 / 2``. Where the
    transmittance behind a Gaussian would not exceed ``stop``, the pixel ends before that Gaussian.
    """

    low_pass: float = 0.3
    """Added to both diagonal entries of the 2D covariance, px^2."""
    alpha_max: float = 0.999
    """Upper limit of alpha."""
    alpha_min: float = 1 / 255
    """Gaussians are skipped where their alpha is smaller."""
    stop: float = 1e-4
    """Transmittance at which a pixel ends."""
    extent: float = 3.33
    """Radius, in standard deviations, beyond which a Gaussian of opacity above one is cut off."""
    frustum_margin: float = 0.3
    """Outside the frame the Jacobian is evaluated at most this part of tan(field of view / 2) beyond it."""
    antialiased: bool = False
    """Scale opacity by ``sqrt(max(0, det before low-pass / det after))``."""

    def __post_init__(self) -> None:
        def check(name: str, holds: Callable[[float], bool], expected: str) -> None:
            value = getattr(self, name)
            require(is_finite_number(value) and holds(value), f"renderer.settings.{name}", expected, value)

        for name in ("low_pass", "frustum_margin", "stop"):
            check(name, lambda value: value >= 0, "a number >= 0")
        for name in ("alpha_min", "alpha_max"):
            check(name, lambda value: 0 < value < 1, "a number between 0 and 1")
        check("alpha_min", lambda value: value < self.alpha_max, f"less than alpha_max = {self.alpha_max}")
        check("extent", lambda value: value > 0, "a number > 0")
        found = self.antialiased
        require(isinstance(found, bool), "renderer.settings.antialiased", "true or false", found)


def is_finite_number(value: object) -> bool:
    """Whether a value from a configuration is a finite number (true and false are not numbers)."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
