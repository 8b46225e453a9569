"""A calibration set made of arrays: the same as from a file, and refused for the same reasons."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from astropy import units
from small_run import SEED, SMALL

from walop_jax.data.calset import checked, from_arrays
from walop_jax.data.records import CalibrationSet, FineStructure
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.fit.base_model import base_model
from walop_jax.io.errors import DataError
from walop_jax.simulation.simulate import simulate

X, Y, ANGLES = np.array([-0.1, 0.0, 0.1]), np.array([0.05, -0.05, 0.1]), np.arange(8) * 22.5


def light() -> np.ndarray:
    """Counts (3, 8, 4) of an ideal instrument: N (1 ± cos 2θ), N (1 ± sin 2θ) with polarised light."""
    two = 2 * np.deg2rad(ANGLES)
    return (
        1e5
        * (1.1 + np.stack([np.cos(two), -np.cos(two), np.sin(two), -np.sin(two)], axis=-1)[None])
        * np.ones((3, 1, 1))
    )


def made(**changes) -> CalibrationSet:
    given = {"counts": light(), "errors": np.sqrt(light()), "x": X, "y": Y, "angles": ANGLES}
    return from_arrays(**(given | changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"counts": light()[..., :2], "errors": light()[..., :2]},
            r"N: has 2 camera\(s\), WALOP-SOUTH has 4; .* correct the name of the instrument",
        ),
        (
            {"filters": {"B": ([0.44], [1.0])}},
            r"filters: 'B' is no curve; give walop.FilterCurve\('B', wavelength in um",
        ),
    ],
)
def test_what_belongs_to_another_instrument_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        made(**changes)


def test_an_element_that_the_instrument_has_not_is_no_column_to_pass_over():
    with pytest.raises(
        ValueError, match=r"HPW_ANGLE is given, but the instrument has no .*; did you mean 'CHWP'"
    ):
        base_model(made(hpw_angle=22.5))


@pytest.mark.parametrize("changes", [{"prior": (15.6, -0.1)}, {"start": np.nan}, {"scale": 0.0}])
def test_values_of_a_parameter_that_mean_nothing_are_refused(changes):
    (field,) = changes
    with pytest.raises(ValueError, match=rf"parameter pupil\.magnification: {field} = .* must be"):
        base_model(made()).change("pupil.magnification", **changes)


def test_arrays_come_back():
    block = made().intensities.block(0, 3)
    np.testing.assert_array_equal(block.counts, light())
    np.testing.assert_array_equal(block.sigma, np.sqrt(light()))
    np.testing.assert_array_equal(made().exposures.clp_angle, ANGLES)
    assert made().exposures.clp_in.all()
    assert set(made().exposures.kind) == {"clp"}


def test_the_level_of_the_sky_comes_back():
    """A diagnosis asks for a share of it that is left in the counts."""
    counts, level = light(), 100.0 * np.arange(1.0, 97.0).reshape(3, 8, 4)
    counts[1, 2] = np.nan
    again = from_arrays(**made(counts=counts, sky=level).to_arrays()).intensities
    assert isinstance(again, TableIntensities)
    np.testing.assert_array_equal(again.sky, level[again.point, again.exposure])
    assert made().to_arrays()["sky"] is None


def test_the_structure_of_the_frames_that_a_set_was_made_of_comes_back():
    fine = FineStructure(np.zeros(1), np.ones(1), np.full((1, 4), 1e-6), np.full((1, 4), 1e-7))
    of_frames = dataclasses.replace(made(), fine=fine)
    assert from_arrays(**of_frames.to_arrays()).fine is fine


def test_errors_of_the_numbers_of_a_set_come_back():
    calset = made(stated_errors={"position": 0.2, "time": 30})
    assert (calset.stated_errors.position, calset.stated_errors.time) == (0.2, 30)
    assert calset.stated_errors.scale == made().stated_errors.scale == 1e-3
    assert made().stated_errors.position == 1.0
    assert from_arrays(**calset.to_arrays()).stated_errors == calset.stated_errors
    with pytest.raises(ValueError, match=r"none of 'postion'; did you mean 'position'"):
        made(stated_errors={"postion": 0.2})
    with pytest.raises(ValueError, match=r"time = -1, the error of MJD of sky exposures"):
        made(stated_errors={"time": -1.0})


def test_a_turn_is_an_angle_in_a_table_too():
    table = made(chwp_in=True, chwp_angle=10.0, chwp_turn=np.deg2rad(30.0) * units.rad).to_table()
    assert {table[name].unit for name in ("CHWP_TURN", "CHWP_ANGLE", "CLP_ANGLE", "RA")} == {units.deg}
    np.testing.assert_allclose(table["CHWP_TURN"], 30.0)


def test_units_are_converted():
    calset = made(x=X * 60 * units.arcmin, angles=np.deg2rad(ANGLES) * units.rad, temp=283.15 * units.K)
    np.testing.assert_allclose(calset.points.x, X, rtol=1e-14)
    np.testing.assert_allclose(calset.exposures.clp_angle, ANGLES, rtol=1e-14, atol=1e-12)
    np.testing.assert_allclose(calset.exposures.temp, 10.0, atol=1e-12)


def test_big_endian_and_lists():
    calset = made(counts=light().astype(">f8"), x=X.tolist(), y=Y.astype(">f4"))
    assert calset.intensities.block(0, 3).counts.dtype == np.dtype(float)
    np.testing.assert_array_equal(calset.points.x, X)


def test_what_was_not_measured_is_nan():
    counts = light()
    counts[1, 2] = np.nan
    used = made(counts=counts).intensities.block(0, 3).used
    assert used.sum() == 23
    assert not used[1, 2]


def test_a_single_nan_is_masked_and_said_with_its_place():
    counts = light()
    counts[1, 2, 3] = np.nan
    calset = made(counts=counts)
    assert not calset.intensities.block(0, 3).used[1, 2]
    assert calset.remarks == ("arrays: not finite in counts[1, 2] (camera 3): not used in any camera",)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"x": X * 60}, "degrees: are these arcmin"),
        ({"x": X * units.m}, "cannot be converted to 'deg'"),
        ({"angles": np.deg2rad(ANGLES) + 0.01}, "are these radians"),
        ({"errors": -np.sqrt(light())}, "N_ERR"),
        ({"counts": light()[:2]}, "shape"),
        ({"errors": np.sqrt(light())[:, :2]}, "errors"),
        ({"kinds": "polarizer"}, "'polarizer' is not a kind"),
        ({"filter": "SDSS-g'"}, "FILTER"),
        ({"instrument": ""}, "INSTRUME"),
        ({"temp": [1.0, 2.0]}, "temp"),
        ({"chwp_in": True}, "CHWP_ANGLE"),
        ({"counts": light() * units.m}, "electron"),
        ({"x": np.array(["a", "b", "c"])}, "not made of numbers"),
    ],
)
def test_what_a_file_is_refused_for(changes, message):
    with pytest.raises(DataError, match=message):
        made(**changes)


def test_standards():
    source = np.full((3, 8), -1)
    source[0, 0] = 0
    kinds = np.array(["standard", *["clp"] * 7])
    angles = np.where(kinds == "clp", ANGLES, np.nan)
    stars = {"NAME": ["HD 1"], "Q": [0.01], "U": [0.0], "Q_ERR": [2e-4], "U_ERR": [2e-4]}
    counts = light()
    counts[1:, 0] = np.nan
    calset = made(counts=counts, kinds=kinds, angles=angles, rotator=0.0, sources=stars, source=source)
    assert calset.sources.name.tolist() == ["HD 1"]
    assert calset.intensities.block(0, 1).source[0, 0] == 0
    with pytest.raises(DataError, match="U_ERR"):
        made(sources={name: stars[name] for name in ("NAME", "Q", "U", "Q_ERR")})


def test_a_simulated_set_passes_unchanged():
    calset = simulate(SMALL, seed=SEED).calset
    again = checked(calset)
    one, other = (c.intensities.block(0, len(c.points)) for c in (calset, again))
    for field in dataclasses.fields(one):
        np.testing.assert_array_equal(getattr(one, field.name), getattr(other, field.name))


def test_a_set_in_memory_meets_the_checks_of_a_file():
    calset = simulate(SMALL, seed=SEED).calset
    table = calset.intensities
    assert isinstance(table, TableIntensities)
    table.counts[5, 1] = np.nan
    assert not checked(calset).intensities.used[5]
    table.sigma[7] = 0.0
    with pytest.raises(DataError, match="row 7"):
        checked(calset)


def test_rows_that_were_put_aside_in_memory_stay_so():
    """Half of the rows masked by hand: the checks of files do not bring them back."""
    calset = made()
    table = calset.intensities
    mask = np.arange(len(table.used)) % 2 == 0
    masked = dataclasses.replace(calset, intensities=table.using(table.used & mask))
    np.testing.assert_array_equal(checked(masked).intensities.used, table.used & mask)
