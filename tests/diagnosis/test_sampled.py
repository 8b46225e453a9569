"""A set too large for tables of columns: points spread over the field are looked at, and the findings say so."""

from __future__ import annotations

import pytest

from walop_jax.diagnosis import workflow
from walop_jax.diagnosis.workflow import diagnose
from walop_jax.likelihood import limits
from walop_jax.model.effects import effect_by_name
from walop_jax.simulation.observing_plan import ObservingPlan, polariser_turn
from walop_jax.simulation.simulate import simulate

PLAN = ObservingPlan(
    grid=9, standard_grid=1, standards=0, unpolarised=0, moon_patches=2, polariser_angles=polariser_turn(8)
)  # fmt: skip


class SeenError(Exception):
    pass


def test_a_sample_of_a_large_set_is_looked_at(monkeypatch):
    calset = simulate(PLAN, seed=4).calset
    monkeypatch.setattr(limits, "DIAGNOSED_ROWS", 40 * len(calset.exposures))

    def looked_at(likelihood):
        some = likelihood.calset
        assert len(some.points) == 40
        assert set(some.points.point) < set(calset.points.point)
        raise SeenError

    monkeypatch.setattr(workflow, "fit", looked_at)
    with pytest.raises(SeenError):
        diagnose(calset)


@pytest.mark.long
def test_findings_of_a_sample_say_so(monkeypatch):
    effect = effect_by_name("clp_wobble").of(PLAN.context(), amplitude=0.3, phase=1.0)
    calset = simulate(PLAN, seed=4, effects=(effect,)).calset
    monkeypatch.setattr(limits, "DIAGNOSED_ROWS", 40 * len(calset.exposures))
    found = diagnose(calset)
    assert len(found.after.calset.points) == 40
    assert found.points == 81
    assert "40 of 81 field points" in found.caution
    assert [step.effect for step in found.steps] == ["clp_wobble"]
    value, sigma, _ = found.steps[0].parameters["amplitude"]
    assert value == pytest.approx(0.3, abs=5 * sigma)
