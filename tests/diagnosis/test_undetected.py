"""Changes that the data would not show: their second moment by quadrature, and their errors in a product."""

import dataclasses

import numpy as np
import pytest
from fits_with import examined_with, fit_with
from scipy import integrate, stats
from small_run import SMALL

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.matrix import first_setting, planned_matrices
from walop_jax.diagnosis import grammar
from walop_jax.diagnosis.class_members import LinearisedFit, LinearStep
from walop_jax.diagnosis.class_product import Questions, averaged
from walop_jax.diagnosis.discrepancy import (
    _AtData,
    _Block,
    _block,
    _carrying,
    _factor_of_matrix,
    _no_starlight,
    _of_exposures,
    _of_stated_numbers,
    _second_moments,
    _steady_places,
    ambiguities,
    undetected,
)
from walop_jax.diagnosis.stated_conditions import condition_scores
from walop_jax.model.effects import Described
from walop_jax.model.planning import plan_for_settings
from walop_jax.posterior import draws
from walop_jax.simulation.simulate import simulate

AHEAD, SIZE = "retardance v ahead of polariser", 4e-4
"""Turns q and u of all light from the sky, which standards of 3 % with errors of 2·10⁻⁴ hardly show."""


def fitted(seed: int, *texts: str, size: float = SIZE):
    """A fit of the base model, what may be undetected, and the truth of the set."""
    effects = [Described.saying(list(texts), [size] * len(texts))] if texts else []
    simulation = simulate(SMALL, seed=seed, effects=effects)
    result = fit_with(simulation.calset)
    classes = ambiguities(examined_with(result), {})
    assert not classes.several
    return result, classes.undetected, simulation


@pytest.fixture(scope="module")
def sound():
    return fitted(3)


def product_of(result, shape) -> Calibration:
    return averaged(Calibration.from_fit(result.with_verdict()), Questions(undetected=shape))


def worst_pulls(result, shape, simulation) -> list[float]:
    """Median pull of the element that is farthest off, of the fit and of the product."""
    points, calset = result.calset.points, simulation.calset
    setting = first_setting(calset, simulation.truth)
    plan = plan_for_settings(simulation.truth, setting, calset.filters)
    true = planned_matrices(simulation.truth, plan, points.x, points.y).reshape(len(points.x), 6)
    worst = []
    for product in (Calibration.from_fit(result.with_verdict()), product_of(result, shape)):
        m, c = product.matrix(points.x, points.y, setting)
        pulls = np.abs(m - true) / np.sqrt(np.diagonal(c, axis1=1, axis2=2))
        worst.append(np.median(pulls, axis=0).max())
    return worst


def by_quadrature(square: float, score: float, width: float) -> tuple[float, float]:
    """∫ p L and ∫ c² p L of an amplitude c, its prior of four widths; L = exp(−½ |r + K c|² + ½ |r|²)."""
    evidence, moment = 0.0, 0.0
    for scale in (1.0, 0.3, 0.1, 0.03):
        c = np.linspace(-8.0, 8.0, 200_001) * scale * width
        density = stats.norm.pdf(c, scale=scale * width) * np.exp(-0.5 * square * c**2 - score * c) / 4
        evidence += integrate.trapezoid(density, c)
        moment += integrate.trapezoid(c**2 * density, c)
    return evidence, moment


def test_second_moments_are_those_of_the_mixture():
    """By quadrature of prior × likelihood: each of two amplitudes is there, at one of four widths, or not."""
    gram, score, widths = (
        np.array([[4e4, 0.0], [0.0, 9e2]]),
        np.array([500.0, -20.0]),
        np.array([0.02, 0.003]),
    )
    block = _Block((), widths, ([0], [1]), gram, score, np.zeros((0, 2)))
    (moments,) = _second_moments([block], 1.0)
    evidence, squares = [], []
    for i in range(2):
        for scale in (1.0, 0.3, 0.1, 0.03):
            c = np.linspace(-12.0, 12.0, 200_001) * scale * widths[i]
            # The residuals r change by K c: −½ |r + K c|² without r².
            density = stats.norm.pdf(c, scale=scale * widths[i])
            density *= np.exp(-0.5 * gram[i, i] * c**2 - score[i] * c)
            evidence.append(integrate.trapezoid(density, c))
            squares.append(integrate.trapezoid(c**2 * density, c))
    # Each of two is there with a probability of a half, at any of four scales.
    expected = [sum(squares[i : i + 4]) / 8 / (0.5 + sum(evidence[i : i + 4]) / 8) for i in (0, 4)]
    np.testing.assert_allclose(np.diag(moments), expected, rtol=1e-6)
    assert moments[0, 1] == 0.0


def test_few_columns_carry_a_covariance():
    rng = np.random.default_rng(0)
    columns = rng.standard_normal((60, 20))
    factor = columns[:, [2, 5, 11]] @ rng.standard_normal((3, 9))
    chosen, loadings = _carrying(columns, factor)
    carried = columns[:, chosen] @ loadings
    # Left is 1 % of the variance of a row of size one in the mean over 60 rows.
    assert np.sum((carried - factor) ** 2) < 0.01 * 60
    assert len(chosen) < 20


def test_a_product_has_the_covariance_of_all_undetected_changes():
    """Of every element at every point that of the fit, with F Fᵀ of all that may be there; descriptions included.

    A turn of one arm alone is told as one of both: errors of what q makes in u, and u in q, may be a quarter too small.
    """
    result = fitted(3)[0]
    state = examined_with(result, lambda name: True)
    laid = LinearisedFit(state)
    step, data = laid.nothing_removed, _AtData.of(laid.columns)
    blocks = [_block(laid, step, data, *place) for place in _steady_places(laid)]
    factor = _factor_of_matrix(laid, step, [block for block in blocks if block is not None])
    points, shape = result.calset.points, undetected(laid)
    _, c = product_of(result, shape).matrix(points.x, points.y)
    errors = np.sqrt(np.diagonal(c, axis1=1, axis2=2))
    np.testing.assert_allclose(errors, np.hypot(laid.errors, np.linalg.norm(factor, axis=-1)), rtol=0.25)
    of_stars = laid.error_of_p(factor @ np.swapaxes(factor, 1, 2))
    assert shape.spread == pytest.approx(of_stars, rel=0.1)


def test_values_stay_and_offsets_keep_their_errors(sound):
    """Of a sound set: diattenuation shows in every exposure, polarisation ahead of the polariser hardly does."""
    result, shape, _ = sound
    alone, product = Calibration.from_fit(result.with_verdict()), product_of(result, shape)
    x, y = np.random.default_rng(1).uniform(-0.2, 0.2, (2, 30))
    (m, c), (one, within) = product.matrix(x, y), alone.matrix(x, y)
    np.testing.assert_allclose(m, one, rtol=0, atol=1e-13)
    errors, stated = (np.sqrt(np.diagonal(a, axis1=1, axis2=2)) for a in (c, within))
    assert np.all(errors >= stated * (1 - 1e-9))
    np.testing.assert_allclose(errors[:, [0, 3]], stated[:, [0, 3]], rtol=0.05)
    assert np.median(errors[:, 1]) > 5 * np.median(stated[:, 1])
    assert np.median(errors) < 1e-3
    assert shape.spread < shape.stated


def test_what_is_hidden_lies_within_the_errors():
    """Seen by standards alone, below their errors: elements off by many errors of the fit, the truth within ours."""
    result, shape, simulation = fitted(5, AHEAD)
    fit, product = worst_pulls(result, shape, simulation)
    assert fit > 4.0
    assert product < 2.0


def test_a_gain_that_standards_share_with_stars_is_in_the_errors():
    """Polariser and Moon are seen with another gain, which the fit takes for that of stars."""
    others = ["gain of O1 * kind clp", "gain of O1 * kind moon"]
    simulation = simulate(SMALL, seed=5, effects=[Described.saying(others, [3e-3, 3e-3])])
    result = fit_with(simulation.calset)
    assert result.explains_data
    shape = ambiguities(examined_with(result, lambda name: True), {}).undetected
    fit, product = worst_pulls(result, shape, simulation)
    assert fit > 4.0
    assert product < 2.0


def test_a_drift_that_no_test_shows_moves_the_parameters_as_a_fit_to_it_does(sound):
    """E[c²] of its size by quadrature, times the shifts of a fit to the same noise with the drift hidden."""
    drift, size = "turn of polariser * hours", 0.3
    result, _, _ = sound
    other, _, _ = fitted(3, drift, size=size)
    free = result.model.free
    shift = (other.values - result.values)[free] / size
    state = examined_with(result, drift.__eq__)
    (probe,) = (probe for probe in state.descriptions if probe.name == drift)
    laid = LinearisedFit(state)
    _, root = _of_exposures(laid, LinearStep(laid, np.zeros(0, int), np.zeros(laid.design.rows)))
    at = state.bare.places()[probe.name]
    square = state.bare.gram[at, at].item()
    left = laid.design.projector(laid.design.residual)[: laid.design.rows]
    score = float(state.candidates[probe.name].columns[:, 0] @ left)
    evidence, moment = by_quadrature(square, score, probe.widths[0])
    moment /= 1.0 + evidence  # there or not, at even odds
    errors = np.sqrt(np.diag(result.covariance)[free])
    moved = np.sqrt(moment) * shift / errors
    np.testing.assert_allclose(
        np.linalg.norm(root / errors[:, None], axis=1), np.abs(moved), atol=0.05 * np.abs(moved).max()
    )


@pytest.mark.parametrize(
    ("name", "absent"),
    [
        ("turn of polariser * hours", True),
        ("gain of O1 * counts", True),
        ("light in O1", True),
        ("light of E1 in O1", False),
        ("axis of half1.plate", False),
        ("fringes of half1.plate * gap 1; fringes of half1.plate * gap 1.0775", False),
    ],
)
def test_what_a_star_does_not_have(sound, name, absent):
    template, calset = sound[0].model.template, sound[0].calset
    asked = grammar.descriptions(template, calset.exposures, len(calset.points))
    (probe,) = (probe for probe in asked if probe.name == name)
    assert _no_starlight(probe, template) == absent


def test_draws_of_a_posterior_keep_what_is_undetected(sound, monkeypatch):
    """Normal draws of the parameters of the fit stand for a posterior."""
    result, shape, _ = sound
    product = product_of(result, shape)
    assert [product.model.names[i] for i in product.fitted] == list(result.model.names)
    drawn = np.random.default_rng(2).multivariate_normal(result.values, result.covariance, 4000)
    monkeypatch.setattr(draws, "read_draws", lambda path, names, digest: drawn)
    moments = draws.with_moments(product, "posterior.nc")
    sigma = np.sqrt(np.diag(product.covariance))
    np.testing.assert_allclose(np.sqrt(np.diag(moments.covariance)), sigma, rtol=0.06, atol=1e-7)
    whole = draws.with_draws(product, "posterior.nc", 4000).draws
    np.testing.assert_allclose(whole.std(axis=0), sigma, rtol=0.06, atol=1e-7)


def with_lamp(calset, factor: float):
    """The set with another colour of the lamp than the one it was taken with."""
    e = calset.exposures
    teff = np.where(e.clp_in, e.teff * factor, e.teff)
    return dataclasses.replace(calset, exposures=dataclasses.replace(e, teff=teff))


def test_a_wrong_colour_of_the_lamp_moves_the_parameters_as_a_fit_with_it_does(sound):
    """E[c²] of TEFF by quadrature, times the shifts of a fit to the same counts with another TEFF."""
    result, _, _ = sound
    step = 0.01
    other = fit_with(with_lamp(result.calset, 1.0 + step))
    free = result.model.free
    laid = LinearisedFit(examined_with(result))
    numbers = condition_scores(laid.design, "TEFF of exposures of kind clp").items
    (number,) = numbers
    kelvin = float(np.median(result.calset.exposures.teff[result.calset.exposures.clp_in]))
    shift = (other.values - result.values)[free] / (step * kelvin)
    column = number.single.candidate.columns
    left = laid.design.projector(laid.design.residual)
    square, score = number.rest.item(), float(column[:, 0] @ left)
    evidence, moment = by_quadrature(square, score, 10.0 * 0.05 * kelvin)
    every = [one for one in condition_scores(laid.design).items if not one.stated.seen_by_stars]
    asked = [one.single.candidate.name for one in every if one.alive.all()]
    moment /= len(asked) - 1 + evidence  # one of them is expected
    root = _of_stated_numbers(laid, laid.nothing_removed)
    found = root[:, asked.index("TEFF of exposures of kind clp")]
    errors = np.sqrt(np.diag(result.covariance)[free])
    moved = np.sqrt(moment) * shift / errors
    np.testing.assert_allclose(np.abs(found / errors), np.abs(moved), atol=0.05 * np.abs(moved).max())


def test_a_wrong_colour_of_the_lamp_is_in_the_errors_of_a_product():
    """A lamp that is called hotter by 30 % moves an element of the matrix by many errors of the fit, and χ² by few."""
    simulation = simulate(SMALL, seed=3)
    result = fit_with(with_lamp(simulation.calset, 1.3))
    assert result.explains_data
    shape = ambiguities(examined_with(result), {}).undetected
    fit, product = worst_pulls(result, shape, simulation)
    assert fit > 4.0
    assert product < 2.0
