"""`sample` from Python: the posterior of a run, interrupted, resumed, refused."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from walop_jax.calibration.product import read_product
from walop_jax.commands.refit import refit
from walop_jax.commands.sample import OUTPUTS, sample
from walop_jax.fit.refit import FitResult, covariance
from walop_jax.io.errors import DataError
from walop_jax.posterior.run import Run

from .conftest import FittedSet, assert_same_files

STEPS = 300  # 400 are enough
OPTIONS = {"interval": 100, "maximum_steps": STEPS, "moves": "laplace"}


def copied(fitted: FittedSet, folder: Path) -> Path:
    return Path(shutil.copytree(fitted.run, folder))


@pytest.mark.long
def test_an_interrupted_run_goes_on_as_if_nothing_had_been(
    call, fitted: FittedSet, tmp_path: Path, monkeypatch
):
    command, caller = copied(fitted, tmp_path / "command"), copied(fitted, tmp_path / "caller")
    options = ("--interval", 100, "--maximum-steps", STEPS, "--moves", "laplace", "--quiet")
    assert call("sample", command, *options).exit_code == 1  # so few steps do not converge

    told: list[str] = []

    def interrupt(text: str) -> None:
        told.append(text)
        if sum(entry.startswith("sampling") for entry in told) == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sample(caller, **OPTIONS, progress=interrupt)
    assert {entry.partition(":")[0] for entry in told} == {"tabulating the model", "starting", "sampling"}
    assert "τ" in told[-1]
    assert not any((caller / name).exists() for name in OUTPUTS)
    assert [path.name for path in (caller / "sampling").iterdir()] == ["chain.h5"]

    with pytest.raises(DataError, match="holds a chain already"):
        sample(caller, **OPTIONS)
    found = sample(caller, **OPTIONS, resume=True)
    assert not found.trusted
    assert read_product(caller / "calibration.fits").verdict.covariance_from == "fit"
    assert_same_files(command, caller, but=("sampling", "summary.json"))

    with pytest.raises(DataError, match=r"holds posterior\.nc already"):
        sample(caller, **OPTIONS)

    # On to convergence; the files of a posterior that is to be trusted appear together or not at all.
    before = {name: (caller / name).read_bytes() for name in (*OUTPUTS, "calibration.fits")}
    more = OPTIONS | {"maximum_steps": 100_000}

    def fail(*args: object) -> None:
        raise OSError("No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("walop_jax.calibration.write_calibration", fail)
        with pytest.raises(DataError, match="the old content is untouched"):
            sample(caller, **more, resume=True)
    assert {name: (caller / name).read_bytes() for name in before} == before
    found = sample(caller, **more, resume=True)
    assert found.trusted
    product = read_product(caller / "calibration.fits")
    assert product.verdict.covariance_from == "posterior"
    np.testing.assert_array_equal(product.covariance, found.covariance)


@pytest.mark.long
def test_a_posterior_has_the_errors_of_a_fit_that_leaves_too_much(spoilt_file: Path, tmp_path: Path):
    refit(spoilt_file, output=tmp_path / "RUN")
    before = read_product(tmp_path / "RUN" / "calibration.fits")
    assert before.verdict.errors_from.startswith("residuals")
    found = sample(tmp_path / "RUN", **(OPTIONS | {"maximum_steps": 100_000}))
    assert found.trusted
    after = read_product(tmp_path / "RUN" / "calibration.fits")
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
