"""Reads all of a data set once and says what is there, what is missing and what is broken."""

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import rich
from rich.console import Console
from rich.progress import track
from rich.table import Table
from torch.utils.data import DataLoader, Dataset

from ghgs_lit.data.contact import Tile, draw_tile, save_sheet
from ghgs_lit.data.datamodule import PHASES, PhotographsDataModule
from ghgs_lit.data.overlap import overlap
from ghgs_lit.data.reader import Reader
from ghgs_lit.data.sampling import CAMERAS
from ghgs_lit.errors import InputError

_LINE = re.compile(r"(?P<place>.*?): expected (?P<expected>.*); found (?P<found>.*)", re.DOTALL)
# Rows of a table on the terminal; check.json has all of them.
_SHOWN = 30
_PICTURED_SUBJECTS, _PICTURED_VIEWS = 6, 8

Photograph = tuple[str, int, int]


@dataclass(frozen=True)
class Seen:
    """What reading one photograph gave."""

    name: str
    pid: int
    vid: int
    iou: float | None = None
    inside: float | None = None
    problem: str | None = None
    tile: Tile | None = field(default=None, repr=False)


@dataclass
class Phase:
    """What a phase has."""

    people: int
    subjects: int
    bodies: int
    seen: list[Seen]

    def overlaps(self, key: str) -> list[float]:
        return [value for seen in self.seen if (value := getattr(seen, key)) is not None]


@dataclass
class Report:
    """All of it: ``problems`` keep training from starting (each ``place: expected ...; found ...``),
    ``notes`` do not."""

    phases: dict[str, Phase] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    inspections: int = 0


class _Photographs(Dataset):
    """Item ``i`` is what reading photograph ``i`` gave."""

    def __init__(
        self, reader: Reader, photographs: Sequence[Photograph], pictured: set, least: float
    ) -> None:
        self.reader, self.photographs, self.pictured, self.least = reader, photographs, pictured, least

    def __len__(self) -> int:
        return len(self.photographs)

    def __getitem__(self, index: int) -> Seen:
        name, pid, vid = self.photographs[index]
        wanted = self.photographs[index] in self.pictured
        try:
            view = self.reader.view(name, pid, vid)
            body = self.reader.body(name)
        except InputError as error:
            return Seen(name, pid, vid, problem=str(error), tile=draw_tile(None, None) if wanted else None)
        tile = draw_tile(view, body) if wanted else None
        fit = None if body is None else overlap(body, view)
        if fit is None:
            return Seen(name, pid, vid, tile=tile)
        problem = None
        if fit.iou < self.least:
            place = self.reader.place(name, pid, vid)
            expected = f"the body in its mask (IoU of {self.least:.2f} or more)"
            problem = f"{place}: expected {expected}; found IoU {fit.iou:.2f}"
        return Seen(name, pid, vid, fit.iou, fit.inside, problem, tile)


class _Inspections(Dataset):
    def __init__(self, inspections: Sequence[Callable[[], None]]) -> None:
        self.inspections = inspections

    def __len__(self) -> int:
        return len(self.inspections)

    def __getitem__(self, index: int) -> str | None:
        try:
            self.inspections[index]()
        except InputError as error:
            return str(error)
        return None


def _read_all(items: Dataset, workers: int, label: str) -> list:
    loader = DataLoader(items, batch_size=None, collate_fn=_as_is, num_workers=min(workers, len(items)))
    return list(track(loader, label, total=len(items), console=Console(stderr=True)))


def _as_is(item):
    return item


def inspect(data: PhotographsDataModule, least_iou: float = 0.5) -> Report:
    """Read everything that ``data`` would ever read, once, with its workers.

    ``least_iou``: of the body's silhouette and a mask; below it a camera counts as wrong. Clothed people
    reach 0.75 to 0.95, a camera that is off 0 to 0.4.
    """
    report = Report()
    if data.still:  # whatever targets the command line has: they are a matter of training
        data.targets = CAMERAS
    data.cache_images_mb = min(data.cache_images_mb, 4)  # a body is read once for all its photographs
    inspections = data.inspections()
    report.inspections = len(inspections)
    if inspections:
        found = _read_all(_Inspections(inspections), data.workers, "checking files")
        report.problems += [line for line in found if line is not None]
    if data.root is None and inspections:
        return report
    for phase in PHASES:
        try:
            reader = data.reader(phase, None, strict=False)
        except InputError as error:
            report.problems.append(str(error))
            continue
        report.problems += reader.problems
        report.phases[phase] = _inspect_phase(data, phase, reader, least_iou)
        report.problems += [seen.problem for seen in report.phases[phase].seen if seen.problem]
        report.notes += _notes(data, phase, reader, report.phases[phase])
    if not report.problems:
        report.problems += _cannot_draw(data)
    report.problems = list(dict.fromkeys(report.problems))
    return report


def _inspect_phase(data: PhotographsDataModule, phase: str, reader: Reader, least_iou: float) -> Phase:
    # Views that the protocol may ask for are read even where no file of theirs is there to be listed.
    needed = {0} | data.targets.vids
    photographs = [
        (name, pid, vid)
        for name, pids in reader.subjects.items()
        for pid in pids
        for vid in sorted(needed | set(reader.vids(name, pid)))
    ]
    items = _Photographs(reader, photographs, _pictured(reader), least_iou)
    seen = _read_all(items, data.workers, f"checking {phase}") if photographs else []
    unread = {s.name for s in seen if s.problem is not None and s.iou is None}
    bodies = sum(name not in unread and reader.body(name) is not None for name in reader.subjects)
    return Phase(data.people(reader), len(reader.subjects), bodies, seen)


def _pictured(reader: Reader) -> set[Photograph]:
    """The photographs of the contact sheet."""

    def some(items: Sequence, count: int) -> list:
        return [items[i] for i in np.unique(np.linspace(0, len(items) - 1, count).round().astype(int))]

    names = some(list(reader.subjects), _PICTURED_SUBJECTS) if reader.subjects else []
    return {(name, pid, 0) for name in names for pid in some(reader.subjects[name], _PICTURED_VIEWS)}


def _notes(data: PhotographsDataModule, phase: str, reader: Reader, read: Phase) -> list[str]:
    notes = []
    published = data.published.get(phase)
    if published is not None and read.people != published:
        notes.append(f"{phase}: expected {published} people as published; found {read.people}")
    if read.bodies < read.subjects:
        notes.append(
            f"{phase}: expected a body for each of {read.subjects} subjects; found {read.bodies} "
            "(no Chamfer term, and cameras without a body are not checked)"
        )
    most = max((len(pids) for pids in reader.subjects.values()), default=0)
    fewer = [name for name, pids in reader.subjects.items() if len(pids) < most]
    if fewer:
        notes.append(
            f"{phase}: expected {most} cameras of every subject; found fewer of {len(fewer)}, as {fewer[0]}"
        )
    return notes


def _cannot_draw(data: PhotographsDataModule) -> list[str]:
    """Why the protocols cannot draw their samples from what is there, if they cannot."""
    for attempt in (data.training_draws, data.evaluation_loader):
        try:
            attempt()
        except InputError as error:
            return [str(error)]
    return []


def split_line(line: str) -> tuple[str, str, str]:
    """Place, expected, found of an error's line."""
    match = _LINE.fullmatch(line)
    return (match["place"], match["expected"], match["found"]) if match else ("", "", line)


def show(report: Report) -> None:
    """The tables on the terminal."""
    columns = ("people", "subjects", "photos", "broken", "bodies", "mean IoU", "least IoU", "inside")
    table = Table("phase", *columns)
    for name, phase in report.phases.items():
        iou, inside = phase.overlaps("iou"), phase.overlaps("inside")
        numbers = [f"{np.mean(iou):.3f}", f"{min(iou):.3f}", f"{min(inside):.3f}"] if iou else ["-"] * 3
        broken = sum(seen.problem is not None for seen in phase.seen)
        counts = (phase.people, phase.subjects, len(phase.seen), broken, phase.bodies)
        table.add_row(name, *map(str, counts), *numbers)
    if report.phases:
        rich.print(table)
    if report.inspections:
        rich.print(f"{report.inspections} scans or other sources were read.")
    for title, lines in (("problem", report.problems), ("note", report.notes)):
        if lines:
            table = Table(title, "expected", "found")
            for line in lines[:_SHOWN]:
                table.add_row(*split_line(line))
            if len(lines) > _SHOWN:
                table.add_row(f"... and {len(lines) - _SHOWN} more", "", "")
            rich.print(table)


def _plain(phase: Phase) -> dict:
    """Without pictures."""
    content = asdict(phase)
    for seen in content["seen"]:
        del seen["tile"]
    return content


def write(report: Report, folder: Path) -> Path:
    """Write ``check.json`` and, where there are photographs, ``contact.png``; gives the folder."""
    keys = ("place", "expected", "found")
    content = {
        "problems": [dict(zip(keys, split_line(line), strict=True)) for line in report.problems],
        "notes": report.notes,
        "inspections": report.inspections,
        "phases": {name: _plain(phase) for name, phase in report.phases.items()},
    }
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "check.json").write_text(json.dumps(content, indent=1))
    rows: dict[str, list[Tile]] = {}
    for name, phase in report.phases.items():
        for seen in phase.seen:
            if seen.tile is not None:
                label = "" if seen.iou is None else f" {seen.iou:.2f}"
                rows.setdefault(f"{name} {seen.name}", []).append((f"{seen.pid:03d}{label}", seen.tile))
    if rows:
        save_sheet(rows, folder / "contact.png")
    return folder
