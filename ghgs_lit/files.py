"""Writing files that are whole or not there at all, whatever kills the process."""

import os
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any


def write_atomically(path: str | Path, write: Callable[[Path], Any]) -> None:
    """Let ``write(temporary)`` write a file beside ``path``, wait for the disk, then rename it to ``path``.

    Readers see the old file or the new one, never a part. Folders are made. A temporary file of a process
    that was killed is removed by the next write of the same path on the same machine.

    Args:
        path: the file to write.
        write: writes the whole content to the path that it is given.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    _remove_leftovers(path)
    temporary = path.with_name(f".{path.name}.{socket.gethostname()}.{os.getpid()}.tmp")
    try:
        write(temporary)
        _sync(temporary)
        os.replace(temporary, path)
        _sync(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


def write_text_atomically(path: str | Path, text: str) -> None:
    """Write ``text`` to ``path`` by :func:`write_atomically`."""
    write_atomically(path, lambda temporary: temporary.write_text(text))


def _remove_leftovers(path: Path) -> None:
    """Delete temporary files of ``path`` whose process is gone."""
    prefix = f".{path.name}.{socket.gethostname()}."
    for leftover in path.parent.glob(f"{prefix}*.tmp"):
        number = leftover.name.removeprefix(prefix).removesuffix(".tmp")
        if number.isdecimal() and not _is_running(int(number)):
            leftover.unlink(missing_ok=True)


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _sync(place: Path) -> None:
    """Wait until a file or folder is on the disk, so that a rename survives a power cut."""
    try:
        handle = os.open(place, os.O_RDONLY)
    except OSError:  # some systems do not open folders
        return
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
