"""Whether the limits of `walop-jax limits` hold: the amplitudes that are found and named, and the protection level.

    python tests/studies/limits_hold.py [--draws 2000] [--named 300] [--instruments 8] [--first 0] [OUT.json]

Twenty minutes.

found    Scores are drawn with each effect at 0.9, 1 and 1.1 times the amplitude that the limits say is found with
         99 %, all sentences competing: the amplitude at which 99 % of the draws raise the alarm, over the predicted.
named    The same for the amplitude that is named alone: the amplitude estimated from the draw, with its own separation
         from every other effect.
sets     Whole data sets with and without an effect at 0.98 of the amplitude that is just found, fitted without it,
         the noise the same: the largest difference that it makes to q and u, over the protection level, at every point.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import numpy as np
from scipy import stats

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from matrix_at import matrix_at  # noqa: E402
from score_draws import alarms, noise_scores  # noqa: E402
from study_options import options_of  # noqa: E402

from walop_jax.calibration.accuracy import change_of_qu  # noqa: E402
from walop_jax.data.records import CalibrationSet  # noqa: E402
from walop_jax.diagnosis import grammar, thresholds  # noqa: E402
from walop_jax.diagnosis.detection_limits import (  # noqa: E402
    _columns,
    detection_limits,
)
from walop_jax.diagnosis.examination import Examination, examine  # noqa: E402
from walop_jax.diagnosis.hypotheses import Hypotheses, Probe, probes  # noqa: E402
from walop_jax.diagnosis.score import ScoreSpace, local_p, separations  # noqa: E402
from walop_jax.fit.refit import FitResult, refit  # noqa: E402
from walop_jax.model.effects import EFFECTS  # noqa: E402
from walop_jax.model.effects.in_models import effect_context  # noqa: E402
from walop_jax.model.instrument import Instrument  # noqa: E402
from walop_jax.simulation.observing_plan import ObservingPlan, polariser_turn  # noqa: E402
from walop_jax.simulation.simulate import simulate  # noqa: E402

PLAN = ObservingPlan(
    grid=6, standard_grid=2, polariser_angles=polariser_turn(12), moon_patches=4, standards=4
)
TRIED = (0.9, 1.0, 1.1)
BELOW = 0.98


def one_shape_each(examination: Examination) -> Iterator[Probe]:
    """A probe of every effect that the data can show."""
    alive, places, seen = examination.space.alive, examination.space.places(), set()
    for probe in examination.probes:
        if probe.effect.name not in seen and alive[places[probe.name]].any():
            seen.add(probe.effect.name)
            yield probe


def rivals_of(names: Examination) -> ScoreSpace:
    """The space of all effects, without the nuisance of single exposures."""
    return names.bare.subset([probe.name for probe in names.probes])


def amplitude_at(rate: Callable[[float], float], predicted: float) -> float:
    """The amplitude with a rate of `thresholds.PROBABILITY`, over the predicted one: interpolated probits."""
    rates = np.clip([rate(share * predicted) for share in TRIED], 1e-4, 1 - 1e-4)
    slope, level = np.polyfit(TRIED, stats.norm.ppf(rates), 1)
    return float((stats.norm.ppf(thresholds.PROBABILITY) - level) / slope)


def scores(result: FitResult, draws: int, named: int) -> dict[str, dict[str, float]]:
    """Simulated over predicted amplitudes, found and named, of every effect."""
    template, calset = result.model.template, result.calset
    context = effect_context(template, calset.exposures)
    every = list(probes(EFFECTS, context))
    said = grammar.descriptions(template, calset.exposures, len(calset.points))
    said = grammar.beside_names(said, EFFECTS, context, template)[0]
    names = examine(result, Hypotheses(every), np.random.default_rng(0))
    whole = examine(result, Hypotheses(every, said), np.random.default_rng(0))
    p = local_p(thresholds.ALARM, whole.table.trials)
    space, full, rng = whole.space, whole.bare, np.random.default_rng(1)
    noise, threshold = noise_scores(space, rng, draws), np.log(p)
    noise_in_full = noise_scores(full, rng, named)
    places = full.places()
    found: dict[str, dict[str, float]] = {}
    for probe in one_shape_each(names):
        limit, at = _columns(names, rivals_of(names), probe, p)[0], places[probe.name]
        place = at.start + limit.number

        def detected(amplitude: float, place: int = place) -> float:
            return alarms(space, noise + amplitude * space.gram[:, place], threshold)

        def told_alone(amplitude: float, place: int = place, at: slice = at, probe: Probe = probe) -> float:
            inverse = np.linalg.pinv(full.gram[at, at], rcond=1e-8, hermitian=True)
            alone = 0
            for drawn in noise_in_full + amplitude * full.gram[:, place]:
                estimate = inverse @ drawn[at]
                square = float(estimate @ full.gram[at, at] @ estimate)
                apart = names.nearest(separations(full, full.gram[:, at] @ estimate, square))
                del apart[probe.effect.name]
                alone += min(apart.values()) > thresholds.SEPARATION
            return alone / len(noise_in_full)

        found[probe.effect.name] = {"found": amplitude_at(detected, limit.detected)}
        if named and np.isfinite(limit.named) and limit.named > 1.001 * limit.detected:
            found[probe.effect.name]["named"] = amplitude_at(told_alone, limit.named)
        print(probe.effect.name, found[probe.effect.name], flush=True)
    return found


def matrices_of(instrument: Instrument, calset: CalibrationSet) -> np.ndarray:
    """Rows q, u of the instrument matrix at all field points."""
    return matrix_at(instrument, calset).reshape(-1, 2, 3)


def sets(seed: int, most: int) -> Iterator[tuple[str, float]]:
    """Effects just below detection in sets of one instrument: the largest error over the protection level."""
    reference = refit(simulate(PLAN, seed=seed).calset)
    truth = reference.model.instrument(reference.values)
    limits = detection_limits(reference)
    calset = reference.calset
    listed = grammar.hypotheses(EFFECTS, reference.model.template, calset.exposures, len(calset.points))
    names = examine(reference, listed, np.random.default_rng(0))
    rivals, p = rivals_of(names), local_p(thresholds.ALARM, names.table.trials)
    without = refit(simulate(PLAN, seed=seed, instrument=truth).calset)
    start = matrices_of(without.model.instrument(without.values), calset)
    bare = matrices_of(truth, calset)
    for probe in list(one_shape_each(names))[:most]:
        limit = _columns(names, rivals, probe, p)[0]
        step = np.zeros(len(probe.widths))
        # Beyond the width of its prior an effect is not plausible: the protection level ends there.
        step[limit.number] = BELOW * min(limit.detected, float(probe.widths[limit.number]))
        effect = probe.effect.combine(probe.group, step)
        result = refit(simulate(PLAN, seed=seed, instrument=truth, effects=(effect,)).calset)
        assumed = matrices_of(result.model.instrument(result.values), calset) - start
        true = matrices_of(dataclasses.replace(truth, effects=(effect,)), calset) - bare
        error = change_of_qu(bare, bare + (assumed - true))
        known = np.isfinite(error) & np.isfinite(limits.protection)
        yield probe.effect.name, float(np.max(error[known] / limits.protection[known]))


def main() -> None:
    """Print the numbers of the study, and write them where a file is named."""
    parser = options_of(__doc__, draws=2000, named=300, instruments=8, first=0, effects=99)
    parser.add_argument("output", nargs="?", type=Path)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    found = {}
    if options.draws:
        found["scores"] = scores(refit(simulate(PLAN, seed=11).calset), options.draws, options.named)
    shares = []
    for seed in range(options.first, options.first + options.instruments):
        for name, share in sets(seed, options.effects):
            shares.append((seed, name, share))
            print(seed, name, f"{share:.3f}", flush=True)
    if shares:
        found["protection"] = shares
        print(f"the protection level held in {sum(s <= 1.0 for *_, s in shares)} of {len(shares)} sets")
    if options.output is not None:
        options.output.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
