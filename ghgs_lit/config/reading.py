"""Read overrides and files for Hydra, and restrict what external files may set.

External files are those of ``--config-dir`` and ``hydra.searchpath``, which may be untrusted. Their keys
of the package's groups are options and validated as such. The node ``hydra``, however, can set
environment variables, call functions and write shell scripts, and resolvers such as ``${oc.env:...}``
read secrets. Therefore the only interpolations allowed in such a file are references to keys, and of
``hydra`` it may set only :data:`SETTABLE`; the command line may set all of it.
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

from ghgs_lit.config.defaults import open_nodes, verb_values
from ghgs_lit.config.folder import conf_dir
from ghgs_lit.config.keys import flatten, is_below
from ghgs_lit.config.registry import verbs
from ghgs_lit.errors import InputError, require
from ghgs_lit.parsing import check_yaml, read_parsed

#: Keys of launchers: names and numbers for the queue and the processes, no commands.
_LAUNCHER = """
    n_jobs backend prefer verbose timeout batch_size
    submitit_folder timeout_min cpus_per_task gpus_per_node tasks_per_node mem_gb nodes name stderr_to_stdout
    partition qos comment constraint exclude gres cpus_per_gpu gpus_per_task mem_per_gpu mem_per_cpu account
    signal_delay_s max_num_timeout array_parallelism
"""
#: Keys below ``hydra`` that an external file may set.
SETTABLE = (
    "mode", "verbose", "run.dir", "sweep.dir", "sweep.subdir", "job.name", "job.chdir", "job.config",
    *(f"launcher.{key}" for key in _LAUNCHER.split()),
    "sweeper.params", "sweeper.max_batch_size",
)  # fmt: skip
#: Classes that it may set; Hydra requires these to be registered plugins.
_CLASSES = {
    "launcher._target_": r"(hydra_plugins|hydra\._internal\.core_plugins)\.[\w.]+",
    "sweeper._target_": r"(hydra_plugins|hydra\._internal\.core_plugins)\.[\w.]+",
}
#: Interpolation that calls no resolver.
_REFERENCE = re.compile(r"\$\{[\w.\[\]-]+\}")
#: Limit of the number of values, far above that of any configuration.
_MOST_VALUES = 100_000


class FileConfigSource(file_config_source.FileConfigSource):
    """Hydra's file reader, extended by checks of files that do not belong to the package."""

    # Hydra's registry treats a class of this name as its default, and then does not replace it.

    def load_config(self, config_path: str) -> ConfigResult:
        file = Path(self.path, self._normalize_file_name(config_path))
        if Path(self.path) == conf_dir() or not file.is_file():
            result = super().load_config(config_path)
        else:
            header, config = read_parsed(file, "YAML", _parse)
            result = ConfigResult(self.provider, f"file://{self.path}", config, header)
            check_file(file, config_path, header.get("package") or "", config)
        if OmegaConf.is_dict(result.config):
            name = config_path.removesuffix(".yaml")
            if name in verbs():
                result.config = OmegaConf.create(verb_values(name, OmegaConf.to_container(result.config)))
            open_nodes(name, result.header.get("package") or "", result.config)
        return result


def _parse(text: str) -> tuple[dict[str, str | None], DictConfig]:
    """Header of a file as Hydra reads it, and the content."""
    check_yaml(text, most=_MOST_VALUES)
    return FileConfigSource._get_header_dict(text[:512]), OmegaConf.load(io.StringIO(text))


def read_as_ghgs() -> None:
    """Make Hydra read files with :class:`FileConfigSource` in this process from now on, and keep the
    spelling of names."""
    overrides_parser.HydraOverrideVisitor = SpellingVisitor
    _utils.get_yaml_loader = yaml_loader
    SourcesRegistry.instance().types["file"] = FileConfigSource


@contextmanager
def reading_as_ghgs() -> Iterator[None]:
    """Apply :func:`read_as_ghgs` within the block only; Hydra applications of other programs are not
    affected."""
    Plugins.instance()  # registers Hydra's sources
    types = SourcesRegistry.instance().types
    before = types["file"], overrides_parser.HydraOverrideVisitor, _utils.get_yaml_loader
    read_as_ghgs()
    try:
        yield
    finally:
        types["file"], overrides_parser.HydraOverrideVisitor, _utils.get_yaml_loader = before


#: Keys of Hydra that are paths or names, even if they look like numbers.
_PATHS = ("hydra.run.", "hydra.sweep.", "hydra.job.")
#: Override functions whose arguments are numbers.
_OF_NUMBERS = ("range", "interval")

_yaml_loader = _utils.get_yaml_loader


class SpellingVisitor(HydraOverrideVisitor):
    """Hydra's parser of overrides, modified to keep integers with unusual spelling as text.

    For example, Hydra reads ``2024_05_17`` as 20240517. Numeric keys accept such texts, too.
    """

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
        return _keep_spelling(value, ctx.getText().strip())


def yaml_loader() -> type[yaml.SafeLoader]:
    """OmegaConf's YAML loader, modified to keep spellings, too: ``0426`` is octal in YAML 1.1."""
    loader = _yaml_loader()
    loader.add_constructor("tag:yaml.org,2002:int", _construct_int)
    return loader


def _construct_int(loader: yaml.SafeLoader, node: yaml.ScalarNode) -> int | str:
    return _keep_spelling(loader.construct_yaml_int(node), node.value)


def _keep_spelling(value: float, text: str) -> float | str:
    """The number, or its text if numbers are not usually written this way."""
    return value if str(value) == text.removeprefix("+") else text


def check_file(file: Path, name: str, package: str, config: Any) -> None:
    """Check an external configuration file.

    Args:
        file: Path of the file, for messages.
        name: Group and option, such as ``hydra/launcher/mine``.
        package: Value of its ``@package`` line; empty: its group.
        config: Content of the file, unresolved.

    Raises:
        InputError: The file has an interpolation other than a reference to a key, or sets a key of Hydra
            outside :data:`SETTABLE`; the message contains file and key.
    """
    content = OmegaConf.to_container(config)
    require(isinstance(content, dict), str(file), "keys with values", content)
    for key, value in flatten(content).items():
        # Hydra drops backslashes from grid values.
        others = _REFERENCE.sub("", f"{key}={value}".replace("\\", ""))
        require("${" not in others, f"{file}: {key}", "no interpolations but references to keys", value)
    *groups, _ = name.split("/")
    is_of_hydra = groups[:1] == ["hydra"]
    # Packages accumulate along the lists of defaults.
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
    """Groups and packages of an entry of a defaults list."""
    return list(entry) if isinstance(entry, dict) else [str(entry)]


def _may_set(key: str, value: Any) -> bool:
    """Whether an external file may set a dotted key below ``hydra`` to an unresolved value."""
    if key in _CLASSES:
        return isinstance(value, str) and re.fullmatch(_CLASSES[key], value) is not None
    # Hydra's instantiate has keywords such as _target_; keys of a grid are overrides.
    if re.search(r"(^|\.)_|hydra", key):
        return False
    values = value if isinstance(value, list) else [value]
    return value == {} or (is_below(key, SETTABLE) and all(_is_plain(item, key) for item in values))


def _is_plain(value: Any, key: str) -> bool:
    """Whether a scalar is on one line and, for objects that Hydra instantiates, does not refer to another
    node."""
    if not isinstance(value, str):
        return value is None or isinstance(value, bool | int | float)
    refers = re.match(r"\s*\$\{(?!hydra\.)", value) and is_below(key, ["launcher", "sweeper"])
    return value.isprintable() and not refers
