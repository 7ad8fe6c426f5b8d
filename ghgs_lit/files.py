"""Files that several processes share: atomic writes, and locks that are freed when their process
ends."""

import contextlib
import errno
import fcntl
import os
import socket
import stat
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from ghgs_lit.errors import InputError, require

# Lock files that this process holds; never opened again, because closing a second descriptor would
# free the lock.
_HELD: set[Path] = set()
_OWNER = b"process "  #: Prefix of a lock file's text


def write_atomically(path: str | Path, write: Callable[[Path], Any]) -> None:
    """Write a file next to ``path``, synchronise it with the disk, then rename it to ``path``.

    Readers find the old file or the new one, never a part. Missing folders are created. A link is
    replaced; its target stays. If a process is killed, its temporary file is removed by the next
    write of the same path on the same machine.

    Args:
        path: the file.
        write: called with the temporary path; writes the content there.

    Raises:
        InputError: ``path`` is, or links to, a directory, a device or a pipe.
        OSError: the disk is full, or the folder is not writable; ``filename`` is ``path``.
    """
    path = Path(path)
    _require_replaceable(path)
    temporary = path.with_name(f".{path.name}.{socket.gethostname()}.{os.getpid()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _remove_leftovers(path)
        write(temporary)
        _sync(temporary)
        os.replace(temporary, path)
        _sync(path.parent)
    except Exception as error:
        # PyTorch and safetensors raise other errors for a full disk.
        cause = error if isinstance(error, OSError) else _find_write_error(temporary)
        if cause is None or cause.errno is None:
            raise
        raise OSError(cause.errno, cause.strerror, str(path)) from error
    finally:
        with contextlib.suppress(OSError):  # a folder that is not writable
            temporary.unlink(missing_ok=True)


def _require_replaceable(path: Path) -> None:
    """Reject a path that a new file must not replace.

    Raises:
        InputError: ``path`` is, or links to, a directory, a device or a pipe.
    """
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        return
    found = "a directory" if stat.S_ISDIR(mode) else "a device or a pipe"
    require(stat.S_ISREG(mode), str(path), "a file to write", found)


def require_free(path: str | Path, key: str, overwrite: bool) -> None:
    """Check a file path of a configuration key; an existing file requires ``overwrite``.

    Called before the work, so that the error precedes it.

    Args:
        path: the file; ``~`` is expanded.
        key: dotted key of the command line, for messages.
        overwrite: whether an existing file may be replaced.

    Raises:
        InputError: the file exists, cannot be replaced by :func:`write_atomically`, or its folder is
            not writable.
    """
    path = Path(path).expanduser()
    _require_replaceable(path)
    taken = os.path.lexists(path) and not overwrite
    require(not taken, key, "a path where there is no file, or overwrite=true", str(path))
    require_writable(path.absolute().parent, key, str(path))


def require_writable(folder: Path, key: str, what: str) -> Path:
    """Check that a folder is writable, or can be created.

    Args:
        folder: its absolute path.
        key: dotted key of the command line, for messages.
        what: the file or files to write, for messages.

    Returns:
        The folder, or its nearest parent that exists.

    Raises:
        InputError: that folder is not writable.
    """
    place = next(path for path in (folder, *folder.parents) if path.exists())
    fits = place.is_dir() and os.access(place, os.W_OK | os.X_OK)
    require(fits, key, f"a folder that can be written to for {what}", str(place))
    return place


@contextlib.contextmanager
def name_folder_in_errors(folder: Path) -> Iterator[None]:
    """Add a folder to each OSError inside the context that has no file name, such as for a full disk.

    Args:
        folder: where files are written inside the context.

    Raises:
        OSError: as inside the context, with ``folder`` as its ``filename``.
    """
    try:
        yield
    except OSError as error:
        if error.filename is not None:
            raise
        probe = folder / f".{os.getpid()}.tmp"
        try:
            # NumPy's error for a full disk has no errno.
            cause = error if error.errno is not None else _find_write_error(probe)
        finally:
            probe.unlink(missing_ok=True)
        if cause is None:
            raise
        raise OSError(cause.errno, cause.strerror, str(folder)) from error


def _find_write_error(path: Path) -> OSError | None:
    """The error of the system when more is written to the file ``path``; None: writing succeeds."""
    try:
        with path.open("ab") as file:
            file.write(bytes(1 << 20))
    except OSError as error:
        return error
    return None


def resolve_path(path: str | Path) -> Path:
    """The absolute path without links or ``~``.

    Raises:
        InputError: a loop of links (before Python 3.13; in later versions opening the path fails).
    """
    try:
        return Path(path).expanduser().resolve()
    except RuntimeError as error:
        raise InputError(f"{path}: expected a path; found links in a loop") from error


def write_text_atomically(path: str | Path, text: str) -> None:
    """Write ``text`` to ``path``; errors as in :func:`write_atomically`."""
    write_atomically(path, lambda temporary: temporary.write_text(text))


def require_no_links(directory: Path, names: Iterable[str]) -> None:
    """Reject links where libraries write, because they would change the targets of the links.

    Args:
        directory: a run's directory.
        names: files and folders in it; files directly in these folders are checked, too.

    Raises:
        InputError: names the first link.
    """
    for name in names:
        path = directory / name
        files = path.iterdir() if path.is_dir() and not path.is_symlink() else ()
        for each in (path, *files):
            require(not each.is_symlink(), str(each), "a file or folder of the run", "a link")


def _remove_leftovers(path: Path) -> None:
    prefix = f".{path.name}.{socket.gethostname()}."
    for leftover in path.parent.glob(f"{prefix}*.tmp"):
        number = leftover.name.removeprefix(prefix).removesuffix(".tmp")
        try:
            os.kill(int(number), 0)
        except ProcessLookupError:
            leftover.unlink(missing_ok=True)
        except (ValueError, PermissionError):  # not a process ID; a process of another user
            continue


def _sync(place: Path) -> None:
    """Flush a file or folder to the disk, so that a rename survives a power failure."""
    try:
        handle = os.open(place, os.O_RDONLY)
    except OSError:  # some systems cannot open folders
        return
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _resolve_lock_path(path: str | Path) -> Path:
    """The path, with links in its folders resolved, but not a link to the file."""
    path = Path(path)
    return resolve_path(path.parent) / path.name


def _open_lock(path: Path, flags: int) -> int:
    """Open a lock file without changing it.

    Args:
        path: the file, without links in its folders.
        flags: flags of :func:`os.open`.

    Returns:
        The file descriptor.

    Raises:
        InputError: it is a link, not a file, or has other content than an owner.
        OSError: it cannot be opened.
    """
    try:
        # Opening a pipe would block until its other end is opened.
        handle = os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK, 0o664)
    except OSError as error:
        require(not path.is_symlink(), str(path), "a lock file", "a link")
        raise error
    is_file = stat.S_ISREG(os.fstat(handle).st_mode)
    if not is_file or os.pread(handle, len(_OWNER), 0) not in (b"", _OWNER):
        os.close(handle)
        raise InputError(f"{path}: expected a lock file; found {'another file' if is_file else 'no file'}")
    return handle


@contextlib.contextmanager
def lock(path: str | Path, wait: bool = False) -> Iterator[bool]:
    """Hold a lock file for this process within the context.

    A POSIX record lock (``fcntl``): the system frees it however the process ends, forked children do
    not inherit it, and NFS shares it among machines. The file contains the text of
    :func:`lock_owner`.

    Args:
        path: the lock file; it and its folders are created if missing.
        wait: block until another process frees the lock.

    Yields:
        Whether the lock was acquired; False: another process, or this one already, holds it.

    Raises:
        InputError: the file system has no locks, or the file is a link or has other content than an
            owner, which is kept.
    """
    path = _resolve_lock_path(path)
    if path in _HELD:
        yield False
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    handle = _open_lock(path, os.O_RDWR | os.O_CREAT)
    try:
        locked = _try_lock(handle, fcntl.LOCK_EX, wait, path)
        if not locked:  # is_locked() in another process holds it briefly
            time.sleep(0.05)
            locked = _try_lock(handle, fcntl.LOCK_EX, wait, path)
        if locked:
            _HELD.add(path)
            os.ftruncate(handle, 0)
            os.write(handle, _OWNER + f"{os.getpid()} on {socket.gethostname()}\n".encode())
        yield locked
    finally:
        os.close(handle)
        _HELD.discard(path)


def is_locked(path: str | Path) -> bool:
    """Whether a process, including this one, holds the lock of a file.

    Raises:
        InputError: as for :func:`lock`.
    """
    path = _resolve_lock_path(path)
    if path in _HELD:
        return True
    if not path.exists():
        return False
    handle = _open_lock(path, os.O_RDONLY)
    try:
        return not _try_lock(handle, fcntl.LOCK_SH, False, path)
    finally:
        os.close(handle)


def lock_owner(path: str | Path) -> str:
    """The process that last locked the file ``path``, for messages."""
    try:
        return Path(path).read_text().strip() or "another process"
    except OSError:
        return "another process"


def _try_lock(handle: int, kind: int, wait: bool, path: Path) -> bool:
    """Lock an open file by ``fcntl.lockf``.

    Args:
        handle: file descriptor.
        kind: ``fcntl.LOCK_EX`` or ``fcntl.LOCK_SH``.
        wait: block until no other process holds a conflicting lock.
        path: of the file, for messages.

    Returns:
        Whether it is locked; False: another process holds it, and ``wait`` is false.

    Raises:
        InputError: the file system has no locks.
    """
    try:
        fcntl.lockf(handle, kind | (0 if wait else fcntl.LOCK_NB))
    except OSError as error:
        if error.errno in (errno.EACCES, errno.EAGAIN):
            return False
        raise InputError(f"{path}: expected a file system with locks; found {error}") from None
    return True
