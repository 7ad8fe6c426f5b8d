"""Options of config groups by name, beside those that the composed configuration has."""

from contextlib import nullcontext
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf

from ghgs_lit.config.options import did_you_mean
from ghgs_lit.config.paths import VERSION_BASE, conf_dir
from ghgs_lit.errors import InputError


def read_option(group: str, name: str, key: str | None = None) -> dict[str, Any]:
    """The values of ``<group>/<name>.yaml``, its own defaults included, as plain data.

    Inside a Hydra application its search path counts, which has the user's ``--config-dir`` too. InputError:
    the group has no such option; names ``key``, or the group.
    """
    inside = GlobalHydra.instance().is_initialized()
    with nullcontext() if inside else initialize_config_dir(str(conf_dir()), **VERSION_BASE):
        known = sorted(GlobalHydra.instance().config_loader().get_group_options(group))
        if name in known:
            node = OmegaConf.select(compose(f"{group}/{name}"), group.replace("/", "."))
            return OmegaConf.to_container(node, resolve=True)
    hint = did_you_mean(name, known)
    raise InputError(f"{key or group}: expected one of {', '.join(known)}; found {name!r}{hint}")
