"""Free errors of the data in a diagnosis: held at what no candidate explains, and free in the model that is found."""

import dataclasses

import numpy as np
import pytest
from small_run import SMALL, small_fit

from walop_jax.data.table_intensities import TableIntensities
from walop_jax.diagnosis.examination import examine
from walop_jax.diagnosis.held_errors import errors_behind, fits_errors, with_errors_free, with_errors_held
from walop_jax.diagnosis.hypotheses import Hypotheses, probes
from walop_jax.diagnosis.workflow import diagnose
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import fit
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects import effect_by_name
from walop_jax.model.effects.in_models import effect_context
from walop_jax.model.noise import with_noise
from walop_jax.simulation.simulate import effect_from_text, simulate

LEAK = "camera_leakage=0.02"
"""Light of one camera in another, ten times the usual share."""


def examined(result, *names):
    """The examination of a fit beside some effects of the catalogue, without descriptions."""
    context = effect_context(result.model.template, result.calset.exposures)
    asked = list(probes([effect_by_name(name) for name in names], context))
    return examine(result, Hypotheses(asked), np.random.default_rng(1))


def leaking(seed=6001):
    return simulate(SMALL, seed=seed, effects=[effect_from_text(LEAK, SMALL.context())]).calset


def test_one_scale_is_the_scatter_behind_everything_by_the_closed_form():
    """s² = |r̃|² / (n − n_F − tr H), H the projection on parameters and candidates, by least squares."""
    calset = leaking()
    model = with_noise(base_model(calset), scale="all")
    held = model.change("noise.scale", free=False)
    result = fit(Likelihood.of(calset, held))
    found = examined(result, "camera_leakage", "ghost", "nonlinearity")
    design, columns = found.design, np.concatenate(found.columns, axis=1).astype(float)
    columns = columns[:, found.bare.independent()[0]] / result.noise_scale
    columns = np.vstack([columns, np.zeros((len(design.residual) - design.rows, columns.shape[1]))])
    both = np.hstack([design.jacobian, columns])
    u = np.linalg.qr(both / np.linalg.norm(both, axis=0))[0]
    left = (design.residual - u @ (u.T @ design.residual))[: design.rows]
    freedom = design.rows - design.measured.used.sum() - np.sum(u[: design.rows] ** 2)
    (scale,) = errors_behind(found, model)
    assert result.chi2 > 20.0 * result.dof
    assert scale == pytest.approx(result.noise_scale * np.sqrt(np.sum(left**2) / freedom), rel=1e-3)
    assert scale == pytest.approx(1.0, abs=0.1)


def test_a_model_without_free_errors_stays_as_it_is():
    result = small_fit()
    likelihood = result.likelihood
    assert not fits_errors(likelihood.model)
    assert with_errors_held(likelihood, lambda _: pytest.fail("nothing is examined")) is likelihood.model
    assert with_errors_free(result, likelihood.model) is result


def test_errors_are_free_again_as_they_were_given():
    calset = small_fit().calset
    given = with_noise(base_model(calset), scale="all", fraction="O1")
    held = given.change("noise.scale", free=False, start=1.7).change(
        "noise.fraction_O1", free=False, start=0.0
    )
    result = with_errors_free(fit(Likelihood.of(calset, held)), given)
    alone = fit(Likelihood.of(calset, given))
    assert result.model["noise.scale"].free
    assert result.model["noise.fraction_O1"].prior == given["noise.fraction_O1"].prior
    np.testing.assert_allclose(result.values, alone.values, atol=0.02 * alone.sigma.max(), rtol=0.02)


def test_an_effect_is_named_beside_free_errors():
    """N_ERR too small by 1.3 and 0.4 % of the counts: the fit alone takes the leak for noise of 35 N_ERR."""
    calset, rng = leaking(), np.random.default_rng(3)
    table = calset.intensities
    assert isinstance(table, TableIntensities)
    further = np.sqrt((1.3**2 - 1.0) * table.sigma**2 + (0.004 * table.counts) ** 2)
    counts = table.counts + further * rng.standard_normal(table.counts.shape)
    loud = dataclasses.replace(calset, intensities=dataclasses.replace(table, counts=counts))
    found = diagnose(loud, with_noise(base_model(loud), scale="all", fraction="all"))
    assert [step.effect for step in found.steps] == ["camera_leakage"]
    for name, true in (("noise.scale", 1.3), ("noise.fraction", 0.004)):
        value, error = found.after.value(name)
        assert abs(value - true) < 3.0 * error
