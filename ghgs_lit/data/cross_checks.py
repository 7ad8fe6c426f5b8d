"""Checks that compare photographs: masks of a subject with one another, ``train`` with ``val``."""

from collections.abc import Mapping
from dataclasses import replace

from ghgs_lit.data.findings import Phase, Seen
from ghgs_lit.data.reader import Reader
from ghgs_lit.data.sampling import RING_VIEW
from ghgs_lit.data.silhouettes import SEARCH, height, twins


def agreeing(seen: list[Seen], reader: Reader, least: float) -> list[Seen]:
    """``seen`` with the agreement of those masks that no body checked; at most one problem for each subject.
    ``least``: share of a mask that the other masks of its subject must allow."""
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
    """Subjects, and photographs under different names, that are both in ``train`` and in ``val``."""
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
