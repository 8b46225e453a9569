"""The efficient score: what each candidate would explain that the base parameters cannot. Plain linear algebra.

Symbols      r whitened residuals at the best fit, prior rows appended; J = ∂r/∂θ of the free base parameters;
             C_g = ∂r/∂ε of the amplitudes of candidate g at zero.
Projection   C̃ = (1 − QQᵀ) C with Q from the QR decomposition of J: removed is the part that the base absorbs.
Gram matrix  Everything below follows from G = C̃ᵀC̃, s = C̃ᵀr and r·r. A candidate joins the base by a Schur complement.
Statistic    T_g = s_gᵀ G_gg⁺ s_g; χ² with rank(G_gg) degrees of freedom under the base model.
             One-step amplitudes ε = −G_gg⁺ s_g, covariance G_gg⁺.
Noise scale  T is divided by the mean square of the residuals in the complement of base and candidates, so that
             errors that are stated a few per cent too small or too large raise no alarm (an F statistic; the
             complement has thousands of degrees of freedom, so χ² serves).
Global p     Under the base model the scores of all candidates together are N(0, G): the smallest p of a draw is
             compared with the smallest p found, a thousand times, without a model call. Below the smallest fifth of
             the draws p follows from the effective number of trials n that these give: with 1 − (1 − p)ⁿ the chance of
             a smallest p below p, n = k / (Σ_{i≤k} tᵢ + (D − k) tₖ) for the k smallest t = −ln(1 − p) of D draws (to
             1/√k; measured between 0.3 % and 40 % of the draws it is the same to a tenth).
Sources      Rao 1948; Bera & Bilias 2001, J. Stat. Plan. Inference 97, 9 (score tests); Gross & Vitells 2010,
             Eur. Phys. J. C 70, 525 (trial factors).

Products of matrices with hundreds of columns and 10⁴ to 10⁶ rows are taken piece by piece on all cores. The command
line keeps numpy to one thread, as its matrices are small everywhere else. The pieces do not depend on the number of
cores, and so neither do the results."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import linalg, special

from walop_jax.io.code import cores
from walop_jax.io.shapes import AnyMatrix, AnyVector
from walop_jax.likelihood import limits
from walop_jax.likelihood.inverses import unit_columns, whitening

NULL_DRAWS = 1_000
"""Draws of all scores under the base model: a fifth of them give the number of trials to 7 %."""

Gram = Any
"""A symmetric matrix whose entries are asked for by index: an array, `Repeated`, `Less` or `Blocks`."""
Reduction = Callable[[AnyVector, float], tuple[AnyVector, float]]

ABSORBED = 1e-6  # surviving share of a column's square below which the base has swallowed it
FAINTEST = 0.05  # standard deviations that a plausible amplitude must reach to be testable
ROOT_TOLERANCE = 1e-6  # far above what columns in single precision leave, far below a part that counts
LEAST_REST = 0.1  # share of the degrees of freedom that must be left behind all candidates to tell the noise
SCALES = np.array([1.0, 0.3, 0.1, 0.03])  # of the numbers of one effect, in widths of their priors
SKETCHES = 6  # random sums of its entries that a column is recognised by
SAME = 3e-7  # distance of two columns of unit length that single precision cannot tell apart
TAIL = 0.2  # share of the draws, those with the smallest p, that give the number of trials


@dataclasses.dataclass(frozen=True)
class Candidate:
    """A named set of columns: the derivative of the residuals with respect to its amplitudes.

    `widths` are the prior standard deviations of the amplitudes, in their own units. `block` is the block of the
    free-form term that can take it up, where there is one.
    """

    name: str
    columns: AnyMatrix
    widths: AnyVector
    block: str = ""


@dataclasses.dataclass(frozen=True)
class Score:
    """The efficient score of one candidate.

    `statistic` T and `rank`; `log_p` ln of the local p; `amplitudes` one step from zero with `covariance`; `log_bayes`
    ln B against the base for the prior widths, exact (the function `log_bayes`). A ghost of 0.3 % ± 0.1 % has one
    amplitude, 0.003, the rank 1 and the statistic 9, the square of its three standard errors.
    """

    name: str
    statistic: float
    rank: int
    log_p: float
    amplitudes: AnyVector
    covariance: Float[np.ndarray, "k k"]
    log_bayes: float

    @property
    def testable(self) -> bool:
        """False when the base absorbs all of it."""
        return self.rank > 0


class Projector:
    """Removes from columns everything that the base parameters could absorb.

    `eliminated` counts the directions that are gone from residuals and columns already: one for every flux that
    was solved for. `free` is the number left for noise, `basis` an orthonormal basis of the part removed.
    """

    def __init__(self, jacobian: AnyMatrix, eliminated: int = 0) -> None:
        self._jacobian, self.basis = jacobian, np.linalg.qr(unit_columns(jacobian)[0])[0]
        self.free = jacobian.shape[0] - jacobian.shape[1] - eliminated

    def __call__(self, columns: np.ndarray) -> np.ndarray:
        """Project columns: to 10⁻¹⁵ of their length, where a part of 10⁻³ counts (`ABSORBED`, of the square)."""
        return columns - self.basis @ (self.basis.T @ columns)

    def taken_up(self, along: Float[np.ndarray, "q ..."]) -> Float[np.ndarray, "f ..."]:
        """Change R⁻¹QᵀC of the parameters, J = QR, at first order, by changes C of the rows; `along` is QᵀC."""
        unit, norm = unit_columns(self._jacobian)
        return (np.linalg.lstsq(self.basis.T @ unit, along, rcond=None)[0].T / norm).T


@dataclasses.dataclass(frozen=True)
class ScoreTable:
    """Scores of all candidates against one fit, and the global significance of the best of them.

    `noise_scale` is the scatter of the residuals behind base and candidates, in units of their errors; `trials` the
    effective number of independent candidates.
    """

    scores: tuple[Score, ...]
    noise_scale: float
    p_global: float
    trials: float

    def __getitem__(self, name: str) -> Score:
        return self._by_name[name]

    @functools.cached_property
    def _by_name(self) -> Mapping[str, Score]:
        return {score.name: score for score in self.scores}

    def corrected(self, score: Score) -> float:
        """p of a candidate corrected for the number of candidates tried."""
        return corrected_p(score.log_p, self.trials)

    def significant(self, alarm: float, most: int) -> tuple[str, ...]:
        """Names of up to `most` candidates with a corrected p below `alarm`, the smallest first."""
        ranked = sorted((s for s in self.scores if s.testable), key=lambda s: s.log_p)
        return tuple(score.name for score in ranked if self.corrected(score) < alarm)[:most]


def corrected_p(log_p: float, trials: float) -> float:
    """Šidák correction 1 − (1 − p)^n, from ln p."""
    p = np.exp(max(log_p, -700.0))
    return float(-np.expm1(trials * np.log1p(-min(p, 1.0 - 1e-16))))


def local_p(p: float, trials: float) -> float:
    """The local p of one of so many candidates that `corrected_p` makes `p`."""
    return float(-np.expm1(np.log1p(-p) / max(trials, 1)))


def effective_trials(smallest: AnyVector) -> float:
    """Effective number of independent candidates, from draws of ln of the smallest p."""
    count = int(TAIL * len(smallest))
    if not count:
        return 1.0
    t = -np.log1p(-np.exp(np.minimum(np.sort(smallest), -1e-12)))
    return max(1.0, count / float(t[:count].sum() + (len(t) - count) * t[count - 1]))


@functools.cache
def noncentrality(p: float, rank: int, power: float) -> float:
    """λ for which the statistic of a candidate, χ'²_rank(λ), undercuts a local `p` with probability `power`."""
    return float(special.chndtrinc(special.chdtri(rank, p), rank, 1.0 - power))


@dataclasses.dataclass(frozen=True)
class ScoreSpace:
    """The Gram matrix of all candidates behind the projection: all that the scores need of a design.

    `before` are the squares of the columns ahead of any projection; `free` the degrees of freedom of the residuals.
    Nothing here depends on the residuals, so that many data sets of the same design can be scored in turn.
    """

    names: tuple[str, ...]
    sizes: tuple[int, ...]
    widths: AnyVector
    before: AnyVector
    gram: Gram
    free: int

    @classmethod
    def projected(
        cls,
        projector: Projector,
        names: Sequence[str],
        widths: Sequence[AnyVector],
        columns: Sequence[AnyMatrix],
        *,
        scale: float = 1.0,
        exact: int | None = None,
    ) -> ScoreSpace:
        """The space of candidates, from the columns of each ahead of the projection, in units of `scale`.

        Rows beyond those of the columns, of priors, are 0. Of columns beyond the first `exact` that are multiples of
        one another in single precision, one is multiplied (`Repeated`). Products are taken in double precision, though
        columns may come in single: with products good to 10⁻⁷ the number of directions that all candidates span, and
        with it the noise behind them, hangs on rounding. The projected columns of all rows are never there at once.
        """
        sizes = [block.shape[1] for block in columns]
        stop = np.cumsum([0, *sizes])
        places = [slice(first, last) for first, last in itertools.pairwise(stop.tolist())]
        basis, count = projector.basis, int(stop[-1])
        before, along = np.empty(count), np.empty((basis.shape[1], count))
        for at, joined in joined_in_batches(columns):
            before[at] = np.einsum("dk,dk->k", joined, joined) / scale**2
            along[:, at] = basis[: len(joined)].T @ joined / scale
        first_of, factor = multiples(columns, count if exact is None else exact)
        distinct, number = np.unique(first_of, return_inverse=True)
        products, alone = np.zeros((len(distinct),) * 2), [np.zeros((size, size)) for size in sizes]
        for first in range(0, len(basis), limits.PRODUCT_ROWS):
            rows = slice(first, first + limits.PRODUCT_ROWS)
            remainder = along.T @ -basis[rows].T  # a column of all rows is contiguous
            for at, block, square in zip(places, columns, alone, strict=True):
                rows_of_block = block[rows].T
                remainder[at, : rows_of_block.shape[1]] += rows_of_block / scale
                square += remainder[at] @ remainder[at].T
            _add_upper(products, remainder[distinct].T if len(distinct) < count else remainder.T)
        _mirror(products)
        gram = Repeated(products, number, factor, alone, along)
        return cls(tuple(names), tuple(sizes), np.concatenate(widths), before, gram, projector.free)

    def places(self) -> dict[str, slice]:
        """Slices of the amplitudes, by candidate."""
        stop = np.cumsum(self.sizes)
        return {n: slice(int(b - k), int(b)) for n, k, b in zip(self.names, self.sizes, stop, strict=True)}

    def chosen(self, names: Sequence[str]) -> Int[np.ndarray, " _"]:
        """Positions of the amplitudes of some candidates."""
        places = self.places()
        return np.concatenate([np.arange(places[n].start, places[n].stop) for n in names])

    def subset(self, names: Sequence[str]) -> ScoreSpace:
        """The space of some of the candidates."""
        keep, sizes = self.chosen(names), dict(zip(self.names, self.sizes, strict=True))
        counts = tuple(sizes[name] for name in names)
        number = {name: k for k, name in enumerate(self.names)}
        gram = _of_candidates(self.gram, [number[name] for name in names], keep)
        return ScoreSpace(tuple(names), counts, self.widths[keep], self.before[keep], gram, self.free)

    @functools.cached_property
    def alive(self) -> Bool[np.ndarray, " _"]:
        """Amplitudes of which the base leaves something, and that reach `FAINTEST` σ at their prior width."""
        after = np.clip(self.gram.diagonal(), 0.0, None)
        share = np.where(self.before > 0, after / np.where(self.before > 0, self.before, 1.0), 0.0)
        return (share > ABSORBED) & (np.sqrt(after) * self.widths > FAINTEST)

    @functools.cached_property
    def whitened(self) -> Mapping[str, AnyMatrix]:
        """By candidate its `whitening`, with no part in it of amplitudes that are not alive."""
        return {name: whitening(self._of_alive(at)) for name, at in self.places().items()}

    def _of_alive(self, at: slice) -> AnyMatrix:
        """A block of the Gram matrix, 0 for amplitudes that are not alive."""
        alive = self.alive[at]
        return np.where(np.outer(alive, alive), self.gram[at, at], 0.0)

    def joining(
        self, names: Sequence[str], widths: AnyVector | None = None
    ) -> tuple[Int[np.ndarray, " k"], Float[np.ndarray, "k r"]]:
        """Amplitudes of some candidates that join the base, and W: their columns times W have WᵀCᵀCW = 1.

        With `widths`, one for each of their amplitudes, a ridge of their inverse squares is added to CᵀC.
        """
        place, alive = self.chosen(names), self.alive
        inverse = np.zeros(len(place)) if widths is None else np.asarray(widths, float) ** -2
        place, inverse = place[alive[place]], inverse[alive[place]]
        return place, whitening(self.gram[np.ix_(place, place)] + np.diag(inverse))

    def with_base(
        self, names: Sequence[str], widths: AnyVector | None = None
    ) -> tuple[ScoreSpace, Reduction]:
        """The space when some candidates have joined the base, and what takes (C̃ᵀr, r·r) there.

        With `widths`, one for each of their amplitudes, these are nuisances that are known that well beforehand.
        """
        place, w = self.joining(names, widths)
        along = self.gram[:, place] @ w

        def reduce(scores: AnyVector, square: float) -> tuple[AnyVector, float]:
            explained = w.T @ scores[place]
            return scores - along @ explained, square - float(explained @ explained)

        free = self.free - (w.shape[1] if widths is None else 0)
        return dataclasses.replace(self, gram=Less.of(self.gram, along, along), free=free), reduce

    def with_known(self, along: AnyMatrix) -> ScoreSpace:
        """The space when directions that were taken out of the columns are in them again; `along` are their parts."""
        return dataclasses.replace(self, gram=Less.of(self.gram, -along, along))

    def behind(self, projector: Projector, along: Float[np.ndarray, "q _"]) -> ScoreSpace:
        """The space of the same columns behind another projection; `along` is QᵀC with the basis Q of that one.

        Cᵀ(1 − QQᵀ)C = Cᵀ(1 − Q₀Q₀ᵀ)C + (Q₀ᵀC)ᵀ(Q₀ᵀC) − (QᵀC)ᵀ(QᵀC): the columns are not multiplied again.
        """
        first = self.gram.whole if isinstance(self.gram, Less) else self.gram
        given, taken = first.along.T, along.T
        gram = Less.of(first, np.hstack([taken, -given]), np.hstack([taken, given]))
        return dataclasses.replace(self, gram=gram, free=projector.free)

    # ------------------------------------------------------------------------------------------ scores

    @functools.cached_property
    def _root(self) -> _Root:
        return _Root(self.gram, self.alive)

    def independent(self) -> tuple[Int[np.ndarray, " r"], Float[np.ndarray, "r r"]]:
        """Columns that span those of all candidates, and the L of their Gram matrix G = L Lᵀ (lower triangle)."""
        return self._root.chosen, self._root.first

    def forget(self) -> None:
        """Give back the memory of the root of the Gram matrix, which nothing but `table` and `smallest_p` asks for."""
        vars(self).pop("_root", None)

    def table_after(self, earlier: ScoreTable, scores: AnyVector) -> ScoreTable:
        """The table of a space that is part of an earlier one, with the noise and the number of trials found there."""
        noise, trials = earlier.noise_scale, earlier.trials
        table, best = self._scored(scores, noise)
        return ScoreTable(table, noise, corrected_p(best, trials), trials)

    def table(self, scores: AnyVector, square: float, smallest: AnyVector | None = None) -> ScoreTable:
        """The table from s = C̃ᵀr and r·r, both behind the projection; `smallest` are draws of `smallest_p`."""
        noise_square = max(square - self._root.explained(scores), 0.0)
        freedom = self.free - self._root.rank
        if freedom < LEAST_REST * self.free:  # candidates that could explain anything do not show the noise
            noise_square, freedom = square, self.free
        noise = float(np.sqrt(noise_square / max(freedom, 1))) or 1.0
        table, best = self._scored(scores, noise)
        if smallest is None or not len(smallest):
            return ScoreTable(table, noise, 1.0, 1.0)
        trials, below = effective_trials(smallest), int(np.sum(smallest <= best))
        often = below >= TAIL * len(smallest)
        p = (1 + below) / (1 + len(smallest)) if often else corrected_p(best, trials)
        return ScoreTable(table, noise, p, trials)

    def _scored(self, scores: AnyVector, noise: float) -> tuple[tuple[Score, ...], float]:
        """The scores of all candidates, and ln of the smallest p of those that are testable (0: none is)."""
        table = list[Score]()
        for name, at in self.places().items():
            w, along = self.whitened[name], np.where(self.alive[at], scores[at], 0.0)
            z = w.T @ along
            statistic, rank = float(z @ z) / noise**2, w.shape[1]
            score = Score(
                name=name, statistic=statistic, rank=rank,
                log_p=float(_log_of_chi2(statistic, rank)) if rank else 0.0,
                amplitudes=-w @ z, covariance=w @ w.T * noise**2,
                log_bayes=log_bayes(self._of_alive(at) / noise**2, along / noise**2, self.widths[at]),
            )  # fmt: skip
            table.append(score)
        return tuple(table), min((score.log_p for score in table if score.testable), default=0.0)

    def smallest_p(self, rng: np.random.Generator, draws: int = NULL_DRAWS) -> AnyVector:
        """ln of the smallest p among all candidates, drawn under the base."""
        if not self._root.rank:
            return np.zeros(0)
        # Scores s = L n have covariance G for unit normals n. Seven digits are plenty for a count.
        root = self._root.whole
        return self.smallest_of(root @ rng.standard_normal((draws, root.shape[1]), dtype=np.float32).T)

    def smallest_of(self, drawn: Float[np.ndarray, "a d"]) -> AnyVector:
        """ln of the smallest p among all candidates in each draw of the scores C̃ᵀr, for noise of unit size."""
        largest: dict[int, AnyVector] = {}  # statistic of all candidates of a rank: p falls with it
        for name, at in self.places().items():
            w = self.whitened[name]
            if rank := w.shape[1]:
                along = w.T @ np.where(self.alive[at][:, None], drawn[at], 0.0)
                statistic = np.einsum("kd,kd->d", along, along)
                best = largest.setdefault(rank, statistic)
                np.maximum(best, statistic, out=best)
        # Millions of values, 10⁻⁴ is plenty.
        smallest = np.zeros(drawn.shape[1])
        for rank, statistic in largest.items():
            np.minimum(smallest, np.interp(statistic, *_survival_grid(rank)), out=smallest)
        return smallest


class Repeated:
    """The Gram matrix of columns of which some are multiples (`factor`) of a distinct one (`number`).

    `distinct` are the products of those; `blocks` are the products of the columns of each candidate, in float64;
    `along` is what was taken out of the columns, QᵀC. Indices are those of an array of numpy with two axes.
    """

    def __init__(
        self,
        distinct: AnyMatrix,
        number: Int[np.ndarray, " _"],
        factor: AnyVector,
        blocks: Sequence[AnyMatrix],
        along: Float[np.ndarray, "q _"],
    ) -> None:
        self.along = along
        self.distinct, self.number, self.factor, self._blocks = distinct, number, factor, list(blocks)
        sizes = np.array([len(block) for block in blocks], int)
        self._owner = np.repeat(np.arange(len(sizes)), sizes)
        self._in_blocks = np.concatenate([np.zeros(0), *map(np.ravel, blocks)])
        ends, squares = np.cumsum(sizes), np.cumsum(sizes**2)
        self._local = np.arange(len(number)) - (ends - sizes)[self._owner]
        self._row = (squares - sizes**2)[self._owner] + self._local * sizes[self._owner]
        starts = (ends - sizes).tolist()
        self._of_place = {pair: k for k, pair in enumerate(zip(starts, ends.tolist(), strict=True))}

    def of_candidates(self, numbers: Sequence[int], at: Int[np.ndarray, " _"]) -> Repeated:
        """The matrix of some candidates, whose columns are `at`; the products of distinct columns are not copied."""
        blocks = [self._blocks[number] for number in numbers]
        return Repeated(self.distinct, self.number[at], self.factor[at], blocks, self.along[:, at])

    def __getitem__(self, index: tuple[Any, Any]) -> Any:
        first, second = index
        if isinstance(first, slice) and isinstance(second, slice) and first == second:
            number = self._of_place.get((first.start, first.stop))
            if number is not None and first.step is None:
                return self._blocks[number]
        rows, columns = (np.arange(len(self.number))[at] for at in index)
        if rows.ndim == 1 and columns.ndim == 1:
            rows, columns = np.ix_(rows, columns)
        entries = self.distinct[self.number[rows], self.number[columns]]
        entries = entries * (self.factor[rows] * self.factor[columns])
        inside = self._owner[rows] == self._owner[columns]
        return np.where(
            inside, self._in_blocks[np.where(inside, self._row[rows] + self._local[columns], 0)], entries
        )

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.asarray(self[:, :], dtype)

    def diagonal(self) -> AnyVector:
        """Entries of the diagonal."""
        return self._in_blocks[self._row + self._local]


def multiples(columns: Sequence[AnyMatrix], exact: int) -> tuple[Int[np.ndarray, " _"], AnyVector]:
    """For every column the first of which it is a multiple, and the factor; the first `exact` are their own.

    Found by a few sums of their entries with random weights, and held against each other in single precision.
    """
    count = sum(block.shape[1] for block in columns)
    first_of, factor = np.arange(count), np.ones(count)
    if exact >= count:
        return first_of, factor
    weights = np.random.default_rng(0).standard_normal((max(map(len, columns)), SKETCHES))
    known: dict[bytes, tuple[int, AnyVector, float]] = {}
    for at, joined in joined_in_batches(columns):
        length = np.sqrt(np.einsum("dk,dk->k", joined, joined))
        sketch = weights[: len(joined)].T @ joined
        for k, j in enumerate(range(at.start, at.stop)):
            if j < exact:
                continue
            if not length[k]:
                first_of[j], factor[j] = 0, 0.0
                continue
            signed = length[k] * (np.sign(sketch[0, k]) or 1.0)
            unit = joined[:, k] / signed
            key = (np.round(sketch[:, k] / signed, 4) + 0.0).tobytes()
            if key not in known:
                known[key] = j, unit.astype(np.float32), signed
            elif np.linalg.norm(unit - known[key][1]) < SAME:
                first_of[j], factor[j] = known[key][0], signed / known[key][2]
    return first_of, factor


class Less:
    """A symmetric matrix P − L Rᵀ of which only the entries that are asked for are made: P is large, L, R are narrow.

    Indices are those of an array of numpy with two axes.
    """

    def __init__(self, whole: Gram, left: AnyMatrix, right: AnyMatrix) -> None:
        self.whole, self.left, self.right = whole, left, right

    @classmethod
    def of(cls, matrix: Gram, left: AnyMatrix, right: AnyMatrix) -> Less:
        """A matrix less another product L Rᵀ."""
        if not isinstance(matrix, Less):
            return cls(matrix, left, right)
        return cls(matrix.whole, np.hstack([matrix.left, left]), np.hstack([matrix.right, right]))

    def __getitem__(self, index: tuple[Any, ...]) -> Any:
        rows, columns = (np.ravel(at) if isinstance(at, np.ndarray) else at for at in index)
        return self.whole[index] - self.left[rows] @ self.right[columns].T

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.asarray(self[:, :], dtype)

    def diagonal(self) -> AnyVector:
        """Entries of the diagonal."""
        return self.whole.diagonal() - np.sum(self.left * self.right, axis=1)


def _of_candidates(gram: Gram, numbers: Sequence[int], at: Int[np.ndarray, " _"]) -> Gram:
    """The matrix of some candidates, whose columns are `at`."""
    if isinstance(gram, Less):
        return Less(_of_candidates(gram.whole, numbers, at), gram.left[at], gram.right[at])
    return gram.of_candidates(numbers, at) if isinstance(gram, Repeated) else gram[np.ix_(at, at)]


class Blocks:
    """A matrix that is 0 but for square blocks along its diagonal, which alone are asked for: `matrix[at, at]`."""

    def __init__(self, blocks: Sequence[AnyMatrix]) -> None:
        stop = np.cumsum([0, *map(len, blocks)]).tolist()
        self._blocks = blocks
        self._by_place = dict(zip(itertools.pairwise(stop), blocks, strict=True))

    def __getitem__(self, index: tuple[slice, slice]) -> AnyMatrix:
        rows, _ = index
        return self._by_place[rows.start, rows.stop]

    def diagonal(self) -> AnyVector:
        """Entries of the diagonal."""
        return np.concatenate([block.diagonal() for block in self._blocks])


class _Root:
    """L of a Gram matrix G = L Lᵀ (`whole`) of some `rank`: Cholesky's method, the column with most left coming next.

    `chosen` are the columns that span all others, in that order, and `first` is the L of these, in double precision.
    Rows and columns that are not `alive` are 0. Columns of which less than `ROOT_TOLERANCE` of their square is left
    behind those before them add nothing. Seven digits of L are plenty for draws.
    Source: Higham 1990, in Reliable Numerical Computation (Oxford), 161; LAPACK dpstrf.
    """

    def __init__(self, gram: Gram, alive: Bool[np.ndarray, " _"]) -> None:
        norm = np.sqrt(np.where(alive, np.clip(gram.diagonal(), 0.0, None), 0.0))
        every = np.flatnonzero(norm)
        self.whole, self.rank = np.zeros((len(norm), 0), np.float32), 0
        self.chosen, self.first = np.zeros(0, int), np.zeros((0, 0))
        if not len(every):
            return
        # Of columns that are multiples of one another the first: the others add nothing.
        whole = gram.whole if isinstance(gram, Less) else gram
        number = whole.number[every] if isinstance(whole, Repeated) else every
        _, first, of = np.unique(number, return_index=True, return_inverse=True)
        nonzero = every[first]
        scaled = np.empty((len(nonzero), len(nonzero)), order="F")  # as LAPACK has it: no copy is made
        for first in range(0, len(nonzero), limits.COLUMNS_TOGETHER):
            at = slice(first, first + limits.COLUMNS_TOGETHER)
            scaled[:, at] = gram[np.ix_(nonzero, nonzero[at])] / np.outer(norm[nonzero], norm[nonzero[at]])
        factor, pivots, self.rank, _ = linalg.lapack.dpstrf(  # pyright: ignore[reportAttributeAccessIssue]
            scaled, tol=ROOT_TOLERANCE, overwrite_a=True
        )
        order = nonzero[pivots - 1]
        self.chosen, beyond = order[: self.rank], order[self.rank :]
        self.first = np.triu(factor[: self.rank, : self.rank]).T * norm[self.chosen, None]
        root = np.empty((len(nonzero), self.rank), np.float32)
        root[pivots[: self.rank] - 1] = self.first
        for first in range(0, len(beyond), limits.COLUMNS_TOGETHER):
            at = slice(first, first + limits.COLUMNS_TOGETHER)
            part = factor[: self.rank, self.rank :][:, at].T * norm[beyond[at], None]
            root[pivots[self.rank :][at] - 1] = part
        del scaled, factor  # the largest matrix: what is left to be done needs a copy of the root
        self.whole = np.zeros((len(norm), self.rank), np.float32)
        scale = (
            whole.factor[every] / whole.factor[nonzero][of]
            if isinstance(whole, Repeated)
            else np.ones(len(of))
        )
        self.whole[every] = root[of]
        self.whole[every] *= scale[:, None].astype(np.float32)

    def explained(self, scores: AnyVector) -> float:
        """sᵀ G⁺ s of the scores s = Cᵀr: the square of the part of r in the span of the columns C."""
        if not self.rank:
            return 0.0
        solution = linalg.solve_triangular(self.first, scores[self.chosen], lower=True)
        return float(solution @ solution)


def log_bayes(gram: AnyMatrix, scores: AnyVector, widths: AnyVector, scales: AnyVector = SCALES) -> float:
    """ln B of a linear effect against the base: exact, that of several numbers averaged over scales t of their widths.

        B = ⟨exp(½ sᵀ (G + Λ⁻¹/t²)⁻¹ s) / det(1 + t² Λ^½ G Λ^½)^½⟩ over t, Λ^½ the prior widths

    A width says how large one number may be. Of many independent ones it would say as well how large they are together,
    which is unknown: all scales are as probable beforehand (mixtures of priors: Liang et al. 2008, JASA 103, 410).
    """
    value, vector = np.linalg.eigh(gram * np.outer(widths, widths))
    scales = scales if len(widths) > 1 else np.ones(1)
    log_factors = log_bayes_by_scale(value, vector.T @ (scores * widths), scales)
    return float(np.logaddexp.reduce(log_factors) - np.log(len(log_factors)))


def best_scale(gram: AnyMatrix, scores: AnyVector, widths: AnyVector) -> float:
    """The scale of the prior widths, of `SCALES`, with which a linear effect is most probable."""
    return float(max(SCALES, key=lambda t: log_bayes(gram, scores, widths, np.array([t]))))


def log_bayes_by_scale(
    value: Float[np.ndarray, "*n k"], s: Float[np.ndarray, "*n k"], scales: Float[np.ndarray, " t"]
) -> Float[np.ndarray, "*n t"]:
    """ln B at each scale t, of numbers whose Gram matrix is diagonal: `value` and scores `s` in prior widths."""
    t = scales[:, None] ** 2
    # None is below 0: rounding of columns that are nearly alike must not make it so.
    value = t * np.clip(value, 0.0, None)[..., None, :]
    return 0.5 * np.sum(t * s[..., None, :] ** 2 / (1.0 + value) - np.log1p(value), axis=-1)


def _log_of_chi2(statistic: Any, rank: int) -> Any:
    """ln of the χ² survival function."""
    with np.errstate(divide="ignore"):  # far out there is no number so small
        return np.log(special.chdtrc(rank, statistic))


@functools.cache
def _survival_grid(rank: int) -> tuple[np.ndarray, np.ndarray]:
    grid = np.linspace(0.0, rank + 12.0 * np.sqrt(2.0 * rank) + 60.0, 2000)
    return grid, _log_of_chi2(grid, rank)


def separations(space: ScoreSpace, scores: AnyVector, square: float) -> dict[str, float]:
    """Distance (σ) of each candidate from a change D of the residuals when it does its best to follow.

    `scores` are C̃ᵀD and `square` D·D, both behind the projection (Atkinson & Fedorov 1975, Biometrika 62, 57).
    """
    parts = {name: space.whitened[name].T @ scores[at] for name, at in space.places().items()}
    return {name: float(np.sqrt(max(square - float(z @ z), 0.0))) for name, z in parts.items()}


# ------------------------------------------------------------------------------------------- products of large matrices


def joined_in_batches(columns: Sequence[AnyMatrix]) -> Iterator[tuple[slice, AnyMatrix]]:
    """The columns of all blocks side by side in float64, so many at a time as take little memory, and their places."""
    stop = np.cumsum([0, *(block.shape[1] for block in columns)])
    rows = max(1, max(map(len, columns), default=1))
    group_of = stop[:-1] // max(1, min(limits.COLUMNS_TOGETHER, limits.RESPONSE_NUMBERS // rows))
    for _, group in itertools.groupby(range(len(columns)), lambda number: group_of[number]):
        numbers = list(group)
        joined = np.concatenate([columns[number].T for number in numbers], dtype=float).T
        yield slice(int(stop[numbers[0]]), int(stop[numbers[-1] + 1])), joined


def gram(columns: Float[np.ndarray, "d n"]) -> Float[np.ndarray, "n n"]:
    """CᵀC."""
    products = np.zeros((columns.shape[1], columns.shape[1]))
    _add_upper(products, columns)
    _mirror(products)
    return products


def _add_upper(products: AnyMatrix, columns: Float[np.ndarray, "d n"]) -> None:
    """Add CᵀC, piece by piece, to the pieces on and above the diagonal."""
    count = columns.shape[1]
    starts = [*range(0, count, limits.COLUMNS_TOGETHER), count]
    pieces = [slice(first, stop) for first, stop in itertools.pairwise(starts)]

    def product(pair: tuple[slice, slice]) -> None:
        first, second = pair
        products[first, second] += columns[:, first].T @ columns[:, second]

    with ThreadPoolExecutor(cores()) as pool:
        list(pool.map(product, itertools.combinations_with_replacement(pieces, 2)))


def _mirror(products: AnyMatrix) -> None:
    """Copy what is above the diagonal to below it."""
    for first in range(0, len(products), limits.COLUMNS_TOGETHER):
        at = slice(first, first + limits.COLUMNS_TOGETHER)
        square = products[at, at]
        products[at, at] = np.triu(square) + np.triu(square, 1).T
        products[at.stop :, at] = products[at, at.stop :].T
