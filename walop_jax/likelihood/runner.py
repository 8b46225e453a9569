"""Passes over the points of a set: part by part, on several threads and devices, with progress.

Parts are worked on by as many threads as there are processor cores, or by two for each of the other devices of this
process. Results come in the order of the parts, so that their sum depends on no timing and not on the number of
threads. (One array sharded over two CPU devices took 12 µs a point where two threads took 10 and one 15: the engine's
work on a block is too small to be cut further.)
"""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import jax

from walop_jax.io.progress import Tell
from walop_jax.model.compiled import float64, usual_threads

TOLD_EVERY = 1.0  # s

T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class Runner:
    """Runner of passes: its number of threads, and where progress is reported."""

    threads: int = dataclasses.field(default_factory=usual_threads)
    progress: Tell | None = None

    def __getstate__(self) -> dict[str, object]:
        """Parts that a copy in another process can use: progress is not reported from there."""
        return vars(dataclasses.replace(self, progress=None))

    def tell(self, text: str) -> None:
        """Report progress, if somebody listens."""
        if self.progress is not None:
            self.progress(text)

    def each(self, label: str, work: Callable[[int], T], points: int, part: int) -> Iterator[T]:
        """The results of `work` for all parts of `part` points, in order; `label` names the pass in progress."""
        began = last = time.perf_counter()
        with contextlib.closing(self._each(-(-points // part), work)) as results:
            for count, result in enumerate(results, start=1):
                time_now = time.perf_counter()
                if time_now - last > TOLD_EVERY:
                    last, ready, rate = time_now, min(count * part, points), count * part / (time_now - began)
                    seconds = f"{(points - ready) / rate:.0f} s left of this pass"
                    self.tell(f"{label}: {ready:,} of {points:,} points, {rate:,.0f} points/s, {seconds}")
                yield result

    def _each(self, parts: int, work: Callable[[int], T]) -> Generator[T, None, None]:
        devices = jax.local_devices()

        def on_device(number: int) -> T:
            # Programs belong to the device that was asked for: without asking they are shared.
            alone = len(devices) == 1
            chosen = contextlib.nullcontext() if alone else jax.default_device(devices[number % len(devices)])
            with float64(), chosen:  # both are settings of a thread
                return work(number)

        # The first one alone: it compiles.
        yield on_device(0)
        if parts == 1 or self.threads == 1:
            yield from map(on_device, range(1, parts))
            return
        pool = ThreadPoolExecutor(self.threads)
        try:
            yield from pool.map(on_device, range(1, parts))
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
