"""Studies of many nights: what is found in a series, and whether what is said of it holds. The truth is sealed.

    python tests/studies/nights.py quiet                     false breaks of 1000 nights in which things walk
    python tests/studies/nights.py series [--count 300]      one step or bad night each: found, dated, named
    python tests/studies/nights.py smallest [--count 40]     the smallest step, beside ruptures and a person's rule
    python tests/studies/nights.py stars [--count 40]        coverage over a year and of the forecast; other habits
    python tests/studies/nights.py passes [--count 100]      a first pass over nights as files, and what follows

Series but those of `passes` are linear: gradients with their noise, made from the matrices of six simulated nights of
144 points (NIGHTS, made when it is not there). So a series costs no optics, and what is shown is the statistics, not
the linearisation.
"""

from __future__ import annotations

import dataclasses
import functools
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np  # noqa: E402
from scipy import linalg, optimize, stats  # noqa: E402
from study_options import options_of  # noqa: E402

from walop_jax.calibration.accuracy import p_forms, sample_stars  # noqa: E402
from walop_jax.calibration.calibration import Calibration  # noqa: E402
from walop_jax.calibration.product import read_calibration  # noqa: E402
from walop_jax.data.write import write_calibration_set  # noqa: E402
from walop_jax.fit.base_model import base_model  # noqa: E402
from walop_jax.fit.refit import fit  # noqa: E402
from walop_jax.likelihood.likelihood import Likelihood  # noqa: E402
from walop_jax.model.effects.in_models import effect_context  # noqa: E402
from walop_jax.model.laws import YEAR, Law  # noqa: E402
from walop_jax.nights import break_search, breaks, changes  # noqa: E402
from walop_jax.nights.equations import night_equations  # noqa: E402
from walop_jax.nights.night_file import read_nights, write_nights  # noqa: E402
from walop_jax.nights.stacking import stack  # noqa: E402
from walop_jax.nights.survey import Survey  # noqa: E402
from walop_jax.nights.survey_folder import laws_of_all  # noqa: E402
from walop_jax.nights.together import Night, Together, together  # noqa: E402
from walop_jax.simulation.observing_plan import ObservingPlan  # noqa: E402
from walop_jax.simulation.simulate import effect_from_text, simulate, truth_values  # noqa: E402

NIGHTS = Path(tempfile.gettempdir()) / "walop-nights-of-the-study.fits"
RATE = 1e-4  # of throughputs, per √day
LAWS = {"throughput.n?.p00": Law(("walk",), rate=RATE)}
START = 61000.85
KILLS = 10
CHANGING = (
    "half1.plate.mgf2", "half2.plate.quartz", "half2.wedge", "half1.wedge", "collimator.q", "collimator.u",
    "collimator.diattenuation", "throughput.n2.p10", "throughput.n3.p01",
)  # fmt: skip
"""Parameters that change in the series of `smallest` and `stars`."""


def alarm_of(tried: break_search.Tried) -> float:
    """The |z| from which a change is a break."""
    return float(optimize.brentq(lambda u: tried.chance(u) - break_search.CHANCE, 3.0, 12.0, xtol=1e-3))


def cpu() -> float:
    """CPU seconds of this process."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def first_night():
    """A night of 144 points and its truth."""
    return simulate(ObservingPlan(), seed=1)


@functools.cache
def few() -> list[Night]:
    """Six nights over six months, linearised where they truly are."""
    if not NIGHTS.exists():
        first, found = first_night(), []
        for k in range(6):
            plan = dataclasses.replace(ObservingPlan(), mjd=ObservingPlan().start + 30.0 * k)
            calset = simulate(plan, seed=1 + k, instrument=first.truth, catalogue_seed=1).calset
            found += night_equations(calset, base_model(calset), truth_values(first.truth))
        write_nights(NIGHTS, found)
    return read_nights(NIGHTS)


@functools.cache
def roots() -> list[np.ndarray]:
    """R of every night with R Rᵀ its matrix."""
    pairs = [np.linalg.eigh(night.matrix) for night in few()]
    return [vector * np.sqrt(np.clip(value, 0.0, None)) for value, vector in pairs]


def days_of(nights: int, rng: np.random.Generator) -> np.ndarray:
    """Days of nights, 1.5 apart in the mean."""
    return np.cumsum(1 + rng.poisson(0.5, nights)).astype(float)


def walked(days: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """True values (night, parameter) from the reference: throughputs walk."""
    names = few()[0].names
    truth = np.zeros((len(days), len(names)))
    for camera in (1, 2, 3):
        steps = RATE * np.sqrt(np.diff(days, prepend=days[0])) * rng.normal(size=len(days))
        truth[:, names.index(f"throughput.n{camera}.p00")] = np.cumsum(steps)
    return truth


def nights_at(truth: np.ndarray, days: np.ndarray, rng: np.random.Generator) -> list[Night]:
    """Nights whose parameters lie at `truth` from the reference."""
    found = []
    for u, (away, day) in enumerate(zip(truth, days, strict=True)):
        k, mjd = u % len(few()), START + float(day)
        night, noise = few()[k], roots()[k] @ rng.normal(size=truth.shape[1])
        pull = night.matrix @ away
        chi2 = rng.chisquare(night.dof) + away @ pull - 2.0 * away @ noise
        found.append(
            dataclasses.replace(
                night, number=int(mjd), begin=mjd - 0.05, end=mjd + 0.05, mjd=mjd, sha256=f"{u:064d}",
                reference=few()[0].reference, gradient=noise - pull, chi2=float(chi2), source=f"night {u}",
            )
        )  # fmt: skip
    return found


def quiet(count: int, start: int = 0, nights: int = 1000) -> None:
    """False breaks: scores drawn from their covariance, `count` at a time for 40 times; then whole series."""
    rng = np.random.default_rng(10_000 + start)
    days = days_of(nights, rng)
    data = together(nights_at(walked(days, rng), days, rng))
    solution = breaks.solved(data, laws_of_all(data, LAWS))
    tried, largest = break_search.Tried.of(solution), []
    for _ in range(40):
        once = null_scores(solution, count, rng)
        every = (np.cumsum(once[::-1], axis=0)[::-1], once)
        weights = [
            np.where(known > 0, 1.0 / np.sqrt(np.where(known > 0, known, 1.0)), 0.0)
            for known in tried.information
        ]
        z = [
            np.abs(s * w[..., None]).reshape(-1, count).max(axis=0)
            for s, w in zip(every, weights[:2], strict=True)
        ]
        largest += np.maximum(*z).tolist()
    alarm = alarm_of(tried)
    rates = ", ".join(
        f"{np.mean(np.array(largest) > u):.4f} ({tried.chance(u):.4f}) beyond {u:.2f}"
        for u in (5.1, 5.3, alarm)
    )
    print(
        f"quiet: of {len(largest)} draws of all scores of {nights} nights (bound): {rates}; the last is the alarm"
    )


def null_scores(solution, count: int, rng: np.random.Generator) -> np.ndarray:
    """Scores of changes in every single night (night, parameter, draw) where nothing changes but what the laws let.

    The right sides of the solved system are drawn: those of the data with covariance H, priors and the steps of walks
    with their own; the elimination then goes as in `algebra`, with the factors that are known.
    """
    system, e = solution.system, solution.system.equations
    n = e.matrix.shape[1]
    noise = np.stack(
        [(roots()[u % len(few())] @ rng.normal(size=(n, count))) * e.scale[:, None] for u in range(len(e))]
    )
    precision = np.sqrt(system.precision)[:, None]
    right = precision * rng.normal(size=(len(precision), count)) - np.einsum(
        "ug,ugm->gm", system.basis, noise[:, system.at]
    )
    rights: list[np.ndarray] = []
    for cell in system.cells:
        own = np.sqrt(cell.precision)[:, None] * rng.normal(size=(len(cell.parameter), count))
        for v, unit in enumerate(cell.units):
            own -= cell.covers[:, v : v + 1] * noise[unit][cell.parameter]
        rights.append(own)
    for strength, (b, j), (c, k) in system.steps():
        step = rng.normal(size=count) * np.sqrt(strength)
        rights[c][k] += step
        rights[b][j] -= step
    for c, entry in enumerate(solution.cells):
        if c:
            rights[c] = rights[c] - entry.before @ linalg.cho_solve(
                solution.cells[c - 1].factor, rights[c - 1]
            )
        right = right - entry.left.T @ linalg.cho_solve(entry.factor, rights[c])
    shared, local = linalg.cho_solve(solution.factor, right), np.zeros(0)
    values = np.einsum("ug,gm->ugm", system.basis, shared)
    found = np.zeros_like(noise)
    found[:, system.at] = values
    for c in range(len(system.cells) - 1, -1, -1):
        rest = rights[c] - solution.cells[c].left @ shared
        if c + 1 < len(system.cells):
            rest = rest - solution.cells[c + 1].before.T @ local
        local = linalg.cho_solve(solution.cells[c].factor, rest)
        found[system.cells[c].units[:, None], system.cells[c].parameter] += local
    return -(noise + np.einsum("uij,ujm->uim", e.matrix, found, optimize=True))


def information(data: Together, laws: Sequence[Law | None], i: int, first: int, last: int) -> float:
    """Information on a change of a parameter from one night up to another."""
    weights = np.zeros((len(data.nights), 1))
    weights[first:last] = 1.0
    known = changes.weighted(breaks.solved(data, laws), weights, np.array([i]))[1][0, 0]
    return float(known / data.equations.scale[i] ** 2)


def sealed(count: int, start: int = 0, nights: int = 200) -> None:
    """One change a series, of any parameter, effect or walk that the laws let be seen, of 5 to 15 standard errors."""
    tally, began, alarm, clear = np.zeros((3, 7), int), cpu(), 0.0, np.zeros(2, int)
    bands = ("5 to 7", "7 to 8", "8 to 15")
    for k in range(count):
        rng = np.random.default_rng(20_000 + start + k)
        days, names = days_of(nights, rng), few()[0].names
        truth, bad = walked(days, rng), bool(rng.random() < 0.3)
        first = int(rng.integers(nights // 10, nights - nights // 10))
        last = first + 1 if bad else nights
        plain = together(nights_at(truth, days, rng))
        laws = laws_of_all(plain, LAWS)
        alarm = alarm or alarm_of(break_search.Tried.of(breaks.solved(plain, laws)))
        known = 0.0
        while not known > 0.0:
            name = str(rng.choice(names))
            known = information(plain, laws, names.index(name), first, last)
        expected = float(rng.uniform(5.0, 15.0))
        truth[first:last, names.index(name)] += rng.choice([-1.0, 1.0]) * expected / np.sqrt(known)
        found, _ = break_search.find(together(nights_at(truth, days, rng)), laws)
        band = 0 if expected < 7.0 else 1 if expected < 8.0 else 2
        number = np.array([int(START + day) for day in days])
        at = [int(np.searchsorted(number, one.night)) for one in found]
        near = [
            (one, abs(night - first)) for one, night in zip(found, at, strict=True)
            if one.kind != "drift" and (abs(night - first) < 20 or name in (one.name, *one.alike))
        ]  # fmt: skip
        tally[band, 0] += 1
        tally[band, 6] += len(found) - min(len(near), 1)
        if near:
            best, off = max(near, key=lambda pair: abs(pair[0].z))
            right, inside = (
                name in (best.name, *best.alike),
                best.nights[0] <= number[first] <= best.nights[1],
            )
            tally[band, 1:6] += (1, off <= 1, inside, right, 1 + len(best.alike))
            # What one night alone sees of the change, in its errors: no method dates less to a night.
            held = 1 if bad else first * (nights - first) / nights
            if band == 2 and expected / np.sqrt(held) > 2.5:
                clear += (1, off <= 1)
            if band == 2 and not (inside and right):
                print(
                    "  off:",
                    name,
                    "bad" if bad else "step",
                    f"{expected:.1f}",
                    first,
                    best.name,
                    off,
                    f"{best.z:.1f}",
                )
    print(f"sealed: alarm {alarm:.2f}, {cpu() - began:.0f} s of CPU")
    for label, row in zip(bands, tally.tolist(), strict=True):
        total, seen, dated, inside, named, size, more = row
        print(f"  expected z {label}: {total} series, found {seen}, date ±1 {dated}, within its nights {inside}, named "
              f"{named} (class of {size / max(seen, 1):.1f} names), breaks that are none {more}")  # fmt: skip
    print(f"  of 2.5 errors of a night and more: {clear[0]}, date ±1 {clear[1]}")


def alone(night: Night) -> tuple[np.ndarray, np.ndarray]:
    """Values and errors of the parameters of the model that one night gives, priors laid on."""
    data = together([night])
    solution = breaks.solved(data, laws_of_all(data, {}))
    cut = len(data.names) - data.candidates
    scale = data.equations.scale
    return (solution.values[0] * scale)[:cut], (solution.errors()[0] * scale)[:cut]


def smallest(count: int, start: int = 0, nights: int = 200) -> None:
    """Steps in the middle, each method at 1 % false alarms a series; the size found in half of the cases."""
    try:
        import ruptures
    except ImportError:
        ruptures = None
        print("ruptures is not there (pip install ruptures): left out")
    names = [name for name in CHANGING if name in few()[0].names]
    rng = np.random.default_rng(30_000 + start)

    def tracks(truth: np.ndarray, days: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[Night]]:
        made = nights_at(truth, days, rng)
        every = [alone(night) for night in made]
        return np.array([v for v, _ in every]), np.array([e for _, e in every]), made

    def gain(values: np.ndarray) -> float:
        """Of a track in its errors: what the best single step of ruptures gains in the sum of squares."""
        cost = ruptures.costs.CostL2().fit(values[:, None])
        where = ruptures.Binseg(model="l2", min_size=1, jump=1).fit(values[:, None]).predict(1)[0]
        return cost.error(0, len(values)) - cost.error(0, where) - cost.error(where, len(values))

    quiet_gains, jumps = [], []
    for _ in range(count):
        days = days_of(nights, rng)
        values, errors, _ = tracks(walked(days, rng), days)
        z = values / errors
        jumps.append(np.mean(np.abs(np.diff(z, axis=0)) > 3.0 * np.sqrt(2.0), axis=0).max())
        if ruptures is not None:
            quiet_gains += [gain(z[:, few()[0].names.index(name)]) for name in names]
    # 1 % a series over all parameters, as ours: the tail of a gain is that of χ² times the places tried.
    level = np.nan
    if ruptures is not None:
        high = float(np.quantile(quiet_gains, 0.9))
        places = 0.1 / stats.chi2.sf(high, 1)
        level = float(stats.chi2.isf(0.01 / len(few()[0].names) / places, 1))
    print(f"smallest: alarm of ruptures at a gain of {level:.1f}, from {len(quiet_gains)} quiet tracks; the 3 sigma "
          f"rule has a false alarm in {100 * np.mean(np.array(jumps) > 0):.0f} % of quiet series")  # fmt: skip
    middle = nights // 2
    for name in names:
        days = days_of(nights, rng)
        truth = walked(days, rng)
        i = few()[0].names.index(name)
        plain = together(nights_at(truth, days, rng))
        laws = laws_of_all(plain, LAWS)
        one = 1.0 / np.sqrt(information(plain, laws, i, middle, nights))
        alarm = alarm_of(break_search.Tried.of(breaks.solved(plain, laws)))
        sigma = float(np.median(tracks(truth[:6], days[:6])[1][:, i]))
        ours, person = alarm * one, 3.0 * np.sqrt(2.0) * sigma
        found, theirs = [], np.nan
        if ruptures is not None:
            for size in np.geomspace(0.2, 3.0, 20) * sigma:
                values = truth[:, i] + np.where(np.arange(nights) >= middle, size, 0.0)
                hits = [gain(values / sigma + rng.normal(size=nights)) > level for _ in range(10)]
                found.append((size, np.mean(hits)))
            theirs = next((size for size, share in found if share >= 0.5), np.nan)
        print(f"  {name}: ours {ours:.3g}, ruptures {theirs:.3g} ({ours / theirs:.2f}), 3 sigma between neighbours "
              f"{person:.3g} ({ours / person:.2f})", flush=True)  # fmt: skip


def like() -> Calibration:
    """A calibration of the instrument of the series."""
    calset = first_night().calset
    return Calibration.from_fit(fit(Likelihood.of(calset, base_model(calset))).with_verdict())


def stars(count: int, start: int = 0, nights: int = 243) -> None:
    """A year with four breaks, two drifts and three bad nights: stars through it, and until the forecast ends."""
    held, inside, beyond = like(), [], []
    habits: dict[str, list[np.ndarray]] = {"ours": [], "average of all nights": [], "latest night": []}
    names = few()[0].names
    for k in range(count):
        rng = np.random.default_rng(40_000 + start + k)
        days = days_of(nights, rng)
        truth = walked(days, rng)
        sigma = alone(few()[0])[1]
        for j, name in enumerate(rng.permutation(CHANGING)):
            i, at = names.index(str(name)), int(rng.integers(20, nights - 20))
            size = rng.choice([-1.0, 1.0]) * rng.uniform(1.0, 3.0) * sigma[i]
            if j < 4:
                truth[at:, i] += size
            elif j < 6:
                truth[:, i] += size * (days - days[0]) / YEAR
            else:
                truth[at, i] += 5.0 * size
        made = nights_at(truth[:nights], days, rng)
        survey = stack(made, LAWS, like=held)
        plain = stack(made, {}, like=held, find=False)
        form = slopes_of(survey, names)
        reference = dict(zip(names, few()[0].reference, strict=True))
        rows = []
        for u in range(10, nights, 3):
            true = truth[u]
            error, z = off(survey, START + days[u], form, names, reference, true)
            inside.append(z)
            average, _ = off(plain, START + days[u], form, names, reference, true)
            last = np.zeros(len(names))
            last[: len(sigma)] = alone(made[u - 1])[0]
            latest = np.sqrt(np.mean((form @ (last - true)) ** 2))
            rows.append((days[u], error, average, latest))
        # Walks go on from the last night; what a drift does in these days is far below its error.
        true = truth[-1].copy()
        gone = np.linspace(0.1, 1.0, 8) * (survey.until - survey.last)
        for gap, moment in zip(np.diff(gone, prepend=0.0), gone, strict=True):
            for camera in (1, 2, 3):
                true[names.index(f"throughput.n{camera}.p00")] += RATE * np.sqrt(gap) * rng.normal()
            beyond.append(off(survey, survey.last + float(moment), form, names, reference, true)[1])
        for habit, column in zip(habits, np.array(rows).T[1:], strict=True):
            month = np.minimum((np.array(rows)[:, 0] / 30.44).astype(int), 11)
            habits[habit].append(np.array([np.sqrt(np.mean(column[month == m] ** 2)) for m in range(12)]))
    for label, some in (("stars of a year", inside), ("later, up to the end of validity", beyond)):
        z = np.abs(np.concatenate([one.ravel() for one in some])) if some else np.array([np.nan])
        print(
            f"stars: {label}: {100 * np.mean(z < 1):.1f} % within 1 σ, {100 * np.mean(z < 1.96):.1f} % within 1.96 σ"
        )
    for habit, rows in habits.items():
        months = np.sqrt(np.nanmean(np.array(rows) ** 2, axis=0))
        print(f"  error of p (%) by month, {habit}: {' '.join(f'{100 * one:.3f}' for one in months)}")


def slopes_of(survey: Survey, names: Sequence[str]) -> np.ndarray:
    """Derivatives of p (points × stars) to the parameters of the nights, along which stars are wrong."""
    assert survey._matrix is not None
    matrix, of_matrix, *_ = survey._matrix
    slopes, known = p_forms(matrix, sample_stars()) @ of_matrix, survey._full.model.names
    found = np.zeros((slopes.shape[0] * slopes.shape[1], len(names)))
    for k, name in enumerate(names):
        if name in known:
            found[:, k] = slopes[:, :, known.index(name)].ravel()
    return found[::37]


def off(survey, mjd, form, names, reference, true) -> tuple[float, np.ndarray]:
    """Rms error of p at a moment, and every error of p over its standard error."""
    value, covariance = survey.values_at(mjd)
    order = [survey.data.names.index(name) for name in names]
    away = value[order] - np.array([reference[name] for name in names]) - true
    error = form @ away
    sigma = np.sqrt(np.einsum("sn,nm,sm->s", form, covariance[np.ix_(order, order)], form, optimize=True))
    return float(np.sqrt(np.mean(error**2))), error / sigma


def command(*arguments: object, kill_when: Callable[[], bool] | None = None) -> tuple[float, float, float]:
    """CPU seconds, memory (GB) and wall time of a command in a process of its own, killed when something is so."""
    began, ended = time.perf_counter(), threading.Event()
    child = subprocess.Popen(
        [sys.executable, "-m", "walop_jax", *map(str, arguments), "--quiet"], start_new_session=True
    )

    def kill() -> None:
        assert kill_when is not None
        while not kill_when():
            if ended.wait(0.02):
                return
        os.killpg(child.pid, signal.SIGKILL)

    watch = threading.Thread(target=kill)
    if kill_when is not None:
        watch.start()
    _, status, used = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    ended.set()
    if kill_when is None and child.returncode not in (0, 3):
        raise SystemExit(f"{' '.join(map(str, arguments))}: exit code {child.returncode}")
    return used.ru_utime + used.ru_stime, used.ru_maxrss / 1e6, time.perf_counter() - began


def as_files(folder: Path, count: int, start: int) -> list[str]:
    """Nights as files, and in words what was hidden in them: four steps, two drifts, three bad nights, a filter."""
    first, rng = first_night(), np.random.default_rng(50_000 + start)
    model = base_model(first.calset)
    values, days = np.array([truth_values(first.truth)[name] for name in model.names]), days_of(count, rng)
    truth, errors = np.tile(values, (count, 1)), dict(zip(few()[0].names, alone(few()[0])[1], strict=False))
    said = []
    for j, name in enumerate(rng.permutation(CHANGING)):
        i, at = model.names.index(str(name)), int(rng.integers(count // 10, count - count // 10))
        size = rng.choice([-1.0, 1.0]) * rng.uniform(3.0, 6.0) * errors[str(name)]
        if j < 4:
            truth[at:, i] += size
        elif j < 6:
            truth[:, i] += size * (days - days[0]) / (days[-1] - days[0])
        else:
            truth[at, i] += 5.0 * size
        kind = "step" if j < 4 else "drift" if j < 6 else "bad night"
        said.append(f"{kind} of {name} in night {int(START + days[at])}")
    exchanged = int(rng.integers(count // 10, count - count // 10))
    said.append(f"filter_shift from night {int(START + days[exchanged])}")
    for u, day in enumerate(days):
        plan = dataclasses.replace(ObservingPlan(), mjd=START + float(day))
        there = model.instrument(truth[u])
        context = effect_context(model.template, plan.exposures())
        shifted = (effect_from_text("filter_shift=0.001", context),) if u >= exchanged else ()
        calset = simulate(
            plan, seed=60_000 + start + u, instrument=there, effects=shifted, catalogue_seed=1
        ).calset
        write_calibration_set(folder / f"night{u:04d}.fits", calset)
    return said


def passes(count: int, start: int = 0) -> None:
    """The first pass over nights that lie there as files, by the commands that users run."""
    folder = Path(tempfile.mkdtemp())
    said, began = as_files(folder, count, start), cpu()
    print(f"passes: hidden: {'; '.join(said)}", flush=True)
    files = sorted(folder.glob("night*.fits"))
    (folder / "laws.toml").write_text(f'[law."throughput.n?.p00"]\nper = "walk"\nrate = {RATE}\n')
    command("refit", files[0], "-o", folder / "RUN")

    def stacked(output: str, *words: str, nights: int = count, **more: Any) -> tuple[float, float, float]:
        like, laws = folder / "RUN", folder / "laws.toml"
        return command(
            "stack", *files[:nights], "--like", like, "--laws", laws, "-o", folder / output, *words, **more
        )

    def apart(output: str) -> str:
        ends = [read_calibration(folder / name / "calibration.fits") for name in ("WHOLE", output)]
        shift = np.abs(ends[0].values - ends[1].values) / np.where(ends[0].sigma > 0.0, ends[0].sigma, np.inf)
        same = np.array_equal(ends[0].covariance, ends[1].covariance) and not shift.any()
        return "the same to the last digit" if same else f"parameters differ by {shift.max():.1e} σ at most"

    stacked("COLD", nights=2)
    used, memory, wall = stacked("WHOLE")
    print(
        f"  {count} nights: {used:.1f} s of CPU ({used / count:.2f} a night), {memory:.2f} GB, {wall:.1f} s",
        flush=True,
    )
    shared = stacked("WORKERS", "--workers", "2")
    print(
        f"  two workers: {shared[0]:.1f} s of CPU, {shared[2]:.1f} s, {wall / shared[2]:.2f} times as fast; "
        f"{apart('WORKERS')}; load {os.getloadavg()[0]:.0f}",
        flush=True,
    )
    one = dataclasses.replace(ObservingPlan(), grid=round(12 * count**0.5))
    write_calibration_set(folder / "one.fits", simulate(one, seed=1).calset)
    command("refit", folder / "one.fits", "-o", folder / "COLD1")  # keeps its programs, as those above
    alike, size, _ = command("refit", folder / "one.fits", "-o", folder / "ONE")
    print(f"  one set as large: {alike:.1f} s of CPU, {size:.2f} GB: ratio {used / alike:.2f}", flush=True)
    made = (folder / "KILLED" / "partial").glob
    for kill in range(KILLS):  # by turns one process, and two workers whose parent dies, after one night more
        there = len(list(made("night*")))
        stacked(
            "KILLED",
            *(("--workers", "2") if kill % 2 else ()),
            kill_when=lambda there=there: len(list(made("night*"))) > there,
        )
    left = len(list((folder / "KILLED" / "partial").glob("night*")))
    more, _, _ = stacked("KILLED")
    print(
        f"  killed {KILLS} times, with {left} nights made: the last run took {more:.1f} s of CPU; {apart('KILLED')}",
        flush=True,
    )
    whole = read_nights(folder / "WHOLE" / "nights.fits")
    held = read_calibration(folder / "RUN" / "calibration.fits")
    for name, laws in (
        ("steps looked for again", LAWS),
        ("another law", {"half1.wedge": Law(("walk",), rate=1e-5)}),
    ):
        began = cpu()
        survey = stack(whole, laws, like=held)
        print(f"  {name}: {cpu() - began:.2f} s of CPU, {len(survey.breaks)} breaks", flush=True)
        for found in survey.breaks:
            print(
                f"    {found.kind} of {found.name}, night {found.night} ({found.nights}), z = {found.z:.1f}"
            )
    began = cpu()
    stack(whole, LAWS, like=held, find=False)
    print(f"  jointly, nothing looked for: {cpu() - began:.2f} s of CPU", flush=True)
    print(
        f"  one night's refit: {command('refit', files[1], '-o', folder / 'NIGHT')[0]:.1f} s of CPU",
        flush=True,
    )
    shutil.rmtree(folder)


STUDIES = {
    "quiet": (quiet, 50),
    "series": (sealed, 300),
    "smallest": (smallest, 40),
    "stars": (stars, 40),
    "passes": (passes, 100),
}


def main() -> None:
    """Run one study, or all."""
    parser = options_of(__doc__, start=0)
    parser.add_argument("study", choices=[*STUDIES, "all"])
    parser.add_argument("--count", type=int)
    given = parser.parse_args()
    for name, (study, count) in STUDIES.items():
        if given.study in (name, "all"):
            study(given.count or count, given.start)


if __name__ == "__main__":
    main()
