"""The likelihood of data whose errors have parameters, against the normal distribution by linear algebra."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import pytest
from jaxtyping import Float

from walop_jax.likelihood.flux import FluxGroups
from walop_jax.likelihood.noise import NoiseTerms, log_variance, noise_expansion, variance_ratio
from walop_jax.model.compiled import array
from walop_jax.model.noise import Noise

KINDS = ("clp", "clp", "moon", "flux", "steady", "steady")
CAMERAS = ("O1", "E1", "O2", "E2")
FLUX_KNOWN = np.array([kind == "flux" for kind in KINDS])
GROUPS = np.eye(5)[[0, 1, 2, 3, 4, 4]]  # the two exposures of the steady lamp share a flux
BY_ARM = np.kron(np.eye(2), np.ones((2, 2)))
POINTS = 3


class Scene:
    """Counts, models for light of unit flux and stated errors of a few points, drawn once."""

    def __init__(self, shared: FluxGroups) -> None:
        rng = np.random.default_rng(4)
        shape = (POINTS, len(KINDS), len(CAMERAS))
        self.shared = shared
        self.unit = rng.uniform(0.5, 2.0, shape)
        self.counts = 1e4 * self.unit * rng.uniform(0.99, 1.01, shape)
        self.counts[:, FLUX_KNOWN] /= 1e4
        self.weight = 1.0 / rng.uniform(0.003, 0.006, shape) / self.counts
        self.weight[1, 0] = 0.0  # a row that is not used

    def groups(self) -> list[list[tuple[int, int, int]]]:
        """The intensities that have a flux in common; those of a known one each for itself."""
        cameras = np.ones((4, 4)) if self.shared.cameras is None else self.shared.cameras
        exposures = (
            np.eye(6) if self.shared.exposures is None else self.shared.exposures @ self.shared.exposures.T
        )
        groups: dict[tuple[int, ...], list[tuple[int, int, int]]] = {}
        for p, e, k in itertools.product(range(POINTS), range(6), range(4)):
            if self.weight[p, e, k] > 0:
                alone = (e, k) if FLUX_KNOWN[e] else ()
                key = (p, int(np.argmax(exposures[e] > 0)), int(np.argmax(cameras[k] > 0)), *alone)
                groups.setdefault(key, []).append((p, e, k))
        return list(groups.values())

    def residual(self, ratio: Float[np.ndarray, "p e k"]) -> Float[np.ndarray, "p e k"]:
        """(N − F u)/σ with the best flux, group by group."""
        residual, sigma = np.zeros_like(ratio), np.sqrt(ratio)
        for rows in self.groups():
            at = tuple(np.array(rows).T)
            n, u = (a[at] * self.weight[at] / sigma[at] for a in (self.counts, self.unit))
            flux = 1.0 if FLUX_KNOWN[rows[0][1]] else (n @ u) / (u @ u)
            residual[at] = n - flux * u
        return residual

    def deviance(self, ratio: Float[np.ndarray, "p e k"]) -> float:
        """−2 ln of the density of the data, each flux integrated over with a flat prior, less that for stated errors.

        With V the covariance and u the design: ln |V| + ln |uᵀ V⁻¹ u| + rᵀ V⁻¹ r (Harville 1977), by determinants.
        """
        total = 0.0
        for rows in self.groups():
            at = tuple(np.array(rows).T)
            stated = np.diag(self.weight[at] ** -2)
            true, u = stated * ratio[at], self.unit[at][:, None]
            known = FLUX_KNOWN[rows[0][1]]
            for covariance, sign in ((true, 1.0), (stated, -1.0)):
                inverse = np.linalg.inv(covariance)
                total += sign * np.linalg.slogdet(covariance)[1]
                total += 0.0 if known else sign * np.linalg.slogdet(u.T @ inverse @ u)[1]
            inverse = np.linalg.inv(true)
            flux = 1.0 if known else np.linalg.solve(u.T @ inverse @ u, u.T @ inverse @ self.counts[at])
            left = self.counts[at] - np.ravel(u * flux)
            total += float(left @ inverse @ left)
        return total


SHARINGS = {
    "a flux for each exposure": FluxGroups(),
    "a flux for each arm": FluxGroups(cameras=BY_ARM),
    "lamps of one flux": FluxGroups(exposures=GROUPS),
}
TERMS = {
    "one scale": ((("all",), ()), [1.4]),
    "scales of KINDs and cameras": ((("clp", "moon", "E2"), ()), [1.4, 0.8, 1.2]),
    "a fraction": (((), ("all",)), [0.004]),
    "a scale and fractions of cameras": ((("all",), ("O1", "E2")), [0.9, 0.006, 0.002]),
}


@pytest.fixture(params=SHARINGS)
def scene(request: pytest.FixtureRequest) -> Scene:
    return Scene(SHARINGS[request.param])


def noise_at(groups: tuple[tuple[str, ...], tuple[str, ...]], values: Float[np.ndarray, " t"]) -> Noise:
    scales, fractions = groups
    return Noise(
        scale=array(np.array(values[: len(scales)])),
        fraction=array(np.array(values[len(scales) :])),
        scales=scales,
        fractions=fractions,
    )


def terms_of(noise: Noise) -> NoiseTerms:
    return NoiseTerms.of(noise, KINDS, CAMERAS)


@pytest.mark.parametrize("name", TERMS)
def test_it_is_the_density_of_the_data_with_the_fluxes_integrated_over(scene: Scene, name: str):
    groups, values = TERMS[name]
    noise = noise_at(groups, np.array(values))
    ratio = np.asarray(variance_ratio(noise, terms_of(noise), scene.counts, scene.weight))
    residual = scene.residual(ratio)
    light = np.where(scene.weight > 0, scene.counts * scene.weight / np.sqrt(ratio) - residual, 0.0)
    added = float(np.sum(log_variance(ratio, light, FLUX_KNOWN, scene.shared)))
    assert np.sum(residual**2) + added == pytest.approx(scene.deviance(ratio), rel=1e-10)


def expansion(scene: Scene, groups: tuple[tuple[str, ...], tuple[str, ...]]) -> Callable[[np.ndarray], tuple]:
    """Deviance, half its gradient and the matrix at values of the terms."""

    def at(values: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        noise = noise_at(groups, values)
        terms = terms_of(noise)
        ratio = np.asarray(variance_ratio(noise, terms, scene.counts, scene.weight))
        data = scene.counts, scene.weight, scene.residual(ratio)
        value, gradient, matrix = noise_expansion(noise, terms, *data, FLUX_KNOWN, scene.shared)
        return float(np.sum(data[2] ** 2)) + value, gradient, matrix

    return at


@pytest.mark.parametrize("name", TERMS)
def test_its_gradient_is_that_of_finite_differences(scene: Scene, name: str):
    groups, values = TERMS[name]
    at, here = expansion(scene, groups), np.array(values)
    gradient = at(here)[1]
    for i, value in enumerate(here):
        step = np.zeros_like(here)
        step[i] = 1e-4 * value
        slope = (at(here + step)[0] - at(here - step)[0]) / (2.0 * step[i])
        assert 2.0 * gradient[i] == pytest.approx(slope, rel=1e-5, abs=1e-6 * np.abs(gradient).max())


@pytest.mark.parametrize("name", TERMS)
def test_its_matrix_is_the_covariance_of_its_gradient_over_noise(name: str):
    """Fisher's information is the covariance of half the gradient of −2 ln L, over draws of the data."""
    groups, values = TERMS[name]
    scene, rng, here = Scene(FluxGroups()), np.random.default_rng(1), np.array(values)
    scene.unit[:, FLUX_KNOWN] *= 1e4
    noise, truth = noise_at(groups, here), 1e4 * scene.unit / np.where(FLUX_KNOWN, 1e4, 1.0)[None, :, None]
    scene.counts = truth.copy()
    scene.weight = np.where(scene.weight > 0, 1.0 / (0.005 * truth), 0.0)
    ratio = np.asarray(variance_ratio(noise, terms_of(noise), truth, scene.weight))
    error = np.sqrt(ratio) * 0.005 * truth
    drawn = []
    for _ in range(2000):
        scene.counts = truth + error * rng.standard_normal(truth.shape)
        drawn.append(expansion(scene, groups)(here)[1])
    scene.counts = truth
    terms = terms_of(noise)
    data = truth, scene.weight, np.zeros_like(truth)
    information = noise_expansion(noise, terms, *data, FLUX_KNOWN, scene.shared).matrix
    bent = noise_expansion(noise, terms, *data, FLUX_KNOWN, scene.shared).gradient / here
    first = len(terms.scale)
    information[np.diag_indices(len(here))] -= np.where(
        np.arange(len(here)) >= first, np.maximum(bent, 0.0), 0.0
    )
    scale = np.sqrt(np.diag(information))
    np.testing.assert_allclose(
        np.cov(np.array(drawn).T).reshape(information.shape) / np.outer(scale, scale),
        information / np.outer(scale, scale),
        atol=0.12,
    )
    assert np.abs(np.mean(drawn, axis=0) / scale).max() < 4.0 / np.sqrt(2000) + 0.05


def test_one_scale_of_all_errors_is_that_of_the_scatter():
    """s² = χ²/(n − n_F) and its error s/√(2 (n − n_F)); with p parameters, of n data, s² = χ²/(n − n_F − p)."""
    scene, groups = Scene(FluxGroups()), (("all",), ())
    one = np.ones_like(scene.counts)
    chi2 = float(np.sum(scene.residual(one) ** 2))
    used = scene.weight > 0
    free = int(used.sum()) - int(used[:, ~FLUX_KNOWN].any(axis=-1).sum())
    best = np.sqrt(chi2 / free)
    value, gradient, matrix = expansion(scene, groups)(np.array([best]))
    assert gradient[0] == pytest.approx(0.0, abs=1e-8 * free)
    assert matrix[0, 0] ** -0.5 == pytest.approx(best / np.sqrt(2 * free), rel=1e-12)
    assert value == pytest.approx(free + 2.0 * free * np.log(best), rel=1e-12)
    noise = noise_at(groups, np.array([np.sqrt(chi2 / (free - 7))]))
    terms = terms_of(noise)
    ratio = np.asarray(variance_ratio(noise, terms, scene.counts, scene.weight))
    data = scene.counts, scene.weight, scene.residual(ratio)
    taken = np.where(used, np.random.default_rng(1).uniform(0.0, 1.0, used.shape), 0.0)
    taken *= 7.0 / taken.sum()
    gradient = noise_expansion(noise, terms, *data, FLUX_KNOWN, scene.shared, taken).gradient
    assert gradient[0] == pytest.approx(0.0, abs=1e-8 * free)


def test_other_parameters_take_up_some_data_more_than_others():
    """Half the slope of ln |V| + ln |Xᵀ V⁻¹ X| + rᵀ V⁻¹ r, and tr (P V' P V')/4, by determinants and inverses.

    X holds the fluxes and columns of other parameters that one camera determines (Harville 1977).
    """
    scene, groups = Scene(FluxGroups()), (("all",), ("all",))
    rng, values, used = np.random.default_rng(6), np.array([1.3, 0.004]), scene.weight > 0
    n, weight = int(used.sum()), scene.weight[used]
    camera = np.broadcast_to(np.arange(4), used.shape)[used]
    unit = np.zeros((n, len(scene.groups())))
    place = np.full(used.shape, -1)
    place[used] = np.arange(n)
    for column, rows in enumerate(scene.groups()):
        at = place[tuple(np.array(rows).T)]
        unit[at, column] = scene.unit[used][at]
    known = np.broadcast_to(FLUX_KNOWN[:, None], used.shape)[used]
    unit = unit[:, ~np.array([known[column > 0].all() for column in unit.T])]
    others = rng.standard_normal((n, 5)) * np.where(camera == 1, 1.0, 0.05)[:, None] / weight[:, None]
    design, counts = np.hstack([unit, others]), scene.counts[used]

    def variance(at: Float[np.ndarray, " t"]) -> Float[np.ndarray, " n"]:
        return (at[0] / weight) ** 2 + (at[1] * counts) ** 2

    def fitted(at: Float[np.ndarray, " t"]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " c"]]:
        root = np.sqrt(variance(at))
        best = np.linalg.lstsq(
            design / root[:, None], (counts - np.where(known, scene.unit[used], 0.0)) / root
        )[0]
        return np.where(known, scene.unit[used], 0.0) + design @ best, best

    for _ in range(
        20
    ):  # data of which the other parameters explain nothing, so that the model is the light of fluxes
        counts = counts - others @ fitted(values)[1][-5:]

    def deviance(at: Float[np.ndarray, " t"]) -> float:
        left = (counts - fitted(at)[0]) / np.sqrt(variance(at))
        information = design.T @ (design / variance(at)[:, None])
        return float(np.sum(np.log(variance(at))) + np.linalg.slogdet(information)[1] + left @ left)

    sigma = np.sqrt(variance(values))
    x = design / sigma[:, None]
    projection = np.eye(n) - x @ np.linalg.solve(x.T @ x, x.T)
    flux = unit / sigma[:, None]
    of_flux = flux @ np.linalg.solve(flux.T @ flux, flux.T)
    taken, cube, residual = (np.zeros(used.shape) for _ in range(3))
    taken[used] = 1.0 - np.diag(of_flux) - np.diag(projection)
    cube[used], residual[used] = counts, (counts - fitted(values)[0]) / sigma
    noise = noise_at(groups, values)
    found = noise_expansion(
        noise, terms_of(noise), cube, scene.weight, residual, FLUX_KNOWN, scene.shared, taken
    )
    for i, value in enumerate(values):
        step = 1e-5 * value * np.eye(2)[i]
        slope = (deviance(values + step) - deviance(values - step)) / (2.0 * step[i])
        assert 2.0 * found.gradient[i] == pytest.approx(
            slope, rel=1e-5, abs=1e-5 * np.abs(found.gradient).max()
        )
    alpha = np.stack([values[0] / weight**2, values[1] * counts**2]) / sigma**2
    exact = 2.0 * np.einsum("ab,sa,tb->st", projection**2, alpha, alpha)
    matrix = found.matrix - np.diag([0.0, max(found.gradient[1] / values[1], 0.0)])
    scale = np.sqrt(np.outer(np.diag(exact), np.diag(exact)))
    np.testing.assert_allclose(matrix / scale, exact / scale, atol=0.05)
