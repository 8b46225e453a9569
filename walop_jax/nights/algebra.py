"""Normal equations of many nights under laws of time: pure linear algebra, without any instrument.

A unit (the exposures of one file in one night) says of the values θ of all parameters, counted from a common origin,

    χ²_u(θ) = χ²_u + 2 g_uᵀ θ + θᵀ H_u θ,        θ = D_u x,

with D_u the design of the laws for the unknowns x: `globals`, each with a function of time, and locals, that belong to
one cell, which is a night, or several that a file joins. With A the equations of the globals, T those of the locals
(block tridiagonal, as a random walk couples neighbours and nothing else does) and B the block between them,

    S_c  = T_c − C_c S_{c−1}⁻¹ C_cᵀ,      B'_c = B_c − C_c S_{c−1}⁻¹ B'_{c−1}          forwards
    K    = A − Σ B'_cᵀ S_c⁻¹ B'_c                                                      the globals
    x_c  = S_c⁻¹ (r'_c − B'_c β − C_{c+1}ᵀ x_{c+1})                                    backwards

are exact, and so are the covariances (Rauch, Tung & Striebel 1965; bordered systems as in Millepede II, Blobel 2006).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import linalg

from walop_jax.model.laws import Form, Law

Laws = Sequence[Law | None]
Border = Float[np.ndarray, "_ _"]
OfUnits = Float[np.ndarray, "u n"]

Vector = Float[np.ndarray, " _"]
Matrix = Border


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
        names = ("mjd", "night", "file", "chi2", "gradient", "matrix")
        return dataclasses.replace(self, **{name: getattr(self, name)[keep] for name in names})


class Global(NamedTuple):
    """An unknown of all nights: the parameter that it belongs to, its function of time, its prior (mean, precision)."""

    parameter: int
    form: Form
    mean: float
    precision: float


class Cell(NamedTuple):
    """Unknowns of a cell: parameters, the units that each acts in, prior means and precisions, times of walk states."""

    units: Int[np.ndarray, " v"]
    parameter: Int[np.ndarray, " k"]
    covers: Float[np.ndarray, "k v"]
    mean: Float[np.ndarray, " k"]
    precision: Float[np.ndarray, " k"]
    mjd: Float[np.ndarray, " k"]  # NaN: not a state of a walk


class Eliminated(NamedTuple):
    """A cell in the elimination: its own block and border, coupling to the cell before, and both reduced."""

    block: Matrix
    border: Border
    before: Border
    factor: tuple[Matrix, bool]  # of S_c
    left: Border  # B'_c
    right: Vector  # r'_c


def _precision(width: float) -> float:
    return 0.0 if not np.isfinite(width) else width**-2


@dataclasses.dataclass(frozen=True)
class System:
    """The unknowns of equations under laws: what `solve` eliminates."""

    equations: Equations
    laws: tuple[Law | None, ...]
    globals: tuple[Global, ...]
    cells: tuple[Cell, ...]
    rates: Float[np.ndarray, " n"]  # per √day, NaN where there is no walk
    spread: Float[np.ndarray, " n"]

    @classmethod
    def of(
        cls, equations: Equations, laws: Laws, mean: Vector, width: Vector, means: Bool[np.ndarray, " n"]
    ) -> System:
        """`mean` and `width` (inf: none) are the priors, about the origin; `means`: which have a value by default."""
        scale, forms = equations.scale, []
        middle = float(equations.mjd.mean())
        rates, spread = np.full((2, len(laws)), np.nan)
        local = []
        for i, law in enumerate(laws):
            if law is None:
                continue
            for form, has_prior in law.forms(bool(means[i]), middle):
                prior = (mean[i] / scale[i], _precision(width[i] / scale[i])) if has_prior else (0.0, 0.0)
                forms.append(Global(i, form, *prior))
            if law.rate is not None:
                rates[i] = law.rate / scale[i]
            if law.spread is not None:
                spread[i] = law.spread / scale[i]
            if law.base in ("night", "file", "walk"):
                local.append(i)
        cells = _cells(equations, laws, local, mean / scale, width / scale, spread)
        return cls(equations, tuple(laws), tuple(forms), cells, rates, spread)

    @functools.cached_property
    def at(self) -> Int[np.ndarray, " g"]:
        """The parameter of every global unknown."""
        return np.array([entry.parameter for entry in self.globals], int)

    @functools.cached_property
    def basis(self) -> Float[np.ndarray, "u g"]:
        """The functions of time of the global unknowns at the units."""
        return self.functions(self.equations.mjd)

    def functions(self, mjd: Any) -> Float[np.ndarray, "t g"]:
        """The functions of time of the global unknowns."""
        courses = {form: form.at(mjd) for form in dict.fromkeys(entry.form for entry in self.globals)}
        values = np.ones((len(np.atleast_1d(mjd)), len(self.globals)))
        for g, entry in enumerate(self.globals):
            values[:, g] = courses[entry.form]
        return values


def _cells(
    equations: Equations, laws: Laws, local: Sequence[int], mean: Vector, width: Vector, spread: Vector
) -> tuple[Cell, ...]:
    label = equations.night.copy()
    if any(laws[i].base == "file" for i in local):  # type: ignore[union-attr]
        for _ in range(len(label)):
            joined = label.copy()
            for f in range(equations.file.max() + 1):
                of_file = label[equations.file == f]
                between = (label >= of_file.min()) & (label <= of_file.max())
                joined[between] = np.minimum(joined[between], of_file.min())
            if np.array_equal(joined, label):
                break
            label = joined
    cells = []
    for number in np.unique(label):
        units = np.flatnonzero(label == number)
        parameter, covers, means, precisions, times = [], [], [], [], []
        for i in local:
            law = laws[i]
            assert law is not None
            groups = equations.file[units] if law.base == "file" else equations.night[units]
            for group in np.unique(groups):
                parameter.append(i)
                covers.append((groups == group).astype(float))
                first = law.base == "walk" and not cells and group == groups.min()
                if law.base == "walk":
                    prior = (mean[i], _precision(width[i])) if first else (0.0, 0.0)
                elif np.isfinite(spread[i]):
                    prior = (0.0, spread[i] ** -2)
                else:
                    prior = (mean[i], _precision(width[i]))
                means.append(prior[0])
                precisions.append(prior[1])
                times.append(equations.mjd[units][groups == group].mean() if law.base == "walk" else np.nan)
        held = (np.array(values, float) for values in (means, precisions, times))
        cells.append(Cell(units, np.array(parameter, int), np.array(covers).reshape(-1, len(units)), *held))
    return tuple(cells)


class UndeterminedError(ValueError):
    """Nothing determines an unknown; `parameter` is the one, `unit` one of its units, None: of all nights."""

    def __init__(self, parameter: int, unit: int | None) -> None:
        super().__init__("the nights do not determine a parameter under its law")
        self.parameter, self.unit = parameter, unit


def _factored(matrix: Matrix, parameters: Int[np.ndarray, " k"], unit: int | None) -> tuple[Matrix, bool]:
    """The Cholesky factor; `UndeterminedError` names the first parameter that has nothing left."""
    potrf: Any = linalg.lapack.dpotrf  # pyright: ignore[reportAttributeAccessIssue]
    factor, failed = potrf(matrix, lower=1, clean=1)
    if failed:
        raise UndeterminedError(int(parameters[failed - 1]), unit)
    small = np.diag(factor) ** 2 < 1e-14 * np.maximum(np.diag(matrix), 1e-300)
    if small.any():
        raise UndeterminedError(int(parameters[np.argmax(small)]), unit)
    return factor, True


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
    precision = np.array([entry.precision for entry in system.globals])
    means = np.array([entry.mean for entry in system.globals])
    top[np.diag_indices(size)] += precision
    right += precision * means
    rows_of: list[Any] = []
    before: Cell | None = None
    last: Eliminated | None = None
    for cell in system.cells:
        block, border, rhs = _block(system, cell)
        coupling = _walks(system, cell, before, block, rows_of)
        rows_of.append((block, border, rhs, coupling))
        before = cell
    # Forwards, after all blocks: the walk to the next cell adds to a block.
    done: list[Eliminated] = []
    for cell, (block, border, rhs, coupling) in zip(system.cells, rows_of, strict=True):
        left_block, reduced, remainder = block, border, rhs
        if last is not None and coupling.any():
            gain = linalg.cho_solve(last.factor, coupling.T, check_finite=False).T
            left_block, reduced = block - gain @ coupling.T, border - gain @ last.left
            remainder = rhs - gain @ last.right
        factor = _factored(left_block, cell.parameter, int(cell.units[0])) if len(rhs) else (left_block, True)
        last = Eliminated(block, border, coupling, factor, reduced, remainder)
        done.append(last)
        if len(rhs):
            gain = linalg.cho_solve(factor, np.column_stack([reduced, remainder]), check_finite=False)
            top -= reduced.T @ gain[:, :-1]
            right -= reduced.T @ gain[:, -1]
    factor = _factored(0.5 * (top + top.T), at, None) if size else (top, True)
    shared = linalg.cho_solve(factor, right) if size else right
    values: list[Vector] = [np.zeros(0)] * len(done)
    for c in range(len(done) - 1, -1, -1):
        if len(done[c].right):
            remainder = done[c].right - done[c].left @ shared
            if c + 1 < len(done) and len(values[c + 1]):
                remainder = remainder - done[c + 1].before.T @ values[c + 1]
            values[c] = linalg.cho_solve(done[c].factor, remainder, check_finite=False)
    return Solution(system, shared, tuple(values), tuple(done), factor)


def _block(system: System, cell: Cell) -> tuple[Matrix, Border, Vector]:
    """Own block, border and right side of a cell: priors and data, without walks."""
    e, p = system.equations, cell.parameter
    block = np.diag(cell.precision)
    border, right = np.zeros((len(p), len(system.at))), cell.precision * cell.mean
    if len(p):
        for v, unit in enumerate(cell.units):
            weighted = e.matrix[unit][p] * cell.covers[:, v : v + 1]
            block += weighted[:, p] * cell.covers[:, v]
            border += weighted[:, system.at] * system.basis[unit]
            right = right - cell.covers[:, v] * e.gradient[unit][p]
    return block, border, right


def _walks(system: System, cell: Cell, before: Cell | None, block: Matrix, made: Sequence[Any]) -> Border:
    """Add the steps of walks that end in a cell to its block and the one before; the coupling of both."""
    coupling = np.zeros((len(cell.mjd), 0 if before is None else len(before.mjd)))
    for k in np.flatnonzero(np.isfinite(cell.mjd)):
        i = cell.parameter[k]
        within = np.flatnonzero((cell.parameter == i) & (cell.mjd < cell.mjd[k]))
        previous = np.zeros(0, int) if before is None else np.flatnonzero(before.parameter == i)
        if not len(within) and not len(previous):
            continue
        times, same_cell = (cell.mjd, True) if len(within) else (before.mjd, False)  # type: ignore[union-attr]
        last = (within if same_cell else previous)[np.argmax(times[within if same_cell else previous])]
        variance = system.rates[i] ** 2 * (cell.mjd[k] - times[last])
        block[k, k] += 1.0 / variance
        if same_cell:
            block[last, last] += 1.0 / variance
            block[k, last] -= 1.0 / variance
            block[last, k] -= 1.0 / variance
        else:
            made[-1][0][last, last] += 1.0 / variance
            coupling[k, last] = -1.0 / variance
    return coupling


@dataclasses.dataclass(frozen=True)
class Solution:
    """Unknowns that fit best, in units of `Equations.scale`, with their covariances."""

    system: System
    shared: Vector
    local: tuple[Vector, ...]
    cells: tuple[Eliminated, ...]
    factor: tuple[Matrix, bool]

    @functools.cached_property
    def values(self) -> OfUnits:
        """The parameters in every unit, from the origin, scaled."""
        system = self.system
        values = np.zeros((len(system.equations), len(system.laws)))
        for g, i in enumerate(system.at):
            values[:, i] += system.basis[:, g] * self.shared[g]
        for cell, local in zip(system.cells, self.local, strict=True):
            for k, i in enumerate(cell.parameter):
                values[cell.units, i] += cell.covers[k] * local[k]
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

    @functools.cached_property
    def penalty(self) -> float:
        """χ² of priors and of the steps of walks."""
        system = self.system
        entries = zip(system.globals, self.shared, strict=True)
        total = sum(entry.precision * (value - entry.mean) ** 2 for entry, value in entries)
        last: dict[int, tuple[float, float]] = {}
        for cell, local in zip(system.cells, self.local, strict=True):
            total += float(cell.precision @ (local - cell.mean) ** 2)
            for k in np.argsort(cell.mjd):
                if np.isfinite(cell.mjd[k]):
                    i = int(cell.parameter[k])
                    if i in last:
                        gone = cell.mjd[k] - last[i][0]
                        total += (local[k] - last[i][1]) ** 2 / (system.rates[i] ** 2 * gone)
                    last[i] = (float(cell.mjd[k]), float(local[k]))
        return float(total)

    @functools.cached_property
    def covariance(self) -> Matrix:
        """Covariance of the global unknowns."""
        size = len(self.shared)
        return linalg.cho_solve(self.factor, np.eye(size)) if size else np.zeros((0, 0))

    @functools.cached_property
    def smoothed(self) -> list[tuple[Matrix, Matrix, Matrix]]:
        """Of every cell the covariance of its unknowns, that with the globals, and that with the next cell's."""
        smoothed: list[tuple[Matrix, Matrix, Matrix]] = []
        later: tuple[Matrix, Matrix] | None = None
        for c in range(len(self.cells) - 1, -1, -1):
            entry, size = self.cells[c], len(self.local[c])
            if not size:
                later = (np.zeros((0, 0)), np.zeros((0, len(self.shared))))
                smoothed.append((*later, np.zeros((0, 0))))
                continue
            after = None if c + 1 == len(self.cells) else self.cells[c + 1].before
            joint, sides = self.covariance, entry.left
            if after is not None and after.any():
                block, cross = later  # type: ignore[misc]
                joint = np.block([[joint, cross.T], [cross, block]])
                sides = np.hstack([sides, after.T])
            gain = linalg.cho_solve(entry.factor, sides, check_finite=False)
            with_others = -gain @ joint
            block = linalg.cho_solve(entry.factor, np.eye(size)) - with_others @ gain.T
            split = len(self.shared)
            next_one = with_others[:, split:]
            if after is not None and not next_one.size and len(after):
                # Independent locals of neighbours share the globals alone.
                next_one = -gain @ later[1].T  # type: ignore[index]
            later = (block, with_others[:, :split])
            smoothed.append((block, with_others[:, :split], next_one))
        return smoothed[::-1]

    def predict(self, mjd: float, night: int | None = None) -> tuple[Vector, Matrix]:
        """All parameters at a time (MJD), from the origin, scaled, and their covariance.

        `night` is the number of the night that the time belongs to, None for one without equations. A walk is
        interpolated between nights (a Brownian bridge) and goes on behind the last; values of single nights and files
        are known in these alone, elsewhere they scatter as they do over the nights.
        """
        system, n = self.system, len(self.system.laws)
        function = system.functions(mjd)[0]
        terms: list[tuple[int, int, int, float]] = []  # parameter, cell, place in it, weight
        extra = np.zeros(n)
        value = np.zeros(n)
        nights = [system.equations.night[cell.units] for cell in system.cells]
        numbered = (c for c, members in enumerate(nights) if night is not None and night in members)
        current = next(numbered, None)
        for i, law in enumerate(system.laws):
            if law is None or law.base not in ("night", "file", "walk"):
                continue
            if law.base == "walk":
                terms += self._bridge(i, mjd, extra)
                continue
            places = [] if current is None else self._own(i, current, mjd, night)
            if places:
                terms.append((i, current, places[0], 1.0))  # type: ignore[arg-type]
                continue
            if np.isfinite(system.spread[i]):
                extra[i] += system.spread[i] ** 2
                continue
            scatter = self.values[:, i]
            value[i], extra[i] = scatter.mean(), scatter.var(ddof=1) if len(scatter) > 1 else np.inf
        design = np.zeros((n, len(self.shared) + len(terms)))
        design[system.at, np.arange(len(self.shared))] = function
        for k, (i, _, _, weight) in enumerate(terms):
            design[i, len(self.shared) + k] = weight
        local = np.array([self.local[c][k] for _, c, k, _ in terms])
        value += design @ np.concatenate([self.shared, local])
        covariance = design @ self._joint(terms) @ design.T
        covariance[np.diag_indices(n)] += extra
        return value, covariance

    def _own(self, i: int, c: int, mjd: float, night: int | None) -> list[int]:
        """The unknown of a parameter in a cell that holds at a time of a night."""
        e, cell = self.system.equations, self.system.cells[c]
        in_night = np.flatnonzero(e.night[cell.units] == night)
        unit = in_night[np.argmin(np.abs(e.mjd[cell.units[in_night]] - mjd))]
        return np.flatnonzero((cell.parameter == i) & (cell.covers[:, unit] > 0)).tolist()

    @functools.cached_property
    def _states(self) -> dict[int, list[tuple[float, int, int]]]:
        """The states of every walk: time, cell, place."""
        states: dict[int, list[tuple[float, int, int]]] = {}
        for c, cell in enumerate(self.system.cells):
            for k in np.flatnonzero(np.isfinite(cell.mjd)):
                states.setdefault(int(cell.parameter[k]), []).append((float(cell.mjd[k]), c, int(k)))
        return {i: sorted(entries) for i, entries in states.items()}

    def _bridge(self, i: int, mjd: float, extra: Vector) -> list[tuple[int, int, int, float]]:
        states, rate = self._states[i], self.system.rates[i]
        times = [time for time, _, _ in states]
        after = int(np.searchsorted(times, mjd))
        if after in (0, len(times)):
            time, c, k = states[min(after, len(times) - 1)]
            extra[i] += rate**2 * abs(mjd - time)
            return [(i, c, k, 1.0)]
        (start, *earlier), (stop, *two) = states[after - 1], states[after]
        share = (mjd - start) / (stop - start)
        extra[i] += rate**2 * (mjd - start) * (1.0 - share)
        return [(i, earlier[0], earlier[1], 1.0 - share), (i, two[0], two[1], share)]

    def _joint(self, parts: Sequence[tuple[int, int, int, float]]) -> Matrix:
        """Covariance of the globals and of unknowns of at most two neighbouring cells."""
        size = len(self.shared)
        joint = np.zeros((size + len(parts), size + len(parts)))
        joint[:size, :size] = self.covariance
        for a, (_, c, k, _) in enumerate(parts):
            block, cross, after = self.smoothed[c]
            joint[size + a, :size] = joint[:size, size + a] = cross[k]
            for b, (_, d, m, _) in enumerate(parts[: a + 1]):
                if c == d:
                    value = block[k, m]
                elif d == c + 1:
                    value = after[k, m]
                else:
                    value = self.smoothed[d][2][m, k]
                joint[size + a, size + b] = joint[size + b, size + a] = value
        return joint

    def errors(self) -> OfUnits:
        """Standard errors of the parameters in every unit, scaled."""
        system = self.system
        variance = np.zeros_like(self.values)
        shared = np.array_equal(system.basis, np.ones_like(system.basis))
        fixed = np.zeros(len(system.laws))
        np.add.at(fixed, system.at, np.diag(self.covariance))
        local = {i for cell in system.cells[:1] for i in cell.parameter}
        for u in range(len(variance)):
            if shared:
                variance[u] = fixed
            else:
                design = np.zeros((len(system.laws), len(self.shared)))
                design[system.at, np.arange(len(self.shared))] = system.basis[u]
                variance[u] = np.einsum("ng,gh,nh->n", design, self.covariance, design, optimize=True)
        if local:
            for c, cell in enumerate(system.cells):
                block, cross, _ = self.smoothed[c]
                for k, i in enumerate(cell.parameter):
                    units = cell.units[cell.covers[k] > 0]
                    mine = np.flatnonzero(system.at == i)
                    shared_part = system.basis[np.ix_(units, mine)] @ cross[k, mine]
                    variance[units, i] += block[k, k] + 2.0 * shared_part
        return np.sqrt(np.clip(variance, 0.0, None))
