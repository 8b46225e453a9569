"""A small calibration set on disk, its fit, and what the commands make of it; how two folders are compared."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from astropy.io import fits
from command import call, no_cache
from small_run import SEED, SMALL

from walop_jax.calibration.calibration import Calibration
from walop_jax.data.calset import read_calibration_set
from walop_jax.data.write import write_calibration_set
from walop_jax.fit.refit import refit
from walop_jax.model.effects import effect_by_name
from walop_jax.simulation.simulate import simulate

__all__ = ["call", "no_cache"]

TIMES = ("DATE", "CHECKSUM", "DATASUM")  # cards that say when a file was written, and sums over those


@dataclasses.dataclass(frozen=True)
class FittedSet:
    """A calibration set on disk, what a fit makes of it in memory, and the folder of a run with both."""

    calset: Path
    calibration: Calibration
    run: Path


@pytest.fixture(scope="session")
def fitted(calset_file, tmp_path_factory) -> FittedSet:
    run = tmp_path_factory.mktemp("fitted") / "RUN"
    result = refit(read_calibration_set(calset_file)).with_verdict()
    result.save(run)
    return FittedSet(calset_file, Calibration.from_fit(result), run)


@pytest.fixture(scope="session")
def run(fitted) -> Path:
    """The folder of that fit."""
    return fitted.run


@pytest.fixture(scope="session")
def calset_file(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("sets") / "small.fits"
    write_calibration_set(path, simulate(SMALL, seed=SEED).calset)
    return path


@pytest.fixture(scope="session")
def spoilt_file(tmp_path_factory) -> Path:
    """A set with an effect that the base model does not have."""
    path = tmp_path_factory.mktemp("sets") / "spoilt.fits"
    effect = effect_by_name("clp_wobble").of(SMALL.context(), amplitude=0.3, phase=1.0)
    write_calibration_set(path, simulate(SMALL, seed=SEED, effects=(effect,)).calset)
    return path


def content(path: Path) -> Any:
    """What a file holds, times left out, as something that can be compared."""
    if path.suffix == ".json":
        return without_times(json.loads(path.read_text()))
    if path.suffix == ".fits":
        with fits.open(path) as hdus:
            return [
                (
                    [card.image for card in hdu.header.cards if card.keyword not in TIMES],
                    b"" if hdu.data is None else hdu.data.tobytes(),
                )
                for hdu in hdus
            ]
    if path.suffix == ".nc":
        found: dict[str, Any] = {}
        with h5py.File(path) as file:
            file.visititems(lambda name, node: found.update({name: _numbers(node)}))
        return found
    return path.read_bytes()


def _numbers(node: Any) -> bytes:
    return np.asarray(node).tobytes() if isinstance(node, h5py.Dataset) and node.dtype.kind in "fi" else b""


def without_times(value: Any) -> Any:
    """A document without how long things took."""
    if isinstance(value, dict):
        return {key: without_times(entry) for key, entry in value.items() if not key.startswith("seconds")}
    if isinstance(value, list):
        return [without_times(entry) for entry in value]
    return re.sub(r"about \S+ s\b", "", value) if isinstance(value, str) else value


def assert_same_files(one: Path, other: Path, *, but: tuple[str, ...] = ()) -> None:
    """Two folders hold the same files, byte for byte apart from times."""
    names = sorted(entry.name for entry in one.iterdir() if entry.name not in but)
    assert names == sorted(entry.name for entry in other.iterdir() if entry.name not in but)
    for name in names:
        if (one / name).is_file():
            assert content(one / name) == content(other / name), name
