"""Ctrl-C answered within two seconds, whatever the main thread is doing.

Python tells its main thread of a signal between two of its own instructions; compiling a program or decomposing a large
matrix is one that takes many seconds. So a thread of its own hears of the signal as well, by `signal.set_wakeup_fd`,
and ends the process where the main thread has not by then. Files are written beside their place and moved there when
they are whole, and finished parts of a large fit are kept: nothing is lost that a fresh start would not make again.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import threading
from collections.abc import Callable, Iterator

PATIENCE = 1.5  # s


@contextlib.contextmanager
def interrupts_answered(end: Callable[[], int], patience: float = PATIENCE) -> Iterator[None]:
    """Within it an interrupt that is not answered in `patience` s ends the process with the code that `end` returns.

    `end` is called from another thread, to say so. Outside of the main thread nothing is changed.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    hears, told = socket.socketpair()
    told.setblocking(False)
    over = threading.Event()

    def listen() -> None:
        while not over.is_set():
            if signal.SIGINT in hears.recv(64) and not over.wait(patience):
                os._exit(end())

    thread = threading.Thread(target=listen, daemon=True)
    before = signal.set_wakeup_fd(told.fileno(), warn_on_full_buffer=False)
    thread.start()
    try:
        yield
    finally:
        over.set()
        signal.set_wakeup_fd(before)
        told.send(b"\0")  # any other byte than that of the signal
        thread.join()
        hears.close()
        told.close()
