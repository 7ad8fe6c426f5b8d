"""Built-in people: posed, clothed and textured, made at run time from a small body model."""

from ghgs_people.figures.generate import generate
from ghgs_people.figures.mesh import Person, TexturedMesh

__all__ = ["Person", "TexturedMesh", "generate"]
