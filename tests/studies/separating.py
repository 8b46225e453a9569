"""Is a class that a diagnosis leaves decided by the one or two exposures that are planned for it?

    python tests/studies/separating.py [NAME ...] [--minutes 10] [--noises 3]

For each scene a set is simulated with one effect, and diagnosed. Where that leaves a class, the exposures that separate
it are planned from the run (`walop.plan(separate=...)`), simulated with the same instrument and effect and new noise,
and joined with the set; every member is fitted to both. A class is decided when the truth stays and every rival has a
χ² that is larger by more than 9. Printed are the exposures, and for each rival the Δχ² that was expected and those that
were found.
"""

from __future__ import annotations

import dataclasses
import sys
import time
from pathlib import Path

import jax

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from study_options import options_of  # noqa: E402

import walop_jax as walop  # noqa: E402
from walop_jax.data.merge import merge_calibration_sets  # noqa: E402
from walop_jax.fit.base_model import base_model  # noqa: E402
from walop_jax.fit.refit import refit  # noqa: E402
from walop_jax.io.errors import DataError  # noqa: E402
from walop_jax.model.specification import with_effects  # noqa: E402
from walop_jax.plans.separating import DECIDED  # noqa: E402
from walop_jax.simulation.observing_plan import ObservingPlan  # noqa: E402

SOUTH = ObservingPlan("WALOP-SOUTH", grid=6, standard_grid=3)
SCENES = {
    "axis of the second plate": "hwp2_axis=0.003",
    "zero of the polariser": "clp_zero=0.007",
    "axis of the first plate": "hwp1_axis=0.003",
    "crossing of the second plate": "hwp2_crossing=0.005",
    "crossing of the first plate": "hwp1_crossing=0.005",
    "wobble of the polariser": "clp_wobble=amplitude:0.01,phase:0.5",
}
"""Effects that are easily mistaken for others in a usual set, of the polariser over half a turn (docs: effects)."""


def scene(name: str, minutes: float, noises: int) -> tuple[int, int] | None:
    """Numbers of joined sets that decide the class of a scene, and of all; None without a class."""
    effect = SCENES[name]
    instrument = dataclasses.replace(walop.simulate(SOUTH, seed=1).truth, effects=())
    first = walop.simulate(SOUTH, seed=101, instrument=instrument, effect=[effect]).calset
    begin = time.process_time()
    found = walop.diagnose(first)
    for step in found.steps:
        print(f"{name}: {effect}: {step.effect}, class: {', '.join(step.equivalent) or 'none'}", flush=True)
    middle = time.process_time()
    try:
        planned = walop.plan(separate=found, minutes=minutes)
    except (DataError, ValueError) as error:
        print(f"{name}: {effect}: {found.verdict}; no plan: {error}; {middle - begin:.0f} s", flush=True)
        return None
    print(
        f"diagnosis {middle - begin:.0f} s, plan {time.process_time() - middle:.0f} s of CPU\n{planned}",
        flush=True,
    )
    expected = {(pair.truth, pair.rival): pair.after for pair in planned.pairs}
    members, truth = list(dict.fromkeys(pair.truth for pair in planned.pairs)), effect.split("=")[0]
    if truth not in members:
        print(f"{name}: the truth is not in the class: {', '.join(members)}", flush=True)
        return 0, noises
    decided, more = 0, {member: [] for member in members if member != truth}
    for seed in range(noises):
        second = walop.simulate(
            planned.observing_plan, seed=201 + seed, instrument=instrument, effect=[effect]
        ).calset
        both = merge_calibration_sets(first, second)
        base = base_model(both)
        chi2 = {
            member: refit(both, with_effects(base, [member], both)).expansion.objective for member in members
        }
        for member, values in more.items():
            values.append(chi2[member] - chi2[truth])
        decided += min(values[-1] for values in more.values()) > DECIDED
    for member, values in more.items():
        found_values = ", ".join(f"{value:.1f}" for value in values)
        print(
            f"{name}: {member}: Δχ² expected {expected[truth, member]:.1f}, found {found_values}", flush=True
        )
    print(f"{name}: decided in {decided} of {noises}", flush=True)
    return decided, noises


def main() -> None:
    """Print the study."""
    parser = options_of(__doc__, minutes=10.0, noises=3)
    parser.add_argument("names", nargs="*", help=f"of: {'; '.join(SCENES)} (default: all)")
    given = parser.parse_args()
    results = [scene(name, given.minutes, given.noises) for name in given.names or SCENES]
    classes = [result for result in results if result is not None]
    print(
        f"{len(results)} scenes, {len(classes)} with a class that can be planned for; decided in "
        f"{sum(d for d, _ in classes)} of {sum(n for _, n in classes)} joined sets, in all of them for "
        f"{sum(d == n for d, n in classes)} classes"
    )


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
