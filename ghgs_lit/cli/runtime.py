"""What all verbs share: the run's directory, its saved configuration and the path printed last."""

from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from ghgs_lit.config import resolve
from ghgs_lit.config.compose import HEADER, saved_text
from ghgs_lit.errors import require
from ghgs_lit.files import write_text_atomically


def output_dir() -> Path:
    """Absolute path of this run's directory, which Hydra makes."""
    return Path(HydraConfig.get().runtime.output_dir).resolve()


def write_config(config: dict[str, Any], directory: Path) -> None:
    """Write ``directory/config.yaml`` and print its path. InputError: another program's file is there."""
    path = directory / "config.yaml"
    is_free = not path.is_file() or path.read_text(errors="replace").startswith(HEADER)
    require(is_free, str(path), "no file, or the configuration of an earlier run", "another file")
    write_text_atomically(path, saved_text(config))
    overrides = " ".join(HydraConfig.get().overrides.task) if HydraConfig.initialized() else ""
    print(f"config: {path} ({overrides or 'no overrides'})", flush=True)


def save_config(cfg: DictConfig, directory: Path) -> dict[str, Any]:
    """Resolve the configuration and write it; return it as plain data."""
    config = resolve(cfg)
    write_config(config, directory)
    return config


def announce(path: Path | str) -> None:
    """Print the path of the results, as the last line of a verb."""
    print(f"wrote {path}", flush=True)
