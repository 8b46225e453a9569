"""A lock on an output: whoever comes second is told at once who is writing there.

The lock (flock) is the system's and ends with the process that holds it, however that ends. The file that it is on
says who holds it, and goes when the lock is given back; a killed process leaves the file, without a lock on it.
"""

from __future__ import annotations

import contextlib
import datetime
import os
import socket
from collections.abc import Iterator
from pathlib import Path

from walop_jax.io.errors import fail

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
    """Whether an open file is still the one of that name: its last holder may have removed it before it was locked."""
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(place))
    except OSError:
        return False
