"""Other descriptions of an instrument: the same light where they say the same, and found where they are the truth."""

import dataclasses
from unittest.mock import Mock

import jax.numpy as jnp
import numpy as np
import pytest
from scenes import PLAN

from walop_jax.diagnosis import exact, refits
from walop_jax.diagnosis.exact import other_descriptions
from walop_jax.diagnosis.findings import Choice, document
from walop_jax.diagnosis.hypotheses import Hypotheses
from walop_jax.diagnosis.search import Reason, Round, State
from walop_jax.diagnosis.workflow import diagnose
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import FitResult, fit
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.alternatives import alternatives, changed
from walop_jax.model.effects import OtherDescription, effect_by_name
from walop_jax.model.effects.in_models import effect_context, with_effects
from walop_jax.model.instrument import Instrument, nominal_instrument
from walop_jax.model.ray import Conditions, Ray
from walop_jax.model.specification import Model
from walop_jax.simulation.observing_plan import NARROW_BANDS
from walop_jax.simulation.simulate import simulate

TURNED = "half1.wedge and half2.wedge turned by 180 deg"
REVERSED = "half1.plate, half2.plate and chwp with layers in the other order"
OTHER_CURVE = "mgf2 with the dispersion of Li 1980"
COLOURS = dataclasses.replace(PLAN, filters=("SDSS-r", *NARROW_BANDS))


@pytest.fixture(scope="module")
def south() -> Instrument:
    return nominal_instrument("WALOP-SOUTH")


def test_every_change_makes_an_instrument_and_most_come_back(south):
    for sentence, change in alternatives(south).items():
        once = change(south)
        assert once.patched() is not None
        if sentence.endswith(("with layers in the other order", "exchanged beams", "exchanged cameras")):
            twice = changed(once, sentence)
            assert twice.arms[0].analyser.cameras == south.arms[0].analyser.cameras
            assert twice.cameras.pairs == south.cameras.pairs
            plates = [arm.elements[0].layers for arm in twice.arms]
            assert [[one.name for one in layers] for layers in plates] == [["quartz", "mgf2"]] * 2


def test_beams_that_are_exchanged_go_to_the_other_camera(south):
    exchanged = changed(south, "half1 and half2 with exchanged cameras")
    assert exchanged.arms[0].analyser.cameras == ("O2", "E2")
    assert exchanged.cameras.pairs == ((2, 3), (0, 1))
    assert changed(south, "half2.analyser with exchanged beams").arms[1].analyser.cameras == ("E2", "O2")


@pytest.mark.parametrize("turn", [90.0, 180.0, 270.0])
def test_a_turned_wedge_bends_light_to_where_it_points(south, turn):
    """Snell's law at a plane whose normal is (sin w cos a, sin w sin a, cos w), in vectors."""
    wedge = changed(south, f"half1.wedge turned by {turn:.0f} deg").arms[0].elements[1]
    k, w, a = np.array([0.05, -0.08, np.sqrt(1 - 0.05**2 - 0.08**2)]), -0.230, np.deg2rad(turn)
    zero, spectrum = jnp.zeros(()), (jnp.array([0.62]), Conditions(jnp.zeros(()), {}))
    ahead = Ray(zero, zero, jnp.asarray(k[0]), jnp.asarray(k[1]), spectrum)
    n = np.asarray(wedge.index(ahead)).item()
    normal = np.array([np.sin(w) * np.cos(a), np.sin(w) * np.sin(a), np.cos(w)])
    inside = k + (np.sqrt(n**2 - 1 + (k @ normal) ** 2) - k @ normal) * normal
    behind = wedge.ray(ahead)
    assert float(wedge.azimuth) == turn
    np.testing.assert_allclose(np.ravel([behind.kx, behind.ky]), inside[:2], rtol=0, atol=1e-14)


def test_a_sentence_that_the_instrument_has_no_place_for_names_the_nearest(south):
    with pytest.raises(ValueError, match=r"half1\.wedge turned by 90 deg"):
        changed(south, "half1.wedge turned by 91 deg")


def test_a_change_that_gained_nothing_is_not_compared_again(south, monkeypatch):
    """Once names have joined the model; one that did gain is, whatever its linear step leaves."""
    told: list[str] = []
    monkeypatch.setattr(exact, "_screened", lambda result, asked: iter(()))
    result = Mock(FitResult, model=Mock(Model, template=south, effect_names=()))
    earlier = {change: Choice(change, 2.0, -5.0) for change in alternatives(south)}
    asked = result, lambda count: True, told.append
    assert other_descriptions(*asked, earlier=earlier) == ([], {})
    assert not told
    earlier |= {TURNED: Choice(TURNED, 2.0, 30.0), REVERSED: Choice(REVERSED, 0.5)}
    other_descriptions(*asked, earlier=earlier)
    assert told == ["comparing 2 other descriptions"]


@pytest.mark.parametrize(("evidence", "tried"), [(-40.0, []), (12.0, ["chwp_in_beam"])])
def test_a_structural_effect_that_was_refuted_is_not_fitted_again(south, monkeypatch, evidence, tried):
    """One that an earlier round left out for another reason is."""
    fits = list[str]()
    monkeypatch.setattr(
        refits, "try_effect", lambda _, effect: fits.append(effect.name) or Mock(exact.Trial, fit=None)
    )
    monkeypatch.setattr(refits, "context_of", lambda result: PLAN.context())
    monkeypatch.setattr(refits, "other_descriptions", lambda *_, **__: ([], {}))
    plate = effect_by_name("chwp_in_beam")
    reason = Reason(plate.name, evidence, 0.0, fitted=True, reason="something else was added first")
    result = Mock(model=Mock(effect_names=()))
    state = State(Mock(poor=True, result=result), rounds=(Round(0.0, "ghost", (reason,)),))
    judge = refits.Refits(
        hypotheses=Hypotheses(effects=(plate,)),
        rng=np.random.default_rng(0),
        tell=print,
        minutes=np.inf,
        began=0.0,
    )
    judge.others(state)
    assert fits == tried


def test_it_is_an_effect_like_any_other_once_it_is_in_a_model(south):
    calset = simulate(PLAN, 1).calset
    model, context = base_model(calset), effect_context(south, calset.exposures)
    assert effect_by_name("other_description") is OtherDescription
    both = with_effects(model, [OtherDescription(change=f"{TURNED}; {REVERSED}")], context)
    assert both.names == model.names
    with pytest.raises(ValueError, match="there is no change of"):
        with_effects(model, [OtherDescription(change="half1.wedge turned by 91 deg")], context)


def fitted(plan, change: str, seed: int = 5) -> FitResult:
    calset = simulate(plan, seed, effects=[OtherDescription(change=change)] if change else []).calset
    return fit(Likelihood.of(calset, base_model(calset)))


def best_of(result: FitResult) -> Choice | None:
    """The change that gains most in χ²."""
    trials, tried = other_descriptions(result, lambda count: True, lambda text: None)
    assert all(trial.instance.change in tried for trial in trials)
    fitted_ones = [one for one in tried.values() if np.isfinite(one.better_by)]
    return max(fitted_ones, key=lambda one: one.better_by, default=None)


@pytest.mark.long
@pytest.mark.parametrize(("plan", "change"), [(PLAN, TURNED), (PLAN, REVERSED), (COLOURS, OTHER_CURVE)])
def test_the_description_that_made_the_data_is_found(plan, change):
    best = best_of(fitted(plan, change))
    print(change, best)
    assert best is not None
    assert best.change == change
    assert best.better_by > 50.0


@pytest.mark.long
def test_nothing_is_claimed_where_the_description_is_right():
    result = fitted(PLAN, "")
    best = best_of(result)
    assert best is None or best.better_by < 20.0
    assert diagnose(result.calset, catalogue=()).choices == ()


@pytest.mark.long
def test_a_diagnosis_names_it(tmp_path):
    calset = simulate(PLAN, 3, effects=[OtherDescription(change=TURNED)]).calset
    found = diagnose(calset, catalogue=())
    content = document(found)
    assert found.verdict == "effect_found"
    assert [step["effect"] for step in content["steps"]] == ["other_description"]
    assert content["steps"][0]["parameters"]["change"]["value"] == TURNED
    assert content["choices"][0]["change"] == TURNED
    assert content["choices"][0]["better_by"] == pytest.approx(found.before.chi2 - found.after.chi2, rel=0.2)
