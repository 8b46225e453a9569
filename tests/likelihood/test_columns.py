"""Columns from slots: against derivatives of the whole light path, finite differences, and a hand's work."""

import dataclasses

import numpy as np
import pytest
from quick import quick
from small_run import SMALL, WITH_PLATE

from walop_jax.diagnosis import grammar
from walop_jax.diagnosis.hypotheses import applicable, probes, showable, texts_of
from walop_jax.fit.base_model import base_model
from walop_jax.likelihood.columns import Columns, columns, own_columns
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects import EFFECTS, Described, effect_by_name
from walop_jax.model.effects.change import Change as Sentence
from walop_jax.model.effects.change import NoSlotError
from walop_jax.model.effects.in_models import effect_context, with_effects
from walop_jax.model.parameters import values_of
from walop_jax.simulation.simulate import simulate

SENTENCES = (
    "turn of polariser * x",
    "depolarisation of polariser * cos 2 CLP",
    "diattenuation q ahead of polariser * y",
    "retardance q behind polariser * colour",
    "retardance u behind collimator * hours",
    "retardance radial behind half1.plate",
    "diattenuation diagonal ahead of half2.wedge",
    "depolarisation of chwp * sin 1 CHWP",
    "axis of half2.plate",
    "axis of half1.plate.mgf2",
    "thickness of chwp.quartz",
    "cut of half2.plate.quartz * x",
    "thermal of half1.plate",
    "fringes of half1.plate * gap 2.5",
    "displacement y ahead of pupil * hour angle",
    "shift of band",
    "polarisation of sky",
    "polarisation q of sky * exposure 25",
    "gain of half1 * ring 3",
    "gain of E1 * exposure 3",
    "gain of O1 * counts",
    "gain of half2 * root counts * r2",
    "gain of E2 * counts * kelvin",
    "light of E1 in O1",
    "light of O2 in E1 * x",
    "light of E2 in O1 * hours * y",
    "light in O2 * hours",
    "light in O1 * r2",
    "light of opposite in E2",
    "afterglow in O1",
    "afterglow in E2 * y",
    "reported gain of O2 * hours * x",
    "axis of half1.plate * hours",
    "axis of chwp * sin 2 CHWP",
    "thickness of chwp.mgf2 * hour angle",
)
LIGHT = ("light of O2 in E1 * x", "light of E2 in O1 * hours * y")
BESIDE = {
    "camera_leakage": {"share": 2e-3},
    "ghost": {"share": 3e-3},
    "nonlinearity": {"coefficient": 0.01},
    "lens_birefringence": {"delta": 0.01},
}


@pytest.fixture(scope="module")
def laid():
    """A small run with the calibration plate in and out, at temperatures and hour angles that differ, without noise.

    With the flux at its best, finite differences of residuals are their derivatives only where residuals are small.
    """
    model = base_model(simulate(WITH_PLATE, seed=4).calset)
    values = np.array([p.start + 0.3 * (p.prior[1] if p.prior else 0.0) for p in model.parameters])
    calset, truth = simulate(WITH_PLATE, seed=4, instrument=model.instrument(values), noiseless=True)
    # With the stars as they are: what a model expects is what was measured.
    values = np.asarray(values_of(truth))
    e, number = calset.exposures, np.arange(len(calset.exposures))
    moved = dataclasses.replace(e, temp=10.0 + np.sin(number), ha=np.cos(2.0 * number))
    calset = dataclasses.replace(calset, exposures=moved)
    return Likelihood.of(calset, model), values


def _said(text: str) -> tuple[tuple[float, Sentence], ...]:
    return ((1.0, Sentence.parsed(text)),)


def _alike(ours: np.ndarray, theirs: np.ndarray, names: list[str], within: float = 1e-8) -> None:
    off = np.linalg.norm(ours - theirs, axis=0) / np.linalg.norm(theirs, axis=0)
    assert np.all(np.linalg.norm(theirs, axis=0) > 0)
    assert np.max(off) < within, dict(zip(names, off, strict=True))


@pytest.mark.parametrize("text", quick(SENTENCES, [*(SENTENCES[n] for n in (1, 7, 9, 20, -2)), *LIGHT]))
def test_sentences_against_the_whole_light_path(laid, text):
    """The light path with the sentence in it, differentiated: nothing is the same but the physics of elements."""
    likelihood, values = laid
    effect = Described.saying([text], [0.0])
    _alike(columns(likelihood, values, [_said(text)]), own_columns(likelihood, values, [effect]), [text])


@pytest.mark.parametrize(
    "text",
    quick(
        [
            "added polarisation q ahead of polariser * hours",
            "added polarisation u ahead of polariser * per EXPTIME * x",
            "retardance u ahead of polariser * hours",
            "gain of O1 * per EXPTIME * x",
            "gain of half1 * order",
            "gain of O2 * counts * kind moon * y",
            "diattenuation q behind half2.plate * kind standard * x",
            "depolarisation u behind collimator * per EXPTIME",
            "turn of polariser * side CLP",
        ],
        ["added polarisation q ahead of polariser * hours", "gain of O1 * per EXPTIME * x"],
    ),
)
def test_sentences_of_single_exposures_against_the_whole_light_path(laid, text):
    test_sentences_against_the_whole_light_path(laid, text)


@pytest.mark.long
def test_every_effect_against_the_whole_light_path(laid):
    likelihood, values = laid
    template = likelihood.model.template
    context = effect_context(template, likelihood.calset.exposures)
    wanted = showable(
        likelihood.calset, template, list(probes(applicable(EFFECTS, context, template), context))
    )
    first = {probe.effect: probe for probe in reversed(wanted)}
    assert len(first) >= 30
    for effect, probe in first.items():
        changes = [change for member in probe.group for change in member.first_order(template)]
        ours, theirs = columns(likelihood, values, changes), own_columns(likelihood, values, probe.group)
        shown = theirs.any(axis=0)
        # Of the standards some were not observed.
        assert shown.all() or (effect.name == "standard_values" and not ours[:, ~shown].any()), effect.name
        _alike(ours[:, shown], theirs[:, shown], [effect.name] * int(shown.sum()))


@pytest.mark.parametrize("name", quick(BESIDE, []))
def test_beside_an_active_effect(laid, name):
    """What is active stands in the way of every change: mixed cameras, opposite points, detectors, the train."""
    bare, values = laid
    context = effect_context(bare.model.template, bare.calset.exposures)
    active = effect_by_name(name).of(context, **BESIDE[name])
    likelihood = Likelihood.of(bare.calset, with_effects(bare.model, [active], context))
    start = dict(zip(bare.model.names, values, strict=True))
    values = np.array([start.get(p.name, p.start) for p in likelihood.model.parameters])
    texts = ["gain of half1 * ring 3", "retardance q behind collimator * x", "gain of E1 * exposure 3"]
    texts += ["light of E1 in O1", "gain of O1 * counts", "polarisation of sky"]
    texts += ["light of O2 in E1 * r2", "light of E2 in O2 * hours * x"]
    ours = columns(likelihood, values, [_said(text) for text in texts])
    theirs = own_columns(likelihood, values, [Described.saying([text], [0.0]) for text in texts])
    _alike(ours, theirs, texts)


@pytest.mark.parametrize("text", quick((*SENTENCES[:21:4], *LIGHT), SENTENCES[4:5]))
def test_sentences_against_finite_differences(laid, text):
    """Residuals of models that have a little of it, one way and the other."""
    likelihood, values = laid
    context = effect_context(likelihood.model.template, likelihood.calset.exposures)
    step, residual = 1e-4, []
    for size in (step, -step):
        model = with_effects(likelihood.model, [Described.saying([text], [size])], context)
        start = dict(zip(likelihood.model.names, values, strict=True))
        there = np.array([start.get(p.name, p.start) for p in model.parameters])
        own = Likelihood.of(likelihood.calset, model)
        residual.append(own.residuals(there)[1][likelihood.used].reshape(-1))
    difference = (residual[0] - residual[1]) / (2.0 * step)
    _alike(columns(likelihood, values, [_said(text)]), difference[:, None], [text], 1e-5)


@pytest.mark.long
@pytest.mark.parametrize("name", ["WALOP-SOUTH", "WALOP-NORTH", "WALOP-LAB"])
def test_every_kind_and_every_place_against_finite_differences(name):
    """Residuals of a model that has one change of each kind and one at each place, with a little of one, and without.

    A change stands alone where it may stand alone, and under one law where it may not.
    """
    plan = dataclasses.replace(WITH_PLATE, instrument=name)
    calset, truth = simulate(plan, seed=4, noiseless=True)
    model = base_model(calset)
    every = grammar.descriptions(model.template, calset.exposures, len(calset.points))
    known, texts = set[str](), list[str]()
    for text in sorted((text for probe in every for text in texts_of(probe)), key=lambda t: t.count("*")):
        change = Sentence.parsed(text)
        if new := {change.kind, f"{change.relation} {change.place}"} - known:
            known |= new
            texts.append(text)
    context = effect_context(model.template, calset.exposures)
    whole = with_effects(model, [Described.saying(texts, [0.0] * len(texts))], context)
    start = dict(zip(model.names, values_of(truth), strict=True))
    values = np.array([start.get(p.name, p.start) for p in whole.parameters])
    likelihood, step = Likelihood.of(calset, whole), 1e-4

    def residuals(text: str, size: float) -> np.ndarray:
        amplitude = whole.index(f"described.{Sentence.parsed(text).label}")
        moved = np.where(np.arange(len(values)) == amplitude, size, values)
        return likelihood.residuals(moved)[1][likelihood.used].reshape(-1)

    theirs = np.transpose([(residuals(text, step) - residuals(text, -step)) / (2.0 * step) for text in texts])
    given = np.array([start[parameter] for parameter in model.names])
    ours = columns(Likelihood.of(calset, model), given, [_said(text) for text in texts])
    off, length = (np.linalg.norm(of, axis=0) for of in (ours - theirs, ours))
    # Of some changes the data hold little or nothing: differences of residuals are rounded to 10⁻¹² of a hundred σ.
    assert np.all(off < 1e-5 * length + 1e-6), dict(zip(texts, off / length, strict=True))
    assert np.sum(length > 0.1) > 25


def test_by_hand():
    """A gain of one camera: w F N of that camera, less its part along the counts of all.

    With y = N/σ of the model and the unit vector m = y/|y|, ∂r_j/∂a = −(δ_jk − m_j m_k) y_k.
    """
    calset = simulate(SMALL, seed=4).calset
    likelihood = Likelihood.of(calset, base_model(calset))
    values = np.array([p.start for p in likelihood.model.parameters])
    weight, counts = (likelihood.points.gathered(name) for name in ("weight", "counts"))
    _, residual = likelihood.residuals(values)
    y = (counts * weight - residual)[likelihood.used]
    m = y / np.linalg.norm(y, axis=1, keepdims=True)
    expected = -(np.eye(4)[2] - m * m[:, 2:3]) * y[:, 2:3]
    found = columns(likelihood, values, [_said("gain of O2"), _said("gain of O2 * exposure 1")])
    assert found[:, 0] == pytest.approx(expected.reshape(-1), rel=1e-11, abs=1e-11 * np.abs(y).max())
    alone = np.where((np.nonzero(likelihood.used)[1] == 1)[:, None], expected, 0.0)
    assert found[:, 1] == pytest.approx(alone.reshape(-1), rel=1e-11, abs=1e-11 * np.abs(y).max())


def test_every_sentence_of_the_grammar_has_a_column(laid):
    likelihood, values = laid
    found = Columns(likelihood, values)
    every = grammar.descriptions(likelihood.model.template, likelihood.calset.exposures, 25)
    for probe in every:
        for text in texts_of(probe):
            assert found.has(_said(text)), text


def test_what_has_no_response_is_said(laid):
    likelihood, values = laid
    for text in ("thickness of half1.plate.glass", "retardance q behind nothing", "axis of half1.wedge"):
        with pytest.raises(NoSlotError):
            columns(likelihood, values, [_said(text)])
