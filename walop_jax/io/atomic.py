"""Files that appear whole or not at all: written beside their place, flushed to disk, then renamed.

The temporary name has the purpose, the machine and the process by which it was made, so that the next writer of the
same result can remove the remains of a killed one. Messages never show it: users have not chosen it.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import secrets
import shutil
import socket
from collections.abc import Iterator
from pathlib import Path

from walop_jax.io.errors import DataError, PathLike, fail


def check_output(path: PathLike, *, overwrite: bool = False) -> Path:
    """Return the file that `path` leads to, or say why nothing can be written there.

    Meant to be called before hours of work as well as before the writing itself. A symbolic link is
    followed, so that the link stays one and the file behind it changes.

    Raises `DataError` for a missing or read-only folder, a folder in place of the file, a link that leads
    to itself, and a file that exists while `overwrite` is False.
    """
    try:
        target = Path(os.path.realpath(path, strict=Path(path).exists()))
        folder = target.parent
        if not folder.is_dir():
            raise fail(f"the folder {folder} does not exist", file=path, advice="create it first")
        if target.is_dir():
            raise fail("is a folder", file=path, advice="give the name of a file in it")
        if target.is_symlink():
            raise fail("is a symbolic link that leads back to itself", file=path, advice="remove the link")
        if target.exists() and not overwrite:
            raise fail(
                "exists already",
                file=path,
                advice="choose another name, or give --overwrite (overwrite=True in Python)",
            )
    except OSError as error:
        raise fail(f"cannot be written: {error}", file=path, advice="choose another place") from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise fail(f"the folder {folder} is read-only", file=path, advice="choose another folder")
    return target


@contextlib.contextmanager
def atomic_path(path: PathLike, *, overwrite: bool = False) -> Iterator[Path]:
    """Give a temporary file to write; put it in the place of `path` only if the block ends well.

    The temporary file lies in the same folder (a rename across file systems is a copy, hence not atomic)
    and has the same suffix, because many writers choose the format by it. It is removed when the block
    raises, so an old file survives a full disk, an interrupt and a bug untouched.

    Raises `DataError` as `check_output` does, and for errors of the operating system (a full disk).
    """
    target = check_output(path, overwrite=overwrite)
    remove_leftovers(target)
    temporary = target.with_name(f"{own_prefix(target)}{secrets.token_hex(4)}{target.suffix}")
    try:
        with errors_of(path, temporary):
            temporary.touch(exist_ok=False)
            yield temporary
        flush(temporary, target)
        if target.exists() and not overwrite:
            raise fail("has been written by another program meanwhile", file=target)
        os.replace(temporary, target)
        flush_folder(target.parent)
    except OSError as error:
        raise fail(
            f"writing failed: {error.strerror or error}",
            file=path,
            advice="free some space; what stood there before is untouched",
        ) from error
    finally:
        temporary.unlink(missing_ok=True)


def flush(temporary: Path, target: Path) -> None:
    """Flush a file to disk; one that it will replace hands on its permissions."""
    with temporary.open("rb+") as stream:
        os.fsync(stream.fileno())
    if target.exists():
        temporary.chmod(target.stat().st_mode & 0o777)


def flush_folder(folder: Path) -> None:
    """Flush the entries of a folder, without which a power cut may undo a rename."""
    with contextlib.suppress(OSError):  # some network file systems cannot
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


PREFIX = ".walop-"


def prefix_of(target: Path) -> str:
    """Beginning of the names of temporary files and folders of `target`, whoever makes them."""
    return f"{PREFIX}{_short(target.name)}-"


def own_prefix(target: Path) -> str:
    """Beginning of the names of temporary files and folders of `target` that this process makes."""
    return f"{prefix_of(target)}{_short(socket.gethostname())}-{os.getpid()}-"


def remove_leftovers(target: Path) -> None:
    """Remove what writers of `target` that were killed on this machine have left in its folder."""
    prefix = f"{prefix_of(target)}{_short(socket.gethostname())}-"
    with contextlib.suppress(OSError):
        for name in os.listdir(target.parent):
            process = name.removeprefix(prefix).partition("-")[0]
            if name.startswith(prefix) and process.isdigit() and not _lives(int(process)):
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
    """True if a process of this machine is there; one of another user counts."""
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
