"""Changes of parameters that a solution does not have: scores of all of them at once. Pure linear algebra.

A change h of parameter j from cell b on, or in cell b alone, has the score s = −Σ (g_u + H_u θ_u)_j and the information

    I = a − c_xᵀ T⁻¹ c_x − eᵀ K⁻¹ e,       e = c_g − Bᵀ T⁻¹ c_x,

c its cross terms with locals and globals: for all b and j at once from an elimination forwards and one backwards. Then
z = s/√I is the change in its standard errors with everything else fitted anew, s/I its size.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy import linalg

from walop_jax.io.shapes import AnyMatrix, AnyVector
from walop_jax.nights.algebra import Solution, cholesky_solve

NOTHING = 1e-9  # fraction of its information below which a change is taken up by the laws altogether


def _information(
    of: Solution, direct: AnyVector, cross: Float[np.ndarray, "_ n"], taken: AnyVector
) -> Float[np.ndarray, " n"]:
    """Direct information less what locals and globals take."""
    remaining = direct - taken
    if len(cross):
        lower = linalg.solve_triangular(of.factor[0], cross, lower=True, check_finite=False)
        remaining = remaining - np.einsum("gn,gn->n", lower, lower)
    return np.where(remaining > NOTHING * np.maximum(direct, 1e-300), remaining, 0.0)


def scan(of: Solution) -> tuple[Float[np.ndarray, "2 c n"], Float[np.ndarray, "2 c n"]]:
    """Scores and information of changes of every parameter (n): from every cell (c) on, then in every cell alone.

    From the first cell on is a value in all nights. The information is 0 where the laws take the change up. Scaled as
    the equations.
    """
    system, e = of.system, of.system.equations
    n, count, globals_ = len(system.laws), len(system.cells), len(system.at)
    score, information = np.zeros((2, count, n)), np.zeros((2, count, n))
    cross, direct = np.zeros((globals_, n)), np.zeros(n)
    absorbed, border_taken = np.zeros(n), np.zeros((globals_, n))
    behind: tuple[tuple[AnyMatrix, bool], AnyMatrix, AnyMatrix] | None = None  # of the cell behind: U, B̃, c̃
    for c in reversed(range(count)):
        cell, entry = system.cells[c], of.cells[c]
        cross_here = np.zeros((globals_, n))
        local, mine = np.zeros((len(cell.parameter), n)), np.zeros(n)
        for v, unit in enumerate(cell.units):
            matrix = e.matrix[unit]
            cross_here += system.basis[unit][:, None] * matrix[system.at]
            local += cell.covers[:, v : v + 1] * matrix[cell.parameter]
            mine += np.diag(matrix)
        cross, direct = cross + cross_here, direct + mine
        score[:, c] = -of.slopes[cell.units].sum(axis=0)
        block, border, moved = entry.block, entry.border, local
        if behind is not None:
            factor, border_behind, moved_behind = behind
            gain = cholesky_solve(factor, of.cells[c + 1].before).T
            block, border = block - gain @ of.cells[c + 1].before, border - gain @ border_behind
            moved = local - gain @ moved_behind
        # Precision of the cell given all others, from before and from behind; without the globals.
        lower = entry.factor[0]
        joint = linalg.cho_factor(lower @ lower.T + block - entry.block, lower=True, check_finite=False)
        sides = border + entry.left - entry.border
        solved = cholesky_solve(joint, moved)
        taken = absorbed + np.einsum("kn,kn->n", moved, solved)
        beyond = cross - border_taken - sides.T @ solved
        information[0, c] = _information(of, direct, beyond, taken)
        solved = cholesky_solve(joint, local)
        taken = np.einsum("kn,kn->n", local, solved)
        information[1, c] = _information(of, mine, cross_here - sides.T @ solved, taken)
        factor = linalg.cho_factor(block, lower=True, check_finite=False)
        solved = cholesky_solve(factor, moved)
        absorbed = absorbed + np.einsum("kn,kn->n", moved, solved)
        border_taken = border_taken + border.T @ solved
        behind = factor, border, moved
    score[0] = np.cumsum(score[0, ::-1], axis=0)[::-1]
    return score, information


def weighted(
    of: Solution, weights: Float[np.ndarray, "u v"], parameter: Int[np.ndarray, " v"]
) -> tuple[AnyVector, AnyMatrix]:
    """Scores of changes of any course, and their information: `weights` are its values in every unit.

    The information is that of all of them together, off the diagonal what two have in common.
    """
    system, e = of.system, of.system.equations
    count, globals_ = len(parameter), len(system.at)
    direct, cross = np.zeros((count, count)), np.zeros((globals_, count))
    absorbed, border_taken = np.zeros((count, count)), np.zeros((globals_, count))
    moved = np.zeros((0, count))
    for c, cell in enumerate(system.cells):
        local = np.zeros((len(cell.parameter), count))
        for v, unit in enumerate(cell.units):
            if weights[unit].any():
                columns = e.matrix[unit][:, parameter] * weights[unit]
                direct += columns[parameter] * weights[unit][:, None]
                cross += system.basis[unit][:, None] * columns[system.at]
                local += cell.covers[:, v : v + 1] * columns[cell.parameter]
        entry = of.cells[c]
        if entry.before.any():
            local = local - cholesky_solve(of.cells[c - 1].factor, entry.before.T).T @ moved
        solved = cholesky_solve(entry.factor, local)
        absorbed += local.T @ solved
        border_taken += entry.left.T @ solved
        moved = local
    information = direct - absorbed
    if globals_:
        lower = linalg.solve_triangular(of.factor[0], cross - border_taken, lower=True, check_finite=False)
        information = information - lower.T @ lower
    gone = np.diag(information) <= NOTHING * np.maximum(np.diag(direct), 1e-300)
    information[gone] = 0.0
    information[:, gone] = 0.0
    return -np.sum(of.slopes[:, parameter] * weights, axis=0), information
