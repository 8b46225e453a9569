"""Progress that is told again while nothing new can be said: compiling and large matrices are silent for long."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Generator

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
    """A function that tells what is being done, and tells it again, with how long, after `every` s of silence.

    What it repeats is told from another thread, never at the same time as anything else.
    """
    lock, over = threading.Lock(), threading.Event()
    now = time.monotonic()
    text, since, told = "starting", now, now

    def say(new: str) -> None:
        nonlocal text, since, told
        with lock:
            text, since = new, time.monotonic()
            told = since
            tell(new)

    def again() -> None:
        nonlocal told
        while not over.wait(every / 15.0):
            with lock:
                moment = time.monotonic()
                if moment - told >= every and not over.is_set():
                    told = moment
                    tell(f"{text} (for {moment - since:.0f} s)")

    thread = threading.Thread(target=again, daemon=True)
    thread.start()
    try:
        yield say
    finally:
        over.set()
        thread.join()
