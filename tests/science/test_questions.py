"""The questions on conventions that come with the package (`docs/questions`), for it and for other programs.

Their answers are held against numbers by hand and against the functions of the package; the answers of the usual
mistakes have to differ from the right ones.
"""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest

import walop_jax
from walop_jax.model.mueller import retarder
from walop_jax.model.sources import turned
from walop_jax.science.estimate import estimate
from walop_jax.science.polarisation import polarisation

PACK = Path(walop_jax.__file__).parent / "docs" / "questions"
ANGLES = ("EVPA", "EVPA_SKY")  # degrees, the same after half a turn
Key = tuple[str, str]  # a case and a quantity

BY_HAND = {
    ("sign-of-u-3", "EVPA"): 45.0,
    ("sign-of-u-4", "EVPA"): 135.0,
    ("sign-of-u-2", "EVPA"): 90.0,
    ("camera-order-2", "Q"): -0.01,
    ("camera-order-3", "U"): -0.02,
    ("roll-3", "Q_SKY"): -0.007,
    ("roll-3", "U_SKY"): 0.02,
    ("roll-4", "U_SKY"): -0.007,
    ("parity-2", "NORTH"): 0.07,
    ("parity-2", "EAST"): 0.2,
    ("retarder-1", "U_OUT"): 0.1,
    ("retarder-1", "V_OUT"): -0.2,
    ("retarder-2", "Q_OUT"): 0.2,
    ("instrument-matrix-4", "Q"): 0.0,
    ("throughput-1", "Q"): 0.02,
    ("two-cameras-1", "Q"): 0.02,
    ("two-cameras-2", "U"): 0.03,
    ("covariance-3", "Q_SKY_ERR"): 0.0017,
    ("covariance-3", "QU_SKY_COV"): -6e-7,
    ("errors-of-degree-and-angle-1", "EVPA_ERR"): math.degrees(0.0017 / 0.04),
    ("debiasing-3", "WK"): 0.0,
}


class Case(NamedTuple):
    """A question: numbers that are given, the right answers, and what mistakes (in words) would answer."""

    name: str
    topic: str
    given: dict[str, float]
    answers: dict[str, float]
    mistakes: dict[str, dict[str, float]]


def rows(name: str) -> list[dict[str, str]]:
    """The rows of a table that comes with the package."""
    with (PACK / name).open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def values(name: str) -> dict[Key, float]:
    """The numbers of such a table by case and quantity."""
    return {(row["CASE"], row["QUANTITY"]): float(row["VALUE"]) for row in rows(name)}


def cases() -> list[Case]:
    """The questions as the package holds them."""
    made = {row["CASE"]: Case(row["CASE"], row["TOPIC"], {}, {}, {}) for row in rows("cases.csv")}
    for file in ("given", "answers"):
        for (case, quantity), value in values(f"{file}.csv").items():
            getattr(made[case], file)[quantity] = value
    for row in rows("wrong_answers.csv"):
        wrong = made[row["CASE"]].mistakes.setdefault(row["CAUSE"], {})
        wrong[row["QUANTITY"]] = float(row["VALUE"])
    return list(made.values())


def same(quantity: str, answer: float, expected: float) -> bool:
    """True if two numbers agree as docs/conventions asks for: to 10⁻⁶, angles to 10⁻⁵ degrees, modulo 180."""
    if quantity in ANGLES:
        return abs((answer - expected + 90.0) % 180.0 - 90.0) < 1e-5
    return abs(answer - expected) <= 1e-6 * abs(expected) + 1e-12


def right() -> dict[Key, float]:
    return values("answers.csv")


def test_questions_with_answers_known_by_hand():
    found = cases()
    assert len(found) == len({case.name for case in found}) == 43
    for key, value in BY_HAND.items():
        assert right()[key] == pytest.approx(value, rel=1e-12, abs=1e-12), key


def noise(n):
    return np.array([[[n["Q_ERR"] ** 2, n["QU_COV"]], [n["QU_COV"], n["U_ERR"] ** 2]]])


def by_package(case: Case) -> dict[str, float]:
    """The answers that the package's own functions give."""
    n = case.given
    if case.topic in ("sign of u", "errors of degree and angle", "debiasing"):
        covariance = noise(n) if "Q_ERR" in n else np.eye(2)[None] * 1e-12
        qu = np.array([[n["Q"], n["U"]]])
        mas, wk = (polarisation(qu, covariance, name) for name in ("MAS", "WK"))
        found = {"P": mas.degree, "EVPA": mas.angle, "P_ERR": mas.degree_error, "EVPA_ERR": mas.angle_error}
        found |= {"MAS": mas.debiased, "WK": wk.debiased}
        return {name: float(found[name][0]) for name in case.answers}
    if case.topic == "retarder":
        light = jnp.array([1.0, n["Q"], n["U"], n["V"]])
        out = np.asarray(retarder(jnp.deg2rad(n["DELTA"]), jnp.deg2rad(n["AXIS"])) @ light)
        return dict(zip(("Q_OUT", "U_OUT", "V_OUT"), out[1:].tolist(), strict=True))
    if case.topic == "roll":
        back = turned(jnp.array([[n["Q"], n["U"]]]), -jnp.deg2rad(jnp.array([n["ROTATOR"]])))
        q, u = np.asarray(back)[0].tolist()
        angle = polarisation(np.array([[q, u]]), np.eye(2)[None]).angle[0]
        return {"Q_SKY": q, "U_SKY": u, "EVPA_SKY": float(angle)}
    ideal = np.array([[1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 0.0, 1.0], [1.0, 0.0, -1.0]])
    counts = np.array([n.get(f"N{k}", np.nan) for k in range(4)])
    if case.topic == "throughput":  # of two cameras: u is seen by two more that are given the right answer 0
        ideal[:2] *= np.array([[n["T0"]], [n["T1"]]])
        light = (counts[0] / n["T0"] + counts[1] / n["T1"]) / 2
        counts[2:] = light
    if case.topic == "instrument matrix":
        for row, name in ((0, "2"), (2, "3")):
            element = np.array([n[f"M{name}{k}"] for k in (1, 2, 3)])
            ideal[row], ideal[row + 1] = np.eye(3)[0] + element, np.eye(3)[0] - element
        counts = np.array([1 + n["QM"], 1 - n["QM"], 1 + n["UM"], 1 - n["UM"]])
    found = estimate(ideal[None], counts[None], np.sqrt(counts[None] * 1e-6), np.array([0]))
    q, u = found.qu[0].tolist()
    angle = polarisation(found.qu, np.eye(2)[None]).angle[0]
    return {
        name: value for name, value in (("Q", q), ("U", u), ("EVPA", float(angle))) if name in case.answers
    }


PACKAGE = ("parity", "covariance", "two cameras")
"""Topics whose formulas the package has only inside larger functions."""


def test_the_package_answers_right():
    expected = right()
    for case in cases():
        if case.topic not in PACKAGE:
            found = by_package(case)
            assert found.keys() == case.answers.keys()
            for name, value in found.items():
                assert same(name, value, expected[case.name, name]), (case.name, name, value)


def test_a_mistake_answers_otherwise_than_is_right():
    """In one case of its topic at least: an answer that two conventions share is no test of them."""
    told = set()
    for case in cases():
        for mistake, wrong in case.mistakes.items():
            assert wrong.keys() <= case.answers.keys()
            if any(not same(name, value, case.answers[name]) for name, value in wrong.items()):
                told.add((case.topic, mistake))
    assert told == {(case.topic, mistake) for case in cases() for mistake in case.mistakes}


def test_mistakes_of_a_topic_are_told_from_each_other():
    """Over all cases of a topic no two mistakes give the same answers, so that the answers say which one was made."""
    by_topic: dict[str, dict[str, dict[Key, float]]] = {}
    for case in cases():
        for mistake, wrong in case.mistakes.items():
            answers = {(case.name, name): wrong.get(name, value) for name, value in case.answers.items()}
            by_topic.setdefault(case.topic, {}).setdefault(mistake, {}).update(answers)
    for mistakes in by_topic.values():
        names = list(mistakes)
        for number, first in enumerate(names):
            for second in names[number + 1 :]:
                one, other = mistakes[first], mistakes[second]
                assert one.keys() == other.keys()
                assert not all(same(name[1], one[name], other[name]) for name in one), (first, second)


def test_the_tables_hold_the_same_cases():
    """Every question has numbers and answers, in the order in which they are asked, and none is there twice."""
    asked = [row["CASE"] for row in rows("cases.csv")]
    for table in ("given.csv", "answers.csv"):
        assert list(dict.fromkeys(case for case, _ in values(table))) == asked
        assert len(values(table)) == len(rows(table))
