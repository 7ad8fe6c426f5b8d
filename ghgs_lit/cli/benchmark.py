"""``ghgs benchmark``: measure run time and error of every preset."""

import itertools
import json
import math
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

import lightning.pytorch as L
import torch

from ghgs_lit.cli.inputs import build_data, choices, overrides, pick_device, with_trained_data
from ghgs_lit.cli.runtime import announce, output_dir, write_config
from ghgs_lit.config.compose import read_options
from ghgs_lit.config.keys import is_below, key_of
from ghgs_lit.diagnostics.benchmark import report
from ghgs_lit.diagnostics.benchmark.cases import KNOBS, YARDSTICK, Case, cases_of
from ghgs_lit.diagnostics.benchmark.measure import record_cases
from ghgs_lit.diagnostics.machine import in_words, machine_facts
from ghgs_lit.diagnostics.output import document, print_tables
from ghgs_lit.errors import InputError
from ghgs_lit.files import write_text_atomically
from ghgs_lit.runs.results import plain, provenance
from ghgs_lit.types import Batch
from ghgs_lit.weights.checkpoint import read_config

if TYPE_CHECKING:
    from ghgs_lit.cli.verbs import Benchmark

#: Nodes of :data:`KNOBS` that may be set next to a checkpoint, which brings its own model.
_APPLIED = ("skip", "renderer", "precision")


def run(verb: "Benchmark") -> None:
    """Measure the presets on the first subjects of the split; print and write the tables.

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
    cases = configured_cases(verb, device)
    data = build_data(verb)
    data.prepare_data([verb.split])
    number = verb.subjects and math.ceil(verb.subjects / data.dataset.batch_size)
    loader = itertools.islice(data.evaluation_loader(split=verb.split), number)
    batches: list[Batch] = [batch.to(device) for batch in loader]
    if batches[0].targets is None:
        raise InputError(f"targets={verb.targets.name}: expected target photographs; found none")
    records = record_cases(cases, batches, verb.metrics.build().to(device), device, verb.timing.repeats)
    rows = report.rows_of(records)
    broken = list(itertools.chain.from_iterable(map(report.broken_budgets, report.totals(rows))))
    machine = machine_facts(device)
    tables = report.tables_of(rows)
    _, views, _, height, width = batches[0].images.shape
    size = sum(p.numel() for p in cases[0].predictor.model.parameters()) / 1e6
    weights = verb.checkpoint or f"{choices().get('encoder', 'encoder')}, random weights"
    about = (
        f"{weights} ({size:.1f} M parameters, precision {verb.precision}); "
        f"{sum(len(batch.images) for batch in batches)} subjects of {data.dataset.name}, "
        f"{views} views of {height} x {width}"
    )
    notes = [f"Machine: {in_words(machine)}.", about]
    if verb.checkpoint is None:
        notes.append("The weights are random: only run times and differences are meaningful, not PSNR.")
    notes += [f"Budget broken: {line}." for line in broken]
    content = {
        "machine": machine,
        "about": about,
        "random_weights": verb.checkpoint is None,
        "rows": rows,
        "broken": broken,
        "subjects": list(itertools.chain.from_iterable(record.metrics for record in records)),
        "provenance": provenance(verb.plain, seed=verb.seed, verb="benchmark", choices=choices()),
    }
    print_tables(tables)
    write_text_atomically(directory / "benchmark.md", document("Benchmark", notes, tables))
    path = directory / "benchmark.json"
    write_text_atomically(path, json.dumps(plain(content), indent=1, allow_nan=False) + "\n")
    announce(path)
    for line in broken:
        print(f"ghgs benchmark: {line}", file=sys.stderr)
    if broken:
        raise SystemExit(1)


def check_options(run: "Benchmark", given: Sequence[str]) -> None:
    """Refuse options of the model next to a checkpoint.

    Args:
        run: as configured.
        given: overrides of the command line.

    Raises:
        InputError: names the first such key.
    """
    of_model = [name for name in (*KNOBS, "ablation", "compat") if name not in _APPLIED]
    for key in map(key_of, given if run.checkpoint else ()):
        if is_below(key, of_model):
            raise InputError(f"{key}: expected no option of the model with a checkpoint (knobs={{...}})")


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
    of_model = config if path is None else read_config(path)
    of_model = {**of_model, "renderer": config["renderer"], "precision": config["precision"]}
    return cases_of(of_model, path, presets, config["knobs"] or {}, device, run.seed)
