"""What each rule of the search is worth: every one switched off, on the frozen benchmark and on scenes that made none.

    python tests/studies/benchmark/generate.py OLD
    python tests/studies/benchmark/generate.py NEW --seed 2 --new
    python tests/studies/ablation.py OLD NEW [--each 1] [--quiet 40] [--pairs 40]       (a quarter of an hour)

OLD are the published scenes, on which the rules were made; NEW have another simulated run, other noise, and shapes that
are nowhere else (`benchmark/new_shapes.py`). Of each shape and ratio `--each` scenes are taken, `--quiet` in which
nothing is hidden, and beside NEW `--pairs` of two effects of the catalogue. A rule is asked only of scenes in which it
decides something; the others cannot change.

The table has, for each rule, the scenes in which it decides, those whose additions or verdict change without it, and
how many of these are better and worse *with* it: right or in its class before open before wrong.
"""

from __future__ import annotations

import contextlib
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import jax
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), *(str(ROOT / "tests" / p) for p in (".", "diagnosis", "studies/benchmark"))]

from blind import Scene  # noqa: E402
from generate import STEP, Layout  # noqa: E402
from judge import opened  # noqa: E402
from study_options import options_of  # noqa: E402

from walop_jax.diagnosis import examination, search, thresholds  # noqa: E402
from walop_jax.diagnosis.examination import Evidence  # noqa: E402

Switch = Callable[[], Any]
RULES: dict[str, tuple[Any, str, Callable[[Any], Any]]] = {
    # rule: where it is, its name there, and what stands in its place when it is off
    "a name explains a quarter of what is surely missing (`LEAST_SHARE_OF_NAME`)": (
        thresholds, "LEAST_SHARE_OF_NAME", lambda _: 0.0,
    ),
    "one-sided amplitudes on their side (`follow_physics`)": (
        examination, "follow_physics", lambda _: lambda *a: True,
    ),
    "patterns without a name compete (`stands`)": (Evidence, "stands", lambda _: lambda *a: True),
    "a description needs 3 more than a name (`EVEN_ODDS`)": (
        search, "names_first", lambda _: lambda trial: -trial.evidence,
    ),
    "a share of what is missing (`LEAST_SHARE`)": (thresholds, "LEAST_SHARE", lambda _: 0.0),
    "rivals within 8 are tried (`WITHIN`)": (thresholds, "WITHIN", lambda _: 0.0),
}  # fmt: skip
WORTH = {"right": 2, "in its class": 2, "open": 1, "not detected": 1, "wrong": 0}


@contextlib.contextmanager
def without(rule: str) -> Iterator[None]:
    """The search without a rule."""
    owner, name, off = RULES[rule]
    with patch.object(owner, name, off(getattr(owner, name))):
        yield


class Scenes:
    """Scenes of a folder, and pairs, with the truth."""

    def __init__(self, folder: Path, seed: int, each: int, quiet: int, pairs: int) -> None:
        self.blind = Layout(seed).blind
        with np.load(folder / "scenes.npz") as scenes:
            self.residuals, self.without = scenes["residuals"], scenes["without"]
        self.blind.rng = np.random.default_rng([seed, 99])
        self.pairs = [self.blind.pair(10.0) for _ in range(pairs)]
        self.truth: dict[int, dict[str, Any]] = {}
        seen: Counter[tuple[str, str, float]] = Counter()
        for number, label in enumerate(opened(folder)[0]):
            key = label["kind"], label["name"], label["ratio"]
            seen[key] += 1
            if seen[key] <= (quiet if label["kind"] == "null" else each):
                self.truth[number] = label
        for number, pair in enumerate(self.pairs):
            self.truth[-1 - number] = {"kind": "pair", "said": pair.truth}

    def _scene(self, number: int) -> Scene:
        if number < 0:
            return self.pairs[-1 - number]
        r = self.residuals[number] * STEP
        evidence = self.blind.evidence
        along = self.blind._whitening.T @ evidence.design.products(
            evidence.columns, evidence.design.projector(r)
        )
        rest = float(r @ r - along @ along)
        return Scene("", (), 0.0, along, rest, removed=(str(self.without[number]),))

    def judged(self, number: int) -> dict[str, Any]:
        """Verdict and additions, and what is right of them."""
        scene = self._scene(number)
        verdict = self.blind.judged(scene, self.blind.start(scene))[0]
        return {
            "kind": verdict.kind,
            "added": list(verdict.added),
            "outcome": _outcome(verdict, self.truth[number]),
        }


def _outcome(verdict: Any, truth: dict[str, Any]) -> str:
    if verdict.kind == "consistent":
        return "right" if truth["kind"] == "null" else "not detected"
    told = {*verdict.named, *(text for group in verdict.added for text in group.split("; "))}
    classes = {text for one in verdict.classes for group in one for text in group.split("; ")}
    right = set(truth["said"])
    if truth["kind"] == "pair":
        return "right" if right <= told else "in its class" if right <= told | classes else "wrong"
    if told & right:
        return "right"
    if classes & right:
        return "in its class"
    named = any(name != "described" for name in verdict.named)
    return "open" if verdict.kind == "unexplained" and not named else "wrong"


def decided(scenes: Scenes, numbers: list[int]) -> tuple[dict[int, dict[str, Any]], dict[str, set[int]]]:
    """Every scene judged with all rules, and the scenes in which each rule decides something."""
    judged, where = {}, {rule: set[int]() for rule in RULES}
    for number in numbers:
        fired: set[str] = set()
        with contextlib.ExitStack() as stack:
            for rule, watch in WATCHED.items():
                owner, name, _ = RULES[rule]
                stack.enter_context(patch.object(owner, name, watch(getattr(owner, name), fired, rule)))
            stack.enter_context(patch.object(search, "leaders", _leaders(search.leaders, fired)))
            stack.enter_context(patch.object(search, "refused", _refused(search.refused, fired)))
            judged[number] = scenes.judged(number)
        for rule in fired:
            where[rule].add(number)
    return judged, where


def _when(answer: Any) -> Callable[[Callable[..., Any], set[str], str], Callable[..., Any]]:
    """Watch of a rule that decides where it gives one answer."""

    def watch(real: Callable[..., Any], fired: set[str], rule: str) -> Callable[..., Any]:
        def told(*args: Any) -> Any:
            found = real(*args)
            if found is answer:
                fired.add(rule)
            return found

        return told

    return watch


def _of_descriptions(real: Callable[..., Any], fired: set[str], rule: str) -> Callable[..., Any]:
    def told(trial: Any) -> float:
        if trial.effect is search.Described:
            fired.add(rule)
        return real(trial)

    return told


_NAMES = list(RULES)
WATCHED = {_NAMES[1]: _when(False), _NAMES[2]: _when(False), _NAMES[3]: _of_descriptions}


def _leaders(real: Callable[..., Any], fired: set[str]) -> Callable[..., Any]:
    def told(ranked: Any) -> Any:
        found = real(ranked)
        if len(found) > 1:
            fired.add(_NAMES[5])
        return found

    return told


def _refused(real: Callable[..., str], fired: set[str]) -> Callable[..., str]:
    def told(evidence: Any, trial: Any) -> str:
        reason = real(evidence, trial)
        if reason.startswith("it explains"):
            fired.update((_NAMES[0], _NAMES[4]))
        return reason

    return told


def ablation(scenes: Scenes) -> dict[str, tuple[int, int, int, int]]:
    """For each rule: scenes in which it decides, changed without it, better and worse with it."""
    judged, where = decided(scenes, list(scenes.truth))
    print("with all rules", Counter(one["outcome"] for one in judged.values()), flush=True)
    rows = {}
    for rule in RULES:
        changed = better = worse = 0
        with without(rule):
            for number in sorted(where[rule]):
                now, before = scenes.judged(number), judged[number]
                changed += any(now[key] != before[key] for key in ("kind", "added"))
                gain = WORTH[before["outcome"]] - WORTH[now["outcome"]]
                better, worse = better + (gain > 0), worse + (gain < 0)
        rows[rule] = len(where[rule]), changed, better, worse
        print(rule, rows[rule], flush=True)
    return rows


def main() -> None:
    """Print the table."""
    parser = options_of(__doc__, each=1, quiet=40, pairs=40)
    parser.add_argument("old", type=Path)
    parser.add_argument("new", type=Path)
    parser.add_argument("--seed", type=int, default=2, help="of NEW")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    tables = []
    for folder, seed, pairs in ((options.old, 1, 0), (options.new, options.seed, options.pairs)):
        scenes = Scenes(folder, seed, options.each, options.quiet, pairs)
        tables.append((len(scenes.truth), ablation(scenes)))
    counts = " | ".join(f"of {count} scenes: decides; changed; better; worse with it" for count, _ in tables)
    print(f"| rule | {counts} |\n| --- | --- | --- |")
    for rule in RULES:
        print(f"| {rule} | " + " | ".join("; ".join(map(str, table[rule])) for _, table in tables) + " |")


if __name__ == "__main__":
    main()
