"""One star at two places of the field: an error of q, u that depends on the place is found, and nothing else."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from star_tables import SOUTH, setting

from walop_jax.data.user_tables import in_memory
from walop_jax.science.apply import apply
from walop_jax.science.catalogue import read_catalogue
from walop_jax.science.overlaps import overlap

COUNT = 400


def fields(vectors, seed, slope=0.0, brighter=1.0, rotator=(0.0, 0.0), lacking=()):
    """Stars in two fields 0.2 deg apart; `slope` is an error of q that grows with X (per deg).

    Camera O1 is `brighter`; cameras `lacking` are not used.
    """
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-0.25, 0.05, COUNT), rng.uniform(-0.25, 0.25, COUNT)
    q, u = rng.normal(0, 0.01, (2, COUNT))
    rows = []
    for k, shift in enumerate((0.0, 0.2)):
        a = vectors.exact(setting(), x + shift, y)[:, 0]
        seen = (q + slope * (x + shift) + 1j * u) * np.exp(-2j * np.deg2rad(rotator[k]))
        n = 4e6 * np.einsum("pks,ps->pk", a, np.stack([np.ones(COUNT), seen.real, seen.imag], axis=1))
        n[:, 0] *= brighter
        error = np.sqrt(n + 900.0)
        n = n + error * rng.standard_normal(n.shape)
        n[:, list(lacking)] = np.nan
        rows.append(
            {"RA": 50.0 + np.arange(COUNT) / 100, "DEC": np.zeros(COUNT), "X": x + shift, "Y": y, "N": n}
        )
        rows[-1] |= {
            "N_ERR": error,
            "ROTATOR": np.full(COUNT, rotator[k]),
            "MJD": np.full(COUNT, 60000.0 + k),
        }
    return read_catalogue(
        in_memory({name: np.concatenate([row[name] for row in rows]) for name in rows[0]}), SOUTH
    )


@pytest.mark.parametrize("seed", range(4))
def test_sound_fields_agree(vectors, tabulated_once, seed):
    found = overlap(vectors.calibration, fields(vectors, seed))
    assert found.stars > 0.9 * COUNT
    assert not found.differs
    assert found.warnings() == []
    assert 0.4 < found.chi2 / found.dof < 1.2


def test_an_error_that_grows_over_the_field_is_found_with_its_size(vectors, tabulated_once):
    """0.02 per deg over 0.2 deg: ±0.002 about the mean, 0.002 of scatter in q, 0.0014 in q and u."""
    found = overlap(vectors.calibration, fields(vectors, 1, slope=0.02))
    assert found.differs
    assert "an error depends on the place in the field" in found.warnings()[0]
    assert 0.0007 < found.excess < 0.0028


def test_a_change_that_is_in_the_errors_is_no_error_of_the_place(vectors, tabulated_once):
    """O1 brighter by 1 %: with the rotator turned q of the two rows differs by 1 %, and Q_ERR of each holds half."""
    rows = fields(vectors, 1, brighter=1.01, rotator=(0.0, 90.0))
    single = dataclasses.replace(rows, star=np.arange(len(rows)))
    error = np.sqrt(np.median(apply(vectors.calibration, single).covariance[:, 0, 0]))
    assert error == pytest.approx(0.005, rel=0.15)
    assert not overlap(vectors.calibration, rows).differs


def test_rows_that_do_not_hold_q_and_u_are_not_asked(vectors, tabulated_once):
    """Two cameras in every row see one combination of q and u."""
    assert overlap(vectors.calibration, fields(vectors, 1, rotator=(0.0, 45.0), lacking=(2, 3))) is None


@pytest.mark.long
def test_none_of_two_hundred_sound_fields_and_every_one_with_an_error(vectors, tabulated_once):
    """0.01 and 0.02 per deg over 0.2 deg, fifty fields each; sizes within a quarter."""
    sound = [overlap(vectors.calibration, fields(vectors, seed)) for seed in range(200)]
    assert sum(found.differs for found in sound) == 0
    for slope in (0.01, 0.02):
        errors = [
            overlap(vectors.calibration, fields(vectors, seed, slope)) for seed in range(10_000, 10_050)
        ]
        assert all(found.differs for found in errors)
        sizes = [found.excess for found in errors]
        assert np.ptp(sizes) < 0.25 * np.mean(sizes)
        assert 0.07 * slope < np.mean(sizes) < 0.14 * slope


def test_stars_at_one_place_are_not_asked(vectors):
    rows = fields(vectors, 0)
    assert overlap(vectors.calibration, rows.of_rows(rows.time == 60000.0)) is None
