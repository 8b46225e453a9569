"""What `walop-jax diagnose` costs: CPU seconds, compiled programs and memory, nothing compiled before and once more.

    python tests/studies/diagnosis_cost.py [quiet] [encoder] [nameless] [poor] [--package FOLDER] [OUT.json]

quiet      8 × 8 field points with nothing hidden
encoder    12 × 12 points with an error of the polariser's encoder once per turn, 0.06°
nameless   8 × 8 points, every setting of the polariser off by an amount of its own, 0.03° rms: no name, no sentence
poor       the same with 0.2° rms: no model explains it, χ²/dof is about 10

The command runs in a process of its own with an empty cache of programs (cold), and again with what it left there
(warm). `--package` is the root of another checkout, for a comparison in the same hour on the same machine.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
SLIPS = {"nameless": 0.03, "poor": 0.2}  # deg, rms of the settings of the polariser

_CHILD = """
import json, resource, sys
import jax, jax.monitoring
seen = {}
def listen(event, duration, **_):
    count, seconds = seen.get(event, (0, 0.0))
    seen[event] = count + 1, seconds + duration
jax.monitoring.register_event_duration_secs_listener(listen)
from walop_jax.commands import main
sys.argv = ["walop-jax", "diagnose", sys.argv[1], "--output", sys.argv[2], "--quiet", "--overwrite"]
try:
    main()
except SystemExit:
    pass
finally:
    used = resource.getrusage(resource.RUSAGE_SELF)
    print(json.dumps({
        "cpu": used.ru_utime + used.ru_stime, "memory": used.ru_maxrss / 1e6,
        "programs": seen.get("/jax/core/compile/backend_compile_duration", (0, 0.0))[0],
        "compiling": seen.get("/jax/core/compile/backend_compile_duration", (0, 0.0))[1],
        "traced": seen.get("/jax/core/compile/jaxpr_trace_duration", (0, 0.0))[0],
    }))
"""


def write_set(case: str, path: Path) -> None:
    """A simulated set of a case."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from walop_jax.data.records import Position
    from walop_jax.data.write import write_calibration_set
    from walop_jax.model.effects import effect_by_name
    from walop_jax.model.effects.base import Context
    from walop_jax.simulation.observing_plan import ObservingPlan, polariser_turn
    from walop_jax.simulation.simulate import simulate

    if case == "encoder":
        wobble = effect_by_name("clp_wobble").of(Context(), amplitude=0.06, phase=1.1)
        simulated = simulate(ObservingPlan(), seed=1, effects=[wobble])
        write_calibration_set(path, simulated.calset)
        return
    plan = ObservingPlan(
        grid=8, standard_grid=4, polariser_angles=polariser_turn(12), moon_patches=6, standards=6
    )
    if case == "quiet":
        write_calibration_set(path, simulate(plan, seed=1).calset)
        return
    drawn = np.random.default_rng(5).normal(0.0, SLIPS[case], 12)
    angles = tuple(float(a) for a in np.array(polariser_turn(12)) + drawn)
    calset = simulate(dataclasses.replace(plan, polariser_angles=angles), seed=1).calset
    e = calset.exposures
    stated = e.clp_angle.copy()
    stated[e.clp_in] = 15.0 * np.round(e.clp_angle[e.clp_in] / 15.0)
    write_calibration_set(path, dataclasses.replace(calset, exposures=e.placed(CLP=Position.at(stated))))


def measured(calset: Path, folder: Path, package: Path) -> dict[str, object]:
    """The command, once."""
    environment = os.environ | {
        "PYTHONPATH": str(package), "WALOP_JAX_CACHE": str(folder / "cache"), "OMP_NUM_THREADS": "1",
    }  # fmt: skip
    output = folder / "run"
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [sys.executable, "-c", _CHILD, str(calset), str(output), "--overwrite"],
        env=environment, cwd=folder, capture_output=True, text=True, check=False,
    )  # fmt: skip
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        raise RuntimeError(done.stderr)
    found = json.loads(done.stdout.splitlines()[-1])
    found["cpu"] = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    said = json.loads((output / "diagnosis.json").read_text(encoding="utf-8"))
    found["verdict"] = said["verdict"]
    found["steps"] = [step["effect"] for step in said["steps"]]
    found["free form"] = (said["unexplained"] or {}).get("free_form", [])
    found["chi2"] = said["chi2_per_dof_before"], said["chi2_per_dof_after"]
    found["stages"] = done.stderr
    return found


def main() -> None:
    """Measure the cases asked for, one after the other."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", default=["quiet", "encoder", "nameless", "poor"])
    parser.add_argument("--package", type=Path, default=ROOT)
    parser.add_argument("--sets", type=Path, help="folder of sets made before, CASE.fits")
    options = parser.parse_args()
    output = next((Path(case) for case in options.cases if case.endswith(".json")), None)
    cases = [case for case in options.cases if not case.endswith(".json")]
    results: dict[str, dict[str, object]] = {}
    with tempfile.TemporaryDirectory() as name:
        for case in cases or ["quiet", "encoder", "nameless", "poor"]:
            folder = Path(name) / case
            (folder / "cache").mkdir(parents=True)
            calset = folder / f"{case}.fits"
            if options.sets is not None:
                calset = options.sets.resolve() / f"{case}.fits"
            else:
                write_set(case, calset)
            for state in ("cold", "warm"):
                found = measured(calset, folder, options.package.resolve())
                results[f"{case}, {state}"] = found
                print(f"{case}, {state}:", {k: v for k, v in found.items() if k != "stages"}, flush=True)
    if output is not None:
        output.write_text(json.dumps(results, indent=1, ensure_ascii=False), encoding="utf-8")


if __name__ == "__main__":
    main()
