"""Configurations as dotted keys, which keys have no influence on a number, and the rows of the ablation."""

from collections.abc import Iterable, Mapping
from typing import Any

#: Where a run writes, what it shows and how it shares the machine: no number depends on these.
WITHOUT_INFLUENCE = (
    "hydra", "allow_random_encoder", "dry_run", "overwrite", "resume", "logger", "callbacks",
    "data.cache_dir", "data.cache_images_mb", "data.render_workers", "data.workers",
    "encoder.weights",  # repeats the origin of init_from's weights, which counts
    "evaluation.pictures", "trainer.log_every_n_steps",
)  # fmt: skip

#: What may change when a run is resumed without being reported: also how far it trains (``trainer.max_*``)
#: and what is measured after training.
MAY_CHANGE_ON_RESUME = (
    *WITHOUT_INFLUENCE, "evaluation", "metrics", "sweep", "trainer.max_steps", "trainer.max_time",
)  # fmt: skip

#: What loggers do not list among the hyperparameters of a run: also the name of its sweep and what is
#: measured after training.
NOT_HYPERPARAMETERS = (*WITHOUT_INFLUENCE, "evaluation", "sweep")

#: What differs between runs in one table on purpose: also the seed, what the ablation switches, and the
#: views, targets and metrics, which tables keep apart by themselves.
EXPECTED_TO_DIFFER = (
    *WITHOUT_INFLUENCE, "evaluation", "metrics.kind", "recalibration.neighborhood",
    "recalibration.similarity", "seed", "targets", "views",
)  # fmt: skip


def flatten(config: Any, prefix: str = "") -> dict[str, Any]:
    """Values by dotted key; an empty mapping is a value."""
    if not (isinstance(config, Mapping) and config):
        return {prefix: config}
    flat: dict[str, Any] = {}
    for name, value in config.items():
        flat |= flatten(value, f"{prefix}.{name}" if prefix else str(name))
    return flat


def lookup(config: Any, key: str) -> Any:
    """The value at a dotted key, None where there is none."""
    for name in key.split("."):
        if not isinstance(config, Mapping) or name not in config:
            return None
        config = config[name]
    return config


def is_below(key: str, parents: Iterable[str]) -> bool:
    """Whether a dotted key is one of ``parents`` or lies below one."""
    return any(key == parent or key.startswith(f"{parent}.") for parent in parents)


#: The ablation's name by its switches (3D unprojection, semantic consistency), in the tables' order.
ABLATIONS = {
    (False, False): "neither",
    (False, True): "no_unprojection",
    (True, False): "no_semantic",
    (True, True): "full",
}


def switches_of(config: Mapping[str, Any]) -> tuple[bool, bool]:
    """Whether the model of ``config`` finds neighbours in 3D, and weights attention by similarity."""
    recalibration = config["recalibration"]
    # A class of the user's own may have other keys.
    return recalibration.get("neighborhood", "xyz") == "xyz", recalibration.get("similarity") != "none"


def ablation_of(config: Mapping[str, Any]) -> str:
    """The name of a model's row in the ablation table; arguments as for :func:`switches_of`."""
    return ABLATIONS[switches_of(config)]
