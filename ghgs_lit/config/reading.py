"""Find and read files for Hydra, and restrict what external files may set.

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
from pathlib import Path
from typing import Any

import hydra
from hydra._internal.core_plugins import file_config_source
from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult
from omegaconf import DictConfig, OmegaConf

from ghgs_lit.config.defaults import open_nodes, verb_values
from ghgs_lit.config.keys import flatten, is_below
from ghgs_lit.config.registry import verbs
from ghgs_lit.errors import InputError, require
from ghgs_lit.parsing import check_yaml, read_parsed

#: Hydra 1.3 requires the version to be compatible with; later versions do not accept it.
VERSION_BASE: dict[str, Any] = {"version_base": "1.3"} if hydra.__version__.startswith("1.3") else {}


def conf_dir() -> Path:
    """Absolute path of ``conf``: inside the package in a wheel, next to it in a checkout.

    Raises:
        InputError: Neither folder exists.
    """
    package = Path(__file__).resolve().parents[1]
    candidates = (package / "conf", package.parent / "conf")
    for candidate in candidates:
        if (candidate / "train.yaml").is_file():
            return candidate
    raise InputError(
        f"configuration: expected train.yaml in one of {', '.join(map(str, candidates))}; found none"
    )


#: Keys below ``hydra`` that an external file may set.
SETTABLE = ("mode", "run.dir", "sweep.dir", "sweep.subdir", "job.name", "sweeper.params")
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
    """Make Hydra read files with :class:`FileConfigSource` in this process from now on."""
    SourcesRegistry.instance().types["file"] = FileConfigSource


@contextmanager
def reading_as_ghgs() -> Iterator[None]:
    """Apply :func:`read_as_ghgs` within the block only; Hydra applications of other programs are not
    affected."""
    Plugins.instance()  # registers Hydra's sources
    types = SourcesRegistry.instance().types
    before = types["file"]
    read_as_ghgs()
    try:
        yield
    finally:
        types["file"] = before


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
    # Packages accumulate along the lists of defaults.
    packages = [package, *re.findall(r"@[^'\"]*", str(content.get("defaults")))]
    if name.startswith("hydra/"):
        packages.append(name)
    for each in packages:
        require("hydra" not in each, f"{file}: @package", "a package outside of hydra", each)
    for key, value in flatten(content).items():
        # Hydra drops backslashes from grid values.
        others = _REFERENCE.sub("", f"{key}={value}".replace("\\", ""))
        require("${" not in others, f"{file}: {key}", "no interpolations but references to keys", value)
        if is_below(key, ["hydra"]) and not _may_set(key, value):
            expected = f"no keys but {', '.join(SETTABLE)}, with values that are no objects"
            raise InputError(f"{file}: hydra: expected {expected}; found {key}={value!r}")


def _may_set(key: str, value: Any) -> bool:
    """Whether an external file may set a dotted key to an unresolved value: Hydra instantiates mappings with
    keys such as ``_target_``, also where a value refers to one, and keys of a grid are overrides."""
    name = key.removeprefix("hydra.")
    refers = name.startswith("sweeper") and str(value).lstrip().startswith("$")
    is_override = re.search(r"\._|hydra", name) is not None
    return is_below(name, SETTABLE) and not (refers or is_override or isinstance(value, dict | list))
