"""Folders of results: several files that appear together or not at all, written by one process at a time.

Whoever comes second is told at once who is writing there. The lock (flock) is the system's and ends with the process
that holds it, however that ends. The file that it is on says who holds it, and goes when the lock is given back; a
killed process leaves the file, without a lock on it.
"""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import datetime
import errno
import os
import shutil
import socket
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from walop_jax.io.atomic import (
    check_output,
    errors_of,
    flush,
    flush_folder,
    make_ordinary,
    own_prefix,
    prefix_of,
    remove,
    remove_leftovers,
)
from walop_jax.io.errors import DataError, fail

_MOST = 2000
"""Files beyond which a folder is not exchanged as a whole: it is more than that of a run."""

_EXCHANGE = 2  # RENAME_EXCHANGE of renameat2(2), and RENAME_SWAP of renamex_np(2)
_HERE = -100  # AT_FDCWD


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
    return Path(os.path.realpath(folder))


class NotWrittenError(DataError):
    """A file of a result was not written; all others are in their place."""


@dataclasses.dataclass(frozen=True)
class OutputFolder:
    """A folder that this process alone writes results to; `path` is what the caller named it."""

    path: Path
    target: Path
    names: tuple[str, ...]
    overwrite: bool

    @contextlib.contextmanager
    def filled(self, names: Sequence[str] = (), drop: Sequence[str] = ()) -> Iterator[Path]:
        """Give a temporary folder to write the files `names` in; put them into `path` if the block ends well.

        A new folder appears in one step with all its files. One that exists is exchanged in one step for a folder
        with the new files and all others that it held, but for those named in `drop`: at no moment do results of two
        runs stand side by side. Where it cannot be exchanged (its parent is read-only, it is the current folder or a
        mount point, or it holds thousands of files) the old results go before the new ones come, one by one. When
        the block raises, nothing of it is left. `names` are those of the reservation, unless given.

        Raises `DataError` as `check_folder` does, and for what the operating system refuses; `NotWrittenError` where a
        file was not written, once all others are in place.
        """
        names = tuple(names) or self.names
        check_folder(self.path, names, overwrite=self.overwrite)
        whole = not self.target.is_dir() or _exchangeable(self.target)
        where = self.target.parent if whole else self.target
        try:
            temporary = Path(tempfile.mkdtemp(prefix=own_prefix(self.target), dir=where))
        except OSError as error:
            what = f"cannot be written: {error.strerror}"
            raise fail(what, file=self.path, advice="choose another folder") from error
        try:
            with errors_of(self.path, temporary):
                yield temporary
            missing = [name for name in names if not (temporary / name).is_file()]
            names = tuple(name for name in names if name not in missing)
            for name in names:
                flush(temporary / name)
                if (self.target / name).is_file():
                    (temporary / name).chmod((self.target / name).stat().st_mode & 0o777)
            flush_folder(temporary)
            if whole:
                _appear(temporary, self.target, {*names, *missing, *drop})
            else:
                _move(temporary, self.target, names, (*missing, *drop))
        except OSError as error:
            advice = "free some space; what was there is untouched"
            raise fail(f"writing failed: {error.strerror or error}", file=self.path, advice=advice) from error
        finally:
            remove(temporary)
        if missing:
            raise NotWrittenError(
                f"{self.path}: {', '.join(missing)} was not written, all else was; report this"
            )


@contextlib.contextmanager
def output_folder(
    path: str | os.PathLike[str], names: Sequence[str], *, overwrite: bool = False
) -> Iterator[OutputFolder]:
    """Reserve a folder for the results `names` of the block; what a killed writer has left of its own goes.

    Raises `DataError` as `check_folder` does, and if another process is writing there.
    """
    target = check_folder(path, names, overwrite=overwrite)
    apart = os.access(target.parent, os.W_OK | os.X_OK)
    lock = (target.parent / f"{prefix_of(target)}lock") if apart else target / f"{prefix_of(target)}lock"
    with locked(lock, path):
        _restore(target)
        remove_leftovers(target)
        if target.is_dir():
            remove_leftovers(target / target.name)
        check_folder(path, names, overwrite=overwrite)  # another process may have written meanwhile
        yield OutputFolder(Path(path), target, tuple(names), overwrite)


def _exchangeable(folder: Path) -> bool:
    """True if a folder may be replaced by another of the same name without anybody missing something."""
    if os.path.ismount(folder) or not os.access(folder.parent, os.W_OK | os.X_OK):
        return False
    try:
        here = Path.cwd()
    except OSError:  # it has been removed
        here = Path()
    if here == folder or folder in here.parents:
        return False
    count = 0
    for _, folders, files in os.walk(folder):
        count += len(folders) + len(files)
        if count > _MOST:
            return False
    return True


def _appear(temporary: Path, target: Path, new: set[str]) -> None:
    """Put a folder in the place of another, with all that this one holds but for the entries `new`."""
    make_ordinary(temporary, 0o777)
    if not target.is_dir():
        os.rename(temporary, target)
        flush_folder(target.parent)
        return
    _carry(target, temporary, new)
    shutil.copystat(target, temporary)
    with contextlib.suppress(OSError):
        os.chown(temporary, -1, target.stat().st_gid)
    try:
        _exchange(temporary, target)
    except OSError as error:
        if error.errno not in (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP):
            raise
        aside = _aside(target)
        remove(aside)
        os.rename(target, aside)
        os.rename(temporary, target)
        os.rename(aside, temporary)
    flush_folder(target.parent)
    _carry(temporary, target, new)  # what others have put there in the meantime


def _carry(source: Path, target: Path, leave: set[str]) -> None:
    """Give `target` all files of `source` that it lacks, but for the entries `leave`; a link costs no space."""
    for entry in os.scandir(source):
        there = target / entry.name
        if entry.name in leave:
            continue
        if entry.is_dir(follow_symlinks=False):
            if not there.exists():
                there.mkdir()
                shutil.copystat(entry.path, there)
            _carry(Path(entry.path), there, set())
        elif not os.path.lexists(there):
            try:
                os.link(entry.path, there, follow_symlinks=False)
            except OSError:  # a file system without links
                shutil.copy2(entry.path, there, follow_symlinks=False)


def _move(temporary: Path, target: Path, names: Sequence[str], drop: Sequence[str]) -> None:
    """Put files into a folder one by one; the old ones go first, so that a kill mixes no results."""
    for name in (*names[1:], *drop):
        remove(target / name)
    for name in names:
        os.replace(temporary / name, target / name)
    flush_folder(target)


def _exchange(one: Path, other: Path) -> None:
    """Exchange the names of two folders in one step; OSError with ENOSYS where the system cannot."""
    try:
        library = ctypes.CDLL(None, use_errno=True)
    except (OSError, TypeError):
        raise OSError(errno.ENOSYS, "no exchange of names") from None
    names = os.fsencode(one), os.fsencode(other)
    if hasattr(library, "renameat2"):  # Linux
        failed = library.renameat2(_HERE, names[0], _HERE, names[1], _EXCHANGE)
    elif hasattr(library, "renamex_np"):  # macOS
        failed = library.renamex_np(*names, _EXCHANGE)
    else:
        raise OSError(errno.ENOSYS, "no exchange of names")
    if failed:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


def _aside(target: Path) -> Path:
    """Momentary place of a folder that cannot be exchanged in one step."""
    return target.parent / f"{prefix_of(target)}before"


def _restore(target: Path) -> None:
    """Bring back a folder whose exchange was killed between two steps; remove one whose exchange was done."""
    aside = _aside(target)
    if aside.is_dir():
        if target.exists():
            remove(aside)
        else:
            os.rename(aside, target)


try:
    import fcntl
except ImportError:  # a system without flock: two writers are not told of each other there
    fcntl = None


@contextlib.contextmanager
def locked(place: Path, output: object) -> Iterator[None]:
    """Hold the lock file `place` while the block writes `output`, the name that messages show.

    Where the file system knows no locks, nothing is locked. Raises `DataError`, naming the holder, if another process
    (or another thread of this one) holds it.
    """
    descriptor = _acquired(place, output)
    try:
        yield
    finally:
        if descriptor is not None:
            with contextlib.suppress(OSError):
                os.unlink(place)
            os.close(descriptor)


def _acquired(place: Path, output: object) -> int | None:
    while fcntl is not None:
        descriptor = os.open(place, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.read(descriptor, 500).decode("utf-8", "replace").strip() or "another process"
            os.close(descriptor)
            advice = "wait until it has ended, or choose another folder"
            raise fail(f"is being written by {holder}", file=output, advice=advice) from None
        except OSError:
            os.close(descriptor)
            with contextlib.suppress(OSError):
                os.unlink(place)
            return None
        if _is_at(descriptor, place):
            since = datetime.datetime.now().astimezone().strftime("%Y-%m-%d %H:%M:%S %Z")
            # On a full disk the lock holds, but does not say whose it is.
            with contextlib.suppress(OSError):
                os.ftruncate(descriptor, 0)
                os.write(
                    descriptor, f"process {os.getpid()} on {socket.gethostname()} since {since}".encode()
                )
            return descriptor
        os.close(descriptor)
    return None


def _is_at(descriptor: int, place: Path) -> bool:
    """True if an open file is still the one of that name: its last holder may have removed it before it was locked."""
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(place))
    except OSError:
        return False
