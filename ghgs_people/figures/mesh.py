"""Textured meshes, and people that consist of them.

Metres, y up, feet on y = 0, facing +z up to a yaw about y.
Built-in people and scans use the same two types.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ghgs_lit.data.decoding import check_array
from ghgs_lit.errors import require


@dataclass(frozen=True)
class TexturedMesh:
    """One part of a person: triangles with one texture.

    Raises:
        InputError: an array has another shape or a non-finite value, or faces refer to missing
            vertices.
    """

    vertices: np.ndarray  # [n, 3] float32, metres
    faces: np.ndarray  # [m, 3] int64, counter-clockwise seen from outside
    # [n, 2] float32, origin at the bottom left of the texture, v upwards, as trimesh has them
    uv: np.ndarray
    texture: np.ndarray  # [h, w, 3] uint8, row 0 at the top

    def __post_init__(self) -> None:
        for name, shape in (("vertices", (None, 3)), ("faces", (None, 3)), ("uv", (len(self.vertices), 2))):
            check_array(name, getattr(self, name), [shape])
        texture = self.texture
        count = len(self.vertices)
        fits = texture.ndim == 3 and texture.shape[2] == 3 and texture.dtype == np.uint8
        require(fits, "texture", "uint8 [h, w, 3]", f"{texture.dtype} {list(texture.shape)}")
        if len(self.faces):
            low = int(self.faces.min())
            high = int(self.faces.max())
            require(low >= 0 and high < count, "faces", f"indices in [0, {count})", f"{low} to {high}")


@dataclass(frozen=True)
class Person:
    """A dressed, posed person.

    Args:
        name: name of the person, for files and messages.
        parts: meshes in a common frame.
        body_vertices: [k, 3] float32, the body under the clothes in the frame of the parts;
            None: unknown.
    """

    name: str
    parts: tuple[TexturedMesh, ...]
    body_vertices: np.ndarray | None

    def mapped(self, function: Callable[[np.ndarray], np.ndarray]) -> "Person":
        """Transform the vertices of the person.

        Args:
            function: maps vertices [n, 3] float64; applied to parts and body.

        Returns:
            A new person, float32.
        """

        def move(vertices: np.ndarray) -> np.ndarray:
            return function(vertices.astype(np.float64)).astype(np.float32)

        parts = tuple(replace(part, vertices=move(part.vertices)) for part in self.parts)
        body = None if self.body_vertices is None else move(self.body_vertices)
        return replace(self, parts=parts, body_vertices=body)
