"""Sums over slabs of points kept on disk, so that a fit of hours goes on where it was interrupted.

A pass is known by everything its result depends on: the set, the model, the software, the parameter values, the cut
into slabs. Its file is named by the hash of that, and holds one record per finished slab,

    number of the slab (int64), n sums (float64), SHA-256 of these bytes,

appended as they come. What was finished comes back bit by bit, so a resumed fit is the same as one that was never
interrupted. A record that does not agree with its checksum, as a crash may leave at the end, is done again, and all
after it.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float

from walop_jax.data.records import CalibrationSet
from walop_jax.likelihood import limits
from walop_jax.likelihood.thinning import thinned

Vector = Float[np.ndarray, " n"]

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
