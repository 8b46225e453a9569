"""A calibration applied to catalogues: tables against the optics, errors against brute force, frames, flags."""

from __future__ import annotations

import dataclasses
import time

import numpy as np
import pytest
from astropy.table import Table
from quick import quick
from small_run import SEED, WITH_PLATE
from star_tables import SOUTH, read, setting, stars

from walop_jax.calibration.analysis_vectors import COLOURS, AnalysisVectors, colour_weights
from walop_jax.data.settings import Settings
from walop_jax.data.user_tables import in_memory, read_input_table
from walop_jax.fit.verdict import Quality
from walop_jax.io.errors import DataError
from walop_jax.model.effects import Described, effect_by_name
from walop_jax.model.effects.blemish import Blemish
from walop_jax.model.effects.in_models import effect_context, with_effects
from walop_jax.model.instrument import nominal_instrument
from walop_jax.model.specification import make_model
from walop_jax.science.apply import apply
from walop_jax.science.catalogue import read_catalogue
from walop_jax.science.colours import COOL, HOT
from walop_jax.science.detectors import errors_of, linearised
from walop_jax.simulation.simulate import simulate

pytestmark = pytest.mark.usefixtures("tabulated_once")


# --------------------------------------------------------------------------------------------- the vectors


def test_series_meet_the_optics(vectors, calibration):
    """Anywhere in the field and at any colour, against the matrix that the calibration itself computes."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-0.34, 0.34, (2, 60))
    teff = np.where(np.arange(60) % 4 == 0, np.nan, rng.uniform(2000, 30000, 60))
    for plate in (None, 22.5):
        a = vectors.coloured(setting(plate), x, y, teff)
        rows = [(a[:, i] - a[:, i + 1]) / (a[:, i, :1] + a[:, i + 1, :1]) for i in (0, 2)]
        settings = dataclasses.replace(Settings.default(60).at(CHWP=plate), teff=teff)
        values, _ = calibration.matrix(x, y, settings)
        np.testing.assert_allclose(np.concatenate(rows, axis=1), values, atol=1e-6)


def test_derivatives_meet_differences(vectors, calibration):
    """To every parameter the vectors depend on, by changing it; one step of one standard error."""
    x, y, teff = np.array([0.11, -0.2]), np.array([0.2, 0.05]), np.array([np.nan, 4500.0])
    local = vectors.derivatives(setting(22.5), x, y, teff)
    gain = np.random.default_rng(1).standard_normal((2, 2, 4))
    s = np.array([1.0, 0.02, -0.01])
    plain, throughput = (gain @ np.einsum("s,rksf->rkf", s, part) for part in local)
    found = vectors.to_parameters(plain, throughput, x, y)
    for k in [*range(0, found.shape[-1], 9), found.shape[-1] - 1]:
        index = vectors.parameters[k]
        step = np.sqrt(calibration.covariance[index, index])
        shifted = []
        for sign in (1, -1):
            values = calibration.values.copy()
            values[index] += sign * step
            there = AnalysisVectors(dataclasses.replace(calibration, values=values))
            a = there.exact(setting(22.5), x, y, [np.nan, 4500.0])[[0, 1], [0, 1]]
            shifted.append(np.einsum("rik,rks,s->ri", gain, a, s))
        difference = (shifted[0] - shifted[1]) / (2 * step)
        scale = np.abs(difference).max()
        np.testing.assert_allclose(found[..., k], difference, atol=3e-3 * scale)


# --------------------------------------------------------------------------------------------- the answers


@pytest.mark.parametrize("teff", [np.nan, 4200.0])
def test_noiseless_stars_come_back(vectors, calibration, tmp_path, teff):
    table, qu = stars(vectors, 30, plate=(None, 22.5), teff=teff)
    found = apply(calibration, read(table, tmp_path))
    np.testing.assert_allclose(found.qu, qu, atol=2e-6)  # the series are good to 1e-7 of the counts
    assert np.all(found.chi2 < 1e-3)
    assert found.rows.tolist() == [2] * 30


def test_a_plate_that_turns_during_the_exposure_is_the_mean_of_plates_that_stand(
    vectors, calibration, tmp_path
):
    """Counts are the Gauss-Legendre mean, of 12 nodes, over 40° about 22.5°; a plate that stood is 2 % off in p."""
    nodes, weights = np.polynomial.legendre.leggauss(12)
    each = [stars(vectors, 20, plate=(22.5 + 20.0 * node,))[0] for node in nodes]
    table, qu = stars(vectors, 20, plate=(22.5,))
    table["N"] = np.einsum("a,apk->pk", 0.5 * weights, [one["N"] for one in each])
    standing = apply(calibration, read(table, tmp_path))
    assert np.abs(standing.qu - qu).max() > 1e-3
    table["CHWP_TURN"] = np.where(np.arange(20) % 2 == 0, 40.0, -40.0)  # either way, the same angles
    np.testing.assert_allclose(apply(calibration, read(table, tmp_path)).qu, qu, atol=2e-6)
    assert not any("CHWP_TURN" in remark for remark in read(table, tmp_path).remarks)


def test_calibration_errors_are_those_of_a_wrong_calibration(vectors, calibration, tmp_path):
    """Apply calibrations drawn from the covariance to the same counts: their scatter is what was promised.

    Two rows of a star share the calibration; were they taken as independent, the errors would be too small.
    """
    table, _ = stars(vectors, 12, plate=(None, 22.5))
    catalogue = read(table, tmp_path)
    promised = apply(calibration, catalogue)
    rng = np.random.default_rng(2)
    value, vector = np.linalg.eigh(calibration.covariance)  # gauges make it singular
    root = vector * np.sqrt(np.clip(value, 0.0, None))
    draws = 40
    found = []
    for _ in range(draws):
        values = calibration.values + root @ rng.standard_normal(len(root))
        found.append(_brute_force(dataclasses.replace(calibration, values=values), catalogue))
    ratio = np.var(found, axis=0, ddof=1) / np.einsum("sii->si", promised.calibration)
    # 12 stars × 2 share their errors, so the mean ratio counts as some ten independent variances of 39 degrees.
    assert np.mean(ratio) == pytest.approx(1.0, abs=4 * np.sqrt(2 / 39 / 5))
    assert np.all((ratio > 0.3) & (ratio < 2.5))


def _brute_force(calibration, catalogue):
    """(q, u) by the exact optics of a calibration and Gauss–Newton steps written out for each star."""
    vectors = AnalysisVectors(calibration)
    points = catalogue.points
    a = np.empty((len(catalogue), 4, 3))
    for plate in (None, 22.5):
        angle = points.settings.position("CHWP")
        rows = np.isnan(angle) if plate is None else angle == plate
        a[rows] = vectors.exact(setting(plate), points.x[rows], points.y[rows])[:, 0]
    out = []
    for star in range(catalogue.star.max() + 1):
        rows = np.flatnonzero(catalogue.star == star)
        qu = np.zeros(2)
        for _ in range(6):
            jacobian, residual = [], []
            for r in rows:
                w = 1 / catalogue.sigma[r]
                model = w * (a[r] @ [1, *qu])
                project = np.eye(4) - np.outer(model, model) / (model @ model)
                flux = (w * catalogue.counts[r]) @ model / (model @ model)
                jacobian.append(flux * project @ (w[:, None] * a[r, :, 1:]))
                residual.append(project @ (w * catalogue.counts[r]))
            qu = qu + np.linalg.lstsq(np.concatenate(jacobian), np.concatenate(residual), rcond=None)[0]
        out.append(qu)
    return np.array(out)


@pytest.mark.parametrize("size", [0.05, 0.003])
def test_stars_behind_a_small_spot(calibration, size):
    """No series over the field is accurate beside it, nor do its usual places show the smaller one at all.

    Intensities of the camera fall by the depth at the centre, by exp(−1/2) of it at one standard deviation.
    """
    context = effect_context(calibration.model.template, calibration.exposures)
    spot = Blemish.of(context, x=0.11, y=-0.07, size=size, depth=0.1, camera=2)
    model = with_effects(calibration.model, [spot], context)
    place = [model.index(name) for name in calibration.model.names]
    values, covariance = np.array([p.start for p in model.parameters]), np.zeros((len(model.names),) * 2)
    values[place], covariance[np.ix_(place, place)] = calibration.values, calibration.covariance
    free = model.positions("blemish")
    covariance[free, free] = 1e-6
    spotted = AnalysisVectors(
        dataclasses.replace(calibration, model=model, values=values, covariance=covariance, hidden=None)
    )
    x, y, teff = np.array([0.11, 0.11 + size, -0.1]), np.full(3, -0.07), np.full(3, np.nan)
    share = np.exp([0.0, -0.5, -((0.21 / size) ** 2) / 2.0])
    clean = AnalysisVectors(calibration).coloured(setting(None), x, y)
    ratio = spotted.coloured(setting(None), x, y) / clean
    np.testing.assert_allclose(ratio[:, 2, 0], 1.0 - 0.1 * share, atol=1e-6)
    at = [name for name, _ in spotted.named].index("blemish.depth")
    slopes = spotted.derivatives(setting(None), x, y, teff).plain[..., 0, at]
    np.testing.assert_allclose(slopes[:, 2], -share * clean[:, 2, 0], atol=1e-3)
    np.testing.assert_allclose(slopes[:, [0, 1, 3]], 0.0, atol=1e-12)


def test_sky_is_the_instrument_turned(vectors, calibration, tmp_path):
    """A star seen at three position angles is one star on the sky."""
    table, qu = stars(vectors, 20, plate=(None, None, None), rotator=(0.0, 30.0, 112.0))
    found = apply(calibration, read(table, tmp_path))
    np.testing.assert_allclose(found.qu, qu, atol=2e-6)
    single, _ = stars(vectors, 20, plate=(None,), rotator=(30.0,))
    on_sky = apply(calibration, read(single, tmp_path))
    del single["ROTATOR"]
    inside = apply(calibration, read(single, tmp_path))
    turn = np.exp(2j * np.deg2rad(30.0))
    np.testing.assert_allclose(on_sky.qu @ [1, 1j], (inside.qu @ [1, 1j]) * turn, rtol=1e-9)
    for name in ("photon", "calibration"):
        np.testing.assert_allclose(
            np.trace(getattr(on_sky, name), axis1=1, axis2=2),
            np.trace(getattr(inside, name), axis1=1, axis2=2),
            rtol=1e-6,
        )


def test_rows_one_by_one_are_the_same(vectors, calibration, tmp_path):
    rng = np.random.default_rng(3)
    table, _ = stars(vectors, 40, rng, plate=(None, 22.5), teff=5000.0, rotator=(10.0, 10.0))
    whole = apply(calibration, read(table[rng.permutation(len(table))], tmp_path))
    rounding = max(vectors_of_single_rows_differ(vectors, table), 4 * np.finfo(float).eps)
    for star in (0, 7, 23, 39):
        rows = table[table["ID"] == star]
        alone = apply(calibration, read(rows, tmp_path))
        # χ² = Σ ((N − m)/σ)²: where m is off by the share u of itself, by up to 2 √χ² u |N/σ| (Cauchy–Schwarz).
        allowed = 2 * np.sqrt(alone.chi2[0]) * rounding * np.linalg.norm(rows["N"] / rows["N_ERR"])
        assert abs(whole.chi2[star] - alone.chi2[0]) < allowed
        for name in ("qu", "photon", "calibration", "colour", "dof", "rows", "flag"):
            a, b = getattr(whole, name)[star], getattr(alone, name)[0]
            scale = 1.0 if name in ("qu", "colour") else np.abs(np.max(a)) + 1e-30
            np.testing.assert_allclose(a / scale, b / scale, rtol=0, atol=1e-12, err_msg=name)


def vectors_of_single_rows_differ(vectors, table):
    """By how much of themselves: their series are summed by BLAS, in an order that goes by the number of rows."""
    worst = 0.0
    for plate in (None, 22.5):
        rows = table[np.isnan(table["CHWP_ANGLE"]) if plate is None else table["CHWP_ANGLE"] == plate]
        columns = [np.array(rows[name], float) for name in ("X", "Y", "TEFF")]
        together = vectors.coloured(setting(plate), *columns)
        for i, one in enumerate(together):
            single = vectors.coloured(setting(plate), *(column[[i]] for column in columns))[0]
            worst = max(worst, float(np.abs(single - one).max() / np.abs(one).max()))
    return worst


def test_colour_that_is_ignored(vectors, calibration, tmp_path):
    """The stated error is what happens when the column is left out."""
    table, qu = stars(vectors, 20, plate=(None,), teff=3600.0)
    known = apply(calibration, read(table, tmp_path))
    del table["TEFF"]
    ignored = apply(calibration, read(table, tmp_path))
    # To first order: in the zone without u the second order is some per cent of it.
    np.testing.assert_allclose(ignored.qu - qu, known.colour, rtol=0.1, atol=3e-6)
    assert np.abs(known.colour).max() > 2e-5
    cool, hot = (stars(vectors, 20, plate=(None,), teff=t)[0] for t in (3500.0, 10000.0))
    for other in (cool, hot):
        del other["TEFF"]
    half = 0.5 * (apply(calibration, read(hot, tmp_path)).qu - apply(calibration, read(cool, tmp_path)).qu)
    np.testing.assert_allclose(np.abs(ignored.colour), np.abs(half), rtol=0.1, atol=3e-6)


def test_errors_hold_the_colour_that_is_not_known(vectors, calibration, tmp_path):
    """Stars of which 95 % lie between 3500 and 10 000 K, without TEFF: pulls of unit width."""
    rng = np.random.default_rng(12)
    low, high = 1 / HOT, 1 / COOL
    teff = 1.0 / np.clip(rng.normal(0.5 * (low + high), 0.25 * (high - low), 2000), 3e-5, 1 / 2500.0)
    table, qu = stars(vectors, 2000, flux=1e10)  # colour is all that matters
    x, y = np.array(table["X"]), np.array(table["Y"])
    spectra = vectors.at(setting(), x, y)
    a = np.einsum("pc,pcks->pks", colour_weights(teff, COLOURS), spectra)
    table["N"] = 1e10 * np.einsum("pks,ps->pk", a, np.column_stack([np.ones(2000), qu]))
    table["N_ERR"] = np.sqrt(table["N"])
    table["TEFF"] = teff
    known = apply(calibration, read(table, tmp_path))
    assert not known.spectrum.any()
    np.testing.assert_allclose(known.qu, qu, atol=2e-6)
    del table["TEFF"]
    found = apply(calibration, read(table, tmp_path))
    pull = (found.qu - qu) / np.sqrt(np.einsum("sii->si", found.spectrum))
    assert np.mean(np.abs(pull) < 1.0) == pytest.approx(0.683, abs=0.03)
    assert np.mean(np.abs(pull) < 1.96) == pytest.approx(0.95, abs=0.02)
    most = np.trace(found.spectrum - found.photon - found.calibration, axis1=1, axis2=2) > 0
    np.testing.assert_array_equal(found.flag & Quality.UNKNOWN_COLOUR > 0, most)
    assert most.any()


# ----------------------------------------------------------------------------------------- flags and effects


def test_flags(vectors, calibration, tmp_path):
    table, _ = stars(vectors, 8)
    table["X"][0], table["Y"][0] = 0.33, 0.0  # in the instrument, beyond the points of the run
    table["X"][1] = 0.5
    table["TEFF"][2] = 1500.0
    table["N"][3, 0] = np.nan
    table["N_FLAG"] = np.array([0, 0, 0, 0, 1, 0, 0, 0])
    table["N"][5, 1] = 9e6
    table["N"][6] = 0.0
    found = apply(calibration, read(table, tmp_path, saturation=8e6))
    zone = found.flag & 16
    # The first star moved after its light had been worked out: it may disagree with what is seen there.
    others = found.flag & ~(16 | Quality.DISAGREES | Quality.UNKNOWN_COLOUR)
    assert others.tolist()[:7] == [32, 32 | 128 | 16384, 64, 128, 128 | 256 | 16384, 128 | 256, 16384]
    assert others[7] == 0
    assert np.isnan(found.qu[[1, 4, 6]]).all()
    assert np.isfinite(found.qu[[0, 2, 3, 5]]).all()
    assert zone[1] == 16


def test_the_zone_without_u(vectors, calibration, tmp_path):
    """Where m33 → 0 one exposure holds no u. The plate at 22.5° brings it back; a turned rotator does as well."""
    x, y = np.meshgrid(np.linspace(-0.28, 0.28, 15), np.linspace(-0.28, 0.28, 15))
    values, _ = calibration.matrix(x.ravel(), y.ravel())
    blind = np.argsort(np.abs(values[:, 1] * values[:, 5] - values[:, 2] * values[:, 4]))[:5]
    base = Table({"X": x.ravel()[blind], "Y": y.ravel()[blind], "ID": np.arange(5)})
    a = {p: vectors.exact(setting(p), base["X"], base["Y"])[:, 0] for p in (None, 22.5)}

    def error(*rows):
        parts = []
        for plate, rotator in rows:
            part = base.copy()
            part["N"] = 4e6 * a[plate][..., 0]
            part["N_ERR"] = np.sqrt(part["N"])
            part["CHWP_ANGLE"], part["ROTATOR"] = np.nan if plate is None else plate, rotator
            parts.append(part)
        whole = Table({k: np.concatenate([p[k] for p in parts]) for k in parts[0].colnames})
        found = apply(calibration, read(whole, tmp_path))
        return np.sqrt(np.linalg.eigvalsh(found.covariance)[:, -1]), found.flag & 16

    alone, flagged = error((None, 0.0))
    assert np.all(flagged == 16)
    assert np.all(alone > 0.01)
    for rows in (((None, 0.0), (22.5, 0.0)), ((None, 0.0), (None, 45.0))):
        together, flagged = error(*rows)
        assert np.all(flagged == 0)
        assert np.all(together < 0.2 * alone)


def test_detectors_and_rotator_of_the_model(calset, calibration, tmp_path):
    """Non-linearity that the calibration found is undone; a rotator zero turns the results."""
    context = _context(calset)
    effect = effect_by_name("nonlinearity").of(context, coefficient=0.02)
    model = with_effects(calibration.model, [effect], context)
    there = _with(calibration, model)
    counts = np.array([[1e5, 5e5, 1e6, 2e6]])
    anywhere = np.array([0.1]), np.array([0.2])
    shown = counts * (1 + 0.02 * counts / 1e6)
    np.testing.assert_allclose(linearised(there, shown, *anywhere), counts, rtol=1e-12)
    assert there.left_behind == ()
    drift = effect_by_name("camera_gain_drift").of(context)
    drifting = _with(calibration, with_effects(calibration.model, [drift], context))
    assert drifting.left_behind == ("camera_gain_drift",)
    turned = _with(
        calibration,
        with_effects(calibration.model, [effect_by_name("rotator_zero").of(context, angle=2.0)], context),
        known=0.1,
    )
    table, _ = stars(AnalysisVectors(calibration), 6, rotator=(20.0,))
    plain, moved = (apply(c, read(table, tmp_path)) for c in (calibration, turned))
    turn = np.exp(2j * np.deg2rad(2.0))
    np.testing.assert_allclose(moved.qu @ [1, 1j], plain.qu @ [1, 1j] * turn, rtol=1e-9)
    # 0.1° of doubt in the zero adds (2 p · 0.1°)² across the direction of (q, u).
    extra = np.trace(moved.calibration - plain.calibration, axis1=1, axis2=2)
    p = np.hypot(*plain.qu.T)
    np.testing.assert_allclose(extra, (2 * p * np.deg2rad(0.1)) ** 2, rtol=1e-4)  # a small difference


@pytest.mark.parametrize("flux", quick([1e5, 4e6], [4e6]))
def test_errors_of_a_detector_grow_with_the_light(calset, calibration, tmp_path, flux):
    """A coefficient of non-linearity that is uncertain by 0.001: stars are off by what such a change does to them."""
    context = _context(calset)
    effect = effect_by_name("nonlinearity").of(context, coefficient=0.02)
    there = _with(calibration, with_effects(calibration.model, [effect], context), known=1e-3)
    index = there.model.names.index("nonlinearity.coefficient.n1")
    covariance = np.zeros_like(there.covariance)
    covariance[index, index] = 1e-6
    there = dataclasses.replace(there, covariance=covariance)
    table, _ = stars(AnalysisVectors(calibration), 6, flux=flux)
    table["N"] *= 1 + 0.02 * table["N"] / 1e6  # without residuals, which move stars as weights change
    found = []
    for sign in (1, -1):
        values = there.values.copy()
        values[index] += sign * 1e-3
        found.append(apply(dataclasses.replace(there, values=values), read(table, tmp_path)).qu)
    shift = 0.5 * (found[0] - found[1])
    stated = np.sqrt(np.einsum("sii->si", apply(there, read(table, tmp_path)).calibration))
    np.testing.assert_allclose(stated, np.abs(shift), rtol=1e-3, atol=1e-9)
    assert stated.max() > 3e-4 * flux / 4e6


def test_detectors_that_differ_over_the_field_are_undone_star_by_star(calset, calibration):
    context = _context(calset)
    trails = Described.saying(["gain of E1 * root counts * y"], [-0.03])
    there = _with(calibration, with_effects(calibration.model, [trails], context))
    counts = np.random.default_rng(3).uniform(1e4, 2e6, (7, 4))
    x, y = np.random.default_rng(4).uniform(-0.25, 0.25, (2, 7))
    shown = counts.copy()
    shown[:, 1] *= 1.0 - 0.03 * np.sqrt(counts[:, 1] / 1e6) * y / 0.3
    np.testing.assert_allclose(linearised(there, shown, x, y), counts, rtol=1e-11)
    slope = 1.0 - 0.045 * np.sqrt(counts[:, 1] / 1e6) * y / 0.3
    sigma = np.ones_like(counts)
    found = errors_of(there, counts, sigma, x, y)
    np.testing.assert_allclose(found[:, 1], 1.0 / slope, rtol=1e-11)
    np.testing.assert_array_equal(found[:, [0, 2, 3]], 1.0)
    assert there.left_behind == ()


def test_photon_errors_are_those_of_linearised_counts(calset, calibration):
    """1.7·10⁶ electrons of which 5 % are not reported: noise is enlarged by 1/(1 − 0.1) when they are put back."""
    effect = effect_by_name("nonlinearity").of(_context(calset), coefficient=-0.03)
    there = _with(calibration, with_effects(calibration.model, [effect], _context(calset)))
    (seen,) = AnalysisVectors(calibration).exact(setting(), np.array([0.1]), np.array([0.05]))[:, 0]
    arriving = np.broadcast_to(8e6 * seen @ [1.0, 0.01, 0.005], (2000, 4))
    expected = arriving * (1 - 0.03 * arriving / 1e6)
    noise = np.sqrt(expected) * np.random.default_rng(9).standard_normal(expected.shape)
    place = {"X": np.full(2000, 0.1), "Y": np.full(2000, 0.05)}
    table = Table({**place, "N": expected + noise, "N_ERR": np.sqrt(expected)})
    found = apply(there, read_catalogue(in_memory(table), SOUTH))
    assert found.chi2.mean() == pytest.approx(1.0, abs=0.12)  # 1.3 with the errors of the counts as measured
    assert found.check.warnings() == ()
    scatter = np.cov(found.qu.T)
    np.testing.assert_allclose(np.diag(found.photon[0]), np.diag(scatter), rtol=4 * np.sqrt(2 / 2000))


def _context(calset):
    return effect_context(nominal_instrument(calset.instrument), calset.exposures)


def _with(calibration, model, known=0.0):
    """The calibration with a model of more parameters at their start, with an error of `known` on the new."""
    values, old = model.start, list(calibration.model.names)
    covariance = np.diag(np.full(len(values), known**2))
    where = np.array([model.names.index(name) for name in old])
    values[where] = calibration.values
    covariance[np.ix_(where, where)] = calibration.covariance
    return dataclasses.replace(calibration, model=model, values=values, covariance=covariance)


# ------------------------------------------------------------------------------------------------ catalogues


def write(tmp_path, **columns):
    table = {
        "X": [0.0, 0.1],
        "Y": [0.0, 0.1],
        "N": np.full((2, 4), 1e5),
        "N_ERR": np.full((2, 4), 300.0),
    } | columns
    Table({k: v for k, v in table.items() if v is not None}).write(tmp_path / "bad.fits")
    return read_input_table(tmp_path / "bad.fits")


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"N": None}, "bad.fits N: the column is missing; add it, or N0 … N3"),
        ({"N": np.full((2, 3), 1.0)}, "N: has shape"),
        ({"N_ERR": np.array([[1.0, 1, 1, 1], [1, 0, 1, 1]])}, "N_ERR: is not above 0 in row 1"),
        ({"ROTATOR": [0.0, np.nan], "ID": [5, 5]}, "ROTATOR: is missing in row 1"),
        ({"N_FLAG": [0.5, 0.0]}, "N_FLAG: is neither one integer"),
    ],
)
def test_bad_catalogues(tmp_path, columns, message):
    with pytest.raises(DataError, match=message.replace("(", r"\(")):
        read_catalogue(write(tmp_path, **columns), SOUTH)


def test_columns_may_go_by_the_names_of_the_cameras(tmp_path):
    counts = {"O1": 51.0, "E1": 49.0, "O2": 52.0, "E2": 48.0}
    errors = {f"{name}_ERR": 7.0 + k for k, name in enumerate(counts)}
    one = {name: [value] for name, value in {"X": 0.1, "Y": 0.0, **counts, **errors}.items()}
    Table(one).write(tmp_path / "c.csv")
    found = read_catalogue(read_input_table(tmp_path / "c.csv"), SOUTH)
    assert found.counts.tolist() == [[51.0, 49.0, 52.0, 48.0]]
    assert found.sigma.tolist() == [[7.0, 8.0, 9.0, 10.0]]


def test_stars_are_ids_in_a_filter(tmp_path):
    table = Table({"X": np.zeros(6), "Y": np.zeros(6), "ID": ["a", "b", "a", "", "a", ""]})
    for k in range(4):
        table[f"N{k}"], table[f"N{k}_ERR"] = 1e5, 300.0
    table["FILTER"] = ["SDSS-r"] * 4 + ["NB", "SDSS-r"]
    table.write(tmp_path / "c.csv")
    star = read_catalogue(read_input_table(tmp_path / "c.csv"), SOUTH).star
    assert star[0] == star[2]
    assert len(set(star.tolist())) == 5


def test_too_many_settings(calibration, calset, vectors, tmp_path):
    table, _ = stars(vectors, 300)
    table["CHWP_ANGLE"] = np.linspace(0, 90, 300)
    with pytest.raises(DataError, match="300 different optical settings"):
        apply(calibration, read(table, tmp_path))


def test_simulated_observation_of_standards(calset, calibration, tmp_path):
    """Standards of another run, noise and all: counts that the package drew, pulls of unit width."""
    instrument = simulate(WITH_PLATE, seed=SEED).truth
    run = simulate(WITH_PLATE, seed=99, instrument=instrument)
    exposures, block = run.calset.exposures, run.calset.intensities.block(0, len(run.calset.points))
    star, point = [], []
    for p in range(len(run.calset.points)):
        for e in np.flatnonzero(block.used[p] & (exposures.kind == "standard")):
            point.append(p)
            star.append(e)
    point, star = np.array(point), np.array(star)
    table = Table({"X": block.x[point], "Y": block.y[point], "N": block.counts[point, star]})
    table["N_ERR"] = block.sigma[point, star]
    table["CHWP_ANGLE"] = exposures.position("CHWP").angle[star]
    table["ROTATOR"] = exposures.rotator[star]
    source = block.source[point, star]
    table["TEFF"] = run.calset.sources.teff[source]
    found = apply(calibration, read(table, tmp_path))
    truth = np.stack([np.asarray(run.truth.standard.q), np.asarray(run.truth.standard.u)], axis=1)[source]
    chi2 = np.einsum("si,sij,sj->s", found.qu - truth, np.linalg.inv(found.covariance), found.qu - truth)
    assert chi2.mean() == pytest.approx(2.0, abs=4 * 2 / np.sqrt(len(chi2)))


@pytest.mark.parametrize(("instrument", "edge"), [("WALOP-NORTH", 0.28), ("WALOP-LAB", 20.0)])
def test_every_instrument_can_be_tabulated(calibration, instrument, edge):
    """The check of the series at points that are no nodes is passed, or it would raise."""
    model = make_model(instrument, nominal_instrument(instrument, throughput_degree=0))
    other = dataclasses.replace(
        calibration,
        model=model,
        values=model.start,
        covariance=np.zeros((len(model.start),) * 2),
        field=(-edge, edge, -edge, edge),
    )
    vectors = AnalysisVectors(other)
    assert vectors.half_width == pytest.approx(min(1.25 * edge, 45.0))
    table = vectors._vector_table(setting())
    np.testing.assert_array_equal(table.rectangle.high, vectors.half_width)


@pytest.mark.benchmark
def test_a_hundred_thousand_rows_in_seconds(calibration, vectors, tmp_path):
    """A million stars in a minute on one core are 17 000 a second; to check every shape costs some of that."""
    table, _ = stars(vectors, 50_000, plate=(None, 22.5), teff=5000.0, rotator=(0.0, 0.0))
    catalogue = read(table, tmp_path)
    small = read(table[:2], tmp_path)
    apply(calibration, small)  # compile
    began = time.process_time()
    apply(calibration, small)
    tables = time.process_time() - began
    began = time.process_time()
    apply(calibration, catalogue)
    seconds = time.process_time() - began - tables
    print(f"{len(catalogue) / seconds:.0f} rows/s, tables {tables:.1f} s")
    assert len(catalogue) / seconds > 15_000


def test_intensities_that_no_star_makes_are_flagged(vectors, calibration, tmp_path):
    """One camera with a tenth more light: CHI2 says so, and FLAG."""
    table, *_ = stars(vectors, 4)
    table["N"][1, 2] *= 1.1
    found = apply(calibration, read(table, tmp_path))
    assert (found.flag & Quality.DISAGREES > 0).tolist() == [False, True, False, False]
