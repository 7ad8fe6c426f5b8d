"""What the verbs share: their directory, their configuration on disk and in print."""

from pathlib import Path

import rich
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from rich.syntax import Syntax

from ghgs_lit.errors import InputError, require


def output_dir() -> Path:
    """The directory of this run (absolute), made by Hydra."""
    return Path(HydraConfig.get().runtime.output_dir).resolve()


def plain(cfg: DictConfig) -> dict:
    """The configuration as plain data, interpolations resolved; a missing value or a bad seed is refused."""
    missing = OmegaConf.missing_keys(cfg)
    if missing:
        raise InputError(f"{sorted(missing)[0]}: expected a value ({sorted(missing)[0]}=...); found none")
    data = OmegaConf.to_container(cfg, resolve=True)
    seed = data.get("seed", 0)
    require(isinstance(seed, int) and 0 <= seed < 2**32, "seed", "an integer from 0 to 4294967295", seed)
    return data


def write_config(data: dict, directory: Path) -> None:
    """Print the full configuration and write it to ``directory/config.yaml``."""
    text = OmegaConf.to_yaml(OmegaConf.create(data))
    rich.print(Syntax(text, "yaml", theme="ansi_dark", background_color="default"))
    directory.mkdir(parents=True, exist_ok=True)
    (directory / "config.yaml").write_text(text)


def save_config(cfg: DictConfig, directory: Path) -> dict:
    """Print and write the full configuration, give it back as plain data."""
    data = plain(cfg)
    write_config(data, directory)
    return data


def announce(path: Path | str) -> None:
    """Print where the results lie; a verb's last line."""
    print(f"wrote {path}", flush=True)
