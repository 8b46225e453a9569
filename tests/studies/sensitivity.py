"""How much depends on the numbers by which a first look names things, on scenes that made none of them.

Each number is taken smaller and larger.

    python tests/studies/benchmark/generate.py NEW --seed 3 --new
    python tests/studies/sensitivity.py NEW --seed 3 [--each 1] [--quiet 12] [--pairs 12] [--only FAINTEST]

Each value of a number takes five minutes; `--only` is an expression that names of numbers must hold.

The scenes of NEW have another simulated run than the published ones, other noise, and shapes that are nowhere else
(`benchmark/new_shapes.py`). Of each shape and ratio `--each` scenes are taken, `--quiet` in which nothing is hidden,
and `--pairs` of two effects of the catalogue. For each number the table has the scenes whose verdict or names change,
and those that are better and worse with the number as it is: right or in its class before open before wrong.
"""

from __future__ import annotations

import contextlib
import re
import sys
from collections import Counter
from pathlib import Path
from typing import Any
from unittest.mock import patch

import jax
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [
    str(ROOT),
    *(str(ROOT / "tests" / p) for p in (".", "diagnosis", "studies", "studies/benchmark")),
]

from ablation import WORTH  # noqa: E402
from blind import Scene  # noqa: E402
from generate import STEP, Layout  # noqa: E402
from judge import opened  # noqa: E402
from study_options import options_of  # noqa: E402

from walop_jax.diagnosis import score, thresholds  # noqa: E402

OTHERS = {
    "ALARM": (0.00135, 0.0054),
    "NOTHING_MORE": (0.1, 0.9),
    "CERTAIN": (0.9, 0.99),
    "MOST_STEPS": (3, 12),
    "MOST_SENTENCES": (1, 4),
    "IMPROBABLE": (4.6, 9.2),
    "SEPARATION": (2.5, 3.5),
    "FLOOR": (1.1, 1.5),
}
"""A smaller and a larger value of each."""
REBUILT = {(score, "FAINTEST"): (0.01, 0.3), (thresholds, "COMMON_MODE"): (0.02, 0.1)}
"""The same of numbers that are in the table of scores already: it is made again with each value."""


class Scenes:
    """Scenes of a folder, and pairs, with the truth."""

    def __init__(self, folder: Path, seed: int, each: int, quiet: int, pairs: int) -> None:
        self.seed, self.blind = seed, Layout(seed).blind
        with np.load(folder / "scenes.npz") as scenes:
            self.residuals, self.without = scenes["residuals"], scenes["without"]
        self.blind.rng = np.random.default_rng([seed, 99])
        self.pairs = [self.blind.pair(10.0) for _ in range(pairs)]
        self.truth: dict[int, dict[str, Any]] = {}
        self.as_they_are: dict[int, dict[str, Any]] = {}  # answers with the numbers as they are
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
        """Verdict and names, and what is right of them."""
        scene = self._scene(number)
        verdict = self.blind.judge(scene)
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


def changed(
    scenes: Scenes, name: str, value: float, module: Any = thresholds, *, rebuilt: bool = False
) -> tuple[int, int, int]:
    """Scenes with another answer, better and worse ones with the number as it is."""
    counts = [0, 0, 0]
    with patch.object(module, name, value), contextlib.ExitStack() as stack:
        if rebuilt:
            stack.enter_context(patch.object(scenes, "blind", Layout(scenes.seed).blind))
        for number, before in scenes.as_they_are.items():
            now = scenes.judged(number)
            gain = WORTH[before["outcome"]] - WORTH[now["outcome"]]
            counts[0] += any(now[key] != before[key] for key in ("kind", "added"))
            counts[1] += gain > 0
            counts[2] += gain < 0
    return counts[0], counts[1], counts[2]


def main() -> None:
    """Print the table."""
    parser = options_of(__doc__, each=1, quiet=12, pairs=12, seed=3, only="")
    parser.add_argument("folder", type=Path)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    scenes = Scenes(options.folder, options.seed, options.each, options.quiet, options.pairs)
    scenes.as_they_are = {number: scenes.judged(number) for number in scenes.truth}
    print(Counter(one["outcome"] for one in scenes.as_they_are.values()))
    print("| number | smaller: changed; better; worse with it | larger |\n| --- | --- | --- |")
    for name, values in OTHERS.items():
        if not re.search(options.only, name):
            continue
        cells = [f"{value:g}: {'; '.join(map(str, changed(scenes, name, value)))}" for value in values]
        print(f"| `thresholds.{name}` | {cells[0]} | {cells[1]} |", flush=True)
    for (module, name), values in REBUILT.items():
        if not re.search(options.only, name):
            continue
        told = [changed(scenes, name, value, module, rebuilt=True) for value in values]
        cells = [f"{value:g}: {'; '.join(map(str, of))}" for value, of in zip(values, told, strict=True)]
        print(f"| `{module.__name__.rpartition('.')[2]}.{name}` | {cells[0]} | {cells[1]} |", flush=True)


if __name__ == "__main__":
    main()
