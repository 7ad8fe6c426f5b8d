"""Find and compose the Hydra configuration of a verb, and convert it to plain data."""

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

from ghgs_lit.config.defaults import fill, verb_values
from ghgs_lit.config.keys import flatten, is_below, lookup
from ghgs_lit.config.options import did_you_mean
from ghgs_lit.config.reading import VERSION_BASE, conf_dir, reading_as_ghgs
from ghgs_lit.config.registry import KINDS, verb_class, verbs
from ghgs_lit.config.run import Run
from ghgs_lit.errors import InputError, require

#: First line of saved configurations; a file without it belongs to another program.
HEADER = "# The configuration of this run, by ghgs."


@contextmanager
def _application() -> Iterator[None]:
    """Hydra application over ``conf``; an application that is already running is suspended meanwhile."""
    running = GlobalHydra.instance().hydra
    GlobalHydra.instance().hydra = None
    try:
        with reading_as_ghgs(), hydra.initialize_config_dir(str(conf_dir()), **VERSION_BASE):
            yield
    finally:
        GlobalHydra.instance().hydra = running


def _is_own_application() -> bool:
    """Whether the running Hydra application, if any, searches ``conf``; those of other programs do not."""
    if not GlobalHydra.instance().is_initialized():
        return False
    searched = GlobalHydra.instance().config_loader().get_search_path().get_path()
    return any(entry.path.removeprefix("file://") == str(conf_dir()) for entry in searched)


def store_defaults(verb: str, folder: str | None = None) -> None:
    """Register the configuration of a plug-in's verb with Hydra: its keys with their defaults.

    A file ``<verb>.yaml`` in ``--config-dir`` replaces it, and may add groups.

    Args:
        verb: Name of any verb; those with a file in ``conf`` are left unchanged.
        folder: Value of ``--config-dir``, if any.
    """
    store = ConfigStore.instance()
    store.repo.pop(f"{verb}.yaml", None)  # Hydra rejects a file of the same name
    if any(Path(place, f"{verb}.yaml").is_file() for place in (conf_dir(), folder) if place is not None):
        return
    node = {"defaults": ["_self_", {"override hydra/output": "ghgs"}], "hydra": {"job": {"name": verb}}}
    store.store(name=verb, node=verb_values(verb, node))


def compose(
    verb: str,
    overrides: Sequence[str] = (),
    with_hydra: bool = False,
    folder: str | None = None,
    is_filled: bool = True,
) -> DictConfig:
    """Compose the configuration of ``ghgs <verb> <overrides>``, with all defaults.

    Args:
        verb: Name of a verb, or of another file in ``conf``.
        overrides: As on the command line, such as ``model=paper``.
        with_hydra: Whether to include the node ``hydra``.
        folder: Value of ``--config-dir``, if any.
        is_filled: Whether to fill in the defaults of option nodes, which imports their classes.

    Raises:
        HydraException: An override does not fit.
        InputError: A node has an unknown kind.
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
    """YAML text of a resolved configuration in the form that runs save."""
    return f"{HEADER}\n{OmegaConf.to_yaml(OmegaConf.create(config))}"


def run_of(verb: str, overrides: Sequence[str] = ()) -> Run:
    """Run of ``ghgs <verb> <overrides>``: an instance of the verb's class with all keys and groups.

    Args:
        verb: Name of a verb.
        overrides: See :func:`compose`.

    Raises:
        HydraException: An override does not fit.
        InputError: A value is missing or has a wrong type or range.
    """
    return verb_class(verb).of(to_plain(compose(verb, overrides)))


def to_plain(cfg: DictConfig) -> dict[str, Any]:
    """Convert a composed configuration to plain data, groups first, without validation.

    Raises:
        InputError: A value is missing.
    """
    try:
        missing = sorted(OmegaConf.missing_keys(cfg))
    except InterpolationResolutionError:  # it may refer to a key that has only a default
        missing = sorted(OmegaConf.missing_keys(fill(cfg)))
    if missing:
        raise InputError(f"{missing[0]}: expected a value ({missing[0]}=...); found none")
    config = OmegaConf.to_container(cfg, resolve=True)
    return {group: config[group] for group in KINDS if group in config} | config


def check_ablation(cfg: DictConfig, hydra_node: DictConfig) -> None:
    """Check that each key set by the chosen ablation has its value, unless the command line sets it.

    Args:
        cfg: Composed configuration.
        hydra_node: Node ``hydra`` of the application that composed it.

    Raises:
        InputError: A key has another value.
    """
    name = hydra_node.runtime.choices.get("ablation")
    wanted = _ablation_values(name)
    composed = OmegaConf.to_container(cfg)
    # with interpolations as typed
    overrides = OmegaConf.to_container(hydra_node.overrides.task)
    given = [part.key_or_group for part in OverridesParser.create().parse_overrides(overrides)]
    for key, value in wanted.items():
        present = lookup(composed, key)
        holds = present == value or is_below(key, ["hydra", *given])
        require(holds, key, f"{value!r}, as ablation/{name}.yaml sets it", present)


def _ablation_values(name: str | None) -> dict[str, Any]:
    """Dotted keys set by an option of the group ``ablation``, with its values; empty for None."""
    if name is None:
        return {}
    file = GlobalHydra.instance().config_loader().repository.load_config(f"ablation/{name}")
    values = flatten(OmegaConf.to_container(file.config))
    return {key: value for key, value in values.items() if key}


def chosen_options(config: Mapping[str, Any], hydra_node: DictConfig) -> dict[str, Any]:
    """Names by which tables identify a run, for the key ``chosen`` of its configuration.

    Args:
        config: Resolved configuration of a training.
        hydra_node: Node ``hydra`` of the application that composed it.

    Returns:
        ``model``, ``encoder`` and ``ablation``: names of the chosen options, or None; ``sets``: dotted
            keys set by the ablation, with their values in ``config``.
    """
    choices = hydra_node.runtime.choices
    names = {group: choices.get(group) for group in ("model", "encoder", "ablation")}
    return {**names, "sets": {key: lookup(config, key) for key in _ablation_values(names["ablation"])}}


def read_options(group: str, names: Sequence[str], run: Run, key: str) -> dict[str, dict[str, Any]]:
    """Options of a group by name.

    Args:
        group: Name of the group, such as ``skip``.
        names: Names of the options.
        run: The option chosen in this run has the run's values instead of those of its file.
        key: Start of error messages.

    Raises:
        InputError: The group has no such option.
    """
    chosen = getattr(run, group).name
    return {name: run.plain[group] if name == chosen else read_option(group, name, key) for name in names}


def read_option(group: str, name: str, key: str | None = None) -> dict[str, Any]:
    """Values of ``<group>/<name>.yaml``, including its defaults list, as plain data.

    A running application of the package also searches the user's ``--config-dir``.

    Args:
        group: Name of the group; subgroups are separated by slashes.
        name: Name of the option.
        key: Start of error messages; None: the group.

    Raises:
        InputError: The group has no such option.
    """
    with nullcontext() if _is_own_application() else _application():
        known = sorted(GlobalHydra.instance().config_loader().get_group_options(group))
        if name in known:
            node = OmegaConf.select(fill(hydra.compose(f"{group}/{name}")), group.replace("/", "."))
            return OmegaConf.to_container(node, resolve=True)
    hint = did_you_mean(name, known)
    raise InputError(f"{key or group}: expected one of {', '.join(known)}; found {name!r}{hint}")
