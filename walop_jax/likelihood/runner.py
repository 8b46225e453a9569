"""How a pass over the points of a set is run: slab by slab, on several threads, devices and processes, told and kept.

Slabs are worked on by as many threads as there are processor cores, or by two for each of the other devices of this
process; and they are dealt to the processes in turn. Sums are added in the order of the slabs, so that a result
depends on no timing and not on the number of threads. (One array sharded over two CPU devices took 12 µs a point where
two threads took 10 and one 15: the engine's work on a block is too small to be cut further.)
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import os
import time
from collections.abc import Callable, Generator
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
from jaxtyping import Float

from walop_jax.likelihood.journal import Journal
from walop_jax.likelihood.layout import Layout
from walop_jax.likelihood.processes import Processes

Vector = Float[np.ndarray, " n"]
Progress = Callable[[str], None]
"""Is told in a line what is being done."""

TOLD_EVERY = 1.0  # s


@dataclasses.dataclass(frozen=True)
class SlabSums:
    """What some points contribute: sums, and the extent of the used ones (−x, x, −y, y at most; deg).

    `parts` are numbers that belong to one slab and are not added to those of others; all are of the same size.
    """

    sums: Vector
    extent: Float[np.ndarray, 4]
    parts: dict[int, Float[np.ndarray, " m"]] = dataclasses.field(default_factory=dict)

    def plus(self, other: SlabSums) -> SlabSums:
        """What these points and others contribute."""
        return SlabSums(
            self.sums + other.sums, np.maximum(self.extent, other.extent), self.parts | other.parts
        )

    @property
    def packed(self) -> Vector:
        """All of it in one array."""
        numbered = [np.append(float(number), part) for number, part in self.parts.items()]
        head = np.array([len(self.sums), len(numbered), len(numbered[0]) if numbered else 0], float)
        return np.concatenate([head, self.sums, self.extent, *numbered])

    @classmethod
    def unpacked(cls, values: Vector) -> SlabSums:
        """What `packed` holds; zeros may follow."""
        size, count, each = (int(value) for value in values[:3])
        sums, extent, rest = np.split(values[3:], [size, size + 4])
        rows = rest[: count * each].reshape(count, each)
        return cls(sums, extent, {int(row[0]): row[1:] for row in rows})


def usual_threads() -> int:
    """Number of slabs that are worked on at a time unless told otherwise."""
    devices = len(jax.local_devices())
    if devices > 1 or jax.default_backend() != "cpu":
        return 2 * devices  # one computes while the next one is read
    return cores()


def cores() -> int:
    """Number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclasses.dataclass(frozen=True)
class Runner:
    """How passes are run: on how many threads, by which processes, who is told, and where finished slabs are kept."""

    threads: int = dataclasses.field(default_factory=usual_threads)
    processes: Processes = dataclasses.field(default_factory=Processes)
    progress: Progress | None = None
    journal: Journal | None = None

    def alone(self) -> Runner:
        """The same for work that is neither shared with other processes nor worth keeping."""
        return dataclasses.replace(self, processes=Processes(), journal=None)

    def tell(self, text: str) -> None:
        """Say what is being done, if somebody listens."""
        if self.progress is not None:
            self.progress(text)

    def total(self, label: str, key: str | None, work: Callable[[int], SlabSums], layout: Layout) -> SlabSums:
        """The sum of `work` over all slabs of all processes.

        `label` is what is told of it; `key` says all that the result depends on besides the set, the model and the
        software, None that it is not worth keeping. Raises what `work` raises, and LostProcessError when another
        process has gone.
        """
        mine, journal = self.processes.share(layout.slabs), self.journal if key is not None else None
        key = f"{key} slab {layout.slab}"
        done = {} if journal is None else journal.read(key)
        todo = [n for n in mine if n not in done]
        total: SlabSums | None = None
        began = told = time.perf_counter()
        with contextlib.closing(self._each(todo, work)) as parts:
            fresh = 0
            for count, number in enumerate(mine, start=1):
                if number in done:
                    part = SlabSums.unpacked(done[number])
                else:
                    part, fresh = next(parts), fresh + 1
                    if journal is not None:
                        journal.append(key, number, part.packed)
                total = part if total is None else total.plus(part)
                now = time.perf_counter()
                if fresh and now - told > TOLD_EVERY:
                    slab = layout.slab * self.processes.count
                    self._tell_how_far(
                        label, min(count * slab, layout.points), layout.points, fresh * slab / (now - began)
                    )
                    told = now
        if total is None:
            raise ValueError(
                f"{self.processes.count} processes for {layout.slabs} slabs of points: use fewer"
            )
        packed = total.packed
        if total.parts:  # others may have one more
            most = -(-layout.slabs // self.processes.count)
            packed = np.pad(
                packed, (0, (most - len(total.parts)) * (1 + len(next(iter(total.parts.values())))))
            )
        rows = self.processes.gather(f"{label} {key}", packed)
        return functools.reduce(SlabSums.plus, map(SlabSums.unpacked, rows))

    def _tell_how_far(self, label: str, done: int, points: int, rate: float) -> None:
        left = (points - done) / rate
        self.tell(
            f"{label}: {done:,} of {points:,} points, {rate:,.0f} points/s, {left:.0f} s left of this pass"
        )

    def _each(self, numbers: list[int], work: Callable[[int], SlabSums]) -> Generator[SlabSums, None, None]:
        devices = jax.local_devices()

        def on_device(entry: tuple[int, int]) -> SlabSums:
            place, number = entry
            if (
                len(devices) == 1
            ):  # programs belong to the device that was asked for: without asking they are shared
                return work(number)
            with jax.default_device(devices[place % len(devices)]):
                return work(number)

        entries = list(enumerate(numbers))
        # The first one alone: it compiles.
        yield from map(on_device, entries[:1])
        if len(entries) == 1 or self.threads == 1:
            yield from map(on_device, entries[1:])
            return
        pool = ThreadPoolExecutor(self.threads)
        try:
            yield from pool.map(on_device, entries[1:])
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
