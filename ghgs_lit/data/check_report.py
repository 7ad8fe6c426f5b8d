"""The report on a checked data set: printed as tables,
and written as ``check.json`` and a contact sheet."""

import json
import re
from dataclasses import asdict
from pathlib import Path

import numpy as np
import rich
import rich.box
from rich.markup import escape
from rich.table import Table

from ghgs_lit.data.check import Phase, Report
from ghgs_lit.data.overlap import Tile, save_sheet

_LINE = re.compile(r"(?P<place>.*?): expected (?P<expected>.*); found (?P<found>.*)", re.DOTALL)
# Rows of a table on the terminal; check.json has all.
_SHOWN = 30
_LEGEND = "IoU: of masks and silhouettes of bodies; agree: least share of a mask that the other masks allow"


def split_line(line: str) -> tuple[str, str, str]:
    """Place, expected and found of an error message.

    Args:
        line: ``<place>: expected ...; found ...``.

    Returns:
        The three parts; of another line two empty texts and the line.
    """
    match = _LINE.fullmatch(line)
    return (match["place"], match["expected"], match["found"]) if match else ("", "", line)


def _counts(phase: Phase) -> dict[str, int]:
    reader = phase.reader
    broken = sum(one.problem is not None for one in phase.seen)
    counts = (reader.people, len(reader.subjects), len(phase.seen), broken, phase.bodies)
    return dict(zip(("people", "subjects", "photos", "broken", "bodies"), counts, strict=True))


def _light(report: Report) -> str:
    """A line on the lights of the renders and on how bright subjects are, 1 for white."""
    known = {name: phase.known("bright") for name, phase in report.phases.items()}
    bright = ", ".join(f"{name} {np.mean(values):.3f}" for name, values in known.items() if values)
    lights = "" if report.lights is None else f"rendered with data.render.lights={report.lights}; "
    return f"{lights}mean brightness of subjects (1 is white): {bright or 'unknown'}"


def show(report: Report) -> None:
    """Print the report as tables."""
    headings = ("phase", "people", "subjects", "photos", "broken", "bodies", "mean IoU", "min IoU", "agree")
    narrow = {"box": rich.box.SIMPLE_HEAD, "padding": (0, 1, 0, 0)}  # 80 columns hold all headings
    table = Table(*headings, **narrow, caption=_LEGEND, caption_justify="left")
    for name, phase in report.phases.items():
        iou = phase.known("iou")
        agreement = phase.known("agreement")
        numbers = [f"{np.mean(iou):.3f}", f"{min(iou):.3f}"] if iou else ["-", "-"]
        numbers.append(f"{min(agreement):.3f}" if agreement else "-")
        table.add_row(name, *map(str, _counts(phase).values()), *numbers)
    if report.phases:
        rich.print(table)
        print(_light(report))
    for title, lines in (("problem", report.problems), ("note", report.notes)):
        if lines:
            table = Table(title, "expected", "found")
            for line in lines[:_SHOWN]:
                table.add_row(*map(escape, split_line(line)))
            if len(lines) > _SHOWN:
                table.add_row(f"... and {len(lines) - _SHOWN} more", "", "")
            rich.print(table)


def write(report: Report, folder: Path) -> Path:
    """Write ``check.json`` and, if there are photographs, ``contact.png``.

    Args:
        report: of a check.
        folder: is made if it is missing.

    Returns:
        ``folder``.
    """
    keys = ("place", "expected", "found")
    rows = dict[str, list[Tile]]()
    content = {
        "problems": [dict(zip(keys, split_line(line), strict=True)) for line in report.problems],
        "notes": report.notes,
        "lights": report.lights,
        "phases": {},
    }
    for name, phase in report.phases.items():
        seen = [asdict(one) for one in phase.seen]
        for one in seen:
            tile = one.pop("tile")
            del one["silhouette"]
            if tile is not None:
                label = f"{one['position']:03d}" + ("" if one["iou"] is None else f" {one['iou']:.2f}")
                rows.setdefault(f"{name} {one['name']}", []).append((label, tile))
        content["phases"][name] = {**_counts(phase), "seen": seen}
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "check.json").write_text(json.dumps(content, indent=1))
    if rows:
        save_sheet(rows, folder / "contact.png")
    return folder
