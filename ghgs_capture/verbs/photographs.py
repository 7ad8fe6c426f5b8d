"""Open the folder of photographs of a configuration, and check its cameras before a verb runs."""

from typing import TYPE_CHECKING, Any

from ghgs_capture.folder import CaptureFolder
from ghgs_lit.config.nodes import Calibration
from ghgs_lit.errors import InputError, require

if TYPE_CHECKING:
    from ghgs_capture.verbs import OfPhotographs

#: At most one folder whose photographs are being decoded, with its :func:`sources_of`
_BEGUN: list[tuple[dict[str, Any], CaptureFolder]] = []

_SOURCES = ("images", "cameras", "masks", "backgrounds", "segment", "sequence")
_CHECKED = 5  #: Number of instants of a sequence whose cameras are checked


def sources_of(run: "OfPhotographs") -> dict[str, Any]:
    """Arguments of :class:`ghgs_capture.folder.CaptureFolder` from a run's keys.

    Args:
        run: its groups may be unchecked.

    Raises:
        InputError: ``images`` or ``cameras`` is missing.
    """
    for name, example in (("images", "images=<folder of photographs>"), ("cameras", "cameras=<calibration>")):
        require(getattr(run, name) is not None, name, example, None)
    calibration = run.calibration or Calibration.read(run.plain.get("calibration", {}), "calibration")
    return {name: getattr(run, name) for name in _SOURCES if hasattr(run, name)} | {
        "calibration": calibration
    }


def capture_folder(run: "OfPhotographs") -> CaptureFolder:
    """Open a run's folder of photographs, reusing the one that :func:`begin_to_read` decodes.

    Raises:
        InputError: a key or file is missing or wrong.
    """
    sources = sources_of(run)
    if _BEGUN and _BEGUN[0][0] == sources:
        return _BEGUN.pop()[1]
    return CaptureFolder(**sources)


def begin_to_read(run: "OfPhotographs") -> None:
    """Start decoding the first instant in the background, for the next :func:`capture_folder`.

    With ``segment`` nothing is decoded ahead.

    Args:
        run: its groups may be unchecked.

    Raises:
        InputError: as for :func:`capture_folder`.
    """
    sources = sources_of(run)
    folder = CaptureFolder(**sources)
    _BEGUN[:] = [(sources, folder)]
    if run.segment is None:
        folder.begin(folder.instants[0])


def check_cameras(folder: CaptureFolder) -> None:
    """Print how well cameras and masks agree in the first of up to ``_CHECKED`` instants in which they do.

    Raises:
        InputError: cameras and masks disagree in all of these, or the only instant cannot be read.
    """
    from ghgs_capture.camera_report import diagnose
    from ghgs_capture.rig import spread

    found = ""
    for name in spread(folder.instants, _CHECKED):
        try:
            diagnosis = diagnose(folder, name)
        except InputError:
            if len(folder.instants) == 1:
                raise
            continue
        if diagnosis.consistent:
            print(diagnosis.line, flush=True)
            return
        found = diagnosis.line
    if not found:
        print("cameras are not checked: none of the instants looked at can be read", flush=True)
        return
    raise InputError(
        "cameras: expected cameras that fit photographs and masks (check_cameras=false goes on anyway);"
        f" found {found}"
    )
