"""Rows of what is known beforehand: one for every free parameter with a prior or a pull, none for any other."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from walop_jax.diagnosis.design import Design
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import fit
from walop_jax.likelihood.inverses import determined
from walop_jax.likelihood.likelihood import Likelihood, prior_rows
from walop_jax.posterior.target import Target
from walop_jax.simulation.observing_plan import ObservingPlan, polariser_turn
from walop_jax.simulation.simulate import simulate

RUN = ObservingPlan(
    grid=3, standard_grid=2, polariser_angles=polariser_turn(6), moon_patches=2, standards=2,
    throughput_degree=1,
)  # fmt: skip
MASTER, TIED = "throughput.n1.p00", "throughput.n2.p00"


@pytest.fixture(scope="module")
def calset():
    return simulate(RUN, seed=8).calset


@pytest.fixture(scope="module")
def model(calset):
    """Two loosely pulled parameters tied, one of them with a start of its own; one with a prior frozen off it."""
    model = base_model(calset, throughput_degree=1)
    assert model[TIED].loose is not None
    frozen = model["pupil.magnification"]
    return (
        model.change(TIED, tie=MASTER, start=0.7)
        .change("half1.plate.mgf2", tie="half2.plate.mgf2")
        .change(frozen.name, free=False, start=frozen.prior[0] + 5 * frozen.prior[1])
    )


def test_rows_are_those_of_the_free_parameters(model):
    rows = prior_rows(model)
    expected = [
        name
        for name, p in zip(model.names, model.parameters, strict=True)
        if p.free and p.tie is None and (p.prior is not None or p.loose is not None)
    ]
    assert [model.names[i] for i in rows.index] == expected
    for name in (TIED, "half1.plate.mgf2", "pupil.magnification", "throughput.n0.p00"):
        assert model.index(name) not in rows.index
    at = rows.index.tolist().index(model.index(MASTER))
    assert (rows.mean[at], rows.width[at], rows.known[at]) == (
        model[MASTER].start,
        model[MASTER].loose,
        False,
    )
    plate = model["half2.plate.mgf2"]
    at = rows.index.tolist().index(model.index(plate.name))
    assert (rows.mean[at], rows.width[at], rows.known[at]) == (*plate.prior, True)


def test_a_master_is_pulled_once_whatever_is_tied_to_it(calset, model):
    """The objective against one that is written down from the model, away from the start."""
    likelihood = Likelihood.of(calset, model)
    x = model.start[model.free] + 0.3 * np.array([model.parameters[i].scale for i in model.free])
    values = model.full(x)
    assert values[model.index(TIED)] == values[model.index(MASTER)]
    priors = loose = 0.0
    for name in {model.names[i] for i in model.free}:
        p, value = model[name], values[model.index(name)]
        if p.prior is not None:
            priors += ((value - p.prior[0]) / p.prior[1]) ** 2
        elif p.loose is not None:
            loose += ((value - p.start) / p.loose) ** 2
    found = likelihood.expand(values)
    assert found.priors == pytest.approx(priors, rel=1e-12)
    assert found.loose == pytest.approx(loose, rel=1e-12)
    # Its gradient is the derivative of the objective, by differences of the priors' share, which is quadratic.
    for k in (0, len(x) - 1):
        step = 1e-3 * x[k] or 1e-3
        up, down = (likelihood.expand(model.full(x + s * step * np.eye(len(x))[k])) for s in (1, -1))
        difference = (up.objective - down.objective) / (4 * step)
        assert found.gradient[k] == pytest.approx(
            difference, rel=1e-3, abs=1e-3 * np.sqrt(found.matrix[k, k])
        )


def test_fit_sampler_and_diagnosis_have_one_posterior(calset, model):
    """χ² of data, priors and pulls of the same three, with a tied parameter that has a pull of its own declared."""
    result = fit(Likelihood.of(calset, model))
    expansion, target, design = result.expansion, Target(result), Design.of(result)
    x = result.values[model.free]
    assert target.objective(x) == pytest.approx(expansion.objective, rel=1e-10)
    assert design.residual @ design.residual == pytest.approx(expansion.objective, rel=1e-10)
    np.testing.assert_allclose(target.prior_rows(x), -design.residual[design.rows :], rtol=1e-12)
    size = np.sqrt(np.diag(expansion.matrix))
    gram = design.jacobian.T @ design.jacobian
    np.testing.assert_allclose(
        gram / np.outer(size, size), expansion.matrix / np.outer(size, size), atol=1e-9
    )
    pulls = sum(
        p.free and p.tie is None and p.prior is None and p.loose is not None for p in model.parameters
    )
    fluxes = int(result.likelihood.used.sum())
    assert fluxes < design.eliminated <= fluxes + pulls
    assert design.projector.free == expansion.dof


def test_a_frozen_parameter_is_taken_as_it_is(calset, model):
    """Where it is frozen does not enter χ² by its prior: it is not asked, and no degree of freedom counts it."""
    name = "pupil.magnification"
    frozen = model.change(name, start=model[name].prior[0])
    wide = frozen.change(name, prior=(model[name].prior[0] + 1.0, model[name].prior[1]))
    one, other = (Likelihood.of(calset, m).expand(frozen.start) for m in (frozen, wide))
    assert (one.chi2, one.dof) == (other.chi2, other.dof)
    assert dataclasses.replace(one, matrix=other.matrix).objective == other.objective


def test_degrees_of_freedom_count_free_parameters_alone(calset, model):
    """Neither the frozen nor the tied ones; three numbers a row, four cameras less a flux."""
    varied = [p for p in model.parameters if p.free and p.tie is None]
    assert len(varied) <= len(model.parameters) - 3
    likelihood = Likelihood.of(calset, model)
    priors = sum(p.prior is not None for p in varied)
    assert likelihood.independent == 3 * likelihood.used.sum() + priors
    # Where all are equal, the two slopes over the field that cameras have in common are fluxes.
    assert likelihood.expand(model.start).dof == likelihood.independent - (len(varied) - 2)


def test_terms_that_no_data_determine_are_no_lost_degrees_of_freedom(calset):
    """59 terms of the series at 13 places, where four cameras have three ratios: 39, the rank of the derivatives."""
    model = base_model(calset)
    likelihood = Likelihood.of(calset, model)
    pulled = [model.parameters[i].loose is not None for i in model.free]
    columns = likelihood.jacobian(model.start)[:, pulled] * [
        model.parameters[i].loose for i in model.free[pulled]
    ]
    rank = np.linalg.matrix_rank(columns, tol=1.0)  # singular values: how much better data know than pulls
    assert (sum(pulled), rank) == (59, 3 * len(calset.points))
    others = len(pulled) - sum(pulled)
    assert likelihood.expand(model.start).dof == likelihood.independent - others - rank


def test_parameters_that_data_determine_in_closed_form():
    """Alone a share a / (a + w); of two that are seen as a sum one; of what nothing pulls, all."""
    a, w = np.array([3.0, 0.0, 5.0]), np.array([1.0, 2.0, 0.0])
    assert determined(np.diag(a + w), w) == pytest.approx(3.0 / 4.0 + 0.0 + 1.0)
    seen, pull = 1e6 * np.ones((2, 2)), np.full(2, 1e-3)
    assert determined(seen + np.diag(pull), pull) == pytest.approx(1.0)
    assert determined(np.zeros((2, 2)), np.zeros(2)) == 2.0
    assert determined(np.diag([0.0, 4.0]), np.array([0.0, 1.0])) == pytest.approx(1.75)


def test_expected_chi_square_of_a_linear_model_is_its_degrees_of_freedom():
    """Ten data, six parameters of which the data see three, drawn from their pulls: mean χ² of 20 000 fits."""
    rng = np.random.default_rng(5)
    rows = rng.standard_normal((10, 3)) @ np.eye(3, 6)
    weak = np.full(6, 0.2)
    matrix = rows.T @ rows + np.diag(weak)
    data = rows @ (rng.standard_normal((6, 20_000)) / np.sqrt(weak)[:, None])
    data += rng.standard_normal(data.shape)
    chi2 = np.sum((data - rows @ np.linalg.solve(matrix, rows.T @ data)) ** 2, axis=0)
    dof = 10 - determined(matrix, weak)
    assert 7.0 < dof < 7.5
    assert chi2.mean() == pytest.approx(dof, abs=5 * chi2.std() / np.sqrt(chi2.size))
