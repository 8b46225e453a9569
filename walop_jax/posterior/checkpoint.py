"""Checkpoints: a folder of HDF5 files, one per block of steps, each appearing whole or not at all.

    surrogate.h5       the surrogate that is sampled, so that a resumed run samples the very same function
    block-000001.h5    coordinates and ln p of all ensembles; walkers and random state at its end

Every file carries the fingerprint of data, model, priors, settings and versions. A file is written beside its
place, flushed and renamed, and never touched again: a kill at any moment loses the block being computed.
Nothing is ever overwritten by a run with another fingerprint.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from walop_jax.io.atomic import atomic_path
from walop_jax.io.errors import fail
from walop_jax.posterior.ensemble import Block, Walkers
from walop_jax.posterior.surrogate import Surrogate

FORMAT = 1
SURROGATE = "surrogate.h5"
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
        self.folder.mkdir(parents=True, exist_ok=True)
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
        self, number: int, walkers: Sequence[Walkers], blocks: Sequence[Block], seconds: float
    ) -> None:
        """Write one block of all ensembles."""
        arrays: dict[str, Any] = {
            "coordinates": np.stack([block.coordinates for block in blocks]),
            "log_posterior": np.stack([block.log_posterior for block in blocks]),
            "accepted": np.array([block.accepted for block in blocks]),
            "walkers": np.stack([w.coordinates for w in walkers]),
            "walkers_log_posterior": np.stack([w.log_posterior for w in walkers]),
            "random_keys": np.stack([w.random[1] for w in walkers]),
            "random_rest": np.array([w.random[2:] for w in walkers], float),
        }
        self._write(self.block_path(number), arrays, {"seconds": seconds})

    def load_block(self, number: int) -> tuple[list[Walkers], list[Block], float]:
        """One block of all ensembles, and the seconds that it took."""
        a, extra = self._read(self.block_path(number))
        walkers = [
            Walkers(x, lnp, ("MT19937", keys, int(rest[0]), int(rest[1]), float(rest[2])))
            for x, lnp, keys, rest in zip(
                a["walkers"], a["walkers_log_posterior"], a["random_keys"], a["random_rest"], strict=True
            )
        ]
        blocks = [
            Block(x, lnp, float(accepted))
            for x, lnp, accepted in zip(a["coordinates"], a["log_posterior"], a["accepted"], strict=True)
        ]
        return walkers, blocks, float(extra["seconds"])

    # -------------------------------------------------------------------------------------------- the files

    def _write(self, path: Path, arrays: Mapping[str, Any], attributes: Mapping[str, Any]) -> None:
        with atomic_path(path) as temporary, h5py.File(temporary, "w") as file:
            file.attrs["format"] = FORMAT
            file.attrs["fingerprint"] = json.dumps(self.fingerprint)
            for name, value in attributes.items():
                file.attrs[name] = value
            for name, value in arrays.items():
                file.create_dataset(name, data=value)
            file.attrs["content"] = digest(*(np.asarray(arrays[name]) for name in sorted(arrays)))

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
