"""What checking a data set found."""

from dataclasses import dataclass, field

import numpy as np

from ghgs_lit.data.contact import Tile
from ghgs_lit.geometry.silhouettes import Silhouette

#: Name of the subject, position and view.
Photograph = tuple[str, int, int]


@dataclass(frozen=True)
class Seen:
    """What reading one photograph gave.

    Attributes:
        iou, inside: how the body fits the mask (:class:`Overlap`), where there is a body.
        agreement: where there is none, the share of the mask that the other masks allow.
        tall: its largest side in world units, by its body or by its masks, where that is known.
        silhouette: the coarse mask, where the body does not check the camera.
    """

    name: str
    position: int
    view: int
    iou: float | None = None
    inside: float | None = None
    agreement: float | None = None
    body: bool = False
    tall: float | None = None
    digest: str | None = None
    problem: str | None = None
    silhouette: Silhouette | None = field(default=None, repr=False)
    tile: Tile | None = field(default=None, repr=False)


@dataclass
class Phase:
    """What was found in a phase."""

    people: int
    subjects: int
    bodies: int
    seen: list[Seen]

    @property
    def tall(self) -> float | None:
        """Median largest side of the subjects in world units, where it is known."""
        known = [seen.tall for seen in self.seen if seen.tall is not None]
        return float(np.median(known)) if known else None

    def overlaps(self, key: str) -> list[float]:
        """All known values of ``iou``, ``inside`` or ``agreement``."""
        return [value for seen in self.seen if (value := getattr(seen, key)) is not None]


@dataclass
class Report:
    """The result of a check.

    Attributes:
        problems: lines ``<place>: expected ...; found ...`` of what keeps training from starting.
        notes: the same of what does not.
        inspections: number of files that were checked beside the photographs.
    """

    phases: dict[str, Phase] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    inspections: int = 0
