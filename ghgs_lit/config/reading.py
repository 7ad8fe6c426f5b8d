"""Read overrides and files for Hydra, and limit what others' files may set.

Others' are those of ``--config-dir`` and ``hydra.searchpath``.
Such files can come from somebody else. Their keys of the package's groups are options, which are
checked as all options are; but the node ``hydra`` can set environment variables, call functions and
write shell scripts, and resolvers such as ``${oc.env:...}`` read secrets. In such a file the only
interpolations are references to keys, and of ``hydra`` it may set :data:`SETTABLE`; the command line
may set all of it.
"""

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import Any

import yaml
from hydra._internal.core_plugins import file_config_source
from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.override_parser import overrides_parser
from hydra.core.override_parser.overrides_visitor import HydraOverrideVisitor
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult
from omegaconf import DictConfig, OmegaConf, _utils

from ghgs_lit.config.defaults import of_verb, open_nodes
from ghgs_lit.config.folder import conf_dir
from ghgs_lit.config.keys import flatten, is_below
from ghgs_lit.config.registry import verbs
from ghgs_lit.errors import InputError, require
from ghgs_lit.parsing import check_yaml, read_parsed

#: Of launchers: names and numbers for the queue and the processes, no commands.
_LAUNCHER = """
    n_jobs backend prefer verbose timeout batch_size
    submitit_folder timeout_min cpus_per_task gpus_per_node tasks_per_node mem_gb nodes name stderr_to_stdout
    partition qos comment constraint exclude gres cpus_per_gpu gpus_per_task mem_per_gpu mem_per_cpu account
    signal_delay_s max_num_timeout array_parallelism
"""
#: What a file outside of the package may set below ``hydra``.
SETTABLE = (
    "mode", "verbose", "run.dir", "sweep.dir", "sweep.subdir", "job.name", "job.chdir", "job.config",
    *(f"launcher.{key}" for key in _LAUNCHER.split()),
    "sweeper.params", "sweeper.max_batch_size",
)  # fmt: skip
#: Classes that it may name; Hydra itself demands that the first two are registered plugins.
_CLASSES = {
    "launcher._target_": r"(hydra_plugins|hydra\._internal\.core_plugins)\.[\w.]+",
    "sweeper._target_": r"(hydra_plugins|hydra\._internal\.core_plugins)\.[\w.]+",
}
#: An interpolation that calls no resolver.
_REFERENCE = re.compile(r"\$\{[\w.\[\]-]+\}")
#: More values than any configuration has.
_MOST_VALUES = 100_000


class FileConfigSource(file_config_source.FileConfigSource):
    """Hydra's reader of files, which checks those that do not belong to the package."""

    # Hydra's registry takes a class of this name for its default, and then does not replace it.

    def load_config(self, config_path: str) -> ConfigResult:
        file = Path(self.path, self._normalize_file_name(config_path))
        if Path(self.path) == conf_dir() or not file.is_file():
            result = super().load_config(config_path)
        else:
            header, config = read_parsed(file, "YAML", _parsed)
            result = ConfigResult(self.provider, f"file://{self.path}", config, header)
            check_file(file, config_path, header.get("package") or "", config)
        if OmegaConf.is_dict(result.config):
            name = config_path.removesuffix(".yaml")
            if name in verbs():
                result.config = OmegaConf.create(of_verb(name, OmegaConf.to_container(result.config)))
            open_nodes(name, result.header.get("package") or "", result.config)
        return result


def _parsed(text: str) -> tuple[dict[str, str | None], DictConfig]:
    """The header of a file as Hydra reads it, and the content."""
    check_yaml(text, most=_MOST_VALUES)
    return FileConfigSource._get_header_dict(text[:512]), OmegaConf.load(io.StringIO(text))


def read_as_ghgs() -> None:
    """Let Hydra read files as :class:`FileConfigSource` in this process from now on, and keep the spelling
    of names."""
    overrides_parser.HydraOverrideVisitor = SpellingVisitor
    _utils.get_yaml_loader = yaml_loader
    SourcesRegistry.instance().types["file"] = FileConfigSource


@contextmanager
def reading_as_ghgs() -> Iterator[None]:
    """Let applications of the block read so; those of another program do not."""
    Plugins.instance()  # registers Hydra's sources
    types = SourcesRegistry.instance().types
    before = types["file"], overrides_parser.HydraOverrideVisitor, _utils.get_yaml_loader
    read_as_ghgs()
    try:
        yield
    finally:
        types["file"], overrides_parser.HydraOverrideVisitor, _utils.get_yaml_loader = before


#: Keys of Hydra that are paths and names, whatever they spell.
_PATHS = ("hydra.run.", "hydra.sweep.", "hydra.job.")
#: Functions of overrides whose arguments are numbers.
_OF_NUMBERS = ("range", "interval")

_yaml_loader = _utils.get_yaml_loader


class SpellingVisitor(HydraOverrideVisitor):
    """Hydra's reader of overrides, which keeps whole numbers that are spelled in an unusual way as texts,
    such as ``2024_05_17``, which Hydra reads as 20240517. Keys that are numbers take such texts, too."""

    _is_path = False
    _are_numbers = False

    def visitKey(self, ctx: Any) -> Any:
        key = super().visitKey(ctx)
        self._is_path = key.key_or_group.startswith(_PATHS)
        return key

    def visitFunction(self, ctx: Any) -> Any:
        self._are_numbers = ctx.getText().partition("(")[0] in _OF_NUMBERS
        try:
            return super().visitFunction(ctx)
        finally:
            self._are_numbers = False

    def _createPrimitive(self, ctx: Any) -> Any:
        value = super()._createPrimitive(ctx)
        if self._are_numbers or not (type(value) is int or (type(value) is float and self._is_path)):
            return value
        return _spelled(value, ctx.getText().strip())


def yaml_loader() -> type[yaml.SafeLoader]:
    """OmegaConf's reader of YAML, which keeps spellings, too: ``0426`` is octal in YAML 1.1."""
    loader = _yaml_loader()
    loader.add_constructor("tag:yaml.org,2002:int", _construct_int)
    return loader


def _construct_int(loader: yaml.SafeLoader, node: yaml.ScalarNode) -> int | str:
    return _spelled(loader.construct_yaml_int(node), node.value)


def _spelled(value: float, text: str) -> float | str:
    """A number, or its text where a number is usually written otherwise."""
    return value if str(value) == text.removeprefix("+") else text


def check_file(file: Path, name: str, package: str, config: Any) -> None:
    """Check a configuration file that is not the package's.

    Args:
        file: its path, for messages.
        name: the group and its option, such as ``hydra/launcher/mine``.
        package: of its line ``@package``; empty: its group.
        config: its content, unresolved.

    Raises:
        InputError: it has an interpolation that is no reference to a key, or sets something of Hydra
            that is not in :data:`SETTABLE`; names file and key.
    """
    content = OmegaConf.to_container(config)
    require(isinstance(content, dict), str(file), "keys with values", content)
    for key, value in flatten(content).items():
        # Hydra drops backslashes of the values of a grid.
        others = _REFERENCE.sub("", f"{key}={value}".replace("\\", ""))
        require("${" not in others, f"{file}: {key}", "no interpolations but references to keys", value)
    *groups, _ = name.split("/")
    is_of_hydra = groups[:1] == ["hydra"]
    # The packages of files add up along their lists of defaults.
    require("hydra" not in package, f"{file}: @package", "a package outside of hydra", package)
    for entry in chain(*map(_groups, content.pop("defaults", None) or ())):
        moves = "hydra" in entry.partition("@")[2] or (is_of_hydra and re.search("@|^/", entry))
        require(not moves, f"{file}: defaults", "nothing that is moved into hydra", entry)
    prefix = ".".join(groups) if is_of_hydra and package != "_global_" else ""
    for key, value in flatten(content, prefix).items():
        below = key.removeprefix("hydra").removeprefix(".")
        if is_below(key, ["hydra"]) and not _may_set(below, value):
            expected = f"keys of {', '.join(SETTABLE[:8])}, and names and numbers of launcher and sweeper"
            raise InputError(f"{file}: hydra: expected {expected}; found {key}={value!r}")


def _groups(entry: Any) -> list[str]:
    """Groups and packages of an entry of a list of defaults."""
    return list(entry) if isinstance(entry, dict) else [str(entry)]


def _may_set(key: str, value: Any) -> bool:
    """Whether a file outside of the package may set a key to a value.

    Args:
        key: dotted key below ``hydra``.
        value: unresolved.
    """
    if key in _CLASSES:
        return isinstance(value, str) and re.fullmatch(_CLASSES[key], value) is not None
    # Hydra's instantiate has words such as _target_; a key of a grid is an override.
    if re.search(r"(^|\.)_|hydra", key):
        return False
    values = value if isinstance(value, list) else [value]
    return value == {} or (is_below(key, SETTABLE) and all(_is_plain(item, key) for item in values))


def _is_plain(value: Any, key: str) -> bool:
    """Whether a value is one, in one line; of what Hydra instantiates not a reference
    to another node.

    Args:
        value: without lists and mappings.
        key: dotted key below ``hydra``.
    """
    if not isinstance(value, str):
        return value is None or isinstance(value, bool | int | float)
    refers = re.match(r"\s*\$\{(?!hydra\.)", value) and is_below(key, ["launcher", "sweeper"])
    return value.isprintable() and not refers
