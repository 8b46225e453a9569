"""Are effects that a set cannot tell apart decided by the one or two exposures that are planned for them?

    python tests/studies/separating.py [NAME ...] [--minutes 40] [--noises 3] [--diagnosed 0] [--instruments 1]

For each scene a set is simulated with one effect, on so many instruments as they may be built: with `--instruments 5`
the six scenes are thirty classes, and take 50 minutes with one noise each. The class of a set is that effect and a
rival, if a fit of the rival has a χ² that is larger by less than 9; with `--diagnosed 1` it is the class that a
diagnosis of the set leaves. The exposures that separate its members are planned (`walop_jax/plans/separating.py`),
simulated with the same instrument and effect and new noise, and joined with the set; every member is fitted to both. A
class is decided when every rival has a χ² that is larger than that of the truth by more than 9. Printed are the
exposures, and for each rival the Δχ² that was expected and those that were found.
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
from walop_jax.calibration.calibration import Calibration  # noqa: E402
from walop_jax.data.merge import merge_calibration_sets  # noqa: E402
from walop_jax.data.records import CalibrationSet  # noqa: E402
from walop_jax.diagnosis.trust import examined  # noqa: E402
from walop_jax.fit.base_model import base_model  # noqa: E402
from walop_jax.fit.refit import FitResult, refit  # noqa: E402
from walop_jax.io.errors import DataError  # noqa: E402
from walop_jax.model.effects.in_models import with_effects  # noqa: E402
from walop_jax.plans.available import Available  # noqa: E402
from walop_jax.plans.plan import plan_exposures  # noqa: E402
from walop_jax.plans.separating import DECIDED, ClassOfRun, class_of_run  # noqa: E402
from walop_jax.simulation.observing_plan import ObservingPlan  # noqa: E402

SOUTH = ObservingPlan(
    "WALOP-SOUTH", grid=3, standard_grid=2, moon_patches=3, standards=0, unpolarised=0, throughput_degree=1
)
SCENES = {
    "axis of the second plate": ("hwp2_axis=0.006", "hwp2_crossing"),
    "zero of the polariser": ("clp_zero=0.01", "clp_wobble"),
    "crossing of the second plate": ("hwp2_crossing=0.01", "hwp2_axis"),
    "axis of the first plate": ("hwp1_axis=0.006", "hwp1_crossing"),
    "crossing of the first plate": ("hwp1_crossing=0.01", "hwp1_axis"),
    "wobble of the polariser": ("clp_wobble=amplitude:0.015,phase:0.5", "clp_zero"),
}
"""Effects, and rivals that they are easily mistaken for with the polariser over half a turn (docs: effects)."""


def fitted(calset: CalibrationSet, name: str) -> FitResult:
    """A fit of the base model with one effect."""
    return refit(calset, with_effects(base_model(calset, throughput_degree=1), [name], calset))


def class_of_set(name: str, calset: CalibrationSet, diagnosed: bool) -> ClassOfRun | None:
    """The class of the set of a scene; None where there is none, with a line that says why."""
    effect, rival = SCENES[name]
    if diagnosed:
        found = walop.diagnose(calset)
        try:
            return class_of_run(found, found.calibration())
        except DataError as error:
            print(f"{name}: {effect}: {found.verdict}; {error}", flush=True)
            return None
    truth = effect.split("=")[0]
    fits = {member: fitted(calset, member) for member in (truth, rival)}
    apart = fits[rival].expansion.objective - fits[truth].expansion.objective
    print(f"{name}: {effect}: Δχ² of {rival} in the set {apart:.1f}", flush=True)
    if apart > DECIDED:
        return None
    known = Calibration.from_fit(examined(fits[truth]))
    (there,) = known.model.instrument(known.values).effects
    return ClassOfRun((truth, rival), (there, rival), calset, known)


def scene(name: str, minutes: float, noises: int, diagnosed: bool, built: int) -> tuple[int, int, int] | None:
    """Of a scene on the instrument that is drawn with the seed `built`: joined sets that decide its class, and all.

    Third is the number of settings that are planned. None without a class.
    """
    effect, begin = SCENES[name][0], time.process_time()
    instrument = dataclasses.replace(walop.simulate(SOUTH, seed=built).truth, effects=())
    first = walop.simulate(SOUTH, seed=100 + built, instrument=instrument, effect=[effect]).calset
    given = class_of_set(name, first, diagnosed)
    if given is None:
        return None
    middle = time.process_time()
    planned = plan_exposures(Available(SOUTH, any_plate=True), minutes, separate=given)
    print(f"{middle - begin:.0f} s, plan {time.process_time() - middle:.0f} s of CPU\n{planned}", flush=True)
    expected = {(pair.truth, pair.rival): pair.after for pair in planned.pairs}
    truth = effect.split("=")[0]
    if truth not in given.names:
        print(f"{name}: the truth is not in the class: {', '.join(given.names)}", flush=True)
        return 0, noises, 0
    decided, more = 0, {member: [] for member in given.names if member != truth}
    for seed in range(noises):
        second = walop.simulate(
            planned.observing_plan, seed=201 + seed, instrument=instrument, effect=[effect]
        ).calset
        both = merge_calibration_sets(first, second)
        chi2 = {member: fitted(both, member).expansion.objective for member in given.names}
        for member, values in more.items():
            values.append(chi2[member] - chi2[truth])
        decided += min(values[-1] for values in more.values()) > DECIDED
    for member, values in more.items():
        told = ", ".join(f"{value:.1f}" for value in values)
        print(f"{name}: {member}: Δχ² expected {expected[truth, member]:.1f}, found {told}", flush=True)
    print(f"{name}: decided in {decided} of {noises}, by {len(planned.lines)} settings", flush=True)
    return decided, noises, len(planned.lines)


def main() -> None:
    """Print the study."""
    parser = options_of(__doc__, minutes=40.0, noises=3, diagnosed=0, instruments=1)
    parser.add_argument("names", nargs="*", help=f"of: {'; '.join(SCENES)} (default: all)")
    given = parser.parse_args()
    results = [
        scene(name, given.minutes, given.noises, bool(given.diagnosed), built)
        for built in range(1, given.instruments + 1)
        for name in given.names or SCENES
    ]
    classes = [result for result in results if result is not None]
    in_two = sum(d == n and settings <= 2 for d, n, settings in classes)
    print(
        f"{len(results)} scenes, {len(classes)} with a class; decided in {sum(d for d, _, _ in classes)} of "
        f"{sum(n for _, n, _ in classes)} joined sets, in all of them for {sum(d == n for d, n, _ in classes)} "
        f"classes, by at most two settings for {in_two}"
    )


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
