"""Passes over the points of a set: slab by slab, on several threads, devices and processes, told and kept.

Slabs are worked on by as many threads as there are processor cores, or by two for each of the other devices of this
process; and they are dealt to the processes in turn. Sums are added in the order of the slabs, so that a result
depends on no timing and not on the number of threads. (One array sharded over two CPU devices took 12 µs a point where
two threads took 10 and one 15: the engine's work on a block is too small to be cut further.)

Processes   Every process runs the same program on the same files, takes its share of the slabs, and the sums (some ten
            kilobytes) are exchanged at the end, added in the order of the processes: all go on with the same numbers,
            to the last bit. On CPUs JAX lets gloo carry them. A process that dies breaks the exchange, which is an
            error in all the others.
Journal     Sums over slabs are kept on disk, so that a fit of hours goes on where it was interrupted. A pass is known
            by everything its result depends on: the set, the model, the software, the parameter values, the cut into
            slabs. Its file is named by the hash of that, and holds one record per finished slab,
                number of the slab (int64), n sums (float64), SHA-256 of these bytes,
            appended as they come. A record that does not agree with its checksum, as a crash may leave at the end, is
            done again, and all after it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import os
import time
from collections.abc import Callable, Generator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import numpy as np
from jax.experimental import multihost_utils
from jaxtyping import Float

from walop_jax.data.records import CalibrationSet
from walop_jax.likelihood import limits
from walop_jax.likelihood.layout import Layout, Vector, thinned
from walop_jax.model.compiled import float64

# ------------------------------------------------------------------------------------------------------------ journal

_CHECK = 32  # bytes of a SHA-256


@dataclasses.dataclass(frozen=True)
class Journal:
    """A folder of finished work of one fit; `identity` is what all of its passes have in common."""

    folder: Path
    identity: str

    def path(self, key: str) -> Path:
        """The file of a pass."""
        name = hashlib.sha256(f"{self.identity} {key}".encode()).hexdigest()
        return self.folder / f"{name[:24]}.sums"

    def read(self, key: str) -> dict[int, Vector]:
        """The finished records of a pass by number; what follows a damaged one is cut off."""
        path = self.path(key)
        if not path.exists():
            return {}
        content = path.read_bytes()
        size = int.from_bytes(content[:8], "little")
        step = 8 + 8 * size + _CHECK
        found: dict[int, Vector] = {}
        good = 8
        while good + step <= len(content):
            body, check = content[good : good + step - _CHECK], content[good + step - _CHECK : good + step]
            if hashlib.sha256(body).digest() != check:
                break
            found[int.from_bytes(body[:8], "little")] = np.frombuffer(body, "<f8", offset=8).copy()
            good += step
        if good != len(content):
            with path.open("r+b") as file:
                file.truncate(good if found else 0)
        return found

    def append(self, key: str, number: int, sums: Vector) -> None:
        """Add the record of a finished slab."""
        self.folder.mkdir(parents=True, exist_ok=True)
        body = number.to_bytes(8, "little") + np.asarray(sums, "<f8").tobytes()
        with self.path(key).open("ab") as file:
            head = b"" if file.tell() else len(sums).to_bytes(8, "little")
            file.write(head + body + hashlib.sha256(body).digest())

    def remembered(self, key: str, make: Callable[[], Vector]) -> Vector:
        """The result of `make`, from the journal if it holds it."""
        found = self.read(key)
        if not found:
            found = {0: np.asarray(make(), float)}
            self.append(key, 0, found[0])
        return found[0]


def fingerprint(calset: CalibrationSet) -> str:
    """SHA-256 of what sums over a set depend on: its exposures and sources, and its measurements.

    Of a set that was read, its files stand for the measurements, with a sample of these in case that they were changed
    since; of one made in memory all of them are gone through.
    """
    total = hashlib.sha256()
    for record in (calset.site, calset.exposures, calset.sources):
        total.update(_bytes(record))
    for name, curve in sorted(calset.filters.items()):
        total.update(name.encode() + _bytes(curve))
    for entry in calset.inputs:
        total.update(entry.sha256.encode())
    some = thinned(calset, limits.FINGERPRINT_POINTS) if calset.inputs else calset
    for start in range(0, len(some.points), limits.FINGERPRINT_POINTS):
        stop = min(start + limits.FINGERPRINT_POINTS, len(some.points))
        total.update(_bytes(some.intensities.block(start, stop)))
    return total.hexdigest()


def _bytes(record: object) -> bytes:
    """The content of a dataclass of arrays, texts and numbers."""
    values = (getattr(record, field.name) for field in dataclasses.fields(record))  # type: ignore[arg-type]
    arrays = (np.asarray(value) for value in values)
    return b"".join(
        array.tobytes() if array.dtype.kind not in "OUS" else repr(array.tolist()).encode()
        for array in arrays
    )


# ---------------------------------------------------------------------------------------------------------- processes

HEARTBEAT = 30
"""Seconds of silence after which a process counts as dead."""


class LostProcessError(ConnectionError):
    """Another process of the same computation has gone or does something else."""


@dataclasses.dataclass(frozen=True)
class Processes:
    """This process, counted from 0, and how many there are."""

    index: int = 0
    count: int = 1

    def share(self, count: int) -> range:
        """Share of this process in `count` pieces of work."""
        return range(self.index, count, self.count)

    def gather(self, label: str, values: Vector) -> Float[np.ndarray, "processes n"]:
        """The values of every process, one row each.

        Raises LostProcessError when another process does not answer, or is at other work than `label`.
        """
        if self.count == 1:
            return values[None]
        mark = int.from_bytes(hashlib.sha256(label.encode()).digest()[:6])  # fits into a float exactly
        try:
            rows = np.asarray(multihost_utils.process_allgather(np.append(float(mark), values)))
        except (ValueError, RuntimeError) as error:
            raise LostProcessError(
                f"process {self.index} of {self.count} has lost another one ({_first_line(error)}): start all again"
            ) from error
        if not (rows[:, 0] == mark).all():
            raise LostProcessError(
                "the processes are not at the same work: give all of them the same command, files and version"
            )
        return rows[:, 1:]

    def agreed(self, label: str, values: Vector) -> Vector:
        """The values of the first process, for all: machines may round differently."""
        return self.gather(label, values)[0]


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0][:120] if str(error).strip() else type(error).__name__


def join(place: str) -> Processes:
    """Bring the processes of one computation together; to be called before JAX computes anything.

    `place` is INDEX/COUNT@HOST:PORT, the address being that of process 0, or "auto" under Slurm, Open MPI and other
    launchers that JAX knows. Raises ValueError for another form, LostProcessError when the others do not come.
    """
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    where: dict[str, object] = {}
    if place != "auto":
        numbers, at, address = place.partition("@")
        index, slash, count = numbers.partition("/")
        host, colon, port = address.rpartition(":")
        if not (at and slash and colon and host and index.isdigit() and count.isdigit() and port.isdigit()):
            raise ValueError(f"{place!r}: give INDEX/COUNT@HOST:PORT, such as 0/2@localhost:4321, or auto")
        if not int(index) < int(count):
            raise ValueError(f"{place!r}: INDEX counts from 0 to {int(count) - 1}")
        where = {"coordinator_address": address, "num_processes": int(count), "process_id": int(index)}
    try:
        jax.distributed.initialize(
            **where,  # pyright: ignore[reportArgumentType]
            initialization_timeout=10 * HEARTBEAT,
            heartbeat_timeout_seconds=HEARTBEAT,
            shutdown_timeout_seconds=HEARTBEAT,
        )
    except (RuntimeError, ValueError) as error:
        raise LostProcessError(
            f"the processes did not find each other at {place}: {_first_line(error)}"
        ) from error
    here = Processes(jax.process_index(), jax.process_count())
    here.gather("joined", np.zeros(1))  # whoever cannot be reached is missed now
    return here


# --------------------------------------------------------------------------------------------- passes over the points

Progress = Callable[[str], None]
"""Is told in a line what is being done."""

TOLD_EVERY = 1.0  # s


@dataclasses.dataclass(frozen=True)
class SlabSums:
    """Contribution of some points: sums, and the extent of the used ones (−x, x, −y, y at most; deg).

    `parts` are numbers that belong to one slab and are not added to those of others; all are of the same size.
    """

    sums: Vector
    extent: Float[np.ndarray, 4]
    parts: dict[int, Float[np.ndarray, " m"]] = dataclasses.field(default_factory=dict)

    def plus(self, other: SlabSums) -> SlabSums:
        """Contribution of these points and others."""
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
        """Inverse of `packed`; zeros may follow."""
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
    """Runner of passes: its threads and processes, who is told, and where finished slabs are kept."""

    threads: int = dataclasses.field(default_factory=usual_threads)
    processes: Processes = dataclasses.field(default_factory=Processes)
    progress: Progress | None = None
    journal: Journal | None = None

    def __getstate__(self) -> dict[str, object]:
        """Parts that a copy in another process can use: it works alone there, and is listened to by nobody."""
        return vars(dataclasses.replace(self.alone(), progress=None))

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
                    slab, told = layout.slab * self.processes.count, now
                    ready, rate = min(count * slab, layout.points), fresh * slab / (now - began)
                    self.tell(
                        f"{label}: {ready:,} of {layout.points:,} points, {rate:,.0f} points/s, "
                        f"{(layout.points - ready) / rate:.0f} s left of this pass"
                    )
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

    def _each(self, numbers: list[int], work: Callable[[int], SlabSums]) -> Generator[SlabSums, None, None]:
        devices = jax.local_devices()

        def on_device(entry: tuple[int, int]) -> SlabSums:
            place, number = entry
            # Programs belong to the device that was asked for: without asking they are shared.
            alone = len(devices) == 1
            chosen = contextlib.nullcontext() if alone else jax.default_device(devices[place % len(devices)])
            with float64(), chosen:  # both are settings of a thread
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
