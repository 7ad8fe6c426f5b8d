"""Check of a data set: read it once completely, and report what exists, is missing or is broken."""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track
from torch.utils.data import Dataset

from ghgs_lit.data.batches import make_loader
from ghgs_lit.data.datamodule import PhotographsDataModule
from ghgs_lit.data.mask_checks import (
    SEARCH,
    find_equal_poses,
    find_mask_problem,
    make_silhouette,
    measure_height,
    measure_overlap,
)
from ghgs_lit.data.reader import PHASES, Reader
from ghgs_lit.data.sampling import CAMERAS, RING_VIEW, Photo
from ghgs_lit.errors import InputError
from ghgs_lit.geometry.silhouettes import Silhouette

# Minimum IoU of a body's silhouette and a mask; clothed people reach 0.75 to 0.95, wrong cameras 0 to 0.4.
_LEAST_IOU = 0.5
# Without a body, minimum share of a mask that the subject's other masks allow; correct cameras reach 0.98.
_LEAST_AGREEMENT = 0.9
# A subject with all channels below this value, of 255, counts as black.
_BLACK = 8
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
        name: name of the subject.
        photos: number of its images, missing ones included.
        problems: lines about what is wrong.
        images: digest of the pixels and place of each image.
        has_body: whether the subject has a body.
        tall: largest extent in world units, of the body or else of the masks; 0: unknown.
        iou: IoU of the body and each mask, in [0, 1]; empty without a body to compare with.
        agreement: share of each mask inside the visual hull of the others; empty with such a body.
    """

    name: str
    photos: int
    problems: list[str] = field(default_factory=list)
    images: list[tuple[str, str]] = field(default_factory=list)
    has_body: bool = False
    tall: float = 0.0
    iou: list[float] = field(default_factory=list)
    agreement: list[float] = field(default_factory=list)

    def attempt(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call a function, and collect its InputError as a problem; returns its result, or None."""
        try:
            return function(*arguments)
        except InputError as error:
            self.problems.append(str(error))


@dataclass(frozen=True)
class _Subjects(Dataset):
    """Dataset whose item ``i`` is the report about subject ``i``."""

    reader: Reader
    listed: Sequence[tuple[str, Sequence[Photo]]]

    def __len__(self) -> int:
        return len(self.listed)

    def __getitem__(self, index: int) -> SubjectReport:
        name, photos = self.listed[index]
        report = SubjectReport(name, len(photos))
        body = report.attempt(self.reader.read_checked_body, name)
        if body is not None:
            report.has_body = True
            report.tall = float(np.ptp(body, axis=0).max())
        silhouettes = {}
        for photo in photos:
            silhouette = report.attempt(self._examine, report, photo, body)
            if silhouette is not None:
                silhouettes[photo] = silhouette
        if len(silhouettes) > 1:
            report.attempt(self._compare, report, silhouettes)
        return report

    def _examine(self, report: SubjectReport, photo: Photo, body: np.ndarray | None) -> Silhouette | None:
        """Read an image and compare its mask with the body; returns its silhouette if that is impossible.
        Raises InputError if the image is missing, broken or implausible."""
        view = self.reader.read_checked_view(report.name, *photo, depth=True)
        place = self.reader.place(report.name, *photo)
        report.images.append((hashlib.blake2b(view.image.tobytes(), digest_size=16).hexdigest(), place))
        iou = None if body is None else measure_overlap(body, view)
        if iou is None:
            problem = find_mask_problem(view.mask)
            if problem is not None:
                raise InputError(f"{place}: {problem}")
        else:
            report.iou.append(iou)
            expected = f"the body in its mask (IoU of {_LEAST_IOU:.2f} or more)"
            if iou < _LEAST_IOU:
                raise InputError(f"{place}: expected {expected}; found IoU {iou:.2f}")
        brightest = int(view.image[view.mask].max())
        if brightest < _BLACK:
            found = f"black (no channel above {brightest} of 255)"
            raise InputError(f"{place}: expected a photograph in the mask; found {found}")
        return make_silhouette(view) if iou is None else None

    def _compare(self, report: SubjectReport, silhouettes: Mapping[Photo, Silhouette]) -> None:
        """Compare the masks of a subject; raises InputError about the worst one."""
        ring = {photo[0]: one.extrinsics for photo, one in silhouettes.items() if photo[1] == RING_VIEW}
        pair = find_equal_poses(ring)
        if pair is not None:
            place = self.reader.place(report.name, pair[1], RING_VIEW)
            raise InputError(f"{place}: expected a camera of its own; found that of position {pair[0]}")
        report.tall = report.tall or measure_height(list(silhouettes.values()))
        report.agreement = SEARCH.shares(list(silhouettes.values()))
        least = min(report.agreement)
        if least < _LEAST_AGREEMENT:
            worst = list(silhouettes)[report.agreement.index(least)]
            raise InputError(
                f"{self.reader.place(report.name, *worst)}: expected a mask that the others of its subject "
                f"allow ({_LEAST_AGREEMENT:.0%} of it or more); found {least:.0%} (wrong axes, units, "
                "direction or size of a camera?)"
            )


def inspect(data: PhotographsDataModule) -> Report:
    """Read everything that training and evaluation would read, once, with the workers of ``data``."""
    report = Report()
    dataset = data.dataset
    # Static cameras allow only one protocol.
    targets = CAMERAS if dataset.static_cameras else data.targets
    needed = {RING_VIEW} | targets.view_numbers
    reports: dict[str, list[SubjectReport]] = {}
    for phase in PHASES:
        try:
            if phase == "train" and not dataset.has(phase):
                expected = "subjects to train on; found none (evaluation needs none)"
                report.notes.append(f"train: expected {expected}")
                continue
            reader = dataset.reader(phase, strict=False)
        except InputError as error:
            report.problems.append(str(error))
            continue
        listed = []
        for name, positions in reader.subjects.items():
            photos = []
            for position in positions:
                photos += [(position, view) for view in sorted(needed.union(reader.views_at(name, position)))]
            listed.append((name, photos))
        reports[phase] = []
        if listed:
            items = _Subjects(reader, listed)
            loader = make_loader(items, min(data.workers(len(items)), len(items)))
            console = Console(stderr=True)
            reports[phase] += track(loader, f"checking {phase}", total=len(items), console=console)
        report.phases[phase] = _summarize(reports[phase])
        report.problems += reader.problems
        for one in reports[phase]:
            report.problems += one.problems
        report.notes += _describe_oddities(phase, reports[phase])
    if len(reports) == len(PHASES):
        report.problems += _find_leaks(str(dataset.root), *reports.values())
    try:
        if not report.problems and "train" in reports:
            data.training_sampler(targets)
        if not report.problems:
            data.evaluation_loader(targets=targets)
    except InputError as error:
        report.problems.append(str(error))
    report.problems = list(dict.fromkeys(report.problems))
    return report


def _summarize(reports: Sequence[SubjectReport]) -> dict[str, float]:
    figures = {
        "subjects": len(reports),
        "photos": sum(one.photos for one in reports),
        "broken": sum(len(one.problems) for one in reports),
        "bodies": sum(one.has_body for one in reports),
    }
    for key in ("iou", "agreement"):
        values = [min(getattr(one, key)) for one in reports if getattr(one, key)]
        if values:
            figures[f"least {key}"] = round(min(values), 3)
    return figures


def _describe_oddities(phase: str, reports: Sequence[SubjectReport]) -> list[str]:
    notes = []
    bodies = sum(one.has_body for one in reports)
    if bodies < len(reports):
        notes.append(
            f"{phase}: expected a body for each of {len(reports)} subjects; found "
            f"{bodies} (no Chamfer term; cameras are checked by their masks alone)"
        )
    tall = np.median([one.tall for one in reports if one.tall] or [0.0])
    if tall > _TALLEST:
        notes.append(f"{phase}: expected metres; found subjects {tall:.0f} units tall (millimetres?)")
    return notes


def _find_leaks(root: str, train: Sequence[SubjectReport], val: Sequence[SubjectReport]) -> list[str]:
    """Find subjects, or equal images under different names, that are in both ``train`` and ``val``."""
    both = sorted({one.name for one in train} & {one.name for one in val})
    lines = [f"{root}: expected each subject in train or in val; found {name!r} in both" for name in both]
    trained = {}
    for one in train:
        trained |= one.images
    for one in val:
        twin = next(((place, trained[digest]) for digest, place in one.images if digest in trained), None)
        if twin is not None and one.name not in both:
            lines.append(f"{twin[0]}: expected a photograph that train has not; found {twin[1]}")
    return lines
