"""Assembly of tables from measurements: selection of runs, rows and columns."""

import itertools
import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pandas as pd

from ghgs_lit.config.keys import ABLATIONS
from ghgs_lit.errors import InputError, require, require_choice
from ghgs_lit.evaluation.tables.cells import fill
from ghgs_lit.evaluation.tables.layouts import LAYOUTS, Group, Layout, Line, Table, data_title, paper
from ghgs_lit.evaluation.tables.runs import SETTING, Sweep
from ghgs_lit.evaluation.tables.variants import Variant

BASELINES = {
    "black": "Black image",
    "nearest_view": "Nearest input view",
    "hull": "Discs on the visual hull",
    "photo_depth": "Discs at the photo-consistent depth",
    "per_scene": "Per-scene 3DGS",
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


def build_tables(
    sweep: Sweep,
    others: Sequence[pd.DataFrame],
    layout: Layout,
    views: Sequence[int] | None = None,
    targets: Sequence[str] | None = None,
    metrics: Sequence[str] | None = None,
    reported: bool = True,
    unit: re.Pattern[str] | None = None,
) -> list[Table]:
    """Build the tables of a sweep: one for each setting and, if rows are ablations, each model.

    Args:
        sweep: Our runs.
        others: Results of other methods, one frame for each file.
        layout: Rows and columns.
        views: Numbers of input views; None: those of the layout.
        targets: Target protocols; None: those of the runs.
        metrics: Metrics, of which the first is tested; None: PSNR, SSIM and LPIPS, or FLIP where a run
            of a model has no LPIPS.
        reported: Whether the paper's figures are printed where the layout has some.
        unit: Regular expression whose first group is the person, if subjects are frames of people.

    Returns:
        Tables in the order in which their settings first appear.

    Raises:
        InputError: Nothing was measured on these targets, two runs have the same cell, configurations
            in a cell differ, or results of other methods fit no table.
    """
    if others and layout.rows == "ablation":
        raise InputError(f"others: expected layout=table1, table2 or table3; found {layout.name}")
    layout = layout._replace(views=tuple(views or layout.views))
    sweep = _select_runs(sweep, layout)
    ours = _select(sweep.rows, "targets", targets) if targets else sweep.rows
    rows = pd.concat([ours, *others], ignore_index=True)
    known = [name for name in rows if name not in _FACTS and rows[name].notna().any()]
    for name in metrics or ():
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
    return [_build_table(part, sweep, layout, metrics, reported, unit) for part in parts]


def _describe(rows: pd.DataFrame, names: list[str]) -> str:
    return ", ".join(f"{name}={rows.iloc[0][name]}" for name in names)


def _select(rows: pd.DataFrame, name: str, values: Sequence[Any]) -> pd.DataFrame:
    """Rows with one of some numbers of views, or targets."""
    chosen = rows[rows[name].isin(values)]
    known = ", ".join(map(str, rows[name].unique()))
    require(len(chosen), f"evaluation.{name}", f"some of {known}, as the runs were measured", list(values))
    return chosen


def _select_runs(sweep: Sweep, layout: Layout) -> Sweep:
    """Select the runs of a layout.

    They have its numbers of views and, if any run has, the paper's data. Tables of ablations exclude
    baselines; tables of methods exclude the paper's ablations.
    """
    rows = _select(sweep.rows, "views", layout.views)
    on_paper = _find_reported_data(layout)
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
    planned = [run for run in planned if set(run.views) & set(layout.views)]
    return replace(sweep, rows=rows, planned=planned)


def _find_reported_data(layout: Layout) -> list[str]:
    table = paper()["tables"].get(layout.name)
    return table["data"].split(" and ") if table else []


def _build_table(
    rows: pd.DataFrame,
    sweep: Sweep,
    layout: Layout,
    metrics: Sequence[str] | None,
    reported: bool,
    unit: re.Pattern[str] | None,
) -> Table:
    is_ablation = layout.rows == "ablation"
    trained = {variant.trained for variant in rows["variant"]}
    planned = [run for run in sweep.planned if layout.columns == "data" or run.data in set(rows["data"])]
    planned = [run for run in planned if not is_ablation or run.variant.trained in trained]
    if metrics is None:
        models = rows[[variant.kind == "model" for variant in rows["variant"]]]
        models = rows if models.empty else models
        has_lpips = "lpips" in models and models.groupby("source")["lpips"].count().all()
        metrics = ("psnr", "ssim", "lpips" if has_lpips else "flip")
    variants = dict.fromkeys([*rows["variant"], *(run.variant for run in planned)])
    variants = sorted(variants, key=lambda variant: _KINDS.index(variant.kind))
    reported_data = _find_reported_data(layout) if reported else []
    published = list(map(_reported_variant, paper()["tables"][layout.name]["rows"])) if reported_data else []
    stub, lines = (_name_ablations if is_ablation else _name_methods)(published, variants)
    groups = _make_groups(layout, [*rows["data"], *(run.data for run in planned)], reported_data)
    left_out = len(sweep.configs.keys() - set(sweep.rows["source"]))
    table = Table(layout, rows, planned, sweep.configs, stub, groups, list(metrics), lines, left_out, unit)
    table.reported_on = " and ".join(reported_data)
    fill(table)
    return table


def _make_groups(layout: Layout, names: list[str], reported: list[str]) -> list[Group]:
    """Groups of columns, given the names of the measured data sets and the titles of reported ones."""
    if layout.columns == "data":
        titles = dict.fromkeys([*reported, *map(data_title, names)])
        text = "{}, {}-view" if len(layout.views) > 1 else "{}"
        return [Group(text.format(name, n), n, name) for name, n in itertools.product(titles, layout.views)]
    is_alone = len(LAYOUTS[layout.name].views) == 1
    return [Group(data_title(names[0]) if is_alone else f"{n}-view", n) for n in layout.views]


def _reported_variant(method: str) -> Variant:
    switches = {name: pair for pair, name in ABLATIONS.items()}
    return Variant(
        "reported", method, ablation=method if method in switches else "", switches=switches.get(method)
    )


def _name_ablations(reported: list[Variant], measured: list[Variant]) -> tuple[tuple[str, ...], list[Line]]:
    """Headings and rows of reported ablations, the paper's four, and user-defined ones."""
    papers = [replace(measured[0], ablation=name, switches=pair) for pair, name in ABLATIONS.items()]
    custom = [variant for variant in measured if variant.is_own]
    lines = []
    for variant in (*reported, *papers, *custom):
        signs = ["✓" if on else "✗" for on in variant.switches]
        stub = [variant.ablation, *signs] if custom else signs
        if variant.kind == "reported":
            stub[0] = f"† {stub[0]}"
        lines.append(Line(variant, tuple(stub)))
    names = ("3D Unproj.", "Semantic Cons.")
    return ("Ablation", *names) if custom else names, lines


def _name_methods(reported: list[Variant], measured: list[Variant]) -> tuple[tuple[str, ...], list[Line]]:
    """Heading and rows of reported methods, baselines, other methods and our models, which are named by
    their differences."""
    names = {variant: f"† {variant.name}" for variant in reported}
    names |= {variant: BASELINES.get(variant.name, variant.name) for variant in measured}
    models = [variant for variant in measured if variant.kind == "model"]
    parts = [[v.model, v.encoder, v.ablation, *v.titles] for v in models]
    differs = [len(set(values)) > 1 for values in zip(*parts, strict=True)]
    for variant, values in zip(models, parts, strict=True):
        titles = [value for value in itertools.compress(values, differs) if value not in PEERS]
        details = f" ({', '.join(titles)})" if titles else ""
        names[variant] = PEERS.get(variant.model, "Ours") + details
    return ("Methods",), [Line(variant, (name,)) for variant, name in names.items()]
