"""One law for what is missing, as a rival of the search: the posterior over sets of things (`selection.py`).

    python tests/studies/benchmark/generate.py FOLDER --seed 2 --new
    python tests/studies/one_law.py FOLDER [--seed 2] [--pairs 60] [--today]            (a quarter of an hour)
    python tests/studies/one_law.py --fits [--seed 2] [--first 0] [--sets 40] [--save FILE]

Scenes of the benchmark are judged at the first look, with no fit; FOLDER has to be of the same seed. `--today` judges
them by the search as well, as the pairs in any case. With `--fits` sets of the grammar of `sealed.py` are diagnosed
twice: with the search of today, and with the choice below of what is tried and added (`_next`), all else being equal.

The choice: the most certain thing is asked first, its names are fitted, the most probable first, until one of them is,
with what its fit found beyond the linear step, more probable than every name that was not fitted. The first that data
which took no part in its fit confirm is added, and the residuals are scored again.
"""

from __future__ import annotations

import dataclasses
import pickle
import sys
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import jax
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [
    str(ROOT),
    *(str(ROOT / "tests" / p) for p in (".", "diagnosis", "studies/benchmark", "studies")),
]

from blind import Scene  # noqa: E402
from generate import STEP, Layout  # noqa: E402
from judge import opened, sentences  # noqa: E402
from selection import CERTAIN, Posterior, Thing, most_probable  # noqa: E402
from study_options import options_of  # noqa: E402

from walop_jax.diagnosis import search, thresholds  # noqa: E402
from walop_jax.diagnosis.exact import Trial  # noqa: E402
from walop_jax.diagnosis.examination import Evidence  # noqa: E402
from walop_jax.diagnosis.hypotheses import Probe, Ranked  # noqa: E402
from walop_jax.diagnosis.search import Reason, Round, State, _far_beyond, linear_trial  # noqa: E402
from walop_jax.model.effects import Described  # noqa: E402

# ------------------------------------------------------------------------------------------------------ first looks


def marks(told: Sequence[Sequence[str]], complete: bool, truth: set[str], *, every: bool) -> dict[str, float]:
    """Whether classes of names, the best of each first, hold the truth; `every`: all names of the truth are asked."""
    holds = [any(truth & sentences(name) for name in one) for one in told]
    found = {"false names": float(len(told) - sum(holds))}
    found["false names told as complete"] = found["false names"] if complete else 0.0
    if every:
        found["exactly named"] = float({one[0] for one in told} == truth)
        found["all held"] = float(truth <= {name for one in told for name in one})
    elif truth:
        found["right"] = float(any(truth & sentences(one[0]) for one in told))
        found["right or in its class"] = float(any(holds))
    else:
        found["left open"] = float(not (told and complete))
    if told:
        found["names in a class"] = float(np.mean([len(one) for one in told]))
    return found


def looked(layout: Layout, residuals: np.ndarray, without: str) -> Scene:
    """A scene of the benchmark as the blind suite has it."""
    evidence, blind = layout.blind.evidence, layout.blind
    along = blind._whitening.T @ evidence.design.products(
        evidence.columns, evidence.design.projector(residuals)
    )
    return Scene("", (), 0.0, along, float(residuals @ residuals - along @ along), removed=(without,))


def by_law(posterior: Posterior) -> tuple[list[list[str]], bool]:
    """Classes of a posterior, and whether they are the whole explanation."""
    told = [thing for thing in posterior.things if not thing.is_pattern]
    return [list(thing.names) for thing in told], posterior.explains


def by_search(layout: Layout, scene: Scene, start: Evidence) -> tuple[str, list[list[str]], bool]:
    """Verdict of the search of today, its classes, and whether they are the whole explanation."""
    verdict = layout.blind.judged(scene, start)[0]
    pairs = zip(verdict.named, verdict.added, verdict.classes, strict=True)
    told = [[added if name == Described.name else name, *sorted(c)] for name, added, c in pairs]
    return verdict.kind, told, verdict.kind == "effect_found"


def first_looks(
    folder: Path, seed: int, pairs: int, *, today: bool
) -> Iterator[tuple[str, dict[str, float]]]:
    """By kind of scene and method what is right of each scene."""
    layout, labels = Layout(seed), opened(folder)[0]
    with np.load(folder / "scenes.npz") as scenes:
        residuals, without = scenes["residuals"], scenes["without"]
    # Scenes without the same entry of the catalogue share the space of all other candidates.
    for number in sorted(range(len(labels)), key=lambda i: str(without[i])):
        truth = labels[number]
        kind = (
            truth["kind"] if truth["said"] or truth["kind"] == "null" else f"{truth['kind']}, not in the list"
        )
        scene = looked(layout, residuals[number] * STEP, str(without[number]))
        yield from _both(layout, scene, f"{kind}, SNR {truth['ratio']:g}", set(truth["said"]), today=today)
    layout.blind.rng = np.random.default_rng([seed, 99])
    for _ in range(pairs):
        pair = layout.blind.pair(10.0)
        yield from _both(layout, pair, "pair, SNR 10 each", set(pair.truth), today=True)


def _both(
    layout: Layout, scene: Scene, kind: str, truth: set[str], *, today: bool
) -> Iterator[tuple[str, dict[str, float]]]:
    start = layout.blind.start(scene)
    began = time.process_time()
    posterior = most_probable(start)
    found = {"called": float(bool(posterior.things)), "CPU s": time.process_time() - began}
    every = bool(scene.truth)
    yield f"{kind}: law", found | marks(*by_law(posterior), truth, every=every)
    if today:
        began = time.process_time()
        verdict, *told = by_search(layout, scene, start)
        found = {"called": float(verdict != "consistent"), "CPU s": time.process_time() - began}
        yield f"{kind}: today", found | marks(*told, truth, every=every)


# ------------------------------------------------------------------------------------------------- with exact fits


def _refused(trial: Trial) -> str:
    """Reason not to add a fitted trial; empty: there is none."""
    assert trial.fit is not None
    if not trial.fit.converged:
        return "its fit did not converge"
    if trial.evidence <= 0.0:
        return "its ln B is not above 0"
    if far := _far_beyond(trial):
        return far
    if trial.compared.heldout_after >= trial.compared.heldout_before:
        return "data that were left out agree worse with it"
    return f"exposures of {trial.against} speak against it" if trial.against else ""


@dataclasses.dataclass
class Asked:
    """What one round asks: trials by name with the reasons for which they were refused, and the fits that it took."""

    evidence: Evidence
    judge: Any
    fits: int
    trials: dict[str, Trial] = dataclasses.field(default_factory=dict)

    def passes(self, trial: Trial) -> bool:
        """Whether a trial is not refused; it is noted in any case."""
        self.trials[trial.name] = dataclasses.replace(trial, refused=_refused(trial))
        return not self.trials[trial.name].refused

    def names_of(self, thing: Thing) -> list[tuple[float, Trial]]:
        """Trials of the names of a thing that are not refused, each with the logarithm of its probability.

        The probability is that of the linear step, corrected for what the fit found beyond it. Names outside the set of
        the thing are asked only where fits have found those in it less probable than linear steps said.
        """
        passed, held = list[tuple[float, Trial]](), thing.names
        for name, probability in thing.probabilities.items():
            if not passed and name not in held:
                break
            item = _named(self.evidence, name, thing.shapes)
            expected = float(np.log(max(probability, 1e-300)))
            if item is None or item.name in self.trials:
                continue
            if any(worth >= expected or trial.noise for worth, trial in passed) or self.judge.over(self.fits):
                break
            self.fits += 1
            trial = self.judge.fitted(self.evidence, linear_trial(self.evidence, item))
            if trial.fit is not None and self.passes(trial):
                passed.append((expected + (trial.evidence - trial.linear) / self.evidence.floor**2, trial))
        return passed


def _named(evidence: Evidence, name: str, shapes: Mapping[str, tuple[Probe, ...]]) -> Ranked | None:
    """A name as the search ranks it, by the shapes that the posterior gives it; None where it cannot be fitted."""
    items = {item.effect.name: item for item in evidence.ranked} | {
        item.probe.name: item for item in evidence.ranked_sentences
    }
    item = items.get(name)
    own = [p for p in shapes.get(name, ()) if item is not None and p.effect is item.effect]
    if item is None or not own:
        return item
    chosen = [(probe, evidence.table[probe.name]) for probe in own[: thresholds.MOST_FITTED]]
    return dataclasses.replace(item, probe=chosen[0][0], score=chosen[0][1], others=tuple(chosen[1:]))


def _next(state: State, judge: Any) -> tuple[Trial | None, State]:
    """The most probable addition that is not refused (None: all are), as `search._next` of today.

    And the state with the reasons.
    """
    evidence, choices, accepted, others_asked = state.evidence, state.choices, None, False
    things = sorted(most_probable(evidence).things, key=lambda t: -next(iter(t.probabilities.values()), 0.0))
    turn = Asked(evidence, judge, state.fits)
    for thing in [*(thing for thing in things if not thing.is_pattern), None]:
        passed = [] if thing is None else turn.names_of(thing)
        missing = evidence.chi2 - evidence.dof
        explained = any(
            t.noise or evidence.chi2 - t.left > thresholds.GOOD_SHARE * missing for _, t in passed
        )
        if not others_asked and not explained and (evidence.poor or thing is None):
            others_asked = True
            others, choices = judge.others(dataclasses.replace(state, fits=turn.fits))
            turn.fits += len(others)
            # What has no linear step is compared with the best name by the evidence of both fits.
            best = max(passed, key=lambda pair: pair[1].evidence, default=None)
            level = 0.0 if best is None else best[0] - best[1].evidence / evidence.floor**2
            passed += [(level + t.evidence / evidence.floor**2, t) for t in others if turn.passes(t)]
        for _, trial in sorted(passed, key=lambda pair: -pair[0]):
            confronted = judge.confronted(evidence, trial)
            if turn.passes(confronted):
                accepted = _with_rivals(evidence, confronted, thing)
                break
        if accepted is not None or judge.over(turn.fits):
            break
    added = "" if accepted is None else accepted.name
    reasons = (
        Reason(
            name, t.evidence, 0.0, fitted=True, reason=t.refused if name != added else "", against=t.against
        )
        for name, t in turn.trials.items()
    )
    rounds = (*state.rounds, Round(evidence.table.p_global, added, tuple(reasons)))
    ended = judge.over(turn.fits) if accepted is None else ""
    return accepted, dataclasses.replace(state, rounds=rounds, choices=choices, fits=turn.fits, ended=ended)


def _with_rivals(evidence: Evidence, trial: Trial, thing: Thing | None) -> Trial:
    """A trial with the other names of the thing that it is: effects, and descriptions."""
    own = trial.name, trial.effect.name
    names = () if thing is None else tuple(name for name in thing.names if name not in own)
    effects = {item.effect.name for item in evidence.ranked}
    rivals = tuple(name for name in names if name in effects)
    nameless = tuple(name for name in names if name not in effects)[: thresholds.MOST_CLASSES]
    return dataclasses.replace(trial, rivals=rivals, nameless=nameless)


def sets(seed: int, first: int, count: int, save: Path | None) -> None:
    """Diagnose sealed sets with both searches, and print one line for each."""
    from studies import sealed

    options = SimpleNamespace(seed=seed, side=8, refit_only=False, minutes=None)
    outcomes: dict[str, list[Any]] = {"today": [], "law": []}
    for number in range(first, first + count):
        for name, choice in {"today": search._next, "law": _next}.items():
            with patch.object(search, "_next", choice):
                outcomes[name].append(sealed.outcome(number, options))  # type: ignore[arg-type]
            print(name, sealed.line(number, outcomes[name][-1]), flush=True)
            if save:
                save.write_bytes(pickle.dumps(outcomes))
        jax.clear_caches()  # the programs of every set are others
    for name, found in outcomes.items():
        print(f"{name}\n{sealed.table(found)}")


def main() -> None:
    """Print what both searches find."""
    parser = options_of(__doc__, seed=2, pairs=60, first=0, sets=40)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument(
        "--today", action="store_true", help="scenes of the benchmark by the search of today as well"
    )
    parser.add_argument("--fits", action="store_true", help="sets of the grammar of sealed.py, fitted")
    parser.add_argument("--save", type=Path, help="file of the outcomes so far, written after each")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if options.fits:
        sets(options.seed, options.first, options.sets, options.save)
        return
    if options.folder is None:
        parser.error("FOLDER of scenes is missing (or --fits)")
    groups = defaultdict[str, list[dict[str, float]]](list)
    for name, found in first_looks(options.folder, options.seed, options.pairs, today=options.today):
        groups[name].append(found)
    print(f"ν = ½, λ = {CERTAIN}")
    for name, found in sorted(groups.items()):
        keys = dict.fromkeys(key for one in found for key in one)
        means = {key: np.mean([one[key] for one in found if key in one]) for key in keys}
        print(f"{name} ({len(found)}): " + ", ".join(f"{key} {value:.3g}" for key, value in means.items()))


if __name__ == "__main__":
    main()
