"""Start of training: from scratch, from the weights of another run, or from an interrupted run."""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torch import nn

from ghgs_lit.config.keys import MAY_CHANGE_ON_RESUME, lookup
from ghgs_lit.errors import InputError, require
from ghgs_lit.files import resolve_path
from ghgs_lit.method.stages import STAGES
from ghgs_lit.runs.results import differences
from ghgs_lit.weights.checkpoint import load_strictly, model_state, read_checkpoint, require_finite, shape_of

if TYPE_CHECKING:
    from ghgs_lit.cli.verbs import Train
    from ghgs_lit.training.base import BudgetedModule


def check_start(run: "Train", directory: Path) -> None:
    """Reject ``init_from`` together with ``resume``, unless the run resumes in its own directory, where
    its configuration still contains the ``init_from`` with which it began.

    Raises:
        InputError: both are given."""
    if run.resume is None or run.init_from is None:
        return
    own = resolve_path(run.resume).is_relative_to(directory.resolve())
    require(own, "init_from", "null where resume is given", run.init_from)


def check_resume(
    path: str | Path, module: "BudgetedModule", config: Mapping[str, Any]
) -> tuple[int, list[str]]:
    """Check that a run can resume from a checkpoint, and load its weights.

    Args:
        module: the module that gets the weights of all its submodules.
        config: the run's configuration as plain data.

    Returns:
        The step of the checkpoint, and one line for each setting that ``config`` changes.

    Raises:
        InputError: the checkpoint is damaged, not of a training run, or of another model, loss
            (the message names the tensor) or optimizer."""
    checkpoint = read_checkpoint(path, whole=True)
    step = checkpoint.get("global_step")
    for key, kind in (("global_step", int), ("optimizer_states", list)):
        expected = "that of a training run (init_from=... starts from weights alone)"
        value = checkpoint.get(key)
        require(isinstance(value, kind), f"{path}: {key}", expected, type(value).__name__)
    parts = dict(module.named_children())
    for key in checkpoint["state_dict"]:
        expected = f"weights of {' or '.join(parts)}"
        require(str(key).split(".")[0] in parts, f"{path}: {key}", expected, "those of another part")
    for name, part in parts.items():
        load_strictly(part, model_state(checkpoint, f"{name}."), path)
    return step, differences(checkpoint["config"], config, MAY_CHANGE_ON_RESUME)


def initialize(
    model: nn.Module, path: str | Path, strict: bool = False, random_frozen: bool = False
) -> list[str]:
    """Load those weights of a checkpoint that fit into a model.

    Args:
        strict: every tensor must fit, except those of other stages if the file contains only the
            encoder.
        random_frozen: frozen parameters may stay as initialised.

    Returns:
        A line for each tensor: ``loaded``, ``wrong shape`` or ``missing`` (both stay as
        initialised), or ``ignored`` (not in the model).

    Raises:
        InputError: not a checkpoint of this project; nothing fits; a parameter that is not trained
            would stay as initialised; with ``strict``, a tensor that does not fit or is missing
            (names it)."""
    checkpoint = read_checkpoint(path, whole=True)
    state = model_state(checkpoint)
    own = model.state_dict()
    if strict:
        alone = checkpoint["config"].keys() & set(STAGES) == {"encoder"}
        others = {name: own[name] for name in own if alone and not name.startswith("encoder.")}
        load_strictly(model, others | state, path)
    fitting = {}
    lines = []
    for key in {**own, **state}:
        here = shape_of(own[key]) if key in own else None
        there = shape_of(state[key]) if key in state else None
        if here is None:
            lines.append(f"ignored      {key} {there}: the model has no such tensor")
        elif there is None:
            lines.append(f"missing      {key} {here}: left as initialised")
        elif here != there:
            lines.append(f"wrong shape  {key} {there}, expected {here}: left as initialised")
        else:
            fitting[key] = state[key]
            lines.append(f"loaded       {key} {here}")
    if not fitting:
        raise InputError(f"init_from: expected weights that fit the model; found none in {path}")
    for name, parameter in model.named_parameters():
        expected = "weights of a part that does not learn (allow_random_encoder=true does without)"
        known = name in fitting or parameter.requires_grad or random_frozen
        require(known, f"{path}: {name}", expected, "none that fit")
    require_finite(fitting, path)
    model.load_state_dict(fitting, strict=False)
    return lines


def with_origin(run: "Train", model: nn.Module) -> "Train":
    """Adopt ``encoder.weights``, the origin of the semantic features in tables, from the checkpoint from
    which a run starts.

    Returns:
        The configuration with the checkpoint's ``encoder.weights``, if it has this key and all these
        weights fit; otherwise ``run`` unchanged."""
    path = run.resume or run.init_from
    if path is None:
        return run
    checkpoint = read_checkpoint(path)
    origin = lookup(checkpoint["config"], "encoder.weights")
    state = model_state(checkpoint)
    has_branch = getattr(run.encoder, "semantic", None) is not None  # a plug-in's encoder may lack it
    fits = has_branch == (lookup(checkpoint["config"], "encoder.semantic") is not None)
    source = "encoder.semantic." if has_branch else "encoder."
    for name, tensor in model.state_dict().items():
        if name.startswith(source):
            fits &= name in state and state[name].shape == tensor.shape
    if not origin or not fits:
        return run
    return run.with_changes(encoder={"weights": origin})


def report(lines: list[str], path: str | Path, written: Path) -> str:
    """Count what was loaded, and write all lines to the file ``written``.

    Args:
        lines: result of :func:`initialize`.

    Returns:
        One line of text."""
    written.write_text("\n".join(lines) + "\n")
    counts = Counter(line.partition("  ")[0] for line in lines)
    numbers = ", ".join(f"{count} {kind}" for kind, count in counts.items())
    return f"init_from {path}: {numbers} (tensors: {written})"
