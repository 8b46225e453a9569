"""`sample` from Python: the posterior of a run, interrupted, resumed, refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from walop_jax.calibration.product import read_calibration
from walop_jax.commands.refit import refit
from walop_jax.commands.sample import sample
from walop_jax.fit.refit import FitResult, covariance
from walop_jax.io.errors import DataError
from walop_jax.posterior.run import Run

from .conftest import FittedSet

STEPS = 300  # 400 are enough
OPTIONS = {"interval": 100, "maximum_steps": STEPS, "moves": "laplace"}


@pytest.mark.long
def test_a_posterior_has_the_errors_of_a_fit_that_leaves_too_much(spoilt_file: Path, tmp_path: Path):
    refit(spoilt_file, output=tmp_path / "RUN")
    before = read_calibration(tmp_path / "RUN" / "calibration.fits", any_model=True)
    assert before.verdict.errors_from.startswith("residuals")
    found = sample(tmp_path / "RUN", **(OPTIONS | {"maximum_steps": 100_000}))
    assert found.trusted
    after = read_calibration(tmp_path / "RUN" / "calibration.fits", any_model=True)
    assert after.verdict.errors_from == before.verdict.errors_from == found.errors_from
    free = before.sigma > 0
    ratio = after.sigma[free] / before.sigma[free]
    assert np.all(np.abs(ratio - 1.0) < 0.15)
    # The stated errors are smaller by √(χ²/dof) at least.
    stated = np.sqrt(np.diag(stated_covariance(Run(tmp_path / "RUN").fit())))[free]
    assert np.median(after.sigma[free] / stated) > 1.5


def stated_covariance(result: FitResult) -> np.ndarray:
    """The covariance of a fit with the errors that its data state."""
    return covariance(result.model, result.expansion)


def test_what_is_no_run_is_refused(fitted: FittedSet, tmp_path: Path):
    with pytest.raises(DataError, match="not a folder"):
        sample(fitted.calset)
    with pytest.raises(DataError, match="no such file"):
        sample(tmp_path)
    with pytest.raises(DataError, match=r"m\.toml: there is no such file"):
        sample(fitted.run, model=tmp_path / "m.toml")
