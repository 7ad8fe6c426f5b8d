"""Checks of the training state in a checkpoint, before any of it is used.

Lightning loads loops, callbacks, optimizers and schedules as they come: a damaged one fails with a
traceback in the middle of its start, or counts on from a wrong step.
"""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import lightning.pytorch as L
from lightning.pytorch.callbacks import Timer
from torch import Tensor
from torch.nn import Parameter

from ghgs_lit.errors import require

#: What Muon and AdamW keep of a parameter.
_KEPT = ({"step", "momentum"}, {"step", "exp_avg", "exp_avg_sq"})


def check_training_state(path: str | Path, checkpoint: Mapping[str, Any]) -> None:
    """Refuse a checkpoint whose training state does not have Lightning's form.

    Args:
        path: of the checkpoint, for messages.
        checkpoint: its content.

    Raises:
        InputError: names the entry."""
    kinds = {"epoch": int, "global_step": int, "skipped_steps": int, "loops": Mapping, "callbacks": Mapping}
    kinds |= {"optimizer_states": list, "lr_schedulers": list}
    for key in kinds.keys() & checkpoint.keys():
        value = checkpoint[key]
        kind = kinds[key]
        fits = isinstance(value, kind) and (kind is not int or _is_count(value))
        require(
            fits, f"{path}: {key}", "a number of 0 or more" if kind is int else f"a {kind.__name__}", value
        )
    for state in checkpoint["optimizer_states"]:
        groups = state.get("param_groups") if isinstance(state, Mapping) else None
        fits = isinstance(groups, list) and all(isinstance(group, Mapping) for group in groups)
        require(fits, f"{path}: optimizer_states", "states with param_groups", type(state).__name__)


def check_optimizer_state(
    path: str | Path, state: Mapping[str, Any], groups: Sequence[Mapping[str, Any]]
) -> None:
    """Refuse the state of an optimizer with another number of parameters, tensors of other shapes
    or values that are not finite.

    Args:
        path: of the checkpoint, for messages.
        state: of the optimizer in the checkpoint.
        groups: the parameter groups of this run's optimizer.

    Raises:
        InputError: names the entry."""
    place = f"{path}: optimizer_states"
    own = [len(group["params"]) for group in groups]
    lists = [group.get("params") for group in state["param_groups"]]
    found = [len(numbers) if isinstance(numbers, list) else None for numbers in lists]
    expected = f"as many groups and parameters as this run has, {own}"
    require(found == own, f"{place}.param_groups", expected, found)
    for group in state["param_groups"]:
        rate = group.get("lr")
        require(_is_number(rate) and rate >= 0, f"{place}.param_groups.lr", "a number of 0 or more", rate)
    parameters = list(itertools.chain.from_iterable(group["params"] for group in groups))
    by_number = dict(zip(itertools.chain.from_iterable(lists), parameters, strict=True))
    kept = state.get("state")
    require(isinstance(kept, Mapping), f"{place}.state", "a mapping of parameters", type(kept).__name__)
    for number, values in kept.items():
        fits = isinstance(values, Mapping) and (not values or set(values) in _KEPT)
        found = sorted(map(str, values)) if isinstance(values, Mapping) else type(values).__name__
        require(fits, f"{place}.state.{number}", "what AdamW or Muon keeps of a parameter", found)
        require(number in by_number, f"{place}.state", f"numbers of {len(parameters)} parameters", number)
        for name, value in values.items():
            _check_kept(f"{place}.state.{number}.{name}", value, by_number[number])


def _check_kept(place: str, value: Any, parameter: Parameter) -> None:
    """``step`` is one number, everything else as large as its parameter."""
    shape = () if place.endswith(".step") else tuple(parameter.shape)
    found = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
    require(found == shape, place, f"a tensor of shape {shape}", found)
    require(bool(value.isfinite().all()), place, "finite numbers", "NaN or infinity")


def check_schedules(path: str | Path, states: Any, count: int) -> None:
    """Refuse states of LambdaLR that this run cannot go on from.

    Args:
        path: of the checkpoint, for messages.
        states: in the checkpoint.
        count: of parameter groups of the run.

    Raises:
        InputError: names the entry."""
    place = f"{path}: lr_schedulers"
    require(isinstance(states, list), place, "a list of states", type(states).__name__)
    for state in states:
        require(isinstance(state, Mapping), place, "a mapping", type(state).__name__)
        for key, fits in {
            "last_epoch": _is_count,
            "_step_count": _is_count,
            "base_lrs": lambda rates: _are(rates, count, _is_number),
            "_last_lr": lambda rates: _are(rates, count, _is_number),
            "lr_lambdas": lambda functions: _are(functions, count, lambda each: each is None),
        }.items():
            require(
                fits(state.get(key)), f"{place}.{key}", f"that of {count} parameter groups", state.get(key)
            )


def check_restored(trainer: L.Trainer, checkpoint: Mapping[str, Any]) -> None:
    """Refuse states of loops and callbacks whose form differs from what this run's
    have at the start.

    Args:
        trainer: of the run, before it has started.
        checkpoint: that it goes on from.

    Raises:
        InputError: names the entry."""
    path = trainer.ckpt_path
    loops = checkpoint.get("loops") or {}
    require("fit_loop" in loops, f"{path}: loops", "a fit_loop", sorted(map(str, loops)))
    found = loops["fit_loop"]
    own = trainer.fit_loop.state_dict()
    require(isinstance(found, Mapping), f"{path}: loops.fit_loop", "a mapping", type(found).__name__)
    # Loops of other versions of Lightning have others; it leaves them as they are.
    _check_form(f"{path}: loops.fit_loop", found, {key: own[key] for key in own.keys() & found.keys()})
    states = checkpoint.get("callbacks") or {}
    for callback in trainer.callbacks:
        if callback.state_key in states:
            place = f"{path}: callbacks.{type(callback).__name__}"
            own = callback.state_dict()
            if isinstance(callback, Timer):  # seconds, which are whole only before the start
                own = {"time_elapsed": dict.fromkeys(own["time_elapsed"], 0.0)}
            _check_form(place, states[callback.state_key], own)


def _check_form(place: str, found: Any, own: Any) -> None:
    """Refuse another form than that of ``own``: keys, and types of values."""
    if isinstance(own, Mapping):
        require(isinstance(found, Mapping), place, "a mapping", type(found).__name__)
        for key, value in own.items():
            require(key in found, place, f"the key {key!r}", sorted(map(str, found)))
            _check_form(f"{place}.{key}", found[key], value)
        if not own:  # scores of checkpoints by their paths, empty at the start
            fits = all(isinstance(key, str) and _is_score(score) for key, score in found.items())
            require(fits, place, "numbers by name", dict(found))
    elif isinstance(own, bool):
        require(isinstance(found, bool), place, "true or false", found)
    elif isinstance(own, int):
        require(_is_count(found), place, "a number of 0 or more", found)
    elif own is None or isinstance(own, float | Tensor):
        # A score that is not known yet is None; one that none has reached, infinite.
        require(_is_score(found), place, "a number", found)
    else:
        require(isinstance(found, type(own) | None), place, f"a {type(own).__name__}", found)


def _is_score(value: Any) -> bool:
    is_one = isinstance(value, Tensor) and value.ndim == 0
    return value is None or is_one or (isinstance(value, int | float) and not isinstance(value, bool))


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 1 << 62


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _are(values: Any, count: int, fits: Callable[[Any], bool]) -> bool:
    return isinstance(values, list) and len(values) == count and all(map(fits, values))
