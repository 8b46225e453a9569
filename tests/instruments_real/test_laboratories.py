"""Measured tables of three polarimeters: what one instrument leaves of them, and of what it has not seen."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table

from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import fit, refit
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.instrument import Instrument

NOTEBOOKS = Path(__file__).resolve().parents[2] / "notebooks"
sys.path.insert(0, str(NOTEBOOKS))
from metasurface import PLATE, fifth_angles, metasurface_set, started  # noqa: E402
from nasmyth import copied, nasmyth_set  # noqa: E402
from tables import left_over, saying  # noqa: E402
from two_retarders import WANDER, two_retarder_set  # noqa: E402

pytestmark = pytest.mark.long  # minutes
NOISE_SCALE = 3.0  # on errors that are those of noise alone


def read(path: Path) -> Table:
    return Table.read(path, format="ascii.ecsv")


def rms(left: np.ndarray, rows: np.ndarray | slice = slice(None)) -> np.ndarray:
    return np.sqrt((left[rows] ** 2).mean(axis=0))


def test_one_mirror_for_all_filters(shared_data):
    table = read(shared_data / "efosc2_2016.ecsv")
    assert copied(table).sum() == 2  # one row is a copy of another filter's
    calset = nasmyth_set(table)
    model = base_model(calset, Instrument.read(NOTEBOOKS / "nasmyth.toml"))
    result = refit(calset, model)
    assert len(model.free) <= 8
    assert result.converged
    assert result.chi2 / result.dof < 1.3


@pytest.mark.parametrize("name", ["calibration5", "calibration6", "0deg", "10deg", "20deg"])
def test_four_photodiodes(shared_data, name):
    """Beyond what the usual law leaves, and no worse at angles that were left out."""
    table = read(shared_data / f"metasurface_{name}.ecsv")
    calset = metasurface_set(table)
    instrument = Instrument.read(NOTEBOOKS / "metasurface.toml")
    model = saying(base_model(calset, instrument), calset, [s for said in PLATE.values() for s in said])
    whole = fit(Likelihood.of(calset, model), noise_scale=NOISE_SCALE)
    out, mean = fifth_angles(table), calset.intensities.counts.mean(axis=0)
    kept = dataclasses.replace(calset, intensities=calset.intensities.using(~out))
    part = fit(Likelihood.of(kept, started(model, whole)), noise_scale=NOISE_SCALE)
    left, held = (100.0 * left_over(whole, values) / mean for values in (whole.values, part.values))
    print(name, rms(left), rms(held, out))
    assert np.all(rms(left)[:4] < 0.4)
    assert np.all(rms(held, out)[:4] < 0.5)


def test_two_retarders(shared_data):
    calset = two_retarder_set(read(shared_data / "uah_2021.ecsv"))
    model = base_model(calset, Instrument.read(NOTEBOOKS / "two_retarders.toml"))
    model = saying(model, calset, [s for said in WANDER.values() for s in said])
    assert len(model.free) <= 40
    whole = fit(Likelihood.of(calset, model), noise_scale=NOISE_SCALE)
    bins = len(calset.filters)
    out = np.repeat(np.arange(bins) % 4 == 1, len(calset.exposures) // bins)
    kept = dataclasses.replace(calset, intensities=calset.intensities.using(~out))
    part = fit(Likelihood.of(kept, started(model, whole)), noise_scale=NOISE_SCALE)
    left, held = (1e-4 * left_over(whole, values)[:, 0] for values in (whole.values, part.values))
    print(rms(left), rms(held, ~out), rms(held, out))
    assert rms(left) < 1.1
    assert rms(held, out) < 1.3 * rms(held, ~out)
