"""A configured evaluation: check it, measure methods, print means, write the results of the run."""

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import LightningDataModule
from tabulate import tabulate

from ghgs_lit.config.compose import read_options
from ghgs_lit.config.keys import ablation_of
from ghgs_lit.config.run import Run
from ghgs_lit.data.datamodule import PhotographsDataModule
from ghgs_lit.data.sampling import TargetProtocol
from ghgs_lit.errors import require, require_choice
from ghgs_lit.evaluation.measure import Method, measure_all
from ghgs_lit.runs.results import METHOD, Row, provenance, summarize, write_results

#: Print a line once per process: runs of a sweep leave out the same metrics.
print_once = cache(print)
#: Printed metrics and their decimals.
PRINTED = {"psnr": 2, "psnr_box": 2, "psnr_edge": 2, "ssim": 4, "lpips": 4, "flip": 4}
PRINTED |= {"spill": 1, "sharpness": 2, "depth_error_mm": 1, "seconds": 2}
#: Units in the column heads of printed metrics whose names have none.
_UNITS = dict.fromkeys(("psnr", "psnr_box", "psnr_edge"), "\ndB") | {"spill": "\n‰"}


def target_protocols(run: Run) -> dict[str, dict[str, Any]]:
    """Read the protocols that ``evaluation.targets`` lists.

    Args:
        run: With the groups ``evaluation`` and ``targets``.

    Returns:
        Values of each protocol by name: those of its file in ``conf/targets``, or the configured ones
            for the protocol that ``targets=`` selects.

    Raises:
        InputError: There is no such file.
    """
    names = run.evaluation.targets
    protocols = read_options("targets", names, run, "evaluation.targets")
    return {
        name: {**values, "kind": values.get("kind") or values["name"], "name": name}
        for name, values in protocols.items()
    }


def check_evaluation(run: Run, data: PhotographsDataModule) -> None:
    """Check that an evaluation can be measured. Data is prepared, but no image is read.

    Args:
        run: With the groups ``evaluation``, ``metrics`` and ``targets``.
        data: The data that is measured.

    Raises:
        InputError: A value is impossible, a metric cannot be computed, the split has no subjects, or
            a subject lacks an input view or a target.
    """
    views = run.evaluation.views
    for key, values in (("views", views), ("targets", run.evaluation.targets)):
        shown = [] if values == () else values
        require(isinstance(values, tuple) and values != (), f"evaluation.{key}", "a list with a value", shown)
    require(len(set(views)) == len(views), "evaluation.views", "different numbers from 2 on", list(views))
    protocols = {
        name: TargetProtocol.read(values, "targets") for name, values in target_protocols(run).items()
    }
    run.metrics.build()
    split = run.evaluation.split
    require_choice("evaluation.split", split, data.dataset.split_names)
    data.prepare_data([split])
    require(len(data.subjects(split)) > 0, f"evaluation.split={split}", "a subject or more", "none")
    for count in views:
        for protocol in protocols.values():
            _check_targets(data, split, count, protocol)


def _check_targets(data: PhotographsDataModule, split: str, views: int, protocol: TargetProtocol) -> None:
    """Check that each subject has the target views of a protocol; the error names the first missing
    view."""
    reader = data.photographs(split).reader
    for batch in data.evaluation_loader(views=views, targets=protocol, split=split).dataset.groups:
        for sample in batch:
            for position, view in sample.targets:
                known = position in reader.subjects[sample.subject]
                there = reader.views_at(sample.subject, position) if known else []
                expected = f"view {view} of subject {sample.subject} at position {position}"
                require(view in there, f"evaluation.targets={protocol.name}", expected, there)


def measure_and_write(
    methods: Mapping[str, Method],
    data: LightningDataModule,
    run: Run,
    directory: Path,
    device: torch.device,
    /,
    **facts: Any,
) -> Path:
    """Measure methods as configured, print the means, and write the results.

    Writes ``metrics.json`` and ``pictures/``. Call :func:`check_evaluation` first.

    Args:
        methods: Methods by name; the trained model is called ``METHOD``.
        data: Provides ``evaluation_loader``, ``facts`` and ``dataset``.
        run: The configuration.
        directory: The run's directory.
        device: Device of prediction and metrics.
        **facts: Further provenance.

    Returns:
        Path of ``metrics.json``.

    Raises:
        InputError: A metric cannot be computed, or the split has no subjects.
    """
    evaluation = run.evaluation
    targets = target_protocols(run)
    metrics = run.metrics.build().to(device)
    for name, reason in metrics.left_out.items():
        print_once(f"{name} is left out: {reason}")
    views = list(evaluation.views)
    split = evaluation.split
    pictures = directory / "pictures", evaluation.pictures
    rows = measure_all(methods, data, views, targets, split, metrics, device, *pictures)
    if METHOD in methods:
        facts["ablation"] = ablation_of(run.plain)
    source = provenance(
        run.plain,
        seed=run.seed,
        data={**data.facts, **data.dataset.split_facts(split)},
        protocol={
            "metrics": metrics.protocol,
            "views": views,
            "targets": list(targets),
            "target_protocols": targets,
            "reported": metrics.names,
            "left_out": metrics.left_out,
        },
        **facts,
    )
    print(format_means(summarize(rows)), flush=True)
    return write_results(directory, rows, source)


def format_means(summary: Sequence[Row], form: str = "simple") -> str:
    """Format means over subjects as a table.

    Args:
        summary: Rows of :func:`ghgs_lit.runs.results.summarize`.
        form: Format of tabulate, such as ``simple`` (for a terminal) or ``github`` (Markdown).
    """
    names = [name for name in PRINTED if name in summary[0]]
    about = ["method", "views", "targets"]
    lines = []
    for mean in summary:
        numbers = ("-" if mean[name] is None else f"{mean[name]:.{PRINTED[name]}f}" for name in names)
        lines.append([*(mean[key] for key in about), *numbers])
    heads = [*about, *(name.replace("_", "\n") + _UNITS.get(name, "") for name in names)]
    align = ["left", "right", "left", *["right"] * len(names)]
    if form == "github":
        heads = [head.replace("\n", " ") for head in heads]
    return tabulate(lines, heads, form, colalign=align, disable_numparse=True)
