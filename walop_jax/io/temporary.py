"""Temporary names beside the place of a result, the traces that a killed writer leaves under them, and messages.

A name tells for what, on which machine and by which process it was made, so that the next writer of the same result
can remove what a dead one has left. Messages never show it: users have not chosen it.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import socket
from collections.abc import Iterator
from pathlib import Path

from walop_jax.io.errors import DataError

PREFIX = ".walop-"


def prefix_of(target: Path) -> str:
    """What the names of temporary files and folders of `target` begin with, whoever makes them."""
    return f"{PREFIX}{_short(target.name)}-"


def own_prefix(target: Path) -> str:
    """What the names of temporary files and folders of `target` begin with that this process makes."""
    return f"{prefix_of(target)}{_short(socket.gethostname())}-{os.getpid()}-"


def remove_leftovers(target: Path) -> None:
    """Remove what writers of `target` that were killed on this machine have left in its folder."""
    here = f"{prefix_of(target)}{_short(socket.gethostname())}-"
    with contextlib.suppress(OSError):
        for name in os.listdir(target.parent):
            process = name.removeprefix(here).partition("-")[0]
            if name.startswith(here) and process.isdigit() and not _lives(int(process)):
                remove(target.parent / name)


def remove(path: Path) -> None:
    """Remove a file, or a folder with all that is in it, as far as that is possible."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)


@contextlib.contextmanager
def errors_of(target: object, temporary: Path) -> Iterator[None]:
    """Let the errors of the block speak of `target` where they would speak of `temporary`."""
    try:
        yield
    except ValueError as error:
        text = str(error).replace(str(temporary), str(target))
        if text == str(error):
            raise
        raise DataError(text) from error


def _lives(process: int) -> bool:
    """Whether a process of this machine is there; one of another user counts."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True


def _short(text: str) -> str:
    """Eight letters for a text: a file name has no room for long ones."""
    return hashlib.sha256(os.fsencode(text)).hexdigest()[:8]
