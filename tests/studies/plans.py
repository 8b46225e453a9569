"""Do plans keep their promises, for instruments as built, and how do they compare with usual procedures?

    python tests/studies/plans.py [errors] [built] [beside] [naming] [diagnosed]

errors   20 sets each of the best plan of 20 minutes and of usual ones, of 20 instruments drawn from the priors, with
         noise and standards of its own: the errors of p that a fit makes against those promised. The
         fits are linear, from the truth; one full fit says how far that is from the real one.
built    200 instruments as they might be built: what the plan that was made for 20 others is worth in each, beside what
         no plan for that one alone can undercut.
beside   time to 0.1 % on 95 % of the field, for South, North and an instrument of a user's own as they may be built:
         usual procedures, and the best weights for the worst point.
naming   pairs of effects that a standard plan cannot tell apart, simulated with one of them: how often the exposures
         proposed name it at the time promised.
diagnosed a run from end to end: a set is diagnosed, the exposures that tell apart what is left as a class are planned
         from that run, taken, and diagnosed together with the set.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import sys
import tempfile
from importlib import resources
from pathlib import Path

import jax
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from changed_sets import block_of, with_block  # noqa: E402
from study_options import options_of  # noqa: E402

import walop_jax as walop  # noqa: E402
from walop_jax.data.records import CalibrationSet  # noqa: E402
from walop_jax.diagnosis import thresholds  # noqa: E402
from walop_jax.diagnosis.exact import try_effect  # noqa: E402
from walop_jax.fit.base_model import base_model  # noqa: E402
from walop_jax.fit.refit import refit  # noqa: E402
from walop_jax.likelihood.likelihood import Likelihood  # noqa: E402
from walop_jax.model.cameras import with_noise_floor  # noqa: E402
from walop_jax.model.effects.in_models import effect_context  # noqa: E402
from walop_jax.plans.available import Available  # noqa: E402
from walop_jax.plans.criteria import NAMED, criterion_by_name, field_errors  # noqa: E402
from walop_jax.plans.exposures import Candidates, Polarised, candidates  # noqa: E402
from walop_jax.plans.optimal import Experiment, Key, Listed, least_budget, optimise  # noqa: E402
from walop_jax.plans.plan import (  # noqa: E402
    covariance,
    experiment_of,
    largest_variance,
    plan_from,
    usual_plans,
)
from walop_jax.simulation.observing_plan import ObservingPlan, Stop  # noqa: E402
from walop_jax.simulation.simulate import effect_from_text, simulate, truth_values  # noqa: E402

MINUTES, INSTRUMENTS, EACH, BUILT, GOAL, FIELD = 20.0, 20, 1, 200, 0.1, 0.95
SOUTH = ObservingPlan("WALOP-SOUTH", grid=6, standard_grid=3)
PAIRS = (
    ("hwp2_axis=0.0022", "hwp2_crossing=0.002"),
    ("hwp2_crossing=0.0036", "hwp2_axis=0.002"),
    ("clp_zero=0.005", "clp_wobble=amplitude:0.005,phase:0.5"),
    ("clp_wobble=amplitude:0.007,phase:0.5", "clp_zero=0.005"),
    ("hwp1_axis=0.0022", "hwp1_crossing=0.002"),
    ("hwp1_crossing=0.0036", "hwp1_axis=0.002"),
)
"""Effects, of sizes that a standard plan finds at some 6 σ, and rivals that it cannot tell from them, with where their
fit begins."""
OWN = (
    ("WALOP-SOUTH", "OWN"),
    ("2407.0, sigma = 1.0", "200.0, sigma = 0.3"),
    ("1930.0, sigma = 1.0", "180.5, sigma = 0.3"),
    ("edge = 0.29", "edge = 0.12"),
    ("value = 15.63", "value = 8.0"),
    ("default = true\n", ""),
)
"""From WALOP-South to what somebody else might have: plates of zero order, a field of 14', a slower pupil."""


def own() -> str:
    """The description file of the instrument of a user's own."""
    text = (resources.files("walop_jax.instruments") / "WALOP-SOUTH.toml").read_text(encoding="utf-8")
    for old, new in OWN:
        text = text.replace(old, new)
    path = Path(tempfile.mkdtemp()) / "own.toml"
    path.write_text(text)
    return str(path)


def stops_of(found: Candidates, weights: dict[Key, float]) -> tuple[Stop, ...]:
    """Weights as exposures."""
    return tuple(
        dataclasses.replace(found.choices[i].stops[k], times=max(round(w), 1))
        for (i, k), w in weights.items()
    )


def linear_fit(
    plan: ObservingPlan, found: Candidates, draw: int, seed: int
) -> tuple[dict[str, float], float]:
    """By how much the first step of a fit from the truth is wrong; by how many σ a full fit differs from it."""
    instrument = found.model.instrument(found.values[draw])
    simulated = simulate(plan, seed=seed, instrument=instrument, steady=True)
    calset = scattered(simulated.calset, instrument.cameras.noise_floor, seed)
    model = base_model(calset, plan.design, throughput_degree=plan.throughput_degree)
    truth = truth_values(simulated.truth)
    values = np.array([truth[name] for name in model.names])
    there = Likelihood.of(calset, model).expand(values)
    size = np.sqrt(np.diag(there.matrix))
    inverse = np.linalg.pinv(there.matrix / np.outer(size, size), rcond=1e-13, hermitian=True)
    step = -(inverse @ (there.gradient / size)) / size
    apart = 0.0
    if seed == 0:
        fit = refit(calset, model)
        sigma = np.sqrt(np.diag(inverse)) / size
        apart = float(np.max(np.abs((fit.values - values)[list(model.free)] - step) / sigma))
    return {model.names[i]: s for i, s in zip(model.free, step, strict=True)}, apart


def scattered(calset: CalibrationSet, floor: float, seed: int) -> CalibrationSet:
    """A set that scatters as a fit takes it to, where errors have a floor: what the model lacks is no photon noise."""
    if floor == 0.0:
        return calset
    block = block_of(calset)
    more = np.sqrt(with_noise_floor(block.sigma, block.counts, floor) ** 2 - block.sigma**2)
    counts = block.counts + more * np.random.default_rng([seed, 1]).normal(size=block.counts.shape)
    return with_block(calset, counts=counts)


def errors() -> None:
    """Promised errors of p against those of simulated runs."""
    for instrument in ("WALOP-SOUTH", "WALOP-NORTH", own()):
        errors_of(described(instrument))


def errors_of(available: Available) -> None:
    """The same for one instrument."""
    found = candidates(available, draws=INSTRUMENTS)
    field = field_errors(found)
    criterion = criterion_by_name(found, field, "worst")
    best = plan_from(found, MINUTES, criterion, field)
    experiment = experiment_of(found, MINUTES, criterion)
    plans = {"best plan": (best.observing_plan, best.after)}
    for name, weights in usual_plans(found):
        whole = experiment.total({key: max(round(w), 1) for key, w in weights.items()})
        taken = dataclasses.replace(
            found.available.plan, stops=stops_of(found, weights), patches=(), stars=()
        )
        plans[name] = (taken, field.error(covariance(experiment.known + whole)))
    seen = field.seen
    for name, (plan, promised) in plans.items():
        square, apart = np.zeros((EACH, INSTRUMENTS, int(seen.sum()))), 0.0
        for run, draw in np.ndindex(EACH, INSTRUMENTS):
            step, far = linear_fit(plan, found, draw, INSTRUMENTS * run + draw)
            change = field.slopes[draw] @ np.array([step.get(parameter, 0.0) for parameter in found.names])
            square[run, draw] = np.einsum("pi,pij,pj->p", change, field.forms[draw], change)[seen]
            apart = max(apart, far)
        of_each = (square / promised[:, seen] ** 2).mean(axis=2).ravel()
        ratio, scatter = np.sqrt(of_each.mean()), of_each.std() / np.sqrt(of_each.size)
        print(
            f"{found.available.plan.name}, {name}: error of p over that promised, {of_each.size} runs: {ratio:.3f} "
            f"± {0.5 * scatter / ratio:.3f}; "
            f"full fit and linear step differ by {apart:.3f} σ at most",
            flush=True,
        )


def built() -> None:
    """Efficiency of one plan in instruments as built."""
    found = candidates(Available(SOUTH))
    field = field_errors(found)
    best = plan_from(found, MINUTES, criterion_by_name(found, field, "worst"), field)
    taken = [(line, choice_of(found, line)) for line in best.lines]
    efficiency: list[float] = []
    for seed in range(1, 1 + BUILT // len(found.values)):
        other = candidates(Available(SOUTH), seed=seed)
        criterion = criterion_by_name(other, field_errors(other), "worst")
        whole = experiment_of(other, MINUTES, criterion)
        total = whole.total({key: float(line.times) for line, key in taken})
        for draw in range(len(other.values)):
            alone = one_draw(whole, draw)
            least = optimise(alone).bound
            efficiency.append(least / largest_variance(alone, alone.known + total[draw : draw + 1]))
        print(f"{len(efficiency)} instruments: {quantiles(np.array(efficiency))}", flush=True)


def quantiles(values: np.ndarray) -> str:
    """What is said of efficiencies."""
    return (
        f"efficiency at least {values.min():.3f}, 5 % below {np.quantile(values, 0.05):.3f}, median "
        f"{np.median(values):.3f}; {100 * np.mean(values >= 0.9):.0f} % at 0.9 or more"
    )


def choice_of(found: Candidates, line) -> Key:
    """The candidate of a line of a plan."""
    for i, choice in enumerate(found.choices):
        if (choice.kind, choice.filter, choice.seconds) != (line.kind, line.filter, line.exptime):
            continue
        if choice.positions != line.positions:
            continue
        if line.kind == "clp":
            return i, choice.number(line.polariser_angle)
        return i, [stop.number for stop in choice.stops].index(line.number)
    raise LookupError(line)


def one_draw(experiment: Experiment, draw: int) -> Experiment:
    """The problem of one instrument."""
    pick = slice(draw, draw + 1)
    families = tuple(
        dataclasses.replace(f, counts=f.counts[pick], kept={})
        if isinstance(f, Polarised)
        else dataclasses.replace(f, matrices=f.matrices[pick])
        for f in experiment.families
        if isinstance(f, Polarised | Listed)
    )
    return dataclasses.replace(
        experiment, known=experiment.known[pick], targets=experiment.targets[pick], families=families
    )


def minutes_to_goal(experiment: Experiment, whole: np.ndarray, cost: float) -> float:
    """Minutes until GOAL holds at FIELD of the targets, the exposures of a plan in their proportions."""
    low, high = 1e-3, 1e5
    while high / low > 1.001:
        middle = np.sqrt(low * high)
        c = covariance(experiment.known + 60 * middle / cost * whole)
        a = experiment.targets
        phi = np.einsum("rknq,rnm,rkmq->rk", a, c, a, optimize=True)[0]
        low, high = (low, middle) if np.mean(phi <= GOAL**2) >= FIELD else (middle, high)
    return float(high)


def beside() -> None:
    """Time to 0.1 % on 95 % of the field, the exposures of each plan in their proportions."""
    for instrument in ("WALOP-SOUTH", "WALOP-NORTH", own()):
        found = candidates(described(instrument), draws=1)
        field = field_errors(found)
        alone = experiment_of(found, MINUTES, criterion_by_name(found, field, "worst"))
        plans = {"best weights for the worst point": optimise(alone).weights, **dict(usual_plans(found))}
        for name, weights in plans.items():
            minutes = minutes_to_goal(alone, alone.total(weights), alone.cost(weights))
            print(f"{found.available.plan.name}, {name}: {minutes:.3g} min", flush=True)


def described(instrument: str) -> Available:
    """An instrument by name or file, its plate out or at any angle."""
    plan = (
        Path(tempfile.mkdtemp() if not Path(instrument).exists() else Path(instrument).parent) / "plan.toml"
    )
    name = Path(instrument).name
    plan.write_text(f'instrument = "{name}"\ngrid = 6\nstandard_grid = 3\nplate = ["out", "any"]\n')
    return Available.of(plan)


def naming() -> None:
    """How often the exposures proposed name an effect at the time promised."""
    available = Available(dataclasses.replace(SOUTH, plate=(None, 22.5)))
    for pair in PAIRS:
        found = candidates(available, draws=1, effects=(pair[0], pair[1].split("=")[0]))
        criterion = criterion_by_name(found, None, "apart")
        experiment = experiment_of(found, MINUTES, criterion)
        standard = dict(usual_plans(found))["even angles"]
        standard |= {
            (i, place): 1.0
            for i, choice in enumerate(found.choices)
            if choice.kind != "clp" and choice.positions["CHWP"] is None
            for place in range(len(choice.stops))
        }
        before = experiment.total(standard)
        start = dataclasses.replace(experiment, known=experiment.known + before)
        at_first = criterion.reported(largest_variance(start, start.known))
        cheapest, _ = least_budget(start, criterion.variance(NAMED))
        needed = start.cost(cheapest.weights) / 60
        minutes, plan = needed, None
        had = dataclasses.replace(
            available.plan, stops=stops_of(found, standard), patches=(), stars=()
        ).exposures()
        while plan is None or plan.value < NAMED:
            minutes = 1.25 * minutes + 0.2
            with contextlib.suppress(ValueError):  # too little for a single exposure
                plan = plan_from(found, minutes, criterion, known=before_of(found, standard), had=(had,))
        names = [named(found, standard, plan.observing_plan, pair, seed) for seed in range(2 * INSTRUMENTS)]
        print(
            f"{pair[0]} against {pair[1]}: standard plan {at_first:.2f} σ apart; {NAMED:.2g} σ after {needed:.2f} min, "
            f"in whole exposures with changes {minutes:.2f} min ({plan.value:.1f} σ); "
            f"named in {sum(names)} of {len(names)}",
            flush=True,
        )


def before_of(found: Candidates, standard: dict[Key, float]) -> np.ndarray:
    """The information of a standard plan on all parameters of the candidates, in the first draw."""
    return np.asarray(sum(w * found.families[i].information([k])[0, 0] for (i, k), w in standard.items()))


def named(found: Candidates, standard, plan: ObservingPlan, pair: tuple[str, str], seed: int) -> bool:
    """Whether a diagnosis of the standard and the new exposures would call the rival improbable beside the truth."""
    whole = dataclasses.replace(plan, stops=stops_of(found, standard) + plan.stops)
    truth = dataclasses.replace(found.model.instrument(found.values[0]), effects=())
    context = effect_context(found.model.template, whole.exposures())
    effects = [effect_from_text(text, context) for text in pair]
    simulated = simulate(whole, seed=seed, instrument=truth, effects=effects[:1], steady=True)
    base = refit(
        simulated.calset,
        base_model(simulated.calset, whole.design, throughput_degree=whole.throughput_degree),
    )
    own, rival = (try_effect(base, effect).evidence for effect in effects)
    return bool(own - rival > thresholds.IMPROBABLE)


def diagnosed() -> None:
    """From a class of effects to one name."""
    (text, _), seed = PAIRS[0], 1
    text = text.replace("0.0022", "0.003")
    folder = Path(tempfile.mkdtemp())
    sets, runs = [folder / "first.fits", folder / "second.fits"], [folder / "FIRST", folder / "BOTH"]
    truth = dataclasses.replace(walop.simulate(SOUTH, seed=seed).truth, effects=())
    plan = SOUTH
    for count, run in enumerate(runs):
        # The seed is that of the standards as well.
        taken, _ = walop.simulate(plan, seed=seed + 100, instrument=truth, effect=[text])
        walop.write_calibration_set(sets[count], taken)
        walop.diagnose(sets[: count + 1], output=run)
        for step in json.loads((run / "diagnosis.json").read_text())["steps"]:
            print(
                f"{text}: {step['effect']}, equivalent: {', '.join(step['equivalent']) or 'none'}", flush=True
            )
        if not count:
            found = walop.plan(run, minutes=15.0, criterion="apart", draws=1)
            named_after = (found.needed or (np.nan,))[0]
            print(
                f"{found.value:.2f} σ apart in {found.minutes:g} minutes; {NAMED:.2g} σ takes {named_after:.1f}",
                flush=True,
            )
            plan = found.observing_plan


def main() -> None:
    """Print the study."""
    parser = options_of(__doc__)
    parts = {"errors": errors, "built": built, "beside": beside, "naming": naming, "diagnosed": diagnosed}
    parser.add_argument("parts", nargs="*", default=list(parts), choices=list(parts))
    for part in parser.parse_args().parts:
        parts[part]()


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
