"""Files to be read: there, and ordinary ones, before anybody opens them."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from walop_jax.io.errors import fail

_OTHERS = {
    stat.S_IFIFO: "a named pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


def check_input(path: str | os.PathLike[str]) -> Path:
    """Return `path` if it is that of an ordinary file, or of a link to one.

    Raises `DataError` if nothing is there, and for folders, named pipes, sockets and devices: opening a pipe waits
    for a writer, and a device may never end.
    """
    path = Path(path)
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        raise fail("there is no such file", file=path, advice="check the name") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise fail(f"cannot be read: {reason}", file=path, advice="check the name") from None
    if stat.S_ISDIR(mode):
        raise fail("is a folder", file=path, advice="give the name of a file in it")
    if not stat.S_ISREG(mode):
        what = _OTHERS.get(stat.S_IFMT(mode), "no ordinary file")
        raise fail(f"is {what}", file=path, advice="copy its content to a file first")
    return path
