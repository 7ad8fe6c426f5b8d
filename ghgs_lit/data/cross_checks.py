"""Report of a data check, and checks between masks of a subject and between ``train`` and ``val``."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from ghgs_lit.data.overlap import Tile
from ghgs_lit.data.reader import Reader
from ghgs_lit.data.sampling import RING_VIEW
from ghgs_lit.data.silhouettes import SEARCH, height, twins
from ghgs_lit.geometry.silhouettes import Silhouette

#: Subject, position and view.
Photograph = tuple[str, int, int]


@dataclass(frozen=True)
class Seen:
    """Result of reading one photograph. ``iou``, ``inside``: fit of body and mask (:class:`Overlap`). Without
    a body to compare: ``agreement``, the share of the mask that the other masks allow, and ``silhouette``,
    the coarse mask. ``tall``: the subject's largest side in world units, by body or masks."""

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
    """Results of a phase."""

    people: int
    subjects: int
    bodies: int
    seen: list[Seen]

    @property
    def tall(self) -> float | None:
        """Median largest side of the subjects in world units, if known."""
        known = [seen.tall for seen in self.seen if seen.tall is not None]
        return float(np.median(known)) if known else None

    def overlaps(self, key: str) -> list[float]:
        """All known values of ``iou``, ``inside`` or ``agreement``."""
        return [value for seen in self.seen if (value := getattr(seen, key)) is not None]


@dataclass
class Report:
    """Result of a check. ``problems``: lines ``<place>: expected ...; found ...`` that prevent training;
    ``notes``: lines that do not. ``inspections``: number of files checked beside the photographs."""

    phases: dict[str, Phase] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    inspections: int = 0


def agreeing(seen: list[Seen], reader: Reader, least: float) -> list[Seen]:
    """``seen`` with the agreement of masks without a body; at most one problem for each subject. ``least``:
    share of a mask that the other masks of its subject must allow."""
    by_subject: dict[str, list[int]] = {}
    for i, one in enumerate(seen):
        if one.silhouette is not None:
            by_subject.setdefault(one.name, []).append(i)
    checked = list(seen)
    for indices in by_subject.values():
        if len(indices) > 1:
            for i, one in zip(indices, _compared([seen[i] for i in indices], reader, least), strict=True):
                checked[i] = one
    return checked


def _compared(seen: list[Seen], reader: Reader, least: float) -> list[Seen]:

    def broken(one: Seen, line: str) -> Seen:
        return replace(one, problem=f"{reader.place(one.name, one.position, one.view)}: {line}")

    ring = {one.position: one.silhouette.extrinsics for one in seen if one.view == RING_VIEW}
    if (pair := twins(ring)) is not None:
        line = f"expected a camera of its own; found that of position {pair[0]}"
        return [
            broken(one, line) if (one.position, one.view) == (pair[1], RING_VIEW) else one for one in seen
        ]
    silhouettes = [one.silhouette for one in seen]
    shares = SEARCH.shares(silhouettes)
    tall = height(silhouettes)
    seen = [
        replace(one, agreement=share, tall=tall if one.tall is None else one.tall)
        for one, share in zip(seen, shares, strict=True)
    ]
    worst = min(range(len(seen)), key=shares.__getitem__)
    if shares[worst] >= least:
        return seen
    line = (
        f"expected a mask that the others of its subject allow ({least:.0%} of it or more); "
        f"found {shares[worst]:.0%} (wrong axes, units, direction or size of a camera?)"
    )
    return [broken(one, line) if i == worst else one for i, one in enumerate(seen)]


def shared(root: str, phases: Mapping[str, Phase], readers: Mapping[str, Reader]) -> list[str]:
    """Problems: subjects, or photographs under different names, in both ``train`` and ``val``."""
    if set(phases) != {"train", "val"}:
        return []
    both = set(readers["train"].subjects) & set(readers["val"].subjects)
    lines = [
        f"{root}: expected each subject in train or in val; found {name!r} in both" for name in sorted(both)
    ]
    trained = {one.digest: one for one in phases["train"].seen if one.digest is not None}
    pairs: dict[tuple[str, str], str] = {}
    for one in phases["val"].seen:
        twin = trained.get(one.digest)
        if twin is not None and one.name not in both and (one.name, twin.name) not in pairs:
            place = readers["val"].place(one.name, one.position, one.view)
            other = readers["train"].place(twin.name, twin.position, twin.view)
            pairs[one.name, twin.name] = f"{place}: expected a photograph that train has not; found {other}"
    return lines + list(pairs.values())
