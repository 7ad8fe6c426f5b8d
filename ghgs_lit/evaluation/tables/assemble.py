"""From records to tables: which run fills which cell, what is best, what differs beyond chance."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from ghgs_lit.config.ablation import ABLATIONS
from ghgs_lit.errors import InputError, choice
from ghgs_lit.evaluation.tables.differences import differing, differing_text
from ghgs_lit.evaluation.tables.layouts import Cell, Column, Group, Layout, Line, Table, arrow, decimals
from ghgs_lit.evaluation.tables.records import Planned, Record, Sweep, Variant, person_of
from ghgs_lit.evaluation.tables.reported import data_title, reported_data, reported_table
from ghgs_lit.evaluation.tables.significance import PairedTest, compare, holm, too_few
from ghgs_lit.evaluation.tables.text import write_caption, write_notes
from ghgs_lit.runs.results import mean

NO_FIGURE = "-"
"""Where there is no figure, as the paper prints it."""
BASELINES = {
    "black": "Black image",
    "nearest_view": "Nearest input view",
    "hull": "Splats on the visual hull",
    "photo_depth": "Splats at the photo-consistent depth",
    "per_scene": "Per-scene 3DGS",
    "body_depth": "Splats at the body's mean depth",
    "true_depth": "Splats at the true depth",
    "true_discs": "Discs at the true depth",
    "untrained": "Untrained model",
}


@dataclass(frozen=True)
class TableOptions:
    """What is shown.

    Args:
        layout: rows and columns.
        views, targets, metrics: a selection; None: those of the layout and of the runs.
        reported: whether the paper's figures are shown.
        test: the test against the reference row.
        unit: a regular expression whose first group is the person, where subjects are frames of people.
        illustration: whether a note says that the numbers are no result.
    """

    layout: Layout
    views: tuple[int, ...] | None = None
    targets: tuple[str, ...] | None = None
    metrics: tuple[str, ...] | None = None
    reported: bool = True
    test: PairedTest = field(default_factory=PairedTest)
    unit: re.Pattern[str] | None = None
    illustration: bool = False


def build_tables(sweep: Sweep, others: Sequence[Record], options: TableOptions) -> list[Table]:
    """One table for each setting that occurs (and each model, where rows are ablations).

    Args:
        sweep: our runs.
        others: results of other methods.
        options: what is shown.

    Raises:
        InputError: nothing was measured on these targets; two runs claim one cell; the results of other
            methods fit no table.
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
    if others and not any(_table_key(r, layout) in keys for r in others):
        raise InputError(
            f"{others[0].source}: expected results on one of {[_text(k) for k in keys]}; "
            f"found {_text(_table_key(others[0], layout))}"
        )
    return [
        _table([r for r in (*own, *others) if _table_key(r, layout) == key], sweep, options) for key in keys
    ]


def _table_key(record: Record, layout: Layout) -> tuple:
    """Records with the same key belong to the same table."""
    setting = replace(record.setting, data="") if layout.columns == "data" else record.setting
    return (setting, *record.variant.trained) if layout.rows == "ablation" else (setting,)


def _text(key: tuple) -> str:
    return ", ".join(f"{name}={value}" for name, value in vars(key[0]).items() if value)


def _table(records: list[Record], sweep: Sweep, options: TableOptions) -> Table:
    layout = options.layout
    planned = _planned_here(records, sweep, layout)
    reported = layout.reported if options.reported else None
    groups = _groups(records, planned, options)
    models = [r for r in records if r.variant.kind == "model"] or records
    perceptual = "lpips" if all("lpips" in r.means for r in models) else "flip"
    metrics = options.metrics or ("psnr", "ssim", perceptual)
    lines = _reported_lines(layout, reported, groups) if reported else []
    lines += _measured_lines(records, planned, layout)
    stub = ("3D Unproj.", "Semantic Cons.") if layout.rows == "ablation" else ("Methods",)
    on = reported_table(reported)[0] if reported else None
    table = Table(layout, records, planned, stub, groups, list(metrics), lines, reported_on=on)
    for record in records:
        _place(table, record, options)
    _note_missing_seeds(table)
    for column in table.columns:
        _mark_best(table, column)
    _test(table, options.test)
    table.caption = write_caption(table)
    table.notes = write_notes(table, options.test, options.illustration)
    return table


def _planned_here(records: list[Record], sweep: Sweep, layout: Layout) -> list[Planned]:
    """Training runs of the sweep that belong to the models and data of this table."""
    models, data = {r.variant.trained for r in records}, {r.setting.data for r in records}
    return [
        p
        for p in sweep.planned
        if (layout.columns == "data" or p.data in data)
        and (layout.rows != "ablation" or p.variant.trained in models)
    ]


def _groups(records: list[Record], planned: list[Planned], options: TableOptions) -> list[Group]:
    layout, views = options.layout, options.views or options.layout.views
    if layout.columns == "views":
        name = data_title(records[0].setting.data)
        return [Group(name if layout.heading == "data" else f"{n}-view", n) for n in views]
    names = reported_data(layout.reported) if options.reported else []
    names += [r.setting.data for r in records] + [p.data for p in planned]
    several = len(views) > 1
    return [
        Group(f"{name}, {n}-view" if several else name, n, name)
        for name in dict.fromkeys(map(data_title, names))
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
                # The paper does not say with how many views its Table 1 was measured.
                line.cells[group, metric] = Cell({0: figure})
        lines.append(line)
    return lines


def _signs(switches: tuple[bool, bool]) -> tuple[str, str]:
    return tuple("✓" if on else "✗" for on in switches)


def _measured_lines(records: list[Record], planned: list[Planned], layout: Layout) -> list[Line]:
    """All four combinations; or baselines, other methods and ours, in this order."""
    if layout.rows == "ablation":
        first, lines = records[0].variant, []
        for pair in ABLATIONS:
            unprojection, semantic = _signs(pair)
            note = " (a)" if pair[1] and not first.has_semantics else ""
            lines.append(Line(replace(first, switches=pair), (unprojection, semantic + note)))
        return lines
    variants = dict.fromkeys([r.variant for r in records] + [p.variant for p in planned])
    order = ("baseline", "other", "model")
    own = [v for v in variants if v.kind == "model"]
    return [
        Line(v, (_label(v, own),), absent="missing" if v.kind == "model" else NO_FIGURE)
        for v in sorted(variants, key=lambda v: order.index(v.kind))
    ]


def _label(variant: Variant, own: list[Variant]) -> str:
    """``Ours``, with the differences between our variants where there are several."""
    if variant.kind == "baseline":
        return BASELINES.get(variant.name, variant.name)
    if variant.kind != "model":
        return variant.name

    def parts(v: Variant) -> list[str]:
        return [v.model, v.encoder, v.ablation, *(f"{key}={value}" for key, value in v.extra)]

    different = [len(set(values)) > 1 for values in zip(*map(parts, own), strict=True)]
    told = [part for part, differs in zip(parts(variant), different, strict=True) if differs]
    return "Ours" + (f" ({', '.join(told)})" if told else "")


def _place(table: Table, record: Record, options: TableOptions) -> None:
    """Put the numbers of a record into its cells."""
    data = data_title(record.setting.data)
    group = next((g for g in table.groups if g.views == record.views and g.data in (None, data)), None)
    if group is None:
        return
    line = next(line for line in table.lines if line.variant == record.variant)
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
    """Names the runs, and the configuration keys by which they can be told apart."""

    def cell(r: Record) -> tuple:
        return (r.variant, r.setting, r.views, r.seed)

    rivals = [r for r in table.records if cell(r) == cell(record)]
    keys = differing([r.config for r in rivals if r.config])
    hint = f"; they differ in {differing_text(keys)}: by=[{', '.join(keys)}] tells them apart" if keys else ""
    what = f"ablation={record.variant.ablation}" if record.variant.switches else record.variant.name
    return InputError(
        f"{record.source}: expected one run for {what}, {record.views} views, seed {record.seed}; "
        f"found {rivals[0].source} too{hint}"
    )


def _note_missing_seeds(table: Table) -> None:
    """Compare the seeds of each cell of ours with those of the whole table."""
    cells = [cell for line in table.ours for cell in line.cells.values()]
    seeds = {p.seed for p in table.planned} | {seed for cell in cells for seed in cell.seeds}
    for cell in cells:
        cell.missing_seeds = tuple(sorted(seeds - set(cell.seeds)))


def _mark_best(table: Table, column: Column) -> None:
    """Mark the best means of a column, as printed; none where all are equal or no direction is better."""
    cells = [line.cells[column] for line in table.lines if line.competes and column in line.cells]
    printed = [float(f"{cell.mean:.{decimals(column[1])}f}") for cell in cells]
    if len(set(printed)) < 2 or not arrow(column[1]):
        return
    best = _better(column[1], printed)
    for cell, value in zip(cells, printed, strict=True):
        cell.best = value == best


def _better(metric: str, values: Sequence[float]) -> float:
    return min(values) if arrow(metric) == "↓" else max(values)


def _reference_line(table: Table, column: Column, against: str) -> Line | None:
    """The row that the others of a column are tested against; None without values of subjects."""
    lines = [
        line for line in table.lines if line.competes and column in line.cells and line.cells[column].subjects
    ]
    full = [line for line in lines if line.is_ours and line.variant.ablation == "full"]
    if against == "full" and len(full) == 1:
        return full[0]
    if not lines or not arrow(column[1]):
        return None
    best = _better(column[1], [line.cells[column].mean for line in lines])
    return next(line for line in lines if line.cells[column].mean == best)


def _test(table: Table, test: PairedTest) -> None:
    """Test each row against the reference of its column, corrected over all comparisons of the table."""
    if test.kind == "none":
        return
    known: list[Cell] = []
    for column in table.columns:
        reference = _reference_line(table, column, test.against)
        for line in table.lines if reference else ():
            cell = line.cells.get(column)
            if line is not reference and line.competes and cell is not None and cell.subjects:
                cell.test = compare(cell.subjects, reference.cells[column].subjects, test.kind)
                known += [cell] if cell.test.p is not None else []
    for cell, p in zip(known, holm([cell.test.p for cell in known]), strict=True):
        cell.test = replace(cell.test, corrected=p)
        cell.marked = p < test.alpha and too_few(cell.test.n, len(known), test) is None
