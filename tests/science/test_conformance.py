"""The pack of questions: its answers by hand, the package put to it, mistakes named, tables written and judged."""

from __future__ import annotations

import csv
import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest

from walop_jax.commands.conformance import conformance
from walop_jax.io.errors import DataError
from walop_jax.model.mueller import retarder
from walop_jax.model.sources import turned
from walop_jax.science import conformance as science
from walop_jax.science.conformance import RESULTS, SHIPPED, rows, values
from walop_jax.science.estimate import estimate
from walop_jax.science.polarisation import polarisation

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


def cases() -> list[Case]:
    """The questions as the package holds them."""
    made = {row["CASE"]: Case(row["CASE"], row["TOPIC"], {}, {}, {}) for row in rows("cases.csv")}
    for file in ("given", "answers"):
        for (case, quantity), value in values(f"{file}.csv").items():
            getattr(made[case], file)[quantity] = value
    for row in rows("mistakes.csv"):
        wrong = made[row["CASE"]].mistakes.setdefault(row["MISTAKE"], {})
        wrong[row["QUANTITY"]] = float(row["VALUE"])
    return list(made.values())


def judge(answers):
    return science.judge(answers).deviations


def right() -> dict[tuple[str, str], float | None]:
    return {(case.name, quantity): value for case in cases() for quantity, value in case.answers.items()}


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
    answers = right()
    for case in cases():
        if case.topic not in PACKAGE:
            found = by_package(case)
            assert found.keys() == case.answers.keys()
            answers |= {(case.name, name): value for name, value in found.items()}
    assert judge(answers) == ()


def test_mistakes_are_told_from_the_right_answer_and_named():
    seen = set()
    for case in cases():
        for text, wrong in case.mistakes.items():
            answers = right() | {(case.name, name): value for name, value in wrong.items()}
            deviations = judge(answers)
            if deviations:
                assert all(entry.case == case.name and entry.mistake for entry in deviations)
                seen |= {(case.topic, text)} & {(case.topic, entry.mistake) for entry in deviations}
    assert seen == {(case.topic, text) for case in cases() for text in case.mistakes}


def test_an_angle_is_the_same_after_half_a_turn_and_nothing_is_no_answer():
    answers = right()
    answers["sign-of-u-1", "EVPA"] = 180.0
    assert judge(answers) == ()
    answers["sign-of-u-1", "EVPA"] = 179.9
    answers["roll-1", "Q_SKY"] = None
    answers["roll-1", "U_SKY"] = float("nan")
    told = [str(entry) for entry in judge(answers)]
    assert len(told) == 3
    assert "sign-of-u-1 EVPA: 179.9 where 0 is right" in told
    assert "roll-1 Q_SKY: no answer" in told


def fill(folder, change):
    """Answers from answers.csv into results.csv, changed."""
    with (folder / "answers.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    for number, row in enumerate(rows):
        change(number, row)
    with (folder / "results.csv").open("w", newline="") as stream:
        writer = csv.DictWriter(stream, ["CASE", "QUANTITY", "VALUE"])
        writer.writeheader()
        writer.writerows(rows)


def test_tables_are_written_and_judged(tmp_path):
    folder = tmp_path / "pack"
    assert conformance(make=folder) == 43
    assert sorted(entry.name for entry in folder.iterdir()) == sorted((*SHIPPED, RESULTS))
    asked = len(right())
    empty = conformance(check=folder)
    assert len(empty.deviations) == asked
    fill(folder, lambda number, row: None)
    assert conformance(check=folder).document() == {"asked": asked, "right": asked, "deviations": []}
    # Nothing filled in is said once, and so is one mistake made everywhere.
    assert len(empty.display().notes) == 1
    half = {
        case.name: case.mistakes["O2 and E2 are exchanged"]
        for case in cases()
        if case.topic == "camera order"
    }
    swap = lambda number, row: row.update(VALUE=half.get(row["CASE"], {}).get(row["QUANTITY"], row["VALUE"]))  # noqa: E731
    fill(folder, swap)
    (told,) = conformance(check=folder).display().notes
    assert told.startswith("O2 and E2 are exchanged: camera-order-1 U, camera-order-1 EVPA")
    fill(folder, lambda number, row: row.update(VALUE="-0.017") if number == 0 else None)
    assert [entry.quantity for entry in conformance(check=folder).deviations] == ["P"]
    with pytest.raises(DataError, match=r"holds cases\.csv already"):
        conformance(make=folder)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"CASE": "sing-of-u-1"}, r"results\.csv: 'sing-of-u-1 P' is not asked for, in row 0.*sign-of-u-1 P"),
        ({"QUANTITY": "EVPA"}, r"sign-of-u-1 EVPA is there twice, again in row 1"),
        ({"VALUE": "45 deg"}, r"VALUE: '45 deg' is not a number, in row 0"),
    ],
)
def test_results_that_cannot_be_read(tmp_path, change, message):
    conformance(make=tmp_path / "pack")
    fill(tmp_path / "pack", lambda number, row: row.update(change) if number == 0 else None)
    with pytest.raises(DataError, match=message):
        conformance(check=tmp_path / "pack")
