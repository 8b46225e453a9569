"""When did a calibration cease to hold? Asked of the stars of many nights, without any calibration exposure.

    r_j = P (β c_j h(t_j)) + noise + errors of the calibration

A camera k that becomes brighter by β leaves P c β, c the counts of the model in that camera (`star_residuals`); flux
and (q, u) of the stars are eliminated. Of every exposure group (rows of one time) and camera the score g and their
matrix Q are kept, errors of the calibration eliminated. Then any history h over the groups is algebra:

step        h = 1 from one group on
drift       h grows evenly from one group to the last
once        h = 1 in a single group

    z = hᵀg / √(hᵀQh),   β = hᵀg / hᵀQh,   σ_β = (hᵀQh)^(−1/2), the Cramér–Rao bound (matched filter)

A gain that all cameras have in common is flux, and leaves no trace. Tested are the gains of cameras and of arms (all
cameras of one), their gradients over the field (of any direction φ: β cos φ x + β sin φ y, as χ² of two numbers), spots
(`places`) and the numbers of the optics (thicknesses, axes of plates, …). All tests share one correction: noise raises
an alarm in one of 1/`ALARM` watches. With z₀ the threshold, a change of size (z₀ + 2.33) σ_β is detected in 99 % of
cases. A detected change competes with all others of about the same history: those that describe the stars as well are
reported together, and a camera is named only if no other is among them. A number of the optics that would have to
change by more than `FARTHEST` widths of its prior explains nothing: its columns are first-order, and no optics moves
that far. If only such a number describes the stars, a change without a name is reported.
"""

from __future__ import annotations

import dataclasses
import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import special

from walop_jax.calibration.analysis_vectors import AnalysisVectors
from walop_jax.io.shapes import ColumnProducts
from walop_jax.likelihood.inverses import whitening
from walop_jax.science import star_columns as alarms
from walop_jax.science import star_residuals as residuals
from walop_jax.science import star_search as places
from walop_jax.science.star_columns import (
    ALARM,
    OF_SURVEYS,
    RIVAL,
    UNNAMED,
    History,
    PossibleChange,
    Question,
    WeightedColumns,
    profile,
    rivals_of,
    threshold,
)
from walop_jax.science.star_residuals import Residuals, Scale, StarResiduals, StarWeights
from walop_jax.science.star_search import Seen, StarSearch, Strongest, fitted, scored
from walop_jax.science.star_words import FoundChange, Watch

MOST_GROUPS = 150  # exposure groups that are separated; neighbours of more are joined
EDGES = (2.0, 8.0)  # sharpness of spots: a blurred one and one with an edge
_MOST_CHANGES = 4
_ROUNDS = 6
_SETTLED = 0.1  # standard errors


def grouped(time: Float[np.ndarray, " r"], most: int = MOST_GROUPS) -> tuple[OfGroups, Int[np.ndarray, " r"]]:
    """Times of exposure groups and the group of every row; neighbours of more than `most` groups are joined."""
    times, group = np.unique(time, return_inverse=True)
    if len(times) > most:
        step = -(-len(times) // most)
        group = group // step
        times = times[::step]
    return times, group.reshape(-1)


OfGroups = Float[np.ndarray, " g"]
ColumnScores = Float[np.ndarray, " c"]
Settled = tuple[FoundChange, Residuals]  # a change, and the residuals behind it


class Answers(NamedTuple):
    """Of every history and question, each alone: size, standard error (inf: not seen), and direction of a gradient."""

    size: Float[np.ndarray, "h c"]
    error: Float[np.ndarray, "h c"]
    angle: Float[np.ndarray, "h c"]


class Watching(StarSearch):
    """The histories at the head of this file, looked for in the residuals of stars.

    `stars.time` is an MJD, or the number of the exposure group; rows of equal time are one group. `vectors` are those
    of the calibration by which the residuals were made.
    """

    def __init__(self, stars: StarResiduals, vectors: AnalysisVectors) -> None:
        super().__init__(stars, vectors, OF_SURVEYS)
        columns, every = self.columns, range(len(self.cameras))
        # Without the last arm: all arms together are flux, so that its gain is that of the others, reversed.
        units = [*((k,) for k in every), *columns.arms[: len(vectors.instrument.cameras.arms) - 1]]
        self.of_cameras = [columns.of_one("gain", unit) for unit in units]
        self.members = np.array([[float(k in unit) for unit in units] for k in every])
        gradients = []
        for question, unit in zip(self.of_cameras, units, strict=True):
            along, across = ({columns.number(kind, k): 1.0 for k in unit} for kind in ("x", "y"))
            gradients.append(question._replace(kind="gradient", along=along, across=across))
        self.questions: list[Question] = [*self.of_cameras, *gradients, *columns.optics]
        self.time, self.group = grouped(stars.time)
        groups = len(self.time)
        self.histories = [History("step", g) for g in range(groups)]
        self.histories += [History("drift", g) for g in range(groups - 2)]
        self.histories += [History("once", g) for g in range(1, groups - 1)]
        self.shapes = np.stack([h.over(self.time) for h in self.histories], axis=1)
        self.spoilt = np.zeros(len(stars.photon), bool)  # by spots that were found
        self.tests = len(self.histories) * sum(question.number for question in self.questions)
        # Half of the false alarms are left to spots, which are so many that they would raise the threshold of the rest.
        self.alarm = threshold(0.5 * ALARM / self.tests)
        # Stars that share a noise scale: those of one exposure group; and all stars that are in several groups.
        low, high = (op.reduceat(self.group, stars.first) for op in (np.minimum, np.maximum))
        self.pool = np.where(low == high, low, groups)

    # --------------------------------------------------------------------------------------------- noise

    def weights(self, residual: Residuals) -> tuple[StarWeights, Scale]:
        """Weights of the stars, and the scale of all of them.

        A change that stars of a night have in common is no noise: where χ² is not what N_ERR says, weights come from
        the scatter about the gains that fit each group best, if there are stars enough to know it.
        """
        weights, scale, off = self._scaled(residual, np.zeros(len(self.time)))
        # The gains, then their gradients as well if the scatter about the gains is not that of noise.
        for kinds in (1, 3):
            for _ in range(residuals.ABOUT_GAINS if off else 0):
                remaining, fitted = self._behind_gains(residual, weights, kinds * len(self.cameras))
                rescaled = self._scaled(remaining, fitted)
                if rescaled[1].worth < residuals.FEW:
                    return weights, scale
                weights, _, off = rescaled
        return weights, scale

    def _scaled(self, residual: Residuals, fitted: OfGroups) -> tuple[StarWeights, Scale, bool]:
        """Weights, the scale of all stars, and whether any scale differs from that of N_ERR.

        `fitted` is how many numbers were fitted in each group before.
        """
        chi2 = self.stars.chi2(residual) / self.variance
        dof, alarm = self.stars.dof.astype(float), ALARM / (len(self.time) + 1)
        least = 1.0 if np.median(self.variance) > residuals.CROWDED else 0.0
        overall = residuals.beside_fitted(residuals.noise_scale(chi2, dof), dof, float(fitted.sum()))
        off = residuals.is_off(overall, alarm)
        common = max(overall.value, least) if off else 1.0
        if fitted.any():  # gains are fitted only if N_ERR is in doubt
            common = max(overall.value, 1.0) * (residuals.of_few(overall, self.alarm) if off else 1.0)
        weight, share, several = np.where(overall.kept, 1.0 / common, 0.0), overall.share.copy(), off
        for pool in np.unique(self.pool):
            members = np.flatnonzero(self.pool == pool)
            if len(members) < residuals.FEW:
                continue
            parameters = fitted[pool] if pool < len(fitted) else fitted.sum()
            local = residuals.beside_fitted(
                residuals.noise_scale(chi2[members], dof[members]), dof[members], float(parameters)
            )
            mine, several = residuals.is_off(local, alarm), several or residuals.is_off(local, alarm)
            larger = residuals.of_few(local, self.alarm) if fitted.any() else 1.0
            variance = max(local.value, least) * larger if mine else common
            weight[members], share[members] = np.where(local.kept, 1.0 / variance, 0.0), local.share
        return StarWeights(weight / self.variance, share), overall, several

    def _behind_gains(
        self, residual: Residuals, weights: StarWeights, count: int
    ) -> tuple[Residuals, OfGroups]:
        """Residuals less the best fit of the first `count` columns in each group; the numbers fitted in each."""
        groups = len(self.time)
        blocks, slopes = self._by_group(*self.scan(residual, weights))
        size, fitted = np.zeros((groups, count)), np.zeros(groups)
        for g in range(groups):
            root = whitening(blocks[g, :count, g, :count], residuals.SINGULAR)
            size[g] = root @ (root.T @ slopes[g, :count])
            fitted[g] = root.shape[1]

        def change(part: StarResiduals, rows: slice) -> Residuals:
            return np.einsum("rkc,rc->rk", self.columns.of_cameras(part)[..., :count], size[self.group[rows]])

        return self.stars.behind(residual, change), fitted

    # -------------------------------------------------------------------------------------------- columns

    def scan(self, residual: Residuals, weights: StarWeights) -> tuple[ColumnProducts, ColumnScores]:
        """Q and g of `columns` in all groups (group, column), errors of the calibration eliminated."""
        stars, count, groups = self.stars, self.columns.count + len(self.columns.optics), len(self.time)
        nuisances = self.root.shape[1] + 2
        gains = np.zeros((groups * count, groups * count))
        cross, nuisance = np.zeros((groups * count, nuisances)), np.eye(nuisances)
        score, pull = np.zeros(groups * count), np.zeros(nuisances)
        diagonal = np.zeros((groups, count))
        for numbers, rows, subset in stars.blocks():
            group, w, k = self.group[rows], weights.inverse[numbers], weights.share[numbers]
            values = np.concatenate([self.columns.all_of(subset), self.errors(subset)], axis=-1)
            np.add.at(diagonal, group, np.sum(values[..., :count] ** 2, axis=1) * (w * k)[subset.star, None])
            free, along = subset.projected(values)
            heavy = np.sqrt(w * k)[subset.star]
            free = free * heavy[:, None]
            shapes, nuisance_columns = free[:count], free[count:].reshape(nuisances, -1)
            products = np.einsum("arc,brc->rab", shapes, shapes, optimize=True)
            blocks = gains.reshape(groups, count, groups, count)
            np.add.at(blocks, (group, slice(None), group), products)  # pyright: ignore[reportArgumentType]
            mixed = np.einsum("arc,nrc->ran", shapes, free[count:], optimize=True)
            np.add.at(cross.reshape(groups, count, nuisances), group, mixed)
            nuisance += nuisance_columns @ nuisance_columns.T
            # The part taken by q and u of the stars: sums over the rows of a star in each group.
            half = np.linalg.cholesky(subset.photon).swapaxes(1, 2)
            row = half[subset.star] @ np.einsum("rik,ark->ria", subset.tangent, shapes, optimize=True)
            pair, where = np.unique(subset.star * groups + group, return_inverse=True)
            sums = np.zeros((len(pair), *row.shape[1:]))
            np.add.at(sums, where.reshape(-1), row)
            of_star, of_group = pair // groups, pair % groups
            errors = (half @ along[..., count:]) * np.sqrt(w * k)[:, None, None]
            flat = errors.reshape(-1, nuisances)
            nuisance -= flat.T @ flat
            projected = np.einsum("pia,pin->pan", sums, errors[of_star], optimize=True)
            np.subtract.at(cross.reshape(groups, count, nuisances), of_group, projected)
            self._subtract(blocks, sums, of_star, of_group)
            normal = residual[rows] * w[subset.star, None]
            slopes = np.einsum("rkc,rk->rc", values, normal)
            np.add.at(score.reshape(groups, count), group, slopes[:, :count])
            pull += slopes[:, count:].sum(axis=0)
        rounding = np.diag(gains) <= residuals.ROUNDING * diagonal.ravel()
        gains[rounding], gains[:, rounding], cross[rounding], score[rounding] = 0.0, 0.0, 0.0, 0.0
        full = np.block([[gains, cross], [cross.T, nuisance]])
        return residuals.eliminated(full, np.concatenate([score, pull]), groups * count)

    @staticmethod
    def _subtract(
        blocks: Float[np.ndarray, "g k g k"],
        sums: Float[np.ndarray, "p 2 k"],
        of_star: Int[np.ndarray, " p"],
        of_group: Int[np.ndarray, " p"],
    ) -> None:
        """Subtract the part taken by the stars, between all groups that a star is in."""
        pairs = np.bincount(of_star)
        alone = pairs[of_star] == 1
        products = np.einsum("pia,pib->pab", sums[alone], sums[alone])
        np.subtract.at(blocks, (of_group[alone], slice(None), of_group[alone]), products)  # pyright: ignore[reportArgumentType]
        groups, count = blocks.shape[:2]
        several = np.flatnonzero(~alone)
        numbers, place = np.unique(of_star[several], return_inverse=True)
        step = max(1, 2_000_000 // (2 * groups * count))
        for start in range(0, len(numbers), step):
            chosen = (place >= start) & (place < start + step)
            dense = np.zeros((min(step, len(numbers) - start), 2, groups, count))
            dense[place[chosen] - start, :, of_group[several[chosen]]] = sums[several[chosen]]
            flat = dense.reshape(-1, groups * count)
            blocks -= (flat.T @ flat).reshape(blocks.shape)

    def _by_group(
        self, matrix: ColumnProducts, score: ColumnScores
    ) -> tuple[Float[np.ndarray, "g k g k"], Float[np.ndarray, "g k"]]:
        """Q and g of `scan` by group and change."""
        slopes = score.reshape(len(self.time), -1)
        return matrix.reshape(*slopes.shape, *slopes.shape), slopes

    def suspects(self, found: Answers) -> list[PossibleChange]:
        """Changes with the best history of each kind or a neighbour of it: strongest first, impossible ones last."""
        strength = np.max(np.abs(found.size / found.error), axis=1)
        compared: list[int] = []
        for kind in ("step", "drift", "once"):
            if mine := [n for n, h in enumerate(self.histories) if h.kind == kind]:
                top = max(mine, key=lambda n: strength[n])
                compared += [n for n in (top - 1, top, top + 1) if n in mine]
        listed = []
        for n, (k, question) in itertools.product(compared, enumerate(self.questions)):
            entry = question.change(float(found.size[n, k]), float(found.error[n, k]))
            place = () if question.across is None else (float(found.angle[n, k]),)
            if np.isfinite(entry.error):
                listed.append(entry._replace(history=self.histories[n], place=place))
        return sorted(listed, key=lambda entry: (not entry.possible, -abs(entry.sigma)))

    def without(self, residual: Residuals, change: PossibleChange, size: float) -> Residuals:
        """The residuals less a change of this size."""
        return self.stars.behind(residual, lambda part, rows: self.column(part, rows, change) * size)

    def column(self, part: StarResiduals, rows: slice, change: PossibleChange) -> Residuals:
        """The column of a change in some stars, of which these are the rows, over its history."""
        return self.columns.of(part, change) * change.history.over(self.time)[self.group[rows], None]

    # --------------------------------------------------------------------------------------------- asking

    def watch(self) -> Watch:
        """Changes, the strongest first, until nothing is left."""
        residual, changes = self.stars.residual, []
        weights, scale = self.weights(residual)
        matrix, score = self.scan(residual, weights)
        while len(changes) < _MOST_CHANGES:
            answers = self.answers(matrix, score)
            ways = [self.spotted(residual, weights)]
            if np.abs(answers.size / answers.error).max() > self.alarm:
                ways.append(self.settled(residual, answers))
            if (chosen := self._likeliest([way for way in ways if way is not None])) is None:
                break
            change, residual = chosen
            changes.append(change)
            if change.best.kind == "spot":
                x, y = (values[self.stars.first] for values in (self.stars.x, self.stars.y))
                self.spoilt |= profile(x, y, change.best.place) > 0
            weights, scale = self.weights(residual)
            matrix, score = self.scan(residual, weights)
        noise, odd = self._scatter(residual, weights, scale)
        return dataclasses.replace(self.told(changes, matrix, score, noise), odd=odd)

    def _scatter(
        self, residual: Residuals, weights: StarWeights, scale: Scale
    ) -> tuple[float, tuple[str, ...]]:
        """χ² per degree of freedom of all stars, 1 where N_ERR says so; a remark on stars that lie off by themselves.

        Nothing is said that errors of the calibration explain.
        """
        dof = self.stars.dof.astype(float)
        largest = special.chdtri(np.maximum(dof, 1e-12), ALARM / len(dof))
        left_out, off = (
            (weights.inverse == 0) & (dof > 0),
            residuals.is_off(scale, ALARM) and not self.crowded,
        )
        chi2 = self.stars.chi2(residual) / self.variance
        if off or np.any(left_out & (chi2 > largest * max(scale.value, 1.0))):
            chi2 = self.stars.chi2(self._explained(residual, scale)) / self.variance
            off = off and residuals.is_off(residuals.noise_scale(chi2, dof), ALARM)
        odd = left_out & (chi2 > largest * max(scale.value, 1.0))
        noise = scale.value if off else 1.0
        if not odd.any():
            return noise, ()
        worst = self.stars.first[np.argmax(np.where(odd, chi2, 0.0))]
        remark = (
            f"{odd.sum()} of {len(dof)} stars disagree with the calibration each by itself and were left out, the "
            f"worst at X {self.stars.x[worst]:+.3f}°, Y {self.stars.y[worst]:+.3f}°: blends, cosmic rays, bad pixels?"
        )
        return noise, (remark,)

    def _explained(self, residual: Residuals, scale: Scale) -> Residuals:
        """Residuals behind the errors of the calibration that explain them best, if these are as chance makes them."""
        stated = StarWeights(scale.kept / self.variance, scale.share)
        matrix, score = residuals.normal_matrix(
            self.stars, residual, lambda *part: self.errors(part[0]), stated
        )
        root = whitening(matrix + np.eye(len(score)), residuals.SINGULAR)
        errors = root @ (root.T @ score)
        if not places.is_near(errors[:-2]):
            return residual
        return self.stars.behind(residual, lambda *part: self.errors(part[0]) @ errors)

    def _likeliest(self, ways: list[Settled]) -> Settled | None:
        """The change that leaves the least χ², outliers counted with the χ² at which they are cut.

        Another one that leaves about as little is joined to it as alike.
        """
        if len(ways) < 2:
            return ways[0] if ways else None
        dof = self.stars.dof.astype(float)
        costs = [self.stars.chi2(remaining) / self.variance for _, remaining in ways]
        scale = max(1.0, min(residuals.noise_scale(chi2, dof).value for chi2 in costs))
        cut = special.chdtri(np.maximum(dof, 1e-12), residuals.TRIMMED)
        cost = [float(np.minimum(chi2 / scale, cut)[dof > 0].sum()) for chi2 in costs]
        near = abs(cost[1] - cost[0]) < RIVAL and ways[1][0].best.kind != UNNAMED
        # If both are as good the simpler one is the answer: it stands behind the spot, which is the first of `ways`.
        (change, remaining), (alternative, _) = ways[::-1] if near else (ways[n] for n in np.argsort(cost))
        if near:
            change = dataclasses.replace(change, alike=change.alike + alternative.alike)
        return change, remaining

    def answers(self, matrix: ColumnProducts, score: ColumnScores) -> Answers:
        """Size and error of every question with every history, each tested by itself."""
        (blocks, slopes), shapes = self._by_group(matrix, score), self.shapes
        size = shapes.shape[1], len(self.questions)
        answers = Answers(np.zeros(size), np.full(size, np.inf), np.zeros(size))

        def information(one: WeightedColumns, across: WeightedColumns) -> Float[np.ndarray, " h"]:
            terms = [v * w * blocks[:, a, :, b] for a, v in one.items() for b, w in across.items()]
            return np.einsum("gh,gf,fh->h", shapes, np.sum(terms, axis=0), shapes, optimize=True)

        def slope(of: WeightedColumns) -> Float[np.ndarray, " h"]:
            return shapes.T @ np.sum([weight * slopes[:, a] for a, weight in of.items()], axis=0)

        trace = np.einsum("gkgk->k", blocks)
        for k, question in enumerate(self.questions):
            info, pull = information(question.along, question.along), slope(question.along)
            if question.across is not None:
                across, mixed = (information(question.across, of) for of in (question.across, question.along))
                turn = slope(question.across)
                angle = np.arctan2(info * turn - mixed * pull, across * pull - mixed * turn)
                cosine, sine = np.cos(angle), np.sin(angle)
                info = cosine**2 * info + 2.0 * cosine * sine * mixed + sine**2 * across
                pull = cosine * pull + sine * turn
                answers.angle[:, k] = np.rad2deg(angle)
            # Beyond rounding: `scan` has zeros where stars see nothing of a column.
            informed = info > residuals.ROUNDING * sum(
                trace[a] for a in (*question.along, *(question.across or {}))
            )
            answers.size[informed, k] = pull[informed] / info[informed]
            answers.error[informed, k] = info[informed] ** -0.5
        return answers

    def settled(self, residual: Residuals, answers: Answers) -> Settled:
        """A change with its rivals, and the residuals behind it.

        Compared are the best history of each kind (step, drift, once) and its neighbours, for every question. The fit
        is repeated, each time with the stars that it has kept.
        """
        best: PossibleChange | None = None
        total, remaining, alike = 0.0, residual, []
        for _ in range(_ROUNDS):
            if best is not None:
                weights, _ = self.weights(remaining)
                answers = self.answers(*self.scan(self.without(remaining, best, -total), weights))
            ranked = self.suspects(answers)
            if abs(ranked[0].sigma) < self.alarm or not ranked[0].possible:
                ranked.sort(key=lambda entry: -abs(entry.sigma))
            before, best = best, ranked[0]
            alike = rivals_of(best, ranked)
            alike = [entry for entry in alike if entry.possible]
            moved = abs(best.size - total) / best.error
            total = best.size
            remaining = self.without(residual, best, total)
            same = before is not None and (*before.thing, before.history) == (*best.thing, best.history)
            if same and moved < _SETTLED:
                break
        assert best is not None
        if not best.possible:
            best = best._replace(name=UNNAMED, unit="", kind=UNNAMED)
            alike = [best]
        return self._dated(best, alike), remaining

    def _dated(self, best: PossibleChange, alike: list[PossibleChange]) -> FoundChange:
        began = self.time[[entry.history.start for entry in alike]]
        when = float(self.time[best.history.start]), (float(began.min()), float(began.max()))
        return FoundChange(best, tuple(alike), *when, off=self.off([best, *alike]))

    def spotted(self, residual: Residuals, weights: StarWeights) -> Settled | None:
        """A step in a spot of the field, and the residuals behind it; None where noise makes as much."""
        # Stars that were left out as outliers may be those of the spot: here they have the weight of all others.
        common = np.zeros(len(self.time) + 1)
        np.maximum.at(common, self.pool, weights.inverse * self.variance)
        inverse = common[self.pool] / self.variance
        usable = (inverse > 0) & ~self.spoilt
        if usable.sum() < residuals.FEW:
            return None
        variance = 1.0 / np.where(usable, inverse, 1.0)
        found: list[tuple[Strongest, int, Seen]] = []  # the spot in all rows, then the strongest one
        trials = 0
        later = places.seen_from(self.stars, self.group, self.members, residual, variance)
        for start, seen in enumerate(every.of(usable) for every in later):
            here = places.strongest(seen, self.columns.growth.edge)
            trials += here.trials
            if start == 0 or abs(here.sigma) > abs(found[-1][0].sigma):
                found = [*found[:1], (here, start, seen)]
        (spot, start, seen), alarm = found[-1], threshold(0.5 * ALARM / max(trials, 1))
        if abs(spot.sigma) < alarm:
            return None
        near = seen.near(spot.place)
        x, y, size = spot.place
        starts = [(x, y, share * size, edge) for share in (1.0, 2.0) for edge in EDGES]
        ways = [fitted(near, spot.camera, start) for start in starts]
        gains = [places.share_of(near, spot.camera, profile(near.x, near.y, way)) for way in ways]
        (size, *_), place = max(zip(gains, ways, strict=True), key=lambda way: way[0][2])
        name, since = self.of_cameras[spot.camera].name, History("step", start)
        ranked = [PossibleChange(name, True, since, kind="spot", place=place)]
        of_spot = np.zeros(len(usable), bool)
        for _, _, seen in found:
            of_spot[usable] |= places.described(seen, spot.camera, place, size)
        weights = weights._replace(inverse=np.where(of_spot, inverse, weights.inverse))
        for _ in range(2):  # which cameras, and from when on
            best = ranked[0]
            questions = [best._replace(name=question.name) for question in self.of_cameras]
            questions += [best._replace(history=History("step", g)) for g in range(len(self.time))]
            if not (ranked := self._sized(residual, questions, weights)):
                return None
        best = ranked[0]
        if abs(best.sigma) < alarm or not best.possible:
            return None
        alike = rivals_of(best, ranked)
        return self._dated(best, alike), self.without(residual, best, best.size)

    def _sized(
        self, residual: Residuals, asked: list[PossibleChange], weights: StarWeights
    ) -> list[PossibleChange]:
        """Changes with size and error, each alone, the most significant first; without those that no star sees."""

        def columns(part: StarResiduals, rows: slice) -> Float[np.ndarray, "r k c"]:
            steps = [self.column(part, rows, entry) for entry in asked]
            return np.concatenate([np.stack(steps, axis=-1), self.errors(part)], axis=-1)

        matrix, score = residuals.normal_matrix(self.stars, residual, columns, weights)
        prior = (np.arange(len(matrix)) >= len(asked)).astype(float)
        sized = scored(asked, matrix + np.diag(prior), score)
        return sorted(
            (entry for entry in sized if np.isfinite(entry.error)), key=lambda entry: -abs(entry.sigma)
        )

    def told(
        self, changes: list[FoundChange], matrix: ColumnProducts, score: ColumnScores, noise: float
    ) -> Watch:
        """The record of the watch; the gain of a camera is what the changes leave, plus the change that it may have."""
        groups, cameras = len(self.time), len(self.cameras)
        blocks, slopes = self._by_group(matrix, score)
        gain, error, smallest = (np.full((groups, cameras), np.nan) for _ in range(3))
        steps = np.tril(np.ones((groups, groups)))  # group, start
        for k in range(cameras):
            variances = np.diag(blocks[:, k, :, k])
            gain[:, k] = slopes[:, k] / np.where(variances > 0, variances, np.inf)
            for change in changes:
                of_gain = (entry for entry in change.alike if entry.kind in ("gain", "arm"))
                may = [entry for entry in of_gain if self.cameras[k] in entry.members]
                mine = min(may, key=lambda entry: len(entry.name), default=None)
                gain[:, k] += 0.0 if mine is None else mine.size * mine.history.over(self.time)
            error[:, k] = np.where(variances > 0, variances, np.nan) ** -0.5
            information = np.einsum("gh,gf,fh->h", steps, blocks[:, k, :, k], steps, optimize=True)
            measured = np.where(information > 0, information, np.nan)
            smallest[:, k] = (self.alarm + alarms.MOST_LIKELY) * measured**-0.5
        chi2, dof = self.stars.chi2(self.stars.residual), self.stars.dof.astype(float)
        pairs, ratio = np.unique(self.stars.star * groups + self.group), np.full(groups, np.nan)
        for g in np.unique(self.pool[self.pool < groups]):
            ratio[g] = residuals.noise_scale(chi2[self.pool == g], dof[self.pool == g]).value
        return Watch(
            cameras=self.cameras,
            time=self.time,
            stars=np.bincount(pairs % groups, minlength=groups),
            chi2=ratio,
            gain=gain,
            error=error,
            smallest=smallest,
            changes=tuple(changes),
            noise=noise,
            tests=self.tests,
            alarm=self.alarm,
            photons=self.photons,
        )
