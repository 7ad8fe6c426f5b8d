"""Builds objects from configuration nodes, through a whitelist.

A configuration can come from somebody else's checkpoint, and Hydra's ``instantiate`` calls whatever
``_target_`` names. Only this package, the names below and the classes that the user allows
(:mod:`ghgs_lit.config.plugins`) are ever called.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import hydra.utils
from hydra.errors import InstantiationException
from omegaconf import DictConfig, OmegaConf

from ghgs_lit.config.plugins import VARIABLE, is_allowed
from ghgs_lit.errors import InputError

_OUTSIDE = frozenset(
    {
        "lightning.pytorch.Trainer",
        "lightning.pytorch.callbacks.LearningRateMonitor",
        "lightning.pytorch.callbacks.ModelCheckpoint",
        "lightning.pytorch.callbacks.RichProgressBar",
        "lightning.pytorch.callbacks.TQDMProgressBar",
        "lightning.pytorch.callbacks.Timer",
        "lightning.pytorch.loggers.CSVLogger",
        "lightning.pytorch.loggers.TensorBoardLogger",
        "lightning.pytorch.loggers.WandbLogger",
        "lightning.pytorch.strategies.DDPStrategy",
        "lightning.pytorch.strategies.FSDPStrategy",
        "torch.optim.AdamW",
        "torch.optim.Adam",
        "torch.optim.SGD",
    }
)


def _targets(node: Any, key: str = "") -> Iterator[tuple[str, object]]:
    """Every ``_target_`` below ``node`` with its dotted key."""
    if isinstance(node, Mapping):
        for name, value in node.items():
            path = f"{key}.{name}" if key else str(name)
            if name == "_target_":
                yield path, value
            else:
                yield from _targets(value, path)
    elif isinstance(node, Sequence) and not isinstance(node, (str, bytes)):
        for index, value in enumerate(node):
            yield from _targets(value, f"{key}[{index}]")


def _is_allowed(target: str) -> bool:
    return target in _OUTSIDE or target.startswith("ghgs_lit.") or is_allowed(target)


def _reason(error: InstantiationException, key: str) -> InputError:
    """The constructor's own message, as one line that starts with the key."""
    cause = error.__cause__
    while isinstance(cause, InstantiationException) and cause.__cause__ is not None:
        cause = cause.__cause__
    if isinstance(cause, InputError):
        return cause
    text = str(cause or error).strip().splitlines()[0]
    return InputError(f"{key or 'configuration'}: {text}")


def build(node: Mapping | DictConfig, _key: str = "", **extra: Any) -> Any:
    """Build the object that ``node`` describes (``_target_`` and its arguments), nested ones too.

    Args:
        node: a configuration node or a plain mapping; interpolations are resolved.
        _key: the node's dotted key in the configuration, for messages.
        extra: further arguments; they replace the node's.

    Raises:
        InputError: a ``_target_`` is not in the whitelist, or the target refuses an argument. Other errors
            inside the target keep their own type.
    """
    if not isinstance(node, Mapping | DictConfig) or "_target_" not in node:
        raise InputError(f"{_key or 'configuration'}: expected a mapping with _target_; found {node!r}")
    plain = OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else dict(node)
    for path, target in _targets(plain, _key):
        if not (isinstance(target, str) and _is_allowed(target)):
            raise InputError(
                f"{path}: expected a class of ghgs_lit or a whitelisted one; found {target!r}"
                f" ({VARIABLE}=file.py allows classes of your own)"
            )
    try:
        return hydra.utils.instantiate(plain, _convert_="all", **extra)
    except InstantiationException as error:
        if (
            isinstance(error.__cause__, (InputError, TypeError, InstantiationException))
            or not error.__cause__
        ):
            raise _reason(error, _key) from error
        raise
