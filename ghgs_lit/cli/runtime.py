"""What all verbs share: the run's directory, its saved configuration and the path printed last."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from ghgs_lit.cli.verb import Verb
from ghgs_lit.config import resolve
from ghgs_lit.config.compose import HEADER, saved_text
from ghgs_lit.errors import require
from ghgs_lit.files import require_free, resolved, write_text_atomically


def output_dir() -> Path:
    """Absolute path of this run's directory, which Hydra makes."""
    return resolved(HydraConfig.get().runtime.output_dir)


def write_config(config: dict[str, Any], directory: Path) -> None:
    """Write ``directory/config.yaml`` and print its path.

    Args:
        config: the whole configuration as plain data.
        directory: the run's.

    Raises:
        InputError: another program's file is there.
    """
    path = directory / "config.yaml"
    is_free = not path.is_file() or path.read_text(errors="replace").startswith(HEADER)
    require(is_free, str(path), "no file, or the configuration of an earlier run", "another file")
    write_text_atomically(path, saved_text(config))
    overrides = " ".join(HydraConfig.get().overrides.task) if HydraConfig.initialized() else ""
    print(f"config: {path} ({overrides or 'no overrides'})", flush=True)


def save_config(cfg: DictConfig, directory: Path) -> dict[str, Any]:
    """Resolve the configuration and write it.

    Args:
        cfg: the whole configuration that Hydra composed.
        directory: the run's.

    Returns:
        The configuration as plain data.

    Raises:
        InputError: a value is wrong, or another program's file is there.
    """
    config = resolve(cfg)
    write_config(config, directory)
    return config


def files_to_write(options: Verb, keys: Sequence[str], read: Sequence[str | Path] = ()) -> dict[str, Path]:
    """Paths of the files that keys of a verb name, by key, without those that are null.

    Args:
        options: keys of the verb, ``overwrite`` among them.
        keys: those that name files.
        read: files that the verb reads.

    Raises:
        InputError: a file exists and ``overwrite`` is false, it is one of ``read``, or two
            keys name one.
    """
    named = {key: getattr(options, key) for key in keys}
    paths = {key: Path(path).expanduser() for key, path in named.items() if path is not None}
    taken = {resolved(path) for path in read}
    for key, path in paths.items():
        require(resolved(path) not in taken, key, "a file of its own", str(path))
        require_free(path, key, options.overwrite)
        taken.add(resolved(path))
    return paths


def announce(path: Path | str) -> None:
    """Print the path of the results, as the last line of a verb."""
    print(f"wrote {path}", flush=True)
