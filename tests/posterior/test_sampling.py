"""`sample` on a small world: the whole way, interrupted, refused, written and read back."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from quick import quick

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.matrix import matrices, matrix_draws
from walop_jax.data.settings import Settings
from walop_jax.data.user_tables import read_input_table
from walop_jax.fit.refit import FitResult, fit
from walop_jax.io.errors import DataError
from walop_jax.io.plain_tables import astropy_table, write_table
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.noise import with_noise
from walop_jax.posterior import sampling
from walop_jax.posterior.draws import read_draws, with_draws, with_moments
from walop_jax.posterior.files import write_posterior
from walop_jax.posterior.result import Options, PosteriorSample
from walop_jax.posterior.sampling import sample

from .conftest import Scene

OPTIONS = Options(seed=3, interval=200, draws=2000, checks=64)


@pytest.fixture(autouse=True)
def _built_once(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """The surrogate of the scene, with or without a scale of the errors, instead of a new one for every test."""

    def build(*args: Any, scale: float | None = None, **others: Any) -> Any:
        return dataclasses.replace(scene.surrogate, scale=scale)

    monkeypatch.setattr(sampling, "build_surrogate", build)


def with_scale(scene: Scene) -> FitResult:
    """The fit of the scene with a scale of all errors."""
    model = with_noise(scene.result.model, scale="all")
    start = np.append(scene.result.values, 1.0)
    return fit(Likelihood.of(scene.result.calset, model), start=start).with_verdict()


@pytest.fixture(scope="module")
def posterior(scene: Scene) -> PosteriorSample:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sampling, "build_surrogate", lambda *a, **k: scene.surrogate)
        return sample(scene.result, OPTIONS)


def test_posterior_agrees_with_laplace_where_that_holds(scene: Scene, posterior: PosteriorSample) -> None:
    assert posterior.trusted, posterior.warnings
    free = scene.world.likelihood.model.free
    pull = (posterior.mean - scene.result.values)[free] / scene.result.sigma[free]
    ratio = np.sqrt(np.diag(posterior.covariance))[free] / scene.result.sigma[free]
    assert np.abs(pull).max() < 0.2
    assert 0.9 < ratio.min() < ratio.max() < 1.1
    drawn = posterior.draws.reshape(-1, len(posterior.names))
    np.testing.assert_allclose(
        drawn.std(axis=0)[free], np.sqrt(np.diag(posterior.covariance))[free], rtol=0.08
    )
    assert np.ptp(drawn[:, [i for i in range(len(posterior.names)) if i not in free]], axis=0).max() == 0.0
    true = (posterior.mean - scene.world.truth)[free] / np.sqrt(np.diag(posterior.covariance))[free]
    assert np.abs(true).max() < 4.5


@pytest.mark.parametrize("cut", quick([1, 2], [1]))
def test_interrupted_is_uninterrupted(scene: Scene, tmp_path: Path, cut: int) -> None:
    result = scene.result
    options = dataclasses.replace(OPTIONS, moves="de", maximum_steps=600)
    whole = sample(result, options, folder=tmp_path / "whole")
    done = 0

    def stop(progress: Any) -> None:
        nonlocal done
        done += progress.stage == "sampling"
        if done > cut:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sample(result, options, folder=tmp_path / "cut", report=stop)
    assert [path.name for path in (tmp_path / "cut").iterdir()] == ["chain.h5"]
    resumed = sample(result, options, folder=tmp_path / "cut", resume=True)
    np.testing.assert_array_equal(resumed.chains, whole.chains)
    np.testing.assert_array_equal(resumed.draws, whole.draws)
    np.testing.assert_array_equal(resumed.covariance, whole.covariance)


def test_resume_refuses_what_has_changed(scene: Scene, tmp_path: Path) -> None:
    model, result = scene.result.model, scene.result
    options = dataclasses.replace(OPTIONS, maximum_steps=200)
    sample(result, options, folder=tmp_path / "chain")
    with pytest.raises(DataError, match="holds a chain already"):
        sample(result, options, folder=tmp_path / "chain")
    with pytest.raises(DataError, match="other settings"):
        sample(result, dataclasses.replace(options, seed=4), folder=tmp_path / "chain", resume=True)
    changed = model.change(model.names[model.free[0]], prior=(0.81, 0.02))
    likelihood = Likelihood.of(result.calset, changed, batch=result.likelihood.layout.batch)
    other = dataclasses.replace(result, likelihood=likelihood)
    with pytest.raises(DataError, match="other priors"):
        sample(other, options, folder=tmp_path / "chain", resume=True)


def test_a_chain_cut_short_says_so(scene: Scene, tmp_path: Path) -> None:
    options = dataclasses.replace(OPTIONS, moves="stretch", maximum_steps=200)
    short = sample(scene.result, options)
    assert not short.trusted
    assert "Go on for" in short.warnings[0]
    write_posterior(tmp_path / "short.nc", short)
    with pytest.raises(DataError, match="not to be trusted"):
        read_draws(tmp_path / "short.nc", short.names)


def test_a_scale_of_the_errors_is_sampled_with_the_rest(scene: Scene) -> None:
    result = with_scale(scene)
    sampled = sample(result, dataclasses.replace(OPTIONS, interval=400))
    assert sampled.trusted, sampled.warnings
    measured = scene.target.measured
    value, error = sampled.value("noise.scale")
    expected = np.sqrt(scene.result.expansion.data / (measured - len(scene.target.free)))
    assert value == pytest.approx(expected, abs=1.0 / np.sqrt(measured))
    assert error == pytest.approx(expected / np.sqrt(2 * measured), rel=0.15)
    drawn = sampled.draws[..., sampled.names.index("noise.scale")]
    assert (drawn.mean(), drawn.std()) == (
        pytest.approx(value, abs=0.1 * error),
        pytest.approx(error, rel=0.1),
    )
    assert "noise.scale" in sampled.intervals()["NAME"][0]
    assert "noise.scale" in sampled.sampled


def test_errors_that_differ_between_cameras_need_the_exact_posterior(scene: Scene) -> None:
    calset = scene.result.calset
    model = with_noise(scene.result.model, fraction="camera")
    start = np.append(scene.result.values, model.start[len(scene.result.values) :])
    result = fit(Likelihood.of(calset, model), start=start).with_verdict()
    with pytest.raises(DataError, match=r"noise\.fraction_O1.*--sampler nuts"):
        sample(result, OPTIONS)


def test_posterior_file_table_and_report(posterior: PosteriorSample, tmp_path: Path) -> None:
    write_posterior(tmp_path / "posterior.nc", posterior)
    draws = read_draws(tmp_path / "posterior.nc", posterior.names)
    np.testing.assert_array_equal(draws, posterior.draws.reshape(draws.shape))
    for same in (posterior, posterior.groups(), posterior.to_arviz()):  # as `matrix` and `apply` take them
        np.testing.assert_array_equal(read_draws(same, posterior.names), draws)
    with pytest.raises(DataError, match="another model"):
        read_draws(tmp_path / "posterior.nc", posterior.names[1:])
    assert len(read_draws(tmp_path / "posterior.nc", posterior.names, posterior.fit)) == len(draws)
    with pytest.raises(DataError, match="is of another fit with the same parameters"):
        read_draws(tmp_path / "posterior.nc", posterior.names, posterior.fit[::-1])
    data = posterior.to_arviz()
    assert data.posterior["half1.plate.quartz"].attrs["units"] == "um"
    assert data.posterior["half1.wedge"].shape == posterior.draws.shape[:2]
    assert data.posterior.attrs["converged"] == 1
    assert data.posterior.attrs["inference_library"] == "walop-jax"

    columns = posterior.intervals()
    row = list(columns["NAME"][0]).index("half2.wedge")
    low, middle, high = (columns[name][0][row] for name in ("LOW95", "MEDIAN", "HIGH95"))
    sigma = columns["SIGMA"][0][row]
    assert (high - low) / (4 * sigma) == pytest.approx(1.0, abs=0.1)
    assert low < middle < high
    for name in ("posterior.fits", "posterior.ecsv"):
        write_table(tmp_path / name, astropy_table(columns, {"TRUSTED": True}))
        table = read_input_table(tmp_path / name)
        assert {"NAME", "MEDIAN", "LOW68", "HIGH68", "LOW95", "HIGH95"} <= set(table.names)
    assert posterior.document()["trusted"] is True


def test_a_fit_in_arviz_has_its_values_and_covariance(scene: Scene) -> None:
    """Sample moments of 40 000 independent draws, to 5 of their own standard errors; what is frozen does not vary."""
    import arviz as az

    fit = scene.result
    data = fit.to_arviz(draws=10_000, seed=1)
    names = [p.name for p, sigma in zip(fit.model.parameters, fit.sigma, strict=True) if sigma > 0]
    assert [*data.posterior.data_vars] == names
    at = [fit.model.index(name) for name in names]
    z = np.stack([(data.posterior[n].values.ravel() - fit.value(n)[0]) / fit.value(n)[1] for n in names])
    correlation = fit.covariance[np.ix_(at, at)] / np.outer(fit.sigma[at], fit.sigma[at])
    assert np.abs(z.mean(axis=1)).max() < 5 / np.sqrt(40_000)
    np.testing.assert_allclose(z @ z.T / 40_000, correlation, atol=5 * np.sqrt(2 / 40_000))
    assert data.posterior["half1.plate.quartz"].attrs["units"] == "um"
    assert data.observed_data.sizes["camera"] == 4
    said = az.summary(data, var_names=["half2.wedge"], round_to="none").loc["half2.wedge"]
    assert said["sd"] == pytest.approx(fit.value("half2.wedge")[1], rel=0.02)
    assert said["r_hat"] < 1.01


def test_arviz_finds_what_it_looks_for(scene: Scene, posterior: PosteriorSample) -> None:
    """Its own numbers: means and widths; rows of the data; as many effective parameters as the posterior is worth.

    For normal posteriors the mean of χ² over draws is that at the mean plus p_D, and p_loo is near p_D.
    """
    import arviz as az

    few = dataclasses.replace(
        posterior, draws=posterior.draws[:, ::4], log_posterior=posterior.log_posterior[:, ::4]
    )
    data = few.to_arviz(log_likelihood=True)
    said = az.summary(data, var_names=["half2.wedge"], round_to="none").loc["half2.wedge"]
    mean, width = posterior.value("half2.wedge")
    assert abs(said["mean"] - mean) < 0.2 * width
    assert said["sd"] == pytest.approx(width, rel=0.15)
    block = scene.world.likelihood.calset.intensities
    counts = block.counts[block.used]
    assert dict(data.observed_data.sizes) == {"row": len(counts), "camera": 4}
    np.testing.assert_array_equal(np.sort(data.observed_data["N"], axis=0), np.sort(counts, axis=0))
    np.testing.assert_allclose(
        np.sort(data.constant_data["N_ERR"], axis=0), np.sort(block.sigma[block.used], axis=0), rtol=1e-12
    )
    first = data.observed_data.isel(row=0)  # where its coordinates say
    (row,) = np.flatnonzero((block.point == int(first.point)) & (block.exposure == int(first.exposure)))
    np.testing.assert_array_equal(first["N"], block.counts[row])
    by_row = data.log_likelihood["N"].values
    centre = np.broadcast_to(posterior.mean, (2, 1, len(posterior.mean)))
    one = dataclasses.replace(posterior, draws=centre, log_posterior=np.zeros((2, 1)))
    at_mean = one.log_likelihood()[0, 0]
    worth = -2.0 * (by_row.sum(axis=2).mean() - at_mean.sum())
    assert 0.5 * len(scene.target.free) < worth < 1.02 * len(scene.target.free)
    assert at_mean.sum() == pytest.approx(
        -0.5 * scene.target.data(posterior.mean[scene.target.free])
        - 0.5 * scene.target.measured * np.log(2 * np.pi) - np.log(block.sigma[block.used]).sum()
    )  # fmt: skip
    loo = az.loo(data)
    assert (loo.p if hasattr(loo, "p") else loo.p_loo) == pytest.approx(worth, rel=0.35)  # ArviZ 1, 0


def test_matrix_by_draws_agrees_with_the_covariance(
    scene: Scene, posterior: PosteriorSample, tmp_path: Path
) -> None:
    x, y = np.array([0.0, 0.2, -0.25]), np.array([0.0, 0.1, 0.2])
    model, filters = scene.world.likelihood.model, scene.world.likelihood.calset.filters
    drawn = matrix_draws(model, posterior.draws[0, :100], Settings.default(3), filters, x, y)
    instrument = model.instrument(posterior.mean)
    values, covariance = matrices(instrument, Settings.default(3), filters, x, y, posterior.covariance)
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    np.testing.assert_allclose(drawn.std(axis=0), sigma, rtol=0.3)
    assert np.max(np.abs(drawn.mean(axis=0) - values) / sigma) < 0.45
    write_posterior(tmp_path / "posterior.nc", posterior)
    calibration = with_draws(Calibration.from_fit(scene.result), tmp_path / "posterior.nc", 50)
    assert calibration.matrix(x, y)[1].shape == (3, 6, 6)
    moments = with_moments(Calibration.from_fit(scene.result), tmp_path / "posterior.nc")
    flat = posterior.draws.reshape(-1, len(posterior.names))
    np.testing.assert_allclose(moments.values, flat.mean(axis=0), rtol=1e-12)
    away = flat - flat.mean(axis=0)
    np.testing.assert_allclose(moments.covariance, away.T @ away / (len(flat) - 1), rtol=1e-9, atol=1e-18)


def test_options_that_make_no_sense() -> None:
    for wrong in (
        {"moves": "walk"}, {"ensembles": 1}, {"interval": 3}, {"draws": 0}, {"maximum_steps": 100},
        {"parameters": tuple("abcdefghijklmnopqrstu")},
    ):  # fmt: skip
        with pytest.raises(ValueError, match=r"\w"):
            Options(**wrong)  # pyright: ignore[reportArgumentType]
