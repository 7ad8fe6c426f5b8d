"""Check of a data set: read it once completely, and report what exists, is missing or is broken."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

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
from ghgs_lit.data.reader import PHASES, Photographs, Reader
from ghgs_lit.data.sampling import CAMERAS, RING_VIEW, TargetProtocol
from ghgs_lit.errors import InputError
from ghgs_lit.geometry.silhouettes import Silhouette

# MiB of decoded files kept in memory, so that a body is read once for all images of its subject.
_CACHE_MB = 4
# A subject with all channels below this value, of 255, counts as black.
_BLACK = 8
# Height in metres above which another unit is likely.
_TALLEST = 10.0
# Maximum number of problems shown on the terminal; check.json contains all.
_SHOWN = 30


@dataclass
class Reading:
    """Result of reading one image.

    Attributes:
        name: name of the subject.
        position: index of the camera.
        view: number of the view at this position.
        place: name of the image in messages.
        problem: message about what is wrong; None: nothing.
        has_body: whether the subject has a body.
        iou: IoU of body and mask, in [0, 1] (:func:`measure_overlap`); None: no body to compare with.
        agreement: share of the mask inside the visual hull of the subject's other masks; None if there is a
            body to compare with.
        tall: the subject's largest extent in world units, by its body or masks.
        digest: digest of the image's pixels.
        silhouette: coarse mask; None if there is a body to compare with.
    """

    name: str
    position: int
    view: int
    place: str = ""
    problem: str | None = None
    has_body: bool = False
    iou: float | None = None
    agreement: float | None = None
    tall: float | None = None
    digest: str | None = None
    silhouette: Silhouette | None = None


@dataclass
class Report:
    """Result of a check.

    Attributes:
        phases: by phase, counts of what was read, and mean and minimum IoU and agreement.
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


@dataclass(frozen=True)
class _Readings(Dataset):
    """Dataset whose item ``i`` is the result of reading image ``i``."""

    photographs: Photographs
    listed: Sequence[tuple[str, int, int]]
    min_iou: float

    def __len__(self) -> int:
        return len(self.listed)

    def __getitem__(self, index: int) -> Reading:
        reading = Reading(*self.listed[index])
        try:
            self._examine(reading)
        except InputError as error:
            reading.problem = str(error)
        return reading

    def _examine(self, reading: Reading) -> None:
        """Read and measure an image; raises InputError if it is missing, broken or implausible."""
        photograph = reading.name, reading.position, reading.view
        view = self.photographs.view(*photograph)
        body = self.photographs.body(reading.name)
        place = reading.place = self.photographs.reader.place(*photograph)
        reading.digest = hashlib.blake2b(view.image.tobytes(), digest_size=16).hexdigest()
        if body is not None:
            reading.has_body = True
            reading.tall = float(np.ptp(body, axis=0).max())
            reading.iou = measure_overlap(body, view)
        problem = find_mask_problem(view.mask) if reading.iou is None else None
        if reading.iou is not None and reading.iou < self.min_iou:
            least = f"IoU of {self.min_iou:.2f} or more"
            problem = f"expected the body in its mask ({least}); found IoU {reading.iou:.2f}"
        brightest = int(view.image[view.mask].max())
        if problem is None and brightest < _BLACK:
            found = f"black (no channel above {brightest} of 255)"
            problem = f"expected a photograph in the mask; found {found}"
        if problem is not None:
            raise InputError(f"{place}: {problem}")
        if reading.iou is None:
            reading.silhouette = make_silhouette(view)


def inspect(data: PhotographsDataModule, min_iou: float = 0.5, min_agreement: float = 0.9) -> Report:
    """Read everything that training and evaluation would read, once, with the workers of ``data``.

    Args:
        min_iou: minimum IoU of a body's silhouette and a mask, in [0, 1]; clothed people reach 0.75 to
            0.95, wrong cameras 0 to 0.4.
        min_agreement: without a body, the minimum share of a mask that the subject's other masks allow,
            in [0, 1]; correct cameras reach 0.98 to 1.
    """
    report = Report()
    dataset = data.dataset
    # Static cameras allow only one protocol.
    targets = CAMERAS if dataset.static_cameras else data.targets
    readings: dict[str, list[Reading]] = {}
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
        readings[phase] = _read(reader, targets, min_iou, data, f"checking {phase}")
        _compare_masks(readings[phase], min_agreement)
        report.phases[phase] = _summarize(reader, readings[phase])
        report.problems += reader.problems + _collect(readings[phase], "problem")
        report.notes += _describe_oddities(dataset.published.get(phase), phase, reader, readings[phase])
    if len(readings) == len(PHASES):
        report.problems += _find_leaks(str(dataset.root), *readings.values())
    try:
        if not report.problems and "train" in readings:
            data.training_sampler(targets)
        if not report.problems:
            data.evaluation_loader(targets=targets)
    except InputError as error:
        report.problems.append(str(error))
    report.problems = list(dict.fromkeys(report.problems))
    return report


def _read(
    reader: Reader, targets: TargetProtocol, min_iou: float, data: PhotographsDataModule, label: str
) -> list[Reading]:
    """Read the images of a phase that exist or that a target protocol may require."""
    needed = {RING_VIEW} | targets.view_numbers
    listed = []
    for name, positions in reader.subjects.items():
        for position in positions:
            views = sorted(needed | set(reader.views_at(name, position)))
            listed += [(name, position, view) for view in views]
    if not listed:
        return []
    photographs = Photographs(reader, None, min(data.dataset.cache_images_mb, _CACHE_MB))
    items = _Readings(photographs, listed, min_iou)
    loader = make_loader(items, min(data.workers(len(items)), len(items)))
    return list(track(loader, label, total=len(items), console=Console(stderr=True)))


def _compare_masks(readings: Sequence[Reading], least: float) -> None:
    """Set the agreement and height of masks without a body; reports at most one problem a subject."""
    by_subject: dict[str, list[Reading]] = {}
    for one in readings:
        if one.silhouette is not None:
            by_subject.setdefault(one.name, []).append(one)
    for several in by_subject.values():
        ring = {one.position: one for one in several if one.view == RING_VIEW}
        pair = find_equal_poses({position: one.silhouette.extrinsics for position, one in ring.items()})
        if pair is not None:
            twin = ring[pair[1]]
            twin.problem = f"{twin.place}: expected a camera of its own; found that of position {pair[0]}"
        elif len(several) > 1:
            _compare_subject(several, least)


def _compare_subject(readings: Sequence[Reading], least: float) -> None:
    silhouettes = [one.silhouette for one in readings]
    tall = measure_height(silhouettes)
    for one, share in zip(readings, SEARCH.shares(silhouettes), strict=True):
        one.agreement = share
        one.tall = tall if one.tall is None else one.tall
    worst = min(readings, key=lambda one: one.agreement)
    if worst.agreement < least:
        worst.problem = (
            f"{worst.place}: expected a mask that the others of its subject allow ({least:.0%} of it or "
            f"more); found {worst.agreement:.0%} (wrong axes, units, direction or size of a camera?)"
        )


def _collect(readings: Sequence[Reading], key: str) -> list:
    """All known values of an attribute."""
    return [value for one in readings if (value := getattr(one, key)) is not None]


def _summarize(reader: Reader, readings: Sequence[Reading]) -> dict[str, float]:
    figures = {
        "people": reader.people,
        "subjects": len(reader.subjects),
        "photos": len(readings),
        "broken": len(_collect(readings, "problem")),
        "bodies": len({one.name for one in readings if one.has_body}),
    }
    for key in ("iou", "agreement"):
        if values := _collect(readings, key):
            figures[f"mean {key}"] = round(float(np.mean(values)), 3)
            figures[f"least {key}"] = round(min(values), 3)
    return figures


def _describe_oddities(
    published: int | None, phase: str, reader: Reader, readings: Sequence[Reading]
) -> list[str]:
    subjects = reader.subjects
    bodies = len({one.name for one in readings if one.has_body})
    notes = []
    if published not in (None, reader.people):
        notes.append(f"{phase}: expected {published} people as published; found {reader.people}")
    if bodies < len(subjects):
        notes.append(
            f"{phase}: expected a body for each of {len(subjects)} subjects; found "
            f"{bodies} (no Chamfer term; cameras are checked by their masks alone)"
        )
    tall = np.median(_collect(readings, "tall") or [0.0])
    if tall > _TALLEST:
        notes.append(f"{phase}: expected metres; found subjects {tall:.0f} units tall (millimetres?)")
    most = max(map(len, subjects.values()), default=0)
    fewer = [name for name, positions in subjects.items() if len(positions) < most]
    if fewer:
        found = f"fewer of {len(fewer)}, as {fewer[0]}"
        notes.append(f"{phase}: expected {most} cameras of every subject; found {found}")
    return notes


def _find_leaks(root: str, train: Sequence[Reading], val: Sequence[Reading]) -> list[str]:
    """Find subjects, or equal images under different names, that are in both ``train`` and ``val``."""
    both = sorted({one.name for one in train} & {one.name for one in val})
    lines = [f"{root}: expected each subject in train or in val; found {name!r} in both" for name in both]
    trained = {one.digest: one for one in train if one.digest is not None}
    repeated: dict[tuple[str, str], str] = {}
    for one in val:
        twin = trained.get(one.digest)
        if twin is not None and one.name not in both:
            line = f"{one.place}: expected a photograph that train has not; found {twin.place}"
            repeated.setdefault((one.name, twin.name), line)
    return lines + list(repeated.values())
