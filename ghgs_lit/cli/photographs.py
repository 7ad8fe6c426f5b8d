"""What ``predict images=...`` and ``doctor task=cameras`` share: the folder of a configuration."""

from collections.abc import Mapping
from typing import Any

from ghgs_lit.capture.doctor import Diagnosis
from ghgs_lit.capture.folder import CaptureFolder
from ghgs_lit.errors import InputError, require

_SOURCES = ("images", "cameras", "masks", "backgrounds", "segment", "calibration")


def capture_folder(config: Mapping[str, Any]) -> CaptureFolder:
    """The folder that ``images``, ``cameras`` and the keys beside them describe.

    Raises:
        InputError: one of both is missing, or a file is missing or wrong.
    """
    for name, example in (("images", "images=<folder of photographs>"), ("cameras", "cameras=<calibration>")):
        require(config[name] is not None, name, example, None)
    return CaptureFolder(**{name: config[name] for name in _SOURCES})


def require_consistent(diagnosis: Diagnosis) -> None:
    """Refuse cameras that the masks contradict, with what would fit.

    Raises:
        InputError: the diagnosis found something wrong.
    """
    if not diagnosis.consistent:
        raise InputError(
            "cameras: expected cameras that fit photographs and masks (ghgs doctor draws them,"
            f" check_cameras=false goes on anyway); found {'; '.join(diagnosis.lines)}"
        )
