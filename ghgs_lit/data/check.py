"""Check of a data set: read all of it once, and report what is there, missing and broken."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from rich.console import Console
from rich.progress import track
from torch.utils.data import Dataset

from ghgs_lit.data.datamodule import PhotographsDataModule
from ghgs_lit.data.layout import Completeness
from ghgs_lit.data.mask_checks import SEARCH, height, implausible, silhouette, twins
from ghgs_lit.data.overlap import Tile, draw_tile, overlap
from ghgs_lit.data.reader import PHASES, PhotographCache, Reader
from ghgs_lit.data.sampling import CAMERAS, RING_VIEW, TargetProtocol
from ghgs_lit.data.view import View
from ghgs_lit.data.workers import loader_of
from ghgs_lit.errors import InputError
from ghgs_lit.geometry.silhouettes import Silhouette

# MiB of decoded files kept, so that a body is read once for all photographs of its subject.
_CACHE_MB = 4
_PICTURED_SUBJECTS = 6
_PICTURED_VIEWS = 8
# A subject whose channels are all below this, of 255, counts as black.
_BLACK = 8
# Metres: taller subjects suggest another unit.
_TALLEST = 10.0


#: Subject, position and view.
Photograph = tuple[str, int, int]


@dataclass
class Seen:
    """Result of reading one photograph.

    Attributes:
        name: of the subject.
        position: number of the camera.
        view: its number at the position.
        iou: of body and mask, in [0, 1] (:func:`overlap`); None: there is no body to compare.
        agreement: share of the mask that the other masks allow, where there is no body to compare.
        body: whether the subject has a body.
        tall: the subject's largest side in world units, by body or masks.
        bright: mean of the photograph in its mask, 1 for white.
        digest: of the photograph's pixels.
        problem: line that says what is wrong.
        silhouette: coarse mask, where there is no body to compare.
        tile: picture for the contact sheet.
    """

    name: str
    position: int
    view: int
    iou: float | None = None
    agreement: float | None = None
    body: bool = False
    tall: float | None = None
    bright: float | None = None
    digest: str | None = None
    problem: str | None = None
    silhouette: Silhouette | None = None
    tile: Tile | None = None

    @property
    def photograph(self) -> Photograph:
        return self.name, self.position, self.view


@dataclass
class Phase:
    """Results of a phase."""

    reader: Reader
    seen: list[Seen]

    @property
    def bodies(self) -> int:
        """Number of subjects with a body."""
        return len({one.name for one in self.seen if one.body})

    def known(self, key: str) -> list[float]:
        """All known values of ``iou``, ``agreement``, ``tall`` or ``bright``."""
        return [value for one in self.seen if (value := getattr(one, key)) is not None]


@dataclass
class Report:
    """Result of a check.

    Attributes:
        phases: results by phase.
        problems: lines ``<place>: expected ...; found ...`` that prevent training.
        notes: lines that do not.
        lights: of renders that this package made, ``studio`` or ``none``.
    """

    phases: dict[str, Phase] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    lights: str | None = None


@dataclass(frozen=True)
class _Readings(Dataset):
    """Item ``i`` is the result of reading photograph ``i``."""

    photographs: PhotographCache
    listed: Sequence[Photograph]
    pictured: set[Photograph]
    min_iou: float

    def __len__(self) -> int:
        return len(self.listed)

    def __getitem__(self, index: int) -> Seen:
        photograph = self.listed[index]
        seen = Seen(*photograph)
        wanted = photograph in self.pictured
        try:
            view = self.photographs.view(*photograph)
            body = self.photographs.body(seen.name)
        except InputError as error:
            seen.problem = str(error)
            seen.tile = draw_tile(None, None) if wanted else None
            return seen
        seen.digest = hashlib.blake2b(view.image.tobytes(), digest_size=16).hexdigest()
        seen.tile = draw_tile(view, body) if wanted else None
        seen.bright = float(view.image[view.mask].mean() / 255)
        if body is not None:
            seen.body = True
            seen.tall = float(np.ptp(body, axis=0).max())
            seen.iou = overlap(body, view)
        if (problem := self._problem(view, seen.iou)) is not None:
            seen.problem = f"{self.photographs.reader.place(*photograph)}: {problem}"
        elif seen.iou is None:
            seen.silhouette = silhouette(view)
        return seen

    def _problem(self, view: View, iou: float | None) -> str | None:
        if iou is not None and iou < self.min_iou:
            return f"expected the body in its mask (IoU of {self.min_iou:.2f} or more); found IoU {iou:.2f}"
        if iou is None and (problem := implausible(view.mask)) is not None:
            return problem
        brightest = int(view.image[view.mask].max())
        if brightest < _BLACK:
            return f"expected a photograph in the mask; found black (no channel above {brightest} of 255)"
        return None


def inspect(data: PhotographsDataModule, min_iou: float = 0.5, min_agreement: float = 0.9) -> Report:
    """Read everything that training and evaluation would read, once, with the workers of ``data``.

    Args:
        data: the data module.
        min_iou: least IoU of a body's silhouette and a mask, in [0, 1]; clothed people reach 0.75
            to 0.95, wrong cameras 0 to 0.4.
        min_agreement: without a body, least share of a mask that the subject's other masks allow,
            in [0, 1]; right cameras reach 0.98 to 1.
    """
    report = Report()
    dataset = data.dataset
    # Static cameras allow only one protocol.
    targets = CAMERAS if dataset.static_cameras else data.targets
    for phase in PHASES:
        try:
            if phase == "train" and not dataset.has(phase):
                report.notes.append(
                    "train: expected subjects to train on; found none (evaluation needs none)"
                )
                continue
            reader = dataset.reader(phase, strict=False)
        except InputError as error:
            report.problems.append(str(error))
            continue
        photographs = PhotographCache(reader, None, min(dataset.cache_images_mb, _CACHE_MB))
        results = Phase(reader, _read(photographs, targets, min_iou, data, f"checking {phase}"))
        _compare_masks(results.seen, reader, min_agreement)
        report.phases[phase] = results
        report.problems += reader.problems + [seen.problem for seen in results.seen if seen.problem]
        report.notes += _notes(dataset.published.get(phase), phase, results)
        if (wanted := getattr(getattr(dataset, "render", None), "lights", None)) is not None:
            report.lights = Completeness(dataset.folder).lights
            report.notes += _notes_on_lights(wanted, report.lights, phase, results)
    report.problems += _in_both(str(dataset.root), report.phases)
    if not report.problems:
        report.problems += _cannot_sample(data, targets, "train" in report.phases)
    report.problems = list(dict.fromkeys(report.problems))
    return report


def _read(
    photographs: PhotographCache,
    targets: TargetProtocol,
    min_iou: float,
    data: PhotographsDataModule,
    label: str,
) -> list[Seen]:
    """Read all photographs of a phase that its protocol may ask for.

    Args:
        photographs: where they are read.
        targets: their views are read even if no file of theirs exists.
        min_iou: least IoU of a body's silhouette and a mask.
        data: the data module, for its workers.
        label: beside the bar.
    """
    reader = photographs.reader
    # Views that the protocol may ask for are read even if no file of theirs exists.
    needed = {RING_VIEW} | targets.view_numbers
    listed = []
    for name, positions in reader.subjects.items():
        for position in positions:
            views = sorted(needed | set(reader.views_at(name, position)))
            listed += [(name, position, view) for view in views]
    if not listed:
        return []
    items = _Readings(photographs, listed, _pictured(reader), min_iou)
    loader = loader_of(items, min(data.workers(len(items)), len(items)))
    return list(track(loader, label, total=len(items), console=Console(stderr=True)))


def _pictured(reader: Reader) -> set[Photograph]:
    """Photographs of the contact sheet: some positions of some subjects, evenly spaced."""

    def some(items: Sequence, count: int) -> list:
        return [items[i] for i in np.unique(np.linspace(0, len(items) - 1, count).round().astype(int))]

    pictured = set()
    for name in some(list(reader.subjects), _PICTURED_SUBJECTS):
        for position in some(reader.subjects[name], _PICTURED_VIEWS):
            pictured.add((name, position, RING_VIEW))
    return pictured


def _compare_masks(seen: Sequence[Seen], reader: Reader, least: float) -> None:
    """Find the agreement of masks without a body; at most one problem for each subject.

    Args:
        seen: photographs of a phase; ``agreement``, ``tall`` and ``problem`` are filled.
        reader: of the phase.
        least: share of a mask that the other masks of its subject must allow.
    """
    by_subject: dict[str, list[Seen]] = {}
    for one in seen:
        if one.silhouette is not None:
            by_subject.setdefault(one.name, []).append(one)
    for several in by_subject.values():
        if len(several) > 1:
            _compare_subject(several, reader, least)


def _compare_subject(seen: Sequence[Seen], reader: Reader, least: float) -> None:
    """:func:`_compare_masks` of one subject.

    Args:
        seen: its photographs, at least two.
        reader: of the phase.
        least: share of a mask that the others must allow.
    """
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
        one.agreement = share
        one.tall = tall if one.tall is None else one.tall
    worst = min(seen, key=lambda one: one.agreement)
    if worst.agreement < least:
        worst.problem = (
            f"{reader.place(*worst.photograph)}: expected a mask that the others of its subject "
            f"allow ({least:.0%} of it or more); found {worst.agreement:.0%} (wrong axes, units, "
            "direction or size of a camera?)"
        )


def _notes(published: int | None, phase: str, results: Phase) -> list[str]:
    reader = results.reader
    notes = []
    if published is not None and reader.people != published:
        notes.append(f"{phase}: expected {published} people as published; found {reader.people}")
    if results.bodies < len(reader.subjects):
        notes.append(
            f"{phase}: expected a body for each of {len(reader.subjects)} subjects; found "
            f"{results.bodies} (no Chamfer term; cameras are checked by their masks alone)"
        )
    if sizes := results.known("tall"):
        tall = np.median(sizes)
        if tall > _TALLEST:
            notes.append(f"{phase}: expected metres; found subjects {tall:.0f} units tall (millimetres?)")
    most = max(map(len, reader.subjects.values()), default=0)
    fewer = [name for name, positions in reader.subjects.items() if len(positions) < most]
    if fewer:
        notes.append(
            f"{phase}: expected {most} cameras of every subject; found fewer of {len(fewer)}, as {fewer[0]}"
        )
    return notes


def _notes_on_lights(wanted: str, stored: str | None, phase: str, results: Phase) -> list[str]:
    """A note where renders of this package have other lights than the configuration says.

    Args:
        wanted: ``data.render.lights`` of the configuration.
        stored: that of the renders; None: they were made elsewhere.
        phase: name of the phase.
        results: its results.
    """
    if stored in (None, wanted):
        return []
    bright = np.mean(results.known("bright") or [0.0])
    why = "lit again where textures have light of their own" if stored == "studio" else "not lit"
    return [
        f"{phase}: expected renders with data.render.lights={wanted}; found {stored} ({why}),"
        f" subjects of {bright:.3f} of full brightness (errors of darker ones count less in dB)"
    ]


def _in_both(root: str, phases: dict[str, Phase]) -> list[str]:
    """Problems: subjects, or photographs under different names, in both ``train`` and ``val``."""
    if set(phases) != set(PHASES):
        return []
    train = phases["train"]
    val = phases["val"]
    both = sorted(set(train.reader.subjects) & set(val.reader.subjects))
    lines = [f"{root}: expected each subject in train or in val; found {name!r} in both" for name in both]
    trained = {one.digest: one for one in train.seen if one.digest is not None}
    repeated: dict[tuple[str, str], str] = {}
    for one in val.seen:
        twin = trained.get(one.digest)
        if twin is not None and one.name not in both:
            places = val.reader.place(*one.photograph), train.reader.place(*twin.photograph)
            line = "{}: expected a photograph that train has not; found {}".format(*places)
            repeated.setdefault((one.name, twin.name), line)
    return lines + list(repeated.values())


def _cannot_sample(data: PhotographsDataModule, targets: TargetProtocol, training: bool) -> list[str]:
    try:
        if training:
            data.training_sampler(targets)
        data.evaluation_loader(targets=targets)
    except InputError as error:
        return [str(error)]
    return []
