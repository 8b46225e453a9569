"""Classes of what was added: whom data cannot tell from it, what each does to the matrix, and the product of them."""

import dataclasses
import json

import class_scene
import numpy as np
import pytest
from class_scene import TOLD
from fits_with import examined_with, fit_with, set_with
from small_run import SMALL

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.certify import certify
from walop_jax.calibration.matrix import instrument_matrices
from walop_jax.diagnosis import class_members, grammar
from walop_jax.diagnosis.class_members import LinearisedFit, LinearStep, classes_of
from walop_jax.diagnosis.class_product import (
    Answer,
    OpenQuestion,
    Questions,
    _with_ties,
    averaged,
    only_a_class,
)
from walop_jax.diagnosis.discrepancy import ambiguities
from walop_jax.diagnosis.refits import settled
from walop_jax.fit.base_model import base_model
from walop_jax.io.errors import DataError
from walop_jax.model.effects import Described
from walop_jax.model.effects.blemish import Blemish
from walop_jax.model.effects.change import Change
from walop_jax.model.effects.in_models import with_effects
from walop_jax.posterior.run import Run
from walop_jax.simulation.simulate import effect_from_text, simulate


@pytest.fixture(scope="module")
def told():
    return class_scene.told()


def test_what_one_kind_has_against_the_others_the_others_have_against_it(told):
    result, classes = told
    (found,) = classes.additions
    names = [member.name for member in found.members]
    assert names[0] == TOLD
    (other,) = (m for m in found.members if m.name == "gain of O1 * kind clp; gain of O1 * kind standard")
    assert other.probability == pytest.approx(found.members[0].probability)
    assert other.amplitudes == pytest.approx([3e-3], rel=0.1)
    # With the polariser wrong and the Moon right, camera O1 is brighter everywhere: m21 grows by ½ (1 − m21²) 0.3 %.
    m21 = instrument_matrices(result)[:, 0, 0]
    np.testing.assert_allclose(other.change[:, 0], 0.5 * (1 - m21**2) * other.amplitudes[0], rtol=0.05)


def test_the_product_lies_between_and_its_errors_hold_both(told):
    result, classes = told
    alone = Calibration.from_fit(result.with_verdict())
    product = averaged(alone, classes)
    x, y = np.array([0.1, -0.2]), np.array([0.05, 0.2])
    (m, c), (one, within) = product.matrix(x, y), alone.matrix(x, y)
    shift = 0.5 * (1 - one[:, 0] ** 2) * 3e-3
    np.testing.assert_allclose(m[:, 0] - one[:, 0], 0.5 * shift, rtol=0.15)
    np.testing.assert_allclose(np.sqrt(c[:, 0, 0] - within[:, 0, 0]), 0.5 * shift, rtol=0.15)
    assert np.linalg.eigvalsh(product.covariance).min() > -1e-12
    sentence = " ".join(only_a_class(classes))
    assert "only a class of causes was named" in sentence
    assert "plan --separate RUN" in sentence


def test_the_matrix_of_the_product_is_the_mean_of_those_of_the_members(told):
    """Two ways to the same numbers: the model with all members, and the change of the matrix by each."""
    result, classes = told
    alone = Calibration.from_fit(result.with_verdict())
    product = averaged(alone, classes)
    at = result.calset.points.x, result.calset.points.y
    change = (product.matrix(*at)[0] - alone.matrix(*at)[0]).reshape(len(at[0]), -1)
    (group,) = classes.additions
    mean = sum(member.probability * member.change for member in group.members)
    assert np.abs(mean).max() > 5e-4
    np.testing.assert_allclose(change, mean, atol=0.01 * np.abs(mean).max())


def test_one_amplitude_of_two_kinds_is_one_parameter(told):
    """The polariser and the standards are wrong by the same: a covariance of both as two would be singular."""
    result, classes = told
    product = averaged(Calibration.from_fit(result.with_verdict()), classes)
    clp, standard = (f"described.gain_of_O1_*_kind_{kind}" for kind in ("clp", "standard"))
    assert product.model[standard].tie == clp
    values = dict(zip(product.model.names, product.values, strict=True))
    assert values[clp] == pytest.approx(values[standard], rel=1e-12)
    checks = {check.name: check for check in certify(product)}
    assert checks["covariance"].passed, checks["covariance"].found
    assert checks["maps"].passed


def test_sentences_in_a_fixed_ratio_have_one_error(told):
    """Amplitudes a, b: s₁ = a, s₂ = a + b, s₃ = b, s₄ = a. Two of the four are free."""
    result, _ = told
    texts = [f"gain of {camera} * hours" for camera in ("O1", "E1", "O2", "E2")]
    model = with_effects(
        base_model(result.calset), [Described.saying(texts, [0.0, 0.0, 0.0, 0.0])], result.calset
    )
    new = [model.index(f"described.{text.replace(' ', '_')}") for text in texts]
    amplitudes = np.zeros((len(model.parameters), 2))
    amplitudes[new] = [[1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [1.0, 0.0]]
    made = _with_ties(model, new, amplitudes)
    one, two, three, four = (made.parameters[i] for i in new)
    assert [one.free, two.free, three.free] == [True, True, False]
    assert four.tie == one.name


def test_a_class_of_one_changes_nothing(told):
    result, _ = told
    alone = Calibration.from_fit(result.with_verdict())
    assert averaged(alone, Questions()) is alone


def test_probabilities_of_members_add_up_to_one(told, monkeypatch):
    """Of three equally probable ones and e^−6.8 of that: all parameters would be smaller by what is left out."""
    result, _ = told
    laid = LinearisedFit(class_scene.examined())
    sums = (((1.0, Change.parsed("gain of O1 * hours")),),)

    def candidates(step, addition, alike, whole):
        rival = step.member("", sums, laid.design.stacked([laid.columns.of(sums)]), np.array([3e-3]))
        return addition.evidence, [
            (rival._replace(evidence=addition.evidence - less, change=10.0 * k * laid.errors), False)
            for k, less in enumerate((0.0, 0.0, 6.8), 1)
        ]

    monkeypatch.setattr(LinearStep, "candidates", candidates)
    monkeypatch.setattr(LinearStep, "in_other_kinds", lambda step, member, widths: None)
    (group,) = classes_of(laid, {TOLD: ()})
    assert len(group.members) == 4
    assert sum(member.probability for member in group.members) == pytest.approx(1.0, abs=1e-12)
    # A product holds so many changes at most, those of the most probable members, which then are all there is.
    with monkeypatch.context() as less:
        less.setattr(class_members, "MOST_CHANGES", 2)
        (fewer,) = classes_of(laid, {TOLD: ()})
    assert [m.evidence for m in fewer.members] == [m.evidence for m in group.members[:3]]
    assert sum(member.probability for member in fewer.members) == pytest.approx(1.0, abs=1e-12)
    # What no member changes, the mean does not change: half-wave plates of thousands of µm, for example.
    alone = Calibration.from_fit(result.with_verdict())
    product = averaged(alone, Questions(additions=(group,)))
    values = dict(zip(product.model.names, product.values, strict=True))
    for name, value, of in zip(alone.model.names, alone.values, alone.model.parameters, strict=True):
        if not of.free and of.tie is None:
            assert values[name] == pytest.approx(value, rel=1e-12), name


def test_what_was_added_is_in_its_class_once():
    """A fit is no linear step: the same sentence by one step from nothing differs from it by more than its errors."""
    own, other = "depolarisation of polariser * r2", "depolarisation behind collimator * r2"
    result = fit_with(set_with(3, {other: 6e-3}), Described.saying([own], [5e-3]))
    state = examined_with(result, (own, other).__contains__)
    (found,) = ambiguities(state, {own: ()}).additions
    assert [member.name for member in found.members] == [own, other]


@pytest.fixture(scope="module")
def turned():
    """HWP2 turned by 0.06°, fitted by its name; the description of the axes of both plates is asked beside it."""
    turn = effect_from_text("hwp2_axis=0.06", SMALL.context())
    return examined_with(
        fit_with(simulate(SMALL, seed=4, effects=[turn]).calset, turn),
        lambda name: name.startswith("axis of half"),
    )


def test_a_change_of_one_name_is_not_shared_with_a_longer_description_of_it(turned):
    """The axes of both plates say all that the name says, and one number more, which is zero: 0.06° is one change."""
    asked = {probe.name for probe in turned.descriptions}
    assert "axis of half1.plate; axis of half2.plate" in asked
    fit = turned.result
    value, error = fit.value("hwp2_axis.angle")
    assert value == pytest.approx(0.06, abs=4 * error)
    product = averaged(Calibration.from_fit(fit.with_verdict()), ambiguities(turned, {"hwp2_axis": ()}))
    at = product.model.index("hwp2_axis.angle")
    assert product.values[at] == pytest.approx(value, abs=0.1 * error)
    assert np.sqrt(product.covariance[at, at]) < 3.0 * error


def test_members_that_say_a_name_in_other_words_move_its_parameter(turned):
    """A member that turns the plate by b, as probable as the fit: a ± s. The angle is ½ (a + b), all else as it was.

    By the law of total variance its variance is ½ s² + ½ t² + ¼ (a − b)².
    """
    fit, text = turned.result, "axis of half2.plate"
    a, s = fit.value("hwp2_axis.angle")
    b, t, zero = 0.05, 0.001, np.zeros(len(fit.model.free))
    at = turned.design.columns_of(fit.model.positions("hwp2_axis"))
    back = zero.copy()
    back[at] = -a
    sums = (((1.0, Change.parsed(text)),),)
    none = np.zeros((len(fit.calset.points), 6))
    members = (
        Answer("hwp2_axis", 0.0, sums, none, probability=0.5),
        Answer(text, 0.0, sums, none, np.array([b]), np.array([[t**2]]), back, np.zeros((len(zero), 1)), 0.5),
    )
    alone = Calibration.from_fit(fit.with_verdict())
    product = averaged(alone, Questions(additions=(OpenQuestion("hwp2_axis", at, members, 0.0, 0.0, 0.0),)))
    assert product.model.names == alone.model.names
    place = product.model.index("hwp2_axis.angle")
    assert product.values[place] == pytest.approx(0.5 * (a + b), rel=1e-12)
    variance = 0.5 * (s**2 + t**2) + 0.25 * (a - b) ** 2
    assert product.covariance[place, place] == pytest.approx(variance, rel=1e-9)
    others = np.arange(len(product.values)) != place
    np.testing.assert_array_equal(product.values[others], alone.values[others])


def test_a_member_whose_amplitude_is_beyond_its_prior_is_no_explanation():
    """A diattenuation along the analyser is a gain: as a leak of 0.1 % it would have to be 20 times that, and more.

    (1 + η d, η + d): the efficiency seems to change by d (1 − η²), and first order ends long before such a d.
    """
    leak = "light of E1 in O1"
    rival = "diattenuation q behind half1.plate; diattenuation u behind half1.plate"
    calset = set_with(4, {leak: 1e-3})
    result = fit_with(calset, Described.saying([leak], [1e-3]))
    state = examined_with(result, (leak, rival).__contains__)
    assert {leak, rival} <= {probe.name for probe in state.descriptions}
    classes = ambiguities(state, {leak: [rival]})
    assert [m.name for added in classes.additions for m in added.members] == []
    alone = Calibration.from_fit(result.with_verdict())
    product = averaged(alone, classes)
    here = [c.matrix(calset.points.x, calset.points.y)[0] for c in (alone, product)]
    np.testing.assert_allclose(here[1], here[0], atol=1e-4)


RIVAL = "gain of O1 * hours"


@pytest.fixture(scope="module")
def spotted():
    """The fit of a set and a model with a spot, asked for a rival that is none."""
    spot = Blemish.of(SMALL.context(), x=0.1, y=0.05, size=0.1, depth=0.02)
    calset = simulate(SMALL, seed=5, effects=[spot]).calset
    return examined_with(fit_with(calset, spot), RIVAL.__eq__)


def test_what_cannot_be_told_from_one_addition_is_no_member_of_the_class_of_another(spotted):
    """A retardance that lens birefringence may be explains no spot."""
    assert ambiguities(spotted, {"blemish": (), "lens_birefringence": [RIVAL]}).additions == ()


def test_the_mean_over_a_class_keeps_the_shape_of_a_spot(spotted, monkeypatch):
    """Without the spot its depth is 0, and not its size. Fits chose the spot: no member is more probable."""
    monkeypatch.setattr(LinearisedFit, "raised", lambda laid, evidence, best: max(evidence, best))
    result = spotted.result
    (spots,) = ambiguities(spotted, {"blemish": [RIVAL]}).additions
    assert spots.members[0].probability >= spots.members[1].probability
    product = averaged(Calibration.from_fit(result.with_verdict()), Questions(additions=(spots,)))
    values = dict(zip(product.model.names, product.values, strict=True))
    fitted = dict(zip(result.model.names, result.values, strict=True))
    for shape in ("blemish.x", "blemish.y", "blemish.size"):
        assert values[shape] == fitted[shape]
    weight = spots.members[0].probability
    assert values["blemish.depth"] == pytest.approx(weight * fitted["blemish.depth"], rel=1e-9)


def test_what_the_model_has_beside_an_addition_does_not_replace_it():
    """Two things are there. "Without the first, and nothing in its place" is no explanation, whatever was reported."""
    first, second = "gain of O1 * kind moon", "gain of O2 * hours"
    result = fit_with(set_with(3, {first: 3e-3, second: 3.4e-3}), first, second)
    state = examined_with(result, (first, second).__contains__)
    groups = {first: (second,), second: (first,)}
    (moon,) = ambiguities(state, groups).additions
    assert [m.name for m in moon.members] == [first, "gain of O1 * kind clp; gain of O1 * kind standard"]
    assert [m.probability for m in moon.members] == pytest.approx([0.5, 0.5])
    # What the model had before is not in question.
    assert ambiguities(state, {second: ()}, given=[first]).additions == ()


def test_a_time_that_is_the_time_of_one_kind_may_be_that_kind():
    """All exposures of standards are the last ones: a step in time, or standards, or all others the other way."""
    calset = set_with(3, {"gain of O1 * kind standard": 3e-3})
    e = calset.exposures
    hours = 24.0 * (e.mjd - e.mjd.min())
    start = 0.5 * (hours[e.kind == "standard"].min() + hours[e.kind != "standard"].max())
    text = f"gain of O1 * {grammar.between(start, grammar.end_of(e))}"
    state = examined_with(fit_with(calset, text), "gain of O1 * kind standard".__eq__)
    (found,) = ambiguities(state, {text: ()}).additions
    assert [m.name for m in found.members] == [text, "gain of O1 * kind clp; gain of O1 * kind moon"]
    assert found.members[1].probability == pytest.approx(0.5, abs=0.05)


def test_a_time_that_is_the_time_of_two_kinds_may_be_that_of_the_third():
    """Moon and standards are the last exposures: from their time on, or in those of the polariser the other way."""
    calset = set_with(3, {"gain of O1 * kind clp": -3e-3})
    e = calset.exposures
    hours = 24.0 * (e.mjd - e.mjd.min())
    start = 0.5 * (hours[e.kind == "clp"].max() + hours[e.kind != "clp"].min())
    assert start > hours[e.kind == "clp"].max()
    text = f"gain of O1 * {grammar.between(start, grammar.end_of(e))}"
    state = examined_with(fit_with(calset, text))
    (found,) = ambiguities(state, {text: ()}).additions
    assert {m.name: m.probability for m in found.members} == pytest.approx(
        {text: 0.5, "gain of O1 * kind clp": 0.5}, abs=0.05
    )


def test_the_other_kinds_are_as_probable_whatever_the_size():
    """An amplitude of five prior widths has a wider prior: the same one in the other exposures has that too."""
    text = "gain of O1 * kind standard"
    for size in (8e-3, 1.5e-2, 4e-2):
        result = settled(fit_with(set_with(3, {text: size}), text), [Described.name])
        state = examined_with(result, lambda name: name.startswith("gain of O1"))
        (found,) = ambiguities(state, {text: ()}).additions
        sides = {m.name: m.probability for m in found.members}
        assert sides["gain of O1 * kind clp; gain of O1 * kind moon"] == pytest.approx(sides[text])


def test_what_standards_show_of_the_sky_ahead_may_be_there_for_stars():
    """Light of standards is changed ahead of the polariser by 4·10⁻³: stars that are seen alike have it, or have not.

    Their mean is half of it, and half of it is the error: M21 of a star by −0.5 · 4·10⁻³ (1 − M21²) to first order.
    """
    text = "diattenuation q ahead of polariser * kind standard"
    result = fit_with(set_with(3, {text: 4e-3}), text)
    state = examined_with(result, lambda name: name == text)
    (found,) = ambiguities(state, {text: ()}).additions
    sides = {m.name: m for m in found.members}
    with_stars = sides[f"{text}, and of stars"]
    assert with_stars.probability == pytest.approx(sides[text].probability)
    assert found.spread > 1e-3
    assert any("only a class of causes" in one for one in only_a_class(Questions(additions=(found,))))
    alone = Calibration.from_fit(result.with_verdict())
    product = averaged(alone, Questions(additions=(found,)))
    x, y = np.array([0.1, -0.2]), np.array([0.05, 0.2])
    (m, c), (one, within) = product.matrix(x, y), alone.matrix(x, y)
    moved, error = (
        np.abs(m - one)[:, :3].max(axis=1),
        np.sqrt(np.abs(np.diagonal(c - within, axis1=1, axis2=2))),
    )
    np.testing.assert_allclose(moved, error[:, :3].max(axis=1), rtol=0.1)
    assert moved == pytest.approx(2e-3, rel=0.3)


def test_the_product_is_read_as_it_was_written(told, tmp_path):
    from walop_jax.calibration.product import write_calibration

    result, classes = told
    product = averaged(Calibration.from_fit(result.with_verdict()), classes)
    write_calibration(tmp_path / "calibration.fits", product)
    again = Calibration.read(tmp_path / "calibration.fits")
    assert again.content_hash() == dataclasses.replace(product, path=None).content_hash()
    here = product.matrix(0.1, 0.1), again.matrix(0.1, 0.1)
    for ours, theirs in zip(*here, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-15)


def test_a_mean_over_a_class_is_not_made_anew_as_one_fit(tmp_path):
    """Nothing can be sampled around it: the advice is the fit of the model that comes with it."""
    entry = {"added": TOLD, "members": [{"name": TOLD, "probability": 0.5}]}
    (tmp_path / "diagnosis.json").write_text(json.dumps({"members": [entry]}))
    with pytest.raises(DataError, match=r"mean over .* refit --model .*model\.toml"):
        Run(tmp_path).fit()
