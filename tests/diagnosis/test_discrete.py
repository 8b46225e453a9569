"""Gross mistakes have discrete causes: told by name, in part of the exposures as well, and two of them together."""

from __future__ import annotations

import dataclasses
from unittest.mock import Mock

import numpy as np
import pytest
from changed_sets import block_of, with_block
from small_run import SEED, SMALL, WITH_PLATE

from walop_jax.data.records import CalibrationSet, FilterCurve, Position
from walop_jax.diagnosis import search, workflow
from walop_jax.diagnosis.discrete import _most_missed, causes, causes_before_a_fit
from walop_jax.diagnosis.exact import Trial
from walop_jax.diagnosis.findings import FitComparison
from walop_jax.diagnosis.grammar import hypotheses
from walop_jax.diagnosis.readings import Alternative, _columns_exchanged, _filters, in_some_exposures
from walop_jax.diagnosis.screen import stepping
from walop_jax.diagnosis.workflow import diagnose
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import FitResult
from walop_jax.io.errors import DataError
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.alternatives import changed
from walop_jax.model.effects import EFFECTS, Described, OtherDescription, effect_by_name
from walop_jax.model.effects.base import Effect
from walop_jax.model.effects.change import Change
from walop_jax.model.effects.in_models import with_effects
from walop_jax.model.instrument import nominal_instrument
from walop_jax.simulation.simulate import simulate

FAR = 1e5  # χ²/dof of a fit of such data


@pytest.fixture(scope="module")
def sound() -> CalibrationSet:
    return simulate(SMALL, seed=SEED).calset


def with_polariser(calset: CalibrationSet, angle: np.ndarray) -> CalibrationSet:
    return dataclasses.replace(calset, exposures=calset.exposures.placed(CLP=Position.at(angle)))


def plate_in_the_beam() -> Effect:
    return effect_by_name("chwp_in_beam").of(SMALL.context())


def found(calset: CalibrationSet, *structural: Effect, descriptions: bool = False) -> Alternative:
    """The best cause; every one that is named leaves noise."""
    told = causes(calset, base_model(calset), FAR, structural, descriptions=descriptions)
    assert told
    assert told[0].explained < 1.5
    return told[0]


def test_a_plate_left_in_the_beam_is_the_effect_of_that_name():
    calset = simulate(SMALL, seed=SEED, effects=[plate_in_the_beam()]).calset
    told = found(calset, plate_in_the_beam())
    assert told.what == "chwp_in_beam"
    assert not told.of_data


def test_a_diagnosis_of_it_begins_with_its_name_and_ends_trusted():
    """A description of nine numbers, 315 widths beyond a prior, was adopted before it."""
    calset = simulate(SMALL, seed=SEED, effects=[plate_in_the_beam()]).calset
    diagnosis = diagnose(calset)
    assert diagnosis.verdict == "effect_found"
    assert [step.effect for step in diagnosis.steps] == ["chwp_in_beam"]
    assert diagnosis.rounds[0].added == "chwp_in_beam"
    assert diagnosis.after.explains_data


def test_a_wrong_number_of_the_set_is_the_explanation():
    """A clock in local time, two hours off: verdict, headline and usability say so."""
    calset = simulate(SMALL, seed=SEED).calset
    late = dataclasses.replace(calset.exposures, mjd=calset.exposures.mjd + 2.0 / 24.0)
    diagnosis = diagnose(dataclasses.replace(calset, exposures=late))
    assert diagnosis.verdict == "wrong_number"
    assert not diagnosis.complete
    shown = diagnosis.display()
    assert shown.title.startswith("Diagnosis (wrong number): no go")
    told = dict(shown.facts)["found"]
    assert told.startswith("MJD of sky exposures changed by −0.08")


def test_a_mistake_in_some_exposures_is_told_with_their_numbers(sound):
    """The polariser runs backwards from the sixth exposure on; at 0° and 90° that is the same."""
    angle = sound.exposures.clp_angle.copy()
    late = (np.arange(len(angle)) >= 5) & sound.exposures.clp_in
    bad = with_polariser(sound, np.where(late, -angle, angle))
    told = found(bad)
    numbers = ", ".join(str(n) for n in sound.exposures.exposure[late & (angle % 90.0 != 0.0)])
    assert told.what.startswith("CLP_ANGLE runs the other way in exposures")
    assert numbers in told.what
    assert told.change(bad).exposures.clp_angle[late] == pytest.approx(angle[late])


def test_a_gain_that_steps_is_told_with_its_size(sound):
    """A half more from the seventh exposure on: a fault of that camera, whatever its prior says."""
    block, late = block_of(sound), np.arange(len(sound.exposures)) >= 6
    factor = np.ones((len(late), 4))
    factor[late, 2] = 1.5
    told = found(with_block(sound, counts=block.counts * factor, sigma=block.sigma * np.sqrt(factor)))
    first = sound.exposures.exposure[6]
    assert told.what.startswith(f"the gain of O2 is 1.5 times as large in exposures {first}, ")


def test_two_mistakes_at_once_are_told_together(sound):
    block = block_of(sound)
    order = [1, 0, 2, 3]
    points = dataclasses.replace(sound.points, x=-sound.points.x)
    bad = with_block(
        dataclasses.replace(sound, points=points),
        counts=block.counts[..., order],
        sigma=block.sigma[..., order],
        x=points.x,
    )
    told = found(bad)
    assert "the columns of N were in the order E1, O1, O2, E2" in told.what
    assert "X runs the other way" in told.what
    assert ", and " in told.what


def test_the_second_mistake_is_sought_where_the_first_one_was_not(sound):
    """Angles of the polariser that are 45° off hide standards of the other sign: these are not among the worst."""
    stars = dataclasses.replace(sound.sources, u=-sound.sources.u)
    calset = dataclasses.replace(sound, sources=stars)
    told = found(with_polariser(calset, calset.exposures.position("CLP").angle + 45.0))
    assert told.what == "CLP_ANGLE is 135° too small, and U of SOURCES had the other sign"


@pytest.mark.parametrize(
    "change",
    [
        "half2.plate with layers in the other order",
        "half1.plate turned by 90 deg",
        "collimator behind pupil",
    ],
)
def test_an_instrument_rearranged_in_place_is_the_one_with_the_effect(sound, change):
    """Number for number, on the nodes of the instrument as it was: an exchange of layers makes no plate thicker."""
    model = base_model(sound)
    values = model.start * (1.0 + 1e-3 * np.arange(len(model.start)) / len(model.start))
    values = model.full(values[model.free])
    otherwise = model.rearranged(values, lambda bare: changed(bare, change))
    likelihood = Likelihood.of(sound, otherwise)
    effect = OtherDescription(change=change)
    theirs = Likelihood.of(sound, with_effects(model, [effect], sound)).residuals(values)[1]
    ours = likelihood.residuals(otherwise.start)[1]
    assert np.abs(ours - theirs).max() < 1e-9 * np.abs(theirs).max()
    assert likelihood.plan.wavelength.shape == Likelihood.of(sound, model).plan.wavelength.shape


def test_what_is_taken_out_has_no_parameters_in_its_place_and_no_candidates(sound):
    """Half 2 without its plate: nothing acts on the plate, and all other candidates stay."""
    model, change = base_model(sound), "half2.plate left out"
    assert model.rearranged(model.start, lambda bare: changed(bare, change)) is None
    without = with_effects(model, [OtherDescription(change=change)], sound).template
    listed, before = (
        {probe.name for probe in hypotheses(EFFECTS, t, sound.exposures, len(sound.points)).beside(())}
        for t in (without, model.template)
    )
    assert not [name for name in listed if "half2.plate" in name]
    assert "hwp2_axis" in before - listed
    # What was said of the plate is said of its neighbours; of half 1, cameras and sources all is as it was.
    assert {name for name in before if "half1" in name and "half2" not in name} <= listed


@pytest.mark.parametrize("change", ["half1.plate and half2.plate exchanged", "half2.wedge turned by 180 deg"])
def test_an_instrument_put_together_otherwise_is_told(change):
    """The wedge is no field that is turned by 180°, though that explains more than nine tenths of it."""
    calset = simulate(SMALL, seed=SEED, effects=[OtherDescription(change=change)]).calset
    assert found(calset, descriptions=True).what == change


def test_of_readings_that_do_the_same_the_rotator_comes_before_the_catalogue():
    """Of the standards alone a zero of ROTATOR that is 90° off is another sign of Q and U."""
    made = simulate(SMALL, seed=SEED).calset
    e = made.exposures
    turned = np.where(e.kind == "standard", e.rotator - 90.0, e.rotator)
    bad = dataclasses.replace(made, exposures=dataclasses.replace(e, rotator=turned))
    told = causes(bad, base_model(bad), FAR)
    assert told[0].what == "ROTATOR is 90° too small in exposures of kind standard"
    assert "Q and U of SOURCES both had the other sign" in [one.what for one in told]


def test_exposures_of_one_set_and_of_another(sound):
    """By hand: angles, counts and errors of the chosen ones are of the second set, all else of the first."""
    block = block_of(sound)
    other = with_block(with_polariser(sound, -sound.exposures.clp_angle), counts=2.0 * block.counts)
    chosen = np.arange(len(sound.exposures)) % 3 == 1
    mixed = in_some_exposures(sound, other, chosen)
    sign = np.where(chosen, -1.0, 1.0)
    np.testing.assert_array_equal(mixed.exposures.clp_angle, sign * sound.exposures.clp_angle)
    np.testing.assert_array_equal(block_of(mixed).counts, block.counts * np.where(chosen, 2.0, 1.0)[:, None])
    np.testing.assert_array_equal(block_of(mixed).sigma, block.sigma)
    np.testing.assert_array_equal(mixed.exposures.mjd, sound.exposures.mjd)


def test_plates_that_are_exchanged_have_each_others_axes():
    south = nominal_instrument("WALOP-SOUTH")
    crossed = changed(south, "half1.plate and half2.plate exchanged")
    assert [float(crossed.element(f"{arm}.plate").axis) for arm in ("half1", "half2")] == [22.5, 0.0]


@pytest.mark.parametrize(("text", "refused"), [("turn of polariser", True), ("gain of O2 * hours", False)])
def test_optics_ten_widths_beyond_their_prior_explain_nothing(monkeypatch, text, refused):
    """A turn of 15 widths is another arrangement; a gain may be so far off: something broke."""
    change = Change.parsed(text)
    monkeypatch.setattr(search, "descriptions_of", lambda fit: ((change, 1.0, 0.01),))
    monkeypatch.setattr(search, "beyond_prior", lambda fit, name: {change.label: 15.0})
    trial = Trial(
        Described, 1e4, 100.0, leaves_noise=True, fit=Mock(FitResult, converged=True),
        compared=FitComparison(heldout_before=2.0, heldout_after=1.0),
    )  # fmt: skip
    told = search.against(trial)
    assert ("15 widths of its prior" in told) is refused


def test_a_plate_in_the_beam_of_the_standards_alone_is_told():
    """Four exposures of fifteen: a fit bends little, and χ²/dof of the whole set is that of an effect."""
    calset = simulate(SMALL, seed=SEED).calset
    there = simulate(SMALL, seed=SEED, effects=[plate_in_the_beam()]).calset
    mixed = in_some_exposures(calset, there, calset.exposures.kind == "standard")
    told = causes(mixed, base_model(mixed), left=20.0)
    assert told[0].what == (
        "CHWP was in the beam, at 0°, where the exposures say that it was out in exposures of kind standard"
    )
    assert told[0].explained < 1.2


def test_the_share_of_the_light_that_an_exposure_misses():
    """By hand: 3 % of the light of one exposure, nothing in the others; an error of 10 in 1000."""
    counts, sigma = np.full((2, 3, 4), 1000.0), np.full((2, 3, 4), 10.0)
    residual = np.zeros((2, 3, 4))
    residual[:, 1] = 3.0
    block = Mock(counts=counts, sigma=sigma)
    likelihood = Mock(Likelihood, used=np.ones((2, 3), bool), residuals=lambda values: (None, residual))
    likelihood.calset = Mock(points=[0, 1])
    likelihood.calset.intensities.block = lambda first, last: block
    assert _most_missed(likelihood, np.zeros(1)) == pytest.approx(0.03)


def test_data_that_are_read_wrongly_are_refused_without_a_fit(monkeypatch, sound):
    def never(*_: object, **__: object) -> None:
        raise AssertionError("a fit was made")

    monkeypatch.setattr(workflow, "fit", never)
    with pytest.raises(DataError, match=r"it would if CLP_ANGLE runs the other way .*: give −CLP_ANGLE"):
        diagnose(with_polariser(sound, -sound.exposures.clp_angle))
    assert causes_before_a_fit(sound, base_model(sound))[1] is None


def test_columns_of_two_moving_elements_are_exchanged_whole():
    """Angles, and where each is in the beam."""
    calset = simulate(WITH_PLATE, seed=SEED).calset
    (one,) = _columns_exchanged(calset)
    assert one.what == "the columns of CLP and CHWP were exchanged"
    before, after = calset.exposures, one.change(calset).exposures
    np.testing.assert_array_equal(after.position("CHWP").angle, before.clp_angle)
    np.testing.assert_array_equal(after.clp_angle, before.position("CHWP").angle)
    np.testing.assert_array_equal(after.clp_in, before.position("CHWP").inside)


def test_filters_are_exchanged_or_counted_from_the_other_end():
    """By hand: red, green and blue by their wavelengths, whatever their names."""
    waves = {"A": 0.70, "B": 0.45, "C": 0.55}
    curves = {name: FilterCurve(name, np.array([w]), np.array([1.0])) for name, w in waves.items()}
    calset = simulate(SMALL, seed=SEED).calset
    named = np.resize(np.array(["A", "B", "C"]), len(calset.exposures))
    exposures = dataclasses.replace(calset.exposures, filter=named)
    calset = dataclasses.replace(calset, exposures=exposures, filters=curves)
    told = {one.what: one.change(calset).exposures.filter[:3].tolist() for one in _filters(calset)}
    assert told == {
        "the filters B and C were exchanged": ["A", "C", "B"],
        "the filters B and A were exchanged": ["B", "A", "C"],
        "the filters C and A were exchanged": ["C", "B", "A"],
        "the filters were counted from the other end, A as B": ["B", "A", "C"],
    }


def test_the_zero_of_every_moving_element_may_have_stepped():
    """5° on the plate in two exposures, of those where it is in the beam."""
    calset = simulate(WITH_PLATE, seed=SEED).calset
    likelihood = Likelihood.of(calset, base_model(calset))
    told = {number.worded(5.0): number for number in stepping(likelihood)}
    number = told["CHWP_ANGLE is 5° too small"]
    assert "CLP_ANGLE is 5° too small" in told
    at = calset.exposures.position("CHWP")
    some = at.inside & (np.cumsum(at.inside) <= 2)
    after = number.change(calset, 5.0, some).exposures.position("CHWP").angle
    np.testing.assert_allclose(after - at.angle, np.where(at.inside, np.where(some, 5.0, 0.0), np.nan))
