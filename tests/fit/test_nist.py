"""The fitter on the non-linear sets of the NIST Statistical Reference Datasets, certified to 11 digits.

Errors are scaled from what is left, as the search does for data whose errors are not known; the unit of a parameter is
the size of its start value.
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
from nist_sets import MODELS, Certified

from walop_jax.fit.minimise import Minimum, minimise

CLASSIC = ("MGH09", "MGH10", "MGH17", "Thurber", "Eckerle4", "Hahn1", "Misra1a")
BEYOND_DOUBLES = "Lanczos1"
"""Data to 14 digits without noise: χ² at the minimum, 10⁻²⁵, and with it the errors are made of rounding."""


@dataclasses.dataclass(frozen=True)
class Expansion:
    objective: float
    gradient: np.ndarray
    matrix: np.ndarray


@dataclasses.dataclass(frozen=True)
class Fitted:
    minimum: Minimum
    errors: np.ndarray


@functools.cache
def fitted(name: str, start: int) -> Fitted:
    """The fit of a set from one of its starts (0 or 1), to 10⁻⁹ of a standard error."""
    data = Certified.read(name)
    at, scale, noise = data.starts[start], np.abs(data.starts[start]), 1.0
    for _ in range(12):

        def evaluate(x, noise=noise):
            with np.errstate(over="ignore", invalid="ignore"):  # a trial far away is no place to stay
                r, j = data.residuals(x) / noise, data.jacobian(x) / noise
                return Expansion(float(r @ r), j.T @ r, j.T @ j)

        found = minimise(evaluate, at, scale, maximum_steps=500, tolerance=1e-9)
        at, before = found.x, noise
        noise = float(np.sqrt(np.sum(data.residuals(at) ** 2) / (len(data.y) - len(at))))
        if abs(noise / before - 1.0) < 1e-3:
            break
        scale = np.abs(at)
    unit = 1.0 / np.sqrt(np.diag(found.expansion.matrix))
    inverse = np.linalg.pinv(found.expansion.matrix * np.outer(unit, unit), rcond=1e-16)
    return Fitted(found, unit * np.sqrt(np.diag(inverse)) * noise / before)


def quick(chosen):
    """Those that break fitters without scaling of columns at once, the others on demand."""
    return [name if name in CLASSIC else pytest.param(name, marks=pytest.mark.long) for name in chosen]


def digits(found: np.ndarray, certified: np.ndarray) -> float:
    """How many digits of all numbers are right: the log relative error of NIST."""
    with np.errstate(divide="ignore"):
        return float(-np.log10(np.max(np.abs(found / certified - 1.0))))


@pytest.mark.parametrize("name", MODELS)
def test_the_file_is_what_nist_certified(name):
    """Copies have been corrupted: the certified parameters must leave the certified sum of squares."""
    data = Certified.read(name)
    squares = float(np.sum(data.residuals(data.parameters) ** 2))
    if name == BEYOND_DOUBLES:
        assert squares < 1e-19
    else:
        assert squares == pytest.approx(data.squares, rel=2e-10)


@pytest.mark.parametrize("name", quick(MODELS))
def test_from_the_second_start(name):
    data, found = Certified.read(name), fitted(name, 1)
    assert digits(found.minimum.x, data.parameters) >= 6
    if name != BEYOND_DOUBLES:
        assert found.minimum.converged, found.minimum.message
        assert digits(found.errors, data.errors) >= 4


@pytest.mark.long
def test_from_the_first_start_and_never_a_wrong_answer_called_converged():
    right = []
    for name in MODELS:
        data, found = Certified.read(name), fitted(name, 0)
        good = digits(found.minimum.x, data.parameters) >= 6
        right += [name] * good
        assert good or not found.minimum.converged, name
    print(len(right), "of", len(MODELS))
    assert len(right) >= 24
