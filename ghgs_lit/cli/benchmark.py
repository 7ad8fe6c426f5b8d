"""``ghgs benchmark``: run time against error of the presets of ``skip``."""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import lightning.pytorch as L
import numpy as np
import pandas as pd
import torch

from ghgs_lit.cli.inputs import build_data, choices, overrides, pick_device, with_trained_data
from ghgs_lit.cli.reports import Tables, pivot, print_tables, publish, texts
from ghgs_lit.cli.runtime import output_dir, write_config
from ghgs_lit.config.compose import read_options
from ghgs_lit.config.keys import is_below, key_of
from ghgs_lit.diagnostics.benchmark.cases import KNOBS, REFERENCE, Case, make_cases
from ghgs_lit.diagnostics.benchmark.measure import TOTAL, Record, record_cases
from ghgs_lit.diagnostics.machine import in_words, machine_facts
from ghgs_lit.errors import InputError
from ghgs_lit.runs.results import Row, provenance, summarize
from ghgs_lit.types import Batch
from ghgs_lit.weights.checkpoint import read_config

if TYPE_CHECKING:
    from ghgs_lit.cli.verbs import Benchmark

#: Metrics besides PSNR in the row ``total`` of a case, if known.
ERRORS = (
    "psnr_box", "ssim", "ssim_box", "flip", "flip_box", "lpips", "psnr_box_40", "psnr_edge", "spill",
    "sharpness", "depth_error_mm",
)  # fmt: skip
#: Columns and formats of the table of cases, by heading.
_COLUMNS = {
    "preset": ("preset", "{}"),
    "s (quartiles)": ("quartiles", "{}"),
    "speed-up": ("speed_up", "{:.2f}"),
    "peak MB": ("peak_mb", "{:.0f}"),
    "GFLOP": ("gflop", "{:.2f}"),
    "tokens": ("tokens", "{:.0f}"),
    "points": ("points", "{:.0f}"),
    "Gaussians": ("gaussians", "{:.0f}"),
    "PLY MB": ("ply_mb", "{:.2f}"),
    "max rel diff": ("max_rel_diff", "{:.1e}"),
    "over condition": ("rel_diff", "{:.1e}"),
    "PSNR": ("psnr", "{:.2f}"),
    "loss dB": ("psnr_loss_db", "{:+.3f}"),
    "psnr_box": ("psnr_box", "{:.2f}"),
    "ssim": ("ssim", "{:.4f}"),
    "flip": ("flip", "{:.4f}"),
    "depth_error_mm": ("depth_error_mm", "{:.1f}"),
    "budget dB": ("budget_db", "{:.3f}"),
    "budget": ("budget", "{}"),
}

#: Nodes of :data:`KNOBS` that may be set with a checkpoint, which has its own model
_APPLIED = ("skip", "renderer", "precision")


def run(verb: "Benchmark") -> None:
    """Measure the presets on the first subjects of the split; print and write the tables.

    Args:
        verb: the configuration of the run.

    Raises:
        InputError: the configuration, a checkpoint or the data is wrong.
        SystemExit: code 1: a preset exceeds its budget.
    """
    directory = output_dir()
    verb = with_trained_data(verb)
    write_config(verb, directory)
    check_options(verb, overrides())
    L.seed_everything(verb.seed, workers=True, verbose=False)
    device = pick_device(verb.device)
    cases = cases_of(verb, device)
    data = build_data(verb)
    data.prepare_data([verb.split])
    number = verb.subjects and math.ceil(verb.subjects / data.dataset.batch_size)
    loader = itertools.islice(data.evaluation_loader(split=verb.split), number)
    batches: list[Batch] = [batch.to(device) for batch in loader]
    if batches[0].targets is None:
        raise InputError(f"targets={verb.targets.name}: expected target photographs; found none")
    records = record_cases(cases, batches, verb.metrics.build().to(device), device, verb.timing.repeats)
    rows = make_rows(records)
    broken = {row["preset"]: broken_budgets(row) for row in rows if row["stage"] == TOTAL}
    failures = [f"{preset}: {reason}" for preset, reasons in broken.items() for reason in reasons]
    machine = machine_facts(device)
    _, views, _, height, width = batches[0].images.shape
    size = sum(p.numel() for p in cases[0].predictor.model.parameters()) / 1e6
    weights = verb.checkpoint or f"{choices().get('encoder', 'encoder')}, random weights"
    about = (
        f"{weights} ({size:.1f} M parameters, precision {verb.precision}); "
        f"{sum(len(batch.images) for batch in batches)} subjects of {data.dataset.name}, "
        f"{views} views of {height} x {width}"
    )
    notes = ["Benchmark", f"Machine: {in_words(machine)}.", about]
    if verb.checkpoint is None:
        notes.append("The weights are random: only run times and differences are meaningful, not PSNR.")
    notes += [f"Budget broken: {line}." for line in failures]
    content = {
        "machine": machine,
        "about": about,
        "random_weights": verb.checkpoint is None,
        "rows": rows,
        "broken": failures,
        "subjects": [row for record in records for row in record.metrics],
        "provenance": provenance(verb.plain, seed=verb.seed, verb="benchmark", choices=choices()),
    }
    tables = make_tables(pd.DataFrame(rows), broken)
    print_tables(tables)
    publish(directory, "benchmark", notes, tables, content, failures)


def make_rows(records: Sequence[Record]) -> list[Row]:
    """Rows of the tables and of ``benchmark.json``, one for each case (the reference first) and stage. The
    row ``total`` also has costs, errors and budgets."""
    rows: list[Row] = []
    psnr_of_none = summarize(records[0].metrics)[0]["psnr"]
    for record in records:
        (means,) = summarize(record.metrics)
        costs = pd.DataFrame(record.costs)
        changes = pd.DataFrame(record.changes)
        worst = changes.max(skipna=False).to_dict() | {"psnr_to_none": changes.psnr_to_none.min()}
        total = {
            **costs.mean().to_dict(),
            "peak_bytes": float(costs.peak_bytes.max()),
            **{name: worst[name] for name in ("max_rel_diff", "rel_diff")},
            "psnr": means["psnr"],
            "psnr_loss_db": psnr_of_none - means["psnr"],
            "difference_db": difference_db(worst["mse_to_none"], psnr_of_none),
            "budget_db": record.case.budget_db,
            "max_rel_diff_budget": record.case.max_rel_diff,
            "trained": record.case.is_trained,
            **{name: means[name] for name in ERRORS if name in means},
            "differences": worst,
        }
        for stage, seconds in record.seconds.items():
            low, median, high = np.quantile(seconds, (0.25, 0.5, 0.75)).tolist()
            row = {"preset": record.case.label, "stage": stage, "seconds": median}
            row |= {"seconds_low": low, "seconds_high": high, "psnr": None}
            rows.append(row | total if stage == TOTAL else row)
    return rows


def difference_db(mse: float, psnr: float) -> float:
    """PSNR in dB, at least 0, that renders lose by a difference that is independent of their error. Unlike
    the loss against the target images, it cannot be 0 or negative by chance.

    Args:
        mse: mean squared difference of the renders, of colours in [0, 1].
        psnr: of the renders without the difference, in dB.
    """
    return 10 * math.log10(1 + mse * 10 ** (psnr / 10))


def broken_budgets(row: Row) -> list[str]:
    """Reasons why a row ``total`` exceeds its budgets. PSNR is checked for trained weights only."""
    lines = []
    loss = row["psnr_loss_db"]
    if (limit := row["max_rel_diff_budget"]) is not None:
        loss = max(loss, row["difference_db"])
        missing = row["differences"]["unmatched"]
        if not row["rel_diff"] <= limit:
            lines.append(f"expected rel_diff up to max_rel_diff={limit:g}; found {row['rel_diff']:g}")
        if missing > 0:
            lines.append(f"expected the Gaussians of none; found {missing:.2%} others")
    limit = row["budget_db"]
    if row["trained"] and limit is not None and not loss <= limit:
        lines.append(f"expected a loss up to {limit:g} dB of PSNR; found {loss:.3g}")
    return lines


def make_tables(rows: pd.DataFrame, broken: Mapping[str, Sequence[str]]) -> Tables:
    """Tables of cost and error of the cases, and of the seconds of their stages.

    Args:
        rows: of :func:`make_rows`.
        broken: :func:`broken_budgets` of each case, by its label.
    """
    whole = rows[rows.stage == TOTAL]
    has_budget = whole.max_rel_diff_budget.notna() | (whole.trained.astype(bool) & whole.budget_db.notna())
    times = whole[["seconds", "seconds_low", "seconds_high"]].itertuples(index=False)
    cases = whole.assign(
        quartiles=["{:.3f} ({:.3f} to {:.3f})".format(*quartiles) for quartiles in times],
        speed_up=whole.seconds.iloc[0] / whole.seconds,
        peak_mb=whole.peak_bytes.astype(float) / 1e6,
        gflop=whole.flops.astype(float) / 1e9,
        ply_mb=whole.ply_bytes / 1e6,
        budget=np.select([whole.preset.map(broken).astype(bool), has_budget], ["broken", "kept"], "-"),
    )
    stages = pivot(rows, "preset", "stage", "seconds", "{:.4f}")
    return {"Presets": texts(cases, _COLUMNS), "Seconds by stage": stages}


def check_options(run: "Benchmark", given: Sequence[str]) -> None:
    """Reject options of the model if there is a checkpoint.

    Args:
        run: its configuration.
        given: overrides of the command line.

    Raises:
        InputError: with the first such key.
    """
    of_model = [name for name in (*KNOBS, "ablation", "compat") if name not in _APPLIED]
    for key in map(key_of, given if run.checkpoint else ()):
        if is_below(key, of_model):
            raise InputError(f"{key}: expected no option of the model with a checkpoint (knobs={{...}})")


def cases_of(run: "Benchmark", device: torch.device) -> list[Case]:
    """The model with every preset and the reference.

    Args:
        run: its configuration.
        device: of the models.

    Raises:
        FileNotFoundError: there is no such checkpoint.
        InputError: a preset or knob does not exist, or the weights do not fit it.
    """
    names = dict.fromkeys([REFERENCE, *run.presets])
    presets = read_options("skip", list(names), run, "presets")
    config = run.plain
    if run.checkpoint is not None:
        applied = {key: config[key] for key in ("renderer", "precision")}
        config = {**read_config(run.checkpoint), **applied}
    return make_cases(config, run.checkpoint, presets, run.knobs or {}, device, run.seed)
