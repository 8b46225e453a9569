"""The fold of a train against a product of Mueller matrices, written out here in numpy, loop by loop."""

from __future__ import annotations

import dataclasses
import itertools

import builders
import jax.numpy as jnp
import numpy as np
import pytest
from quick import quick

from walop_jax.data.records import Exposures, Position
from walop_jax.instruments.description import parsed
from walop_jax.model import light
from walop_jax.model.instrument import Instrument, build
from walop_jax.model.planning import plan_for

# Three arms, seven elements that are not the identity, three of which move: one of two ahead of the arms is
# leading (achromatic and at rest), another moves, a third depends on wavelength; the third arm has one of its own.
THREE_ARMS = """
name = "THREE-ARMS"
path = ["polariser", "lens", "turning", "window", "plate"]
[field]
[cameras]
names = ["a", "b", "c", "d", "e", "f"]
[throughput]
degree = 0
level = 1.0
[elements.polariser]
kind = "polariser"
moves = "CLP"
[elements.lens]
kind = "diattenuator"
q = 0.03
u = -0.02
[elements.turning]
kind = "retarder"
moves = "DEROT"
delta = 2.0
wavelength = 0.6
axis = 5.0
[elements.window]
kind = "retarder"
delta = 0.4
wavelength = 0.7
axis = 70.0
[elements.plate]
kind = "retarder"
moves = "CHWP"
delta = 3.0
wavelength = 0.62
[arms.first]
path = ["analyser"]
[arms.first.elements.analyser]
kind = "analyser"
cameras = ["a", "b"]
efficiency = 0.99
[arms.second]
path = ["half", "haze", "analyser"]
[arms.second.elements.half]
kind = "retarder"
delta = 3.1
wavelength = 0.62
axis = 22.5
[arms.second.elements.haze]
kind = "depolariser"
linear = 0.05
circular = 0.1
[arms.second.elements.analyser]
kind = "analyser"
cameras = ["d", "c"]
efficiency = 0.98
angle = 3.0
[arms.third]
path = ["tilt", "fourth", "analyser"]
[arms.third.elements.tilt]
kind = "diattenuator"
moves = "TILT"
q = 0.1
u = 0.04
axis = 11.0
[arms.third.elements.fourth]
kind = "retarder"
delta = 1.3
axis = 40.0
[arms.third.elements.analyser]
kind = "analyser"
cameras = ["e", "f"]
efficiency = 0.97
"""
PREFIXES = ("CHWP", "DEROT", "TILT")
LINES = (0.58, 0.62, 0.66)
WEIGHTS = (0.5, 1.0, 0.25)


# --------------------------------------------------------------------------------- the train, written out


def rotated(matrix, degrees):
    """The element turned by an angle: R(−a) M R(a)."""
    c, s = np.cos(2 * np.deg2rad(degrees)), np.sin(2 * np.deg2rad(degrees))
    turn = np.array([[1, 0, 0, 0], [0, c, s, 0], [0, -s, c, 0], [0, 0, 0, 1]])
    return turn.T @ matrix @ turn


def retarder(delta, axis):
    """Fast axis along +X: u and v turn into each other, M_uv = + sin δ."""
    c, s = np.cos(delta), np.sin(delta)
    return rotated(np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, c, s], [0, 0, -s, c]]), axis)


def diattenuator(q, u, axis=0.0):
    """Along its own axis [[1, D], [D, 1]] and √(1 − D²) for the rest; turned to where (q, u) points."""
    d, own = np.hypot(q, u), 0.5 * np.rad2deg(np.arctan2(u, q))
    r = np.sqrt(1 - d**2)
    return rotated(np.array([[1, d, 0, 0], [d, 1, 0, 0], [0, 0, r, 0], [0, 0, 0, r]]), own + axis)


def element(name, wavelength, angle=0.0):
    """Mueller matrix of an element of `THREE_ARMS` that is turned by an angle."""
    return {
        "lens": lambda: diattenuator(0.03, -0.02),
        "turning": lambda: retarder(2.0 * 0.6 / wavelength, 5.0 + angle),
        "window": lambda: retarder(0.4 * 0.7 / wavelength, 70.0),
        "plate": lambda: retarder(3.0 * 0.62 / wavelength, angle),
        "half": lambda: retarder(3.1 * 0.62 / wavelength, 22.5),
        "haze": lambda: np.diag([1.0, 0.95, 0.95, 0.9]),
        "tilt": lambda: diattenuator(0.1, 0.04, 11.0 + angle),
        "fourth": lambda: retarder(1.3, 40.0),
    }[name]()


MOVES = {"turning": "DEROT", "plate": "CHWP", "tilt": "TILT"}
ARMS = {
    ("a", "b"): ((), 0.99, 0.0),
    ("d", "c"): (("half", "haze"), 0.98, 3.0),
    ("e", "f"): (("tilt", "fourth"), 0.97, 0.0),
}


def expected_vectors(positions, common=("lens", "turning", "window", "plate"), arms=ARMS):
    """Analysis vectors of cameras a … f: band average of ½ (1, ± η cos 2α, ± η sin 2α, 0) times the product."""
    vectors = np.zeros((6, 4))
    for (plus, minus), (own, eta, alpha) in arms.items():
        for wavelength, weight in zip(LINES, np.array(WEIGHTS) / sum(WEIGHTS), strict=True):
            matrix = np.eye(4)
            for name in (*common, *own):
                angle = positions[MOVES[name]] if name in MOVES else 0.0
                if angle is not None:
                    matrix = element(name, wavelength, angle) @ matrix
            c, s = np.cos(2 * np.deg2rad(alpha)), np.sin(2 * np.deg2rad(alpha))
            for camera, sign in ((plus, 1.0), (minus, -1.0)):
                beam = 0.5 * np.array([1.0, sign * eta * c, sign * eta * s, 0.0])
                vectors["abcdef".index(camera)] += weight * beam @ matrix
    return vectors


# ------------------------------------------------------------------------------------- and as it is folded


def exposures(states: list[dict[str, float | None]]) -> Exposures:
    rows = [{"chwp_angle": s["CHWP"]} if s["CHWP"] is not None else {} for s in states]
    moving = {}
    for prefix in PREFIXES[1:]:
        angle = np.array([np.nan if s[prefix] is None else s[prefix] for s in states])
        moving[prefix] = Position(np.isfinite(angle), angle)
    return builders.exposures(*rows).placed(**moving)


def found_vectors(instrument: Instrument, states) -> np.ndarray:
    """Analysis vectors (exposure, camera, Stokes) in a band whose three rows are its nodes."""
    curve = builders.curve([LINES[0], LINES[0] + 1e-9], [1.0, 1.0])
    plan = plan_for(instrument, exposures(states), {"band": curve})
    # Three nodes with weights of their own in place of the rule of that curve.
    bands = len(plan.node_weight)
    plan = dataclasses.replace(
        plan,
        wavelength=jnp.asarray(LINES),
        node_weight=jnp.tile(jnp.asarray(WEIGHTS), (bands, 1)),
        conditions=dataclasses.replace(plan.conditions, band_width=jnp.zeros(3)),
    )
    return builders.vectors(instrument, plan, 0.1, -0.2)[0][plan.band_of[:, 0]]


EVERY = [
    dict(zip(PREFIXES, angles, strict=True))
    for angles in itertools.product((None, 0.0, 31.0), (None, -20.0, 77.0), (None, 12.0))
]


def three_arms(text: str = THREE_ARMS) -> Instrument:
    return build(parsed(text, "three arms"))


@pytest.mark.parametrize("seed", range(2))
def test_every_combination_of_positions(seed):
    """Eighteen combinations of three elements, in and out, in an order that no plan has chosen."""
    rng = np.random.default_rng(seed)
    states = [EVERY[i] for i in rng.permutation(len(EVERY))]
    found = found_vectors(three_arms(), states)
    for state, vectors in zip(states, found, strict=True):
        np.testing.assert_allclose(vectors, expected_vectors(state), rtol=0, atol=1e-13, err_msg=str(state))


ORDERS = list(itertools.permutations(("lens", "turning", "window", "plate")))


@pytest.mark.parametrize("order", quick(ORDERS, ORDERS[::3]), ids="-".join)
def test_every_order_of_the_train(order):
    """Which elements lead, and which positions share products, follows from the order; the result does not."""
    text = THREE_ARMS.replace(
        '"lens", "turning", "window", "plate"', ", ".join(f'"{name}"' for name in order)
    )
    states = [EVERY[i] for i in (0, 7, 10, 17)]
    for state, vectors in zip(states, found_vectors(three_arms(text), states), strict=True):
        np.testing.assert_allclose(vectors, expected_vectors(state, order), rtol=0, atol=1e-13)


def test_an_element_in_one_position_only():
    """All exposures agree in two of the moving elements, or in all three."""
    for states in (EVERY[4:5], [EVERY[0], EVERY[1]], [EVERY[6], EVERY[12]], [EVERY[3]] * 3):
        for state, vectors in zip(states, found_vectors(three_arms(), states), strict=True):
            np.testing.assert_allclose(vectors, expected_vectors(state), rtol=0, atol=1e-13)


def test_one_motor_may_turn_two_elements():
    """The plate ahead of the arms and the one in the third arm on the same columns."""
    text = THREE_ARMS.replace('moves = "TILT"', 'moves = "CHWP"')
    states = [s | {"TILT": s["CHWP"]} for s in EVERY if s["TILT"] is None]
    for state, vectors in zip(states, found_vectors(three_arms(text), states), strict=True):
        np.testing.assert_allclose(vectors, expected_vectors(state), rtol=0, atol=1e-13)


def test_arms_without_anything_ahead_of_them():
    text = THREE_ARMS.replace('"polariser", "lens", "turning", "window", "plate"', "")
    head, tail = text.split("[elements.polariser]")
    text = head + "[elements]\n" + tail[tail.index("[arms.first]") :]
    states = [s for s in EVERY if s["CHWP"] is None and s["DEROT"] is None]
    for state, vectors in zip(states, found_vectors(three_arms(text), states), strict=True):
        np.testing.assert_allclose(vectors, expected_vectors(state, ()), rtol=0, atol=1e-13)


def test_an_element_inserted_by_hand_stands_where_it_was_put():
    """Before and after a moving element, and in an arm."""
    text = THREE_ARMS
    instrument = three_arms(text)
    second = next(e for e in instrument.elements if e.name == "window")
    moved = dataclasses.replace(instrument, path=("polariser", "lens", "turning", "plate"))
    moved = dataclasses.replace(moved, elements=tuple(e for e in instrument.elements if e.name != "window"))
    state = [EVERY[17]]
    for place, order in (
        ({"before": "turning"}, ("lens", "window", "turning", "plate")),
        ({"after": "turning"}, ("lens", "turning", "window", "plate")),
        ({"after": "plate"}, ("lens", "turning", "plate", "window")),
    ):
        found = found_vectors(moved.inserted(second, **place), state)[0]
        np.testing.assert_allclose(found, expected_vectors(state[0], order), rtol=0, atol=1e-13)
    found = found_vectors(moved.inserted(second, before="third.fourth"), state)[0]
    arms = ARMS | {("e", "f"): (("tilt", "window", "fourth"), 0.97, 0.0)}
    expected = expected_vectors(state[0], ("lens", "turning", "plate"), arms)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13)


def test_instrument_matrix_has_a_row_for_each_arm():
    """(N₊ − N₋)/(N₊ + N₋) of the cameras that each analyser names, in its order."""
    instrument = three_arms()
    vectors = found_vectors(instrument, [EVERY[17]])[0]
    found = np.asarray(light.instrument_matrix(jnp.asarray(vectors), instrument.cameras.pairs))
    assert found.shape == (3, 3)
    by_name = dict(zip("abcdef", vectors, strict=True))
    for row, (plus, minus) in zip(found, ARMS, strict=True):
        total = by_name[plus][0] + by_name[minus][0]
        np.testing.assert_allclose(row, (by_name[plus] - by_name[minus])[:3] / total, atol=1e-14)
