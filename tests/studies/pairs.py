"""Two effects of the catalogue at once: are both named, in runs that the search has never seen?

    PYTHONPATH=tests python tests/studies/pairs.py [--seed 4] [--pairs 60] [--ratio 10]              (two minutes)

The run of the benchmark with that seed (`benchmark/generate.py --new`) is fitted; two effects, each with the
signal-to-noise ratio by itself, are added to its residuals with noise, and the search names them by linear steps.

In the pairs of the second row both effects are 5 σ from every other name, by design, as in the published study: a
standard that drifts is often much like one that is wrong. The last row is the mean of the probabilities that the
posterior gives its answers. It may be lower than the share of right ones: every scene holds effects of the catalogue,
which the posterior does not know.
"""

from __future__ import annotations

import sys
from pathlib import Path

import jax
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [
    str(ROOT),
    *(str(ROOT / "tests" / p) for p in (".", "diagnosis", "studies", "studies/benchmark")),
]

from blind import SEPARABLE  # noqa: E402
from generate import Layout  # noqa: E402
from study_options import options_of  # noqa: E402

from walop_jax.diagnosis.selection import most_probable  # noqa: E402


def main() -> None:
    """Print the table."""
    options = options_of(__doc__, seed=4, pairs=60, ratio=10.0).parse_args()
    jax.config.update("jax_enable_x64", True)
    blind = Layout(options.seed).blind
    blind.rng = np.random.default_rng([options.seed, 99])
    rows = []
    for number in range(options.pairs):
        scene = blind.pair(options.ratio)
        verdict, last = blind.judged(scene, blind.start(scene))
        names, probability = verdict.named, verdict.probability * most_probable(last).nothing_more
        right = sorted(names) == sorted(scene.truth)
        inside = set(scene.truth) <= set(names).union(*verdict.classes)
        false = sum(name not in scene.truth for name in names)
        rows.append((right, inside, false, probability, scene.separation >= SEPARABLE))
        if not right:
            print(
                f"{number}: {' and '.join(scene.truth)}: {', '.join(names)} ({probability:.2f})", flush=True
            )
    right, inside, false, said, _ = np.mean(rows, axis=0)
    apart = [row[0] for row in rows if row[4]]
    error = np.std([row[0] - row[3] for row in rows]) / np.sqrt(len(rows))
    print(f"| both named, nothing else | {100 * right:.0f} % |")
    print(f"| the same of the {len(apart)} at 5 σ from every other name | {100 * np.mean(apart):.0f} % |")
    print(f"| both named or in a class | {100 * inside:.0f} % |")
    print(f"| false names a pair | {false:.2f} |")
    print(
        f"| probability that the posterior gives its answer, mean | {100 * said:.0f} ± {100 * error:.0f} % |"
    )


if __name__ == "__main__":
    main()
