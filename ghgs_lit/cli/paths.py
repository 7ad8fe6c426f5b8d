"""Files and folders that a command reads, looked for before PyTorch is imported, which takes a second."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ghgs_lit.cli.photographs import begin_to_read
from ghgs_lit.readers import require_data_folder
from ghgs_lit.weights.reading import require_weights

#: Keys of checkpoints that these verbs open in any case.
_WEIGHTS = {
    "adapt": ("checkpoint",),
    "evaluate": ("checkpoint",),
    "export": ("checkpoint",),
    "predict": ("checkpoint",),
    "train": ("resume", "init_from"),
}
#: Verbs that read data and make none that has a folder of its own.
_READERS = ("evaluate", "predict", "pretext", "train")


def require_paths(verb: str, config: Mapping[str, Any]) -> None:
    """Refuse what is missing, in the words of what reads it later; photographs are decoded from here on.
    FileNotFoundError, InputError: a file or folder is missing or wrong."""
    for key in _WEIGHTS.get(verb, ()):
        if config[key] is not None:
            require_weights(config[key])
    has_photographs = config.get("images") is not None and config.get("cameras") is not None
    if has_photographs and (verb == "predict" or config.get("task") == "cameras"):
        begin_to_read(config)
    data = config.get("data")
    is_read = verb in _READERS and isinstance(data, Mapping) and not data.get("source")
    if is_read and isinstance(data.get("root"), str):
        require_data_folder(Path(data["root"]).expanduser())
