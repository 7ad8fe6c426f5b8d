"""Target protocols of an evaluation, and checks before it starts."""

from typing import Any

from ghgs_lit.config.compose import read_options
from ghgs_lit.config.run import Run
from ghgs_lit.data.datamodule import PhotographsDataModule
from ghgs_lit.data.sampling import TargetProtocol
from ghgs_lit.errors import require, require_choice


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
