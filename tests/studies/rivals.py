"""Rivals of the search for what is missing, on the same residuals: the scenes of `benchmark/`, judged by its judge.

    pip install scikit-learn skglm pyoperon
    python tests/studies/benchmark/generate.py FOLDER
    python tests/studies/rivals.py FOLDER [METHOD ...] [--scenes 20]       (half an hour for all but the last two)
    python tests/studies/benchmark/judge.py FOLDER FOLDER/answers/*.jsonl

Every method sees residuals behind the base model, where the rows were measured, and what the base took up.

matched      the truth is known: the most powerful test that there is, and the error that noise alone leaves
search       what `diagnose` does, by linear steps; nothing is held out to confirm a sentence
trees, logistic   classifier two-sample test: rows of residuals against as many that were drawn, area under the curve of
             classifiers trained on the other half; gradient-boosted trees, and a linear classifier that is given
             residuals × polynomials × harmonics (Lopez-Paz & Oquab 2017)
lasso, mcp   group lasso and group MCP over the columns of all effects and sentences, the sparsest within a standard
             error of the best in 5-fold cross-validation; groups orthonormalised (Simon & Tibshirani 2012), MCP by
             local linear approximation (Zou & Li 2008)
stability    group lasso on 20 halves of the rows in complementary pairs (Shah & Samworth 2013); votes for candidates
             whose columns hardly differ are counted together
polynomials  polynomials of the field × harmonics of the polariser angle, camera by camera, chosen by BIC
process, formula   a Gaussian process in field and angle, camera by camera; symbolic regression on its mean, a minute

What has a threshold or a number to be set has it from draws of noise (`Bench.noise`), never from the scenes. Group
methods tell nothing while no candidate stands out of noise as much as it does in one draw of a hundred; beside each
name they tell all candidates that the data cannot tell from it (3 σ), as the search does.
"""

from __future__ import annotations

import json
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), *(str(ROOT / "tests" / p) for p in (".", "diagnosis", "studies/benchmark"))]

from generate import STEP  # noqa: E402
from judge import opened  # noqa: E402
from study_options import options_of  # noqa: E402

from walop_jax.likelihood.inverses import whitening  # noqa: E402

Answer = dict[str, Any]
FALSE_ALARMS, SEPARATION = 0.01, 3.0
SCREENED = 100  # groups with the largest scores that take part in a path
LAMBDAS, FINEST, LEAST = 14, 0.03, 1.0  # a path: from the first group down to this share of it, and to noise
FOLDS, PAIRS, QUICKEST, VOTES, ALIKE = 5, 10, 5, 0.75, 0.95
MCP = 3.0  # γ


class Bench:
    """A folder of scenes; `rows` are those that were fitted, priors last."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.at = dict(np.load(folder / "context.npz"))
        self.said = dict(np.load(folder / "grammar.npz"))
        with np.load(folder / "scenes.npz") as scenes:
            self.residuals, self.without = scenes["residuals"], scenes["without"]
        self.data = self.at["point"] >= 0
        self.cameras = self.at["flux_direction"].shape[1]

    def residual(self, scene: int) -> np.ndarray:
        return self.residuals[scene] * STEP

    def without_flux(self, columns: np.ndarray, direction: str = "flux_direction") -> np.ndarray:
        """Columns of data rows without what the flux of each exposure at a point takes up."""
        cells = columns.reshape(-1, self.cameras, *columns.shape[1:])
        m = self.at[direction].reshape(-1, self.cameras, *(1 for _ in columns.shape[1:]))
        return (cells - m * np.sum(m * cells, axis=1, keepdims=True)).reshape(columns.shape)

    def noise(self, rng: np.random.Generator) -> np.ndarray:
        """Residuals of a set in which nothing is missing."""
        known = self.at["prior_is_known"]
        data = self.without_flux(rng.standard_normal(int(self.data.sum())))
        rows = np.concatenate([data, rng.standard_normal(len(known)) * known])
        return rows - self.at["base"] @ (self.at["base"].T @ rows)

    def columns_of(self, names: list[str]) -> tuple[np.ndarray, np.ndarray]:
        """Which columns belong to candidates, and their widths."""
        group = [np.flatnonzero(self.said["names"] == name)[0] for name in names]
        at = np.flatnonzero(np.isin(self.said["group"], group) & self.said["alive"])
        return at, self.said["widths"][at]

    def expected(self, r: np.ndarray, names: list[str]) -> np.ndarray:
        """The signal of candidates in the rows kept back, fitted together with the priors of their amplitudes."""
        at, widths = self.columns_of(names)
        if not len(at):
            return np.zeros(len(self.at["point_kept_back"]))
        c = self.said["columns"][:, at].astype(float) * widths
        fitted = np.linalg.solve(c.T @ c + np.eye(len(at)), c.T @ r) * widths
        return self.said["columns_kept_back"][:, at] @ fitted


# ------------------------------------------------------------------------------------------ the limit, and ours


def matched(bench: Bench) -> Callable[[int], Answer]:
    """The filter that knows the truth; of an empty scene it is that of one of the others, in turn."""
    _, beyond, _ = opened(bench.folder)
    with np.load(bench.folder / "truth.npz") as truth:
        signals = truth["signature"].astype(float)
    with_signal = np.flatnonzero(np.any(signals, axis=1))

    def answer(scene: int) -> Answer:
        of = scene if scene in with_signal else with_signal[scene % len(with_signal)]
        signal = signals[of]
        power = signal @ signal
        along = float(signal @ bench.residual(scene) / power)
        return {"score": along * np.sqrt(power), "told": [], "kept_back": along * beyond[of]}

    return answer


def search(bench: Bench) -> Callable[[int], Answer]:
    """Ours."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from blind import Scene
    from generate import Layout

    blind = Layout(1).blind

    def answer(scene: int) -> Answer:
        r = bench.residual(scene)
        evidence = blind.evidence
        along = blind._whitening.T @ evidence.design.products(evidence.columns, evidence.design.projector(r))
        seen = Scene("", (), 0.0, along, float(r @ r - along @ along), removed=(str(bench.without[scene]),))
        start = blind.start(seen)
        verdict, left = blind.judged(seen, start)
        names = [
            probe if effect == "described" else effect
            for effect, probe in zip(verdict.named, verdict.added, strict=True)
        ]
        told = [[name, *sorted(others)] for name, others in zip(names, verdict.classes, strict=True)]
        patterns = [name for name, _ in left.patterns_needed] if left.alarm else []
        return {
            "score": -max(min(s.log_p for s in start.table.scores if s.testable), -1e4),
            "told": told,
            "complete": verdict.kind == "effect_found",
            "kept_back": bench.expected(r, [*verdict.added, *patterns]),
        }

    return answer


# ------------------------------------------------------------------------- A: can a classifier tell it from noise?


def _classified(bench: Bench, features: Callable[[np.ndarray], np.ndarray], make: Callable[[], Any]) -> Any:
    from sklearn.metrics import roc_auc_score

    rng = np.random.default_rng(11)
    cells = int(bench.data.sum()) // bench.cameras
    half = rng.permutation(cells) % 2

    def answer(scene: int) -> Answer:
        drawn = [bench.residual(scene), bench.noise(rng), bench.noise(rng)]
        x = np.concatenate([features(r[bench.data].reshape(cells, -1)) for r in drawn])
        real, fold = np.arange(len(x)) < cells, np.tile(half, len(drawn))
        area = []
        for k in (0, 1):
            model = make().fit(x[fold == k], real[fold == k])
            area.append(roc_auc_score(real[fold != k], model.predict_proba(x[fold != k])[:, 1]))
        return {"score": float(np.mean(area)), "told": []}

    return answer


def _where(bench: Bench) -> dict[str, np.ndarray]:
    """Field, angle and kind of every exposure at a point."""
    first = np.flatnonzero(bench.data)[:: bench.cameras]
    point, exposure = bench.at["point"][first], bench.at["exposure"][first]
    inside = bench.at["clp_in"][exposure]
    angle = np.deg2rad(np.where(inside, bench.at["clp_angle"][exposure], 0.0))
    found = {"x": bench.at["x"][point] / 0.3, "y": bench.at["y"][point] / 0.3}
    for n in (2, 4):
        found |= {f"cos {n}": inside * np.cos(n * angle), f"sin {n}": inside * np.sin(n * angle)}
    found["exposure"] = exposure / exposure.max()
    return found | {kind: (bench.at["kind"][exposure] == kind).astype(float) for kind in ("moon", "standard")}


def trees(bench: Bench) -> Callable[[int], Answer]:
    """Gradient-boosted trees on residuals, field, angle, kind and number of the exposure."""
    from sklearn.ensemble import HistGradientBoostingClassifier

    where = np.column_stack(list(_where(bench).values()))
    return _classified(
        bench,
        lambda r: np.column_stack([r, where]),
        lambda: HistGradientBoostingClassifier(max_iter=60, max_leaf_nodes=15, random_state=0),
    )


def logistic(bench: Bench) -> Callable[[int], Answer]:
    """A linear classifier on residuals × (1, x, y, x², xy, y²) × (1, harmonics, kinds)."""
    from sklearn.linear_model import LogisticRegression

    at = _where(bench)
    x, y = at.pop("x"), at.pop("y")
    smooth = np.column_stack([np.ones_like(x), x, y, x**2, x * y, y**2])
    turns = np.column_stack([np.ones_like(x), *at.values()])
    basis = (smooth[:, :, None] * turns[:, None, :]).reshape(len(x), -1)
    return _classified(
        bench,
        lambda r: (r[:, :, None] * basis[:, None, :]).reshape(len(r), -1),
        lambda: LogisticRegression(C=0.01, max_iter=200),
    )


# ------------------------------------------------------------------------------ B: sparse groups of our own columns


class Groups:
    """All effects and sentences as groups of orthonormal columns, with the products of folds and halves of the rows."""

    def __init__(self, bench: Bench) -> None:
        said, self.bench = bench.said, bench
        c = said["columns"].astype(float)
        self.names, parts, maps = [], [], []
        for g in np.flatnonzero(said["kinds"] != "pattern"):
            at = np.flatnonzero((said["group"] == g) & said["alive"])
            w = whitening(c[:, at].T @ c[:, at]) if len(at) else np.zeros((0, 0))
            if w.shape[1]:
                self.names.append(g)
                parts.append(c[:, at] @ w)
                maps.append(said["columns_kept_back"][:, at] @ w)
        self.x, self.beyond = np.concatenate(parts, axis=1), np.concatenate(maps, axis=1)
        self.sizes = np.array([part.shape[1] for part in parts])
        self.first = np.concatenate([[0], np.cumsum(self.sizes)])
        self.names = np.array(self.names)
        self.effect = said["effects"][self.names]
        self.called = [str(e or n) for e, n in zip(self.effect, said["names"][self.names], strict=True)]
        self.gram = self.x.T @ self.x
        rng = np.random.default_rng(12)
        cells = int(bench.data.sum()) // bench.cameras
        priors = np.full(len(bench.data) - cells * bench.cameras, -1)

        def dealt(parts: int) -> np.ndarray:
            """A part of each row, the cameras of an exposure at a point together."""
            return np.append(np.repeat(rng.permutation(cells) % parts, bench.cameras), priors)

        fold, draws = dealt(FOLDS), [dealt(2) for _ in range(PAIRS)]
        self.folds = [fold == k for k in range(FOLDS)]
        self.fold_grams = [self.x[rows].T @ self.x[rows] for rows in self.folds]
        self.halves = [draw == k for draw in draws for k in (0, 1)]
        scores = [self.strength(self.x.T @ bench.noise(rng)).max() for _ in range(2000)]
        self.alarm = float(np.quantile(scores, 1.0 - FALSE_ALARMS))

    def strength(self, z: np.ndarray) -> np.ndarray:
        """Score of every group, over the root of its size."""
        return np.sqrt(np.add.reduceat(z**2, self.first[:-1]) / self.sizes)

    def columns(self, groups: np.ndarray) -> np.ndarray:
        return np.concatenate([np.arange(self.first[g], self.first[g + 1]) for g in groups])

    def allowed(self, scene: int) -> np.ndarray:
        return self.effect != self.bench.without[scene]

    @cached_property
    def alike(self) -> np.ndarray:
        """Groups of which the smaller lies in the larger, all canonical correlations at least `ALIKE`."""
        square = np.add.reduceat(
            np.add.reduceat(self.gram**2, self.first[:-1], axis=0), self.first[:-1], axis=1
        )
        return square >= ALIKE**2 * np.minimum.outer(self.sizes, self.sizes)

    def told(self, r: np.ndarray, groups: np.ndarray, scene: int) -> Answer:
        """The answer that says these groups, less those that do not stand out beside the others, without a penalty.

        One after the other, the weakest first (thresholded lasso, van de Geer, Bühlmann & Zhou 2011).
        """
        z = self.x.T @ r
        while len(groups):
            at = self.columns(groups)
            inverse = np.linalg.pinv(self.gram[np.ix_(at, at)], rcond=1e-8, hermitian=True)
            b = inverse @ z[at]
            parts = np.split(np.arange(len(at)), np.cumsum(self.sizes[groups])[:-1])
            alone = [
                np.sqrt(b[own] @ np.linalg.pinv(inverse[np.ix_(own, own)]) @ b[own] / len(own))
                for own in parts
            ]
            if min(alone) >= self.alarm:
                break
            groups = np.delete(groups, np.argmin(alone))
        if not len(groups):
            return {"told": [], "complete": False}
        allowed, classes = self.allowed(scene), []
        for g, own in zip(groups, parts, strict=True):
            signal = self.gram[:, at[own]] @ b[own]
            square = b[own] @ signal[at[own]]
            apart = np.sqrt(np.maximum(square - np.add.reduceat(signal**2, self.first[:-1]), 0.0))
            near = [h for h in np.argsort(apart) if apart[h] < SEPARATION and allowed[h]]
            others = dict.fromkeys(self.called[h] for h in near if self.called[h] != self.called[g])
            classes.append((-square, [self.called[g], *others]))
        left = z - self.gram[:, at] @ b
        return {
            "told": [one for _, one in sorted(classes)],
            "complete": bool(self.strength(left).max() < self.alarm),
            "kept_back": self.beyond[:, at] @ b,
        }


class GroupPath:
    """Group lasso from products of columns, at a series of penalties, by skglm."""

    def __init__(self, groups: Groups, chosen: np.ndarray) -> None:
        self.sizes = groups.sizes[chosen]
        self.ptr = np.concatenate([[0], np.cumsum(self.sizes)]).astype(np.int32)
        self.indices = np.arange(self.ptr[-1], dtype=np.int32)
        self.roots = np.sqrt(self.sizes).astype(float)

    def __call__(
        self,
        gram: np.ndarray,
        z: np.ndarray,
        lambdas: np.ndarray,
        gamma: float | None = None,
        most: int = 10**9,
    ) -> Iterator[np.ndarray]:
        """Coefficients for ½ bᵀGb − zᵀb + λ Σ √k |b_g|; with `gamma` for the MCP; ends once `most` groups are in."""
        from skglm.datafits import QuadraticGroup
        from skglm.penalties import WeightedGroupL2
        from skglm.solvers import GroupBCD
        from skglm.utils.jit_compilation import compiled_clone

        n = len(z)
        upper = np.linalg.cholesky(gram + 1e-6 * np.trace(gram) / n * np.eye(n)).T
        y, x = np.linalg.solve(upper.T, z), np.asfortranarray(upper)
        fit = compiled_clone(QuadraticGroup(self.ptr, self.indices))
        b, xb = np.zeros(n), np.zeros(n)

        def solved(weights: np.ndarray, penalty: float, start: np.ndarray) -> np.ndarray:
            solver = GroupBCD(tol=1e-3 * penalty / n, max_iter=50, ws_strategy="subdiff")
            term = compiled_clone(WeightedGroupL2(penalty / n, weights, self.ptr, self.indices))
            return solver.solve(x, y, fit, term, start.copy(), x @ start, run_checks=False)[0]

        for penalty in lambdas:
            b = solved(self.roots, penalty, b)
            xb = b
            for _ in range(2 if gamma else 0):
                length = np.sqrt(np.add.reduceat(xb**2, self.ptr[:-1]))
                weights = np.maximum(self.roots - length / (gamma * penalty), 0.0)  # type: ignore[operator]
                xb = solved(weights, penalty, xb)
            yield xb
            if np.count_nonzero(np.add.reduceat(xb**2, self.ptr[:-1])) >= most:
                return


Screened = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, GroupPath]


def _alarmed(groups: Groups, choose: Callable[[Screened], np.ndarray]) -> Callable[[int], Answer]:
    """Nothing below the alarm; else the groups that `choose` takes of those that take part.

    It is given the residuals and their products with all columns, the groups, their columns, penalties and path.
    """

    def answer(scene: int) -> Answer:
        r = groups.bench.residual(scene)
        z = groups.x.T @ r
        strength = np.where(groups.allowed(scene), groups.strength(z), 0.0)
        top = strength.max()
        if top < groups.alarm:
            return {"score": float(top), "told": [], "complete": True}
        chosen = np.sort(np.argsort(-strength)[:SCREENED])
        lambdas = np.geomspace(top, max(FINEST * top, min(LEAST, 0.9 * top)), LAMBDAS)
        path = GroupPath(groups, chosen)
        inside = choose((r, z, chosen, groups.columns(chosen), lambdas, path))
        return {"score": float(top)} | groups.told(r, chosen[inside], scene)

    return answer


def _validated(groups: Groups, gamma: float | None) -> Callable[[int], Answer]:
    def choose(screened: Screened) -> np.ndarray:
        r, z, _, at, lambdas, path = screened
        block = np.ix_(at, at)
        errors = np.zeros((FOLDS, LAMBDAS))
        for k, rows in enumerate(groups.folds):
            own = groups.x[np.ix_(rows, at)].T @ r[rows]
            share = 1.0 - rows.mean()
            held = groups.fold_grams[k][block]
            fits = path(groups.gram[block] - held, z[at] - own, lambdas * share, gamma)
            errors[k] = [b @ held @ b - 2.0 * b @ own for b in fits]
        mean = errors.mean(axis=0)
        # Of the difference from the best: folds differ in noise that all penalties share.
        spread = (errors - errors[:, [np.argmin(mean)]]).std(axis=0, ddof=1) / np.sqrt(FOLDS)
        best = int(np.flatnonzero(mean <= mean.min() + spread)[0])
        *_, b = path(groups.gram[block], z[at], lambdas[: best + 1], gamma)
        return np.flatnonzero(np.add.reduceat(b**2, path.ptr[:-1]) > 0)

    return _alarmed(groups, choose)


def lasso(bench: Bench) -> Callable[[int], Answer]:
    """Group lasso, the sparsest within a standard error of the best prediction."""
    return _validated(Groups(bench), None)


def mcp(bench: Bench) -> Callable[[int], Answer]:
    """Group MCP, the sparsest within a standard error of the best prediction."""
    return _validated(Groups(bench), MCP)


def stability(bench: Bench) -> Callable[[int], Answer]:
    """Candidates that are among the first in most halves of the data."""
    groups = Groups(bench)
    grams = [groups.x[rows].T @ groups.x[rows] for rows in groups.halves]

    def choose(screened: Screened) -> np.ndarray:
        r, _, chosen, at, lambdas, path = screened
        block = np.ix_(at, at)
        votes = np.zeros((len(groups.halves), len(chosen)), bool)
        for k, rows in enumerate(groups.halves):
            *_, b = path(
                grams[k][block], groups.x[np.ix_(rows, at)].T @ r[rows], 0.5 * lambdas, None, QUICKEST
            )
            votes[k] = np.add.reduceat(b**2, path.ptr[:-1]) > 0
        kept, alike = [], groups.alike[np.ix_(chosen, chosen)]
        open_ = np.ones(len(chosen), bool)
        for g in np.argsort(-votes.mean(axis=0), kind="stable"):
            if open_[g] and votes[:, g].any() and votes[:, alike[g]].any(axis=1).mean() >= VOTES:
                kept.append(g)
                open_ &= ~alike[g]
        return np.array(kept, int)

    return _alarmed(groups, choose)


# ------------------------------------------------------------------------ C and D: shapes over the field and the angle


def _shape_columns(bench: Bench, degree: int, harmonics: int, suffix: str) -> np.ndarray:
    """Per camera, in shares of unpolarised light: polynomials of the field × harmonics; the sky has its own."""
    at, point, exposure = bench.at, bench.at[f"point{suffix}"], bench.at[f"exposure{suffix}"]
    data = point >= 0
    point, exposure, camera = point[data], exposure[data], bench.at[f"camera{suffix}"][data]
    x, y = at["x"][point] / 0.3, at["y"][point] / 0.3
    angle, through = np.deg2rad(np.nan_to_num(at["clp_angle"][exposure])), at["clp_in"][exposure]

    def smooth(n: int) -> list[np.ndarray]:
        return [x**i * y**j for i in range(n + 1) for j in range(n + 1 - i)]

    turns = [np.ones_like(x)] + [
        wave(n * angle) for n in range(2, harmonics + 1, 2) for wave in (np.cos, np.sin)
    ]
    patterns = [term * turn * through for term in smooth(degree) for turn in turns]
    patterns += [term * (at["kind"][exposure] == "moon") for term in smooth(min(degree, 1))]
    patterns += [1.0 * (at["kind"][exposure] == "standard")]
    size = at[f"unpolarised_over_error{suffix}"]
    each = np.column_stack([p * size * (camera == k) for k in range(bench.cameras) for p in patterns])
    return bench.without_flux(each, f"flux_direction{suffix}")


def polynomials(bench: Bench) -> Callable[[int], Answer]:
    """What a team would fit to its residuals."""
    models, base, priors = [], bench.at["base"], int((~bench.data).sum())
    for degree in range(5):
        for harmonics in (0, 2, 4):
            rows = np.pad(_shape_columns(bench, degree, harmonics, ""), ((0, priors), (0, 0)))
            along = base.T @ rows
            rows = rows - base @ along
            beyond = (
                _shape_columns(bench, degree, harmonics, "_kept_back") - bench.at["base_kept_back"] @ along
            )
            norm = np.linalg.norm(rows, axis=0) + 1e-300
            u, s, v = np.linalg.svd(rows / norm, full_matrices=False)
            kept = s > 1e-4 * s[0]
            u, s, v = u[:, kept], s[kept], v[kept].T
            models.append((u, (beyond / norm) @ (v / s)))

    def answer(scene: int) -> Answer:
        r = bench.residual(scene)
        fits = [u.T @ r for u, _ in models]
        gain, size = np.array([b @ b for b in fits]), np.array([len(b) for b in fits])
        cost = size * np.log(int(bench.data.sum())) - gain
        best = int(np.argmin(cost))
        signal = models[best][1] @ fits[best] if cost[best] < 0 else None
        return {"score": float(np.max((gain - size) / np.sqrt(2.0 * size))), "told": [], "kept_back": signal}

    return answer


def _process(bench: Bench, seconds: float) -> Callable[[int], Answer]:
    from pyoperon.sklearn import SymbolicRegressor
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    def places(suffix: str, camera: int) -> tuple[np.ndarray, np.ndarray]:
        exposure = bench.at[f"exposure{suffix}"]
        mine = (bench.at[f"camera{suffix}"] == camera) & bench.at["clp_in"][exposure] & (exposure >= 0)
        point, angle = bench.at[f"point{suffix}"][mine], np.deg2rad(bench.at["clp_angle"][exposure[mine]])
        x, y = bench.at["x"][point] / 0.3, bench.at["y"][point] / 0.3
        return mine, np.column_stack([x, y, np.cos(2 * angle), np.sin(2 * angle)])

    def answer(scene: int) -> Answer:
        r, rng = bench.residual(scene), np.random.default_rng(scene)
        expected, score, formulas = np.zeros(len(bench.at["point_kept_back"])), 0.0, []
        for camera in range(bench.cameras):
            (mine, at), (there, far) = places("", camera), places("_kept_back", camera)
            kernel = ConstantKernel(1.0, (1e-3, 1e3)) * RBF([1.0] * 4, (0.1, 30.0)) + WhiteKernel(
                0.75, (0.5, 1.0)
            )
            some = rng.permutation(len(at))[:400]
            tuned = GaussianProcessRegressor(kernel, random_state=0).fit(at[some], r[mine][some])
            mean = GaussianProcessRegressor(tuned.kernel_, optimizer=None).fit(at, r[mine])
            score += mean.log_marginal_likelihood_value_ + 0.5 * float(r[mine] @ r[mine])
            if seconds:
                smooth, mean = mean.predict(at), SymbolicRegressor(
                    allowed_symbols="add,sub,mul,div,sin,cos,constant,variable", optimizer_iterations=5,
                    generations=10**6, max_evaluations=10**9, max_time=round(seconds / bench.cameras),
                    random_state=1,
                )  # fmt: skip
                mean.fit(at, smooth)
                formulas.append(mean.get_model_string(mean.model_, 3))
            expected[there] = mean.predict(far)
        return {"score": score, "told": [], "kept_back": expected, "formulas": formulas}

    return answer


def process(bench: Bench) -> Callable[[int], Answer]:
    """A Gaussian process for each camera."""
    return _process(bench, 0.0)


def formula(bench: Bench) -> Callable[[int], Answer]:
    """Formulas that pyoperon finds in a minute for the mean of the Gaussian process."""
    return _process(bench, 60.0)


# -------------------------------------------------------------------------------------------------------- one command

METHODS = (matched, search, trees, logistic, lasso, mcp, stability, polynomials, process, formula)


def subset(bench: Bench, count: int) -> list[int]:
    """Scenes for the slow ones: of shapes outside the catalogue at a ratio of 30, each shape once, in their order."""
    seen: dict[str, int] = {}
    for i, label in enumerate(opened(bench.folder)[0]):
        if label["kind"] == "outside" and label["ratio"] == 30.0:
            seen.setdefault(label["name"], i)
    return sorted(seen.values())[:count]


def main() -> None:
    """Answer scenes, one line each, written as they come; scenes that are answered already are left out."""
    parser = options_of(__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("methods", nargs="*", help="default: all but process and formula")
    parser.add_argument("--scenes", type=int, help="the first of them only")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    bench = Bench(options.folder)
    (options.folder / "answers").mkdir(exist_ok=True)
    for method in METHODS:
        name = method.__name__
        if name not in (options.methods or [one.__name__ for one in METHODS[:-2]]):
            continue
        path = options.folder / "answers" / f"{name}.jsonl"
        done = (
            {json.loads(line)["scene"] for line in path.read_text().splitlines()} if path.exists() else set()
        )
        scenes = (
            subset(bench, options.scenes or 31) if method in METHODS[-2:] else range(len(bench.residuals))
        )
        begun = time.process_time()
        answer = method(bench)
        print(f"{name}: made ready in {time.process_time() - begun:.1f} s of CPU", flush=True)
        with path.open("a", encoding="utf-8") as file:
            for scene in list(scenes)[: options.scenes]:
                if scene in done:
                    continue
                begun = time.process_time()
                found = answer(scene)
                found |= {"scene": int(scene), "seconds": time.process_time() - begun}
                file.write(json.dumps(found, default=_plain, ensure_ascii=False) + "\n")
                file.flush()
        print(f"{name}: done after {time.process_time() - begun:.1f} s", flush=True)


def _plain(value: Any) -> Any:
    return [float(f"{v:.4g}") for v in value] if isinstance(value, np.ndarray) else value.item()


if __name__ == "__main__":
    main()
