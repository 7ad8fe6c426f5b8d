"""Tables from runs: selection of runs, rows, columns and cells."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import compress, product
from typing import Any

import pandas as pd

from ghgs_lit.config.keys import ABLATIONS
from ghgs_lit.errors import require, require_choice
from ghgs_lit.evaluation.tables.cells import fill
from ghgs_lit.evaluation.tables.layouts import LAYOUTS, Group, Layout, Line, Table, data_title, paper
from ghgs_lit.evaluation.tables.runs import OF_TRAINING_TARGETS, SETTING, Sweep, Variant

BASELINES = {
    "nearest_view": "Nearest input view",
    "hull": "Discs on the visual hull",
    "photo_depth": "Discs at the photo-consistent depth",
    "per_scene": "Per-scene 3DGS",
    "true_depth": "Discs at the true depth",
}
#: Titles of models that are modelled on other methods.
PEERS = {"gps": "After GPS-Gaussian", "pixel": "Pixel-aligned"}
#: Columns of measurements that are not metrics.
_FACTS = {*SETTING, "variant", "views", "trained_views", "seed", "source", "run", "git", "subject", "trained"}


def build_tables(
    sweep: Sweep,
    layout: Layout,
    views: Sequence[int] | None = None,
    targets: Sequence[str] | None = None,
    metrics: Sequence[str] | None = None,
    reported: bool = True,
    unit: str | None = None,
) -> list[Table]:
    """Build the tables of a sweep: one for each setting and, if rows are ablations, each model.

    Args:
        sweep: Runs.
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
        InputError: Nothing was measured on these targets, two runs have the same cell, or
            configurations in a cell differ.
    """
    layout = layout._replace(views=tuple(views or layout.views))
    rows = _select(sweep.rows, layout, targets)
    is_planned = rows["subject"].isna()
    measured = rows[~is_planned]
    for name in metrics or ():
        known = [name for name in measured if name not in _FACTS and measured[name].notna().any()]
        require_choice("columns", name, known)
    # Columns of a planned run that decide to which table it belongs.
    known_before = ["data"] * (layout.columns != "data") + ["trained"] * (layout.rows == "ablation")
    tables = []
    finished = set(sweep.rows["source"][sweep.rows["subject"].notna()]) & sweep.configs.keys()
    left_out = len(finished - set(measured["source"]))
    for _, part in measured.groupby([*known_before, *SETTING[1:]], sort=False):
        planned = rows[is_planned]
        for name in known_before:
            planned = planned[planned[name].isin(part[name])]
        tables.append(_build_table(part, planned, sweep, layout, left_out, metrics, reported, unit))
    return tables


def _select(rows: pd.DataFrame, layout: Layout, targets: Sequence[str] | None) -> pd.DataFrame:
    """Select rows, planned ones too, by views, targets, and if any has, the paper's data.

    Tables of ablations exclude baselines; tables of methods exclude the paper's ablations.
    """
    for name, values in {"views": layout.views, "targets": targets}.items():
        measured = rows[name][rows["subject"].notna()]
        if values:
            expected = f"some of {', '.join(map(str, measured.unique()))}, as the runs were measured"
            require(measured.isin(values).any(), f"evaluation.{name}", expected, list(values))
            rows = rows[rows[name].isin(values) | rows[name].isna()]
    on_paper = rows["data"].map(data_title).isin(_find_reported_data(layout))
    if (on_paper & rows["subject"].notna()).any():
        rows = rows[on_paper]
    variants = rows["variant"]
    if layout.rows == "ablation":
        belongs = [variant.kind == "model" for variant in variants]
    else:
        belongs = [variant.ablation in ("", "full") or variant.is_own for variant in variants]
    rows = rows[belongs].assign(trained=[variant.trained for variant in variants[belongs]])
    expected = f"runs of layout={layout.name}"
    require(rows["subject"].notna().any(), "runs", expected, "baselines or the paper's ablations only")
    return rows


def _find_reported_data(layout: Layout) -> list[str]:
    table = paper()["tables"].get(layout.name)
    return table["data"].split(" and ") if table else []


def _build_table(
    rows: pd.DataFrame,
    planned: pd.DataFrame,
    sweep: Sweep,
    layout: Layout,
    left_out: int,
    metrics: Sequence[str] | None,
    reported: bool,
    unit: str | None,
) -> Table:
    if not metrics:
        models = rows[[variant.kind == "model" for variant in rows["variant"]]]
        models = rows if models.empty else models
        has_lpips = "lpips" in models and models.groupby("source")["lpips"].count().all()
        metrics = ("psnr", "ssim", "lpips" if has_lpips else "flip")
    every = pd.concat([rows, planned])
    reported_on = _find_reported_data(layout) if reported else []
    published = list(map(_reported_variant, paper()["tables"][layout.name]["rows"])) if reported_on else []
    variants = sorted(every["variant"].unique(), key=lambda variant: variant.kind)  # baselines, then models
    stub, lines = (_name_ablations if layout.rows == "ablation" else _name_methods)(published, variants)
    groups = _make_groups(layout, every["data"].unique(), reported_on)
    protocol = rows["targets"].iloc[0]
    configs = {path: _without_other_targets(config, protocol) for path, config in sweep.configs.items()}
    table = Table(layout, rows, planned, configs, left_out, list(metrics), reported_on, groups, stub, lines)
    fill(table, unit)
    return table


def _without_other_targets(config: Mapping[str, Any], protocol: str) -> Mapping[str, Any]:
    """A configuration without the values of targets, if they are not those of the measured protocol."""
    targets = config.get("targets")
    if not isinstance(targets, Mapping) or targets.get("name") == protocol:
        return config
    return {**config, "targets": {key: targets.get(key) for key in OF_TRAINING_TARGETS}}


def _make_groups(layout: Layout, names: Sequence[str], reported: list[str]) -> list[Group]:
    """Groups of columns, given the names of the measured data sets and the titles of reported ones."""
    if layout.columns == "data":
        titles = dict.fromkeys([*reported, *map(data_title, names)])
        text = "{}, {}-view" if len(layout.views) > 1 else "{}"
        return [Group(text.format(name, n), n, name) for name, n in product(titles, layout.views)]
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
    """Heading and rows of reported methods, baselines and our models, which are named by their
    differences."""
    names = {variant: f"† {variant.name}" for variant in reported}
    names |= {variant: BASELINES.get(variant.name, variant.name) for variant in measured}
    models = [variant for variant in measured if variant.kind == "model"]
    parts = [[v.model, v.encoder, v.ablation, *v.extra] for v in models]
    differs = [len(set(values)) > 1 for values in zip(*parts, strict=True)]
    for variant, values in zip(models, parts, strict=True):
        titles = [value for value in compress(values, differs) if value not in PEERS]
        details = f" ({', '.join(titles)})" if titles else ""
        names[variant] = PEERS.get(variant.model, "Ours") + details
    return ("Methods",), [Line(variant, (name,)) for variant, name in names.items()]
