"""Where training starts from: nothing, the weights of another run, or a run that was cut off."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import nn

from ghgs_lit.errors import InputError, require
from ghgs_lit.weights.checkpoint import load_strictly, model_state, read_checkpoint
from ghgs_lit.weights.switches import differences as differing_switches

#: What may differ between a run and the one that it goes on from: where it writes, how far it goes.
FREE = (
    "resume",
    "encoder.weights",
    "dry_run",
    "sweep",
    "trainer.max_steps",
    "trainer.max_time",
    "logger",
    "callbacks",
    "evaluation",
    "metrics",
)


def check_start(config: Mapping[str, Any], directory: Path) -> None:
    """Refuse two ways to start; a run that goes on in its own ``directory`` began with its ``init_from``."""
    if config["resume"] is None or config["init_from"] is None:
        return
    own = Path(config["resume"]).resolve().is_relative_to(directory.resolve())
    require(own, "init_from", "null where resume is given", config["init_from"])


def check_resume(path: str | Path, model: nn.Module, config: Mapping[str, Any]) -> tuple[int, list[str]]:
    """The step of the checkpoint at ``path``, and what of its configuration this run changes.

    Raises:
        InputError: no checkpoint of a training run, or one of another model (names the tensor).
    """
    checkpoint = read_checkpoint(path)
    for key in ("global_step", "optimizer_states"):
        if key not in checkpoint:
            raise InputError(
                f"{path}: expected a checkpoint of a training run; found none of its {key!r}"
                " (init_from=... starts from weights alone)"
            )
    load_strictly(model, model_state(checkpoint), path)
    return checkpoint["global_step"], differences(checkpoint["config"], config)


def differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """``key: value before -> value now`` of all that matters to the weights."""
    old, new = _flat(before), _flat(now)
    return [
        f"{key}: {old.get(key)} -> {new.get(key)}"
        for key in sorted(old.keys() | new.keys())
        if old.get(key) != new.get(key)
        and not any(key == name or key.startswith(f"{name}.") for name in FREE)
    ]


def _flat(config: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat = {}
    for name, value in config.items():
        key = f"{prefix}{name}"
        flat |= _flat(value, f"{key}.") if isinstance(value, Mapping) and value else {key: value}
    return flat


def initialize(model: nn.Module, path: str | Path, strict: bool = False) -> list[str]:
    """Load what fits of the weights at ``path`` into ``model``; says what became of each tensor.

    One line each: ``loaded``, ``wrong shape`` and ``missing`` (both stay as initialised), ``ignored`` (the
    model has no such tensor).

    Raises:
        InputError: no checkpoint of this project; nothing fits; with ``strict``, a tensor that does not fit
            or is missing on either side (names it).
    """
    state, own = model_state(read_checkpoint(path)), model.state_dict()
    if strict:
        load_strictly(model, state, path)
    fitting, lines = {}, []
    for key in [*own, *(key for key in state if key not in own)]:
        here, there = (tuple(s[key].shape) if key in s else None for s in (own, state))
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
    model.load_state_dict(fitting, strict=False)
    return lines


def with_origin(config: Mapping[str, Any], model: nn.Module) -> Mapping[str, Any]:
    """``config`` that says where the encoder's weights come from, if those of the start do and all fit.

    Tables then know that semantic features carry semantics (``encoder.weights``).
    """
    path = config["resume"] or config["init_from"]
    if path is None:
        return config
    checkpoint = read_checkpoint(path)
    origin, state = checkpoint["config"].get("encoder", {}).get("weights"), model_state(checkpoint)
    fits = all(
        name in state and state[name].shape == tensor.shape
        for name, tensor in model.state_dict().items()
        if name.startswith("encoder.")
    )
    return {**config, "encoder": {**config["encoder"], "weights": origin}} if origin and fits else config


def switched(config: Mapping[str, Any]) -> list[str]:
    """The switches (:mod:`ghgs_lit.weights.switches`) in which this model differs from ``init_from``'s."""
    return differing_switches(config, read_checkpoint(config["init_from"])["config"])


def report(lines: list[str], path: str | Path, written: Path) -> str:
    """All but the loaded tensors, and how many those are; ``written`` has the lines of all."""
    written.write_text("\n".join(lines) + "\n")
    others = [line for line in lines if not line.startswith("loaded")]
    loaded = len(lines) - len(others)
    shown = others if len(others) <= 20 else [*others[:20], f"... and {len(others) - 20} more"]
    return "\n".join([f"init_from {path}: {loaded} tensors loaded (all lines: {written})", *shown])
