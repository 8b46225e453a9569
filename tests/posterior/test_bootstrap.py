"""The fit repeated on simulated sets: what is drawn, and its spread beside the covariance of the fit."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import walop_jax as walop
from walop_jax.io.errors import DataError
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.posterior.bootstrap import Bootstrap, simulated_like, with_priors_drawn
from walop_jax.posterior.result import Options
from walop_jax.posterior.sampling import sample

from .conftest import Scene


def test_simulated_counts_scatter_about_the_model_as_their_errors_say(scene: Scene) -> None:
    result, rng = scene.result, np.random.default_rng(1)
    residual = result.likelihood.residuals(result.values)[1]
    used = result.likelihood.used
    weight = result.likelihood.points.gathered("weight")
    counts = result.likelihood.points.gathered("counts")
    model = (counts - residual / np.where(weight > 0, weight, 1.0))[used]
    drawn = []
    for _ in range(50):
        block = simulated_like(result, rng).intensities.block(0, len(result.calset.points))
        np.testing.assert_array_equal(block.used, used)
        drawn.append((block.counts[used] - model) * weight[used])
    away = np.array(drawn)
    assert away.mean() == pytest.approx(0.0, abs=5.0 / np.sqrt(away.size))
    assert away.std() == pytest.approx(1.0, abs=5.0 / np.sqrt(2.0 * away.size))
    assert np.abs(away.mean(axis=0)).max() < 6.0 / np.sqrt(50)


def test_means_of_priors_are_drawn_about_the_fit(scene: Scene) -> None:
    model, values = scene.result.model, scene.result.values
    held = next(p.name for p in model.parameters if p.free and p.prior is not None)
    model = model.change(held, free=False)
    rng = np.random.default_rng(2)
    drawn = [with_priors_drawn(model, values, rng) for _ in range(200)]
    assert all(one[held].prior == model[held].prior for one in drawn)
    rows = [i for i, p in enumerate(model.parameters) if p.free and p.tie is None and p.prior is not None]
    means = np.array([[one.parameters[i].prior[0] for i in rows] for one in drawn])  # pyright: ignore[reportOptionalSubscript]
    widths = np.array([model.parameters[i].width for i in rows])
    assert all(one.parameters[i].width == model.parameters[i].width for one in drawn for i in rows)
    pulls = (means - values[rows]) / widths
    assert pulls.mean() == pytest.approx(0.0, abs=5.0 / np.sqrt(pulls.size))
    assert pulls.std() == pytest.approx(1.0, abs=5.0 / np.sqrt(2.0 * pulls.size))


def test_its_spread_is_the_covariance_of_the_fit(scene: Scene) -> None:
    """Where the model is linear within its errors; of 220 draws a standard deviation is known to 5 %."""
    result = dataclasses.replace(
        scene.result, likelihood=Likelihood.of(scene.result.calset, scene.result.model)
    )
    found = sample(result, Options(sampler=Bootstrap(refits=220), seed=5))
    assert found.trusted, found.warnings
    assert found.counts == {"refits": 220, "converged": 220, "fitted alone": 0}
    free = result.model.free
    covariance = result.covariance[np.ix_(free, free)]
    root = np.linalg.cholesky(covariance / np.outer(*2 * (result.sigma[free],)))
    drawn = found.draws.reshape(-1, len(found.names))
    white = np.linalg.solve(root, ((drawn - result.values)[:, free] / result.sigma[free]).T)
    assert np.abs(white.mean(axis=1)).max() < 5.0 / np.sqrt(200)
    assert np.abs(white.std(axis=1) - 1.0).max() < 5.0 / np.sqrt(400)
    assert set(found.sampled) <= set(found.names)
    assert found.intervals()["MEDIAN"][0] == pytest.approx(result.values[found.varying], abs=1.0, rel=0.05)


def test_what_it_cannot_do_is_said(scene: Scene) -> None:
    with pytest.raises(DataError, match="2 refits are too few"):
        sample(scene.result, Options(sampler=Bootstrap(refits=2)))
    few = sample(scene.result, Options(sampler=Bootstrap(refits=40)))
    assert not few.trusted
    assert "40 independent draws; the covariance of 43 parameters needs 215" in few.convergence.message()
    with pytest.raises(TypeError, match="no chains"):
        Bootstrap().start(scene.surrogate.density(), [0])
    assert isinstance(walop.Options(sampler="bootstrap", maximum_steps=10).make_sampler(), Bootstrap)
