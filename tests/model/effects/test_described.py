"""Changes do what effects of the catalogue do that are known by another name, and what Mueller algebra says."""

import dataclasses
import itertools
import json
from types import SimpleNamespace

import builders
import effect_scenes as scenes
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm, expm_frechet

from walop_jax.fit.model_file import model_without_data, render
from walop_jax.model import light, mueller
from walop_jax.model.compiled import compiled
from walop_jax.model.conventions import OF_WALOP
from walop_jax.model.dependence import is_undone, left_behind
from walop_jax.model.effects import Change, Described, effect_by_name
from walop_jax.model.effects.change import AMPLITUDES, KINDS
from walop_jax.model.effects.factors import PLAIN, factor
from walop_jax.model.effects.in_models import with_effects
from walop_jax.model.effects.optics import ADDED, GENERATORS, generator, matrix_of
from walop_jax.model.elements.simple import AddedPolarisation
from walop_jax.model.instrument import nominal_instrument
from walop_jax.model.parameters import NAME
from walop_jax.model.planning import exposure_arrays
from walop_jax.model.ray import Ray
from walop_jax.model.sources import PointIllumination
from walop_jax.model.specification import make_model


def said(*sentences, values):
    return Described.saying(sentences, values)


def named(name, **values):
    return effect_by_name(name).of(scenes.CONTEXT, **values)


# What the catalogue says in other words; most of its entries are these very sentences.
SAME = {
    "encoder": (("turn of polariser * sin 1 CLP", "turn of polariser * cos 1 CLP"),
        [0.1 * np.cos(0.7), -0.1 * np.sin(0.7)], ("clp_wobble", {"amplitude": 0.1, "phase": 0.7})),
    "analysers": (("retardance v behind half1.plate", "retardance v behind half2.plate"),
        2.0 * np.deg2rad([0.3, 0.3]), ("wollaston_axis", {"angle": 0.3})),
    "drift": (("gain of E1 * hours",), [0.002], ("camera_gain_drift", {"rate": 0.002, "camera": 1})),
    "leakage": (("light of E1 in O1", "light of O1 in E1", "light of E2 in O2", "light of O2 in E2"),
        [0.003] * 4, ("camera_leakage", {"share": 0.003})),
    "fringes": (tuple(f"fringes of {name} * gap 10" for name in ("chwp", "half1.plate", "half2.plate")),
        [0.003] * 3, ("etalon", {"contrast": 0.003, "gap": 10.0})),
}  # fmt: skip


EVERY_SENTENCE = tuple(dict.fromkeys(sentence for sentences, *_ in SAME.values() for sentence in sentences))
EVERY_NAME = {name: parameters for *_, (name, parameters) in SAME.values()}


IN_VAIN = (
    ("axis of half1.plate", "sin 2 CHWP"),  # not an element whose angle it knows
    ("axis of chwp", "exposure 3"),
    ("retardance q behind collimator", "order"),
    ("retardance q behind collimator", "cos 2 CLP"),
    ("retardance q behind collimator", "counts"),
    ("turn of polariser", "colour"),
    ("displacement x ahead of pupil", "sin 1 CLP"),
    ("extinction of polariser", "x"),
    ("shift of band", "hours"),
    ("rotator of sky", "hours"),
    ("polarisation of sky", "x"),
    ("fringes of half1.plate * gap 10", "hours"),
    ("light of E1 in O1", "counts"),
    ("light of opposite in O1", "x"),
    ("light of opposite in O1", "hours"),
    ("light in O1", "colour"),
    ("afterglow in O1", "counts"),
    ("reported gain of O1", "counts"),
)


def test_depolarisation_of_a_stokes_parameter():
    """diag(1, 1 − a, 1 − b, 1 − c), and the same of all three; ahead of the retarder it is another product."""
    kinds = [Change(f"depolarisation {axis}", "of", "plate") for axis in "quv"]
    shares = jnp.array([0.1, 0.02, 0.3])
    found = matrix_of(list(zip(kinds, shares, strict=True)), 0.0, 0.0)
    np.testing.assert_allclose(found, np.diag([1.0, 0.9, 0.98, 0.7]), atol=1e-15)
    every = matrix_of([(Change("depolarisation", "of", "plate"), jnp.asarray(0.2))], 0.0, 0.0)
    np.testing.assert_allclose(every, np.diag([1.0, 0.8, 0.8, 0.8]), atol=1e-15)
    turn = Change("retardance v", "of", "plate")
    both = matrix_of([(kinds[0], shares[0]), (turn, jnp.asarray(0.5 * np.pi))], 0.0, 0.0)
    along_q, along_u = both @ jnp.array([1.0, 1.0, 0.0, 0.0]), both @ jnp.array([1.0, 0.0, 1.0, 0.0])
    assert np.linalg.norm(along_q[1:]) == pytest.approx(1.0)  # turned to u before q is lost
    assert np.linalg.norm(along_u[1:]) == pytest.approx(0.9)


@pytest.mark.parametrize("kind", GENERATORS)
def test_generators_are_the_slopes_of_their_matrices(kind):
    change = Change(kind, "of", "plate")
    slope = jax.jacfwd(lambda size: matrix_of([(change, size)], 0.0, 0.0))(0.0)
    np.testing.assert_allclose(generator(kind), slope, atol=1e-15)


@pytest.mark.parametrize("kind", ADDED)
def test_generators_of_added_polarisation_are_the_slopes_of_its_matrix(kind):
    def matrix(size):
        added = AddedPolarisation(name="added", q=jnp.zeros(()), u=jnp.zeros(()))
        return dataclasses.replace(added, **{kind[-1]: size}).mueller(Ray.on_trial(()))

    np.testing.assert_allclose(generator(kind), jax.jacfwd(matrix)(jnp.zeros(())), atol=1e-15)


@pytest.mark.parametrize(("change", "factor"), IN_VAIN)
def test_factors_that_would_be_left_out_are_refused(change, factor):
    with pytest.raises(ValueError, match=f"cannot grow with '{factor}'"):
        said(f"{change} * {factor}", values=[0.1]).patch(nominal_instrument())


@pytest.mark.parametrize(
    ("factor", "share"),
    [
        ("kind moon", [0, 0, 0, 0, 1, 1, 0, 0, 0]),
        ("kind standard", [0, 0, 0, 0, 0, 0, 1, 1, 0]),
        ("per EXPTIME", [1 / 30] * 9),
        ("hours", [0, 1.2, 1.2, 1.2, 2.4, 2.4, 2.4, 2.4, 2.4]),
    ],
)
def test_optics_follow_the_exposures(factor, share):
    """An element that depends on the list acts in every exposure as a steady one of that size does."""
    sentence, size = "retardance q behind collimator", 0.3
    found = scenes.observe(said(f"{sentence} * {factor}", values=[size]))
    hours = 24.0 * (scenes.EXPOSURES.mjd - scenes.EXPOSURES.mjd.min())
    share = hours if factor == "hours" else np.array(share, float)
    steady = {s: scenes.observe(said(sentence, values=[size * s])) for s in np.unique(share)}
    expected = np.stack([steady[s][:, number] for number, s in enumerate(share)], axis=1)
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    assert np.abs(found / scenes.observe() - 1.0).max() > 1e-4


def test_a_kind_of_exposures_that_is_none_is_refused():
    with pytest.raises(ValueError, match="no KIND of exposures 'mon'; did you mean 'moon'"):
        said("gain of O1 * kind mon", values=[0.1]).patch(nominal_instrument())


def in_company(case):
    """The sentences of a case among all others, which have no size, and its name among all others at neutral.

    One compilation serves all cases so.
    """
    sentences, values, (name, parameters) = SAME[case]
    sizes = dict.fromkeys(EVERY_SENTENCE, 0.0) | dict(zip(sentences, values, strict=True))
    ours = (said(*sizes, values=list(sizes.values())),)
    made = {other: named(other, **like) for other, like in EVERY_NAME.items()}
    others = {other: effect.at_neutral(scenes.CONTEXT) for other, effect in made.items()}
    return ours, tuple((others | {name: named(name, **parameters)}).values()), tuple(others.values())


@pytest.mark.parametrize("alone", [False, pytest.param(True, marks=pytest.mark.long)])
@pytest.mark.parametrize("case", SAME)
def test_the_same_by_another_name(case, alone):
    """Exactly, but for what two shares of light copied back and forth make of each other."""
    sentences, values, (name, parameters) = SAME[case]
    ours, theirs, neutral = in_company(case)
    if alone:
        ours, theirs = (said(*sentences, values=values),), (named(name, **parameters),)
    ours, theirs = scenes.observe(*ours), scenes.observe(*theirs)
    change = np.abs(theirs - scenes.observe(*neutral)).max()
    assert change > 1.0
    # Two programs of all effects round the counts differently, of which the change is a small part.
    rounding = 0.0 if alone else 1e-12 * scenes.FLUX
    assert np.abs(ours - theirs).max() < (0.01 if case == "leakage" else 1e-9) * change + rounding


FIRST_ORDER = {
    "telescope": ("diattenuation q ahead of polariser", 1.0, ("telescope_polarisation", "q")),
    "circular": ("diattenuation v of polariser", 1.0, ("clp_ellipticity", "v")),
    "lenses": ("retardance radial behind collimator", 2.0 * np.pi, ("lens_birefringence", "delta")),
}


@pytest.mark.parametrize("case", FIRST_ORDER)
def test_the_same_to_first_order(case):
    """A mirror takes as much of one polarisation as it adds of the other: that shows in the sky, polarised by 10 %."""
    sentence, factor, (name, parameter) = FIRST_ORDER[case]
    small = 1e-4

    def slope(effect_of):
        up, down = (scenes.observe(effect_of(s * small)) for s in (1, -1))
        return (up - down).ravel()

    ours = slope(lambda a: said(sentence, values=[factor * a]))
    theirs = slope(lambda a: named(name, **{parameter: a}))
    rest = ours - theirs * (ours @ theirs) / (theirs @ theirs)
    assert np.linalg.norm(rest) < (0.12 if case == "telescope" else 1e-2) * np.linalg.norm(ours)
    assert ours @ theirs > 0.98 * theirs @ theirs


def test_every_kind_is_there():
    assert {Change.parsed(text).kind for text in scenes.EVERY_CHANGE} == {*KINDS}


def test_neutral_and_derivatives_of_every_change():
    """At zero nothing happens; each does something, in proportion: forward derivative = central difference."""
    layout = scenes.plan([said(*scenes.EVERY_CHANGE, values=[0.0] * len(scenes.EVERY_CHANGE))])
    data = scenes.points(layout)
    width = np.array([AMPLITUDES[Change.parsed(text).parameter].width for text in scenes.EVERY_CHANGE])

    def counts(amplitudes):
        zero = said(*scenes.EVERY_CHANGE, values=[0.0] * len(scenes.EVERY_CHANGE))
        held = {name: [] for name in AMPLITUDES}
        for i, text in enumerate(scenes.EVERY_CHANGE):
            held[Change.parsed(text).parameter].append(amplitudes[i])
        effect = dataclasses.replace(zero, **{name: jnp.stack(values) for name, values in held.items()})
        return scenes.counts(scenes.instrument(effect), layout, data)

    step = 1e-3 * np.diag(width)
    at = jnp.asarray(np.concatenate([np.zeros((1, len(width))), step, -step]))
    values, slope = compiled(lambda a: (jax.lax.map(counts, a), jax.jacfwd(counts)(a[0])))(at)
    without = scenes.observe(plan_of=[said(*scenes.EVERY_CHANGE, values=[0.0] * len(scenes.EVERY_CHANGE))])
    assert np.abs(np.asarray(values[0]) - without).max() < 1e-12 * scenes.FLUX
    plus, minus = np.split(np.asarray(values[1:]), 2)
    for i, text in enumerate(scenes.EVERY_CHANGE):
        derivative = np.asarray(slope[..., i]) * width[i]
        assert np.abs(derivative / without).max() > 1e-6, f"{text} does nothing"
        difference = (plus[i] - minus[i]) / 2e-3
        assert np.abs(difference - derivative).max() < 1e-5 * np.abs(derivative).max(), text


def test_labels_are_the_descriptions():
    effect = said("depolarisation behind chwp * kelvin", values=[0.0])
    assert effect.labels("share") == ["depolarisation_behind_chwp_*_kelvin"]


def test_factors_grow_as_they_say():
    """Twice the field coordinate, twice the effect; a gain in one exposure is a gain in that one alone."""
    plain, wide = (
        scenes.observe(said(s, values=[1e-5])) - scenes.observe()
        for s in ("turn of polariser", "turn of polariser * x")
    )
    assert wide == pytest.approx(plain * (scenes.X / 0.3)[:, None, None], rel=1e-4, abs=1e-6)
    one = scenes.observe(said("gain of O2 * exposure 3", values=[0.01])) / scenes.observe()
    assert one[:, 3, 2] == pytest.approx(1.01)
    assert np.delete(one.reshape(2, -1), 3 * 4 + 2, axis=1) == pytest.approx(1.0)
    ring = scenes.observe(said("gain of half1 * ring 3", values=[0.01])) / scenes.observe()
    t = (scenes.X**2 + scenes.Y**2) / 0.09 - 1.0
    assert ring[:, 0, :2] == pytest.approx((1 + 0.01 * (5 * t**3 - 3 * t) / 2)[:, None] * np.ones(2))
    assert ring[..., 2:] == pytest.approx(1.0)


def test_general_matrices_are_those_of_one_axis():
    delta, none = jnp.asarray(0.3), jnp.asarray(0.0)
    for axis, at in (
        (0.0, (0.3, 0.0)),
        (np.pi / 4, (0.0, 0.3)),
        (0.2, (0.3 * np.cos(0.4), 0.3 * np.sin(0.4))),
    ):
        ours = mueller.general_retarder(*map(jnp.asarray, at), none)
        assert np.asarray(ours) == pytest.approx(
            np.asarray(mueller.retarder(delta, jnp.asarray(axis))), abs=1e-15
        )
    ours = mueller.general_retarder(none, none, delta)
    assert np.asarray(ours) == pytest.approx(np.asarray(mueller.rotation(delta / 2)), abs=1e-15)


@pytest.mark.parametrize(
    "vector", [(0.3, -0.2, 0.5), (3e-4, 5e-4, -6e-4), (1e-9, 0.0, 2e-9), (0.0, 0.0, 0.0)]
)
def test_an_elliptical_retarder_is_the_exponential_of_its_generator(vector):
    """Against scipy's matrix exponential, with its derivatives, on either side of where the series is used."""
    q, u, v = vector

    def generator(q, u, v):
        return np.array([[0, 0, 0, 0], [0, 0, v, -u], [0, -v, 0, q], [0, u, -q, 0]], float)

    ours = mueller.general_retarder(*map(jnp.asarray, vector))
    assert np.asarray(ours) == pytest.approx(expm(generator(q, u, v)), abs=1e-15)
    slopes = jax.jacfwd(lambda r: mueller.general_retarder(*r))(jnp.asarray(vector))
    for i, along in enumerate(np.eye(3)):
        expected = expm_frechet(generator(q, u, v), generator(*along), compute_expm=False)
        assert np.asarray(slopes[..., i]) == pytest.approx(expected, abs=1e-14)


def test_light_of_another_camera_that_differs_over_the_field_and_between_exposures():
    """N_O1 → N_O1 + a f N_E1 by hand, f = X/h for a steady fraction, and X/h times the hours for one that grows."""
    bare, hours = scenes.observe(), scenes.EXPOSURES.mjd - scenes.EXPOSURES.mjd.min()
    of_field = np.asarray(scenes.X)[:, None] / 0.3
    for factors, expected in (("x", of_field), ("hours * x", of_field * 24.0 * hours)):
        counts = scenes.observe(said(f"light of E1 in O1 * {factors}", values=[0.02]))
        np.testing.assert_allclose(counts[..., 0], bare[..., 0] + 0.02 * expected * bare[..., 1], rtol=1e-12)
        np.testing.assert_array_equal(counts[..., 1:], bare[..., 1:])


def test_what_cannot_be_carried_over_is_said():
    assert left_behind(scenes.instrument(said("gain of O1 * hours", values=[0.0]))) == ("described",)
    assert left_behind(scenes.instrument(said("afterglow in O1", values=[0.0]))) == ("described",)
    assert left_behind(scenes.instrument(said("light of E1 in O1 * r2", values=[0.0]))) == ()
    assert left_behind(scenes.instrument(said("light of E1 in O1 * hours", values=[0.0]))) == ("described",)
    both = said("reported gain of O1", "light of E2 in O2 * hours", values=[0.1, 0.1])
    parts = scenes.instrument(both).patched().cameras.detectors
    assert [is_undone(part, 4) for part in parts] == [True, False], (
        "catalogues are corrected for the gain all the same"
    )
    assert left_behind(scenes.instrument(said("retardance q behind collimator * r2", values=[0.0]))) == ()
    assert left_behind(scenes.instrument(said("gain of half1 * ring 4", values=[0.0]))) == ()
    assert left_behind(scenes.instrument(said("gain of half1 * root counts * x", values=[0.0]))) == ()
    assert left_behind(scenes.instrument(said("gain of half1 * counts * hours", values=[0.0]))) == (
        "described",
    )
    assert left_behind(scenes.instrument(said("light of opposite in O1", values=[0.0]))) == ("described",)
    assert left_behind(scenes.instrument(said("displacement x ahead of pupil", values=[0.0]))) == ()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("retardence q behind collimator", "cannot read"),
        ("turn of polariser * z", "there is no factor 'z'"),
        ("gain of O3", "did you mean 'O2'"),
        ("polarisation q of sky", "state the exposure"),
        ("polarisation q of green_star", "did you mean 'polarisation q of"),
        ("polarisation of blue_star", "there is no description 'polarisation of blue_star'"),
        ("fringes of half1.plate", "state the gap"),
        ("shift of filter", "there is no place of shift 'filter'"),
        ("light of E1 in half2", "one camera and another one"),
        ("light of half1 in O2 * hours", "one camera and another one"),
        ("light of E1 in E1", "one camera and another one"),
    ],
)
def test_what_is_no_sentence_is_an_error(text, message):
    with pytest.raises(ValueError, match=message):
        scenes.observe(said(text, values=[0.1]))


def test_sentences_are_read_as_they_are_written():
    for text in (
        "light of E1 in O1",
        "retardance v behind half1.plate * hours * x",
        "gain of O1 * hours 3 to 20.5",
        "light of opposite in O1",
        "displacement x ahead of pupil * hour angle",
        "fringes of half1.plate * gap 10.0775",
        "polarisation q of sky * exposure 17",
    ):
        assert Change.parsed(text).text == text
    assert Change.parsed("turn of polariser * sin 2 CLP").in_words() == (
        "turn of polariser, as the sine of 2 × the angle of CLP"
    )


def test_every_kind_with_every_factor_is_a_parameter_name():
    plain = (*PLAIN, "ring 3", "cos 2 CLP", "sin 1 CHWP", "hours -0.5 to 20.5", "exposure 12", "gap 10.0775")
    for kind, one in itertools.product(KINDS, plain):
        description = Change(kind, "behind", "half1.plate", (one, "x"), "O1")
        assert Change.parsed(description.text) == description
        assert NAME.fullmatch(f"described.{description.label}")


def test_a_model_file_carries_sentences():
    """What `diagnose` writes is what `--model` reads: the sentences, their values and priors."""
    said = ["turn of polariser * x", "light of O2 in O1", "retardance q behind half1.plate * hours"]
    text = f'[model]\neffects = ["described"]\n[effects.described]\nsentences = {json.dumps(said)}\n'
    model = model_without_data("WALOP-SOUTH", text)
    name = "described.turn_of_polariser_*_x"
    assert model[name].unit == "deg"
    assert model[name].prior == (0.0, 0.1)
    moved = model.change(name, start=0.02)
    again = model_without_data("WALOP-SOUTH", render(moved))
    assert again.names == moved.names
    assert again[name].start == 0.02
    assert again.template.effect("described").sentences == tuple(said)


def test_factors_of_single_exposures_by_hand():
    """Exposure times, the order, and the side from which an element came, in the order of time."""
    at = SimpleNamespace(
        exptime=np.array([3.0, 10.0, 0.0]),
        number=np.arange(3),
        hours=np.array([0.0, 2.0, 1.0]),
        angle=lambda prefix: np.deg2rad([350.0, 10.0, 20.0]),
    )
    np.testing.assert_allclose(factor("per EXPTIME").value(at, OF_WALOP), [1 / 3, 0.1, 0.0])
    np.testing.assert_allclose(factor("order").value(at, OF_WALOP), [0, 1, 2])
    nights = SimpleNamespace(hours=np.array([25.5, 0.0, 24.0, 3.0, 49.0]))
    np.testing.assert_allclose(factor("night hours").value(nights, OF_WALOP), [1.5, 0.0, 0.0, 3.0, 0.0])
    traced = SimpleNamespace(hours=jnp.asarray(nights.hours))
    np.testing.assert_allclose(factor("night hours").value(traced, OF_WALOP), [1.5, 0.0, 0.0, 3.0, 0.0])
    # 350° → 20° upward through 0, then 20° → 10° downward.
    np.testing.assert_allclose(factor("side CLP").value(at, OF_WALOP), [0, -1, 1])


@pytest.mark.parametrize(
    "given",
    ["hours", "hours 0 to 2", "exposure 3", "kind moon", "side CLP", "order", "night hours", "per EXPTIME"],
)
def test_a_change_in_single_exposures_is_not_known_for_stars(given):
    assert Change.parsed("gain of O1").applies_to_catalogue
    assert not Change.parsed(f"gain of O1 * {given}").applies_to_catalogue


def test_polarisation_that_a_telescope_adds_grows_with_time_in_light_from_the_sky_alone():
    """(0, a h, 0, 0) per unit of light of the Moon after h hours; light through the polariser and stars have none."""
    bare = nominal_instrument("WALOP-SOUTH")
    said = Described.saying(["added polarisation q ahead of polariser * hours"], [1e-3])
    exposures = exposure_arrays(
        builders.exposures(
            {"kind": "moon", "mjd": 61000.0},
            {"kind": "moon", "mjd": 61000.0 + 2 / 24},
            {"clp_angle": 30.0, "mjd": 61000.0 + 3 / 24},
        ),
        bare.kinds,
        (),
    )
    illumination = PointIllumination(
        exposures, jnp.zeros((3, 2)), jnp.full(3, -1), jnp.asarray(0.1), jnp.asarray(0.0)
    )
    with_it, without = (
        np.asarray(light.stokes(dataclasses.replace(bare, effects=effects), illumination))
        for effects in ((said,), ())
    )
    np.testing.assert_allclose(with_it - without, [[0] * 4, [0, 2e-3, 0, 0], [0] * 4], atol=1e-15)
    there = dataclasses.replace(bare, effects=(said,))
    zero = jnp.asarray(0.0)
    np.testing.assert_array_equal(light.telescope(there, zero, zero), light.telescope(bare, zero, zero))
    assert left_behind(there) == ("described",)


@pytest.mark.parametrize("name", ["described", "deviations", "other_description"])
def test_an_effect_that_would_change_nothing_is_refused(name):
    """By its name alone it has nothing to change: it would be listed, and nothing be fitted."""
    message = rf"effect '{name}' changes nothing unless it is said what it changes: .*\[effects\.{name}\]"
    for given in (name, effect_by_name(name)):
        with pytest.raises(ValueError, match=message):
            with_effects(make_model("SOUTH", nominal_instrument()), [given], scenes.CONTEXT)
    with pytest.raises(ValueError, match=message):
        model_without_data("WALOP-SOUTH", f'[model]\neffects = ["{name}"]\n')
