"""Wavelength nodes of a band: a Gauss rule for the filter's own tabulated curve.

The band integral ∫ THROUGHPUT f dλ over the tabulated curve is a sum with positive weights (trapezium rule
on the table, refined to 0.5 nm by linear interpolation where it is coarser). The Gauss rule of that
discrete measure integrates polynomials of degree 2n − 1 exactly, so n nodes resolve an oscillation of the
plates as well as any n nodes can. n is the smallest that integrates the fringes of plates of 35 waves
(periods near 17 nm, half of that at second order, in all phases) to `tolerance`, and those of the plates of
an instrument, where these are thicker.

Fringes of full strength faster than those of 35 waves are sensitive to the curve between its tabulated rows:
their measure is that of straight lines, by Gauss–Legendre rules on pieces of it.

Source      `SOURCE`; the discrete measure by the Lanczos process.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from walop_jax.io.shapes import Vector

SOURCE = "Golub & Welsch 1969, Math. Comp. 23, 221; Gautschi 2004, Orthogonal Polynomials, 2.2.3"
FINEST = 0.0005  # µm
WAVES = 36.0  # of one plate at 0.62 µm: (n_e − n_o) d / λ
FAINT = (
    80.0  # waves of all layers of a plate together, a thousand times fainter, resolved by a rule for `WAVES`
)
FAINTER = 1e4  # tolerance of those, in units of that of full strength
STEP = 1.05  # ratio of the numbers of waves of rules: plates of nearly equal thickness share a rule
PER_WAVE = 8.0  # pieces of a straight line for each turn of the fastest fringe, at least
MAXIMUM_NODES = 600

QuadratureRule = tuple[Float[np.ndarray, " nodes"], Float[np.ndarray, " nodes"]]


def tabulated_measure(wavelength: Vector, throughput: Vector, waves: float = WAVES) -> QuadratureRule:
    """Nodes and weights of a measure over a tabulated curve, on pieces of 0.5 nm; weights sum to 1.

    Up to `WAVES` the trapezium rule, beyond them straight lines between the rows.
    """
    if len(wavelength) == 1:
        return wavelength, np.ones(1)
    turns = 0.62 * waves * np.abs(np.diff(1.0 / wavelength)) if waves > WAVES else np.zeros(1)
    counts = np.ceil(np.maximum(np.diff(wavelength) / FINEST, PER_WAVE * turns) - 1e-6)
    pieces = [
        np.linspace(a, b, max(1, int(count)), endpoint=False)
        for (a, b), count in zip(itertools.pairwise(wavelength), counts, strict=True)
    ]
    fine = np.concatenate([*pieces, wavelength[-1:]])
    gap = np.diff(fine)
    if waves > WAVES:
        place, share = np.polynomial.legendre.leggauss(3)
        fine = (fine[:-1, None] + gap[:, None] * 0.5 * (1.0 + place)).ravel()
        weight = np.interp(fine, wavelength, throughput) * np.outer(gap, share).ravel()
    else:
        weight = np.interp(fine, wavelength, throughput)
        weight *= 0.5 * (np.append(gap, 0.0) + np.append(0.0, gap))
    inside = weight > 0
    return fine[inside], weight[inside] / weight[inside].sum()


def moments(wavelength: Vector, throughput: Vector, teff: float) -> tuple[float, float]:
    """Mean wavelength (µm) of the photons of a black body (K; NaN: flat spectrum) behind a filter, and rms width."""
    node, weight = tabulated_measure(wavelength, throughput)
    if np.isfinite(teff):
        weight = weight * node**-4 / np.expm1(14387.77 / (node * teff))
        weight = weight / weight.sum()
    mean = float(weight @ node)
    return mean, float(np.sqrt(weight @ (node - mean) ** 2))


def waves_over(wavelength: Vector, retardance: Vector) -> float:
    """Waves at 0.62 µm of a fixed birefringence (∝ 1/λ) with as many turns over a band as a retardance.

    The wavelengths (µm) span the band; the retardance is in waves.
    """
    turns = 0.62 * abs(1.0 / wavelength[0] - 1.0 / wavelength[-1])
    return float(np.abs(np.diff(retardance)).sum() / turns) if turns > 0 else 0.0


def rounded_up(waves: float, known: float) -> float:
    """The next number of waves with a rule, at least `known`, that of the smallest rule."""
    return known if waves <= known else known * STEP ** float(np.ceil(np.log(waves / known) / np.log(STEP)))


def _recurrence(node: Vector, weight: Vector) -> Iterator[tuple[float, float]]:
    """Diagonal and off-diagonal of the Jacobi matrix, row by row, of a measure on [−1, 1] whose weights sum to 1."""
    vectors = np.zeros((0, len(node)))
    vector = np.sqrt(weight)
    while True:
        vectors = np.vstack([vectors, vector])
        step = node * vector
        alpha = float(vector @ step)
        # Twice is enough: full orthogonalisation keeps Lanczos from losing the rule.
        for _ in range(2):
            step = step - vectors.T @ (vectors @ step)
        beta = float(np.linalg.norm(step))
        yield alpha, beta
        vector = step / beta


def gauss_rules(node: Vector, weight: Vector, counts: range) -> Iterator[QuadratureRule]:
    """Gauss rules of growing numbers of nodes, fewer than the measure has; its weights sum to 1."""
    centre, half = 0.5 * (node[0] + node[-1]), 0.5 * (node[-1] - node[0])
    rows = _recurrence((node - centre) / half, weight)
    coefficients: list[tuple[float, float]] = []
    for count in counts:
        coefficients += itertools.islice(rows, count - len(coefficients))
        alpha, beta = np.array(coefficients).T
        value, columns = np.linalg.eigh(np.diag(alpha) + np.diag(beta[:-1], 1) + np.diag(beta[:-1], -1))
        yield centre + half * value, columns[0] ** 2


def _fringe_error(rule: QuadratureRule, measure: tuple[Vector, Vector], waves: float) -> float:
    # Phase of a plate of fixed birefringence, 2π waves · 0.62/λ, at a range of thicknesses.
    thickness = 2j * np.pi * 0.62 * waves * np.linspace(0.3, 1.0, 8)[:, None]
    mean, exact = (np.exp(thickness / node) @ weight for node, weight in (rule, measure))
    return float(np.abs(mean - exact).max())


def band_rule(
    wavelength: Vector,
    throughput: Vector,
    tolerance: float = 1e-7,
    path_difference: float = 0.0,
    waves: float = WAVES,
    faint: float = FAINT,
) -> QuadratureRule:
    """Fewest wavelength nodes (µm) and weights (sum 1) that integrate plate fringes to `tolerance`.

    `waves` are those of the fringes of full strength (`waves_over`). Fringes at twice the frequency of usual plates
    carry a hundred times less light and are held to a hundred times the tolerance; so are those of a `path_difference`
    (µm), if there is an air gap. Those of all layers of thicker plates, `faint`, carry a thousand times less.
    """
    fringes = path_difference / 0.62
    weak = max(2 * WAVES, fringes)
    followed = [(WAVES, tolerance), (weak, 100 * tolerance)]
    followed += [(waves, tolerance)] if waves > WAVES else []
    followed += [(faint, FAINTER * tolerance)] if faint > FAINT else []
    measure = fine, fine_weight = tabulated_measure(wavelength, throughput, waves)
    # No rule resolves a fringe with fewer than two nodes a cycle: those are not tried.
    cycles = 0.62 * max(fringes, waves if waves > WAVES else 0.0) * (1.0 / fine[0] - 1.0 / fine[-1])
    counts = range(max(1, int(2.0 * cycles)), min(MAXIMUM_NODES, len(fine)))
    for rule in gauss_rules(fine, fine_weight, counts) if counts else ():
        if all(_fringe_error(rule, measure, n) < limit for n, limit in followed):
            return rule
    return measure
