"""What ``predict images=...`` and ``doctor task=cameras`` share: the folder of a configuration."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ghgs_lit.errors import InputError, require
from ghgs_lit.prediction.capture.folder import CaptureFolder
from ghgs_lit.readers import require_data_folder
from ghgs_lit.weights.reading import require_weights

_BEGUN: list[CaptureFolder] = []  #: The folder that is being read, if any

_SOURCES = ("images", "cameras", "masks", "backgrounds", "segment", "calibration", "sequence")
_CHECKED = 5  #: How many instants of a sequence the check of cameras looks at


def sources_of(config: Mapping[str, Any]) -> dict[str, Any]:
    """``images``, ``cameras`` and the keys beside them. InputError: one of both is missing."""
    for name, example in (("images", "images=<folder of photographs>"), ("cameras", "cameras=<calibration>")):
        require(config[name] is not None, name, example, None)
    return {name: config[name] for name in _SOURCES if name in config}


def capture_folder(config: Mapping[str, Any]) -> CaptureFolder:
    """The folder that ``images``, ``cameras`` and the keys beside them describe. InputError: one of both is
    missing, or a file is missing or wrong."""
    folder = CaptureFolder(**sources_of(config))
    return _BEGUN.pop() if [folder] == _BEGUN else folder


def begin_to_read(config: Mapping[str, Any]) -> None:
    """Decode the photographs of the first instant, which the next :func:`capture_folder` then has.
    InputError: as :func:`capture_folder`."""
    _BEGUN[:] = [capture_folder(config)]
    if config["segment"] is None:
        _BEGUN[0].begin(_BEGUN[0].instants[0])


def check_cameras(folder: CaptureFolder) -> None:
    """Print how cameras and masks agree, in a few instants of a sequence, and which contradict. InputError:
    all contradict, or the only instant cannot be read."""
    from ghgs_lit.prediction.capture.camera_report import diagnose, in_parts

    names, found = folder.instants, {}
    last = len(names) - 1
    for place in sorted({round(last * i / (_CHECKED - 1)) for i in range(_CHECKED)}):
        try:
            found[names[place]] = diagnose(folder, names[place])
        except InputError:
            if not last:
                raise
    for name, diagnosis in found.items():
        parts = in_parts(diagnosis.ranking[0].views)
        if len(parts) > 1:
            print(f"instant {name}: masks of {', '.join(parts)} have two large parts, taken for one subject")
        if not diagnosis.consistent and last:
            print(f"instant {name}: cameras and masks do not fit: {'; '.join(diagnosis.lines)}", flush=True)
    sound = [diagnosis for diagnosis in found.values() if diagnosis.consistent]
    for diagnosis in (sound or list(found.values()))[:1]:
        if not diagnosis.consistent:
            raise InputError(
                "cameras: expected cameras that fit photographs and masks (ghgs doctor draws them,"
                f" check_cameras=false goes on anyway); found {'; '.join(diagnosis.lines)}"
            )
        print("\n".join(diagnosis.lines), flush=True)


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
