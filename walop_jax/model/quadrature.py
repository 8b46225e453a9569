"""Wavelength nodes of a band: a Gauss rule for the filter's own tabulated curve.

The band integral ∫ THROUGHPUT f dλ over the tabulated curve is a sum with positive weights (trapezium rule
on the table, refined to 0.5 nm by linear interpolation where it is coarser). The Gauss rule of that
discrete measure integrates polynomials of degree 2n − 1 exactly, so n nodes follow an oscillation of the
plates as well as any n nodes can. n is the smallest that integrates the fringes of the plates (35 waves
thick, so periods near 17 nm, half of that at second order, in all phases) to `tolerance`.

Source      `SOURCE`; the discrete measure by the Lanczos process.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

SOURCE = "Golub & Welsch 1969, Math. Comp. 23, 221; Gautschi 2004, Orthogonal Polynomials, 2.2.3"
FINEST = 0.0005  # µm
WAVES = 36.0  # of one plate at 0.62 µm: (n_e − n_o) d / λ
MAXIMUM_NODES = 200

Vector = Float[np.ndarray, " n"]
Rule = tuple[Float[np.ndarray, " nodes"], Float[np.ndarray, " nodes"]]


def tabulated_measure(wavelength: Vector, throughput: Vector) -> Rule:
    """Nodes and weights of the trapezium rule over a tabulated curve, refined to 0.5 nm; weights sum to 1."""
    if len(wavelength) == 1:
        return wavelength, np.ones(1)
    pieces = [
        np.linspace(a, b, max(1, int(np.ceil((b - a) / FINEST - 1e-6))), endpoint=False)
        for a, b in itertools.pairwise(wavelength)
    ]
    fine = np.concatenate([*pieces, wavelength[-1:]])
    gap = np.diff(fine)
    weight = np.interp(fine, wavelength, throughput)
    weight *= 0.5 * (np.append(gap, 0.0) + np.append(0.0, gap))
    inside = weight > 0
    return fine[inside], weight[inside] / weight[inside].sum()


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


def gauss_rules(node: Vector, weight: Vector, counts: range) -> Iterator[Rule]:
    """Gauss rules of growing numbers of nodes, fewer than the measure has; its weights sum to 1."""
    centre, half = 0.5 * (node[0] + node[-1]), 0.5 * (node[-1] - node[0])
    rows = _recurrence((node - centre) / half, weight)
    known: list[tuple[float, float]] = []
    for count in counts:
        known += itertools.islice(rows, count - len(known))
        alpha, beta = np.array(known).T
        value, columns = np.linalg.eigh(np.diag(alpha) + np.diag(beta[:-1], 1) + np.diag(beta[:-1], -1))
        yield centre + half * value, columns[0] ** 2


def _fringe_error(
    node: Vector,
    weight: Vector,
    fine: Float[np.ndarray, " f"],
    fine_weight: Float[np.ndarray, " f"],
    waves: float,
) -> float:
    # Phase of a plate of fixed birefringence, 2π waves · 0.62/λ, at a range of thicknesses.
    thickness = 2j * np.pi * 0.62 * waves * np.linspace(0.3, 1.0, 8)[:, None]
    rule = np.exp(thickness / node) @ weight
    exact = np.exp(thickness / fine) @ fine_weight
    return float(np.abs(rule - exact).max())


def band_rule(
    wavelength: Vector, throughput: Vector, tolerance: float = 1e-7, path_difference: float = 0.0
) -> Rule:
    """Fewest wavelength nodes (µm) and weights (sum 1) that integrate plate fringes to `tolerance`.

    Fringes at twice the plates' frequency carry a hundred times less light and are held to a hundred times
    the tolerance; so are those of a `path_difference` (µm), if there is an air gap.
    """
    fringes = path_difference / 0.62
    weak = max(2 * WAVES, fringes)
    fine, fine_weight = tabulated_measure(wavelength, throughput)
    # No rule follows a fringe with fewer than two nodes a cycle: there is no need to try those.
    cycles = 0.62 * fringes * (1.0 / fine[0] - 1.0 / fine[-1])
    counts = range(max(1, int(2.0 * cycles)), min(MAXIMUM_NODES, len(fine)))
    for node, weight in gauss_rules(fine, fine_weight, counts) if counts else ():
        if (
            _fringe_error(node, weight, fine, fine_weight, WAVES) < tolerance
            and _fringe_error(node, weight, fine, fine_weight, weak) < 100 * tolerance
        ):
            return node, weight
    return fine, fine_weight
