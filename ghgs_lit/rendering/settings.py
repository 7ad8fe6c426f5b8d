"""The constants that define the image; the defaults are gsplat's."""

import math
from dataclasses import dataclass

from ghgs_lit.errors import require


@dataclass(frozen=True)
class RasterSettings:
    """What all backends agree on.

    A pixel sees Gaussians in the order of their float32 depth, ties by index. Each has
    ``alpha = min(alpha_max, o exp(-sigma))``, ``sigma`` half its squared Mahalanobis distance from the
    pixel's centre; it is skipped where ``alpha < alpha_min`` or ``sigma > extent^2 / 2``. The pixel is
    finished, and that Gaussian left out, when the transmittance behind it would not exceed ``stop``.
    """

    low_pass: float = 0.3
    """Added to both diagonal entries of the 2D covariance, px^2."""
    alpha_max: float = 0.999
    alpha_min: float = 1 / 255
    stop: float = 1e-4
    extent: float = 3.33
    """Standard deviations beyond which a Gaussian of opacity above one is cut."""
    frustum_margin: float = 0.3
    """The Jacobian is taken at most this part of tan(field of view / 2) beyond the frame."""
    antialiased: bool = False
    """Scale opacity by ``sqrt(max(0, det before low-pass / det after))``."""

    def __post_init__(self) -> None:
        for name in ("low_pass", "frustum_margin", "stop"):
            value = getattr(self, name)
            require(_is_number(value) and value >= 0, f"renderer.settings.{name}", "a number >= 0", value)
        for name in ("alpha_min", "alpha_max"):
            value = getattr(self, name)
            require(
                _is_number(value) and 0 < value < 1,
                f"renderer.settings.{name}",
                "a number between 0 and 1",
                value,
            )
        require(
            self.alpha_min < self.alpha_max,
            "renderer.settings.alpha_min",
            f"less than alpha_max = {self.alpha_max}",
            self.alpha_min,
        )
        require(
            _is_number(self.extent) and self.extent > 0,
            "renderer.settings.extent",
            "a number > 0",
            self.extent,
        )
        require(
            isinstance(self.antialiased, bool),
            "renderer.settings.antialiased",
            "true or false",
            self.antialiased,
        )


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
