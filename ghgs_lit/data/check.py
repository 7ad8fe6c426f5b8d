"""Check of a data set: read all of it once, and report what is there, missing and broken."""

import hashlib
import json
import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import rich
from rich.console import Console
from rich.progress import track
from rich.table import Table
from torch.utils.data import DataLoader, Dataset

from ghgs_lit.data.cross_checks import Phase, Photograph, Report, Seen, agreeing, shared
from ghgs_lit.data.datamodule import PhotographsDataModule
from ghgs_lit.data.overlap import Tile, draw_tile, overlap, save_sheet
from ghgs_lit.data.reader import PHASES, Photographs, Reader
from ghgs_lit.data.sampling import CAMERAS, RING_VIEW, TargetProtocol
from ghgs_lit.data.silhouettes import implausible, silhouette
from ghgs_lit.data.view import View
from ghgs_lit.errors import InputError

_LINE = re.compile(r"(?P<place>.*?): expected (?P<expected>.*); found (?P<found>.*)", re.DOTALL)
# Rows of a table on the terminal; check.json has all.
_SHOWN = 30
# MiB of decoded files kept, so that a body is read once for all photographs of its subject.
_CACHE_MB = 4
_PICTURED_SUBJECTS, _PICTURED_VIEWS = 6, 8
# A subject whose channels are all below this, of 255, counts as black.
_BLACK = 8
# Metres: taller subjects suggest another unit.
_TALLEST = 10.0


@dataclass(frozen=True)
class _Readings(Dataset):
    """Item ``i`` is the result of reading photograph ``i``."""

    photographs: Photographs
    listed: Sequence[Photograph]
    pictured: set[Photograph]
    min_iou: float

    def __len__(self) -> int:
        return len(self.listed)

    def __getitem__(self, index: int) -> Seen:
        photograph = self.listed[index]
        wanted = photograph in self.pictured
        try:
            view = self.photographs.view(*photograph)
            body = self.photographs.body(photograph[0])
        except InputError as error:
            return Seen(*photograph, problem=str(error), tile=draw_tile(None, None) if wanted else None)
        seen = Seen(
            *photograph,
            body=body is not None,
            tall=None if body is None else float(np.ptp(body, axis=0).max()),
            digest=hashlib.blake2b(view.image.tobytes(), digest_size=16).hexdigest(),
            tile=draw_tile(view, body) if wanted else None,
        )
        fit = None if body is None else overlap(body, view)
        if fit is not None:
            seen = replace(seen, iou=fit.iou, inside=fit.inside)
        problem = self._problem(view, seen)
        if problem is not None:
            return replace(seen, problem=f"{self.photographs.reader.place(*photograph)}: {problem}")
        return seen if fit is not None else replace(seen, silhouette=silhouette(view))

    def _problem(self, view: View, seen: Seen) -> str | None:
        if seen.iou is not None and seen.iou < self.min_iou:
            return (
                f"expected the body in its mask (IoU of {self.min_iou:.2f} or more); found IoU {seen.iou:.2f}"
            )
        if seen.iou is None and (problem := implausible(view.mask)) is not None:
            return problem
        brightest = int(view.image[view.mask].max())
        if brightest < _BLACK:
            return f"expected a photograph in the mask; found black (no channel above {brightest} of 255)"
        return None


@dataclass(frozen=True)
class _Inspections(Dataset):
    """Item ``i`` is the problem of inspection ``i``, or None."""

    inspections: Sequence[Callable[[], None]]

    def __len__(self) -> int:
        return len(self.inspections)

    def __getitem__(self, index: int) -> str | None:
        try:
            self.inspections[index]()
        except InputError as error:
            return str(error)
        return None


def _read_all(items: Dataset, workers: int, label: str) -> list:
    loader = DataLoader(items, batch_size=None, num_workers=min(workers, len(items)))
    return list(track(loader, label, total=len(items), console=Console(stderr=True)))


def inspect(data: PhotographsDataModule, min_iou: float = 0.5, min_agreement: float = 0.9) -> Report:
    """Read everything that training and evaluation would read, once, with the workers of ``data``.
    ``min_iou``: least IoU of a body's silhouette and a mask; clothed people reach 0.75 to 0.95, wrong cameras
    0 to 0.4. ``min_agreement``, without a body: least share of a mask that the subject's other masks allow;
    right cameras reach 0.98 to 1."""
    report = Report()
    dataset, workers = data.dataset, data.dataset.workers
    # Static cameras allow only one protocol.
    targets = CAMERAS if dataset.static_cameras else data.targets
    inspections = dataset.inspections()
    report.inspections = len(inspections)
    if inspections:
        found = _read_all(_Inspections(inspections), workers, "checking files")
        report.problems += [line for line in found if line is not None]
    if dataset.root is None and inspections:
        return report
    readers: dict[str, Reader] = {}
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
        report.problems += reader.problems
        cache_mb = min(data.dataset.cache_images_mb, _CACHE_MB)
        found = _inspect_phase(phase, Photographs(reader, None, cache_mb), targets, min_iou, workers)
        found.seen = agreeing(found.seen, reader, min_agreement)
        report.phases[phase] = found
        readers[phase] = reader
        report.problems += [seen.problem for seen in found.seen if seen.problem]
        report.notes += _notes(dataset.published.get(phase), phase, reader, found)
    report.problems += shared(str(dataset.root), report.phases, readers)
    if not report.problems:
        report.problems += _cannot_sample(data, targets, "train" in report.phases)
    report.problems = list(dict.fromkeys(report.problems))
    return report


def _inspect_phase(
    phase: str, photographs: Photographs, targets: TargetProtocol, min_iou: float, workers: int
) -> Phase:
    reader = photographs.reader
    # Views that the protocol may ask for are read even if no file of theirs exists.
    needed = {RING_VIEW} | targets.view_numbers
    places = [(name, position) for name, positions in reader.subjects.items() for position in positions]
    listed = [(*place, view) for place in places for view in sorted(needed | set(reader.views_at(*place)))]
    items = _Readings(photographs, listed, _pictured(reader), min_iou)
    seen = _read_all(items, workers, f"checking {phase}") if listed else []
    bodies = len({s.name for s in seen if s.body})
    return Phase(reader.people, len(reader.subjects), bodies, seen)


def _pictured(reader: Reader) -> set[Photograph]:

    def some(items: Sequence, count: int) -> list:
        return [items[i] for i in np.unique(np.linspace(0, len(items) - 1, count).round().astype(int))]

    names = some(list(reader.subjects), _PICTURED_SUBJECTS) if reader.subjects else []
    chosen = {name: some(reader.subjects[name], _PICTURED_VIEWS) for name in names}
    return {(name, position, RING_VIEW) for name, positions in chosen.items() for position in positions}


def _notes(published: int | None, phase: str, reader: Reader, read: Phase) -> list[str]:
    notes = []
    if published is not None and read.people != published:
        notes.append(f"{phase}: expected {published} people as published; found {read.people}")
    if read.bodies < read.subjects:
        notes.append(
            f"{phase}: expected a body for each of {read.subjects} subjects; found {read.bodies} "
            "(no Chamfer term; cameras are checked by their masks alone)"
        )
    if read.tall is not None and read.tall > _TALLEST:
        notes.append(f"{phase}: expected metres; found subjects {read.tall:.0f} units tall (millimetres?)")
    most = max(map(len, reader.subjects.values()), default=0)
    fewer = [name for name, positions in reader.subjects.items() if len(positions) < most]
    if fewer:
        notes.append(
            f"{phase}: expected {most} cameras of every subject; found fewer of {len(fewer)}, as {fewer[0]}"
        )
    return notes


def _cannot_sample(data: PhotographsDataModule, targets: TargetProtocol, training: bool) -> list[str]:
    try:
        if training:
            data.training_sampler(targets)
        data.evaluation_loader(targets=targets)
    except InputError as error:
        return [str(error)]
    return []


def split_line(line: str) -> tuple[str, str, str]:
    """Place, expected and found of an error message."""
    match = _LINE.fullmatch(line)
    return (match["place"], match["expected"], match["found"]) if match else ("", "", line)


def show(report: Report) -> None:
    """Print the report as tables."""
    columns = ("people", "subjects", "photos", "broken", "bodies", "mean IoU", "min IoU", "inside", "agree")
    table = Table("phase", *columns)
    for name, phase in report.phases.items():
        iou, inside = phase.overlaps("iou"), phase.overlaps("inside")
        numbers = [f"{np.mean(iou):.3f}", f"{min(iou):.3f}", f"{min(inside):.3f}"] if iou else ["-"] * 3
        agreement = phase.overlaps("agreement")
        numbers.append(f"{min(agreement):.3f}" if agreement else "-")
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


def write(report: Report, folder: Path) -> Path:
    """Write ``check.json`` and, if there are photographs, ``contact.png``; return ``folder``."""
    keys = ("place", "expected", "found")
    content = {
        "problems": [dict(zip(keys, split_line(line), strict=True)) for line in report.problems],
        "notes": report.notes,
        "inspections": report.inspections,
        "phases": {name: asdict(phase) for name, phase in report.phases.items()},
    }
    for phase in content["phases"].values():
        for seen in phase["seen"]:
            del seen["tile"], seen["silhouette"]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "check.json").write_text(json.dumps(content, indent=1))
    rows: dict[str, list[Tile]] = {}
    for name, phase in report.phases.items():
        for seen in phase.seen:
            if seen.tile is not None:
                label = "" if seen.iou is None else f" {seen.iou:.2f}"
                rows.setdefault(f"{name} {seen.name}", []).append((f"{seen.position:03d}{label}", seen.tile))
    if rows:
        save_sheet(rows, folder / "contact.png")
    return folder
