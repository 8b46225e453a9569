"""An instrument with one arm and two turning elements: matrix, tables and stars against a product of Mueller matrices.

The product is typed here, in numpy, from the textbook matrices of retarder and diattenuator.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from astropy.table import Table

from walop_jax.calibration.analysis_vectors import AnalysisVectors
from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.certify import _physics
from walop_jax.calibration.matrix import analysis_vectors, matrices
from walop_jax.data.records import Exposures, FilterCurve, Position, Site, Sources
from walop_jax.data.settings import Settings
from walop_jax.data.user_tables import read_input_table
from walop_jax.fit.verdict import Verdict
from walop_jax.io.errors import DataError
from walop_jax.model.instrument import Instrument
from walop_jax.model.parameters import values_of
from walop_jax.model.planning import plan_for, plan_for_settings
from walop_jax.model.specification import Model, make_model
from walop_jax.science.apply import apply
from walop_jax.science.catalogue import read_catalogue
from walop_jax.science.field_points import field_points
from walop_jax.science.star_errors import determinant

TEXT = """
name = "TWO-BEAM"
about = "One beam, two detectors, a turning plate and a turning retarder"
source = "typed in the test"
path = ["polariser", "lens", "plate", "retarder"]

[field]
limit = 0.2
scale = 0.1

[cameras]
names = ["left", "right"]

[throughput]
degree = 1
level = 0.6

[elements.polariser]
kind = "polariser"
moves = "CLP"

[elements.lens]
kind = "collimator"
diattenuation = { value = 0.8, sigma = 0.1, unit = "deg-2" }
q = { value = 0.01, sigma = 0.002 }

[elements.plate]
kind = "retarder"
moves = "HWP"
delta = { value = 3.05, sigma = 0.02, unit = "rad" }
wavelength = 0.6

[elements.retarder]
kind = "retarder"
moves = "RET"
axis = { value = 2.0, sigma = 1.0, unit = "deg" }
delta = { value = 1.1, sigma = 0.05, unit = "rad" }

[arms.only]
path = ["analyser"]

[arms.only.elements.analyser]
kind = "analyser"
cameras = ["left", "right"]
efficiency = { value = 0.99, sigma = 0.002 }
"""
LINE = {"line": FilterCurve("line", np.array([0.62]), np.ones(1))}
SERIES = np.array([[0.60, 0.05, -0.02], [0.55, -0.04, 0.03]])  # 1, X/h, Y/h; left and right
X, Y = np.array([0.0, 0.08, -0.15, 0.05]), np.array([0.0, -0.12, 0.06, 0.15])
HWP, RET = np.array([0.0, 22.5, 67.0, np.nan]), np.array([10.0, np.nan, 75.0, 33.0])


@pytest.fixture(scope="module")
def instrument(tmp_path_factory) -> Instrument:
    path: Path = tmp_path_factory.mktemp("description") / "two_beam.toml"
    path.write_text(TEXT)
    instrument = Instrument.read(path)
    return dataclasses.replace(
        instrument, throughput=dataclasses.replace(instrument.throughput, coefficients=jnp.asarray(SERIES))
    )


@pytest.fixture(scope="module")
def model(instrument) -> Model:
    return make_model(instrument.name, instrument, fixed=("throughput.n0.p00",))


@pytest.fixture(scope="module")
def calibration(model) -> Calibration:
    """Values as designed, errors of a tenth of a prior width; exposures of lamp and polariser at four plate angles."""
    width = np.array([p.prior[1] if p.prior else 0.01 for p in model.parameters])
    sigma = np.where([p.free for p in model.parameters], 0.1 * width, 0.0)
    angles = np.tile([0.0, 22.5, 45.0, 67.5], 2)
    nan, count, odd = np.full(8, np.nan), 8, np.arange(8) % 2 > 0
    exposures = Exposures(
        exposure=np.arange(count), kind=np.repeat(["lamp", "clp"], 4), mjd=61000.0 + np.arange(8), exptime=nan,
        filter=np.full(count, "line"), temp=np.full(8, 10.0), ha=nan, ra=nan, dec=nan, rotator=nan, teff=nan,
        positions={
            "CLP": Position.at(np.where(np.arange(8) > 3, 30.0, np.nan)), "HWP": Position.at(angles),
            "RET": Position.at(np.where(odd, 20.0, np.nan)),
        },
    )  # fmt: skip
    verdict = Verdict(1.0, 1, 16, 1.0, converged=True)
    return Calibration(
        model=model,
        values=np.asarray(values_of(model.template)),
        covariance=np.diag(sigma**2),
        verdict=verdict,
        filters=LINE,
        exposures=exposures,
        sources=Sources.none(),
        site=Site("", np.nan, np.nan, np.nan),
        origin="",
        field=(-0.15, 0.15, -0.15, 0.15),
    )


# ------------------------------------------------------------------------------- the instrument, typed in numpy


def rotation(degrees: float) -> np.ndarray:
    """Stokes parameters referred to axes turned by an angle."""
    c, s = np.cos(2 * np.deg2rad(degrees)), np.sin(2 * np.deg2rad(degrees))
    return np.array([[1, 0, 0, 0], [0, c, s, 0], [0, -s, c, 0], [0, 0, 0, 1.0]])


def retarder(delta: float, axis: float) -> np.ndarray:
    """Fast axis at `axis` (deg): along +X it takes u to v by +sin δ."""
    c, s = np.cos(delta), np.sin(delta)
    along = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, c, s], [0, 0, -s, c]])
    return rotation(-axis) @ along @ rotation(axis)


def diattenuator(q: float, u: float) -> np.ndarray:
    """Lu & Chipman 1996, equation 18."""
    d, size = np.array([q, u, 0.0]), np.hypot(q, u)
    root, unit = np.sqrt(1 - size**2), np.array([q, u, 0.0]) / max(size, 1e-300)
    matrix = np.eye(4)
    matrix[0, 1:] = matrix[1:, 0] = d
    matrix[1:, 1:] = root * np.eye(3) + (1 - root) * np.outer(unit, unit)
    return matrix


def typed(x: float, y: float, hwp: float, ret: float, wavelength: float = 0.62) -> np.ndarray:
    """Analysis vectors (camera, Stokes) of light behind the place of the polariser."""
    train = diattenuator(0.8 * (x**2 - y**2) + 0.01, 0.8 * 2 * x * y)
    if np.isfinite(hwp):
        train = retarder(3.05 * 0.6 / wavelength, hwp) @ train
    if np.isfinite(ret):
        train = retarder(1.1, 2.0 + ret) @ train
    beams = 0.5 * np.array([[1, 0.99, 0, 0], [1, -0.99, 0, 0]])
    throughput = SERIES @ [1.0, x / 0.1, y / 0.1]
    return throughput[:, None] * (beams @ train)


def typed_matrix(vectors: np.ndarray) -> np.ndarray:
    return (vectors[0] - vectors[1])[:3] / (vectors[0] + vectors[1])[0]


def settings_of(hwp: np.ndarray, ret: np.ndarray) -> Settings:
    return Settings.default(len(hwp), "line").at(HWP=hwp, RET=ret)


EXPECTED = np.array([typed(*row) for row in zip(X, Y, HWP, RET, strict=True)])


# --------------------------------------------------------------------------------------- matrix and vectors


def test_vectors_are_the_product_of_mueller_matrices(instrument):
    settings = settings_of(HWP, RET)
    plan = plan_for_settings(instrument, settings, LINE)
    found = analysis_vectors(instrument, plan, X, Y)[np.arange(4), np.asarray(plan.band_of)[:, 0]]
    np.testing.assert_allclose(found, EXPECTED, rtol=0, atol=1e-12)


def test_exposures_and_settings_make_the_same_plan(instrument, calibration):
    """What is asked for by settings is laid out as a fit lays it out for exposures that stand alike."""
    settings = Settings.of(calibration.exposures, instrument.moving())
    one = plan_for(instrument, calibration.exposures, LINE)
    other = plan_for_settings(instrument, settings, LINE)
    assert one.moving == other.moving
    assert [positions for positions, *_ in one.settings] == [positions for positions, *_ in other.settings]
    # Exposures of each KIND have bands of their own.
    weights = (np.asarray(plan.node_weight)[np.asarray(plan.band_of)[:, 0]] for plan in (one, other))
    np.testing.assert_array_equal(*weights)


def test_the_matrix_has_one_row(calibration):
    values, covariance = calibration.matrix(X, Y, settings_of(HWP, RET))
    expected = [typed_matrix(vectors) for vectors in EXPECTED]
    np.testing.assert_allclose(values, expected, rtol=0, atol=1e-12)
    assert covariance.shape == (4, 3, 3)


def test_the_covariance_is_that_of_finite_differences(calibration):
    settings, total = settings_of(HWP, RET), np.zeros((4, 3, 3))
    for k in np.flatnonzero(np.diag(calibration.covariance)):
        step = np.zeros(len(calibration.values))
        step[k] = np.sqrt(calibration.covariance[k, k])
        up, down = (
            matrices(
                calibration.model.instrument(calibration.values + sign * 0.1 * step),
                settings, LINE, X, Y, calibration.covariance,
            )[0]
            for sign in (1, -1)
        )  # fmt: skip
        slope = (up - down) / 0.2
        total += slope[:, :, None] * slope[:, None, :]
    scale = np.sqrt(np.einsum("pii->pi", total))
    off = (calibration.matrix(X, Y, settings)[1] - total) / (scale[:, :, None] * scale[:, None, :])
    assert np.abs(off).max() < 1e-3


def test_flags_and_columns(calibration):
    """One row has no inverse, so its cross-talk is no matter; a filter that was never used is."""
    settings = dataclasses.replace(settings_of(HWP, RET), filter=np.array(["line"] * 3 + ["SDSS-r"]))
    outside = np.array([False, True, False, False])
    columns = calibration.matrix_columns(X, Y, settings, outside)
    assert list(columns) == ["M21", "M22", "M23", "M21_ERR", "M22_ERR", "M23_ERR", "FLAG"]
    assert columns["FLAG"][0].tolist() == [0, 32, 0, 64]
    assert np.isnan(columns["M22"][0]).tolist() == outside.tolist()


def test_maps_are_of_a_setting_that_was_used(calibration):
    """The plate was never out, the retarder sometimes was."""
    maps = calibration.new_maps(5)
    assert maps.values.shape == (3, 5, 5)
    assert maps.positions == {"HWP": 0.0}
    points = maps.grid.points
    expected = [typed_matrix(typed(x, y, 0.0, np.nan)) for x, y in zip(points.x, points.y, strict=True)]
    np.testing.assert_allclose(maps.values.reshape(3, -1).T, expected, rtol=0, atol=1e-12)


def test_no_camera_sees_less_than_nothing(calibration):
    check = _physics(calibration)
    assert check.passed
    assert "left/right " in check.found
    index = calibration.model.index("only.analyser.efficiency")
    values = calibration.values.copy()
    values[index] = 1.05
    assert not _physics(dataclasses.replace(calibration, values=values)).passed


def test_an_element_that_is_not_there(calibration):
    with pytest.raises(ValueError, match="no moving element 'HWQ'; did you mean 'HWP'"):
        calibration.matrix(X, Y, Settings.default(4, "line").at(HWQ=3.0))
    out = Settings.default(4, "line").at(HWP=HWP, CHWP=None)  # what is out need not exist
    assert np.isfinite(calibration.matrix(X, Y, out)[0]).all()


# ------------------------------------------------------------------------------------------- tables and stars


@pytest.fixture(scope="module")
def vectors(calibration) -> AnalysisVectors:
    return AnalysisVectors(calibration)


def test_tables_meet_the_product(vectors):
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-0.18, 0.18, (2, 40))
    for hwp, ret in ((0.0, np.nan), (67.0, 75.0)):
        setting = Settings.default(1, "line").at(HWP=hwp, RET=ret)
        expected = [typed(*place, hwp, ret)[:, :3] for place in zip(x, y, strict=True)]
        np.testing.assert_allclose(vectors.coloured(setting, x, y), expected, rtol=0, atol=2e-7)
        np.testing.assert_allclose(vectors.exact(setting, x, y)[:, 0], expected, rtol=0, atol=1e-12)


PLATES = (0.0, 22.5, 45.0, 67.5)


def star_rows(rng, count: int, plates=PLATES, electrons: float = 1e6) -> tuple[Table, np.ndarray]:
    """Rows of stars by the typed product, noise and all, one for each angle of the plate; and their (q, u)."""
    x, y = rng.uniform(-0.14, 0.14, (2, count))
    qu = rng.uniform(-0.05, 0.05, (count, 2))
    table: dict[str, list] = {name: [] for name in ("ID", "X", "Y", "N", "N_ERR", "HWP_ANGLE")}
    for star in range(count):
        for plate in plates:
            n = (
                electrons
                * rng.uniform(0.7, 1.0)
                * typed(x[star], y[star], plate, np.nan)[:, :3]
                @ [1, *qu[star]]
            )
            error = np.sqrt(n)
            for name, value in zip(
                table, (star, x[star], y[star], n + error * rng.standard_normal(2), error, plate), strict=True
            ):
                table[name].append(value)
    return Table(table | {"FILTER": np.full(len(table["X"]), "line")}), qu


def read(table: Table, calibration: Calibration, tmp_path: Path):
    table.write(tmp_path / "c.fits", overwrite=True)
    instrument = calibration.model.template.patched()
    return read_catalogue(read_input_table(tmp_path / "c.fits"), instrument, always_in=calibration.always_in)


def test_four_plate_angles_give_q_and_u(calibration, tmp_path):
    table, qu = star_rows(np.random.default_rng(3), 200)
    found = apply(calibration, read(table, calibration, tmp_path))
    root = np.linalg.cholesky(np.linalg.inv(found.photon))
    pulls = np.einsum("sij,si->sj", root, found.qu - qu)
    assert np.abs(np.mean(pulls)) < 4 / np.sqrt(400)
    assert np.mean(pulls**2) == pytest.approx(1.0, abs=4 * np.sqrt(2 / 400))
    assert found.rows.tolist() == [4] * 200
    assert (found.flag == 0).all()
    # Eight intensities, four fluxes, q and u.
    assert found.dof.tolist() == [2] * 200
    assert np.mean(found.chi2) == pytest.approx(2.0, abs=4 * np.sqrt(4 / 200))


def test_one_angle_holds_one_combination(calibration, tmp_path):
    table, _ = star_rows(np.random.default_rng(4), 3, plates=(22.5,))
    found = apply(calibration, read(table, calibration, tmp_path))
    assert np.isnan(found.qu).all()
    assert (found.flag == 16 | 16384).all()
    both, _ = star_rows(np.random.default_rng(4), 3, plates=(22.5, 22.5))  # twice the same
    assert (apply(calibration, read(both, calibration, tmp_path)).flag == 16 | 16384).all()


def test_what_exposures_hold_of_q_and_u():
    one = np.stack([typed(0.0, 0.0, plate, np.nan)[:, :3] for plate in (0.0, 22.5)])
    assert determinant(one[:1]) == pytest.approx(0.0, abs=1e-7)
    rows = np.stack([typed_matrix(vectors) for vectors in one])[:, 1:]
    assert determinant(one[None])[0] == pytest.approx(abs(np.linalg.det(rows)), rel=1e-9)


def test_a_table_must_say_where_an_element_stands_that_was_never_out(calibration, tmp_path):
    table, _ = star_rows(np.random.default_rng(4), 2)
    del table["HWP_ANGLE"]
    with pytest.raises(DataError, match=r"HWP_ANGLE: the angle of HWP is missing.*--at HWP=0"):
        read(table, calibration, tmp_path)


def test_columns_of_moving_elements(instrument, tmp_path):
    """Without the column IN an element is in the beam where it has an angle; other columns are left alone."""
    columns = {"X": [0.0, 0.1], "Y": [0.0, 0.0], "HWP_ANGLE": [np.nan, 45.0], "RET_IN": [True, False]}
    columns |= {"RET_ANGLE": [10.0, 20.0], "CHWP_ANGLE": [1.0, 2.0], "ODD_IN": [3, 4]}
    Table(columns).write(tmp_path / "p.fits")
    settings = field_points(read_input_table(tmp_path / "p.fits"), instrument).settings
    assert list(settings.positions) == ["HWP", "RET"]
    np.testing.assert_array_equal(settings.position("HWP"), [np.nan, 45.0])
    np.testing.assert_array_equal(settings.position("RET"), [10.0, np.nan])
    Table({"X": [0.0], "Y": [0.0], "RET_IN": [True]}).write(tmp_path / "q.fits")
    with pytest.raises(DataError, match="RET_ANGLE: is not finite in row 0"):
        field_points(read_input_table(tmp_path / "q.fits"), instrument)
