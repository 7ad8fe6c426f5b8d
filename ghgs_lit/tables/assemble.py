"""From records to tables: which run stands in which cell, what is best, what differs beyond chance."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from ghgs_lit.errors import InputError, choice
from ghgs_lit.runs.results import mean
from ghgs_lit.tables.differences import differing, differing_text
from ghgs_lit.tables.layouts import (
    Cell,
    Column,
    Group,
    Layout,
    Line,
    Table,
    arrow,
    decimals,
)
from ghgs_lit.tables.others import data_title, reported_data, reported_table
from ghgs_lit.tables.records import ABLATIONS, Planned, Record, Sweep, Variant, person_of
from ghgs_lit.tables.significance import PairedTest, compare, holm, too_few

NO_FIGURE = "-"
"""As the paper prints it."""
BASELINES = {
    "black": "Black image",
    "nearest_view": "Nearest input view",
    "body_depth": "Splats at the body's mean depth",
    "true_depth": "Splats at the true depth",
    "untrained": "Untrained model",
}
_COMPETE = ("model", "other")
"""Kinds of rows that can be best and are tested: no baseline, some of which know the truth."""


@dataclass(frozen=True)
class TableOptions:
    """What is shown: ``views``, ``targets`` and ``metrics`` None for what the layout and the runs have.

    ``unit``: a regular expression whose first group names the person, where subjects are frames of people.
    """

    layout: Layout
    views: tuple[int, ...] | None = None
    targets: tuple[str, ...] | None = None
    metrics: tuple[str, ...] | None = None
    reported: bool = True
    test: PairedTest = field(default_factory=PairedTest)
    unit: re.Pattern[str] | None = None


def build_tables(sweep: Sweep, others: Sequence[Record], options: TableOptions) -> list[Table]:
    """One table for each setting that occurs (and model, where rows are ablations).

    Raises:
        InputError: nothing was measured on these targets; two runs claim one cell; other methods' results
            fit no table.
    """
    layout = options.layout
    if others and layout.rows == "ablation":
        raise InputError(f"others: expected layout=table1, table2 or table3; found {layout.name}")
    own = [r for r in sweep.records if not options.targets or r.setting.targets in options.targets]
    if layout.rows == "ablation":
        own = [r for r in own if r.variant.kind == "model"]
    if not own:
        raise InputError(f"runs: expected some on targets {list(options.targets or [])}; found others only")
    measured = dict.fromkeys(name for r in (*own, *others) for name in r.means)
    for name in options.metrics or ():
        choice("columns", name, tuple(measured))
    keys = list(dict.fromkeys(_table_key(r, layout) for r in own))
    foreign = [r for r in others if _table_key(r, layout) not in keys]
    if foreign and len(foreign) == len(others):
        raise InputError(
            f"{foreign[0].source}: expected results on one of {[_text(k) for k in keys]}; "
            f"found {_text(_table_key(foreign[0], layout))}"
        )
    return [
        _table([r for r in (*own, *others) if _table_key(r, layout) == key], sweep, options) for key in keys
    ]


def _table_key(record: Record, layout: Layout) -> tuple:
    """Records of one key stand in one table."""
    setting, variant = record.setting, record.variant
    if layout.columns == "data":
        setting = replace(setting, data="")
    if layout.rows == "ablation":
        return (setting, variant.model, variant.encoder, variant.extra)
    return (setting,)


def _text(key: tuple) -> str:
    s = key[0]
    shown = {"data": s.data, "split": s.split, "targets": s.targets, "protocol": s.protocol}
    return ", ".join(f"{name}={value}" for name, value in shown.items() if value)


def _table(records: list[Record], sweep: Sweep, options: TableOptions) -> Table:
    layout = options.layout
    planned = _planned_here(records, sweep, layout)
    reported = layout.reported if options.reported else None
    groups = _groups(records, planned, options)
    models = [r for r in records if r.variant.kind == "model"] or records
    metrics = options.metrics or (
        "psnr",
        "ssim",
        "lpips" if all("lpips" in r.means for r in models) else "flip",
    )
    lines = _reported_lines(layout, reported, groups) if reported else []
    lines += _lines(records, planned, layout)
    stub = ("3D Unproj.", "Semantic Cons.") if layout.rows == "ablation" else ("Methods",)
    about = {"records": records, "planned": planned}
    on = reported_table(reported)[0] if reported else None
    table = Table(layout, about, stub, groups, list(metrics), lines, reported_on=on)
    for record in records:
        _place(table, record, options)
    _finish_cells(table)
    for column in table.columns:
        _mark_best(table, column)
    _test(table, options.test)
    return table


def _planned_here(records: list[Record], sweep: Sweep, layout: Layout) -> list[Planned]:
    """Training runs of the sweep that belong to this table's models and data."""
    models = {(r.variant.model, r.variant.encoder, r.variant.extra) for r in records}
    data = {r.setting.data for r in records}
    found = sweep.planned
    if layout.columns != "data":
        found = [p for p in found if p.data in data]
    if layout.rows == "ablation":
        found = [p for p in found if (p.variant.model, p.variant.encoder, p.variant.extra) in models]
    return found


def _groups(records: list[Record], planned: list[Planned], options: TableOptions) -> list[Group]:
    layout, views = options.layout, options.views or options.layout.views
    if layout.columns == "views":
        name = data_title(records[0].setting.data)
        return [Group(name if layout.heading == "data" else f"{n}-view", n) for n in views]
    names = [data_title(d) for d in reported_data(layout.reported)] if options.reported else []
    names += [data_title(r.setting.data) for r in records] + [data_title(p.data) for p in planned]
    several = len(views) > 1
    return [
        Group(f"{name}, {n}-view" if several else name, n, name)
        for name in dict.fromkeys(names)
        for n in views
    ]


def _reported_lines(layout: Layout, reported: str, groups: list[Group]) -> list[Line]:
    lines = []
    switches = {name: pair for pair, name in ABLATIONS.items()}
    for method, figures in reported_table(reported)[1].items():
        pair = switches[method] if layout.rows == "ablation" else None
        stub = (method,) if pair is None else _signs(pair)
        line = Line(Variant("reported", method, switches=pair), stub, absent=NO_FIGURE)
        by_group = {data_title(k) if isinstance(k, str) else k: v for k, v in figures.items()}
        for group in groups:
            for metric, figure in by_group.get(group.data or group.views, {}).items():
                # The paper does not say of how many views its Table 1 is.
                line.cells[group, metric] = Cell({0: figure})
        lines.append(line)
    return lines


def _signs(switches: tuple[bool, bool]) -> tuple[str, str]:
    return tuple("✓" if on else "✗" for on in switches)


def _lines(records: list[Record], planned: list[Planned], layout: Layout) -> list[Line]:
    """The measured rows: all four combinations, or baselines, other methods and ours, in this order."""
    variants = dict.fromkeys([r.variant for r in records] + [p.variant for p in planned])
    if layout.rows == "ablation":
        first = records[0].variant
        lines = []
        for pair in ABLATIONS:
            unprojection, semantic = _signs(pair)
            note = " (a)" if pair[1] and not first.has_semantics else ""
            lines.append(Line(replace(first, switches=pair), (unprojection, semantic + note)))
        return lines
    order = ("baseline", "other", "model")
    own = [v for v in variants if v.kind == "model"]
    return [
        Line(v, (_label(v, own),), absent="missing" if v.kind == "model" else NO_FIGURE)
        for v in sorted(variants, key=lambda v: order.index(v.kind))
    ]


def _label(variant: Variant, own: list[Variant]) -> str:
    """``Ours``, with what tells our variants apart where there are several."""
    if variant.kind == "baseline":
        return BASELINES.get(variant.name, variant.name)
    if variant.kind != "model":
        return variant.name

    def parts(v: Variant) -> list[str]:
        ablation = ABLATIONS[v.switches] if v.switches else ""
        return [v.model, v.encoder, ablation, *(f"{key}={value}" for key, value in v.extra)]

    rows = [parts(v) for v in own]
    told = [p for i, p in enumerate(parts(variant)) if len({row[i] for row in rows}) > 1]
    return "Ours" + (f" ({', '.join(told)})" if told else "")


def _place(table: Table, record: Record, options: TableOptions) -> None:
    """Put a record's numbers into its cells."""
    data = data_title(record.setting.data)
    group = next((g for g in table.groups if g.views == record.views and g.data in (None, data)), None)
    if group is None:
        return
    line = next(
        line
        for line in table.lines
        if line.variant == record.variant
        or (
            (table.layout.rows == "ablation" and line.variant.kind == "model")
            and line.variant.switches == record.variant.switches
        )
    )
    for metric in table.metrics:
        if metric not in record.means:
            continue
        cell = line.cells.setdefault((group, metric), Cell(count=record.count))
        if record.seed in cell.seeds:
            if cell.seeds[record.seed] == record.means[metric]:
                continue  # the same numbers, measured or copied twice
            raise _claimed_twice(table, record)
        cell.seeds[record.seed] = record.means[metric]
        cell.runs.append(str(record.about.get("hash") or record.source))
        people: dict[str, list[float]] = {}
        for subject, values in record.subjects.items():
            if metric in values:
                people.setdefault(person_of(subject, options.unit), []).append(values[metric])
        for person, values in people.items():
            cell.by_seed.setdefault(person, []).append(mean(values))


def _claimed_twice(table: Table, record: Record) -> InputError:
    """Says which runs, and by which keys of their configurations they could be told apart."""
    rivals = [
        r
        for r in table.about["records"]
        if (r.variant, r.setting, r.views, r.seed)
        == (record.variant, record.setting, record.views, record.seed)
    ]
    keys = differing([r.config for r in rivals if r.config])
    hint = f"; they differ in {differing_text(keys)}: by=[{', '.join(keys)}] tells them apart" if keys else ""
    what = (
        f"ablation={ABLATIONS[record.variant.switches]}" if record.variant.switches else record.variant.name
    )
    return InputError(
        f"{record.source}: expected one run for {what}, {record.views} views, seed {record.seed}; "
        f"found {rivals[0].source} too{hint}"
    )


def _finish_cells(table: Table) -> None:
    """Subjects' means over seeds, and which seeds are lacking."""
    models = [line for line in table.lines if line.variant.kind == "model"]
    seeds = {p.seed for p in table.about["planned"]}
    seeds |= {seed for line in models for cell in line.cells.values() for seed in cell.seeds}
    for line in table.lines:
        for cell in line.cells.values():
            cell.subjects = {name: mean(values) for name, values in cell.by_seed.items()}
            if line.variant.kind == "model":
                cell.lacking = tuple(sorted(seeds - set(cell.seeds)))


def _printed(cell: Cell, metric: str) -> str:
    return f"{cell.mean:.{decimals(metric)}f}"


def _mark_best(table: Table, column: Column) -> None:
    """The best mean of a column, as printed; none where there is no better and worse."""
    metric = column[1]
    cells = [
        line.cells[column] for line in table.lines if line.variant.kind in _COMPETE and column in line.cells
    ]
    texts = {_printed(cell, metric) for cell in cells}
    if len(texts) < 2 or not arrow(metric):
        return
    best = _better(metric, [cell.mean for cell in cells])
    for cell in cells:
        cell.best = _printed(cell, metric) == f"{best:.{decimals(metric)}f}"


def _better(metric: str, values: Sequence[float]) -> float:
    return min(values) if arrow(metric) == "↓" else max(values)


def reference_line(table: Table, column: Column, against: str) -> Line | None:
    """The row that the others of a column are tested against; None without subjects' values."""
    lines = [
        line
        for line in table.lines
        if line.variant.kind in _COMPETE and column in line.cells and line.cells[column].subjects
    ]
    full = [line for line in lines if line.variant.kind == "model" and line.variant.switches == (True, True)]
    if against == "full" and len(full) == 1:
        return full[0]
    if not lines or not arrow(column[1]):
        return None
    best = _better(column[1], [line.cells[column].mean for line in lines])
    return next(line for line in lines if line.cells[column].mean == best)


def _test(table: Table, test: PairedTest) -> None:
    """Each row against its column's reference, corrected over all comparisons of the table."""
    if test.kind == "none":
        return
    tested: list[Cell] = []
    for column in table.columns:
        reference = reference_line(table, column, test.against)
        for line in table.lines:
            cell = line.cells.get(column)
            if reference is None or line is reference or cell is None or not cell.subjects:
                continue
            if line.variant.kind in _COMPETE:
                cell.test = compare(cell.subjects, reference.cells[column].subjects, test.kind)
                tested.append(cell)
    known = [cell for cell in tested if cell.test.p is not None]
    for cell, p in zip(known, holm([cell.test.p for cell in known]), strict=True):
        enough = too_few(cell.test.n, len(known), test) is None
        cell.test = replace(cell.test, corrected=p)
        cell.marked = enough and p < test.alpha
