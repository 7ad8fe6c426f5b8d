"""The texts of a table: its numbers as printed, its caption, its notes."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from ghgs_lit.evaluation.tables.differences import differing, differing_text
from ghgs_lit.evaluation.tables.layouts import Cell, Line, Table, decimals
from ghgs_lit.evaluation.tables.records import Planned
from ghgs_lit.evaluation.tables.reported import data_title, reported_source
from ghgs_lit.evaluation.tables.significance import KINDS, PairedTest, too_few

FOOTNOTE = (
    "All four combinations are listed. The paper's Table 4 prints three and has (✗, ✓) among them, while its"
    " text says that semantic consistency alone is not included. Without 3D unprojection there are no token"
    " points: neighbours are then found on the image plane."
)
NO_SEMANTICS = "features carry no semantics: this encoder was never trained for semantics"
ILLUSTRATION = "This is an illustration of the framework on a small model, not a result."
MARK = "*"


@dataclass(frozen=True)
class CellText:
    """The parts of a printed number.

    Args:
        mean: the number, or the text where there is none.
        spread: deviation over seeds; may be empty.
        tail: marks and missing seeds; may be empty.
        best: whether it is the best of its column.
    """

    mean: str
    spread: str = ""
    tail: str = ""
    best: bool = False


def deviation(values: Sequence[float]) -> float | None:
    """Sample standard deviation; None for fewer than two values."""
    if len(values) < 2:
        return None
    center = sum(values) / len(values)
    return math.sqrt(sum((v - center) ** 2 for v in values) / (len(values) - 1))


def cell_text(cell: Cell | None, line: Line, metric: str) -> CellText:
    """The text of a cell (None: the row has none in this column) in a column of ``metric``."""
    if cell is None:
        return CellText(line.absent)
    digits, spread = decimals(metric), deviation(list(cell.seeds.values()))
    tail = MARK if cell.marked else ""
    if cell.missing_seeds:
        tail += f" ({len(cell.seeds)}/{len(cell.seeds) + len(cell.missing_seeds)})"
    text = "" if spread is None else f"{spread:.{digits}f}"
    return CellText(f"{cell.mean:.{digits}f}", text, tail, cell.best)


def write_caption(table: Table) -> str:
    """Data, protocol, model and number of runs, in one line."""
    first, names = table.records[0], dict.fromkeys(r.setting.data for r in table.records)
    counts = sorted({cell.count for cell in table.measured if cell.count})
    seeds = max((len(cell.seeds) for cell in table.measured), default=0)
    setting = first.setting
    said = [
        f"Data {' and '.join(f'`{name}`' for name in names)}",
        f"{' or '.join(map(str, counts)) or 'no'} subjects of `{setting.split}`",
        f"targets `{setting.targets}`",
        f"metrics `{setting.protocol}`",
    ]
    if table.layout.rows == "ablation":
        said += [f"model `{first.variant.model}`", f"encoder `{first.variant.encoder}`"]
        said += [f"`{key}={value}`" for key, value in first.variant.extra]
    views = {group.views for group in table.groups}
    if table.layout.heading != "views" and len(views) == 1:
        said.append(f"{views.pop()} input views")
    spread = f" ± deviation over {seeds} seeds" if seeds > 1 else ""
    return f"{', '.join(said)}; mean over subjects{spread}, best of the measured methods in bold."


def write_notes(table: Table, test: PairedTest, illustration: bool = False) -> list[str]:
    """The notes below the table; ``illustration`` adds that the numbers are no result."""
    said = [f"**{ILLUSTRATION}**"] if illustration else []
    if table.layout.rows == "ablation":
        said.append(FOOTNOTE)
        if not table.ours[0].variant.has_semantics:
            said.append(f"(a) {NO_SEMANTICS}.")
    if "flip" in table.metrics and "lpips" not in table.metrics:
        said.append("FLIP replaces the paper's LPIPS, which at least one run could not compute.")
    if table.reported_on:
        said.append(
            f"Reported: figures that {reported_source()}, prints for {table.reported_on}, measured by its"
            " authors on their data, split and views. They were not measured here, and are not comparable"
            " with figures on other data or protocols."
        )
    said += _about_others(table)
    said += _about_test(table, test)
    said += _about_steps(table)
    said += _about_runs(table)
    return said


def _about_others(table: Table) -> list[str]:
    """Where the numbers of other methods are from, and whether their number of subjects differs from ours."""
    said = []
    own = {r.count for r in table.records if r.variant.kind == "model"}
    for line in table.lines:
        if line.variant.kind == "other":
            records = [r for r in table.records if r.variant == line.variant]
            untested = "" if all(r.subjects for r in records) else "; means only where untested"
            counts = sorted({r.count for r in records if r.count} - own)
            fewer = f"; of {' or '.join(map(str, counts))} subjects" if counts else ""
            said.append(f"{line.variant.name}: {records[0].about['source']}{untested}{fewer}.")
    return said


def _about_test(table: Table, test: PairedTest) -> list[str]:
    """Which test was made with how many subjects, or why nothing is marked."""
    tested = [c for c in table.measured if c.test is not None]
    if not tested:
        return []
    known = [c for c in tested if c.test.p is not None]
    counts = sorted({c.test.n for c in tested})
    n = " to ".join(map(str, dict.fromkeys((counts[0], counts[-1]))))
    against = "its column's best row"
    if test.against == "full":
        full = [line for line in table.ours if line.variant.ablation == "full"]
        against = "the row of the whole method" if len(full) == 1 and full[0].cells else against
    few = too_few(counts[-1], len(known), test)
    about = f"{KINDS[test.kind]} against {against}, n = {n} subjects (each averaged over seeds)"
    if few:
        return [f"No differences are marked: n = {n} subjects are too few for a {KINDS[test.kind]} ({few})."]
    marks = f"{MARK} differs beyond chance: {about}, two-sided, Holm's correction over the {len(known)}"
    return [f"{marks} comparisons of this table, p < {test.alpha:g}."]


def _about_steps(table: Table) -> list[str]:
    """That rows were not trained equally long, where they were not."""
    steps: dict[str, set[int]] = {}
    for record in table.records:
        if "steps" in record.means:
            line = next(line for line in table.lines if line.variant == record.variant)
            steps.setdefault(" ".join(line.stub), set()).add(round(record.means["steps"]))
    if len(set().union(*steps.values())) < 2:
        return []
    rows = (f"{name}: {' to '.join(map(str, sorted({min(n), max(n)})))}" for name, n in steps.items())
    return [f"Rows were trained for different numbers of steps ({'; '.join(rows)})."]


def _run_name(planned: Planned) -> str:
    variant = planned.variant
    return f"{data_title(planned.data)} {variant.model} {variant.ablation} seed {planned.seed}"


def _about_runs(table: Table) -> list[str]:
    """Runs that are unfinished, that differ in settings, or that are of different states of the code."""
    said = []
    if any(cell.missing_seeds for cell in table.measured):
        said.append("(2/3): from 2 of 3 seeds; the others have no results yet.")
    unfinished = list(dict.fromkeys(_run_name(p) for p in table.planned if not p.done))
    if unfinished:
        more = f" and {len(unfinished) - 4} more" if len(unfinished) > 4 else ""
        said.append(f"No results yet (in progress or cut off): {'; '.join(unfinished[:4])}{more}.")
    groups: dict[tuple, list] = {}
    for record in table.records:
        if record.config:
            variant = record.variant
            row = (variant.model, variant.encoder, variant.switches, record.setting.data)
            row = () if table.layout.rows == "ablation" else row
            groups.setdefault(row, []).append(record.config)
    keys = {key: values for group in groups.values() for key, values in differing(group).items()}
    if keys:
        said.append(f"Runs side by side differ also in {differing_text(keys)}.")
    states = {_git_text(git) for r in table.records if (git := r.about.get("git"))}
    if len(states) > 1:
        said.append(f"The runs are of {len(states)} states of the code: {', '.join(sorted(states))}.")
    return said


def _git_text(git: dict) -> str:
    return f"{git['commit'][:9]}{' with changes' if git.get('changed') else ''}"
