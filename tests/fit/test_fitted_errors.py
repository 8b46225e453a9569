"""Errors of the data as a part of the model: found by a fit, stated in model files, carried by calibrations."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_run import SMALL, small_fit

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.product import read_calibration, write_calibration
from walop_jax.data.records import CalibrationSet
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.fit.base_model import base_model
from walop_jax.fit.many import refit_many
from walop_jax.fit.model_file import render
from walop_jax.fit.model_of_set import model_for, model_like
from walop_jax.fit.refit import FitResult, fit
from walop_jax.likelihood.forward import Forward
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.noise import with_noise
from walop_jax.simulation.simulate import simulate


def table(calset: CalibrationSet) -> TableIntensities:
    assert isinstance(calset.intensities, TableIntensities)
    return calset.intensities


def with_stated(calset: CalibrationSet, factor: float) -> CalibrationSet:
    """The set with its stated errors times a factor."""
    stated = dataclasses.replace(table(calset), sigma=factor * table(calset).sigma)
    return dataclasses.replace(calset, intensities=stated)


def fitted(calset: CalibrationSet, **groups: str) -> FitResult:
    return fit(Likelihood.of(calset, with_noise(base_model(calset), **groups)))


def test_the_gradient_that_a_search_follows_is_that_of_its_objective():
    """Of χ² + Σ ln σ², errors and optics, by central differences of the value; without it a search stands still.

    Data of one camera are 3 % too bright: the fluxes that its fraction leaves hang on what the model says.
    """
    calset = small_fit().calset
    counts = table(calset).counts * np.array([1.03, 1.0, 1.0, 1.0])
    calset = dataclasses.replace(calset, intensities=dataclasses.replace(table(calset), counts=counts))
    likelihood = Likelihood.of(calset, with_noise(base_model(calset), scale="all", fraction="all"))
    values, model = likelihood.model.start, likelihood.model
    likelihood = dataclasses.replace(likelihood, light=likelihood.light_at(values))

    def terms(at: np.ndarray) -> tuple[float, np.ndarray]:
        found = likelihood.data_terms(at)[0]
        return 0.5 * (found.data + found.log_variance), np.asarray(found.gradient)

    gradient = terms(values)[1]
    for name in ("noise.scale", "noise.fraction", "half1.efficiency", "half2.efficiency"):
        step = np.zeros(len(values))
        step[model.index(name)] = 1e-5
        difference = (terms(values + step)[0] - terms(values - step)[0]) / (2.0 * step.max())
        assert gradient[model.index(name)] == pytest.approx(difference, rel=1e-4), name


@pytest.mark.parametrize("factor", [0.2, 1.0, 3.0])
def test_a_scale_makes_up_for_errors_as_stated(factor):
    """s is √(χ²/dof) of the fit without it, over the factor; all other parameters and errors are as with errors × s."""
    plain = small_fit()
    found = fitted(with_stated(plain.calset, factor), scale="all")
    assert found.converged
    value, error = found.value("noise.scale")
    assert value == pytest.approx(np.sqrt(plain.chi2 / plain.dof) / factor, abs=0.5 * error)
    assert error == pytest.approx(value / np.sqrt(2.0 * plain.dof), rel=0.05)
    assert found.chi2 == pytest.approx(found.dof, rel=0.02)
    with_scale = fit(Likelihood.of(with_stated(plain.calset, factor * value), plain.model))
    free, n = plain.model.free, len(plain.values)
    np.testing.assert_allclose(
        found.values[:n][free], with_scale.values[free], atol=1e-3 * plain.sigma[free].max()
    )
    np.testing.assert_allclose(found.sigma[:n][free], with_scale.sigma[free], rtol=1e-2)


def test_scintillation_of_one_camera_is_found_where_it_is():
    plan = dataclasses.replace(SMALL, noise_scale=1.3)
    calset = simulate(plan, seed=3).calset
    block, rng = table(calset), np.random.default_rng(0)
    counts = block.counts.copy()
    counts[:, 1] *= 1.0 + 0.004 * rng.standard_normal(len(counts))
    calset = dataclasses.replace(calset, intensities=dataclasses.replace(block, counts=counts))
    found = fitted(calset, scale="all", fraction="camera")
    assert found.converged
    for name, truth in (("noise.scale", 1.3), ("noise.fraction_E1", 0.004)):
        value, error = found.value(name)
        assert abs(value - truth) < 4.0 * error, name
        assert error < 0.1 * truth
    for name in ("noise.fraction_O1", "noise.fraction_O2", "noise.fraction_E2"):
        value, error = found.value(name)
        assert abs(value) < 4.0 * error, name
    (told,) = (text for text in found.with_verdict().warnings if "errors of the data were fitted" in text)
    assert "noise.fraction_E1 = 0.00" in told


def test_the_forward_model_has_the_same_density():
    """The gradient in the parameters of the errors, by JAX beside the expansion of a fit, and the value."""
    calset = small_fit().calset
    model = with_noise(base_model(calset), scale=["clp", "moon", "standard"], fraction="camera")
    likelihood, forward = Likelihood.of(calset, model), Forward.of(calset, model)
    values = model.start.copy()
    values[: len(small_fit().values)] = small_fit().values
    expansion, at = likelihood.expand(values), model.positions("noise")
    slope = np.asarray(jax.grad(forward.log_likelihood)(jnp.asarray(values)))[at]
    rows, place = likelihood.priors, {i: n for n, i in enumerate(model.free.tolist())}
    pulls = np.zeros(len(values))
    pulls[rows.index] = rows.residuals(values) / rows.width
    half = np.array([expansion.gradient[place[i]] for i in at]) - pulls[at]
    np.testing.assert_allclose(-slope, half, rtol=1e-9)
    deviance = -2.0 * float(forward.log_likelihood(values))
    assert deviance == pytest.approx(expansion.data + expansion.log_variance, rel=1e-10)
    assert float(forward.log_variance(values)) == pytest.approx(expansion.log_variance, rel=1e-8)


def test_a_model_file_says_what_is_fitted(tmp_path: Path):
    calset = small_fit().calset
    text = '[noise]\nscale = "all"\nfraction = ["camera", "moon"]\n[parameters."noise.scale"]\nstart = 1.2\n'
    model = model_for(calset, text)
    names = [name for name in model.names if name.startswith("noise")]
    cameras = [f"noise.fraction_{camera}" for camera in ("O1", "E1", "O2", "E2")]
    assert names == ["noise.scale", *cameras, "noise.fraction_moon"]
    assert model["noise.scale"].start == 1.2
    assert model["noise.fraction_moon"].prior == (0.0, 0.01)
    again = model_for(calset, render(model))
    assert (again.names, again.start.tolist()) == (model.names, model.start.tolist())
    assert model_like(calset, model).names == model.names
    for wrong, message in (
        ('[noise]\nscale = "E3"\n', "'E3' is no group of intensities; did you mean"),
        ("[noise]\nscale = 2.0\n", r"\[noise\] scale = 2.0 must be"),
        ('[noise]\nfactor = "all"\n', "key of \\[noise\\] 'factor'"),
    ):
        with pytest.raises(ValueError, match=message):
            model_for(calset, wrong)


def test_a_calibration_carries_them(tmp_path: Path):
    found = fitted(small_fit().calset, scale="all").with_verdict()
    write_calibration(tmp_path / "c.fits", Calibration.from_fit(found))
    back = read_calibration(tmp_path / "c.fits")
    assert back["noise.scale"].value == found["noise.scale"].value
    matrix, plain = (
        Calibration.from_fit(one).matrix(0.1, -0.1)[0] for one in (found, small_fit().with_verdict())
    )
    np.testing.assert_allclose(back.matrix(0.1, -0.1)[0], matrix, atol=1e-14)
    np.testing.assert_allclose(matrix, plain, atol=1e-4)


def test_many_fits_have_them_one_by_one():
    calset = small_fit().calset
    model = with_noise(base_model(calset), scale="all")
    many = refit_many([calset, with_stated(calset, 0.5)], model)
    assert many.alone == (1,)
    assert many[1]["noise.scale"].value == pytest.approx(2.0 * many[0]["noise.scale"].value, rel=0.02)


def test_whatever_asks_a_fit_for_its_points_gets_the_fitted_errors():
    """Also where its likelihood is made anew, as for a sample of its points."""
    found = fitted(with_stated(small_fit().calset, 0.5), scale="all")
    again = dataclasses.replace(found, likelihood=Likelihood.of(found.calset, found.model))
    stated, used = found.likelihood.points_as_stated.gathered("weight"), found.likelihood.used
    scale = found["noise.scale"].value
    for one in (found, again):
        np.testing.assert_allclose(
            one.likelihood.points.gathered("weight")[used], stated[used] / scale, rtol=1e-12
        )
    np.testing.assert_array_equal(again.residuals(), found.residuals())
