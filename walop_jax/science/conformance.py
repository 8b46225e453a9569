"""Forty-three small questions on conventions, with their right answers, for any program that reduces such data.

Every answer is a closed formula of docs: conventions, written out here and nowhere used in the package, so that the
package can be put to the test as well. Beside the right answer stand those of the usual mistakes, to name them.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence

EVPA = ("EVPA", "EVPA_SKY")  # degrees, the same after half a turn

Numbers = Mapping[str, float]
Rule = Callable[[Numbers], dict[str, float]]


@dataclasses.dataclass(frozen=True)
class Case:
    """A question: numbers that are given, the right answers, and what mistakes (in words) would answer."""

    name: str
    topic: str
    question: str
    given: Numbers
    answers: Numbers
    mistakes: Mapping[str, Numbers]


@dataclasses.dataclass(frozen=True)
class Deviation:
    """An answer that is not right: None stands for none; `mistake` names what would answer so, or is empty."""

    case: str
    quantity: str
    answer: float | None
    expected: float
    mistake: str

    def __str__(self) -> str:
        if self.answer is None:
            return f"{self.case} {self.quantity}: no answer"
        hint = f": {self.mistake}" if self.mistake else ""
        return f"{self.case} {self.quantity}: {self.answer:.10g} where {self.expected:.10g} is right{hint}"


def judge(answers: Mapping[tuple[str, str], float | None]) -> tuple[Deviation, ...]:
    """Hold answers, by case and quantity, against the right ones."""
    found = []
    for case in cases():
        for quantity, expected in case.answers.items():
            answer = answers.get((case.name, quantity))
            if not _same(quantity, answer, expected):
                likely = (
                    text for text, wrong in case.mistakes.items() if _same(quantity, answer, wrong[quantity])
                )
                found.append(Deviation(case.name, quantity, answer, expected, next(likely, "")))
    return tuple(found)


def _same(quantity: str, answer: float | None, expected: float) -> bool:
    """True if two numbers agree to 10⁻⁶, angles to 10⁻⁵ degrees."""
    if answer is None or not math.isfinite(answer):
        return False
    if quantity in EVPA:
        return abs((answer - expected + 90.0) % 180.0 - 90.0) < 1e-5
    return abs(answer - expected) <= 1e-6 * abs(expected) + 1e-12


# ---------------------------------------------------------------------------------------------- the rules


def _angle(q: float, u: float) -> float:
    return math.degrees(0.5 * math.atan2(u, q)) % 180.0


def _turned(q: float, u: float, degrees: float) -> tuple[float, float]:
    c, s = math.cos(math.radians(2 * degrees)), math.sin(math.radians(2 * degrees))
    return c * q - s * u, s * q + c * u


def _evpa(n: Numbers) -> dict[str, float]:
    return {"P": math.hypot(n["Q"], n["U"]), "EVPA": _angle(n["Q"], n["U"])}


def _cameras(n: Numbers) -> dict[str, float]:
    q = (n["N0"] - n["N1"]) / (n["N0"] + n["N1"])
    u = (n["N2"] - n["N3"]) / (n["N2"] + n["N3"])
    return {"Q": q, "U": u, "EVPA": _angle(q, u)}


def _sky(n: Numbers) -> dict[str, float]:
    q, u = _turned(n["Q"], n["U"], n["ROTATOR"])
    return {"Q_SKY": q, "U_SKY": u, "EVPA_SKY": _angle(q, u)}


def _parity(n: Numbers) -> dict[str, float]:
    c, s = math.cos(math.radians(n["ROTATOR"])), math.sin(math.radians(n["ROTATOR"]))
    return {"NORTH": n["X"] * c - n["Y"] * s, "EAST": n["X"] * s + n["Y"] * c}


def _retarder(n: Numbers) -> dict[str, float]:
    q, u = _turned(n["Q"], n["U"], -n["AXIS"])
    c, s = math.cos(math.radians(n["DELTA"])), math.sin(math.radians(n["DELTA"]))
    u, v = c * u + s * n["V"], -s * u + c * n["V"]
    q, u = _turned(q, u, n["AXIS"])
    return {"Q_OUT": q, "U_OUT": u, "V_OUT": v}


def _matrix(n: Numbers) -> dict[str, float]:
    a, b = n["QM"] - n["M21"], n["UM"] - n["M31"]
    determinant = n["M22"] * n["M33"] - n["M23"] * n["M32"]
    return {
        "Q": (n["M33"] * a - n["M23"] * b) / determinant,
        "U": (n["M22"] * b - n["M32"] * a) / determinant,
    }


def _throughput(n: Numbers) -> dict[str, float]:
    """N0 = T0 (1 + q), N1 = T1 (1 − q)."""
    one, other = n["N0"] / n["T0"], n["N1"] / n["T1"]
    return {"Q": (one - other) / (one + other)}


def _two_cameras(n: Numbers) -> dict[str, float]:
    """Half-wave plate at 0°, 45°, 22.5°, 67.5°: (q, −q, u, −u) between the cameras, whatever their throughputs."""
    d = {a: (n[f"O_{a}"] - n[f"E_{a}"]) / (n[f"O_{a}"] + n[f"E_{a}"]) for a in ("0", "45", "22", "67")}
    return {"Q": 0.5 * (d["0"] - d["45"]), "U": 0.5 * (d["22"] - d["67"])}


def _seen(q: float, u: float) -> Numbers:
    """Counts of two cameras of equal throughput behind a half-wave plate."""
    signals = {"0": q, "45": -q, "22": u, "67": -u}
    return {f"{c}_{a}": 1e6 * (1 + s * d) for a, d in signals.items() for c, s in (("O", 1), ("E", -1))}


def _covariance(n: Numbers) -> dict[str, float]:
    c, s = math.cos(math.radians(2 * n["ROTATOR"])), math.sin(math.radians(2 * n["ROTATOR"]))
    a, b, d = n["Q_ERR"] ** 2, n["QU_COV"], n["U_ERR"] ** 2
    return {
        "Q_SKY_ERR": math.sqrt(c * c * a - 2 * c * s * b + s * s * d),
        "U_SKY_ERR": math.sqrt(s * s * a + 2 * c * s * b + c * c * d),
        "QU_SKY_COV": c * s * (a - d) + (c * c - s * s) * b,
    }


def _across(n: Numbers) -> tuple[float, float, float]:
    """p, variance along the direction of (q, u) and across it."""
    p = math.hypot(n["Q"], n["U"])
    c, s = n["Q"] / p, n["U"] / p
    a, b, d = n["Q_ERR"] ** 2, n["QU_COV"], n["U_ERR"] ** 2
    return p, c * c * a + 2 * c * s * b + s * s * d, s * s * a - 2 * c * s * b + c * c * d


def _errors(n: Numbers) -> dict[str, float]:
    p, along, across = _across(n)
    return {"P_ERR": math.sqrt(along), "EVPA_ERR": math.degrees(math.sqrt(across) / (2 * p))}


def _debiased(n: Numbers) -> dict[str, float]:
    p, _, b = _across(n)
    return {"MAS": p - b * (1 - math.exp(-(p**2) / b)) / (2 * p), "WK": math.sqrt(max(p * p - b, 0.0))}


# ---------------------------------------------------------------------------------------------- the cases


def _changed(rule: Rule, **signs: float) -> Rule:
    """The rule with some of the given numbers multiplied by a factor."""
    return lambda n: rule({**n, **{name: n[name] * factor for name, factor in signs.items()}})


def _swapped(rule: Rule, *pairs: tuple[str, str]) -> Rule:
    """The rule with given numbers exchanged."""
    return lambda n: rule({**n, **{a: n[b] for a, b in pairs}, **{b: n[a] for a, b in pairs}})


_QU = ((0.031, 0.0), (-0.031, 0.0), (0.0, 0.024), (0.0, -0.024), (0.012, 0.017), (-0.012, -0.017))
_NOISE = {"Q_ERR": 0.0011, "U_ERR": 0.0017, "QU_COV": 6.0e-7}
_TOPICS: Sequence[tuple[str, str, Rule, Mapping[str, Rule], Sequence[Numbers]]] = (
    (
        "sign of u",
        "Degree P and angle EVPA (degrees, from +X towards +Y) of light of these fractions Q, U",
        _evpa,
        {"u has the other sign": _changed(_evpa, U=-1.0), "angle from +Y": _changed(_evpa, Q=-1.0, U=-1.0)},
        tuple({"Q": q, "U": u} for q, u in _QU),
    ),
    (
        "camera order",
        "Q, U and EVPA from the electrons in the cameras O1, E1, O2, E2 of an ideal instrument",
        _cameras,
        {
            "O1 and E1 are exchanged": _swapped(_cameras, ("N0", "N1")),
            "O2 and E2 are exchanged": _swapped(_cameras, ("N2", "N3")),
            "the halves are exchanged": _swapped(_cameras, ("N0", "N2"), ("N1", "N3")),
        },
        tuple(
            {"N0": 1e6 * (1 + q), "N1": 1e6 * (1 - q), "N2": 8e5 * (1 + u), "N3": 8e5 * (1 - u)}
            for q, u in ((0.02, 0.005), (-0.01, 0.03), (0.004, -0.02), (-0.015, -0.008))
        ),
    ),
    (
        "roll",
        "Q, U, EVPA on the sky (north through east) of Q, U in the instrument; ROTATOR is the position angle of +X",
        _sky,
        {
            "ROTATOR turns the other way": _changed(_sky, ROTATOR=-1.0),
            "(q, u) turns by the angle once, not twice": _changed(_sky, ROTATOR=0.5),
            "u has the other sign": _changed(_sky, U=-1.0),
        },
        tuple(
            {"Q": 0.02, "U": 0.007, "ROTATOR": rotator} for rotator in (0.0, 30.0, 45.0, 90.0, -67.5, 200.0)
        ),
    ),
    (
        "parity",
        "Offsets NORTH and EAST (degrees) from the field centre of a field point X, Y under ROTATOR",
        _parity,
        {
            "ROTATOR turns the other way": _changed(_parity, ROTATOR=-1.0),
            "the field is mirrored": _changed(_parity, Y=-1.0),
        },
        tuple({"X": 0.2, "Y": -0.07, "ROTATOR": rotator} for rotator in (0.0, 90.0, 33.0, -120.0)),
    ),
    (
        "retarder",
        "Light behind a retarder with its fast axis at AXIS and retardance DELTA (degrees; lead of the fast wave)",
        _retarder,
        {
            "the axis is the slow one, or V has the other sign": _changed(_retarder, DELTA=-1.0),
            "the axis turns the other way": _changed(_retarder, AXIS=-1.0),
        },
        tuple(
            {"Q": 0.3, "U": 0.2, "V": 0.1, "AXIS": axis, "DELTA": delta}
            for axis, delta in ((0.0, 90.0), (22.5, 180.0), (45.0, 60.0), (-30.0, 75.0))
        ),
    ),
    (
        "instrument matrix",
        "Q, U of the light from QM, UM = M21 + M22 Q + M23 U, M31 + M32 Q + M33 U",
        _matrix,
        {
            "the matrix is transposed": _swapped(_matrix, ("M23", "M32")),
            "cross-talk is left out": _changed(_matrix, M23=0.0, M32=0.0),
            "the zero offsets are left in": _changed(_matrix, M21=0.0, M31=0.0),
        },
        tuple(
            {"QM": qm, "UM": um, "M21": 0.002, "M22": 0.96, "M23": 0.11, "M31": -0.004, "M32": -0.05, "M33": 0.9}
            for qm, um in ((0.02, 0.01), (-0.03, 0.004), (0.005, -0.06), (0.002, -0.004))
        ),
    ),
    (
        "throughput",
        "Q from the electrons N0 = T0 (1 + Q), N1 = T1 (1 − Q) of two cameras of unequal throughput",
        _throughput,
        {
            "throughput is left out": lambda n: _throughput({**n, "T0": 1.0, "T1": 1.0}),
            "the cameras are exchanged": _swapped(_throughput, ("N0", "N1"), ("T0", "T1")),
        },
        ({"N0": 612000.0, "N1": 441000.0, "T0": 6e5, "T1": 4.5e5}, {"N0": 2e5, "N1": 8e5, "T0": 5e5, "T1": 6e5}),
    ),
    (
        "two cameras",
        "Q and U from the electrons in cameras O (0°) and E (90°) with a half-wave plate at 0, 45, 22.5 and 67.5 deg",
        _two_cameras,
        {
            "the plate turns the other way": _swapped(_two_cameras, ("O_22", "O_67"), ("E_22", "E_67")),
            "the cameras are exchanged": _swapped(
                _two_cameras, *((f"O_{a}", f"E_{a}") for a in ("0", "45", "22", "67"))
            ),
        },
        tuple(_seen(q, u) for q, u in ((0.02, 0.005), (-0.01, 0.03), (0.0, -0.004))),
    ),
    (
        "covariance",
        "Errors and covariance of Q, U on the sky from those in the instrument, under ROTATOR",
        _covariance,
        {
            "ROTATOR turns the other way": _changed(_covariance, ROTATOR=-1.0),
            "the covariance is left out": _changed(_covariance, QU_COV=0.0),
        },
        tuple(_NOISE | {"ROTATOR": rotator} for rotator in (0.0, 30.0, 45.0, -80.0)),
    ),
    (
        "errors of degree and angle",
        "Standard errors P_ERR and EVPA_ERR (degrees), to first order, of Q, U with this covariance",
        _errors,
        {
            "the covariance is left out": _changed(_errors, QU_COV=0.0),
            "the covariance has the other sign": _changed(_errors, QU_COV=-1.0),
        },
        tuple(_NOISE | {"Q": q, "U": u} for q, u in ((0.02, 0.0), (0.012, 0.017), (-0.01, 0.01))),
    ),
    (
        "debiasing",
        "Degree without bias: MAS (Plaszczynski et al. 2014), WK (Wardle & Kronberg 1974), b² across (Q, U)",
        _debiased,
        {"the covariance is left out": _changed(_debiased, QU_COV=0.0)},
        tuple(_NOISE | {"Q": q, "U": u} for q, u in ((0.02, 0.005), (0.0015, 0.002), (0.0004, -0.0003))),
    ),
)  # fmt: skip


def cases() -> Iterator[Case]:
    """The questions by topic."""
    for topic, question, rule, mistakes, inputs in _TOPICS:
        for number, given in enumerate(inputs, start=1):
            name = f"{topic.replace(' ', '-')}-{number}"
            wrong = {text: other(given) for text, other in mistakes.items()}
            yield Case(name, topic, question, given, rule(given), wrong)
