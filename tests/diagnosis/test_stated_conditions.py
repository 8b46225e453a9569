"""Numbers that a set states wrongly are found in its residuals, with their size; what is not found has a limit."""

from __future__ import annotations

import dataclasses
import itertools
import re

import jax
import numpy as np
import pytest
from changed_sets import block_of, with_block
from quick import quick
from scipy import stats
from small_run import SEED, SMALL, small_fit, small_fit_stating, small_fit_with_plate

from walop_jax.calibration.accuracy import change_of_qu
from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.could_hide import hidden_errors
from walop_jax.calibration.matrix import first_setting, matrix_slopes
from walop_jax.data.records import CalibrationSet
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.diagnosis import stated_conditions as conditions
from walop_jax.diagnosis import thresholds
from walop_jax.diagnosis.design import Design
from walop_jax.diagnosis.detection_limits import condition_limits
from walop_jax.diagnosis.readings import with_places
from walop_jax.diagnosis.remainder import instead_of_names, rival_conditions
from walop_jax.diagnosis.stated_conditions import Singles, condition_scores, stated_conditions
from walop_jax.diagnosis.trust import examined
from walop_jax.diagnosis.undetected_errors import undetected_errors
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import FitResult, fit, refit
from walop_jax.fit.verdict import Hidden
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects import Described
from walop_jax.model.effects.in_models import with_effects
from walop_jax.model.instrument import nominal_instrument
from walop_jax.model.planning import plan_for
from walop_jax.simulation.simulate import effect_from_text, simulate


def told_of(result: FitResult, start: str = "the residuals ask for ") -> str:
    """The one doubt that begins so, of a fit that is not trusted."""
    assert not result.trusted
    (told,) = [text for text in result.verdict.residual_doubts if text.startswith(start)]
    return told


def number(told: str, what: str) -> tuple[float, float]:
    """The number behind some words, and its error."""
    value, error = re.search(what + r" ?([−\d.]+) ± ([\d.]+)", told).groups()  # type: ignore[union-attr]
    return float(value.replace("−", "-")), float(error)


def moved(calset: CalibrationSet, x: np.ndarray, y: np.ndarray) -> CalibrationSet:
    return with_places(lambda *_: (x, y))(calset)


def displaced(calset: CalibrationSet) -> CalibrationSet:
    return moved(calset, calset.points.x + 0.02, calset.points.y)


def turned(calset: CalibrationSet) -> CalibrationSet:
    x, y = calset.points.x, calset.points.y
    return moved(calset, x - 0.002 * y, y + 0.002 * x)


def shifted(calset: CalibrationSet) -> CalibrationSet:
    curves = {
        name: dataclasses.replace(c, wavelength=c.wavelength + 0.004) for name, c in calset.filters.items()
    }
    return dataclasses.replace(calset, filters=curves)


def cooler(calset: CalibrationSet) -> CalibrationSet:
    e = calset.exposures
    teff = np.where(e.kind == "clp", 2800.0, e.teff)
    return dataclasses.replace(calset, exposures=dataclasses.replace(e, teff=teff))


def of_date(calset: CalibrationSet, years: float = 80.0) -> CalibrationSet:
    """RA and DEC of the sky as a telescope displays them in 2080: apparent, not ICRS (precession by Meeus, ch. 21)."""
    e = calset.exposures
    ra, dec, moon = np.deg2rad(e.ra), np.deg2rad(e.dec), e.kind == "moon"
    m, n = 46.124 * years / 3600.0, 20.043 * years / 3600.0
    later = {
        "ra": np.where(moon, e.ra + m + n * np.sin(ra) * np.tan(dec), e.ra),
        "dec": np.where(moon, e.dec + n * np.cos(ra), e.dec),
    }
    return dataclasses.replace(calset, exposures=dataclasses.replace(e, **later))


def not_linear(calset: CalibrationSet) -> CalibrationSet:
    """The second camera answers with 0.4 % less at 10⁶ electrons."""
    counts = block_of(calset).counts.copy()
    counts[..., 1] *= 1.0 - 4e-3 * counts[..., 1] / 1e6
    return with_block(calset, counts=counts)


@pytest.mark.parametrize(
    ("change", "what", "size"),
    [
        (of_date, "the equinox of RA and DEC", 2080.0),
        (not_linear, "a non-linearity of E1 of", -4e-3),
        (displaced, "ask for X of all field points changed by", -0.02),
        (turned, "ask for the angle of the field changed by", -0.002),
        # The effect that does the same is told first, and with the same number.
        pytest.param(shifted, "ask for filter_shift, wavelength", -0.004, marks=pytest.mark.long),
        pytest.param(
            shifted, "um; or for the wavelengths of filter SDSS-r changed by", -0.004, marks=pytest.mark.long
        ),
        pytest.param(cooler, "ask for TEFF of exposures of kind clp", 5772.0, marks=pytest.mark.long),
    ],
)
def test_a_number_that_is_wrong_is_told_with_its_size(change, what, size):
    """Beside others that do nearly the same."""
    told = told_of(
        examined(refit(change(simulate(SMALL, seed=SEED).calset)), as_written=change in (of_date, not_linear))
    )
    value, error = number(told, re.escape(what))
    # A step of a quarter is not a linear one; an equinox has terms beyond the first, in years.
    beyond = {of_date: 2.0, not_linear: 0.0}.get(change, 0.25 * abs(size))
    assert value == pytest.approx(size, rel=0, abs=4 * error + beyond)


def under_sky(calset: CalibrationSet, left: float) -> CalibrationSet:
    """Faint standards: under a sky of one to six times their light, polarised by 10 %, of which a share is left."""
    table, e, rng = calset.intensities, calset.exposures, np.random.default_rng(1)
    level, angle = rng.uniform(1.0, 6.0, len(e)), rng.uniform(0.0, 2.0 * np.pi, len(e))
    pattern = 1 + 0.1 * np.stack([np.cos(angle), -np.cos(angle), np.sin(angle), -np.sin(angle)], axis=1)
    of_sky = np.where(e.direct("standard"), level, 0.0)[:, None] * pattern
    sky = of_sky[table.exposure] * table.counts.mean(axis=1, keepdims=True)
    table = dataclasses.replace(table, counts=table.counts + left * sky, sky=sky)
    return dataclasses.replace(calset, intensities=table)


def test_a_share_of_the_sky_that_is_left_is_told_with_its_size():
    plain = simulate(SMALL, seed=SEED).calset
    told = told_of(examined(refit(under_sky(plain, 0.01))), "the residuals ask for the light of the sky")
    assert "(subtract the sky anew" in told
    value, error = number(told, "in units of SKY,")
    assert value == pytest.approx(0.01, abs=4 * error)
    assert error < 0.001
    sound = refit(under_sky(plain, 0.0))
    (score,) = [
        one.score for one in condition_scores(Design.of(sound)).items if "light of the sky" in one.stated.what
    ]
    assert abs(score.amplitudes[0]) < 3 * np.sqrt(score.covariance[0, 0])
    assert examined(sound).trusted


def test_a_sky_that_was_made_of_the_counts_is_told_as_that_and_asks_for_nothing():
    """A tenth of N holds the noise of N: the residuals vanish, and all numbers have errors 1000 times too small."""
    fitted = refit(simulate(SMALL, seed=SEED).calset)
    table = fitted.calset.intensities
    assert isinstance(table, TableIntensities)
    calset = dataclasses.replace(
        fitted.calset, intensities=dataclasses.replace(table, sky=table.counts / 10.0)
    )
    copied = fit(Likelihood.of(calset, fitted.model), start=fitted.values)
    singles = Singles.of(Design.of(copied))
    assert [name for name in singles.of_noise if "light of the sky" in name] == list(singles.of_noise)
    assert len(singles.of_noise) == 1
    assert list(stated_conditions(Design.of(copied), singles)) == []
    assert singles.noise_scale > 0.8


@pytest.mark.long
def test_sky_left_over_in_twenty_sets_and_in_no_sound_one():
    """1 % of the level in each, told ahead of all else with its size."""
    pulls = []
    for seed in range(100, 120):
        plain = simulate(SMALL, seed=seed).calset
        assert examined(refit(under_sky(plain, 0.0))).trusted
        first = examined(refit(under_sky(plain, 0.01))).verdict.residual_doubts[0]
        value, error = number(first, "residuals ask for .* units of SKY,")
        pulls.append((value - 0.01) / error)
    assert 0.7 < np.sqrt(np.mean(np.square(pulls))) < 1.4


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("hwp1_axis=0.01", "hwp1_axis, angle "),
        ("camera_gain_drift=camera:2,rate:0.0016", "camera_gain_drift, camera O2, rate "),
        ("nonlinearity=0/-0.0012/0/0", "a non-linearity of E1 of "),
    ],
)
def test_an_effect_of_seven_standard_errors_is_told_whatever_patterns_say(text, told):
    """Δχ² of 40 to 50 in one number: told with its size, to 4 standard errors, alone or beside what it is like."""
    effect = effect_from_text(text, SMALL.context())
    said = told_of(examined(refit(simulate(SMALL, seed=7, effects=(effect,)).calset)))
    value, error = number(said, told)
    assert value == pytest.approx(float(re.findall(r"-?\d+\.\d+", text)[0]), abs=4 * error)


@pytest.mark.long
def test_both_crystals_of_a_plate_are_told_by_what_was_known_of_them():
    """Priors that are 6 µm off in all four plates: told as thicknesses, not as a filter or a colour."""
    right = small_fit_with_plate()
    wrong = right.model
    for name in ("half1.plate.quartz", "half1.plate.mgf2", "half2.plate.quartz", "half2.plate.mgf2"):
        mean, width = right.model[name].prior
        wrong = wrong.change(name, prior=(mean - 6.0, width))
    told = told_of(examined(refit(right.calset, wrong)))
    assert told.startswith("the residuals ask for half2.plate.quartz ")
    for crystal, mean in (("quartz", 2401), ("mgf2", 1924)):
        assert f" um, not {mean} ± 1" in told
        value, error = number(told, f"half2.plate.{crystal}")
        assert value == pytest.approx(right.value(f"half2.plate.{crystal}")[0], abs=4.0 * error)
        assert value > mean + 3.0


def test_a_name_that_explains_no_more_than_a_stated_number_is_told_beside_it():
    """Patches of the Moon fitted one by one explain what coordinates of date do: sixteen numbers for one mistake."""
    calset = of_date(simulate(SMALL, seed=SEED).calset, 16.0)
    patches = effect_from_text("moon_patch=q:0/0/0,u:0/0/0", SMALL.context())
    wrong = refit(calset)
    named = refit(calset, with_effects(wrong.model, (patches,), SMALL.context()))
    (told,) = rival_conditions(Design.of(wrong), condition_scores(Design.of(wrong)), named.chi2)
    assert "one number that the set states would, if it were " in told
    assert "the equinox of RA and DEC 20" in told


def test_far_from_the_data_a_stated_number_is_held_against_errors_as_given():
    """A camera of 12 % more light on the Moon: χ²/dof of 470, which no latitude or DEC explains."""
    text = "gain of O1 * kind moon"
    calset = simulate(SMALL, seed=3, effects=[Described.saying([text], [0.12])]).calset
    base = base_model(calset)
    wrong = fit(Likelihood.of(calset, base))
    model = with_effects(base, [Described.saying([text], [0.12])], SMALL.context())
    named = fit(Likelihood.of(calset, model))
    assert wrong.noise_scale > 10.0
    design = Design.of(wrong)
    assert list(rival_conditions(design, condition_scores(design), named.chi2)) == []


def an_hour_late(calset: CalibrationSet) -> CalibrationSet:
    """Local time of a zone one hour east, in the exposures of the sky."""
    e = calset.exposures
    mjd = np.where(e.kind == "moon", e.mjd + 1.0 / 24.0, e.mjd)
    return dataclasses.replace(calset, exposures=dataclasses.replace(e, mjd=mjd))


@pytest.mark.parametrize(
    ("change", "what", "size"),
    [
        (an_hour_late, r"MJD of sky exposures changed by (\S+)", -1.0 / 24.0),
        (of_date, r"the equinox of RA and DEC (\S+)", 2080.0),
    ],
)
def test_one_number_explains_data_in_which_no_name_was_found(change, what, size):
    calset = change(simulate(SMALL, seed=SEED).calset)
    wrong = refit(calset)
    text, explained = instead_of_names(condition_scores(Design.of(wrong)), wrong, wrong)
    found = re.search(what, text)
    assert found, text
    assert explained  # it is what happened: nothing but noise is left
    assert float(found[1].replace("−", "-")) == pytest.approx(size, rel=0.1)


def test_where_no_number_explains_the_data_none_is_told():
    wrong = refit(
        simulate(SMALL, seed=5, effects=[effect_from_text("camera_leakage=0.02", SMALL.context())]).calset
    )
    assert not wrong.explains_data
    assert instead_of_names(condition_scores(Design.of(wrong)), wrong, wrong) == ("", False)


def test_a_number_that_would_be_impossible_is_no_rival():
    """An encoder's wobble of 0.3°: Newton's steps in the latitude of the site end beyond the pole."""
    wobble = effect_from_text("clp_wobble=amplitude:0.3,phase:1.0", SMALL.context())
    wrong = refit(simulate(SMALL, seed=SEED, effects=[wobble]).calset)
    neutral = wobble.kind.neutral(SMALL.context())
    right = refit(wrong.calset, with_effects(wrong.model, [neutral], SMALL.context()))
    assert instead_of_names(condition_scores(Design.of(wrong)), wrong, right) == ("", False)


def test_a_name_that_explains_a_fit_far_off_is_kept(monkeypatch):
    """Wollaston prisms turned by 0.3°: χ² in multiplied errors is not compared with χ² in those that are stated."""
    turn = effect_from_text("wollaston_axis=0.3", SMALL.context())
    calset = simulate(SMALL, seed=SEED, effects=[turn]).calset
    wrong = refit(calset)
    named = refit(calset, with_effects(wrong.model, [turn.kind.neutral(SMALL.context())], SMALL.context()))
    assert wrong.noise_scale > 2.0
    assert named.noise_scale == 1.0
    monkeypatch.setattr(thresholds, "ALARM", np.inf)
    assert instead_of_names(condition_scores(Design.of(wrong)), wrong, named) == ("", False)


def test_scale_and_angle_are_sums_of_both_coordinates():
    """As differences of two sets that are scaled and turned."""
    design = Design.of(small_fit())
    asked = [one for one in conditions.stated_numbers(small_fit().calset) if one.along is not None]
    assert [one.unit for one in asked] == ["deg", "deg", "", "rad"]
    for one, column in zip(asked, conditions._columns(design, asked), strict=True):
        exact = conditions._column(design, one)
        np.testing.assert_allclose(column, exact, rtol=0, atol=1e-5 * np.abs(exact).max())


def test_the_score_is_what_a_fit_gains_that_knows_better():
    """χ² of the set with X corrected, fitted, is smaller by the score, to the order of the step squared."""
    calset = simulate(SMALL, seed=SEED).calset
    wrong, right = refit(displaced(calset)), refit(calset)
    scored = condition_scores(Design.of(wrong))
    score = next(item.score for item in scored.items if item.stated.what.startswith("X of all field points"))
    away = float(score.amplitudes[0]) - -0.02
    expected = score.statistic - away**2 / score.covariance[0, 0]
    assert wrong.chi2 - right.chi2 == pytest.approx(expected, rel=0.1)


def test_a_number_that_explains_little_of_a_fit_far_off_is_not_told():
    """Gains of 3 % by exposure and camera: errors are multiplied to fit at all, and single numbers borrow a part."""
    calset = simulate(SMALL, seed=SEED).calset
    counts = block_of(calset).counts
    gain = 1.0 + 0.03 * np.random.default_rng(1).standard_normal(counts.shape[1:])
    result = refit(with_block(calset, counts=counts * gain))
    assert result.noise_scale > 2.0
    design = Design.of(result)
    scores = Singles.of(design).testable
    assert min(item.score.log_p for item in scores) < -20.0
    assert not list(stated_conditions(design))


def test_what_could_hide_is_ranked_by_what_it_does_to_stars():
    """In the order of the protection level over the field, each by itself, not of how far parameters move."""
    design = Design.of(small_fit())
    hidden = undetected_errors(design, Singles.of(design))
    calibration = Calibration.from_fit(small_fit())
    x, y = small_fit().calset.points.x, small_fit().calset.points.y
    seen = []
    for number in range(len(hidden)):
        one = Hidden(*(getattr(hidden, f.name)[number : number + 1] for f in dataclasses.fields(Hidden)))
        hiding = dataclasses.replace(calibration, hidden=one)
        seen.append(np.nanmedian(hidden_errors(hiding, x, y, hiding.usual_settings())[0]))
    assert len(seen) > 3
    assert all(after <= 1.3 * before for before, after in itertools.pairwise(seen))  # 0: out of the beam


@pytest.mark.parametrize("seed", quick(range(50, 55), [50]))
def test_noise_asks_for_no_other_conditions(seed):
    """Of five sound sets none; 0.27 % are expected."""
    assert not list(stated_conditions(Design.of(refit(simulate(SMALL, seed=seed).calset))))


def test_at_its_limit_a_number_is_found_as_often_as_promised():
    """Noise drawn into the fitted model, with the number wrong by its limit: 99 of 100 are found, at half of it few."""
    design = Design.of(small_fit())
    singles = Singles.of(design)
    limits = {one.what: one for one in condition_limits(design, singles)}
    rng = np.random.default_rng(5)
    rows = design.rows
    noise = np.zeros((len(design.residual), 1500))
    noise[:rows] = rng.standard_normal((rows, noise.shape[1]))
    checked = 0
    # The verdict corrects for all single numbers: priors, terms of cameras and effects as well.
    tried = len(singles.testable)
    least = 1.0 - (1.0 - 0.0027) ** (1.0 / tried)
    for item in singles.items:
        if item.single.stated is None or not item.score.testable:
            continue
        limit = limits[item.stated.what]
        left = design.projector(item.single.candidate.columns[:, 0])
        along = left @ design.projector(noise) / np.linalg.norm(left)
        for share, expected in ((1.0, thresholds.PROBABILITY), (0.5, 0.5)):
            size = share * limit.detected * np.linalg.norm(left)
            found = np.mean((along + size) ** 2 > stats.chi2.isf(least, 1))
            if share == 1.0:
                assert found == pytest.approx(expected, abs=0.012)
            else:
                assert found < expected
        checked += 1
    assert checked >= 5


def test_a_limit_beyond_what_is_plausible_is_told_beside_the_error_of_the_plausible():
    """The limit is that of the data; q and u are off by no more than the error that the set states makes."""
    limits = {}
    for position in (1.0, 2.0, 3600.0):
        design = Design.of(small_fit_stating(position=position))
        found = condition_limits(design, Singles.of(design))
        limits[position] = next(one for one in found if one.what.startswith("X of all"))
    assert limits[1.0].detected == limits[2.0].detected == limits[3600.0].detected == limits[3600.0].size
    assert (limits[1.0].size, limits[2.0].size) == pytest.approx((1 / 3600, 2 / 3600))
    twice = 2.0 * limits[1.0].error_of_qu[0]  # so small a mistake is linear
    assert limits[2.0].error_of_qu[0] == pytest.approx(twice, rel=0.01)


def test_the_error_at_the_limit_is_that_of_a_fit_that_is_misled():
    """q and u off by as much as the matrix of a fit to noiseless counts with X wrong by its limit, to a fifth."""
    right = small_fit()
    calset = right.calset
    design = Design.of(small_fit_stating(position=3600.0))
    limits = condition_limits(design, Singles.of(design))
    limit = next(one for one in limits if one.what.startswith("Y of all"))
    misled = refit(moved(calset, calset.points.x, calset.points.y + limit.detected), right.model)

    def matrix(result: FitResult) -> np.ndarray:
        instrument = result.model.instrument(result.values)
        setting = first_setting(calset, instrument)
        return matrix_slopes(instrument, setting, calset.filters, calset.points.x, calset.points.y)[0]

    error = change_of_qu(matrix(misled), matrix(right))
    assert np.nanmax(error) == pytest.approx(limit.error_of_qu[1], rel=0.2)


def test_a_set_with_another_colour_has_a_plan_of_the_same_shape():
    """So its residuals need no program of their own."""
    calset = simulate(SMALL, seed=SEED).calset
    instrument = nominal_instrument(calset.instrument)
    shapes = []
    for kind in ("", *np.unique(calset.exposures.kind)):
        teff = np.where(calset.exposures.kind == kind, 4000.0, calset.exposures.teff)
        exposures = dataclasses.replace(calset.exposures, teff=teff)
        plan = plan_for(instrument, exposures, calset.filters, calset.sources)
        shapes.append((jax.tree.structure(plan), [np.shape(leaf) for leaf in jax.tree.leaves(plan)]))
    assert all(one == shapes[0] for one in shapes)
