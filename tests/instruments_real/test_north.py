"""The optical design of WALOP-North: the fit that the command makes, its product, and what is held out of it."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.product import read_calibration
from walop_jax.commands.refit import refit
from walop_jax.data.calset import read_calibration_set
from walop_jax.data.records import CalibrationSet
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import FitResult, fit
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.specification import Model

NOTEBOOKS = Path(__file__).resolve().parents[2] / "notebooks"
sys.path.insert(0, str(NOTEBOOKS))
from walop_north_design import colours, measured_matrix, part, predicted_matrix  # noqa: E402

pytestmark = pytest.mark.long  # five minutes


@pytest.fixture(scope="module")
def design(shared_data: Path) -> Path:
    return shared_data / "walop_north_design.fits"


@pytest.fixture(scope="module")
def calset(design: Path) -> CalibrationSet:
    return read_calibration_set(design)


@pytest.fixture(scope="module")
def run(design: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[FitResult, Calibration]:
    folder = tmp_path_factory.mktemp("north") / "run"
    return refit(design, output=folder, instrument="WALOP-NORTH"), read_calibration(folder).calibration


def off(calibration: Calibration, calset: CalibrationSet) -> np.ndarray:
    """Design minus prediction of m22, m23, m32, m33 (point, wavelength, 4)."""
    x, y = calset.points.x, calset.points.y
    return measured_matrix(calset)[0] - predicted_matrix(calibration, x, y, colours(calset))[0]


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def test_the_command_explains_the_design(run, calset):
    made, calibration = run
    assert made.converged
    assert made.minimum.steps <= 12
    left = off(calibration, calset)
    assert rms(left) < 0.0008
    assert all(rms(left[..., element]) < 0.0011 for element in range(4))


def test_errors_come_from_what_is_left(run):
    made, calibration = run
    assert not made.explains_data
    assert "300 states" in calibration.verdict.errors_from
    assert "36 cells" in calibration.verdict.errors_from
    value, error = made.value("half2.plate.quartz")
    assert 0.01 < error < 1.0
    assert value == made.value("chwp.quartz")[0]


def started(result: FitResult) -> Model:
    model = result.model
    for name, value in zip(model.names, result.values, strict=True):
        model = model.change(name, start=float(value))
    return model


def test_squares_of_a_checkerboard_that_were_left_out(run, calset):
    made, calibration = run
    x, y = calset.points.x, calset.points.y
    outside = (np.floor((x + 0.25) / 0.125) + np.floor((y + 0.25) / 0.125)) % 2 == 0
    kept = part(calset, points=~outside)
    found = Calibration.from_fit(
        fit(Likelihood.of(kept, started(made.result)), noise_scale=1.5).with_verdict()
    )
    assert rms(off(found, calset)[outside]) < 1.3 * rms(off(calibration, calset))


def test_a_wavelength_that_was_left_out(run, calset):
    made, calibration = run
    number = 3  # 0.62 um
    kept = part(calset, wavelength=colours(calset)[number])
    found = Calibration.from_fit(
        fit(Likelihood.of(kept, started(made.result)), noise_scale=1.5).with_verdict()
    )
    assert rms(off(found, calset)[:, number]) < 1.3 * rms(off(calibration, calset))


def test_the_matrix_is_smooth_at_a_wavelength_that_is_in_no_file(run, calset):
    """Between 0.62 and 0.685 um a cubic through the neighbours at 0.1 and 0.2 nm gives the matrix: no steps, no kinks.

    A straight line would not do. Ahead of a slanted wedge the axes of quartz and MgF2 are not seen at right angles, and
    the 31 waves of the quartz alone show as fringes of lambda^2 / (d (n_e - n_o)), 21 nm, and some 0.01. The term that
    the cubic leaves out is a sixth of the fourth derivative times the step to the fourth: (2 pi 0.1 / 21)^4 0.02 / 6.
    """
    _, calibration = run
    x, y = calset.points.x[::40], calset.points.y[::40]
    values = predicted_matrix(calibration, x, y, [0.6498, 0.6499, 0.65, 0.6501, 0.6502])[0]
    far, near, middle = values[:, 0] + values[:, 4], values[:, 1] + values[:, 3], values[:, 2]
    np.testing.assert_allclose((4 * near - far) / 6, middle, rtol=0, atol=1e-8)
    assert np.abs(values[:, 3] - values[:, 1]).max() > 1e-4


def test_an_instrument_of_another_order_is_far_off(calset):
    """One order of retardance away the fringes over the field are others: no matrix comes near."""
    model = base_model(calset)
    model = model.change("half2.plate.quartz", start=model["half2.plate.quartz"].start + 69.0)
    wrong = Likelihood.of(calset, model)
    right = Likelihood.of(calset, base_model(calset))
    assert wrong.expand(wrong.model.start).data > 3.0 * right.expand(right.model.start).data
