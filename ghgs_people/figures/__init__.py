"""Built-in people, generated at run time from a small body model: posed, clothed and textured."""

from ghgs_people.figures.generate import generate
from ghgs_people.figures.mesh import Person, TexturedMesh

__all__ = ["Person", "TexturedMesh", "generate"]
