"""Folders of results: several files that appear together or not at all."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from walop_jax.io.atomic import check_output, publish
from walop_jax.io.errors import fail


def check_folder(path: str | os.PathLike[str], names: Sequence[str] = (), *, overwrite: bool = False) -> Path:
    """Return the folder that results may be put in, or say why not; it need not exist yet.

    Meant to be called before the work as well as before the writing. Raises `DataError` if its parent folder
    is missing or read-only, if a file stands in its place, or if it holds one of `names` while `overwrite` is
    False.
    """
    folder = Path(path)
    try:
        if not folder.exists():
            return check_output(folder)
        if not folder.is_dir():
            raise fail("is a file, a folder is needed", file=path, advice="choose another name")
        found = [name for name in names if (folder / name).exists()]
    except OSError as error:
        raise fail(f"cannot be written: {error}", file=path, advice="choose another place") from error
    if found and not overwrite:
        raise fail(
            f"holds {found[0]} already",
            file=path,
            advice="choose another folder, or give --overwrite (overwrite=True in Python)",
        )
    if not os.access(folder, os.W_OK | os.X_OK):
        raise fail("the folder is read-only", file=path, advice="choose another folder")
    return folder


@contextlib.contextmanager
def atomic_folder(
    path: str | os.PathLike[str], names: Sequence[str], *, overwrite: bool = False
) -> Iterator[Path]:
    """Give a temporary folder to write the files `names` in; put them into `path` if the block ends well.

    A new folder appears in one step with all its files. In a folder that exists, each file takes its place
    in one step, after all of them have been written; other files stay. When the block raises, nothing of it
    is left.

    Raises `DataError` as `check_folder` does, for a file that was not written, and for what the operating
    system refuses.
    """
    target = check_folder(path, names, overwrite=overwrite)
    try:
        temporary = Path(tempfile.mkdtemp(prefix=".walop-", dir=target if target.is_dir() else target.parent))
    except OSError as error:
        raise fail(f"cannot be written: {error}", file=path, advice="choose another folder") from error
    try:
        yield temporary
        missing = [name for name in names if not (temporary / name).is_file()]
        if missing:
            raise fail(f"{missing[0]} was not written", file=path, advice="report this")
        if target.is_dir():
            for name in names:
                publish(temporary / name, target / name, overwrite=overwrite)
        else:
            umask = os.umask(0)
            os.umask(umask)
            temporary.chmod(0o777 & ~umask)
            os.rename(temporary, target)
    except OSError as error:
        raise fail(
            f"writing failed: {error}", file=path, advice="free some space; what was there is untouched"
        ) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
