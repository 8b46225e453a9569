"""Files of a sampler: `posterior.nc` (`draws`) and the chain of emcee.

Chain          `sampling/chain.h5`: the chains of emcee so far, as its own back end reads them, so that an interrupted
               run can go on. With the fingerprint of data, model, priors, sampler, settings and versions. It is written
               anew after every block of steps: a kill at any moment loses the block being computed.
"""

from __future__ import annotations

import io
import json
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from walop_jax.io.atomic import atomic_path
from walop_jax.io.errors import fail
from walop_jax.posterior.result import PosteriorSample
from walop_jax.posterior.samplers import EnsembleState, Stretch

CHAIN = "chain.h5"
_ADVICE = "sample into another folder, or start anew with --overwrite"


def write_posterior(path: str | os.PathLike[str], sample: PosteriorSample) -> None:
    """Write `posterior.nc` (netCDF 4), a group for each of ArviZ's, whole or not at all."""
    import h5netcdf
    from xarray.backends import H5NetCDFStore

    groups = sample.groups()

    def fill(file: h5py.File) -> None:
        with warnings.catch_warnings(), h5netcdf.File(file, "a") as content:
            warnings.simplefilter("ignore")
            for name, node in groups.children.items():
                node.to_dataset().dump_to_store(H5NetCDFStore(content, group=name, mode="a"))

    _write_hdf5(path, fill)


def _write_hdf5(
    path: str | os.PathLike[str], fill: Callable[[h5py.File], None], overwrite: bool = False
) -> None:
    """Write an HDF5 file that `fill` fills, in memory first: HDF5 does not survive a disk that is full."""
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        fill(file)
    with atomic_path(path, overwrite=overwrite) as temporary:
        temporary.write_bytes(buffer.getbuffer())


# -------------------------------------------------------------------------------------------------- the chain


class Chain:
    """The chain of emcee in the folder of a run, as `emcee.backends.HDFBackend(path, name="ensemble0")`, … reads it."""

    def __init__(self, folder: str | os.PathLike[str], fingerprint: Mapping[str, str]) -> None:
        self.path, self.fingerprint = Path(folder) / CHAIN, dict(fingerprint)

    def save(self, states: Sequence[EnsembleState], stretches: Sequence[Stretch], seconds: float) -> None:
        """Write all ensembles, each with its state at the end, in place of what the file held."""
        self.path.parent.mkdir(parents=True, exist_ok=True)

        def fill(file: h5py.File) -> None:
            file.attrs.update({"fingerprint": json.dumps(self.fingerprint), "seconds": seconds})
            for number, (state, stretch) in enumerate(zip(states, stretches, strict=True)):
                steps, walkers, dimension = stretch.positions.shape
                group = file.create_group(f"ensemble{number}")
                size = {"nwalkers": walkers, "ndim": dimension, "iteration": steps}
                random = {f"random_state_{k}": part for k, part in enumerate(state["random"])}
                group.attrs.update({"version": "3", "has_blobs": False, **size, **random})
                group["chain"], group["log_prob"] = stretch.positions, stretch.log_density
                group["accepted"] = stretch.acceptance.sum(axis=0)

        _write_hdf5(self.path, fill, overwrite=True)

    def load(self) -> tuple[list[EnsembleState], list[Stretch], float]:
        """All ensembles, their states at the end, and seconds; `DataError` for a file of another sample."""
        from emcee.backends import HDFBackend

        try:
            with h5py.File(self.path, "r") as file:
                before, count = json.loads(str(file.attrs["fingerprint"])), len(file)
                seconds = float(str(file.attrs["seconds"]))
            path = str(self.path)
            arrays: list[Any] = [HDFBackend(path, name=f"ensemble{n}", read_only=True) for n in range(count)]
            # Of the proposals accepted the file has the mean of each walker.
            shares = (np.repeat(k.accepted[None] / k.iteration, k.iteration, axis=0) for k in arrays)
            stretches = [Stretch(k.get_chain(), k.get_log_prob(), next(shares)) for k in arrays]
            states: list[EnsembleState] = [
                {
                    "positions": s.positions[-1],
                    "log_density": s.log_density[-1],
                    "random": tuple(k.random_state),
                }
                for s, k in zip(stretches, arrays, strict=True)
            ]
        except Exception as error:  # whatever a damaged file brings about
            raise fail(f"cannot be read: {error}", file=self.path, advice=_ADVICE) from error
        keys = sorted({*before, *self.fingerprint})
        pairs = {key: (before.get(key, "none"), self.fingerprint.get(key, "none")) for key in keys}
        if changed := [f"{k} ({a[:12]} → {b[:12]})" for k, (a, b) in pairs.items() if a != b]:
            raise fail(f"was sampled with other {', '.join(changed)}", file=self.path, advice=_ADVICE)
        return states, stretches, seconds
