"""Textured meshes and people made of them: what is photographed.

Metres, y up, feet on y = 0, facing +z up to a yaw about y. Built-in people and scans use the same two types.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ghgs_lit.errors import InputError


@dataclass(frozen=True)
class TexturedMesh:
    """One part of a person: triangles with one texture. InputError: an array has another shape, or the faces
    name vertices that do not exist.

    Attributes:
        vertices: [n, 3] float32, metres.
        faces: [m, 3] int64, counter-clockwise seen from outside.
        uv: [n, 2] float32, origin at the bottom left of the texture, v upwards (as trimesh has them).
        texture: [h, w, 3 or 4] uint8, row 0 at the top.
        alpha_cutoff: faces are cut away where the texture's alpha is below this value (0 to 1); None: opaque.
    """

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    texture: np.ndarray
    alpha_cutoff: float | None = None

    def __post_init__(self) -> None:
        _expect("vertices", self.vertices, (None, 3))
        _expect("faces", self.faces, (None, 3))
        _expect("uv", self.uv, (len(self.vertices), 2))
        if self.texture.ndim != 3 or self.texture.shape[2] not in (3, 4):
            raise InputError(f"texture: expected [h, w, 3 or 4], found {list(self.texture.shape)}")
        if self.alpha_cutoff is not None and self.texture.shape[2] != 4:
            raise InputError("alpha_cutoff: expected a texture with alpha [h, w, 4], found 3 channels")
        if len(self.faces) and (self.faces.min() < 0 or self.faces.max() >= len(self.vertices)):
            raise InputError(
                f"faces: expected indices in [0, {len(self.vertices)}), "
                f"found {self.faces.min()} to {self.faces.max()}"
            )


@dataclass(frozen=True)
class Person:
    """A dressed, posed person. ``body_vertices``: [k, 3] float32, the body under the clothes in the frame of
    the parts; None: unknown."""

    name: str
    parts: tuple[TexturedMesh, ...]
    body_vertices: np.ndarray | None

    def mapped(self, function: Callable[[np.ndarray], np.ndarray]) -> "Person":
        """The person with ``function`` applied to all vertices [n, 3], in float64, of parts and body."""

        def move(vertices: np.ndarray) -> np.ndarray:
            return function(vertices.astype(np.float64)).astype(np.float32)

        parts = tuple(replace(part, vertices=move(part.vertices)) for part in self.parts)
        body = None if self.body_vertices is None else move(self.body_vertices)
        return replace(self, parts=parts, body_vertices=body)


def sample_texture(texture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Sample a repeating texture bilinearly.

    Colours of a texture with alpha are weighted by it, so that cut-away texels do not bleed into others.

    Args:
        texture: [h, w, c] uint8, c = 3 or 4.
        uv: [n, 2], origin at the bottom left.

    Returns:
        [n, c] in [0, 1].
    """
    height, width, channels = texture.shape
    x, y = uv[:, 0] * width - 0.5, (1 - uv[:, 1]) * height - 0.5
    left, top = np.floor(x), np.floor(y)
    fx, fy = (x - left).astype(np.float32), (y - top).astype(np.float32)
    columns = np.stack((left, left + 1)).astype(np.int64) % width
    rows = np.stack((top, top + 1)).astype(np.int64) % height
    texels = texture.reshape(-1, channels)
    total = np.zeros((len(uv), channels), np.float32)
    for i, wy in enumerate((1 - fy, fy)):
        for j, wx in enumerate((1 - fx, fx)):
            texel = texels[rows[i] * width + columns[j]].astype(np.float32) / 255
            if channels == 4:
                texel[:, :3] *= texel[:, 3:]
            total += (wx * wy)[:, None] * texel
    if channels == 4:
        alpha = total[:, 3:]
        total[:, :3] = np.where(alpha > 0, total[:, :3] / np.where(alpha > 0, alpha, 1), 0)
    return total


def _expect(name: str, array: np.ndarray, shape: tuple[int | None, ...]) -> None:
    """Raise unless `array` has `shape`, in which None means any length."""
    if array.ndim != len(shape) or any(s not in (None, a) for s, a in zip(shape, array.shape, strict=True)):
        wanted = ", ".join("n" if s is None else str(s) for s in shape)
        raise InputError(f"{name}: expected [{wanted}], found {list(array.shape)}")
