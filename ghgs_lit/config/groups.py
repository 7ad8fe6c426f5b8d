"""Options of config groups by name, beside those that the composed configuration has."""

import difflib
from contextlib import nullcontext
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf

from ghgs_lit.config.paths import conf_dir
from ghgs_lit.errors import InputError


def read_option(group: str, name: str, key: str | None = None) -> dict[str, Any]:
    """The values of ``<group>/<name>.yaml``, its own defaults included, as plain data.

    Inside a Hydra application its search path counts, which has the user's ``--config-dir`` too.

    Args:
        group: config group, such as ``targets``.
        name: option of the group.
        key: the configuration key that named the option, for messages (default: the group).

    Raises:
        InputError: the group has no such option.
    """
    inside = GlobalHydra.instance().is_initialized()
    with nullcontext() if inside else initialize_config_dir(str(conf_dir()), version_base="1.3"):
        known = sorted(_options(group))
        if name in known:
            return _read(group, name)
    close = difflib.get_close_matches(str(name), known, n=1)
    hint = f" (did you mean {close[0]}?)" if close else ""
    raise InputError(f"{key or group}: expected one of {', '.join(known)}; found {name!r}{hint}")


def _options(group: str) -> list[str]:
    return GlobalHydra.instance().config_loader().get_group_options(group)


def _read(group: str, name: str) -> dict[str, Any]:
    node = OmegaConf.select(compose(f"{group}/{name}"), group.replace("/", "."))
    return OmegaConf.to_container(node, resolve=True)
