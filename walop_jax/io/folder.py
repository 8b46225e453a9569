"""Folders of results: several files of one run, written by one process at a time.

Whoever comes second learns at once who is writing there. The lock (flock) is the system's and ends with the process
that holds it, however that ends. The file that it is on says who holds it, and goes when the lock is given back; a
killed process leaves the file, without a lock on it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import os
import re
import socket
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from walop_jax.io import atomic
from walop_jax.io.errors import DataError, PathLike, fail


def check_folder(path: PathLike, names: Sequence[str] = (), *, overwrite: bool = False) -> Path:
    """Return the folder that results may be put in, or say why not; it need not exist yet.

    Meant to be called before the work as well as before the writing. Raises `DataError` if its parent folder
    is missing or read-only, if a file stands in its place, or if it holds one of `names` while `overwrite` is
    False.
    """
    folder = Path(path)
    try:
        if not folder.exists():
            return atomic.check_output(folder)
        if not folder.is_dir():
            raise fail("is a file, a folder is needed", file=path, advice="choose another name")
        existing = [name for name in names if (folder / name).exists()]
    except OSError as error:
        raise fail(f"cannot be written: {error}", file=path, advice="choose another place") from error
    if existing and not overwrite:
        raise fail(
            f"holds {existing[0]} already",
            file=path,
            advice="choose another folder, or give --overwrite (overwrite=True in Python)",
        )
    if not os.access(folder, os.W_OK | os.X_OK):
        raise fail("the folder is read-only", file=path, advice="choose another folder")
    return Path(os.path.realpath(folder))


def check_apart(written: Iterable[PathLike], read: Iterable[PathLike]) -> None:
    """Refuse files to be written that are files to be read, by whatever name or link; with --overwrite they were lost.

    `read` may name a table in a file, as in STARS.fits[OBJECTS]. Raises `DataError`.
    """
    inputs = [
        Path(re.sub(r"\[[^\[\]]+\]$", "", str(path)) if not os.path.exists(path) else path) for path in read
    ]
    for target in written:
        for path in inputs:
            with contextlib.suppress(OSError):
                if os.path.samefile(target, path):
                    what = f"is the output and an input{'' if str(path) == str(target) else f', {path}'}"
                    raise fail(
                        what, file=target, advice="give the output another name: the input would be lost"
                    )


class NotWrittenError(DataError):
    """A file of a result was not written; all others are in their place."""


@dataclasses.dataclass(frozen=True)
class OutputFolder:
    """A folder that this process alone writes results to; `path` is the name that the caller gave."""

    path: Path
    target: Path
    names: tuple[str, ...]
    overwrite: bool

    @contextlib.contextmanager
    def filled(self, names: Sequence[str] = (), drop: Sequence[str] = ()) -> Iterator[Path]:
        """Give a temporary folder to write the files `names` in; put them into `path` if the block ends well.

        A new folder appears in one step with all its files. In one that exists the old results go, with the files
        `drop`, all but the first of `names`, which is replaced where it is; the others follow one by one. So a kill
        may leave a part of one result, never parts of two. When the block raises, nothing of it is left. `names` are
        those of the reservation, unless given.

        Raises `DataError` as `check_folder` does, and for errors of the operating system; `NotWrittenError` where a
        file was not written, once all others are in place.
        """
        names = tuple(names) or self.names
        check_folder(self.path, names, overwrite=self.overwrite)
        new, untouched = not self.target.is_dir(), True
        temporary = (self.target.parent if new else self.target) / f"{atomic.own_prefix(self.target)}new"
        try:
            temporary.mkdir()
            with atomic.errors_of(self.path, temporary):
                yield temporary
            missing = [name for name in names if not (temporary / name).is_file()]
            names = tuple(name for name in names if name not in missing)
            for name in names:
                atomic.flush(temporary / name, self.target / name)
            atomic.flush_folder(temporary)
            if new:
                os.rename(temporary, self.target)
            else:
                untouched = False
                for name in (*names[1:], *missing, *drop):
                    atomic.remove(self.target / name)
                for name in names:
                    os.replace(temporary / name, self.target / name)
            atomic.flush_folder(self.target.parent if new else self.target)
        except OSError as error:
            advice = "free some space; the old content is untouched" if untouched else "write it again"
            raise fail(f"writing failed: {error.strerror or error}", file=self.path, advice=advice) from error
        finally:
            atomic.remove(temporary)
        if missing:
            raise NotWrittenError(
                f"{self.path}: {', '.join(missing)} was not written, all else was; report this"
            )


@contextlib.contextmanager
def output_folder(path: PathLike, names: Sequence[str], *, overwrite: bool = False) -> Iterator[OutputFolder]:
    """Reserve a folder for the results `names` of the block; remains of a killed writer are removed.

    Raises `DataError` as `check_folder` does, and if another process is writing there.
    """
    target = check_folder(path, names, overwrite=overwrite)
    apart = os.access(target.parent, os.W_OK | os.X_OK)
    with locked((target.parent if apart else target) / f"{atomic.prefix_of(target)}lock", path):
        for place in (target, target / target.name):
            atomic.remove_leftovers(place)
        check_folder(path, names, overwrite=overwrite)  # another process may have written meanwhile
        yield OutputFolder(Path(path), target, tuple(names), overwrite)


try:
    import fcntl
except ImportError:  # a system without flock: two writers are not notified of each other there
    fcntl = None


@contextlib.contextmanager
def locked(place: Path, output: object) -> Iterator[None]:
    """Hold the lock file `place` while the block writes `output`, the name that messages show.

    Where the file system has no locks, nothing is locked. Raises `DataError`, naming the holder, if another process
    (or another thread of this one) holds it.
    """
    descriptor = None
    while fcntl is not None and descriptor is None:
        descriptor = os.open(place, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # Its last holder may have removed it before it was locked: then once more.
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(descriptor), os.stat(place)):
                    break
            os.close(descriptor)
            descriptor = None
        except BlockingIOError:
            holder = os.read(descriptor, 500).decode("utf-8", "replace").strip() or "another process"
            os.close(descriptor)
            advice = "wait until it has ended, or choose another folder"
            raise fail(f"is being written by {holder}", file=output, advice=advice) from None
        except OSError:
            break
    try:
        if descriptor is not None:
            since = datetime.datetime.now().astimezone().strftime("%Y-%m-%d %H:%M:%S %Z")
            # On a full disk the lock holds, but does not say whose it is.
            with contextlib.suppress(OSError):
                os.ftruncate(descriptor, 0)
                os.write(
                    descriptor, f"process {os.getpid()} on {socket.gethostname()} since {since}".encode()
                )
        yield
    finally:
        if descriptor is not None:
            with contextlib.suppress(OSError):
                os.unlink(place)
            os.close(descriptor)
