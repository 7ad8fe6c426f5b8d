"""Built-in people: posed, clothed and textured, made at run time from a small body model."""

from ghgs_lit.synthesis.people.generate import generate
from ghgs_lit.synthesis.people.mesh import Person, TexturedMesh

__all__ = ["Person", "TexturedMesh", "generate"]
