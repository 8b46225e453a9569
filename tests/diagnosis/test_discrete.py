"""Gross mistakes have discrete causes: told by name, in part of the exposures as well, and two of them together."""

from __future__ import annotations

import dataclasses
from unittest.mock import Mock

import numpy as np
import pytest
from changed_sets import block_of, with_block
from small_run import SEED, SMALL

from walop_jax.data.records import CalibrationSet, Position
from walop_jax.diagnosis import search
from walop_jax.diagnosis.discrete import causes
from walop_jax.diagnosis.exact import Trial
from walop_jax.diagnosis.examination import Evidence
from walop_jax.diagnosis.findings import FitComparison
from walop_jax.diagnosis.readings import Alternative, in_some_exposures
from walop_jax.diagnosis.workflow import diagnose
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import FitResult
from walop_jax.model.alternatives import changed
from walop_jax.model.effects import Described, OtherDescription, effect_by_name
from walop_jax.model.effects.base import Effect
from walop_jax.model.effects.change import Change
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
    trial = Trial(Described, 1e4, 100.0, noise=True, fit=Mock(FitResult, converged=True))
    kept = {"evidence_needed": 0.0, "floor": 1.0, "chi2": 1e6, "dof": 100, "poor": True}
    evidence = Mock(Evidence, **kept, stands=lambda *_: True)
    told = search.refused(
        evidence, dataclasses.replace(trial, compared=FitComparison(heldout_before=2.0, heldout_after=1.0))
    )
    assert ("15 widths of its prior" in told) is refused
