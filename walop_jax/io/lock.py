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
        with contextlib.suppress(OSError):
            # The last holder may have removed the file between our opening and locking it.
            if os.path.samestat(os.fstat(descriptor), os.stat(place)):
                since = datetime.datetime.now().astimezone().strftime("%Y-%m-%d %H:%M:%S %Z")
                text = f"process {os.getpid()} on {socket.gethostname()} since {since}"
                os.ftruncate(descriptor, 0)
                os.write(descriptor, text.encode())
                return descriptor
        os.close(descriptor)
    return None
