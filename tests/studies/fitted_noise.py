"""Errors of the data that a fit finds: their pulls, and whether effects are found beside them as without.

    python tests/studies/fitted_noise.py [--sets 40] [--diagnosed 0]      (two minutes; one more for each diagnosed set)

Every set is a simulated small run with an as-built instrument and noise of its own. Its intensities get further noise,
so that their true errors are σ² = (1.3 N_ERR)² + (0.004 N)²; N_ERR stays as it is. The fit has one scale and one
fraction for all intensities (`walop.with_noise`). Asked are the pulls of both, (fitted − true) / error, and of all
other parameters; the same fits of the sets as they were simulated (scale 1, fraction 0) have to find nothing.

With `--diagnosed` an effect is hidden in so many further sets; a diagnosis that starts with the noise terms, of the set
with the further noise, is held against one of the set as simulated that starts with the base model.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

import jax
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from small_run import SMALL  # noqa: E402
from study_options import options_of  # noqa: E402

from walop_jax.data.records import CalibrationSet  # noqa: E402
from walop_jax.data.table_intensities import TableIntensities  # noqa: E402
from walop_jax.diagnosis.findings import Diagnosis  # noqa: E402
from walop_jax.diagnosis.workflow import diagnose  # noqa: E402
from walop_jax.fit.base_model import base_model  # noqa: E402
from walop_jax.fit.refit import FitResult, fit  # noqa: E402
from walop_jax.likelihood.likelihood import Likelihood  # noqa: E402
from walop_jax.model.effects.in_models import effect_context  # noqa: E402
from walop_jax.model.noise import with_noise  # noqa: E402
from walop_jax.model.specification import Model  # noqa: E402
from walop_jax.simulation.simulate import effect_from_text, simulate, truth_values  # noqa: E402

SCALE, FRACTION = 1.3, 0.004
HIDDEN = (
    "lens_birefringence=0.02", "camera_leakage=0.02", "ghost=0.03", "clp_wobble=amplitude:1.0", "hwp1_crossing=2.0",
    "nonlinearity=0.05", "upstream_retarder=delta:0.1,axis:20.0", "camera_gain_drift=rate:0.02,camera:1",
)  # fmt: skip


def noisier(calset: CalibrationSet, rng: np.random.Generator) -> CalibrationSet:
    """The set with noise added to its intensities, of which the stated errors know nothing."""
    table = calset.intensities
    assert isinstance(table, TableIntensities)
    further = np.sqrt((SCALE**2 - 1.0) * table.sigma**2 + (FRACTION * table.counts) ** 2)
    counts = table.counts + further * rng.standard_normal(table.counts.shape)
    return dataclasses.replace(calset, intensities=dataclasses.replace(table, counts=counts))


def with_both(calset: CalibrationSet) -> Model:
    """The base model with a scale and a fraction for all intensities."""
    return with_noise(base_model(calset), scale="all", fraction="all")


def pulls(result: FitResult, truth: dict[str, float]) -> dict[str, float]:
    """(Fitted − true) / error of every free parameter with a known true value."""
    at = {result.model.names[i]: i for i in result.model.free}
    found = {n: (result.values[i] - truth[n]) / result.sigma[i] for n, i in at.items() if n in truth}
    return {name: float(value) for name, value in found.items() if np.isfinite(value)}


def spread(values: Iterable[float]) -> str:
    """Mean and standard deviation, each with its own error."""
    x = np.asarray(list(values))
    n = max(len(x), 2)
    mean, rms = x.mean(), np.sqrt(np.mean(x**2))
    return f"mean {mean:+.2f} ± {x.std() / np.sqrt(n):.2f}, rms {rms:.2f} ± {1 / np.sqrt(2 * n):.2f}"


def fitted_errors(count: int) -> None:
    """Print the pulls over so many sets, with further noise and as simulated."""
    of: dict[str, list[float]] = {"scale": [], "fraction": [], "others": [], "sound: scale": []}
    sound = list[float]()
    for number in range(count):
        one = simulate(SMALL, seed=5000 + number)
        truth = truth_values(one.truth)
        loud = noisier(one.calset, np.random.default_rng([7, number]))
        result = fit(Likelihood.of(loud, with_both(loud)))
        for name, true in (("scale", SCALE), ("fraction", FRACTION)):
            value, error = result.value(f"noise.{name}")
            of[name].append((value - true) / error)
        of["others"] += pulls(result, truth).values()
        quiet = fit(Likelihood.of(one.calset, with_both(one.calset)))
        value, error = quiet.value("noise.scale")
        of["sound: scale"].append((value - 1.0) / error)
        sound.append(abs(quiet.value("noise.fraction")[0]))
    for name, values in of.items():
        print(f"pulls of {name} ({len(values)}): {spread(values)}")
    print(f"sound: fraction {np.median(sound):.1e} (median), {max(sound):.1e} at most")


def names_of(diagnosis: Diagnosis) -> Sequence[str]:
    """What was found."""
    return [diagnosis.verdict, *(step.effect for step in diagnosis.steps)]


def effects_found(count: int) -> None:
    """Print what is found of a hidden effect without further noise, and beside fitted errors with it."""
    sound = simulate(SMALL, seed=6000).calset
    context = effect_context(base_model(sound).template, sound.exposures)
    for number, text in enumerate(HIDDEN[:count]):
        calset = simulate(SMALL, seed=6000 + number, effects=[effect_from_text(text, context)]).calset
        loud = noisier(calset, np.random.default_rng([8, number]))
        plain, beside = diagnose(calset), diagnose(loud, with_both(loud))
        values = [beside.after.value(f"noise.{name}")[0] for name in ("scale", "fraction")]
        print(
            f"{text}: {names_of(plain)} | {names_of(beside)}, scale {values[0]:.2f}, fraction {values[1]:.4f}",
            flush=True,
        )


def main() -> None:
    """Print both tables."""
    options = options_of(__doc__, sets=40, diagnosed=0).parse_args()
    jax.config.update("jax_enable_x64", True)
    fitted_errors(options.sets)
    effects_found(options.diagnosed)


if __name__ == "__main__":
    main()
