"""Results of reading single photographs, and the comparison of the masks of one subject."""

from collections.abc import Sequence
from dataclasses import dataclass

from ghgs_lit.data.overlap import Tile
from ghgs_lit.data.reader import Reader
from ghgs_lit.data.sampling import RING_VIEW
from ghgs_lit.data.silhouettes import SEARCH, height, twins
from ghgs_lit.geometry.silhouettes import Silhouette

#: Subject, position and view.
Photograph = tuple[str, int, int]


@dataclass
class Seen:
    """Result of reading one photograph. ``iou``: of body and mask (:func:`overlap`). Without a body to
    compare: ``agreement``, the share of the mask that the other masks allow, and ``silhouette``, the coarse
    mask. ``tall``: the subject's largest side in world units, by body or masks."""

    name: str
    position: int
    view: int
    iou: float | None = None
    agreement: float | None = None
    body: bool = False
    tall: float | None = None
    digest: str | None = None
    problem: str | None = None
    silhouette: Silhouette | None = None
    tile: Tile | None = None

    @property
    def photograph(self) -> Photograph:
        return self.name, self.position, self.view


def compare_masks(seen: Sequence[Seen], reader: Reader, least: float) -> None:
    """Find the agreement of masks without a body; at most one problem for each subject. ``least``: share of
    a mask that the other masks of its subject must allow."""
    by_subject: dict[str, list[Seen]] = {}
    for one in seen:
        if one.silhouette is not None:
            by_subject.setdefault(one.name, []).append(one)
    for several in by_subject.values():
        if len(several) > 1:
            _compare(several, reader, least)


def _compare(seen: Sequence[Seen], reader: Reader, least: float) -> None:
    ring = {one.position: one for one in seen if one.view == RING_VIEW}
    pair = twins({position: one.silhouette.extrinsics for position, one in ring.items()})
    if pair is not None:
        place = reader.place(*ring[pair[1]].photograph)
        line = f"{place}: expected a camera of its own; found that of position {pair[0]}"
        ring[pair[1]].problem = line
        return
    silhouettes = [one.silhouette for one in seen]
    tall = height(silhouettes)
    for one, share in zip(seen, SEARCH.shares(silhouettes), strict=True):
        one.agreement, one.tall = share, tall if one.tall is None else one.tall
    worst = min(seen, key=lambda one: one.agreement)
    if worst.agreement < least:
        worst.problem = (
            f"{reader.place(*worst.photograph)}: expected a mask that the others of its subject allow "
            f"({least:.0%} of it or more); found {worst.agreement:.0%} (wrong axes, units, direction or size "
            "of a camera?)"
        )
