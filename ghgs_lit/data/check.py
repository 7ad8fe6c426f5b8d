"""Check of a data set: read it once completely, and report what exists, is missing or is broken."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console
from rich.progress import track
from torch.utils.data import Dataset

from ghgs_lit.data.batches import make_loader
from ghgs_lit.data.decoding import check_mask
from ghgs_lit.data.reader import PHASES, Reader
from ghgs_lit.data.sampling import CAMERAS, RING_VIEW
from ghgs_lit.data.view import View, area_mask
from ghgs_lit.errors import InputError
from ghgs_lit.geometry.silhouettes import HullSearch, Silhouette, median_height

if TYPE_CHECKING:  # importing Lightning takes seconds
    from ghgs_lit.data.datamodule import PhotographsDataModule

# Minimum IoU of the boxes of a body and a mask; wrong cameras reach 0 to 0.3.
_LEAST_IOU = 0.5
# Without a body, minimum share of a mask that the subject's other masks allow; correct cameras reach 0.98.
_LEAST_AGREEMENT = 0.9
# Comparison of masks; a quarter of them may be wrong.
_SEARCH = HullSearch(rays=200, depths=64, reach=1.0, others=12, wrong=0.25)
# Longer side of a coarse mask in cells.
_CELLS = 64
# Height in metres above which another unit is likely.
_TALLEST = 10.0
# Maximum number of problems shown on the terminal; check.json contains all.
_SHOWN = 30


@dataclass
class Report:
    """Result of a check.

    Attributes:
        phases: by phase, counts of what was read, and minimum IoU and agreement.
        problems: lines ``<place>: expected ...; found ...`` about what prevents training.
        notes: lines about what does not.
    """

    phases: dict[str, dict[str, float]] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def show(self) -> None:
        """Print a line for each phase, problem and note."""
        for name, figures in self.phases.items():
            print(f"{name}: " + ", ".join(f"{title} {value}" for title, value in figures.items()))
        for title, lines in (("problem", self.problems), ("note", self.notes)):
            for line in lines[:_SHOWN]:
                print(f"{title}: {line}")
            if len(lines) > _SHOWN:
                print(f"... and {len(lines) - _SHOWN} more")

    def write(self, path: Path) -> None:
        """Write the report as JSON."""
        path.write_text(json.dumps(vars(self), indent=1))


@dataclass
class SubjectReport:
    """Result of reading one subject.

    Attributes:
        photos: number of its images, missing ones included.
        problems: lines about what is wrong.
        has_body: whether the subject has a body.
        height: median height of the masks in world units; 0: unknown.
        iou: IoU of the boxes of the body and each mask; empty without a body.
        agreement: share of each mask inside the visual hull of the others; empty with a body.
    """

    photos: int = 0
    problems: list[str] = field(default_factory=list)
    has_body: bool = False
    height: float = 0.0
    iou: list[float] = field(default_factory=list)
    agreement: list[float] = field(default_factory=list)


@dataclass(frozen=True)
class _Subjects(Dataset):
    """Dataset whose item ``i`` is the report about subject ``i``; ``views``: required at each position."""

    reader: Reader
    names: Sequence[str]
    views: set[int]

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> SubjectReport:
        name = self.names[index]
        report = SubjectReport()
        body = None
        try:
            body = self.reader.read_checked_body(name)
        except InputError as error:
            report.problems.append(str(error))
        report.has_body = body is not None
        silhouettes = {}
        for position in self.reader.subjects[name]:
            for number in sorted(self.views.union(self.reader.views_at(name, position))):
                report.photos += 1
                place = self.reader.place(name, position, number)
                try:
                    view = self.reader.read_checked_view(name, position, number, depth=True)
                    check_mask(place, view.mask)
                    if body is not None:
                        report.iou.append(measure_overlap(body, view))
                        if report.iou[-1] < _LEAST_IOU:
                            expected = f"the body in its mask (IoU of their boxes {_LEAST_IOU:.2f} or more)"
                            raise InputError(f"{place}: expected {expected}; found {report.iou[-1]:.2f}")
                    silhouettes[place] = make_silhouette(view)
                except InputError as error:
                    report.problems.append(str(error))
        if len(silhouettes) > 1:
            _compare(report, silhouettes)
        return report


def _compare(report: SubjectReport, silhouettes: dict[str, Silhouette]) -> None:
    """Measure the height of a subject, and compare its masks if there is no body."""
    shapes = list(silhouettes.values())
    report.height = median_height(shapes)
    if report.has_body:
        return
    report.agreement = _SEARCH.shares(shapes)
    least = min(report.agreement)
    if least < _LEAST_AGREEMENT:
        worst = list(silhouettes)[report.agreement.index(least)]
        report.problems.append(
            f"{worst}: expected a mask that the others of its subject allow ({_LEAST_AGREEMENT:.0%} of it or "
            f"more); found {least:.0%} (wrong axes, units, direction or size of a camera?)"
        )


def inspect(data: "PhotographsDataModule") -> Report:
    """Read everything that training and evaluation would read, once, with the workers of ``data``."""
    report = Report()
    dataset = data.dataset
    # Static cameras allow only one protocol.
    targets = CAMERAS if dataset.static_cameras else data.targets
    names: dict[str, set[str]] = {}
    for phase in PHASES:
        if phase == "train" and not dataset.has(phase):
            expected = "subjects to train on; found none (evaluation needs none)"
            report.notes.append(f"train: expected {expected}")
            continue
        try:
            reader = dataset.reader(phase)
        except InputError as error:
            report.problems.append(str(error))
            continue
        names[phase] = set(reader.subjects)
        items = _Subjects(reader, list(reader.subjects), {RING_VIEW} | targets.view_numbers)
        loader = make_loader(items, min(data.workers(len(items)), len(items)))
        console = Console(stderr=True)
        subjects = list(track(loader, f"checking {phase}", total=len(items), console=console))
        report.phases[phase] = _summarize(subjects)
        for one in subjects:
            report.problems += one.problems
        report.notes += _describe_oddities(phase, subjects)
    for name in sorted(names.get("train", set()) & names.get("val", set())):
        line = f"{dataset.root}: expected each subject in train or in val; found {name!r} in both"
        report.problems.append(line)
    try:
        if not report.problems and "train" in names:
            data.training_sampler(targets)
        if not report.problems:
            data.evaluation_loader(targets=targets)
    except InputError as error:
        report.problems.append(str(error))
    report.problems = list(dict.fromkeys(report.problems))
    return report


def _summarize(subjects: Sequence[SubjectReport]) -> dict[str, float]:
    figures = {
        "subjects": len(subjects),
        "photos": sum(one.photos for one in subjects),
        "broken": sum(len(one.problems) for one in subjects),
        "bodies": sum(one.has_body for one in subjects),
    }
    for key in ("iou", "agreement"):
        values = [min(getattr(one, key)) for one in subjects if getattr(one, key)]
        if values:
            figures[f"least {key}"] = round(min(values), 3)
    return figures


def _describe_oddities(phase: str, subjects: Sequence[SubjectReport]) -> list[str]:
    notes = []
    bodies = sum(one.has_body for one in subjects)
    if bodies < len(subjects):
        notes.append(
            f"{phase}: expected a body for each of {len(subjects)} subjects; found "
            f"{bodies} (no Chamfer term; cameras are checked by their masks alone)"
        )
    height = np.median([one.height for one in subjects])
    if height > _TALLEST:
        notes.append(f"{phase}: expected metres; found subjects {height:.0f} units tall (millimetres?)")
    return notes


def make_silhouette(view: View) -> Silhouette:
    """Make a silhouette from the mask and camera of a view, at most 64 cells high and wide."""
    height, width = view.mask.shape
    scale = min(_CELLS / max(height, width), 1)
    size = max(round(height * scale), 1), max(round(width * scale), 1)
    intrinsics = view.intrinsics.astype(np.float64)
    intrinsics[:2] *= np.array([[size[1] / width], [size[0] / height]])
    return Silhouette(area_mask(view.mask, *size), intrinsics, view.extrinsics.astype(np.float64))


def measure_overlap(vertices: np.ndarray, view: View) -> float:
    """IoU of the boxes of a body and of a mask in an image; parts outside of the image are ignored.

    Args:
        vertices: [n, 3] in the world, metres.
        view: the view whose mask and camera are compared.
    """
    height, width = view.mask.shape
    points = vertices @ view.extrinsics[:3, :3].T + view.extrinsics[:3, 3]
    points = points[points[:, 2] > 1e-6] @ view.intrinsics.T
    pixels = points[:, :2] / points[:, 2:]
    pixels = pixels[((pixels >= 0) & (pixels < (width, height))).all(-1)]
    if not len(pixels):
        return 0.0
    subject = np.argwhere(view.mask)[:, ::-1] + 0.5
    low = np.stack((pixels.min(0), subject.min(0) - 0.5))
    high = np.stack((pixels.max(0), subject.max(0) + 0.5))
    common = np.clip(high.min(0) - low.max(0), 0, None).prod()
    return float(common / ((high - low).prod(1).sum() - common))
