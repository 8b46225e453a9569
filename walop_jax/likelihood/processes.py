"""The processes that share the work on one set: as many as `jax.distributed` has brought together, or one.

Every process runs the same program on the same files. In a pass over the points each takes its share of the slabs, and
the sums (some ten kilobytes) are exchanged at the end, added in the order of the processes: all go on with the same
numbers, to the last bit. On CPUs JAX lets gloo carry them. A process that dies breaks the exchange, which is an error
in all the others.
"""

from __future__ import annotations

import dataclasses
import hashlib
import os

import jax
import numpy as np
from jax.experimental import multihost_utils
from jaxtyping import Float

Vector = Float[np.ndarray, " n"]

HEARTBEAT = 30
"""Seconds of silence after which a process counts as dead."""


class LostProcessError(ConnectionError):
    """Another process of the same computation has gone or does something else."""


@dataclasses.dataclass(frozen=True)
class Processes:
    """This process, counted from 0, and how many there are."""

    index: int = 0
    count: int = 1

    @classmethod
    def present(cls) -> Processes:
        """Those that `jax.distributed` knows of."""
        return cls(jax.process_index(), jax.process_count())

    def share(self, count: int) -> range:
        """Which of `count` pieces of work are this process's."""
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
    here = Processes.present()
    here.gather("joined", np.zeros(1))  # whoever cannot be reached is missed now
    return here


def leave_at_once(code: int) -> None:
    """End this process without waiting for the others, which may have gone."""
    os._exit(code)
