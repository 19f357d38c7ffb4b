"""Writing files completely or not at all, also in a crash or on a full disk; what is no file."""

import contextlib
import errno
import os
import stat
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

_PARTIAL = ".partial"
_NO_FILES = {
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


def check_is_file(path: str | os.PathLike) -> None:
    """ValueError for a pipe, a socket or a device, which might be read without end. Missing files
    and folders pass: whoever opens them says what is wrong."""
    try:
        kind = _NO_FILES.get(stat.S_IFMT(os.stat(path).st_mode))
    except (OSError, ValueError):
        return
    if kind is not None:
        raise ValueError(f"{os.fspath(path)} must be a file, but is {kind}")


def replace_file(path: str | os.PathLike, content: bytes | memoryview | str) -> None:
    """Writes a new file beside the old one, then replaces the old one. Creates the folder. If an
    OSError is raised, it names `path`, and the old file is unchanged."""
    path = Path(path)
    data = content.encode() if isinstance(content, str) else content
    temporary = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(
            prefix=f".{path.name}.", suffix=_PARTIAL, dir=path.parent, delete=False
        ) as file:
            temporary = Path(file.name)
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        temporary.replace(path)
    except OSError as error:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
        raise OSError(
            error.errno, f"cannot write the file, which is unchanged: {error.strerror}", str(path)
        ) from error


def remove_partial_files(folder: str | os.PathLike) -> None:
    """Removes the temporary files of killed calls of `replace_file` below a folder."""
    for path in Path(folder).rglob(f".*{_PARTIAL}"):
        path.unlink(missing_ok=True)


@contextlib.contextmanager
def locked(path: str | os.PathLike) -> Iterator[None]:
    """A context in which no other process can lock the same file. The file is created and kept.

    The lock belongs to the process: its forks do not hold it, and its end frees it, even by a kill.
    BlockingIOError: another process holds the lock.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        try:
            _lock(file)
        except OSError as error:
            if error.errno in (errno.EACCES, errno.EAGAIN):
                raise BlockingIOError(
                    errno.EAGAIN, "another process holds the lock", str(path)
                ) from None
            # Some network file systems have no locks: continue without one.
        yield


def _lock(file: IO) -> None:
    """OSError: another process holds the lock, or the file system has none."""
    if sys.platform == "win32":
        file.seek(0)
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # the first byte, which need not exist
    else:
        fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
