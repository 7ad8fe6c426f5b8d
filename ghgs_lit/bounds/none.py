"""Depths without bounds."""

from typing import ClassVar

from ghgs_lit.config.options import Options
from ghgs_lit.types import Batch


class NoBounds(Options):
    """The stage of a model whose depths are not bounded, as in the authors' release."""

    group = "bounds"
    is_bounded: ClassVar[bool] = False

    def __call__(self, batch: Batch) -> None:
        """None: there are no bounds."""
        return None
