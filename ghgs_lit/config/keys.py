"""Dotted keys of configurations, lists of keys that do not influence results,
and names of ablations."""

from collections.abc import Iterable, Mapping
from typing import Any

from ghgs_lit.errors import require

#: Keys that no result depends on: where a run writes, what it shows and how it shares the machine.
WITHOUT_INFLUENCE = (
    "hydra", "allow_random_encoder", "chosen", "dry_run", "overwrite", "resume", "logger", "callbacks",
    "data.cache_dir", "data.cache_images_mb", "data.packed_gb", "data.render_workers",
    "data.workers", "feature_cache.folder",
    "encoder.weights",  # repeats the origin of init_from's weights, which counts
    "evaluation.pictures", "trainer.log_every_n_steps", "trainer.profiler",
)  # fmt: skip

#: Keys that may change when a run is resumed without being reported: those without influence, the
#: length of training (``trainer.max_*``) and what is measured after it.
MAY_CHANGE_ON_RESUME = (
    *WITHOUT_INFLUENCE, "evaluation", "metrics", "sweep", "trainer.max_steps", "trainer.max_time",
)  # fmt: skip

#: Keys that loggers do not list as hyperparameters: those without influence, the sweep,
#: and the evaluation.
NOT_HYPERPARAMETERS = (*WITHOUT_INFLUENCE, "evaluation", "sweep")

#: Keys of views and targets by which models are trained differently.
OF_TRAINING = ("views.training_counts", "views.training", "targets.training_views", "targets.per_step")
#: Keys by which a protocol of one name has other targets.
OF_TARGETS = ("targets.kind", "targets.view", "targets.positions", "targets.per_subject")

#: Keys that may differ between the runs of a row of a table: those without influence, the seed, and
#: views, targets and metrics, which tables keep apart themselves.
OF_A_RUN = (*WITHOUT_INFLUENCE, "evaluation", "metrics.kind", "seed", "targets", "views")
#: Keys that name files and machines: the same run elsewhere has others.
OF_A_PLACE = ("checkpoint", "data.root", "data.source", "init_from", "trainer.accelerator")
#: Keys that may differ between the runs of a table: those of a run,
#: and the switches of the ablation.
EXPECTED_TO_DIFFER = (*OF_A_RUN, "recalibration.neighborhood", "recalibration.similarity")


def flatten(config: Any, prefix: str = "") -> dict[str, Any]:
    """Values by dotted key; an empty mapping is a value.

    Args:
        config: nested mappings, or a single value.
        prefix: dotted key of ``config`` itself; empty: the whole configuration.
    """
    if not (isinstance(config, Mapping) and config):
        return {prefix: config}
    flat: dict[str, Any] = {}
    for name, value in config.items():
        flat |= flatten(value, f"{prefix}.{name}" if prefix else str(name))
    return flat


#: More than any configuration has; a file of a few kilobytes can refer to one list a billion times.
_MOST_VALUES = 100_000
_MOST_LEVELS = 32


def require_plain(config: Any, where: str) -> None:
    """Reject a configuration that YAML cannot express.

    Args:
        config: mappings with keys of text, lists, texts and numbers are plain.
        where: its file or key, for messages.

    Raises:
        InputError: it holds another type, or itself, or too much; names the key.
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
    """The value at a dotted key, or None.

    Args:
        config: nested mappings; other values have no keys.
        key: dotted key.
    """
    for name in key.split("."):
        if not isinstance(config, Mapping) or name not in config:
            return None
        config = config[name]
    return config


def key_of(override: str) -> str:
    """The key or group of an override such as ``+data.people=3``."""
    return override.split("=", 1)[0].lstrip("+~")


def is_hyperparameter(key: str) -> bool:
    """Whether runs are compared by a key or group."""
    return not is_below(key.replace("/", "."), NOT_HYPERPARAMETERS)


def is_below(key: str, parents: Iterable[str]) -> bool:
    """Whether a dotted key is one of some others or lies below one.

    Args:
        key: the dotted key.
        parents: dotted keys.
    """
    return any(key == parent or key.startswith(f"{parent}.") for parent in parents)


#: Name of the ablation by its switches (3D unprojection, semantic consistency),
#: in the order of tables.
ABLATIONS = {
    (False, False): "neither",
    (False, True): "no_unprojection",
    (True, False): "no_semantic",
    (True, True): "full",
}


def switches_of(config: Mapping[str, Any]) -> tuple[bool, bool]:
    """The switches of the ablation in a model.

    Args:
        config: whole configuration as plain data.

    Returns:
        Whether the model finds neighbours in 3D, and whether it weights attention by similarity.
    """
    recalibration = config["recalibration"]
    # A plug-in may have other keys.
    return recalibration.get("neighborhood", "xyz") == "xyz", recalibration.get("similarity") != "none"


def ablation_of(config: Mapping[str, Any]) -> str:
    """Name of a model's row in the ablation table.

    Args:
        config: Resolved configuration of a training. Its ``chosen.ablation``, where it has one, is
            the option of the group ``ablation`` that was chosen.

    Returns:
        The option where it is user-defined; else the name that :data:`ABLATIONS` gives to the
        model's switches, which the command line may have set one by one.
    """
    name = lookup(config, "chosen.ablation")
    return name if is_own_ablation(name) else ABLATIONS[switches_of(config)]


def is_own_ablation(name: Any) -> bool:
    """Whether ``name`` is a user-defined option of the group ``ablation``."""
    return isinstance(name, str) and name not in ABLATIONS.values()
