"""Composes the configuration of a verb, and turns a composed one into plain data."""

from collections.abc import Sequence
from typing import Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig, OmegaConf

from ghgs_lit.config.paths import VERSION_BASE, conf_dir
from ghgs_lit.config.registry import KINDS, check
from ghgs_lit.config.verbs import VERBS
from ghgs_lit.errors import InputError

#: First line of the configuration that a run saves: a file without it is another program's.
HEADER = "# The configuration of this run, by ghgs."


def compose(verb: str, overrides: Sequence[str] = (), with_hydra: bool = False) -> DictConfig:
    """The configuration of ``ghgs <verb> <overrides>``, with the node ``hydra`` or without."""
    # A verb that is running has initialized Hydra already.
    running = GlobalHydra.instance().hydra
    GlobalHydra.instance().hydra = None
    try:
        with hydra.initialize_config_dir(str(conf_dir()), **VERSION_BASE):
            return hydra.compose(verb, overrides=list(overrides), return_hydra_config=with_hydra)
    finally:
        GlobalHydra.instance().hydra = running


def saved_text(config: dict[str, Any]) -> str:
    """A resolved configuration as runs save it, in YAML."""
    return f"{HEADER}\n{OmegaConf.to_yaml(OmegaConf.create(config))}"


def resolve(cfg: DictConfig, verb: str | None = None) -> dict[str, Any]:
    """A composed configuration as plain data; the groups are checked, and the keys of ``verb``. InputError: a
    value is missing, or of the wrong type or range."""
    data = own_keys(cfg, verb)
    check(data)
    return data


def own_keys(cfg: DictConfig, verb: str | None) -> dict[str, Any]:
    """:func:`resolve` without a look at the groups, whose options import PyTorch."""
    missing = sorted(OmegaConf.missing_keys(cfg))
    if missing:
        raise InputError(f"{missing[0]}: expected a value ({missing[0]}=...); found none")
    data = OmegaConf.to_container(cfg, resolve=True)
    if verb is not None:
        VERBS[verb].read({name: value for name, value in data.items() if name not in KINDS}, "")
    return data
