"""Do plans keep their promises, for instruments as built, and how do they compare with usual procedures?

    python tests/studies/plans.py [errors] [built] [beside] [naming] [diagnosed]

errors   20 sets each of the best plan of 20 minutes and of usual ones, of 20 instruments drawn from the priors, with
         noise and standards of its own: the errors of p that a fit makes against those promised. The
         fits are linear, from the truth; one full fit says how far that is from the real one.
built    200 instruments as they might be built: what the plan that was made for 20 others is worth in each, beside what
         no plan for that one alone can undercut.
beside   time to 0.1 % on 95 % of the field, for South, North and an instrument of a user's own as they may be built:
         usual procedures, the best plan found, and the time that no plan can undercut, whatever it gives up.
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
from scipy.optimize import linprog

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
from walop_jax.model.cameras import with_floor  # noqa: E402
from walop_jax.model.effects.in_models import effect_context  # noqa: E402
from walop_jax.plans.available import Available  # noqa: E402
from walop_jax.plans.criteria import NAMED, criterion_by_name, field_errors  # noqa: E402
from walop_jax.plans.exposures import Candidates, Polarised, candidates  # noqa: E402
from walop_jax.plans.optimal import Experiment, least_budget, optimise  # noqa: E402
from walop_jax.plans.plan import (  # noqa: E402
    covariance,
    experiment_of,
    information_of_weights,
    largest_variance,
    plan_from,
    usual_plans,
)
from walop_jax.simulation.observing_plan import ObservingPlan, Stop  # noqa: E402
from walop_jax.simulation.simulate import effect_from_text, simulate, truth_values  # noqa: E402

MINUTES, INSTRUMENTS, EACH, BUILT, GOAL, FIELD = 20.0, 20, 1, 200, 0.1, 0.95
NODES, ENOUGH = 40, 1.1  # of the search for what is best given up, and the factor at which it ends
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


def stops_of(found: Candidates, weights: dict[tuple[int, tuple[float, ...]], float]) -> tuple[Stop, ...]:
    """Weights of (choice, place) as exposures."""
    return tuple(found.choices[i].stop(place, max(round(w), 1)) for (i, place), w in weights.items())


def linear_fit(
    plan: ObservingPlan, found: Candidates, draw: int, seed: int
) -> tuple[dict[str, float], float]:
    """By how much the first step of a fit from the truth is wrong; by how many σ a full fit differs from it."""
    instrument = found.model.instrument(found.values[draw])
    simulated = simulate(plan, seed=seed, instrument=instrument, steady=True)
    calset = scattered(simulated.calset, instrument.cameras.floor, seed)
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
    more = np.sqrt(with_floor(block.sigma, block.counts, floor) ** 2 - block.sigma**2)
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
        whole, _ = information_of_weights(experiment, {key: max(round(w), 1) for key, w in weights.items()})
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
    found = candidates(Available(SOUTH), angles=181)
    field = field_errors(found)
    best = plan_from(found, MINUTES, criterion_by_name(found, field, "worst"), field)
    taken = [(line, choice_of(found, line)) for line in best.lines]
    efficiency: list[float] = []
    for seed in range(1, 1 + BUILT // len(found.values)):
        other = candidates(Available(SOUTH), seed=seed, angles=181)
        criterion = criterion_by_name(other, field_errors(other), "worst")
        whole = experiment_of(other, MINUTES, criterion)
        total, _ = information_of_weights(whole, {key: float(line.times) for line, key in taken})
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


def choice_of(found: Candidates, line) -> tuple[int, tuple[float, ...]]:
    """The candidate of a line of a plan."""
    for i, choice in enumerate(found.choices):
        if (choice.kind, choice.filter, choice.seconds) != (line.kind, line.filter, line.exptime):
            continue
        if choice.positions != line.positions:
            continue
        if line.kind == "clp":
            return i, choice.place(line.polariser_angle)
        return i, (float([stop.number for stop in choice.stops].index(line.number)),)
    raise LookupError(line)


def one_draw(experiment: Experiment, draw: int) -> Experiment:
    """The problem of one instrument."""
    pick = slice(draw, draw + 1)
    families = tuple(
        dataclasses.replace(f, counts=f.counts[pick], known={})
        if isinstance(f, Polarised)
        else dataclasses.replace(f, basis=f.basis[pick])
        for f in experiment.families
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


@dataclasses.dataclass
class Most:
    """The least time in which a plan brings all but a few targets, whichever it gives up, to a variance.

    For any matrices Y a target has φ_k(v) ≥ 2 tr Y'A_k − tr Y' M(v) Y, so that a plan which reaches φ_k ≤ g has
    Σ_i v_i tr Y' M_i Y ≥ b, b = 2 tr Y'A_k − tr Y' M₀ Y − g, where it does not give up k: z_k = 1. As a linear program,
    0 ≤ z_k ≤ 1 and Σ z_k no more than may be given up, that is a lower bound; its multipliers μ bound the time over the
    continuum of candidates, whatever is given up: (Σ μ_k b_k without the largest) / max_i (tr G M_i / c_i),
    G = Σ μ_k Y_k Y_k'.
    """

    problem: Experiment
    goal: float

    def __post_init__(self) -> None:
        k = self.problem.targets.shape[1]
        self.dropped = k - int(np.ceil(FIELD * k))
        self.columns = [(f, p) for f, one in enumerate(self.problem.families) for p in one.spread()]
        self.matrices = [self._of(c) for c in self.columns]
        self.cuts: list[tuple[int, np.ndarray, float]] = []

    def _of(self, column) -> np.ndarray:
        return self.problem.families[column[0]].information(np.atleast_2d(column[1]))[0, 0]

    def cost(self, column) -> float:
        return float(self.problem.families[column[0]].cost_at(np.atleast_2d(column[1]))[0])

    def phi(self, total: np.ndarray) -> np.ndarray:
        """Variances of the targets."""
        a = self.problem.targets[0]
        return np.einsum("knq,nm,kmq->k", a, np.linalg.inv(total), a, optimize=True)

    def cut(self, weights: np.ndarray, z: np.ndarray) -> int:
        """Half-spaces that the weights violate: those of each target where it would just be reached in proportion."""
        whole, known, new = np.tensordot(weights, np.stack(self.matrices), 1), self.problem.known[0], 0
        for k, a in enumerate(self.problem.targets[0]):
            if z[k] > 0.999:
                continue
            total = known + whole / (1 - z[k])
            if np.trace(a.T @ np.linalg.solve(total, a)) <= self.goal * (1 + 1e-3):
                continue
            low, high = 1.0, 1e9
            while high / low > 1.001:
                middle = np.sqrt(low * high)
                there = np.trace(a.T @ np.linalg.solve(known + middle * whole / (1 - z[k]), a))
                low, high = (middle, high) if there > self.goal else (low, middle)
            y = np.linalg.solve(known + high * whole / (1 - z[k]), a)
            b = 2 * np.trace(y.T @ a) - np.trace(y.T @ known @ y) - self.goal
            self.cuts.append((k, y, b))
            new += 1
        return new

    def relaxed(self, ones: frozenset[int], zeros: frozenset[int]) -> tuple[float, np.ndarray, np.ndarray]:
        """Bound (s), weights and z of the linear program; new candidates join the columns until they do not pay."""
        bound, k = 0.0, self.problem.targets.shape[1]
        for _ in range(40):
            count = len(self.columns)
            costs = np.array([self.cost(c) for c in self.columns])
            stacked = np.stack(self.matrices).reshape(count, -1)
            y = np.stack([cut[1] for cut in self.cuts])
            b = np.array([cut[2] for cut in self.cuts])
            of = np.array([cut[0] for cut in self.cuts])
            rows = (y @ y.swapaxes(1, 2)).reshape(len(y), -1) @ stacked.T
            scale = np.where(b > 0, b, 1.0)
            given = np.zeros((len(b), k))
            given[np.arange(len(b)), of] = b / scale
            limits = np.array([(1, 1) if i in ones else (0, 0) if i in zeros else (0, 1) for i in range(k)])
            found = linprog(
                np.append(costs, np.zeros(k)),
                A_ub=np.vstack(
                    [-np.hstack([rows / scale[:, None], given]), np.append(np.zeros(count), np.ones(k))]
                ),
                b_ub=np.append(-b / scale, self.dropped),
                bounds=np.vstack([np.tile([0, np.inf], (count, 1)), limits]),
                method="highs",
            )
            multipliers = np.maximum(-found.ineqlin.marginals[:-1], 0) / scale
            g = np.einsum("c,cnq,cmq->nm", multipliers, y, y, optimize=True)
            worth = np.bincount(of, multipliers * b, k)
            ratio, new = 0.0, []
            for number, family in enumerate(self.problem.families):
                places, largest = family.best(g[None], 4)
                ratio = max(ratio, largest)
                new += [(number, place) for place in places]
            free = np.array([i for i in range(k) if i not in ones and i not in zeros])
            left = sum(worth[i] for i in range(k) if i not in ones)
            most = np.sort(worth[free])[::-1][: self.dropped - len(ones)].clip(0).sum()
            bound = max(bound, (left - most) / ratio)
            if bound >= found.fun * (1 - 3e-3):
                break
            self.columns += new
            self.matrices += [self._of(c) for c in new]
            weights, z = found.x[:count], found.x[count:]
        weights, z = found.x[:count], found.x[count:]
        return bound, np.append(weights, np.zeros(len(self.columns) - count)), z

    def solve(self, nodes: int, enough: float) -> tuple[float, float]:
        """Time (s) of the best plan found, and that below which none is: branch and bound over what is given up."""
        best, queue, tried = np.inf, [(0.0, frozenset(), frozenset())], set()
        self.cut(np.full(len(self.columns), 1e-3), np.zeros(self.problem.targets.shape[1]))
        for _ in range(nodes):
            queue.sort(key=lambda node: node[0])
            lower, ones, zeros = queue.pop(0)
            if lower >= best / enough:
                return best, min(lower, best)
            for _ in range(12):
                bound, weights, z = self.relaxed(ones, zeros)
                lower = max(lower, bound)
                if lower >= best / enough or not self.cut(weights, z):
                    break
            given_up = frozenset(np.argsort(-z, kind="stable")[: self.dropped].tolist())
            if given_up not in tried:
                tried.add(given_up)
                kept = np.array([i for i in range(len(z)) if i not in given_up])
                some = dataclasses.replace(
                    self.problem, targets=self.problem.targets[:, kept], budget=min(best, self.problem.budget)
                )
                plan, _ = least_budget(some, self.goal)
                best = min(best, cost_of(some, plan) * plan.value / self.goal)
            open_ = np.flatnonzero((z > 1e-6) & (z < 1 - 1e-6))
            if len(open_):
                i = int(open_[np.argmax(z[open_])])
                queue.append((lower, ones | {i}, zeros))
                queue.append((lower, ones, zeros | {i}))
            else:
                queue.append((lower, ones, zeros))
        return best, min(best, *(node[0] for node in queue))


def beside() -> None:
    """Time to 0.1 % on 95 % of the field."""
    for instrument in ("WALOP-SOUTH", "WALOP-NORTH", own()):
        found = candidates(described(instrument), draws=1, angles=181)
        field = field_errors(found)
        alone = experiment_of(found, MINUTES, criterion_by_name(found, field, "worst"))
        best, least = Most(alone.reduced(), GOAL**2).solve(NODES, ENOUGH)
        rows = {"best plan found": best / 60, "no plan below": least / 60}
        for name, weights in usual_plans(found):
            rows[name] = minutes_to_goal(alone, *information_of_weights(alone, weights))
        for name, minutes in rows.items():
            print(
                f"{found.available.plan.name}, {name}: {minutes:.3g} min, {60 * minutes / best:.2f} times the best, "
                f"at most {60 * minutes / least:.2f} times any",
                flush=True,
            )


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
            (i, (float(place),)): 1.0
            for i, choice in enumerate(found.choices)
            if choice.kind != "clp" and choice.positions["CHWP"] is None
            for place in range(len(choice.stops))
        }
        before, _ = information_of_weights(experiment, standard)
        start = dataclasses.replace(experiment, known=experiment.known + before)
        at_first = criterion.reported(largest_variance(start, start.known))
        cheapest, _ = least_budget(start, criterion.variance(NAMED))
        needed = cost_of(start, cheapest) / 60
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


def cost_of(experiment: Experiment, plan) -> float:
    """Time (s) of weights, without changes."""
    return sum(
        w * float(experiment.families[f].cost_at(p[None])[0])
        for f, p, w in zip(plan.family, plan.place, plan.weight, strict=True)
    )


def before_of(found: Candidates, standard: dict[tuple[int, tuple[float, ...]], float]) -> np.ndarray:
    """The information of a standard plan on all parameters of the candidates, mean over draws."""
    return sum(w * found.families[i].information(np.atleast_2d(p))[0, 0] for (i, p), w in standard.items())


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
            print(
                f"{found.value:.2f} σ apart in {found.minutes:g} minutes; {NAMED:.2g} σ takes {found.needed[0]:.1f}",
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
