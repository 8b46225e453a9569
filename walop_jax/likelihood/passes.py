"""A pass over the points of a set: slab by slab, on several threads, devices and processes, watched and resumed.

Slabs are worked on by as many threads as there are processor cores, or by one for each of the other devices of this
process; and they are dealt to the processes in turn. Sums are added in the order of the slabs, so that a result
depends on no timing and not on the number of threads. (One array sharded over two CPU devices took 12 µs a point where
two threads took 10 and one 15: the engine's work on a block is too small to be cut further.)
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
import os
import time
from collections.abc import Callable, Generator
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from walop_jax.likelihood.journal import Journal
from walop_jax.likelihood.processes import Processes

Vector = Float[np.ndarray, " n"]
Watch = Callable[[str, int, float], None]
"""Is told what is done, how many points have been, and how many are done in a second."""


class Part(NamedTuple):
    """What some points contribute: sums, and the extent of the used ones (−x, x, −y, y at most; deg)."""

    sums: Vector
    extent: Float[np.ndarray, 4]

    def __add__(self, other: Part) -> Part:  # pyright: ignore[reportIncompatibleMethodOverride]
        return Part(self.sums + other.sums, np.maximum(self.extent, other.extent))

    @property
    def packed(self) -> Vector:
        """All of it in one array."""
        return np.concatenate(self)

    @classmethod
    def unpacked(cls, values: Vector) -> Part:
        """What `packed` holds."""
        return cls(values[:-4], values[-4:])


@dataclasses.dataclass
class Passes:
    """How passes over a set are run; `points` is the length of the set, `slab` that of a slab."""

    points: int
    slab: int
    watch: Watch | None = None
    journal: Journal | None = None
    processes: Processes = dataclasses.field(default_factory=Processes)

    def total(self, label: str, key: str | None, work: Callable[[int], Part]) -> Part:
        """The sum of `work` over all slabs of all processes.

        `label` is told to `watch`; `key` says all that the result depends on besides the set, the model and the
        software, None that it is not worth keeping. Raises what `work` raises, and LostProcessError when another
        process has gone.
        """
        slabs = math.ceil(self.points / self.slab)
        mine, journal = self.processes.share(slabs), self.journal if key is not None else None
        key = f"{key} slab {self.slab}"
        done = {} if journal is None else journal.read(key)
        todo = [n for n in mine if n not in done]
        total: Part | None = None
        began = told = time.perf_counter()
        with contextlib.closing(self._each(todo, work)) as parts:
            fresh = 0
            for count, number in enumerate(mine, start=1):
                if number in done:
                    part = Part.unpacked(done[number])
                else:
                    part, fresh = next(parts), fresh + 1
                    if journal is not None:
                        journal.append(key, number, part.packed)
                total = part if total is None else total + part
                now = time.perf_counter()
                if self.watch is not None and fresh and (now - told > 1.0 or count == len(mine)):
                    rate = fresh * self.slab * self.processes.count / (now - began)
                    self.watch(label, min(count * self.slab * self.processes.count, self.points), rate)
                    told = now
        if total is None:
            raise ValueError(f"{self.processes.count} processes for {slabs} slabs of points: use fewer")
        rows = self.processes.gather(f"{label} {key}", total.packed)
        return functools.reduce(Part.__add__, map(Part.unpacked, rows))

    def _each(self, numbers: list[int], work: Callable[[int], Part]) -> Generator[Part, None, None]:
        devices = jax.local_devices()
        threads = threads_at_work()

        def on_device(entry: tuple[int, int]) -> Part:
            place, number = entry
            with jax.default_device(devices[place % len(devices)]):
                return work(number)

        entries = list(enumerate(numbers))
        # The first one alone: it compiles.
        yield from map(on_device, entries[:1])
        if len(entries) == 1 or threads == 1:
            yield from map(on_device, entries[1:])
            return
        pool = ThreadPoolExecutor(threads)
        try:
            yield from pool.map(on_device, entries[1:])
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def threads_at_work() -> int:
    """Number of slabs that are worked on at a time."""
    devices = len(jax.local_devices())
    if devices > 1 or jax.default_backend() != "cpu":
        return 2 * devices  # one computes while the next one is read
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
