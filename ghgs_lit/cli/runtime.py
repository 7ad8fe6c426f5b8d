"""Functions shared by all verbs: the run's directory, its saved configuration, output files and the path
printed last."""

from collections.abc import Sequence
from pathlib import Path

from hydra.core.hydra_config import HydraConfig

from ghgs_lit.cli.verb import Verb
from ghgs_lit.config.compose import HEADER, saved_text
from ghgs_lit.config.run import Run
from ghgs_lit.errors import require
from ghgs_lit.files import require_free, resolve_path, write_text_atomically


def output_dir() -> Path:
    """Absolute path of the run's directory, which Hydra creates."""
    return resolve_path(HydraConfig.get().runtime.output_dir)


def write_config(run: Run, directory: Path) -> None:
    """Write ``directory/config.yaml`` and print its path.

    Raises:
        InputError: The file exists and was written by another program.
    """
    path = directory / "config.yaml"
    is_free = not path.is_file() or path.read_text(errors="replace").startswith(HEADER)
    require(is_free, str(path), "no file, or the configuration of an earlier run", "another file")
    write_text_atomically(path, saved_text(run.plain))
    overrides = HydraConfig.get().overrides.task if HydraConfig.initialized() else []
    words = " ".join(text.removeprefix("++") for text in overrides)  # ++ is added by ghgs
    print(f"config: {path} ({words or 'no overrides'})", flush=True)


def files_to_write(options: Verb, keys: Sequence[str], read: Sequence[str | Path] = ()) -> dict[str, Path]:
    """Paths of the output files of a verb by key, without keys that are null.

    Args:
        options: Keys of the verb, including ``overwrite``.
        keys: Keys that hold paths of output files.
        read: Files that the verb reads.

    Raises:
        InputError: A file exists and ``overwrite`` is false, it is one of ``read``, or two keys have the
            same path.
    """
    named = {key: getattr(options, key) for key in keys}
    paths = {key: Path(path).expanduser() for key, path in named.items() if path is not None}
    taken = {resolve_path(path) for path in read}
    for key, path in paths.items():
        require(resolve_path(path) not in taken, key, "a file of its own", str(path))
        require_free(path, key, options.overwrite)
        taken.add(resolve_path(path))
    return paths


def announce(path: Path | str) -> None:
    """Print the path of the results as the last line of a verb's output."""
    print(f"wrote {path}", flush=True)
