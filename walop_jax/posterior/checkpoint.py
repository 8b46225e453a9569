"""Checkpoints: a folder of HDF5 files, one per block of steps, each appearing whole or not at all.

    surrogate.h5       the surrogate, where that is sampled, so that a resumed run samples the very same function
    block-000001.h5    positions and ln p of all ensembles; the state of the sampler at its end

Every file carries the fingerprint of data, model, priors, sampler, settings and versions. A file is written beside its
place, flushed and renamed, and never touched again: a kill at any moment loses the block being computed.
Nothing is ever overwritten by a run with another fingerprint.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from walop_jax.data.records import InputFile
from walop_jax.io.atomic import atomic_path
from walop_jax.io.errors import fail
from walop_jax.posterior.samplers import State, Stretch
from walop_jax.posterior.surrogate import Surrogate

FORMAT = 2
SURROGATE = "surrogate.h5"
_STATE = "state."
_ARRAYS = ("positions", "log_density", "acceptance")
_ADVICE = "sample into another folder, or start anew with --overwrite"


def digest(*parts: Any) -> str:
    """SHA-256 of arrays, texts and numbers."""
    total = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray) and part.dtype.kind not in "OUS":
            total.update(f"{part.dtype.str}{part.shape}".encode() + np.ascontiguousarray(part).tobytes())
        else:
            total.update(repr(part.tolist() if isinstance(part, np.ndarray) else part).encode() + b"\n")
    return total.hexdigest()


def digest_of_fit(inputs: Sequence[InputFile], names: Sequence[str], values: np.ndarray) -> str:
    """What tells a fit from others: its data, its parameters and their values, to the last bit."""
    return digest(sorted(entry.sha256 for entry in inputs), list(names), np.asarray(values, float))


class Checkpoints:
    """The checkpoint folder of one run."""

    def __init__(self, folder: str | os.PathLike[str], fingerprint: Mapping[str, str]) -> None:
        self.folder = Path(folder)
        self.fingerprint = dict(fingerprint)

    def block_path(self, number: int) -> Path:
        """The file of block `number`, counted from 1."""
        return self.folder / f"block-{number:06d}.h5"

    def count(self) -> int:
        """How many blocks there are, without a gap."""
        number = 0
        while self.block_path(number + 1).exists():
            number += 1
        return number

    def exists(self) -> bool:
        """Whether a run has left anything here."""
        return (self.folder / SURROGATE).exists() or self.count() > 0

    def clear(self) -> None:
        """Remove the checkpoints of an earlier run.

        The surrogate last, so that what is left is still whole.
        """
        blocks = sorted(self.folder.glob("block-*.h5"), reverse=True)
        unfinished = self.folder.glob(".walop-*.h5")  # what a kill in the middle of writing leaves
        for path in (*blocks, *unfinished, self.folder / SURROGATE):
            path.unlink(missing_ok=True)

    # --------------------------------------------------------------------------------------- the surrogate

    def save_surrogate(self, surrogate: Surrogate, extra: Mapping[str, float]) -> None:
        """Write the surrogate and what was measured of it."""
        arrays = {f.name: getattr(surrogate, f.name) for f in dataclasses.fields(surrogate)}
        names = json.dumps(list(arrays.pop("names")))
        self._write(self.folder / SURROGATE, arrays, {"names": names, **extra})

    def load_surrogate(self) -> tuple[Surrogate, dict[str, Any]]:
        """The surrogate as it was saved, and what was measured of it."""
        arrays, extra = self._read(self.folder / SURROGATE)
        names = tuple(json.loads(extra.pop("names")))
        scalars = {"measured": int(arrays.pop("measured")), "inflate": bool(arrays.pop("inflate"))}
        return Surrogate(names=names, **scalars, **arrays), extra

    # ------------------------------------------------------------------------------------------- the blocks

    def save_block(
        self, number: int, states: Sequence[State], stretches: Sequence[Stretch], seconds: float
    ) -> None:
        """Write one block of all ensembles, with their states at its end."""
        arrays = {name: np.stack([getattr(s, name) for s in stretches]) for name in _ARRAYS}
        arrays |= {f"{_STATE}{name}": np.stack([state[name] for state in states]) for name in states[0]}
        counts = json.dumps([dict(stretch.counts) for stretch in stretches])
        self._write(self.block_path(number), arrays, {"seconds": seconds, "counts": counts})

    def load_block(self, number: int) -> tuple[list[State], list[Stretch], float]:
        """One block of all ensembles, their states at its end, and the seconds that it took."""
        arrays, extra = self._read(self.block_path(number))
        counts = json.loads(extra["counts"])
        stretches = [
            Stretch(*(arrays[name][i] for name in _ARRAYS), counts=counts[i]) for i in range(len(counts))
        ]
        kept = {name.removeprefix(_STATE): a for name, a in arrays.items() if name.startswith(_STATE)}
        states: list[State] = [{name: array[i] for name, array in kept.items()} for i in range(len(counts))]
        return states, stretches, float(extra["seconds"])

    def check(self) -> None:
        """Raise `DataError` if what is here was sampled from, or with, anything else."""
        surrogate = self.folder / SURROGATE
        self._read(surrogate if surrogate.exists() else self.block_path(1))

    # -------------------------------------------------------------------------------------------- the files

    def _write(self, path: Path, arrays: Mapping[str, Any], attributes: Mapping[str, Any]) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        # In memory first: HDF5 does not survive a disk that is full.
        buffer = io.BytesIO()
        with h5py.File(buffer, "w") as file:
            file.attrs["format"] = FORMAT
            file.attrs["fingerprint"] = json.dumps(self.fingerprint)
            for name, value in attributes.items():
                file.attrs[name] = value
            for name, value in arrays.items():
                file.create_dataset(name, data=value)
            file.attrs["content"] = digest(*(np.asarray(arrays[name]) for name in sorted(arrays)))
        with atomic_path(path) as temporary:
            temporary.write_bytes(buffer.getbuffer())

    def _read(self, path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
        try:
            with h5py.File(path, "r") as file:
                attributes: dict[str, Any] = {str(key): value for key, value in file.attrs.items()}
                arrays = {str(name): np.asarray(file[str(name)]) for name in file}
        except (OSError, RuntimeError, KeyError) as error:
            raise fail(f"cannot be read: {error}", file=path, advice=_ADVICE) from error
        if attributes.pop("format", None) != FORMAT:
            raise fail("is a checkpoint of another format", file=path, advice=_ADVICE)
        if attributes.pop("content", None) != digest(*(arrays[name] for name in sorted(arrays))):
            raise fail("the content is not what was written", file=path, advice=_ADVICE)
        before: dict[str, str] = json.loads(str(attributes.pop("fingerprint", "{}")))
        keys = sorted({*before, *self.fingerprint})
        changed = [key for key in keys if before.get(key) != self.fingerprint.get(key)]
        if changed:
            what = ", ".join(
                f"{k} ({before.get(k, 'none')[:12]} → {self.fingerprint.get(k, 'none')[:12]})"
                for k in changed
            )
            raise fail(f"was sampled with other {what}", file=path, advice=_ADVICE)
        return arrays, attributes
