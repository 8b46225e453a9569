"""Products that are certified or not, and epochs of an instrument that has changed or not."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from astropy.io import fits
from calibration_in_words import changed as in_words
from scipy import stats
from small_run import SMALL, small_fit
from typer.testing import CliRunner

import walop_jax.science.epoch
from walop_jax.calibration.accuracy import sample_stars
from walop_jax.calibration.calibration import Calibration, Written
from walop_jax.calibration.certify import certify
from walop_jax.calibration.product import read_calibration, validity, write_calibration
from walop_jax.commands.program import app
from walop_jax.data.write import write_calibration_set
from walop_jax.fit.base_model import base_model
from walop_jax.fit.model_of_set import model_for
from walop_jax.fit.refit import fit, refit, with_empirical_covariance
from walop_jax.fit.verdict import Doubt, Quality, Structure
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects import effect_by_name
from walop_jax.model.effects.in_models import with_effects
from walop_jax.science.epoch import compared, epoch, fit_like
from walop_jax.simulation.simulate import simulate


def calibrate(calset):
    return Calibration.from_fit(refit(calset).with_verdict())


@pytest.fixture(scope="module")
def first():
    """An instrument, and what a first run has learnt of it."""
    run = simulate(SMALL, seed=5)
    calset = dataclasses.replace(run.calset, inputs=())
    return run.truth, calibrate(calset)


@pytest.fixture(scope="module")
def product(first, tmp_path_factory):
    from walop_jax.data.calset import read_calibration_set

    path = tmp_path_factory.mktemp("sets") / "first.fits"
    write_calibration_set(path, simulate(SMALL, seed=5).calset)
    return calibrate(read_calibration_set(path))


def failed(product):
    return [check.name for check in certify(product) if not check.passed]


def test_a_good_product_is_valid(product):
    checks = certify(product)
    assert [check.name for check in checks] == [
        "converged", "explains the data", "conditioned", "covariance", "validity", "parents", "model", "maps",
        "physics", "protection",
    ]  # fmt: skip
    assert failed(product) == []
    known = validity(product)
    assert known.filters == ("SDSS-r",)
    assert known.mjd[0] == np.nanmin(product.exposures.mjd)


def test_what_is_wrong_is_named(product, tmp_path):
    def changed(**more):
        return dataclasses.replace(product, **more)

    def verdict(**more):
        return changed(verdict=dataclasses.replace(product.verdict, **more))

    assert failed(verdict(converged=False)) == ["converged"]
    assert failed(verdict(doubts=(Doubt(Quality.UNEXPLAINED, ""),))) == ["explains the data"]
    assert failed(verdict(doubts=(Doubt(Quality.ILL_CONDITIONED, "", blocking=False),))) == ["conditioned"]
    broken = product.covariance.copy()
    broken[0, 1] += 3 * np.sqrt(broken[0, 0] * broken[1, 1]) + 1e-6
    assert "covariance" in failed(changed(covariance=broken))
    exposures = dataclasses.replace(product.exposures, mjd=np.full(len(product.exposures), np.nan))
    assert "validity" in failed(changed(exposures=exposures))
    assert failed(changed(inputs=())) == ["parents"]
    maps = dataclasses.replace(product.maps, values=product.maps.values + 1e-5)
    written = Written(maps, product.model_lines, product.description)
    assert failed(changed(written=written)) == ["maps"]
    unknown = in_words(product, model_lines=("[model]", 'effects = ["no_such"]'))
    write_calibration(tmp_path / "unknown.fits", unknown)
    held = read_calibration(tmp_path / "unknown.fits", any_model=True)
    assert failed(held) == ["model"]
    assert "no_such" in str(held.unavailable)
    values = product.values.copy()
    values[product.names.index("half1.efficiency")] = 1.2  # analyses more light than there is
    assert "physics" in failed(changed(values=values))


def test_validity_stands_in_the_header(product, tmp_path):
    write_calibration(tmp_path / "p.fits", product)
    header = fits.getheader(tmp_path / "p.fits")
    known = validity(product)
    assert (header["MJD-BEG"], header["MJD-END"]) == pytest.approx(known.mjd)
    assert (header["TEMPMIN"], header["TEMPMAX"]) == pytest.approx(known.temperature)
    assert header["FILTER1"] == "SDSS-r"


def test_a_calibration_is_checked_from_the_command_line(product, tmp_path):
    write_calibration(tmp_path / "good.fits", product)
    result = CliRunner().invoke(app, ["check", str(tmp_path / "good.fits"), "--json"])
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout)
    assert told["go"] is True
    assert told["product"] == product.content_hash()
    assert told["commissioning"]["valid"] is True
    assert told["commissioning"]["content"] == product.content_hash()
    assert told["commissioning"]["parents"] == [product.inputs[0].sha256]
    bad = dataclasses.replace(
        product, verdict=dataclasses.replace(product.verdict, doubts=(Doubt(Quality.DOUBTED, "odd"),))
    )
    write_calibration(tmp_path / "bad.fits", bad)
    result = CliRunner().invoke(app, ["check", str(tmp_path / "bad.fits")])
    assert result.exit_code == 3
    assert result.stdout.startswith(f"{tmp_path / 'bad.fits'}: no go: odd; walop-jax diagnose")
    assert "FAILED  explains the data" in result.stdout
    assert "Next" not in result.stderr


# ------------------------------------------------------------------------------------------------- epochs


def test_departure_by_hand():
    """3-4-5: Δ = (3, 4) with unit errors, and a third parameter that nobody measured."""
    change, covariance = np.array([3.0, 4.0, 0.0]), np.diag([1.0, 1.0, 0.0])
    chi2, directions, _ = compared("abc", change, covariance, np.array([1.0, 1.0, 1.0]), "abc")
    assert (chi2, directions) == (pytest.approx(25.0), 2)


def test_an_instrument_that_has_not_changed_still_fits(first):
    """Over six later runs of the same instrument T follows its χ², and no run is called a change."""
    truth, old = first
    found = [
        epoch(old, fit_like(old, simulate(SMALL, seed=100 + k, instrument=truth).calset).with_verdict())
        for k in range(6)
    ]
    assert all(entry.fits for entry in found)
    for entry in found:  # the smaller of two p-values, as the smallest of two
        smaller = min(stats.chi2.sf(entry.test, entry.directions), entry.largest.p_value)
        assert entry.p_value == pytest.approx(1.0 - (1.0 - smaller) ** 2)
        assert entry.p_value < 1.0
    k = found[0].directions
    # The old calibration is one and the same: half of the variance of T is common to the six.
    assert np.mean([entry.test for entry in found]) == pytest.approx(
        k, abs=4 * np.sqrt(2 * k * (1 / 6 + 0.5))
    )
    assert np.mean([entry.chi2_old - entry.chi2_new for entry in found]) > 0
    assert all(entry.star_errors["q"]["median"] < 0.05 for entry in found)


def test_a_change_is_found_and_named(first):
    """A wedge that has yielded by half a milliradian."""
    truth, old = first
    bent = truth.changed("half2.wedge", angle=lambda angle: angle + 5e-4)
    found = epoch(old, fit_like(old, simulate(SMALL, seed=200, instrument=bent).calset).with_verdict())
    assert not found.fits
    assert found.moved[0].name == "half2.wedge"
    assert found.moved[0].new - found.moved[0].old == pytest.approx(5e-4, abs=4 * found.moved[0].error)
    assert found.chi2_old > found.chi2_new + 100
    assert found.star_errors["u"]["max"] > 0.05


def test_a_camera_that_has_become_fainter_is_found_with_its_size(first):
    truth, old = first
    throughput = truth.throughput
    fainter = throughput.coefficients.at[1, 0].add(-0.01)
    dim = dataclasses.replace(truth, throughput=dataclasses.replace(throughput, coefficients=fainter))
    found = epoch(old, fit_like(old, simulate(SMALL, seed=210, instrument=dim).calset).with_verdict())
    assert found.fits is False
    moved = {entry.name: entry for entry in found.moved}["throughput.n1.p00"]
    assert moved.new - moved.old == pytest.approx(-0.01, abs=4 * moved.error)


def test_a_plate_that_has_turned_is_a_change_and_not_errors_that_became_large(first):
    """The old model lacks an axis: its fit of the new data is nothing to compare with, that of a larger one is."""
    truth, old = first
    turned = effect_by_name("hwp1_axis").of(SMALL.context(), angle=0.05)
    calset = simulate(SMALL, seed=220, instrument=truth, effects=[turned]).calset
    unlike = fit_like(old, calset).with_verdict()
    assert not unlike.trusted
    found = epoch(old, unlike)
    assert found.fits is None
    assert not found.holds
    document = found.document()
    numbers = ("p_value", "test", "largest", "visible", "chi2_old", "chi2_new", "star_errors")
    assert [document[name] for name in numbers] == [None] * len(numbers)
    assert document["moved"] == ()
    assert document["verdict"] == "The new data are not explained"
    assert document["verdict"] in found.display().text()
    assert len(found.to_table()) == 0

    larger = with_effects(unlike.model, [turned], SMALL.context())
    found = epoch(old, with_empirical_covariance(fit(Likelihood.of(calset, larger))).with_verdict())
    assert found.fits is False
    assert found.added == ("hwp1_axis",)
    assert found.largest.name == "hwp1_axis.angle"
    assert found.largest.unit == "deg"
    assert found.largest.size == pytest.approx(0.05, abs=4 * found.largest.error)
    assert found.largest.z == pytest.approx(found.largest.size / found.largest.error)
    assert found.chi2_old > found.chi2_new + 100
    assert "HAS CHANGED" in found.display().text()
    assert "hwp1_axis.angle by 0.0" in found.display().text()


def test_one_number_that_has_changed_by_five_standard_errors_is_not_hidden_by_all_others(first):
    """The parameter that hangs together least with others: of some seventy directions the sum does not see it."""
    truth, old = first
    result = fit_like(old, simulate(SMALL, seed=5, instrument=truth).calset).with_verdict()
    same = Calibration.from_fit(result)
    quiet = epoch(same, result)
    assert quiet.fits
    assert quiet.p_value == 1.0
    # Well measured: known three times better than before, or not known at all before.
    prior = {p.name: (p.prior or (0.0, np.inf))[1] for p in result.model.parameters}
    moved = [entry for entry in quiet.moved if result.value(entry.name)[1] < prior[entry.name] / 3.0]
    names = [entry.name for entry in moved]
    i = np.array([result.model.index(name) for name in names])
    correlation = result.covariance[np.ix_(i, i)] / np.outer(result.sigma[i], result.sigma[i])
    lone = int(np.argmin(np.abs(correlation - np.eye(len(i))).max(axis=0)))
    values = same.values.copy()
    values[i[lone]] -= 5.5 * moved[lone].error
    found = epoch(dataclasses.replace(same, values=values), result)
    assert stats.chi2.sf(found.test, found.directions) > 0.01
    assert not found.fits
    assert found.largest.name == names[lone]
    assert found.largest.z == pytest.approx(5.5, rel=0.2)
    # What could have been missed: five standard errors of the change, √2 times those of one fit at most.
    x, y = np.meshgrid(*(np.linspace(*same.field[k : k + 2], 4) for k in (0, 2)))
    _, covariance = same.matrix(x.ravel(), y.ravel())
    error = 100 * np.median(np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)), axis=0)
    for seen, of_one in zip(found.visible.values(), error, strict=True):
        assert 3.0 * of_one < seen <= 5.0 * np.sqrt(2.0) * of_one * (1.0 + 1e-6)


def test_errors_of_a_catalogue_that_both_fits_take_are_no_change():
    """Standards alone fix the polarisation of the telescope: noise is in the change, errors of their catalogue are not.

    The estimate is C Jᵀ(data) + C P(priors), so that data alone scatter it by C JᵀJ C with JᵀJ = C⁻¹ − P.
    """
    effect = effect_by_name("telescope_polarisation")
    calset = simulate(SMALL, seed=5, effects=[effect.of(SMALL.context(), q=0.004, u=-0.002)]).calset
    table, width = calset.intensities, np.full(len(calset.sources.q), 1e-3)
    moon = (calset.exposures.kind == "moon")[table.exposure]
    dim = dataclasses.replace(table, sigma=np.where(moon[:, None], 1e3 * table.sigma, table.sigma))
    stars = dataclasses.replace(calset.sources, q_err=width, u_err=width)
    calset = dataclasses.replace(calset, intensities=dim, sources=stars, inputs=())
    model = with_effects(base_model(calset), [effect.neutral(SMALL.context())], SMALL.context())
    result = refit(calset, model).with_verdict()
    found = epoch(Calibration.from_fit(result), result)
    c = result.covariance[np.ix_(model.free, model.free)]
    prior = np.array([(model.parameters[i].prior or (0.0, np.inf))[1] ** -2.0 for i in model.free])
    size = np.sqrt(np.diag(c))  # numbers of parameters differ by orders of magnitude
    data = np.linalg.inv(c / np.outer(size, size)) / np.outer(size, size) - np.diag(prior)
    # Rounding may leave less than nothing for a parameter that its prior alone determines.
    noise = np.sqrt(2.0 * np.clip(np.diag(c @ data @ c), 0.0, None))
    moved = {entry.name: entry.error for entry in found.moved}
    for axis in "qu":
        name = f"telescope_polarisation.{axis}"
        at = list(model.free).index(model.index(name))
        assert moved[name] == pytest.approx(noise[at], rel=0.01)
        assert moved[name] < 0.7 * np.sqrt(2.0) * size[at]
    # The parameters are compared, which the structure of field points leaves as certain as they are.
    verdict = dataclasses.replace(result.checked_verdict(), structure=Structure(gain=2e-3))
    structured = dataclasses.replace(result, verdict=verdict)
    assert epoch(Calibration.from_fit(structured), structured).visible == pytest.approx(found.visible)


def test_stars_turn_with_the_zero_of_the_rotator():
    """An old zero that is 1° off turns (q, u) by 2°, and changes no p."""
    result = small_fit()
    new = Calibration.from_fit(result)
    model = with_effects(
        new.model, [effect_by_name("rotator_zero").of(SMALL.context(), angle=1.0)], SMALL.context()
    )
    at, values = [model.index(name) for name in new.model.names], model.start.copy()
    values[at], covariance = new.values, np.zeros(2 * (len(values),))
    covariance[np.ix_(at, at)] = new.covariance
    old = dataclasses.replace(new, model=model, values=values, covariance=covariance)
    errors = epoch(old, result).star_errors
    degree = np.hypot(*sample_stars().T)
    both = np.hypot(errors["q"]["rms"], errors["u"]["rms"])
    assert both == pytest.approx(
        100.0 * 2.0 * np.sin(np.deg2rad(1.0)) * np.sqrt(np.mean(degree**2)), rel=1e-6
    )
    assert errors["p"]["max"] < 1e-6


def test_of_many_changes_the_largest_is_held_to_their_number():
    """By hand: of three independent changes 3 standard errors have p = 0.0027, and six are asked for."""
    unit = np.eye(3)
    found = compared("abc", np.array([0.5, -3.0, 1.0]), unit, np.ones(3), "abc")[2]
    assert (found.name, found.asked) == ("b", 6)
    assert found.z == pytest.approx(-3.0)
    assert found.p_value == pytest.approx(1.0 - (1.0 - 0.0026998) ** 6, rel=1e-3)
    # Of two that hang together by 0.8 the one that has changed alone stands out further than it does by itself.
    pair = np.array([[1.0, 0.8], [0.8, 1.0]])
    alone = compared("ab", np.array([3.0, 0.0]), pair, np.ones(2), "ab")[2]
    assert (alone.name, alone.alone) == ("a", True)
    assert alone.z == pytest.approx(3.0 / 0.6)


def test_the_new_set_is_fitted_with_the_old_model(first, monkeypatch):
    """Not with its effects alone: plates, degree, choices, priors and what was held are the old model's."""
    truth, old = first
    text = """
    [model]
    plates = "fixed_axis"
    throughput_degree = 1
    effects = ["blemish"]
    [effects.blemish]
    camera = 2
    [parameters."half1.wedge"]
    free = false
    [parameters."blemish.depth"]
    prior = [0.0, 0.001]
    """
    earlier = dataclasses.replace(SMALL, grid=4, moon_patches=0)
    model = model_for(simulate(earlier, seed=5).calset, text)
    size = len(model.names)
    assumed = dataclasses.replace(old, model=model, values=model.start, covariance=1e-12 * np.eye(size))
    asked: list[Likelihood] = []

    def fitted(likelihood, start):
        asked.append(likelihood)
        raise RuntimeError("enough")

    monkeypatch.setattr(walop_jax.science.epoch, "fit", fitted)
    with pytest.raises(RuntimeError, match="enough"):
        fit_like(assumed, simulate(earlier, seed=6, instrument=truth).calset)
    (new,) = asked
    assert new.model.template.plates == "fixed_axis"
    assert new.model.template.throughput.degree == 1
    assert new.model.template.effect("blemish").camera == 2
    assert not new.model["half1.wedge"].free
    assert new.model["blemish.depth"].prior == (0.0, 0.001)
    assert new.model.names == model.names


def test_another_instrument_is_refused(first):
    calset = simulate(dataclasses.replace(SMALL, instrument="WALOP-NORTH")).calset
    with pytest.raises(ValueError, match="of WALOP-NORTH, the calibration of WALOP-SOUTH"):
        fit_like(first[1], calset)
