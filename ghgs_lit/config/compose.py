"""Find and compose the Hydra configuration of a verb, and turn it into plain data."""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import InterpolationResolutionError

from ghgs_lit.config.defaults import fill, of_verb
from ghgs_lit.config.folder import VERSION_BASE, conf_dir
from ghgs_lit.config.keys import flatten, is_below, lookup
from ghgs_lit.config.options import did_you_mean
from ghgs_lit.config.reading import reading_as_ghgs
from ghgs_lit.config.registry import KINDS, verb_class, verbs
from ghgs_lit.config.run import Run
from ghgs_lit.errors import InputError, require

#: First line of the configuration that a run saves; a file without it belongs to another program.
HEADER = "# The configuration of this run, by ghgs."


@contextmanager
def _application() -> Iterator[None]:
    """A Hydra application over ``conf``; one that runs already is put aside meanwhile."""
    running = GlobalHydra.instance().hydra
    GlobalHydra.instance().hydra = None
    try:
        with reading_as_ghgs(), hydra.initialize_config_dir(str(conf_dir()), **VERSION_BASE):
            yield
    finally:
        GlobalHydra.instance().hydra = running


def _is_own() -> bool:
    """Whether the Hydra application that runs, if any, searches ``conf``:
    another program's does not."""
    if not GlobalHydra.instance().is_initialized():
        return False
    searched = GlobalHydra.instance().config_loader().get_search_path().get_path()
    return any(entry.path.removeprefix("file://") == str(conf_dir()) for entry in searched)


def store_defaults(verb: str, folder: str | None = None) -> None:
    """Register the configuration of a plug-in's verb with Hydra: its keys, at their defaults.

    A file ``<verb>.yaml`` in ``--config-dir`` takes its place, and may add groups.

    Args:
        verb: name of any verb; those of ``conf`` are left as they are.
        folder: of ``--config-dir``, if any.
    """
    store = ConfigStore.instance()
    store.repo.pop(f"{verb}.yaml", None)  # Hydra rejects a file of the same name
    if any(Path(place, f"{verb}.yaml").is_file() for place in (conf_dir(), folder) if place is not None):
        return
    node = {"defaults": ["_self_", {"override hydra/output": "ghgs"}], "hydra": {"job": {"name": verb}}}
    store.store(name=verb, node=of_verb(verb, node))


def compose(
    verb: str,
    overrides: Sequence[str] = (),
    with_hydra: bool = False,
    folder: str | None = None,
    is_filled: bool = True,
) -> DictConfig:
    """The configuration of ``ghgs <verb> <overrides>``, with all defaults.

    Args:
        verb: name of a verb, or of another file in ``conf``.
        overrides: as on the command line, such as ``model=paper``.
        with_hydra: whether the node ``hydra`` is part of it.
        folder: of ``--config-dir``, if any.
        is_filled: whether nodes have the defaults of their classes, which are imported then.

    Raises:
        HydraException: an override does not fit.
        InputError: a node names an unknown kind.
    """
    if verb in verbs():
        store_defaults(verb, folder)
    if folder is not None:
        searched = json.dumps([f"file://{Path(folder).resolve()}"], ensure_ascii=False)
        overrides = [*overrides, f"hydra.searchpath={searched}"]
    with _application():
        cfg = hydra.compose(verb, overrides=list(overrides), return_hydra_config=with_hydra)
        return fill(cfg) if is_filled else cfg


def saved_text(config: dict[str, Any]) -> str:
    """YAML text of a resolved configuration, as runs save it."""
    return f"{HEADER}\n{OmegaConf.to_yaml(OmegaConf.create(config))}"


def run_of(verb: str, overrides: Sequence[str] = ()) -> Run:
    """The run of ``ghgs <verb> <overrides>``: a verb's class with all of its keys and groups.

    Args:
        verb: name of a verb.
        overrides: as for :func:`compose`.

    Raises:
        HydraException: an override does not fit.
        InputError: a value is missing or has a wrong type or range.
    """
    return verb_class(verb).of(plain(compose(verb, overrides)))


def plain(cfg: DictConfig) -> dict[str, Any]:
    """A composed configuration as plain data that nothing has checked, groups first.

    Raises:
        InputError: a value is missing.
    """
    try:
        missing = sorted(OmegaConf.missing_keys(cfg))
    except InterpolationResolutionError:  # perhaps of a key that has only a default
        missing = sorted(OmegaConf.missing_keys(fill(cfg)))
    if missing:
        raise InputError(f"{missing[0]}: expected a value ({missing[0]}=...); found none")
    config = OmegaConf.to_container(cfg, resolve=True)
    return {group: config[group] for group in KINDS if group in config} | config


#: Groups whose files set keys of the whole configuration.
_GLOBAL = ("experiment", "sweep", "ablation")


def check_ablation(cfg: DictConfig, hydra_node: DictConfig) -> None:
    """Check that each key that the chosen ablation sets has its value,
    unless the command line sets it.

    Args:
        cfg: the composed configuration.
        hydra_node: the node ``hydra`` of the application that composed it.

    Raises:
        InputError: a key has another value, or a file that sets keys of the whole configuration
            lacks its line ``@package``.
    """
    for group in _GLOBAL:
        if group in cfg:
            file = f"{group}/{hydra_node.runtime.choices.get(group)}.yaml"
            raise InputError(f"{file}: expected the first line '# @package _global_'; found none")
    name = hydra_node.runtime.choices.get("ablation")
    wanted = _set_by_ablation(name)
    composed = OmegaConf.to_container(cfg)
    # with interpolations as they were typed
    overrides = OmegaConf.to_container(hydra_node.overrides.task)
    given = [part.key_or_group for part in OverridesParser.create().parse_overrides(overrides)]
    for key, value in wanted.items():
        present = lookup(composed, key)
        holds = present == value or is_below(key, ["hydra", *given])
        require(holds, key, f"{value!r}, as ablation/{name}.yaml sets it", present)


def _set_by_ablation(name: str | None) -> dict[str, Any]:
    """Dotted keys that an option of the group ``ablation`` sets, with its values.

    Args:
        name: of the option; None: no option, which sets nothing.
    """
    if name is None:
        return {}
    file = GlobalHydra.instance().config_loader().repository.load_config(f"ablation/{name}")
    values = flatten(OmegaConf.to_container(file.config))
    return {key: value for key, value in values.items() if key}


def chosen_options(config: Mapping[str, Any], hydra_node: DictConfig) -> dict[str, Any]:
    """What tables call a run by, for the key ``chosen`` of its configuration.

    Args:
        config: Resolved configuration of a training.
        hydra_node: The node ``hydra`` of the application that composed it.

    Returns:
        ``model``, ``encoder`` and ``ablation``: names of the chosen options, None without one;
        ``sets``: dotted keys that the ablation sets, with their values in ``config``.
    """
    choices = hydra_node.runtime.choices
    names = {group: choices.get(group) for group in ("model", "encoder", "ablation")}
    return {**names, "sets": {key: lookup(config, key) for key in _set_by_ablation(names["ablation"])}}


def read_options(group: str, names: Sequence[str], run: Run, key: str) -> dict[str, dict[str, Any]]:
    """Options of a group by name.

    Args:
        group: name of the group, such as ``skip``.
        names: of the options.
        run: the option that its node of the group names has these values instead of
            those of its file.
        key: begins the message of an error.

    Raises:
        InputError: the group has no such option.
    """
    chosen = getattr(run, group).name
    return {name: run.plain[group] if name == chosen else read_option(group, name, key) for name in names}


def read_option(group: str, name: str, key: str | None = None) -> dict[str, Any]:
    """The values of ``<group>/<name>.yaml``, including its list of defaults, as plain data.

    An application of the package also searches the user's ``--config-dir``.

    Args:
        group: name of the group; a subgroup with slashes.
        name: of the option.
        key: begins the message of an error; None: the group does.

    Raises:
        InputError: the group has no such option.
    """
    with nullcontext() if _is_own() else _application():
        known = sorted(GlobalHydra.instance().config_loader().get_group_options(group))
        if name in known:
            node = OmegaConf.select(fill(hydra.compose(f"{group}/{name}")), group.replace("/", "."))
            return OmegaConf.to_container(node, resolve=True)
    hint = did_you_mean(name, known)
    raise InputError(f"{key or group}: expected one of {', '.join(known)}; found {name!r}{hint}")
