"""Constants of rendering; the defaults are gsplat's."""

from pydantic import Field, model_validator

from ghgs_lit.config.options import Amount, Options, Positive


class RasterSettings(Options):
    """Constants of rendering, the same in all backends.

    Each pixel composites Gaussians in the order of their float32 depth, ties by index. A Gaussian
    has ``alpha = min(alpha_max, opacity exp(-sigma))`` with ``sigma`` half its squared Mahalanobis
    distance from the pixel's centre; it is skipped where ``alpha < alpha_min`` or
    ``sigma > extent^2 / 2``. A pixel terminates before the first Gaussian behind which its
    transmittance would not exceed ``stop``.
    """

    group = "renderer.settings"
    low_pass: Amount = 0.3
    """Added to both diagonal entries of the 2D covariance, px^2."""
    alpha_max: float = Field(0.999, gt=0, lt=1)
    """Upper limit of alpha."""
    alpha_min: float = Field(1 / 255, gt=0, lt=1)
    """Gaussians are skipped in pixels where their alpha is smaller."""
    stop: Amount = 1e-4
    """Transmittance at or below which a pixel terminates."""
    extent: Positive = 3.33
    """Radius, in standard deviations, beyond which a Gaussian of opacity above one is cut off."""
    frustum_margin: Amount = 0.3
    """For centres outside the frame, the Jacobian is evaluated at most this fraction of tan(field of
    view / 2) beyond its border."""
    antialiased: bool = False
    """Scale opacity by ``sqrt(max(0, det before low-pass / det after))``."""

    @model_validator(mode="after")
    def _limits_in_order(self) -> "RasterSettings":
        self.require(self.alpha_min < self.alpha_max, "alpha_min", f"less than alpha_max = {self.alpha_max}")
        return self
