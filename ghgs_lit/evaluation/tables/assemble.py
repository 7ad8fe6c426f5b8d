"""Assembly of tables from measurements: their rows, columns and cells."""

import itertools
import re
from collections.abc import Callable, Sequence
from dataclasses import replace

import pandas as pd

from ghgs_lit.config.keys import ABLATIONS
from ghgs_lit.errors import InputError, choice, require
from ghgs_lit.evaluation.tables.cells import fill
from ghgs_lit.evaluation.tables.layouts import (
    Group,
    Layout,
    Line,
    Table,
    TableOptions,
    data_title,
    reported_data,
    reported_table,
)
from ghgs_lit.evaluation.tables.notes import write_caption, write_notes
from ghgs_lit.evaluation.tables.records import SETTING, Planned, Sweep
from ghgs_lit.evaluation.tables.variants import Variant

BASELINES = {
    "black": "Black image",
    "nearest_view": "Nearest input view",
    "hull": "Discs on the visual hull",
    "photo_depth": "Discs at the photo-consistent depth",
    "per_scene": "Per-scene 3DGS",
    "body_depth": "Discs at the body's mean depth",
    "true_depth": "Discs at the true depth",
    "untrained": "Untrained model",
}
#: Titles of models that follow other methods.
PEERS = {"gps": "After GPS-Gaussian", "pixel": "Pixel-aligned"}


def build_tables(sweep: Sweep, others: Sequence[pd.DataFrame], options: TableOptions) -> list[Table]:
    """Tables of the measurements of a sweep: one for each setting,
    and for each model if rows are ablations.

    Args:
        sweep: Runs of ours.
        others: Results of other methods, one frame for each file.
        options: What the tables show.

    Returns:
        Tables in the order in which their settings first appear.

    Raises:
        InputError: Nothing was measured on these targets, two runs claim one cell, configurations
            in a cell differ, or results of other methods fit no table.
    """
    layout = options.layout
    if others and layout.rows == "ablation":
        raise InputError(f"others: expected layout=table1, table2 or table3; found {layout.name}")
    sweep = _runs_of_layout(sweep, options)
    ours = sweep.rows
    if options.subjects is not None:
        ours = _selected(ours, options.subjects, "the runs")
        others = [_selected(rows, options.subjects, rows["source"].iloc[0]) for rows in others]
    if options.targets:
        ours = ours[ours["targets"].isin(options.targets)]
    if ours.empty and options.targets:
        expected = (
            f"some of {', '.join(dict.fromkeys(sweep.rows['targets']))}, on which the runs were measured"
        )
        raise InputError(f"evaluation.targets: expected {expected}; found {', '.join(options.targets)}")
    rows = pd.concat([ours, *others], ignore_index=True)
    for name in options.metrics or ():
        choice("columns", name, tuple(_measured(rows)))
    same = [name for name in SETTING if layout.columns != "data" or name != "data"]
    if layout.rows == "ablation":
        rows = rows.assign(trained=[variant.trained for variant in rows["variant"]])
        same = [*same, "trained"]
    tables = [part for _, part in rows.groupby(same, sort=False) if part.index[0] < len(ours)]
    theirs = rows.iloc[len(ours) :]
    if len(theirs) and not any(theirs.index.isin(part.index).any() for part in tables):
        keys = [_text(part.iloc[0], same) for part in tables]
        where = theirs.iloc[0]
        raise InputError(f"{where['source']}: expected results on one of {keys}; found {_text(where, same)}")
    return [_table(part, sweep, options) for part in tables]


def _runs_of_layout(sweep: Sweep, options: TableOptions) -> Sweep:
    """The runs that a layout shows, of those of all layouts in a folder: with its numbers of views; on
    the paper's data, if any are; no baselines among ablations, and none of the paper's ablations
    among methods.

    Raises:
        InputError: There are none.
    """
    layout = options.layout
    views = options.views or layout.views
    rows = sweep.rows[sweep.rows["views"].isin(views)]
    known = ", ".join(map(str, sorted(set(sweep.rows["views"]))))
    expected = f"some of {known}, with which the runs were measured"
    require(len(rows), "evaluation.views", expected, list(views))
    on_paper = reported_table(layout.reported)[0].split(" and ") if layout.reported else []
    has_papers = any(data_title(name) in on_paper for name in rows["data"])

    def belongs(variant: Variant, data: str) -> bool:
        if has_papers and data_title(data) not in on_paper:
            return False
        if layout.rows == "ablation":
            return variant.kind == "model"
        return variant.kind != "model" or variant.ablation == "full" or variant.is_own

    rows = rows[list(map(belongs, rows["variant"], rows["data"]))]
    require(len(rows), "runs", f"runs of layout={layout.name}", "baselines or the paper's ablations only")
    planned = [p for p in sweep.planned if belongs(p.variant, p.data)]
    planned = [p for p in planned if p.views is None or set(p.views) & set(views)]
    return replace(sweep, rows=rows, planned=planned)


def _selected(rows: pd.DataFrame, names: re.Pattern[str], where: str) -> pd.DataFrame:
    """Rows of a selection of subjects.

    Args:
        rows: One for each subject; means, which say no subject, stay.
        names: Whole names of the selection match.
        where: The rows are from, for messages.

    Raises:
        InputError: None matches.
    """
    is_kept = [not isinstance(name, str) or names.fullmatch(name) is not None for name in rows["subject"]]
    expected = f"a match with the whole name of a subject of {where}, such as {rows['subject'].iloc[0]}"
    require(any(is_kept), "subjects", expected, names.pattern)
    return rows[is_kept]


def _measured(rows: pd.DataFrame) -> list[str]:
    facts = {*SETTING, "variant", "views", "trained_views", "seed", "source", "run", "git", "subject"}
    facts |= {"count", "said", "trained"}
    return [name for name in rows if name not in facts and rows[name].notna().any()]


def _text(row: pd.Series, names: list[str]) -> str:
    return ", ".join(f"{name}={row[name]}" for name in names)


def _table(rows: pd.DataFrame, sweep: Sweep, options: TableOptions) -> Table:
    layout = options.layout
    planned = _planned_here(rows, sweep.planned, layout)
    reported = layout.reported if options.reported else None
    groups = _groups(rows, planned, options)
    models = rows[[v.kind == "model" for v in rows["variant"]]]
    models = rows if models.empty else models
    lpips = "lpips" in models and models.groupby("source")["lpips"].count().all()
    metrics = list(options.metrics or ("psnr", "ssim", "lpips" if lpips else "flip"))
    begun = dict.fromkeys([*rows["variant"], *(p.variant for p in planned if not p.done)])
    lines = _measured_lines(sorted(begun, key=_place_in(sweep.order)), layout)
    figures: list[dict] = []
    if reported:
        names, figures = _reported(layout, reported, groups)
        lines = [*names, *lines]
    stub = ("3D Unproj.", "Semantic Cons.") if layout.rows == "ablation" else ("Methods",)
    if layout.rows == "ablation" and any(line.variant.is_own for line in lines):
        stub = ("Ablation", *stub)
        lines = [replace(line, stub=(line.variant.ablation, *line.stub)) for line in lines]
    on = reported_table(reported)[0] if reported else None
    table = Table(options, rows, planned, sweep.configs, stub, groups, metrics, lines, reported_on=on)
    table.others = len(sweep.configs.keys() - set(sweep.rows["source"]))
    fill(table, figures)
    table.caption = write_caption(table)
    table.notes = write_notes(table)
    return table


def _place_in(order: list[Variant]) -> Callable[[Variant], int]:
    return lambda variant: order.index(variant) if variant in order else len(order)


def _planned_here(rows: pd.DataFrame, planned: list[Planned], layout: Layout) -> list[Planned]:
    models = {variant.trained for variant in rows["variant"]}
    data = set(rows["data"])
    planned = [p for p in planned if layout.columns == "data" or p.data in data]
    return [p for p in planned if layout.rows != "ablation" or p.variant.trained in models]


def _groups(rows: pd.DataFrame, planned: list[Planned], options: TableOptions) -> list[Group]:
    layout = options.layout
    views = options.views or options.layout.views
    if layout.columns == "views":
        name = data_title(rows["data"].iloc[0])
        return [Group(name if layout.heading == "data" else f"{n}-view", n) for n in views]
    names = reported_data(layout.reported) if options.reported else []
    names += [*rows["data"], *(p.data for p in planned)]
    titles = dict.fromkeys(map(data_title, names))
    text = "{}, {}-view" if len(views) > 1 else "{}"
    pairs = itertools.product(titles, views)
    return [Group(text.format(name, n), n, name) for name, n in pairs]


def _reported(layout: Layout, reported: str, groups: list[Group]) -> tuple[list[Line], list[dict]]:
    """The paper's rows, and its figures with their line and group."""
    lines = []
    cells = []
    switches = {name: pair for pair, name in ABLATIONS.items()}
    for method, figures in reported_table(reported)[1].items():
        pair = switches[method] if layout.rows == "ablation" else None
        stub = (method,) if pair is None else _signs(pair)
        by_group = {data_title(k) if isinstance(k, str) else k: v for k, v in figures.items()}
        for number, group in enumerate(groups):
            # The paper does not say with how many views its Table 1 was measured.
            for metric, figure in by_group.get(group.data or group.views, {}).items():
                cells.append({"line": len(lines), "group": number, "metric": metric, "mean": figure})
        ablation = "" if pair is None else method
        variant = Variant("reported", method, ablation=ablation, switches=pair)
        lines.append(Line(variant, stub))
    return lines, cells


def _signs(switches: tuple[bool, bool]) -> tuple[str, str]:
    return tuple("✓" if on else "✗" for on in switches)


def _measured_lines(begun: list[Variant], layout: Layout) -> list[Line]:
    """Rows of all four ablations, then of a user's own; or of baselines, other methods and ours, in
    this order."""
    if layout.rows == "ablation":
        first = begun[0]
        papers = [replace(first, ablation=name, switches=pair) for pair, name in ABLATIONS.items()]
        own = [variant for variant in begun if variant.is_own]
        return [_ablation_line(variant) for variant in (*papers, *own)]
    order = ("baseline", "other", "model")
    models = [v for v in begun if v.kind == "model"]
    return [Line(v, (_label(v, models),)) for v in sorted(begun, key=lambda v: order.index(v.kind))]


def _ablation_line(variant: Variant) -> Line:
    unprojection, semantic = _signs(variant.switches)
    note = " (a)" if variant.switches[1] and not variant.has_semantics else ""
    return Line(variant, (unprojection, semantic + note))


def _label(variant: Variant, models: list[Variant]) -> str:
    """Title of a row: ``Ours`` or another method's, with what distinguishes several models."""
    if variant.kind == "baseline":
        return BASELINES.get(variant.name, variant.name)
    if variant.kind != "model":
        return variant.name

    def parts(v: Variant) -> list[str]:
        return [v.model, v.encoder, v.ablation, *v.titles]

    different = [len(set(values)) > 1 for values in zip(*map(parts, models), strict=True)]
    titles = [p for p, differs in zip(parts(variant), different, strict=True) if differs and p not in PEERS]
    return PEERS.get(variant.model, "Ours") + (f" ({', '.join(titles)})" if titles else "")
