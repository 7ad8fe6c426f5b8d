"""Constants of rendering; the defaults are gsplat's."""

from pydantic import Field

from ghgs_lit.config.options import Amount, Options


class RasterSettings(Options):
    """Constants of rendering, the same in all backends; others are in ``layout``.

    Each pixel composites Gaussians in the order of their float32 depth, ties by index. A Gaussian
    has ``alpha = min(alpha_max, opacity exp(-sigma))`` with ``sigma`` half its squared Mahalanobis
    distance from the pixel's centre; it is skipped where ``alpha < 1 / 255`` or ``sigma > 3.33^2 / 2``.
    A pixel terminates before the first Gaussian behind which its transmittance would not exceed 1e-4.
    """

    group = "renderer.settings"
    low_pass: Amount = 0.3
    """Added to both diagonal entries of the 2D covariance, px^2."""
    alpha_max: float = Field(0.999, gt=1 / 255, lt=1)
    """Upper limit of alpha."""
    antialiased: bool = False
    """Scale opacity by ``sqrt(max(0, det before low-pass / det after))``."""
