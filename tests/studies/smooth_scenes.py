"""What smooth fields as candidates change, by linear steps: scenes with them in the list of candidates, and without.

    python tests/studies/smooth_scenes.py [--seed 7] [--draws 1] [--waves 40] [--ratios 10 30]      (fifteen minutes)

The design is that of the benchmark (`benchmark/generate.py`). Hidden are

    waves       a sum of four plane waves over the field, at a place and under a law that a smooth field may have, in a
                random combination of the changes there: no simple pattern is this
    describable one of the new shapes of the benchmark that descriptions say (`benchmark/new_shapes.py`)
    open        one of those that nothing in the list says

Of the scenes that raise the alarm the table has the shares in which a thing has the truth first among its names (of
waves: a name with the same place and law), in which a thing holds it in its set, in which something is left as a
pattern without a name, and in which names without the truth are told as the whole; then names in a set, and CPU s.
"""

from __future__ import annotations

import collections
import dataclasses
import sys
import time
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [
    str(ROOT),
    *(str(ROOT / "tests" / p) for p in (".", "diagnosis", "studies", "studies/benchmark")),
]

from generate import Layout, hidden  # noqa: E402
from study_options import options_of  # noqa: E402

from walop_jax.diagnosis.design import SINGLE_EXPOSURES  # noqa: E402
from walop_jax.diagnosis.examination import Examination, common_mode, examine  # noqa: E402
from walop_jax.diagnosis.grammar import hypotheses  # noqa: E402
from walop_jax.diagnosis.selection import Thing, most_probable  # noqa: E402
from walop_jax.model.effects.change import SMOOTH, Change  # noqa: E402
from walop_jax.model.effects.in_models import known_effects  # noqa: E402

WAVES, STEEPEST = (
    4,
    1.8,
)  # plane waves of a field; their wave vectors scatter by so much per scale of the field


class Scene(NamedTuple):
    """What is hidden: its kind, the names that are right, its length in standard errors, the rows of the residuals."""

    kind: str
    said: tuple[str, ...]
    ratio: float
    rows: np.ndarray


class Scenes:
    """One fit, with all candidates and their columns, to which the residuals of any scene are given."""

    def __init__(self, seed: int) -> None:
        self.layout, self.seed = Layout(seed), seed
        result = self.layout.design.fit
        model, calset = result.model, result.calset
        self.listed = hypotheses(known_effects(model), model.template, calset.exposures, len(calset.points))
        self.examined = examine(result, self.listed, np.random.default_rng(seed))
        self.smallest = self.examined.space.smallest_p(np.random.default_rng(seed + 1))
        assert self.examined.smooth is not None
        self.smooth = self.examined.smooth

    def drawn(self, draws: int, waves: int, ratios: tuple[float, ...]) -> list[Scene]:
        """All scenes."""
        new = hidden(self.layout, self.seed, draws, 0, ratios, new=True)
        scenes = [
            Scene("describable" if one.said else "open", one.said, one.ratio, one.rows)
            for one in new
            if one.kind == "outside"
        ]
        rng = np.random.default_rng([self.seed, 99])
        points, design = self.examined.result.calset.points, self.examined.design
        at = np.stack([points.x, points.y]) / self.examined.result.model.template.units.field
        for _ in range(waves):
            field = self.smooth.fields[int(rng.integers(len(self.smooth.fields)))]
            vectors, phases = rng.normal(0.0, STEEPEST, (WAVES, 2)), rng.uniform(0, 2 * np.pi, WAVES)
            pattern = np.cos(vectors @ at + phases[:, None]).sum(axis=0)
            changes = [((1.0, change),) for change in field.changes]
            column = design.columns.of(changes) @ rng.standard_normal(len(changes)) * pattern[design.point]
            rows = design.projector(design.stacked([column[:, None]])[:, 0])
            if np.linalg.norm(rows) > 1e-3 * np.linalg.norm(column):
                scenes += [Scene("waves", (field.name,), r, r * rows / np.linalg.norm(rows)) for r in ratios]
        return scenes

    def evidence(self, rows: np.ndarray, *, smooth: bool) -> Examination:
        """The examination with other residuals, with smooth fields or without."""
        old, design = self.examined, dataclasses.replace(self.examined.design, residual=rows)
        scores = design.products(old.columns, rows)
        _, reduce = old.bare.with_base([SINGLE_EXPOSURES], common_mode(old.bare, old.design))
        scores, square = reduce(scores, float(rows @ rows))
        table = old.space.table(scores, square, self.smallest)
        new = dataclasses.replace(old, design=design, scores=scores, square=square, table=table)
        fields = dataclasses.replace(self.smooth, design=design)
        # What does not depend on the residuals serves again.
        known = {name: value for name, value in vars(self.smooth).items() if name not in vars(fields)}
        vars(fields).update({name: value for name, value in known.items() if name != "scores"})
        vars(new)["smooth"] = fields if smooth else None
        return new


def place_and_law(name: str) -> tuple[str, tuple[str, ...]]:
    """Where the first change of a name is, and what it grows with beside the field."""
    head, *factors = name.split("; ")[0].split(" * ")
    change = Change.parsed(" * ".join([head, *(f for f in factors if f != SMOOTH)]))
    return f"{change.relation} {change.place}", change.beside_field


def outcome(scene: Scene, things: tuple[Thing, ...]) -> tuple[float, ...]:
    """Truth first, truth held, something left open, false names told as the whole, names in a set."""
    named = [thing for thing in things if not thing.is_pattern]
    leading = [next(iter(thing.probabilities)) for thing in named]
    right = set(scene.said)

    def says(name: str) -> bool:
        return name in right or bool(right & set(name.split("; ")))

    holds = [any(map(says, thing.names)) for thing in named]
    if scene.kind == "waves":
        described = [name for name in leading if " " in name and "(" not in name]
        first = any(place_and_law(name) == place_and_law(scene.said[0]) for name in described)
    else:
        first = any(map(says, leading))
    open_ = len(named) < len(things)
    in_set = float(np.mean([len(thing.names) for thing in named])) if named else np.nan
    return float(first), float(any(holds)), float(open_), float(not open_ and not all(holds)), in_set


def main() -> None:
    """Print the table."""
    parser = options_of(__doc__, seed=7, draws=1, waves=40)
    parser.add_argument("--ratios", type=float, nargs="+", default=(10.0, 30.0))
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    scenes = Scenes(options.seed)
    noise = np.random.default_rng([options.seed, 34])
    found: dict[tuple[str, float, bool], list[tuple[float, ...]]] = collections.defaultdict(list)
    for scene in scenes.drawn(options.draws, options.waves, tuple(options.ratios)):
        rows = scene.rows + scenes.layout.noise(noise)
        for smooth in (False, True):
            evidence, began = scenes.evidence(rows, smooth=smooth), time.process_time()
            if evidence.alarm:
                things = most_probable(evidence).things
                seconds = time.process_time() - began
                found[scene.kind, scene.ratio, smooth].append((*outcome(scene, things), seconds))
    print("| hidden | ratio | smooth | scenes | first | held | open | false as the whole | names | CPU s |")
    print(f"|{' --- |' * 10}")
    for (kind, ratio, smooth), rows in sorted(found.items()):
        first, held, left, false, names, seconds = np.nanmean(rows, axis=0)
        shares = " | ".join(f"{100 * share:.0f} %" for share in (first, held, left, false))
        with_them = "yes" if smooth else "no"
        print(f"| {kind} | {ratio:g} | {with_them} | {len(rows)} | {shares} | {names:.1f} | {seconds:.2f} |")


if __name__ == "__main__":
    main()
