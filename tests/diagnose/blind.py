"""A blind suite at the level of scores: thousands of hidden effects through the rules of `diagnose`, no refits.

One design (a simulated calibration set, its Jacobian, the columns of every effect and pattern) is rotated into
the space that its columns span; what lies outside is pure noise. Scenes are drawn there, Gaussian noise plus an
effect of known signal-to-noise ratio after projection, and go through the scoring, ranking and separating code of
the package.
Verdicts are written before the truths are opened.

    python tests/diagnose/blind.py [scenes per effect and ratio]
"""

from __future__ import annotations

import collections
import dataclasses
import hashlib
import json
import sys
from collections.abc import Iterator, Sequence

import numpy as np

from walop_jax.data.records import CalibrationSet
from walop_jax.diagnose import naming
from walop_jax.diagnose.columns import Probe, effect_candidates, probes
from walop_jax.diagnose.design import Design
from walop_jax.diagnose.freeform import strata
from walop_jax.diagnose.score import Candidate, Projector, Scorer, ScoreTable, whitened
from walop_jax.diagnose.workflow import ALARM, MOST_STEPS
from walop_jax.fit.refit import fit
from walop_jax.likelihood.problem import Problem, base_model
from walop_jax.model.effects import EFFECTS
from walop_jax.model.specification import effect_context

NOISE_ROWS = 2000


@dataclasses.dataclass(frozen=True)
class Scene:
    """What is hidden: effect names (or the label of an outside shape) and the residuals they make."""

    truth: tuple[str, ...]
    ratio: float
    residual: np.ndarray


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What the rules say of a scene."""

    kind: str
    named: tuple[str, ...]
    classes: tuple[frozenset[str], ...]
    amplitudes: dict[str, float]


class Blind:
    """A design made ready for drawing and judging scenes."""

    def __init__(self, calset: CalibrationSet, seed: int = 1) -> None:
        model = base_model(calset)
        problem = Problem(calset, model)
        result = fit(problem)
        design = Design.of(problem, result)
        self.probes: list[Probe] = list(probes(EFFECTS, effect_context(model.template, calset.exposures)))
        named = design.padded(list(effect_candidates(calset, model, result.values, self.probes).values()))
        free = design.padded(list(strata(design.measured)))
        outside = design.padded(list(self._outside(design)))
        every = np.column_stack([design.jacobian, *(c.columns for c in [*named, *free, *outside])])
        turn = whitened(every)[0]
        self.jacobian = self._rotated(turn, design.jacobian)
        self.named = [self._candidate(turn, c) for c in named]
        self.free = [self._candidate(turn, c) for c in free]
        self.outside = [self._candidate(turn, c) for c in outside]
        self._scorers: dict[tuple[tuple[str, ...], tuple[str, ...]], tuple[Scorer, list[Probe]]] = {}
        self.projector = Projector(self.jacobian)
        self.rng = np.random.default_rng(seed)

    @staticmethod
    def _rotated(turn: np.ndarray, columns: np.ndarray) -> np.ndarray:
        return np.pad(turn.T @ columns, ((0, NOISE_ROWS), (0, 0)))

    def _candidate(self, turn: np.ndarray, c: Candidate) -> Candidate:
        return Candidate(c.name, self._rotated(turn, c.columns), c.widths)

    @staticmethod
    def _outside(design: Design) -> Iterator[Candidate]:
        """Shapes that are in no catalogue."""
        measured = design.measured
        e, points = design.problem.calset.exposures, design.problem.calset.points
        shape = (len(points), len(e), 4)
        r = np.hypot(points.x, points.y)
        through = e.clp_in
        angle = np.deg2rad(np.where(through, e.clp_angle, 0.0))
        sky = (e.kind == "moon") & ~through

        def camera(k: int) -> np.ndarray:
            return np.eye(4)[k][None, None]

        ring = np.exp(-((r - 0.2) ** 2) / (2 * 0.02**2))[:, None, None]
        step = np.where(points.x > 0.05, 1.0, 0.0)[:, None, None]
        six = np.where(through, np.cos(6 * angle), 0.0)[None, :, None]
        hysteresis = np.where(through & (np.arange(len(e)) % 2 == 0), 1.0, 0.0)[None, :, None]
        pair = camera(0) - camera(1)
        gradient = (points.x / 0.3)[:, None, None] * sky[None, :, None] * pair
        patterns = {
            "ring": ring * camera(2),
            "step": step * camera(1),
            "6θ": six * camera(0),
            "hysteresis": hysteresis * camera(3),
            "sky gradient": gradient,
        }
        for name, pattern in patterns.items():
            yield measured.candidate(name, [np.broadcast_to(pattern, shape)])

    # ------------------------------------------------------------------------------------------ drawing scenes

    def noise(self) -> np.ndarray:
        """Residuals of a set in which nothing is missing."""
        return self.rng.standard_normal(len(self.jacobian))

    def signal(self, candidate: Candidate, ratio: float) -> np.ndarray:
        """A random direction of a candidate at a signal-to-noise ratio (after projection)."""
        direction = candidate.columns @ (self.rng.standard_normal(len(candidate.widths)) * candidate.widths)
        return -direction * ratio / np.linalg.norm(self.projector(direction))

    def hidden(self, name: str, ratio: float) -> np.ndarray:
        """The residual pattern of a named effect, at a random one of its shapes that can be seen at all."""
        table = self.table()
        shapes = [
            c
            for p, c in zip(self.probes, self.named, strict=True)
            if p.effect.name == name and table[p.name].testable
        ]
        return self.signal(shapes[self.rng.integers(len(shapes))], ratio)

    def visible(self) -> list[str]:
        """Effects that this design can show."""
        table = self.table()
        return sorted({p.effect.name for p in self.probes if table[p.name].testable})

    def table(self) -> ScoreTable:
        """Scores of pure noise: for what does not depend on the data."""
        return self._scorer((), ())[0](np.ones(len(self.jacobian)))

    # --------------------------------------------------------------------------------------------------- judging

    def _scorer(self, added: tuple[str, ...], removed: tuple[str, ...]) -> tuple[Scorer, list[Probe]]:
        key = (added, removed)
        if key not in self._scorers:
            active = {p.effect.name for p in self.probes if p.name in added}
            keep = [
                (p, c) for p, c in zip(self.probes, self.named, strict=True)
                if p.effect.name not in active | set(removed)
            ]  # fmt: skip
            base = np.column_stack([self.jacobian, *(c.columns for c in self.named if c.name in added)])
            scorer = Scorer(Projector(base), [*(c for _, c in keep), *self.free], np.random.default_rng(7))
            self._scorers[key] = scorer, [p for p, _ in keep]
        return self._scorers[key]

    def judge(self, residual: np.ndarray, removed: tuple[str, ...] = ()) -> Verdict:
        """The workflow's rules with linear steps in place of refits."""
        added: list[str] = []
        amplitudes: dict[str, float] = {}
        scorer, left = self._scorer((), removed)
        table = scorer(residual)
        while table.p_global < ALARM and len(added) < MOST_STEPS:
            ranked = [
                r for r in naming.rank(table, left) if table.corrected(r.score) < ALARM and r.log_bayes > 0
            ]
            if not ranked:
                break
            added.append(ranked[0].probe.name)
            amplitudes[ranked[0].effect.name] = float(np.sqrt(ranked[0].score.statistic))
            scorer, left = self._scorer(tuple(added), removed)
            table = scorer(residual)
        classes = tuple(self._class(name, added, residual, removed) for name in added)
        kind = "unexplained" if table.p_global < ALARM else "effect_found" if added else "consistent"
        names = tuple(next(p.effect.name for p in self.probes if p.name == a) for a in added)
        return Verdict(kind, names, classes, amplitudes)

    def _class(
        self, name: str, added: Sequence[str], residual: np.ndarray, removed: tuple[str, ...]
    ) -> frozenset[str]:
        others = tuple(a for a in added if a != name)
        scorer, left = self._scorer(others, removed)
        table = scorer(residual)
        effect = next(p.effect for p in self.probes if p.name == name)
        change = table.projected[name] @ table[name].amplitudes
        return naming.close_rivals(
            change, [(p, table.projected[p.name]) for p in left if p.effect is not effect]
        )


def study(
    blind: Blind, each: int, ratios: Sequence[float] = (6.0, 10.0, 30.0), nulls: int = 200
) -> dict[str, object]:
    """Draw scenes, judge them, then open the truths: the numbers of the acceptance list."""
    scenes: list[Scene] = [Scene((), 0.0, blind.noise()) for _ in range(nulls)]
    for name in blind.visible():
        for ratio in ratios:
            scenes += [Scene((name,), ratio, blind.noise() + blind.hidden(name, ratio)) for _ in range(each)]
    for shape in blind.outside:
        for ratio in (10.0, 30.0):
            scenes += [
                Scene((f"outside: {shape.name}",), ratio, blind.noise() + blind.signal(shape, ratio))
                for _ in range(each)
            ]
    order = blind.rng.permutation(len(scenes))
    sealed = json.dumps([scenes[i].truth for i in order]).encode()
    verdicts = [blind.judge(scenes[i].residual) for i in order]
    opened = [scenes[i] for i in order]
    if (
        hashlib.sha256(json.dumps([s.truth for s in opened]).encode()).digest()
        != hashlib.sha256(sealed).digest()
    ):
        raise RuntimeError("the truths changed while the verdicts were made")
    return summarise(list(zip(opened, verdicts, strict=True)))


def summarise(judged: Sequence[tuple[Scene, Verdict]]) -> dict[str, object]:
    """Rates over judged scenes, and the confusion of names."""
    rates: dict[str, list[bool]] = collections.defaultdict(list)
    confusion: collections.Counter[tuple[str, str]] = collections.Counter()
    for scene, verdict in judged:
        if not scene.truth:
            rates["false alarm"].append(verdict.kind != "consistent")
            continue
        truth, ratio = scene.truth[0], f"{scene.ratio:g}"
        if truth.startswith("outside"):
            rates[f"outside unexplained {ratio}"].append(verdict.kind == "unexplained")
            confusion[truth, "+".join(verdict.named) + f" [{verdict.kind}]"] += 1
            continue
        first = verdict.named[0] if verdict.named else verdict.kind
        told = frozenset(verdict.named[:1]).union(*verdict.classes[:1])
        rates[f"detected {ratio}"].append(verdict.kind != "consistent")
        rates[f"top-1 {ratio}"].append(first == truth)
        rates[f"in class {ratio}"].append(truth in told)
        rates[f"confident and wrong {ratio}"].append(bool(verdict.named) and truth not in told)
        rates[f"exactly one step {ratio}"].append(len(verdict.named) == 1 and verdict.kind == "effect_found")
        if first != truth:
            confusion[truth, first] += 1
    return {
        "rates": {name: (float(np.mean(v)), len(v)) for name, v in sorted(rates.items())},
        "confusion": [(t, n, c) for (t, n), c in confusion.most_common(40)],
    }


if __name__ == "__main__":
    import jax

    jax.config.update("jax_enable_x64", True)
    from walop_jax.likelihood.observing import ObservingPlan
    from walop_jax.likelihood.simulate import simulate

    simulated, _ = simulate(ObservingPlan(), seed=20260)
    print(
        json.dumps(
            study(Blind(simulated), int(sys.argv[1]) if len(sys.argv) > 1 else 10),
            indent=1,
            ensure_ascii=False,
        )
    )
