"""The check of the covariance by hand: of two parameters with the correlation r the smallest eigenvalue is 1 − |r|."""

from __future__ import annotations

import numpy as np
import pytest
from calibration_in_words import changed
from handmade_run import parameters
from test_other_products import product_of

from walop_jax.calibration.certify import certify
from walop_jax.data.calset import read_calibration_set

NAN = float("nan")


@pytest.fixture
def checked(two_cameras):
    """Two free parameters, and one that is held, between them: the check of their covariance."""
    calset = read_calibration_set(two_cameras.write())
    three = parameters(
        ("hwp.retardance", "waves", 0.5, (0.5, 0.25), True),
        ("throughput.n0.p00", "", 1.0, None, False),
        ("throughput.n1.p00", "", 0.25, None, True),
    )

    def check(r: float, first: float = 0.125):
        covariance = np.zeros((3, 3))
        covariance[0, 0], covariance[2, 2] = first**2, 0.25
        covariance[0, 2] = covariance[2, 0] = r * first * 0.5
        product = changed(
            product_of(calset, 2, {}),
            parameters=three,
            values=np.array([0.5, 1.0, 0.25]),
            covariance=covariance,
        )
        return next(check for check in certify(product) if check.name == "covariance")

    return check


@pytest.mark.parametrize(("r", "lowest"), [(0.0, "1"), (0.75, "0.25"), (-0.999, "0.001")])
def test_held_parameters_are_left_aside(checked, r, lowest):
    check = checked(r)
    assert check.passed
    assert f"of the correlation of 2 free parameters {lowest};" in check.found


@pytest.mark.parametrize("r", [1.0, -1.0])
def test_a_singular_covariance_fails(checked, r):
    check = checked(r)
    assert not check.passed
    assert "2 free parameters 0 (singular)" in check.found


def test_a_free_parameter_without_an_error_fails(checked):
    check = checked(0.0, first=0.0)
    assert not check.passed
    assert "the error of the free parameter hwp.retardance is 0" in check.found
