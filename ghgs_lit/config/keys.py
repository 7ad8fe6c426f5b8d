"""Dotted keys of configurations, lists of keys that do not affect results, and names of ablations."""

from collections.abc import Iterable, Mapping
from typing import Any

from ghgs_lit.errors import require

#: Keys that do not affect results: output paths, displays and the use of the machine.
WITHOUT_INFLUENCE = (
    "hydra", "allow_random_encoder", "chosen", "dry_run", "overwrite", "resume", "logger", "callbacks",
    "data.cache_dir", "data.packed", "data.render_workers",
    "data.workers", "feature_cache.folder",
    "encoder.weights",  # repeats the origin of the weights of init_from, which is compared
    "evaluation.pictures", "trainer.log_every_n_steps",
)  # fmt: skip

#: Keys that may change without a report when a run is resumed: those without influence, the
#: length of training (``trainer.max_*``) and the evaluation after it.
MAY_CHANGE_ON_RESUME = (
    *WITHOUT_INFLUENCE, "evaluation", "metrics", "sweep", "trainer.max_steps", "trainer.max_time",
)  # fmt: skip

#: Keys that loggers do not list as hyperparameters: those without influence, the sweep,
#: and the evaluation.
NOT_HYPERPARAMETERS = (*WITHOUT_INFLUENCE, "evaluation", "sweep")

#: Keys that may differ between the runs of a table row: those without influence, the seed, and what
#: tables distinguish otherwise.
OF_A_RUN = (
    *WITHOUT_INFLUENCE, "evaluation", "metrics.kind", "seed", "targets.name", "views.evaluation_count",
)  # fmt: skip
#: Keys of files and machines, which differ if the same run is repeated elsewhere.
OF_A_PLACE = ("checkpoint", "data.root", "data.source", "init_from", "trainer.accelerator")
#: Keys that may differ between the runs of a table: :data:`OF_A_RUN` and the switches of the ablation.
EXPECTED_TO_DIFFER = (*OF_A_RUN, "recalibration.neighborhood", "recalibration.similarity")


def flatten(config: Any, prefix: str = "") -> dict[str, Any]:
    """Values by dotted key; an empty mapping counts as a value.

    Args:
        config: Nested mappings, or a single value.
        prefix: Dotted key of ``config`` itself; empty: the whole configuration.
    """
    if not (isinstance(config, Mapping) and config):
        return {prefix: config}
    flat: dict[str, Any] = {}
    for name, value in config.items():
        flat |= flatten(value, f"{prefix}.{name}" if prefix else str(name))
    return flat


#: Limits far above any configuration; a file of a few kilobytes can refer to one list a billion times.
_MOST_VALUES = 100_000
_MOST_LEVELS = 32


def require_plain(config: Any, where: str) -> None:
    """Reject a configuration that YAML cannot express.

    Args:
        config: Mappings with text keys, lists, texts and numbers are accepted.
        where: File or key of the configuration, for messages.

    Raises:
        InputError: It contains another type, itself, or too many values or levels; the message contains
            the key.
    """
    left = [(where, config, 0)]
    count = 0
    while left:
        key, value, level = left.pop()
        count += 1
        small = level < _MOST_LEVELS and count < _MOST_VALUES
        require(small, key, f"less than {_MOST_LEVELS} levels and {_MOST_VALUES} values, no loops", "more")
        if isinstance(value, Mapping):
            for name, item in value.items():
                require(isinstance(name, str), key, "keys of text", name)
                left.append((f"{key}.{name}", item, level + 1))
        elif isinstance(value, list | tuple):
            left += [(key, item, level + 1) for item in value]
        else:
            known = value is None or isinstance(value, str | int | float)
            require(known, key, "mappings, lists, texts and numbers", type(value).__name__)


def lookup(config: Any, key: str) -> Any:
    """Value at a dotted key, or None. Values other than mappings have no keys."""
    for name in key.split("."):
        if not isinstance(config, Mapping) or name not in config:
            return None
        config = config[name]
    return config


def key_of(override: str) -> str:
    """Key or group of an override such as ``+data.people=3``."""
    return override.split("=", 1)[0].lstrip("+~")


def is_hyperparameter(key: str) -> bool:
    """Whether a key or group counts as a hyperparameter by which runs are compared."""
    return not is_below(key.replace("/", "."), NOT_HYPERPARAMETERS)


def is_below(key: str, parents: Iterable[str]) -> bool:
    """Whether a dotted key equals one of some dotted keys or lies below one."""
    return any(key == parent or key.startswith(f"{parent}.") for parent in parents)


#: Name of the ablation by its switches (3D unprojection, semantic consistency), in the order of tables.
ABLATIONS = {
    (False, False): "neither",
    (False, True): "no_unprojection",
    (True, False): "no_semantic",
    (True, True): "full",
}


def switches_of(config: Mapping[str, Any]) -> tuple[bool, bool]:
    """Ablation switches of a model.

    Args:
        config: Whole configuration as plain data.

    Returns:
        Whether the model finds neighbours in 3D, and whether it weights attention by similarity.
    """
    recalibration = config["recalibration"]
    # Kinds of plug-ins may have other keys.
    return recalibration.get("neighborhood", "xyz") == "xyz", recalibration.get("similarity") != "none"


def ablation_of(config: Mapping[str, Any]) -> str:
    """Name of a model's row in the ablation table.

    Args:
        config: Resolved configuration of a training; its ``chosen.ablation``, if any, is the chosen
            option of the group ``ablation``.

    Returns:
        The option if it is user-defined; otherwise the name in :data:`ABLATIONS` of the model's switches,
        which the command line may have set one by one.
    """
    name = lookup(config, "chosen.ablation")
    return name if is_custom_ablation(name) else ABLATIONS[switches_of(config)]


def is_custom_ablation(name: Any) -> bool:
    """Whether ``name`` is a user-defined option of the group ``ablation``."""
    return isinstance(name, str) and name not in ABLATIONS.values()
