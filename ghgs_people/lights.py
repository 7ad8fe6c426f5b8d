"""Lights around a person, as in photographs of real people: several area lights with soft shadows, and
ambient light that is brighter from above. They are white and the same for every camera, so that views are
consistent.

The light at each vertex of the mesh is computed once, for both sides of the surface, and interpolated:

    (ambient (1 + sky n_y) + sum_l w_l mean_s visible(l, s) max(n . d_ls, 0)) ^ (1 / 2.2)

over samples s of each light l. The power turns it into a factor on stored texture values. The exposure is
that of a camera that meters the subject from all around."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

#: Gamma of stored values: light is their 2.2th power
GAMMA = 2.2
# Samples per light
_SAMPLES = 12
# Median of the mean brightness of 32 generated people at an exposure of 1
_TYPICAL = 0.39
# Samples at the rim that are traced first; the others are traced only where these disagree
_PROBED = 5
# Angle between successive samples on a sunflower spiral, which covers a disc evenly
_GOLDEN = np.pi * (3 - np.sqrt(5))
# Offset in metres of the origins of shadow rays from the surface
_LIFT = 3e-3

#: Whether rays, given by origins and directions [n, 3] float32, hit the subject [n]
Blocked = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Lights:
    """Ranges [least, greatest] from which lights are sampled."""

    count: tuple[int, int] = (2, 4)
    ambient: tuple[float, float] = (0.25, 0.55)  # fraction of ambient light, 0 to 1
    # relative increase of ambient light from above compared with the side, 0 to 1
    sky: tuple[float, float] = (0.1, 0.7)
    radius: tuple[float, float] = (4.0, 25.0)  # angular radius of a light, degrees
    elevation: tuple[float, float] = (5.0, 60.0)  # of a light, degrees
    contrast: float = 0.6  # relative variation of the lights' strengths, 0 to below 1
    brightness: float = 0.4  # mean of a typical subject, 1 for white
    spread: float = 0.12  # standard deviation of its logarithm, in addition to that between people

    def draw(self, rng: np.random.Generator) -> "LightRig":
        """Sample the lights of one person, roughly evenly spaced in azimuth.

        Args:
            rng: samples number, positions, sizes and strengths of the lights, and the brightness.
        """
        count = int(rng.integers(self.count[0], self.count[1] + 1))
        azimuth = 2 * np.pi * (np.arange(count) + rng.uniform() + rng.uniform(-0.3, 0.3, count)) / count
        elevation = np.radians(rng.uniform(*self.elevation, count))
        radius = np.tan(np.radians(rng.uniform(*self.radius, count)))
        strength = 1 + self.contrast * rng.uniform(-1, 1, count)
        ambient = rng.uniform(*self.ambient)
        side = np.stack((np.cos(azimuth), np.zeros(count), -np.sin(azimuth)), -1)
        middle = np.stack(
            (np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)), -1
        )
        spiral = np.arange(_SAMPLES)
        disc = np.sqrt((spiral + 0.5) / _SAMPLES) * np.exp(
            1j * (_GOLDEN * spiral + rng.uniform(0, 2 * np.pi))
        )
        offsets = disc[:, None].real * side[:, None] + disc[:, None].imag * np.cross(middle, side)[:, None]
        directions = middle[:, None] + radius[:, None, None] * offsets
        # Mean of max(n . d, 0) over the sphere of normals n is 1 / 4.
        return LightRig(
            (directions / np.linalg.norm(directions, axis=-1, keepdims=True)).astype(np.float32),
            (4 * (1 - ambient) * strength / strength.sum()).astype(np.float32),
            float(ambient),
            float(rng.uniform(*self.sky)),
            float(self.brightness * np.exp(self.spread * np.clip(rng.standard_normal(), -2, 2))),
        )


@dataclass(frozen=True)
class LightRig:
    """The lights of one person.

    Args:
        directions: [l, s, 3] float32 unit vectors towards samples of the lights.
        strengths: [l] float32, light that each adds to a surface facing it.
        ambient: ambient light.
        sky: relative increase of ambient light from above compared with the side, 0 to 1.
        brightness: mean brightness that a typical subject would have, 1 for white.
        exposure: factor on stored values; None: not measured yet.
    """

    directions: np.ndarray
    strengths: np.ndarray
    ambient: float
    sky: float
    brightness: float
    exposure: float | None = None

    def expose(self, brightness: float) -> "LightRig":
        """Set the exposure if it is not set.

        It compensates half (in logarithms) of a subject's deviation from a typical brightness, such as
        for dark or white clothes, like a camera that meters subject and surroundings.

        Args:
            brightness: mean brightness of the subject at an exposure of 1.
        """
        return replace(self, exposure=self.exposure or self.brightness / np.sqrt(_TYPICAL * brightness))

    def shade(
        self,
        points: np.ndarray,
        normals: np.ndarray,
        is_blocked: Blocked,
    ) -> np.ndarray:
        """Compute the light on both sides of a surface at an exposure of 1.

        Args:
            points: [n, 3] float32, points of the surface, metres.
            normals: [n, 3] float32 unit vectors.
            is_blocked: whether rays hit the subject.

        Returns:
            Factors [n, 2] on stored values, on the side of the normals and on the other side.
        """
        sides = np.array([1, -1], np.float32)
        light = self.ambient * (1 + self.sky * normals[:, 1:2] * sides)
        for directions, strength in zip(self.directions, self.strengths, strict=True):
            visible = _visible(points, normals, directions[-_PROBED:], is_blocked)
            edge = np.flatnonzero(visible.any(1) != visible.all(1))
            visible = np.repeat(visible[:, :1], len(directions), 1)
            visible[edge] = _visible(points[edge], normals[edge], directions, is_blocked)
            reached = visible * (normals @ directions.T)
            both = (np.maximum(reached, 0).mean(1), np.maximum(-reached, 0).mean(1))
            light += strength * np.stack(both, 1)
        return light ** (1 / GAMMA)


def _visible(
    points: np.ndarray, normals: np.ndarray, directions: np.ndarray, is_blocked: Blocked
) -> np.ndarray:
    """Visibility [n, s] of a light's samples from surface points, on the side facing each sample."""
    side = np.sign(normals @ directions.T)[..., None]
    origins = points[:, None] + np.float32(_LIFT) * side * normals[:, None]
    rays = np.broadcast_to(directions, origins.shape)
    return ~is_blocked(origins.reshape(-1, 3), rays.reshape(-1, 3)).reshape(side.shape[:2])
