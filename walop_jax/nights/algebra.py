"""Normal equations of many nights under laws of time: pure linear algebra, without any instrument.

A unit (the exposures of one file in one night) says of the values θ of all parameters, counted from a common origin,

    χ²_u(θ) = χ²_u + 2 g_uᵀ θ + θᵀ H_u θ,        θ = D_u x,

with D_u the design of the laws for the unknowns x. Unknowns are either `globals`, each with a function of time, or
locals, which belong to one cell: a night, or several nights that a file joins. With A the equations of the globals, T
the equations of the locals (block tridiagonal, as a random walk couples neighbours and nothing else does) and B the
block between them,

    S_c  = T_c − C_c S_{c−1}⁻¹ C_cᵀ,      B'_c = B_c − C_c S_{c−1}⁻¹ B'_{c−1}          forwards
    K    = A − Σ B'_cᵀ S_c⁻¹ B'_c                                                      the globals
    x_c  = S_c⁻¹ (r'_c − B'_c β − C_{c+1}ᵀ x_{c+1})                                    backwards

are exact, and so are the covariances (Rauch, Tung & Striebel 1965; bordered systems as in Millepede II, Blobel 2006).
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import linalg

from walop_jax.io.shapes import AnyMatrix, AnyVector
from walop_jax.likelihood.inverses import pseudo_inverse
from walop_jax.model.laws import Form, Law

LawOfEach = Sequence[Law | None]
OfUnits = Float[np.ndarray, "u n"]

LOCAL = ("night", "file", "walk")  # bases of laws that give a parameter values of its own in every cell


@dataclasses.dataclass(frozen=True)
class Equations:
    """Normal equations of units in the order of time, about a common origin, each parameter in units of `scale`.

    `night` numbers the nights and `file` the files; χ² is of the data alone.
    """

    mjd: Float[np.ndarray, " u"]
    night: Int[np.ndarray, " u"]
    file: Int[np.ndarray, " u"]
    chi2: Float[np.ndarray, " u"]
    gradient: OfUnits
    matrix: Float[np.ndarray, "u n n"]
    scale: Float[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.mjd)

    def only(self, keep: Bool[np.ndarray, " u"]) -> Equations:
        """The equations of some units."""
        of_units = {name: values[keep] for name, values in vars(self).items() if name != "scale"}
        return dataclasses.replace(self, **of_units)


class Cell(NamedTuple):
    """Unknowns of a cell (a night, or several that a file joins): parameters, the units in which each acts, priors."""

    units: Int[np.ndarray, " v"]
    parameter: Int[np.ndarray, " k"]
    covers: Float[np.ndarray, "k v"]
    mean: Float[np.ndarray, " k"]
    precision: Float[np.ndarray, " k"]


class Eliminated(NamedTuple):
    """A cell in the elimination: its own block and border, coupling to the cell before, and both reduced."""

    block: AnyMatrix
    border: AnyMatrix
    before: AnyMatrix
    factor: tuple[AnyMatrix, bool]  # of S_c
    left: AnyMatrix  # B'_c
    right: AnyVector  # r'_c


@dataclasses.dataclass(frozen=True)
class System:
    """The unknowns of equations under laws, which `solve` eliminates.

    For the unknowns of all nights, `at` are the parameters, `forms` the functions of time, `mean` and `precision` the
    priors.
    """

    equations: Equations
    laws: tuple[Law | None, ...]
    at: Int[np.ndarray, " g"]
    forms: tuple[Form, ...]
    mean: Float[np.ndarray, " g"]
    precision: Float[np.ndarray, " g"]
    cells: tuple[Cell, ...]
    rates: Float[np.ndarray, " n"]  # per √day, NaN where there is no walk
    spread: Float[np.ndarray, " n"]

    @classmethod
    def of(
        cls,
        equations: Equations,
        laws: LawOfEach,
        mean: AnyVector,
        width: AnyVector,
        means: Bool[np.ndarray, " n"],
    ) -> System:
        """The unknowns that laws give equations.

        `mean` and `width` (inf: none) are the priors, counted from the origin; `means` is true for parameters that have
        a value by default.
        """
        scale, middle = equations.scale, float(equations.mjd.mean())
        mean, precision = mean / scale, np.array([w**-2.0 for w in width / scale])
        every = [(i, *f) for i, law in enumerate(laws) if law for f in law.forms(bool(means[i]), middle)]
        at, stated = np.array([i for i, *_ in every], int), np.array([has for *_, has in every], bool)
        centre, strength = np.where(stated, [mean[at], precision[at]], 0.0)
        rates = np.array([law and law.rate for law in laws], float) / scale  # None is NaN
        spread = np.array([law and law.spread for law in laws], float) / scale
        forms, cells = (form for _, form, _ in every), _cells(equations, laws, mean, precision, spread)
        return cls(equations, tuple(laws), at, tuple(forms), centre, strength, tuple(cells), rates, spread)

    @functools.cached_property
    def basis(self) -> Float[np.ndarray, "u g"]:
        """The functions of time of the global unknowns at the units."""
        return self.functions(self.equations.mjd)

    def functions(self, mjd: Any) -> Float[np.ndarray, "t g"]:
        """The functions of time of the global unknowns."""
        times = np.atleast_1d(mjd)
        return np.column_stack([np.zeros((len(times), 0)), *(form.at(times) for form in self.forms)])

    @functools.cached_property
    def locals(self) -> list[tuple[int, int, int, Int[np.ndarray, " v"]]]:
        """For every unknown of a cell: the cell, its position in the cell, its parameter, and the units in which it
        acts.
        """
        return [
            (c, k, i, cell.units[cell.covers[k] > 0])
            for c, cell in enumerate(self.cells)
            for k, i in enumerate(cell.parameter.tolist())
        ]

    @functools.cached_property
    def states(self) -> dict[int, list[tuple[float, int, int]]]:
        """For every parameter that walks its states, night by night: time (MJD), cell, position in the cell."""
        states: dict[int, list[tuple[float, int, int]]] = {}
        for c, k, i, units in self.locals:
            if np.isfinite(self.rates[i]):
                states.setdefault(i, []).append((float(self.equations.mjd[units].mean()), c, k))
        return states

    def steps(self) -> Iterator[tuple[float, list[int], list[int]]]:
        """For every step of a walk its precision, and cell and position of the states before and after it."""
        for i, states in self.states.items():
            for (start, *before), (stop, *after) in itertools.pairwise(states):
                yield 1.0 / (self.rates[i] ** 2 * (stop - start)), before, after


def _cells(
    equations: Equations, laws: LawOfEach, mean: AnyVector, precision: AnyVector, spread: AnyVector
) -> list[Cell]:
    """The cells in the order of time; the first state of a walk alone has the prior of its parameter."""
    local = {i: law for i, law in enumerate(laws) if law is not None and law.base in LOCAL}
    ends = np.ones(equations.night.max() + 1, bool)  # of a cell, with each night
    if any(law.base == "file" for law in local.values()):
        for file in np.unique(equations.file):
            nights = equations.night[equations.file == file]
            ends[nights.min() : nights.max()] = False
    label = np.append(0, np.cumsum(ends))[equations.night]
    scatters = np.isfinite(spread)
    mean, precision = np.where(scatters, 0.0, mean), np.where(scatters, spread**-2.0, precision)
    cells: list[Cell] = []
    for number in np.unique(label):
        units = np.flatnonzero(label == number)
        parameter, covers, priors = [], [], []
        for i, law in local.items():
            groups = equations.file[units] if law.base == "file" else equations.night[units]
            for k, group in enumerate(np.unique(groups)):
                parameter.append(i)
                covers.append(groups == group)
                priors.append((0.0, 0.0) if law.base == "walk" and (cells or k) else (mean[i], precision[i]))
        acts = np.array(covers, float).reshape(-1, len(units))
        cells.append(Cell(units, np.array(parameter, int), acts, *np.array(priors, float).reshape(-1, 2).T))
    return cells


class UndeterminedError(ValueError):
    """Nothing determines an unknown of `parameter`, in the unit `unit` (None: in all nights)."""

    def __init__(self, parameter: int, unit: int | None) -> None:
        super().__init__("the nights do not determine a parameter under its law")
        self.parameter, self.unit = parameter, unit


def _factored(
    matrix: AnyMatrix, parameters: Int[np.ndarray, " k"], unit: int | None
) -> tuple[AnyMatrix, bool]:
    """The Cholesky factor; `UndeterminedError` names the first parameter that has nothing left."""
    potrf: Any = linalg.lapack.dpotrf  # pyright: ignore[reportAttributeAccessIssue]
    factor, failed = potrf(matrix, lower=1, clean=1)
    if failed:
        raise UndeterminedError(int(parameters[failed - 1]), unit)
    small = np.diag(factor) ** 2 < 1e-14 * np.maximum(np.diag(matrix), 1e-300)
    if small.any():
        raise UndeterminedError(int(parameters[np.argmax(small)]), unit)
    return factor, True


def cholesky_solve(factor: tuple[AnyMatrix, Any], right: Any) -> Any:
    """The inverse of a factored matrix (`scipy.linalg.cho_factor`) times right sides, of which there may be none."""
    return linalg.cho_solve(factor, right, check_finite=False) if right.size else right


def solve(system: System) -> Solution:
    """The most probable values of all unknowns. Raises `UndeterminedError` where there is none."""
    e, at, basis = system.equations, system.at, system.basis
    size = len(at)
    top, right = np.zeros((size, size)), np.zeros(size)
    # Functions of time meet in pairs: units are summed once for every pair of functions that differ.
    kinds, which = np.unique(basis, axis=1, return_inverse=True)
    rows = [np.flatnonzero(which == k) for k in range(kinds.shape[1])]
    for a, mine in enumerate(rows):
        right[mine] = -(kinds[:, a] @ e.gradient[:, at[mine]])
        for b, columns in enumerate(rows[: a + 1]):
            weight = kinds[:, a] * kinds[:, b]
            if weight.any():
                summed = np.tensordot(weight, e.matrix, 1)[np.ix_(at[mine], at[columns])]
                top[np.ix_(mine, columns)] = summed
                top[np.ix_(columns, mine)] = summed.T
    top[np.diag_indices(size)] += system.precision
    right += system.precision * system.mean
    blocks = [_block(system, cell) for cell in system.cells]
    sizes = [len(cell.parameter) for cell in system.cells]
    links = [np.zeros(shape) for shape in zip(sizes, [0, *sizes[:-1]], strict=True)]  # with the cell before
    for precision, (b, j), (c, k) in system.steps():
        blocks[b][0][j, j] += precision
        blocks[c][0][k, k] += precision
        if b == c:
            blocks[c][0][[j, k], [k, j]] -= precision
        else:
            links[c][k, j] = -precision
    done: list[Eliminated] = []
    for cell, (block, border, rhs), link in zip(system.cells, blocks, links, strict=True):
        reduced, left, remainder = block, border, rhs
        if link.any():
            gain = cholesky_solve(done[-1].factor, link.T).T
            reduced, left = block - gain @ link.T, border - gain @ done[-1].left
            remainder = rhs - gain @ done[-1].right
        factor = _factored(reduced, cell.parameter, int(cell.units[0]))
        done.append(Eliminated(block, border, link, factor, left, remainder))
        gain = cholesky_solve(factor, np.column_stack([left, remainder]))
        top -= left.T @ gain[:, :-1]
        right -= left.T @ gain[:, -1]
    factor = _factored(0.5 * (top + top.T), at, None)
    shared = cholesky_solve(factor, right)
    values: list[AnyVector] = []
    for c in reversed(range(len(done))):
        remainder = done[c].right - done[c].left @ shared
        if values:
            remainder = remainder - done[c + 1].before.T @ values[-1]
        values.append(cholesky_solve(done[c].factor, remainder))
    return Solution(system, shared, tuple(values[::-1]), tuple(done), factor)


def _block(system: System, cell: Cell) -> tuple[AnyMatrix, AnyMatrix, AnyVector]:
    """Own block, border and right side of a cell: priors and data, without the steps of walks."""
    e, p = system.equations, cell.parameter
    block = np.diag(cell.precision)
    border, right = np.zeros((len(p), len(system.at))), cell.precision * cell.mean
    for v, unit in enumerate(cell.units):
        weighted = e.matrix[unit][p] * cell.covers[:, v : v + 1]
        block += weighted[:, p] * cell.covers[:, v]
        border += weighted[:, system.at] * system.basis[unit]
        right = right - cell.covers[:, v] * e.gradient[unit][p]
    return block, border, right


@dataclasses.dataclass(frozen=True)
class Solution:
    """Unknowns that fit best, in units of `Equations.scale`, with their covariances."""

    system: System
    shared: AnyVector
    local: tuple[AnyVector, ...]
    cells: tuple[Eliminated, ...]
    factor: tuple[AnyMatrix, bool]

    @functools.cached_property
    def values(self) -> OfUnits:
        """The parameters in every unit, from the origin, scaled."""
        system = self.system
        values = np.zeros((len(system.equations), len(system.laws)))
        np.add.at(values.T, system.at, (system.basis * self.shared).T)
        for c, k, i, units in system.locals:
            values[units, i] += self.local[c][k]
        return values

    @functools.cached_property
    def slopes(self) -> OfUnits:
        """Half the gradient of χ² of every unit with respect to its parameters, at the solution."""
        e = self.system.equations
        return e.gradient + (e.matrix @ self.values[:, :, None])[:, :, 0]

    @functools.cached_property
    def unit_chi2(self) -> Float[np.ndarray, " u"]:
        """χ² of the data of every unit at the solution."""
        e = self.system.equations
        return e.chi2 + np.sum((e.gradient + self.slopes) * self.values, axis=1)

    @property
    def chi2(self) -> float:
        """χ² of the data."""
        return float(self.unit_chi2.sum())

    @property
    def walked(self) -> list[float]:
        """χ² of every step of a walk."""
        pairs = ((p, self.local[c][k] - self.local[b][j]) for p, (b, j), (c, k) in self.system.steps())
        return [float(precision * step**2) for precision, step in pairs]

    @functools.cached_property
    def covariance(self) -> AnyMatrix:
        """Covariance of the global unknowns."""
        return cholesky_solve(self.factor, np.eye(len(self.shared)))

    @functools.cached_property
    def smoothed(self) -> list[tuple[AnyMatrix, AnyMatrix]]:
        """For every cell the covariance of its unknowns, and their covariance with the globals and the unknowns of the
        next cell.
        """
        smoothed: list[tuple[AnyMatrix, AnyMatrix]] = []
        beside = self.covariance  # of the globals and the next cell: none behind the last
        for c in reversed(range(len(self.cells))):
            entry = self.cells[c]
            coupling = [self.cells[c + 1].before.T] if smoothed else []
            gain = cholesky_solve(entry.factor, np.hstack([entry.left, *coupling]))
            others = -gain @ beside
            block = cholesky_solve(entry.factor, np.eye(len(entry.right))) - others @ gain.T
            beside = _joined(self.covariance, block, others)
            smoothed.append((block, others))
        return smoothed[::-1]

    def predict(
        self, mjd: float, night: int | None = None, moved: AnyVector | float = 0.0
    ) -> tuple[AnyVector, AnyMatrix]:
        """All parameters at a time (MJD), from the origin, scaled, and their covariance.

        `night` is the number of the night that the time belongs to, None for one without equations; `moved` is added
        to the functions of time of the globals. A walk is interpolated between nights (a Brownian bridge) and goes on
        behind the last; values of single nights and files are known in these alone, elsewhere they scatter as they do
        over the nights.
        """
        system, e, n = self.system, self.system.equations, len(self.system.laws)
        functions = system.functions(mjd)[0] + moved
        here: dict[int, tuple[int, int]] = {}  # cell and place of the values of the unit at this time
        if night is not None:
            units = np.flatnonzero(e.night == night)
            unit = units[np.argmin(np.abs(e.mjd[units] - mjd))]
            here = {i: (c, k) for c, k, i, covered in system.locals if unit in covered}
        terms: list[tuple[int, int, int, float]] = []  # parameter, cell, place in it, weight
        extra, value, scattering = np.zeros(n), np.zeros(n), list[int]()
        for i, law in enumerate(system.laws):
            if law is None or law.base not in LOCAL:
                continue
            if law.base == "walk":
                beside, extra[i] = self._bridge(i, mjd)
                terms += beside
            elif night is not None:
                terms.append((i, *here[i], 1.0))
            elif np.isfinite(system.spread[i]):
                extra[i] = system.spread[i] ** 2
            else:
                value[i], extra[i] = self._elsewhere(i, functions)
                scattering.append(i)
        # The cells of a time are neighbours; their unknowns follow the globals, those of the later cell first.
        cells = sorted({c for _, c, _, _ in terms}, reverse=True)
        joint, first = self.covariance, {}
        for c in cells:
            first[c] = len(joint)
            block, others = self.smoothed[c]
            joint = _joined(joint, block, others)
        design = np.zeros((n, len(joint)))
        design[system.at, np.arange(len(self.shared))] = functions
        for i, c, k, weight in terms:
            design[i, first[c] + k] = weight
        design[scattering] = 0.0
        value += design @ np.concatenate([self.shared, *(self.local[c] for c in cells)])
        covariance = design @ joint @ design.T
        covariance[np.diag_indices(n)] += extra
        return value, covariance

    def _elsewhere(self, i: int, at_time: AnyVector) -> tuple[float, float]:
        """A value of single nights or files where no data are, the globals having these functions, and its variance.

        Least squares of the values in a constant and the steps, bad nights and trends of the parameter: these may be
        in the values as well as beside them. The variance is that of the residuals, and of what was fitted.
        """
        system = self.system
        first = np.array([units[0] for _, _, j, units in system.locals if j == i])
        functions = np.vstack([system.basis[first], at_time])[:, system.at == i]
        functions = np.column_stack([np.ones(len(functions)), functions])
        design, here, values = functions[:-1], functions[-1], self.values[first, i]
        inverse = pseudo_inverse(design.T @ design, 1e-12)
        coefficients = inverse @ (design.T @ values)
        free = len(first) - np.linalg.matrix_rank(design)
        scatter = float(np.sum((values - design @ coefficients) ** 2)) / free if free > 0 else np.inf
        return float(here @ coefficients), scatter * (1.0 + float(here @ inverse @ here))

    def _bridge(self, i: int, mjd: float) -> tuple[list[tuple[int, int, int, float]], float]:
        """The states beside a time with their weights, and the variance of the walk between them."""
        states, variance = self.system.states[i], self.system.rates[i] ** 2
        times = [time for time, _, _ in states]
        after = int(np.searchsorted(times, mjd))
        if after in (0, len(times)):
            time, c, k = states[min(after, len(times) - 1)]
            return [(i, c, k, 1.0)], variance * abs(mjd - time)
        (start, *before), (stop, *behind) = states[after - 1], states[after]
        share = (mjd - start) / (stop - start)
        weighted = [(i, before[0], before[1], 1.0 - share), (i, behind[0], behind[1], share)]
        return weighted, variance * (mjd - start) * (1.0 - share)

    def errors(self) -> OfUnits:
        """Standard errors of the parameters in every unit, scaled."""
        system = self.system
        variance = np.zeros_like(self.values)
        same = system.at[:, None] == system.at  # globals of one parameter
        of_globals = system.basis * (system.basis @ (self.covariance * same))
        np.add.at(variance.T, system.at, of_globals.T)
        for c, k, i, units in system.locals:
            block, others = self.smoothed[c]
            with_globals = system.basis[units] @ np.where(system.at == i, others[k, : len(self.shared)], 0.0)
            variance[units, i] += block[k, k] + 2.0 * with_globals
        return np.sqrt(np.clip(variance, 0.0, None))


def _joined(covariance: AnyMatrix, block: AnyMatrix, others: AnyMatrix) -> AnyMatrix:
    """A covariance extended by further unknowns.

    `block` is the covariance of the further unknowns, `others` their covariance with the first ones, and maybe with
    more.
    """
    cross = others[:, : len(covariance)]
    return np.block([[covariance, cross.T], [cross, block]])
