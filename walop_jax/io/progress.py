"""Progress is repeated and Ctrl-C is answered while compiled code keeps the main thread busy, for many seconds at
times.

Python tells its main thread of a signal between two of its own instructions; compiling a program or decomposing a large
matrix is one instruction. So a second thread is notified as well (`signal.set_wakeup_fd`), and ends the process where
the main thread has not by then. Files are written beside their place and moved there when whole: nothing is
half-written.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Generator, Iterator

Tell = Callable[[str], None]

EVERY = 4.0  # s


class Stage(str):
    """A message of progress that begins a stage of the work: `stage` is its name, whatever the message says."""

    stage: str

    def __new__(cls, text: str, stage: str) -> Stage:
        """Make the message `text`, which begins `stage`."""
        self = super().__new__(cls, text)
        self.stage = stage
        return self


@contextlib.contextmanager
def repeated(tell: Tell, every: float = EVERY) -> Generator[Tell, None, None]:
    """A function that reports progress, and repeats the last report, with its age, after `every` s of silence.

    Repeated reports come from another thread, never at the same time as others.
    """
    lock, over = threading.Lock(), threading.Event()
    begin = time.monotonic()
    text, since, shown = "starting", begin, begin

    def say(new: str) -> None:
        nonlocal text, since, shown
        with lock:
            text, since = new, time.monotonic()
            shown = since
            tell(new)

    def again() -> None:
        nonlocal shown
        while not over.wait(every / 15.0):
            with lock:
                moment = time.monotonic()
                if moment - shown >= every and not over.is_set():
                    shown = moment
                    tell(f"{text}, {moment - since:.0f} s so far")

    thread = threading.Thread(target=again, daemon=True)
    thread.start()
    try:
        yield say
    finally:
        over.set()
        thread.join()


PATIENCE = 1.5  # s


@contextlib.contextmanager
def interrupts_answered(end: Callable[[], int]) -> Iterator[None]:
    """Within it an interrupt that is not answered in `PATIENCE` s ends the process with the code that `end` returns.

    `end` is called from another thread, to say so. Outside of the main thread nothing is changed.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    hears, notifier = socket.socketpair()
    notifier.setblocking(False)

    def listen() -> None:
        with hears:
            if signal.SIGINT in hears.recv(64):
                time.sleep(PATIENCE)
                if notifier.fileno() >= 0:  # the block has not ended
                    os._exit(end())

    before = signal.set_wakeup_fd(notifier.fileno(), warn_on_full_buffer=False)
    threading.Thread(target=listen, daemon=True).start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(before)
        notifier.close()
