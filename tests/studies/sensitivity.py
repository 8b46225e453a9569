"""How much depends on the numbers of the search: each is halved and doubled, on scenes that made none.

    python tests/studies/benchmark/generate.py NEW --seed 3 --new
    python tests/studies/sensitivity.py NEW --seed 3 [--each 1] [--quiet 12] [--pairs 12] [--every 1]     (an hour)

The scenes are those of `ablation.py`, judged by linear steps. For each number the table has the scenes whose additions
or verdict change, and those that are better and worse with the number as it is: right or in its class before open
before wrong. With `--every 4` a fourth of the scenes is taken.
"""

from __future__ import annotations

import sys
from pathlib import Path
from unittest.mock import patch

import jax

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [
    str(ROOT),
    *(str(ROOT / "tests" / p) for p in (".", "diagnosis", "studies", "studies/benchmark")),
]

from ablation import WORTH, Scenes  # noqa: E402
from study_options import options_of  # noqa: E402

from walop_jax.diagnosis import thresholds  # noqa: E402

FACTORS = 0.5, 2.0
NUMBERS = (
    "COMMON_MODE", "EVEN_ODDS", "IMPROBABLE", "SEPARATION", "LEAST_EVIDENCE", "LEAST_SHARE_OF_NAME",
    "POOR_FIT", "FLOOR", "GOOD_SHARE", "PART", "ALARM", "MOST_SENTENCES", "MOST_TOGETHER", "MOST_LEADERS", "MOST_STEPS",
    "WITHIN", "LINEAR_GOOD", "LINEAR_BELOW", "LINEAR_SHARE", "MOST_FITTED", "MOST_PATTERNS", "MOST_CLASSES",
)  # fmt: skip
"""Those that searches by linear steps reach."""


def changed(scenes: Scenes, name: str, factor: float) -> tuple[int, int, int]:
    """Scenes with another answer, better and worse ones with the number as it is."""
    value = getattr(thresholds, name)
    counts = [0, 0, 0]
    replaced = type(value)(max(value * factor, 1)) if isinstance(value, int) else value * factor
    with patch.object(thresholds, name, replaced):
        for number, before in scenes.as_they_are.items():
            now = scenes.judged(number)
            gain = WORTH[before["outcome"]] - WORTH[now["outcome"]]
            counts[0] += any(now[key] != before[key] for key in ("kind", "added"))
            counts[1] += gain > 0
            counts[2] += gain < 0
    return counts[0], counts[1], counts[2]


def main() -> None:
    """Print the table."""
    parser = options_of(__doc__, each=1, quiet=12, pairs=12, seed=3, every=1)
    parser.add_argument("folder", type=Path)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    scenes = Scenes(options.folder, options.seed, options.each, options.quiet, options.pairs)
    scenes.as_they_are = {
        number: scenes.judged(number) for number in list(scenes.truth)[:: options.every]
    }
    print(
        f"| number | half of it, of {len(scenes.as_they_are)} scenes: changed; better; worse with it | twice |"
    )
    print("| --- | --- | --- |")
    for name in NUMBERS:
        cells = ["; ".join(map(str, changed(scenes, name, factor))) for factor in FACTORS]
        print(f"| `thresholds.{name}` | {cells[0]} | {cells[1]} |", flush=True)


if __name__ == "__main__":
    main()
