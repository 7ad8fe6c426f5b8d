"""``ghgs benchmark``: measure run time and error of every preset."""

import itertools
import math
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import lightning.pytorch as L
import torch

from ghgs_lit.cli.inputs import build_data, choices, overrides, pick_device, with_trained_data
from ghgs_lit.cli.runtime import announce, output_dir, write_config
from ghgs_lit.config.compose import read_options
from ghgs_lit.config.keys import is_below
from ghgs_lit.diagnostics.benchmark import report
from ghgs_lit.diagnostics.benchmark.measure import record_cases
from ghgs_lit.diagnostics.benchmark.presets import KNOBS, YARDSTICK, Case, Source, cases_of
from ghgs_lit.diagnostics.machine import machine_facts
from ghgs_lit.diagnostics.output import print_tables
from ghgs_lit.errors import InputError
from ghgs_lit.runs.provenance import provenance
from ghgs_lit.types import Batch
from ghgs_lit.weights.checkpoint import read_config

if TYPE_CHECKING:
    from ghgs_lit.cli.verbs import Benchmark


def run(verb: "Benchmark") -> None:
    """Measure the presets, print the tables and write them.

    Args:
        verb: the run.

    Raises:
        InputError: the configuration, a checkpoint or the data is wrong.
        SystemExit: code 1: a preset exceeds its error budget.
    """
    directory = output_dir()
    verb = with_trained_data(verb)
    write_config(verb, directory)
    check_options(verb, overrides())
    L.seed_everything(verb.seed, workers=True, verbose=False)
    device = pick_device(verb.device)
    torch.set_num_threads(verb.threads or torch.get_num_threads())
    content = _presets(configured_cases(verb, device), verb, device)
    content = {"machine": machine_facts(device), **content}
    tables = report.tables_of(content["rows"])
    print_tables(tables)
    source = provenance(verb.plain, seed=verb.seed, verb="benchmark", choices=choices())
    announce(report.write_numbers(directory, {**content, "provenance": source}, tables))
    if content["broken"]:
        for line in content["broken"]:
            print(f"ghgs benchmark: {line}", file=sys.stderr)
        raise SystemExit(1)


def check_options(run: "Benchmark", given: Sequence[str]) -> None:
    """Refuse options of the model beside a checkpoint, which brings its own model.

    Args:
        run: as configured.
        given: overrides of the command line.

    Raises:
        InputError: names the first such key.
    """
    if run.checkpoint is None:
        return
    for key in (text.split("=", 1)[0].lstrip("+~") for text in given):
        if is_below(key, [name for name in (*KNOBS, "ablation", "compat") if name not in _APPLIED]):
            raise InputError(f"{key}: expected no option of the model beside a checkpoint (knobs={{...}})")


#: Nodes of :data:`KNOBS` that may be set beside a checkpoint.
_APPLIED = ("skip", "renderer", "precision")


def configured_cases(run: "Benchmark", device: torch.device) -> list[Case]:
    """The model in every preset, always including the yardstick.

    Args:
        run: as configured.
        device: where the models are.

    Raises:
        FileNotFoundError: there is no such checkpoint.
        InputError: a preset or knob does not exist, or the weights do not fit it.
    """
    config = run.plain
    names = dict.fromkeys([YARDSTICK, *run.presets])
    presets = read_options("skip", list(names), run, "presets")
    path = run.checkpoint
    source = Source(config if path is None else read_config(path), path)
    shared = {name: config[name] for name in ("renderer", "precision")}
    return cases_of(source, presets, config["knobs"] or {}, shared, device, run.seed)


def _presets(cases: list[Case], run: "Benchmark", device: torch.device) -> dict[str, Any]:
    """Measure cases on the first subjects of the split.

    Args:
        cases: the yardstick first.
        run: as configured.
        device: where the models are.

    Returns:
        Content of ``benchmark.json`` without machine and provenance: ``about``, ``random_weights``,
        ``rows`` (:func:`report.rows_of`), ``broken`` budgets, and ``subjects``: the metrics of every picture.

    Raises:
        InputError: the data has no target photographs, or is wrong.
    """
    data = build_data(run)
    data.prepare_data([run.split])
    loader = data.evaluation_loader(split=run.split)
    number = run.subjects and math.ceil(run.subjects / data.dataset.batch_size)
    batches: list[Batch] = [batch.to(device) for batch in itertools.islice(loader, number)]
    if batches[0].targets is None:
        raise InputError(f"targets={run.targets.name}: expected target photographs; found none")
    metrics = run.metrics.build().to(device)
    records = record_cases(cases, batches, metrics, device, run.timing.repeats)
    rows = report.rows_of(records)
    _, views, _, height, width = batches[0].images.shape
    subjects = sum(len(batch.images) for batch in batches)
    number = sum(p.numel() for p in cases[0].predictor.model.parameters()) / 1e6
    weights = run.checkpoint or f"{choices().get('encoder', 'encoder')}, random weights"
    weights = f"{weights} ({number:.1f} M parameters, precision {run.precision})"
    photographs = f"{subjects} subjects of {data.dataset.name}, {views} views of {height} x {width}"
    return {
        "about": f"{weights}; {photographs}",
        "random_weights": run.checkpoint is None,
        "rows": rows,
        "broken": report.broken_budgets(rows),
        "subjects": list(itertools.chain.from_iterable(record.metrics for record in records)),
    }
