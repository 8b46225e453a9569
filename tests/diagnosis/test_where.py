"""Where an effect sits is told where the plan alone would not put it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from small_run import SMALL, small_fit

from walop_jax.diagnosis.design import Design
from walop_jax.diagnosis.findings import _trend, describe
from walop_jax.simulation.observing_plan import polariser_turn

TURN = dataclasses.replace(SMALL, polariser_angles=polariser_turn(24, full_turn=True)).exposures()
"""A plan as usual: the polariser first, in the order of its angles, then the sky."""


@pytest.fixture(scope="module")
def design() -> Design:
    return Design.of(small_fit())


def rows_of(design: Design, exposures, cameras) -> np.ndarray:
    """Data rows with so large a change in every exposure and camera."""
    cube = np.ones((len(design.fit.calset.points), 1, 1)) * exposures[None, :, None] * cameras[None, None, :]
    inside = design.measured.used
    found = np.zeros(len(design.residual))
    found[: inside.sum() * cube.shape[2]] = cube[inside].ravel()
    return found


def test_a_constant_change_of_the_polariser_does_not_shrink_with_time(design: Design):
    """Polariser exposures come first in every plan: what sits in them was told to shrink with time."""
    e = design.fit.calset.exposures
    size = np.where(e.clp_in, 1.0 + 0.2 * np.cos(np.deg2rad(2 * e.clp_angle)), 0.2)
    found = describe(design, rows_of(design, np.nan_to_num(size, nan=0.2), np.array([1.02, 1.0, 0.99, 1.0])))
    assert found["time"] is None
    assert found["camera"] is None
    assert found["wavelength"] is None  # there is one filter
    assert found["kind"].startswith("clp")


def test_one_camera_is_told(design: Design):
    e = design.fit.calset.exposures
    found = describe(design, rows_of(design, np.ones(len(e)), np.array([3.0, 1.0, 1.0, 1.0])))
    assert found["camera"].startswith("O1 75%")


@pytest.mark.parametrize(("sign", "sure"), [(1.0, True), (-1.0, True), (0.0, False)])
def test_a_trend_among_exposures_that_are_alike_is_told(sign: float, sure: bool):
    e = TURN
    angle = np.deg2rad(np.nan_to_num(e.clp_angle))
    settings = np.unique(e.kind, return_inverse=True)[1]
    time = np.arange(len(e)) / len(e)
    size = np.where(e.clp_in, 2.0 + np.cos(2 * angle) + 0.5 * np.sin(4 * angle), 0.3) + 3.0 * sign * time
    found = _trend(e, settings, np.abs(size))
    assert (abs(found) > 0.7) == sure
    assert found * sign >= 0.0
