"""Writing files so that a crash, a kill or a full disk leaves the old one or the new one."""

import os
import tempfile
from pathlib import Path


def replace_file(path: str | os.PathLike, content: bytes | str) -> None:
    """Writes a file whole, beside the old one and then in its place; makes its folder.

    Raises:
        OSError: no room, or no right to write; it names `path`, which is as it was.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    data = content.encode() if isinstance(content, str) else content
    temporary = None
    try:
        with tempfile.NamedTemporaryFile(
            prefix=f".{path.name}.", dir=path.parent, delete=False
        ) as file:
            temporary = Path(file.name)
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.chmod(0o666 & ~_umask())
        temporary.replace(path)
    except OSError as error:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
        raise OSError(
            error.errno, f"cannot write it, it is as it was: {error.strerror}", str(path)
        ) from error


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
