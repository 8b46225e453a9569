"""What could hide in a calibration, and what its data do not measure at all, against closed forms."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
from astropy.table import Table
from scipy import optimize, stats
from small_run import SEED, SMALL, small_fit, small_fit_stating
from star_tables import SOUTH, setting

from walop_jax.calibration.analysis_vectors import AnalysisVectors
from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.certify import certify
from walop_jax.calibration.could_hide import change_by_effect, could_hide
from walop_jax.calibration.product import read_calibration, write_calibration
from walop_jax.data.records import ERROR_WORDS
from walop_jax.data.user_tables import read_input_table
from walop_jax.diagnosis.design import Design
from walop_jax.diagnosis.stated_conditions import Singles
from walop_jax.diagnosis.trust import examined
from walop_jax.diagnosis.undetected_errors import Starlight, undetected_errors
from walop_jax.fit.refit import FitResult, refit
from walop_jax.fit.verdict import Hidden
from walop_jax.science.apply import apply
from walop_jax.science.catalogue import read_catalogue
from walop_jax.science.commissioning import requirements
from walop_jax.science.field_accuracy import field_accuracy
from walop_jax.simulation.simulate import simulate

USUAL = 0.002  # width of the prior of each element of the polarisation of the telescope


@functools.cache
def polariser_alone() -> FitResult:
    """A set without Moon and standards: everything passes the polariser."""
    plan = dataclasses.replace(SMALL, moon_patches=0, standards=0)
    return examined(refit(simulate(plan, seed=SEED).calset))


@pytest.fixture
def product(tmp_path) -> Calibration:
    """Its calibration, as read from the file."""
    write_calibration(tmp_path / "calibration.fits", Calibration.from_fit(polariser_alone()))
    return read_calibration(tmp_path / "calibration.fits")


def test_a_telescope_that_nothing_measures_hides_its_usual_polarisation(product):
    """Light polarised by 0.002 more in q: q is wrong by 0.002. A sky turned by δ: 2 · 0.05 · δ for p = 5 %."""
    result = polariser_alone()
    assert result.trusted
    (remark,) = [text for text in result.warnings if "no information" in text]
    assert "telescope_polarisation.q, telescope_polarisation.u" in remark
    found = {one.name: one for one in could_hide(product)}
    for name in ("telescope_polarisation.q", "telescope_polarisation.u"):
        assert found[name].error[0] == pytest.approx(USUAL, rel=0.02)
        assert found[name].error[1] == pytest.approx(
            USUAL, rel=0.1
        )  # where u is weak the intensity counts as well
        assert not found[name].measured
    # 5.236e-4 = 2 · 0.05 · 0.3°
    assert found["rotator_zero.angle"].error == pytest.approx((5.236e-4, 5.236e-4), rel=1e-3)
    assert could_hide(product)[0].name.startswith("telescope_polarisation")
    assert not {name for name, one in found.items() if not one.measured and "telescope" not in name} - {
        "rotator_zero.angle"
    }


def test_it_is_no_go_and_not_fit_for_use(product):
    accuracy = field_accuracy(product, size=5)
    assert accuracy is not None
    assert "% behind the telescope" in dict(accuracy.facts())["p of a star"]
    fit = polariser_alone()
    missing = [one for one in requirements(fit.checked_verdict(), "", accuracy, fit.calset) if not one.met]
    told = next(one for one in missing if one.needed)
    assert "telescope_polarisation.q" in told.found
    assert "standards" in told.advice
    (failed,) = [check for check in certify(product) if not check.passed and check.name != "parents"]
    assert failed.name == "measured"
    assert "telescope_polarisation" in failed.found


def only(calibration: Calibration, name: str) -> Calibration:
    """The calibration with one of its mistakes."""
    hidden = calibration.hidden
    assert hidden is not None
    at = [mistake.name for mistake in hidden.errors].index(name)
    return dataclasses.replace(calibration, hidden=Hidden((hidden.errors[at],), hidden.changes[[at]]))


def star(tmp_path, calibration: Calibration, q: float, plate=None, rotator=None) -> tuple[float, float]:
    """Q_HIDDEN and U_HIDDEN of a star with exact counts."""
    vectors = AnalysisVectors(calibration)
    x, y = np.array([0.11]), np.array([-0.07])
    a = vectors.exact(setting(plate), x, y, [np.nan])[0, 0]
    n = 4e6 * a @ np.array([1.0, q, 0.0])
    table = Table({"ID": [1], "X": x, "Y": y, "N": [n], "N_ERR": [np.sqrt(n)], "TEFF": [np.nan]})
    table["CHWP_ANGLE"] = [np.nan if plate is None else plate]
    if rotator is not None:
        table["ROTATOR"] = [rotator]
    table.write(tmp_path / "star.fits", overwrite=True)
    stars = apply(calibration, read_catalogue(read_input_table(tmp_path / "star.fits"), SOUTH))
    return tuple(stars.hidden[0])


def test_stars_have_it(product, tmp_path):
    """q and u by 0.002 of the telescope; on the sky u of a star with q = 0.5 by 2 · 0.5 · 0.3° of the zero."""
    assert star(tmp_path, product, 0.0) == pytest.approx((USUAL, USUAL), rel=0.05)
    zero = only(product, "rotator_zero.angle")
    q, u = star(tmp_path, zero, 0.5, rotator=0.0)
    assert u == pytest.approx(5.236e-3, rel=1e-3)
    assert q == pytest.approx(0.0, abs=1e-6)
    assert star(tmp_path, zero, 0.5) == (0.0, 0.0)  # without ROTATOR there is no sky
    assert product.warnings
    assert "telescope_polarisation" in product.warnings[0]


def test_a_plate_that_was_never_in_the_beam_is_unknown_where_stars_are_seen_through_it(product, tmp_path):
    """A half-wave plate turned by δ turns polarised light by 2δ: (q, u) by 4 · 0.5 · 0.3°; out of the beam by none."""
    axis = only(product, "chwp_axis.angle")
    assert np.hypot(*star(tmp_path, axis, 0.5, plate=22.5)) == pytest.approx(0.010472, rel=0.02)
    assert star(tmp_path, axis, 0.5) == (0.0, 0.0)
    assert not any("chwp" in one.name for one in could_hide(product))


def test_what_moon_and_standards_measure_is_measured():
    design = Design.of(small_fit())
    hidden = undetected_errors(design, Singles.of(design))
    assert all(mistake.measured for mistake in hidden.errors)
    found = could_hide(dataclasses.replace(Calibration.from_fit(small_fit()), hidden=hidden))
    assert [one.error[0] for one in found] == sorted((one.error[0] for one in found), reverse=True)


def found_with_99_per_cent(tried: int) -> float:
    """Noncentrality of χ² of one degree of freedom that undercuts the p of 3 σ, of so many, in 99 of 100 cases."""
    alarm = 2.0 * stats.norm.sf(3.0)
    threshold = stats.chi2.isf(1.0 - (1.0 - alarm) ** (1.0 / tried), 1)
    return float(optimize.brentq(lambda square: stats.ncx2.sf(threshold, 1, square) - 0.99, 1.0, 200.0))


@functools.cache
def singles_of(**errors: float) -> tuple[Design, Singles]:
    """Design of the small run whose set states such errors, and its single numbers."""
    design = Design.of(small_fit_stating(**errors))
    return design, Singles.of(design)


NUMBERS = {
    "X of all field points": ("position", 1.0 / 3600.0),
    "the scale of X and Y": ("scale", 1.0),
    "scattered light in O1": ("scattered", 1.0),
    "TEFF of exposures of kind clp": ("teff", 5772.0),
}
"""Some numbers of the small set: the field of `StatedErrors`, and its unit in that of the number."""
COARSE = {"position": 3600.0, "scale": 0.5, "scattered": 0.5, "teff": 1.0}
FINE = {"position": 15.0, "scale": 0.01, "scattered": 1e-3, "teff": 0.5}


@pytest.mark.parametrize("errors", [COARSE, FINE])
def test_what_hides_is_what_the_data_do_not_show_and_is_plausible(errors):
    """h = min(w, √λ s): w the error that the set states, s the error with which its data measure the number."""
    design, singles = singles_of(**errors)
    mistakes = {one.name: one for one in undetected_errors(design, singles).errors}
    found, least = list[str](), np.sqrt(found_with_99_per_cent(len(singles.testable)))
    for item in singles.items:
        name = item.single.candidate.name
        if name in NUMBERS and name in mistakes:
            field, unit = NUMBERS[name]
            s = np.sqrt(item.score.covariance[0, 0]) / singles.noise_scale
            assert mistakes[name].size == pytest.approx(min(errors[field] * unit, least * s), rel=1e-6), name
            found.append(name if least * s < errors[field] * unit else "")
    # The data of the coarse set limit, of the fine one what it states.
    assert found.count("") == (0 if errors is COARSE else len(found))
    assert len(found) > 1


def test_positions_of_an_arcsecond_hide_no_more_than_that():
    """A fiftieth of what the data would show, and as small in q and u; the search is the same."""
    product = Calibration.from_fit(small_fit())

    def by_positions(**errors: float) -> float:
        hidden = undetected_errors(*singles_of(**errors))
        found = could_hide(dataclasses.replace(product, hidden=hidden))
        places = ("X of all", "Y of all", "the scale of", "the angle of the field")
        return max((one.error[0] for one in found if one.name.startswith(places)), default=0.0)

    assert by_positions(**COARSE) > 1e-3
    assert by_positions() < 2e-4
    scores = ({one.score.name: one.score.log_p for one in singles_of(**e)[1].items} for e in (COARSE, {}))
    assert next(scores) == next(scores)


def test_a_number_that_is_known_exactly_hides_nothing():
    exactly = dict.fromkeys(ERROR_WORDS, 0.0)
    hidden = undetected_errors(*singles_of(**exactly))
    of_data = [one.name for one in hidden.errors if one.kind == "data"]
    # Who takes coordinates of date for ICRS is wrong by the years since 2000, however well they are measured.
    assert set(of_data) <= {"the equinox of RA and DEC"}


@pytest.mark.parametrize("name", ["telescope_polarisation", "hwp1_axis", "camera_leakage", "hwp2_crossing"])
def test_what_an_effect_does_to_starlight_is_that_of_the_light_path(name):
    """From the responses, in the colour of the lamp, against the matrix of an instrument that has the effect."""
    fit = small_fit()
    design = Design.of(fit)
    of_stars = Starlight(design, Singles.of(design).asked, 0, np.arange(len(fit.calset.points)))
    (probe,) = [one for one in of_stars.asked if one.effect.name == name]
    count = len(probe.widths)
    none = np.zeros((design.projector.basis.shape[1], count))
    for one in of_stars.mistakes(probe, 0.01 * probe.widths, none, np.ones(count, bool)):
        assert one.acts
        points = fit.calset.points
        at = of_stars.setting, fit.calset.filters, points.x, points.y
        exact = change_by_effect(of_stars.instrument, one.effect, *at)
        np.testing.assert_allclose(one.change, exact, atol=0.05 * np.abs(exact).max())
