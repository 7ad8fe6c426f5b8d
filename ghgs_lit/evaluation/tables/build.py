"""Assembly of tables from measurements: selection of runs, rows and columns."""

import itertools
import re
from collections.abc import Sequence
from dataclasses import replace

import pandas as pd

from ghgs_lit.config.keys import ABLATIONS
from ghgs_lit.errors import InputError, require, require_choice
from ghgs_lit.evaluation.tables.cells import fill
from ghgs_lit.evaluation.tables.layouts import Group, Layout, Line, Table, TableOptions, data_title, paper
from ghgs_lit.evaluation.tables.notes import write_caption, write_notes
from ghgs_lit.evaluation.tables.runs import SETTING, TRAINING, Planned, Sweep
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
#: Titles of models that are modelled on other methods.
PEERS = {"gps": "After GPS-Gaussian", "pixel": "Pixel-aligned"}
#: Kinds of measured rows from top to bottom.
_KINDS = ("baseline", "other", "model")
#: Columns of measurements that are not metrics.
_FACTS = {*SETTING, "variant", "views", "trained_views", "seed", "source", "run", "git", "subject"}
_FACTS |= {"count", "origin", "trained"}


def build_tables(sweep: Sweep, others: Sequence[pd.DataFrame], options: TableOptions) -> list[Table]:
    """Build the tables of a sweep: one for each setting and, if rows are ablations, each model.

    Args:
        sweep: Our runs.
        others: Results of other methods, one frame for each file.
        options: Content of the tables.

    Returns:
        Tables in the order in which their settings first appear.

    Raises:
        InputError: Nothing was measured on these targets, two runs have the same cell, configurations
            in a cell differ, or results of other methods fit no table.
    """
    layout = options.layout
    if others and layout.rows == "ablation":
        raise InputError(f"others: expected layout=table1, table2 or table3; found {layout.name}")
    sweep = _select_runs(sweep, options)
    ours = sweep.rows
    if options.subjects is not None:
        ours = _select_subjects(ours, options.subjects, "the runs")
        others = [_select_subjects(rows, options.subjects, rows["source"].iloc[0]) for rows in others]
    if options.targets:
        expected = f"some of {', '.join(dict.fromkeys(ours['targets']))}, on which the runs were measured"
        ours = ours[ours["targets"].isin(options.targets)]
        require(len(ours), "evaluation.targets", expected, list(options.targets))
    rows = pd.concat([ours, *others], ignore_index=True)
    known = [name for name in rows if name not in _FACTS and rows[name].notna().any()]
    for name in options.metrics or ():
        require_choice("columns", name, tuple(known))
    same = [name for name in SETTING if layout.columns != "data" or name != "data"]
    if layout.rows == "ablation":
        rows["trained"] = [variant.trained for variant in rows["variant"]]
        same.append("trained")
    parts = [part for _, part in rows.groupby(same, sort=False) if part.index[0] < len(ours)]
    shown = set().union(*(part["source"] for part in parts))
    for source, theirs in rows[len(ours) :].groupby("source", sort=False):
        if source not in shown:
            keys = [_describe(part, same) for part in parts]
            raise InputError(f"{source}: expected results on one of {keys}; found {_describe(theirs, same)}")
    return [_build_table(part, sweep, options) for part in parts]


def _describe(rows: pd.DataFrame, names: list[str]) -> str:
    return ", ".join(f"{name}={rows.iloc[0][name]}" for name in names)


def _select_subjects(rows: pd.DataFrame, names: re.Pattern[str], where: str) -> pd.DataFrame:
    """Rows of the subjects whose whole names match, and means, which have no subject."""
    is_kept = [not isinstance(name, str) or names.fullmatch(name) is not None for name in rows["subject"]]
    expected = f"a match with the whole name of a subject of {where}, such as {rows['subject'].iloc[0]}"
    require(any(is_kept), "subjects", expected, names.pattern)
    return rows[is_kept]


def _select_runs(sweep: Sweep, options: TableOptions) -> Sweep:
    """Select the runs of a layout.

    They have its numbers of views and, if any run has, the paper's data. Tables of ablations exclude
    baselines; tables of methods exclude the paper's ablations.
    """
    layout = options.layout
    views = options.views or layout.views
    rows = sweep.rows[sweep.rows["views"].isin(views)]
    known = ", ".join(map(str, sorted(set(sweep.rows["views"]))))
    require(len(rows), "evaluation.views", f"some of {known}, as the runs were measured", list(views))
    on_paper = _reported_data(layout)
    has_papers = any(data_title(name) in on_paper for name in rows["data"])

    def belongs(variant: Variant, data: str) -> bool:
        if has_papers and data_title(data) not in on_paper:
            return False
        if layout.rows == "ablation":
            return variant.kind == "model"
        return variant.kind != "model" or variant.ablation == "full" or variant.is_own

    rows = rows[list(map(belongs, rows["variant"], rows["data"]))]
    require(len(rows), "runs", f"runs of layout={layout.name}", "baselines or the paper's ablations only")
    planned = [run for run in sweep.planned if belongs(run.variant, run.data)]
    planned = [run for run in planned if run.views is None or set(run.views) & set(views)]
    return replace(sweep, rows=rows, planned=planned)


def _reported_data(layout: Layout) -> list[str]:
    return paper()["tables"][layout.reported]["data"].split(" and ") if layout.reported else []


def _build_table(rows: pd.DataFrame, sweep: Sweep, options: TableOptions) -> Table:
    layout = options.layout
    is_ablation = layout.rows == "ablation"
    trained = {variant.trained for variant in rows["variant"]}
    planned = [run for run in sweep.planned if layout.columns == "data" or run.data in set(rows["data"])]
    planned = [run for run in planned if not is_ablation or run.variant.trained in trained]
    models = rows[[variant.kind == "model" for variant in rows["variant"]]]
    models = rows if models.empty else models
    has_lpips = "lpips" in models and models.groupby("source")["lpips"].count().all()
    metrics = list(options.metrics or ("psnr", "ssim", "lpips" if has_lpips else "flip"))
    place = {variant: i for i, variant in enumerate(sweep.order)}
    variants = dict.fromkeys([*rows["variant"], *(run.variant for run in planned)])
    variants = sorted(variants, key=lambda v: (_KINDS.index(v.kind), place.get(v, len(place))))
    stub = ("3D Unproj.", "Semantic Cons.") if is_ablation else ("Methods",)
    lines = _ablation_lines(variants) if is_ablation else _method_lines(variants)
    groups = _make_groups(rows, planned, options)
    left_out = len(sweep.configs.keys() - set(sweep.rows["source"]))
    table = Table(options, rows, planned, sweep.configs, stub, groups, metrics, lines, left_out)
    if layout.reported and options.reported:
        table.reported_on = paper()["tables"][layout.reported]["data"]
        table.lines = [*_reported_lines(layout), *lines]
    if is_ablation and any(variant.is_own for variant in variants):
        table.stub = ("Ablation", *stub)
        table.lines = [line._replace(stub=(line.variant.ablation, *line.stub)) for line in table.lines]
    if options.test.metrics is None:
        table.tested = [name for name in metrics if name not in TRAINING][:1]
    else:
        chosen = options.test.metrics
        table.tested = [chosen] if isinstance(chosen, str) else list(chosen)
    fill(table)
    table.caption = write_caption(table)
    table.notes = write_notes(table)
    return table


def _make_groups(rows: pd.DataFrame, planned: list[Planned], options: TableOptions) -> list[Group]:
    layout = options.layout
    views = options.views or layout.views
    if layout.columns == "views":
        name = data_title(rows["data"].iloc[0])
        return [Group(name if layout.heading == "data" else f"{n}-view", n) for n in views]
    names = _reported_data(layout) if options.reported else []
    titles = dict.fromkeys(map(data_title, [*names, *rows["data"], *(run.data for run in planned)]))
    text = "{}, {}-view" if len(views) > 1 else "{}"
    return [Group(text.format(name, n), n, name) for name, n in itertools.product(titles, views)]


def _signs(switches: tuple[bool, bool]) -> tuple[str, ...]:
    return tuple("✓" if on else "✗" for on in switches)


def _reported_lines(layout: Layout) -> list[Line]:
    switches = {name: pair for pair, name in ABLATIONS.items()}
    lines = []
    for method in paper()["tables"][layout.reported]["rows"]:
        pair = switches.get(method)
        variant = Variant("reported", method, ablation="" if pair is None else method, switches=pair)
        lines.append(Line(variant, _signs(pair) if pair else (method,)))
    return lines


def _ablation_lines(variants: list[Variant]) -> list[Line]:
    """Rows of the paper's four ablations, then of user-defined ones."""
    papers = [replace(variants[0], ablation=name, switches=pair) for pair, name in ABLATIONS.items()]
    lines = []
    for variant in (*papers, *(variant for variant in variants if variant.is_own)):
        unprojection, semantic = _signs(variant.switches)
        note = " (a)" if variant.switches[1] and not variant.has_semantics else ""
        lines.append(Line(variant, (unprojection, semantic + note)))
    return lines


def _method_lines(variants: list[Variant]) -> list[Line]:
    """Rows of baselines, other methods and our models, which are named by their differences."""
    models = [variant for variant in variants if variant.kind == "model"]
    parts = [[v.model, v.encoder, v.ablation, *v.titles] for v in models]
    differs = [len(set(values)) > 1 for values in zip(*parts, strict=True)]
    names = {variant: BASELINES.get(variant.name, variant.name) for variant in variants}
    for variant, values in zip(models, parts, strict=True):
        titles = [value for value in itertools.compress(values, differs) if value not in PEERS]
        details = f" ({', '.join(titles)})" if titles else ""
        names[variant] = PEERS.get(variant.model, "Ours") + details
    return [Line(variant, (name,)) for variant, name in names.items()]
