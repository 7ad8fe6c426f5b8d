"""Checkpoints of this package: plain data with the whole configuration, enough to rebuild the model."""

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from ghgs_lit.config.keys import flatten, require_plain
from ghgs_lit.config.registry import KINDS
from ghgs_lit.errors import InputError, require
from ghgs_lit.files import resolve_path, write_atomically
from ghgs_lit.geometry.precision import fast_precision
from ghgs_lit.weights.frozen import SHARING, join_frozen
from ghgs_lit.weights.reading import open_file, require_dense

FORMAT_VERSION = 2  #: Version of self-contained checkpoints; version 1 is read too

STATE_PREFIX = "model."  #: Prefix of the model's tensors in the state of a LightningModule


def read_checkpoint(path: str | Path, whole: bool = False) -> dict[str, Any]:
    """Read a checkpoint of this package, including its shared frozen weights (:mod:`.frozen`).

    Tensors are memory-mapped, not read.

    Args:
        path: path of the file, or :data:`ghgs_lit.weights.reading.SHIPPED`.
        whole: read every byte once and reject a damaged file (2 s for 1 GB).

    Returns:
        Its content: ``state_dict``, ``config``, ``format_version`` and further entries.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: it is not a checkpoint of this package, or its frozen weights are missing.
    """
    checkpoint = open_file(path, whole)
    for key, kind in (("state_dict", Mapping), ("config", Mapping), ("format_version", int)):
        value = checkpoint.get(key) if isinstance(checkpoint, Mapping) else None
        if not isinstance(value, kind):
            hint = "; `ghgs import` makes one of published weights"
            raise InputError(
                f"{path}: expected a checkpoint with {key!r}{hint}; found {describe(checkpoint)}"
            )
    version = checkpoint["format_version"]
    if not 1 <= version <= SHARING:
        newer = ", of a newer version of this package" if version > SHARING else ""
        raise InputError(f"{path}: expected format_version 1 to {SHARING}; found {version}{newer}")
    checkpoint = join_frozen(path, checkpoint, whole)
    _check_content(path, checkpoint)
    return checkpoint


def read_config(path: str | Path) -> dict[str, Any]:
    """Read the configuration of a checkpoint, nested mappings of plain values; arguments and errors as
    for :func:`read_checkpoint`."""
    return read_checkpoint(path)["config"]


def _check_content(path: str | Path, checkpoint: Mapping[str, Any]) -> None:
    """Reject nodes and tensors of impossible types; values of nodes are checked where they are used."""
    require_plain(checkpoint["config"], f"{path}: config")
    for name, node in checkpoint["config"].items():
        fits = name not in KINDS or node is None or isinstance(node, Mapping)
        require(fits, f"{path}: config.{name}", "a mapping of its keys", node)
    # Commands merge parts of it into their configuration, where OmegaConf would evaluate resolvers.
    for key, value in flatten(checkpoint["config"]).items():
        require("${" not in repr(value), f"{path}: config.{key}", "a value, no interpolation", value)
    require_dense(checkpoint["state_dict"], path)


def describe(content: Any) -> str:
    """Describe the content of an unexpected file in messages: the first keys of a mapping, else its type."""
    if not isinstance(content, Mapping):
        return f"a {type(content).__name__}"
    names = [repr(name) for name in content]
    more = f" and {len(names) - 4} more" if len(names) > 5 else ""
    return ", ".join(names[: 4 if more else 5]) + more if names else "an empty mapping"


def model_state(checkpoint: Mapping[str, Any], prefix: str = STATE_PREFIX) -> dict[str, Tensor]:
    """Tensors of the model by name; a LightningModule's checkpoint also holds those of losses.

    Args:
        checkpoint: from :func:`read_checkpoint`.
        prefix: prefix of the wanted names, which is removed.
    """
    return {
        key.removeprefix(prefix): value
        for key, value in checkpoint["state_dict"].items()
        if key.startswith(prefix)
    }


def require_fit(module: nn.Module, state: Mapping[str, Any], source: str | Path) -> None:
    """Check that keys and shapes are exactly those of a module.

    Args:
        module: its tensors may be on the meta device.
        state: tensors by name.
        source: origin of the state, for messages.

    Raises:
        InputError: a key is missing or unknown, or a shape differs; the message names source, key
            and both shapes.
    """
    tensors = module.state_dict()
    for key in tensors:
        require(key in state, f"{source}: {key}", f"a tensor of shape {tuple(tensors[key].shape)}", "nothing")
    for key, value in state.items():
        require(key in tensors, f"{source}: {key}", "no such key in the configured model", shape_of(value))
        require_shape(f"{source}: {key}", tensors[key], value)


def require_finite(state: Mapping[str, Tensor], source: str | Path) -> None:
    """Reject weights with NaN or infinity, which make every prediction empty.

    Args:
        state: tensors by name.
        source: origin of the state, for messages.

    Raises:
        InputError: a value is not finite; the message names source and key.
    """
    for key, value in state.items():
        # The sum is finite only if all terms are, and needs no second tensor. Half precision would
        # overflow.
        total = value.sum(dtype=torch.promote_types(value.dtype, torch.float32))
        require(bool(total.isfinite()), f"{source}: {key}", "finite numbers", "NaN or infinity")


def load_strictly(module: nn.Module, state: Mapping[str, Any], source: str | Path) -> None:
    """Copy a state into a module, after :func:`require_fit` and :func:`require_finite`.

    Args:
        module: the module to overwrite.
        state: tensors by name.
        source: origin of the state, for messages.

    Raises:
        InputError: as in these two functions.
    """
    require_fit(module, state, source)
    require_finite(state, source)
    module.load_state_dict(state)


def require_shape(key: str, own: Tensor, found: Any) -> None:
    """Reject a value that is not a floating point tensor with the shape of the model's.

    Args:
        key: location of the value, for messages.
        own: the model's tensor.
        found: the value, a tensor or anything else.

    Raises:
        InputError: the message names the key and both shapes, or the dtype.
    """
    expected = f"shape {tuple(own.shape)} of the configured model"
    require(shape_of(found) == tuple(own.shape), key, expected, shape_of(found))
    require(found.is_floating_point(), key, "floating point numbers", found.dtype)


def shape_of(value: Any) -> tuple[int, ...] | str:
    """Shape of a tensor, or type name of anything else, for messages."""
    return tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__


def write_checkpoint(
    path: str | Path, state: Mapping[str, Tensor], config: Mapping[str, Any], **facts: Any
) -> None:
    """Write a checkpoint atomically.

    Args:
        path: path of the file.
        state: tensors of the model by name.
        config: the whole configuration, as plain data.
        facts: further entries of the file, plain data.
    """
    content = {
        "state_dict": {f"{STATE_PREFIX}{key}": value for key, value in state.items()},
        "config": dict(config),
        "format_version": FORMAT_VERSION,
        **facts,
    }
    write_atomically(path, lambda temporary: torch.save(content, temporary))


def write_inference(checkpoint: str | Path, path: str | Path, dtype: str) -> None:
    """Write the model of a checkpoint without optimizer, losses and progress.

    Args:
        checkpoint: checkpoint of a whole model.
        path: file to write.
        dtype: dtype of all weights: ``float16``, ``bfloat16`` or ``float32``.

    Raises:
        InputError: a weight overflows the dtype, both paths are the same file, or the checkpoint
            holds the encoder alone.
    """
    if resolve_path(checkpoint) == resolve_path(path):
        raise InputError(f"inference={path}: expected another file than the checkpoint; found the same")
    content = read_checkpoint(checkpoint, whole=True)
    require("depth_head" in content["config"], str(checkpoint), "a whole model", "the encoder alone")
    state = {name: tensor.to(getattr(torch, dtype)) for name, tensor in model_state(content).items()}
    require_finite(state, f"{checkpoint} as {dtype}")
    # Paths of the training machine are dropped; loading reads ``imported``.
    config = {**content["config"], "resume": None, "init_from": None}
    facts = {"imported": content["imported"]} if "imported" in content else {}
    write_checkpoint(path, state, config, **facts)


def load_weights(
    model: nn.Module, path: str | Path, dtype: torch.dtype | None = None, device: Any = "cpu"
) -> None:
    """Load the weights of a checkpoint into a :class:`ghgs_lit.method.model.GHGS`, memory-mapped instead
    of copied.

    Args:
        model: its present weights may be on the meta device.
        path: as for :func:`read_checkpoint`.
        dtype: dtype of the encoder (None: as in the file, but float32 on a CPU without that half
            precision, and for float64); the heads are float32.
        device: device that the weights will be moved to.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: it is not a checkpoint of this package, or its weights are not finite or do not
            fit the model.
    """
    checkpoint = read_checkpoint(path, whole=True)
    state = model_state(checkpoint)
    require_fit(model, state, path)
    check_preset(model, checkpoint, path)
    for name, tensor in state.items():
        wanted = torch.float32
        if name.startswith("encoder."):
            single = torch.float32 if tensor.dtype == torch.float64 else tensor.dtype
            wanted = dtype or fast_precision(single, torch.device(device))
        state[name] = tensor.to(wanted)
    require_finite(state, path)
    model.load_state_dict(state, assign=True)


def check_preset(model: nn.Module, checkpoint: Mapping[str, Any], path: str | Path) -> None:
    """Warn if the authors' weights are used with fewer than all tokens.

    Args:
        model: a :class:`ghgs_lit.method.model.GHGS`.
        checkpoint: content of the checkpoint.
        path: path of the checkpoint, for messages.
    """
    is_release = "release" in (checkpoint.get("imported") or {})
    if is_release and model.skip.tokens != "all":
        expected = "all, as in the training of the authors' weights"
        found = f"{model.skip.tokens}, whose error is not known for them"
        warnings.warn(f"{path}: skip.tokens: expected {expected}; found {found}", stacklevel=3)
