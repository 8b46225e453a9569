"""Residuals and normal equations against plain derivatives, numpy, identities and the oracle."""

from __future__ import annotations

import dataclasses
import functools

import builders
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracle import forward, validate

from walop_jax.data.calset import read_calibration_set
from walop_jax.data.records import Block, CalibrationSet, Intensities, Points, Site, Sources
from walop_jax.fit.base_model import base_model
from walop_jax.likelihood import engine
from walop_jax.likelihood.flux import eliminate_flux
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.compiled import compiled
from walop_jax.model.parameters import values_of, with_values

POINTS = 7
# flux exposures come last so that they can be left off
ROWS = [
    *({"clp_angle": angle} for angle in (0.0, 50.0, 100.0)),
    *({"clp_angle": angle, "chwp_angle": 45.0} for angle in (20.0, 80.0, 140.0)),
    *({"kind": "moon", "ra": ra, "dec": 30.0, "rotator": 20.0} for ra in (100.0, 112.0)),
    *({"kind": "standard", "rotator": angle, "teff": 5500.0} for angle in (0.0, 40.0)),
    {"kind": "flux"},
]


class Dense(Intensities):
    """All intensities in memory."""

    def __init__(self, block):
        self.all = block

    def block(self, start, stop):
        return Block(*(getattr(self.all, f.name)[start:stop] for f in dataclasses.fields(Block)))

    @property
    def rows(self):
        return int(self.all.used.sum())


def calibration_set(block, rows=ROWS):
    sources = Sources(
        np.array([3, 9]), np.array(["POL", "UNPOL"]), np.array([0.03, 0.0]), np.array([-0.04, 0.0]),
        np.array([1e-3, 2e-3]), np.array([1e-3, 3e-3]), np.array([4500.0, np.nan]),
    )  # fmt: skip
    return CalibrationSet(
        instrument="WALOP-SOUTH",
        site=Site("SAAO 1-m", -32.38, 20.81, 1798.0),
        origin="made here",
        exposures=builders.exposures(*rows),
        points=Points(np.arange(len(block.x)), block.x, block.y),
        sources=sources,
        filters={"band": builders.curve([0.62, 0.6204, 0.6208], [1.0, 0.8, 0.3])},
        intensities=Dense(block),
    )


@functools.cache
def make_block(seed=3, noise=True, flux_known=True):
    """Counts of a random as-built instrument at random points, at random fluxes, with some rows unused."""
    rng = np.random.default_rng(seed)
    x, y = builders.field(rng, POINTS)
    e = len(ROWS)
    source = np.full((POINTS, e), -1)
    source[:, 8:10] = rng.integers(0, 2, (POINTS, 2))
    sigma = rng.uniform(300.0, 900.0, (POINTS, e, 4))
    used = rng.uniform(size=(POINTS, e)) > 0.15
    block = Block(x, y, np.ones((POINTS, e, 4)), sigma, used, source)
    calset = calibration_set(block)
    model = base_model(calset, throughput_degree=2)
    instrument = builders.as_built(model.instrument(model.start), rng)
    likelihood = Likelihood.of(calset, model)
    flux = rng.uniform(0.5e6, 1.5e6, (POINTS, e, 1))
    if flux_known:
        flux[:, -1] = 1.0
    counts = flux * np.asarray(engine.prediction(instrument, likelihood.plan, next(iter(likelihood.points))))
    sigma = sigma * np.where(flux == 1.0, 1e-6, 1.0)
    if noise:
        counts = counts + sigma * rng.standard_normal(counts.shape)
    counts = np.where(used[..., None], counts, 0.0)
    return Block(x, y, counts, sigma, used, source), instrument


def likelihood_of(block, rows=ROWS, batch=None):
    calset = calibration_set(block, rows)
    return Likelihood.of(calset, base_model(calset, throughput_degree=2), batch=batch)


@pytest.fixture(scope="module")
def block():
    return make_block()[0]


@pytest.fixture(scope="module")
def likelihood(block):
    return likelihood_of(block)


@pytest.fixture(scope="module")
def values(likelihood):
    """A point of parameter space some standard deviations off the truth: residuals far from noise."""
    rng = np.random.default_rng(8)
    return np.asarray(values_of(builders.as_built(make_block()[1], rng, 0.5)))


@functools.cache
def _derivatives():
    there = with_values(likelihood_of(make_block()[0]).model.template)
    predicted = jax.vmap(engine.point_prediction, (None, None, 0))

    def plain(values, plan, data):
        model = predicted(there(values), plan, data) * data.weight
        eliminate = jax.vmap(eliminate_flux, in_axes=(0, 0, None))
        residual = eliminate(data.counts * data.weight, model, plan.exposures.flux_known)[1]
        return (residual, model), (residual, model)

    return compiled(jax.jacfwd(plain, has_aux=True))


def jacobians(likelihood, values, data):
    """Residuals, weighted model, and their plain forward derivatives with respect to all parameters."""
    (dr, da), (r, a) = _derivatives()(jnp.asarray(values), likelihood.plan, data)
    return tuple(np.asarray(v) for v in (r, a, dr, da))


def kaufman(y, a, da, known):
    """J of one row of four: −F (da − â âᵀ da), or −da where the flux is known. numpy, row by row."""
    out = np.zeros_like(da)
    for index in np.ndindex(a.shape[:2]):
        row, d = a[index], da[index]
        if not row.any():
            continue
        if known[index[1]]:
            out[index] = -d
            continue
        flux = (y[index] @ row) / (row @ row)
        out[index] = -flux * (d - np.outer(row, row @ d) / (row @ row))
    return out


# ------------------------------------------------------------------------------------- the normal equations


@pytest.fixture(scope="module")
def plain(likelihood, values):
    return jacobians(likelihood, values, next(iter(likelihood.points)))


def test_gradient_is_that_of_plain_derivatives(likelihood, values, plain):
    """Jᵀr of the structured equations = Jᵀr of the residuals differentiated as they stand, flux and all."""
    r, _, dr, _ = plain
    np.testing.assert_allclose(likelihood.residuals(values)[1], r, rtol=1e-9, atol=1e-9)
    normal = engine.normal_equations(
        likelihood.model.instrument(values), likelihood.plan, next(iter(likelihood.points))
    )
    assert float(normal.chi2) == pytest.approx(np.sum(r**2), rel=1e-10)
    expected = np.einsum("pek,pekn->n", r, dr)
    scale = np.sqrt(np.einsum("pek,pekn->n", r**2, dr**2))
    np.testing.assert_allclose(normal.gradient, expected, rtol=0, atol=1e-9 * scale.max())
    np.testing.assert_array_less(np.abs(np.asarray(normal.gradient) - expected), 1e-8 * scale + 1e-12)


def test_matrix_is_kaufmans(likelihood, values, plain):
    _, a, _, da = plain
    data = next(iter(likelihood.points))
    y = np.asarray(data.counts * data.weight)
    jacobian = kaufman(y, a, da, np.asarray(likelihood.plan.exposures.flux_known)).reshape(-1, len(values))
    expected = jacobian.T @ jacobian
    normal = engine.normal_equations(likelihood.model.instrument(values), likelihood.plan, data)
    size = np.sqrt(np.diag(expected))
    assert (size > 0).all()
    np.testing.assert_allclose(
        normal.matrix / np.outer(size, size), expected / np.outer(size, size), atol=1e-10
    )


def test_matrix_is_the_fisher_information_with_fluxes_marginalised():
    """Without noise and at the truth: Schur complement of the joint information of parameters and fluxes."""
    block, truth = make_block(noise=False)
    likelihood, values = likelihood_of(block), np.asarray(values_of(truth))
    data = next(iter(likelihood.points))
    r, a, dr, da = jacobians(likelihood, values, data)
    np.testing.assert_allclose(r, 0.0, atol=1e-6)
    known = np.asarray(likelihood.plan.exposures.flux_known)
    information = np.zeros((len(values), len(values)))
    for p, e in np.ndindex(a.shape[:2]):
        row, d = a[p, e], da[p, e]
        if not row.any():
            continue
        flux = 1.0 if known[e] else float(np.asarray(data.counts * data.weight)[p, e] @ row / (row @ row))
        joint = np.concatenate([flux * d, row[:, None]], 1)
        joint = joint.T @ joint
        information += joint[:-1, :-1]
        if not known[e]:
            information -= np.outer(joint[:-1, -1], joint[-1, :-1]) / joint[-1, -1]
    normal = engine.normal_equations(likelihood.model.instrument(values), likelihood.plan, data)
    size = np.sqrt(np.diag(information))
    np.testing.assert_allclose(
        normal.matrix / np.outer(size, size), information / np.outer(size, size), atol=1e-9
    )
    # there the plain residuals have the same derivative
    plain = np.einsum("pekn,pekm->nm", dr, dr)
    np.testing.assert_allclose(plain / np.outer(size, size), information / np.outer(size, size), atol=1e-8)


def test_posterior_adds_the_priors(likelihood, values):
    """χ² of the priors and half its derivative, by hand, on top of the data's."""
    found = likelihood.expand(values)
    normal = engine.normal_equations(
        likelihood.model.instrument(values), likelihood.plan, next(iter(likelihood.points))
    )
    gradient, matrix, chi2 = np.array(normal.gradient), np.array(normal.matrix), 0.0
    loose = 0.0
    for i, p in enumerate(likelihood.model.parameters):
        if p.prior is not None:
            chi2 += ((values[i] - p.prior[0]) / p.prior[1]) ** 2
            gradient[i] += (values[i] - p.prior[0]) / p.prior[1] ** 2
            matrix[i, i] += p.prior[1] ** -2
        elif p.loose is not None:
            loose += ((values[i] - p.start) / p.loose) ** 2
            gradient[i] += (values[i] - p.start) / p.loose**2
            matrix[i, i] += p.loose**-2
    free = likelihood.model.free
    assert found.priors == pytest.approx(chi2, rel=1e-12)
    assert found.loose == pytest.approx(loose, rel=1e-12)
    assert found.data == pytest.approx(float(normal.chi2), rel=1e-12)
    assert found.objective == pytest.approx(float(normal.chi2) + chi2 + loose, rel=1e-12)
    np.testing.assert_allclose(found.gradient, gradient[free], rtol=1e-12)
    np.testing.assert_allclose(found.matrix, matrix[np.ix_(free, free)], rtol=1e-12)


def test_a_factor_on_the_errors_leaves_the_priors_alone(likelihood, values):
    """Errors of the data three times as large: their part of gradient and matrix a ninth."""
    one, three = likelihood.expand(values), likelihood.expand(values, noise_scale=3.0)
    rows, select = likelihood.priors, likelihood.model.selection()
    prior = rows.jacobian(select).T @ rows.jacobian(select)
    pull = rows.jacobian(select).T @ rows.residuals(values)
    size = np.sqrt(np.diag(one.matrix))
    np.testing.assert_allclose(
        (three.matrix - prior) / np.outer(size, size),
        (one.matrix - prior) / np.outer(size, size) / 9,
        atol=1e-12,
    )
    np.testing.assert_allclose(
        (three.gradient - pull) / size, (one.gradient - pull) / size / 9, atol=1e-12 * np.sqrt(one.data)
    )
    assert three.data == pytest.approx(one.data, rel=1e-12)


# ------------------------------------------------------------------------------------------------ identities


def same(one, other, rtol=1e-10):
    assert one.data == pytest.approx(other.data, rel=rtol)
    size = np.sqrt(np.diag(other.matrix))
    np.testing.assert_allclose(
        one.gradient / size, other.gradient / size, rtol=0, atol=rtol * np.sqrt(other.data)
    )
    np.testing.assert_allclose(
        one.matrix / np.outer(size, size), other.matrix / np.outer(size, size), atol=rtol
    )


def changed(block, **changes):
    return dataclasses.replace(block, **changes)


def test_batches_change_nothing(block, likelihood, values):
    """Seven points in batches of three: the last one is padded."""
    batched = likelihood_of(block, batch=3)
    assert len(batched.points) == 3
    same(batched.expand(values), likelihood.expand(values))
    assert (batched.independent, batched.used_data.n_data) == (
        likelihood.independent,
        likelihood.used_data.n_data,
    )


def test_order_of_points_and_exposures_changes_nothing(block, likelihood, values):
    rng = np.random.default_rng(1)
    p, e = rng.permutation(POINTS), rng.permutation(len(ROWS))
    table = (getattr(block, name)[p][:, e] for name in ("counts", "sigma", "used", "source"))
    shuffled = likelihood_of(Block(block.x[p], block.y[p], *table), [ROWS[i] for i in e])
    same(shuffled.expand(values), likelihood.expand(values))


def test_row_that_is_not_used_is_as_good_as_removed(block, values):
    """An exposure masked everywhere (counts and errors of any size) = a set that lacks it."""
    gone = 4
    used, counts, sigma = block.used.copy(), block.counts.copy(), block.sigma.copy()
    used[:, gone], counts[:, gone], sigma[:, gone] = False, 1e9, 1e-3
    masked = likelihood_of(changed(block, used=used, counts=counts, sigma=sigma))
    keep = np.delete(np.arange(len(ROWS)), gone)
    names = ("counts", "sigma", "used", "source")
    removed = likelihood_of(
        changed(block, **{name: getattr(block, name)[:, keep] for name in names}), [ROWS[i] for i in keep]
    )
    same(masked.expand(values), removed.expand(values))
    assert (masked.independent, masked.used_data.n_data) == (removed.independent, removed.used_data.n_data)
    flux, residual = masked.residuals(values)
    np.testing.assert_array_equal(residual[:, gone], 0.0)
    assert np.isfinite(flux).all()


def test_unit_of_the_counts_does_not_matter(block, values):
    """N and N_ERR times anything, row by row: the flux is eliminated (KIND `flux` has none to eliminate)."""
    factor = np.random.default_rng(2).uniform(0.01, 100.0, (POINTS, len(ROWS), 1))
    factor[:, -1] = 1.0
    scaled = changed(block, counts=block.counts * factor, sigma=block.sigma * factor)
    plain = likelihood_of(block)
    same(likelihood_of(scaled).expand(values), plain.expand(values), 1e-9)
    flux = plain.residuals(values)[0]
    np.testing.assert_allclose(likelihood_of(scaled).residuals(values)[0], flux * factor[..., 0], rtol=1e-9)


def test_known_flux_is_not_eliminated(block, values):
    used = np.zeros_like(block.used)
    used[:, -1] = True
    alone = changed(block, used=used)
    twice = likelihood_of(changed(alone, counts=2 * block.counts)).expand(values).data
    assert twice > 2 * likelihood_of(alone).expand(values).data


def test_independent_data(block, likelihood):
    """Three per row, four with known flux, one per prior; counted by hand."""
    rows = block.used.sum()
    flux_rows = block.used[:, -1].sum()
    priors = 3 + 2 + 2 + 8 + 4  # collimator, calibration plate, pupil, each half four, two standards
    assert likelihood.used_data.n_data == 4 * rows
    assert likelihood.independent == 3 * rows + flux_rows + priors


def test_eliminated_flux_is_the_least_squares_one():
    rng = np.random.default_rng(6)
    y, a = rng.uniform(1, 2, (5, 4)), rng.uniform(1, 2, (5, 4))
    known = np.array([False, False, True, False, False])
    a[3] = 0.0
    flux, residual = eliminate_flux(jnp.asarray(y), jnp.asarray(a), jnp.asarray(known))
    for i in (0, 1, 4):
        expected, rest, *_ = np.linalg.lstsq(a[i][:, None], y[i], rcond=None)
        assert float(flux[i, 0]) == pytest.approx(expected[0], rel=1e-12)
        assert float(jnp.sum(residual[i] ** 2)) == pytest.approx(rest[0], rel=1e-10)
    np.testing.assert_array_equal(residual[2], y[2] - a[2])
    np.testing.assert_array_equal(residual[3], y[3])


# ------------------------------------------------------------------------------------------------ the oracle


@pytest.mark.parametrize("start", ["true", "nominal"])
def test_set_a_has_the_oracles_residuals(either_south_set, start):
    """χ² of a set made elsewhere, residual by residual, at the as-built values and at the nominal ones."""
    south = either_south_set("a")
    calset = read_calibration_set(south.path)
    likelihood = Likelihood.of(calset, base_model(calset))
    data = forward.load(south.path)
    params = forward.nominal() if start == "nominal" else validate.read_truth(south)[0]
    params["q"], params["u"] = data["sources"]["Q"] + 1e-4, data["sources"]["U"] - 2e-4
    values = dict(zip(likelihood.model.names, likelihood.model.start, strict=True))
    values |= {ours: params[theirs] for ours, theirs in builders.ORACLE_NAMES.items()}
    for k in range(4):
        values |= {
            f"throughput.n{k}.p{i}{j}": c
            for (i, j), c in zip(forward.TERMS, params["throughput"][k], strict=True)
        }
    for i in range(8):
        values |= {f"standard.STD0{i}.q": params["q"][i], f"standard.STD0{i}.u": params["u"][i]}
    assert len(values) == len(likelihood.model.names)
    vector = np.array([values[name] for name in likelihood.model.names])

    expected = forward.residuals(params, data)
    rows = 4 * data["point"].size
    found = likelihood.residuals(vector)[1][data["point"], data["exposure"]]
    np.testing.assert_allclose(found.ravel(), expected[:rows], rtol=1e-6, atol=1e-4)
    expansion = likelihood.expand(vector)
    assert expansion.data == pytest.approx(np.sum(expected[:rows] ** 2), rel=1e-6)
    assert expansion.priors == pytest.approx(np.sum(expected[rows:] ** 2), rel=1e-10)
    assert likelihood.used_data.n_data == rows
