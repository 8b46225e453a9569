"""What a plan must contain for a go: directions of the polariser, counted by hand."""

from __future__ import annotations

import numpy as np
import pytest

from walop_jax.calibration.certify import UNMEASURED, lacks
from walop_jax.calibration.could_hide import shown_by_the_sky_alone
from walop_jax.data.records import Exposures
from walop_jax.model.effects import EFFECTS
from walop_jax.plans.available import Available, CandidateExposure
from walop_jax.plans.exposures import Candidates
from walop_jax.plans.needs import _directions, _of_the_sky, half_a_turn_later
from walop_jax.science.field_accuracy import known_in_half
from walop_jax.simulation.observing_plan import ObservingPlan, Stop


def polarised(turn: float) -> CandidateExposure:
    return CandidateExposure("clp", "SDSS-r", {"CHWP": None}, 30.0, (Stop(0.0),)).over(turn)


def candidates_of(*choices: CandidateExposure) -> Candidates:
    """Candidates without any information: what they are is enough."""
    found = object.__new__(Candidates)
    object.__setattr__(found, "choices", choices)
    object.__setattr__(found, "available", Available(ObservingPlan(grid=2)))
    return found


def taken(angles: list[float]) -> list[Exposures]:
    plan = ObservingPlan(grid=2, polariser_angles=tuple(angles) or (0.0,), moon_patches=0, standards=0)
    return [plan.exposures()] if angles else []


@pytest.mark.parametrize("turn", [180.0, 360.0])
@pytest.mark.parametrize("had", [[], [0.0], [0.0, 90.0], [12.0 * k for k in range(15)]])
@pytest.mark.parametrize("planned", [[], [43.5, 45.0, 135.0]])
def test_directions_are_eight_with_those_that_are_there(turn, had, planned):
    """No more than are missing; two of a plan within 3° are one."""
    choice = polarised(turn)
    numbers = {(0, choice.number(angle)): 1.0 + k for k, angle in enumerate(planned)}
    wanted = _directions(candidates_of(choice), numbers, taken(had))
    found = [choice.stops[number].polariser_angle for _, number in wanted]
    directions = np.sort(np.mod([*had, *found], 180.0))
    gaps = np.diff(np.append(directions, directions[0] + 180.0))
    assert len(directions) == max(8, len(had) + (turn == 360.0))
    assert gaps.min() >= (3.0 if len(had) < 8 else 0.0)
    if planned and len(had) < 8:
        assert {135.0, 45.0} <= set(found)  # 43.5° is not another direction
    if turn == 360.0:
        whole = np.sort(np.mod([*had, *found], 360.0))
        assert np.diff(np.append(whole, whole[0] + 360.0)).max() <= 180.0


def test_every_second_direction_is_taken_half_a_turn_later():
    """Three and more lie over a whole turn; where half a turn later is another exposure none is touched."""
    choice = polarised(180.0)
    angles = [150.0, 21.0, 81.0, 120.0, 51.0]
    planned = {(0, choice.number(angle)): 1.0 for angle in angles}
    later = {choice.stops[i].polariser_angle for _, i in half_a_turn_later(candidates_of(choice), planned)}
    assert later == {51.0, 120.0}
    choice = polarised(360.0)
    planned = {(0, choice.number(angle)): 1.0 for angle in angles}
    assert half_a_turn_later(candidates_of(choice), planned) == set()


def test_the_sky_of_a_go_is_what_takes_least_time_beside_the_plan():
    """By hand: two Moon patches take 240 s, two standards 300; where a polarised one is planned the other takes 150."""
    moon, star = (
        CandidateExposure(kind, "SDSS-r", {}, 60.0, tuple(Stop(None, kind=kind, number=i) for i in range(4)))
        for kind in ("moon", "standard")
    )
    found = candidates_of(moon, star)
    assert found.available.plan.unpolarised == 2
    assert set(_of_the_sky(found, {}, [])) == {(0, 0), (0, 1)}
    assert set(_of_the_sky(found, {(1, 3): 2.0}, [])) == {(1, 0), (1, 3)}
    assert set(_of_the_sky(found, {(1, 3): 2.0, (0, 2): 1.0}, [])) == {(0, 0), (0, 2)}
    assert _of_the_sky(found, {}, [ObservingPlan(grid=2).exposures()]) == {}


def test_what_only_the_sky_shows_and_what_it_does_to_stars():
    """By hand: polarisation added as it is, 0.2 %; the sky turned by 0.3°: 2 p δ with p = 5 %, 0.052 %."""
    plan = ObservingPlan(grid=2)
    errors = shown_by_the_sky_alone(plan.design, EFFECTS, plan.context())
    assert errors == pytest.approx(
        {
            "rotator_zero.angle": 2 * 0.05 * np.deg2rad(0.3),
            "telescope_polarisation.q": 0.002,
            "telescope_polarisation.u": 0.002,
        }
    )
    assert min(errors.values()) > UNMEASURED
    polariser_alone = ObservingPlan(grid=2, moon_patches=0, standards=0).exposures()
    (finding,) = lacks(plan.design, EFFECTS, plan.context(), polariser_alone)
    assert finding.what.startswith(
        "rotator_zero.angle, telescope_polarisation.q, telescope_polarisation.u not measured"
    )
    assert list(lacks(plan.design, EFFECTS, plan.context(), polariser_alone, plan.exposures())) == []
    one = ObservingPlan(grid=2, polariser_angles=(0.0, 180.0)).exposures()
    assert [finding.severity for finding in lacks(plan.design, EFFECTS, plan.context(), one)] == ["fault"]


def test_p_known_in_half_of_the_field():
    assert known_in_half(4.9e-4).met
    assert not known_in_half(5.1e-4).met
    assert "4.0 times the light" in known_in_half(1e-3).advice
    # Light alone does not measure a polarisation of 5 % to within itself: another setting does.
    assert "times the light" in known_in_half(0.049).advice
    for unknown in (np.inf, 0.051, 180.0):
        assert "plate at 22.5°" in known_in_half(unknown).advice
        assert "times the light" not in known_in_half(unknown).advice
