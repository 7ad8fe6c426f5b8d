"""Make Hydra 1.3, on import, read each file once, merge the same files once and copy quickly.

Composing configurations otherwise takes a quarter of the suite's time.
"""

import copy
import functools
import pickle
from pathlib import Path

import yaml
from hydra import version
from hydra._internal import defaults_list
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import CachingConfigRepository, ConfigRepository
from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra.core.object_type import ObjectType
from omegaconf import DictConfig, ListConfig, OmegaConf, omegaconf

_load, _merge = ConfigRepository.load_config, ConfigLoaderImpl._compose_config_from_defaults_list
_map = getattr(defaults_list, "_create_interpolation_map", None)  # only in Hydra 1.3
# pickled, because callers change composed configurations
_pickled: dict[tuple, bytes] = {}


def _map_where_needed(overrides, defaults, *arguments):
    """Skip the map that Hydra makes for each file, a third of its time, unless interpolations need it."""
    return _map(overrides, defaults, *arguments) if any(d.is_interpolation() for d in defaults) else None


def _load_once(self, config_path):
    source = self._find_object_source(config_path, ObjectType.CONFIG)
    stamp = None
    if isinstance(source, FileConfigSource):  # a user's file may change
        found = Path(source.path, source._normalize_file_name(config_path)).stat()
        stamp = found.st_mtime_ns, found.st_size, found.st_ino
    key = source and (config_path, source.provider, source.path, stamp)
    if key not in _pickled:
        result = _load(self, config_path)
        if result is None:
            return None
        result.key = key
        _pickled[key] = pickle.dumps(result)
    return pickle.loads(_pickled[key])


def _merge_once(self, defaults, repo):
    read = [(d.package, d.primary, repo.load_config(d.config_path)) for d in defaults]
    key = tuple((package, primary, result and result.key) for package, primary, result in read)
    if key not in _pickled:
        merged = _merge(self, defaults, repo)
        OmegaConf.clear_cache(merged)  # such as resolved times
        _pickled[key] = pickle.dumps(merged)
    return pickle.loads(_pickled[key])


def _copied(self, memo):
    """A deep copy with the same parent; OmegaConf's takes ten times as long."""
    parent, self.__dict__["_parent"] = self.__dict__["_parent"], None
    try:
        copied = pickle.loads(pickle.dumps(self))
    finally:
        self.__dict__["_parent"] = parent
    copied.__dict__["_parent"] = parent
    return copied


def _keep_repository(self, delegate):
    """Copy only the list of sources, the part that Hydra replaces; Hydra deep-copies the sources."""
    self.delegate, self.cache = copy.copy(delegate), {}


def _quick_dumper():
    """OmegaConf's dumper on LibYAML."""
    dumper = type("Dumper", (getattr(yaml, "CDumper", yaml.Dumper),), {})
    dumper.add_representer(str, omegaconf.get_omega_conf_dumper().str_representer)
    return dumper


_dumper = _quick_dumper()
omegaconf.get_omega_conf_dumper = lambda: _dumper
DictConfig.__deepcopy__ = ListConfig.__deepcopy__ = _copied
if _map is not None:
    # LibYAML is faster.
    yaml.SafeLoader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    version._get_version = functools.cache(version._get_version)
    defaults_list._create_interpolation_map = _map_where_needed
    CachingConfigRepository.__init__ = _keep_repository
    ConfigRepository.load_config = _load_once
    ConfigLoaderImpl._compose_config_from_defaults_list = _merge_once
