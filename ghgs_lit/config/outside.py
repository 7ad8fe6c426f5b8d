"""Files of ``--config-dir`` and ``hydra.searchpath``, and what they may say to Hydra.

Such files can come from somebody else. What they say of the package's groups are options, which are
checked as all options are; but the node ``hydra`` can set environment variables, call functions and
write shell scripts. Of it these files may set :data:`SETTABLE`; the command line may set all of it.
"""

import itertools
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml
from hydra._internal.core_plugins import file_config_source
from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult
from omegaconf import OmegaConf

from ghgs_lit.config.defaults import of_verb, open_nodes
from ghgs_lit.config.folder import conf_dir
from ghgs_lit.config.keys import flatten, is_below, require_plain
from ghgs_lit.config.registry import verbs
from ghgs_lit.config.spelling import keep_spelling, spelling_is_kept
from ghgs_lit.errors import InputError

#: Of launchers: names and numbers for the queue and the processes, no commands.
_LAUNCHER = """
    n_jobs backend prefer verbose timeout batch_size
    submitit_folder timeout_min cpus_per_task gpus_per_node tasks_per_node mem_gb nodes name stderr_to_stdout
    partition qos comment constraint exclude gres cpus_per_gpu gpus_per_task mem_per_gpu mem_per_cpu account
    signal_delay_s max_num_timeout array_parallelism
"""
#: Of sweepers: the grid, and Optuna's study.
_SWEEPER = """
    params max_batch_size direction storage study_name n_trials n_jobs max_failure_rate sampler search_space
"""
#: What a file outside of the package may set below ``hydra``.
SETTABLE = (
    "mode", "verbose", "run.dir", "sweep.dir", "sweep.subdir", "job.name", "job.chdir", "job.config",
    *(f"launcher.{key}" for key in _LAUNCHER.split()),
    *(f"sweeper.{key}" for key in _SWEEPER.split()),
)  # fmt: skip
#: Classes that it may name; Hydra itself demands that the first two are registered plugins.
_CLASSES = {
    "launcher._target_": r"(hydra_plugins|hydra\._internal\.core_plugins)\.[\w.]+",
    "sweeper._target_": r"(hydra_plugins|hydra\._internal\.core_plugins)\.[\w.]+",
    "sweeper.sampler._target_": r"optuna\.samplers\.\w+Sampler",
}


class FileConfigSource(file_config_source.FileConfigSource):
    """Hydra's reader of files, which checks those that do not belong to the package."""

    # Hydra's registry takes a class of this name for its own, and then does not replace it.

    def load_config(self, config_path: str) -> ConfigResult:
        file = Path(self.path, self._normalize_file_name(config_path))
        is_outside = Path(self.path) != conf_dir()
        if is_outside and file.is_file():
            with file.open(encoding="utf-8") as stream:  # references are not written out yet
                require_plain(yaml.load(stream, yaml.BaseLoader), str(file))
        result = super().load_config(config_path)
        if not OmegaConf.is_dict(result.config):
            return result
        package = result.header.get("package") or ""
        content = OmegaConf.to_container(result.config)
        if is_outside:
            check_file(file, config_path, package, content)
        name = config_path.removesuffix(".yaml")
        if name in verbs():
            result.config = OmegaConf.create(of_verb(name, content))
        open_nodes(name, package, result.config)
        return result


def check_outside_files() -> None:
    """Let all later applications of this process read files as :class:`FileConfigSource` does,
    and keep the spelling of names."""
    keep_spelling()
    SourcesRegistry.instance().types["file"] = FileConfigSource


@contextmanager
def files_are_read() -> Iterator[None]:
    """Let applications of the block read files so; those of another program do not."""
    Plugins.instance()  # registers Hydra's own
    types = SourcesRegistry.instance().types
    before = types["file"]
    try:
        with spelling_is_kept():
            check_outside_files()
            yield
    finally:
        types["file"] = before


def check_file(file: Path, name: str, package: str, content: Mapping[str, Any]) -> None:
    """Check a configuration file that is not the package's.

    Args:
        file: its path, for messages.
        name: the group and its option, such as ``hydra/launcher/mine``.
        package: what its line ``@package`` says; empty: its group.
        content: its keys, unresolved.

    Raises:
        InputError: it says something to Hydra that is not in :data:`SETTABLE`; names file and key.
    """
    group = ".".join(name.split("/")[:-1])
    parts = (package or group).replace("_group_", group).removeprefix("_global_").strip(".").split(".")
    entries = [key for key in _defaults(content.get("defaults")) if "@" in key]
    moves = [key for key in entries if parts[0] == "hydra" or "hydra" in key.partition("@")[2]]
    if moves:
        raise InputError(f"{file}: defaults: expected nothing that is moved into hydra; found {moves[0]!r}")
    nodes = [content.get("hydra", {})]
    if parts[0] == "hydra":
        node: Any = {key: value for key, value in content.items() if key != "defaults"}
        for part in reversed(parts[1:]):
            node = {part: node}
        nodes.append(node)
    for key, value in itertools.chain.from_iterable(flatten(node).items() for node in nodes):
        if not _may_set(key, value):
            expected = f"keys of {', '.join(SETTABLE[:8])}, and names and numbers of launcher and sweeper"
            raise InputError(f"{file}: hydra: expected {expected}; found hydra.{key}={value!r}")


def _defaults(entries: Any) -> Iterator[str]:
    """Groups and packages that a list of defaults names."""
    for entry in entries or ():
        yield from entry if isinstance(entry, Mapping) else [str(entry)]


def _may_set(key: str, value: Any) -> bool:
    """Whether a file outside of the package may set a key to a value.

    Args:
        key: dotted key below ``hydra``.
        value: unresolved.
    """
    if key in _CLASSES:
        return isinstance(value, str) and re.fullmatch(_CLASSES[key], value) is not None
    if any(part.startswith("_") for part in key.split(".")):  # a word of Hydra's instantiate
        return False
    if value == {}:
        return True
    values = value if isinstance(value, list) else [value]
    return is_below(key, SETTABLE) and all(_is_plain(item, key) for item in values)


def _is_plain(value: Any, key: str) -> bool:
    """Whether a value is one, in one line; of what Hydra instantiates not a reference
    to another node.

    Args:
        value: without lists and mappings.
        key: dotted key below ``hydra``.
    """
    if not isinstance(value, str):
        return value is None or isinstance(value, bool | int | float)
    refers = re.match(r"\s*\$\{(?!hydra\.|sqlite:|now:)", value) and is_below(key, ["launcher", "sweeper"])
    return value.isprintable() and not refers
