"""Physics that the search has never seen: is what a diagnosis hands on right, star by star and element by element?

    python tests/studies/sealed.py [--sets 400] [--first 0] [--seed 53] [--side 8] [--budget MINUTES] [--refit-only]
    python tests/studies/sealed.py --join FILE...

What is hidden in a set depends on its number and the seed alone, and is drawn from a grammar of its own. It shares no
line with the sentences of a diagnosis (kinds, places and factors are other ones), and its light path is that of
`tests/oracle`. A twelfth of the sets each holds nothing, or a mistake of the tables; the others

    optics       M → exp(a g f s A) M, to second order, at a place of the train: ahead of the polariser, in it and
                 turning with it, behind it, behind the collimator, ahead of the analyser of one half
    detectors    counts of a camera or a half × (1 + a g f), or × (1 + a g (N/N₀)^γ), or + a share of the light of
                 another camera
    sky          polarisation added to the Moon sky, or to standards, by a law of time, angle or star

A is a random sum of the six generators of the Poincaré sphere and of unequal depolarisations; f a random smooth pattern
of the field (low-pass noise, a bump, a ridge at some angle, a power of the radius about a displaced centre), s one of
wavelength, g one of time (drift, exponential settling, step), temperature, exposure time, order of the exposures, angle
of an element, side from which it came, KIND (some of them, with stars or without), or of nothing; a is drawn over a
decade and a half about what the data just show. Stars are taken at the time of the first exposure, at 10 °C, for 60 s.

Printed are each set, and the table: pulls and errors of the matrix between the points, and of stars with p = 2 %, at
400 places, where |det| is 0.1 or more, of stars so faint that no detector shows a power of their counts. A set counts
where what is hidden raises χ² of the base model by 30: beside that of the same set, with the same noise, without it.

All stars share the error of one calibration, so that even an exact covariance puts many of them beyond three errors now
and then (`chance.py`). Beside the number of products that are trusted and wrong stands therefore the number that their
own covariances would give by chance. With `--refit-only` nothing is searched for: "diagnosis" stands then for trusted
fits with the errors of undetected changes. Outcomes of some of the sets go to a file (`--save`), and several such files
into one table (`--join`).

A name or a description is right if it places the cause where it was hidden (`home`): ahead of the polariser, in it,
in the common train, in one half, in the cameras, in a source, in the tables. `class`: another one that the diagnosis
lists as indistinguishable is.
"""

from __future__ import annotations

import argparse
import dataclasses
import pickle
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.stats import binomtest

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from oracle import forward  # noqa: E402
from studies.sealed_judging import FEW, TEFF, Judged, homes_of, judged, right_of  # noqa: E402
from studies.sealed_optics import Hidden, vectors  # noqa: E402
from study_options import options_of  # noqa: E402

from walop_jax.calibration.calibration import Calibration  # noqa: E402
from walop_jax.data.records import CalibrationSet, Position  # noqa: E402
from walop_jax.data.table_intensities import TableIntensities  # noqa: E402
from walop_jax.data.write import write_calibration_set  # noqa: E402
from walop_jax.diagnosis.class_product import with_average  # noqa: E402
from walop_jax.diagnosis.discrepancy import ambiguities  # noqa: E402
from walop_jax.diagnosis.examination import examine  # noqa: E402
from walop_jax.diagnosis.findings import Diagnosis  # noqa: E402
from walop_jax.diagnosis.hypotheses import Hypotheses  # noqa: E402
from walop_jax.diagnosis.trust import examined  # noqa: E402
from walop_jax.diagnosis.workflow import diagnose  # noqa: E402
from walop_jax.fit.refit import FitResult, refit  # noqa: E402
from walop_jax.io.errors import DataError  # noqa: E402
from walop_jax.simulation.observing_plan import ObservingPlan, polariser_turn  # noqa: E402
from walop_jax.simulation.simulate import simulate  # noqa: E402

HELD, CLEAR = 30.0, 900.0  # Δχ² of the truth: detectable; amplitude of 30 standard errors
WORSE = 1.2
PLACES, STAR_SECONDS = 400, 60.0
NODES = 24  # of the band: 10⁻⁹ of the whole table
ELECTRONS = 1e6
EDGES, BAND = np.linspace(-0.3, 0.3, 25), np.linspace(0.54, 0.71, 35)


# ------------------------------------------------------------------------------------------------------- what is drawn


def generators(rng: np.random.Generator) -> np.ndarray:
    """A random Mueller matrix near the identity, less the identity: retarder, diattenuator, depolarisation."""
    a = np.zeros((4, 4))
    d, r, k = rng.standard_normal((3, 3)) * (rng.random((3, 1)) < (0.45, 0.55, 0.3))
    if not (d.any() or r.any() or k.any()):
        r = rng.standard_normal(3)
    a[0, 1:] = a[1:, 0] = d
    a[1:, 1:] = np.array([[0, r[2], -r[1]], [-r[2], 0, r[0]], [r[1], -r[0], 0]]) - np.diag(np.abs(k))
    return a / np.linalg.norm(a)


def over_field(rng: np.random.Generator) -> tuple[str, Callable[[np.ndarray, np.ndarray], np.ndarray]]:
    """A smooth pattern of the field (deg), about 1 at its largest."""
    kind = rng.choice(["uniform", "noise", "bump", "ridge", "power"], p=[0.35, 0.2, 0.1, 0.15, 0.2])
    angle, x0, y0 = rng.uniform(0, 2 * np.pi), *rng.uniform(-0.2, 0.2, 2)
    width, power = rng.uniform(0.1, 0.35), rng.choice([1.0, 2.0, 3.0, 4.0])
    waves, phases = rng.normal(0.0, 6.0, (4, 2)), rng.uniform(0, 2 * np.pi, 4)

    def value(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        x, y = np.atleast_1d(x), np.atleast_1d(y)
        if kind == "uniform":
            return np.ones(x.shape)
        if kind == "noise":
            return np.cos(np.tensordot(waves, np.stack([x, y]), 1) + phases[:, None]).sum(axis=0) / 2.0
        if kind == "bump":
            return np.exp(-((x - x0) ** 2 + (y - y0) ** 2) / (2 * width**2))
        if kind == "ridge":
            return np.tanh((np.cos(angle) * x + np.sin(angle) * y - x0) / width)
        return (np.hypot(x - x0, y - y0) / 0.3) ** power

    return kind, value


def over_colour(rng: np.random.Generator) -> Callable[[np.ndarray], np.ndarray]:
    """A smooth function of the wavelength (µm)."""
    kind, slope, phase = rng.integers(3), rng.normal(0, 3.0), rng.uniform(0, 2 * np.pi)
    if kind == 0:
        return np.ones_like
    if kind == 1:
        return lambda w: 1.0 + slope * (w / 0.62 - 1.0)
    return lambda w: np.cos(2 * np.pi * (w - 0.62) / 0.3 + phase)


def law(rng: np.random.Generator, calset: CalibrationSet) -> tuple[str, np.ndarray, float]:
    """A law over the exposures, about 1 at its largest, and its value for stars."""
    e, n = calset.exposures, len(calset.exposures)
    hours = 24.0 * (e.mjd - e.mjd.min())
    kind = rng.choice(
        ["none", "drift", "settling", "step", "kelvin", "1/exptime", "order", "angle", "side", "kinds"],
        p=[0.37, 0.09, 0.05, 0.05, 0.08, 0.08, 0.05, 0.06, 0.05, 0.12],
    )
    star, value = 0.0, np.ones(n)
    if kind == "none":
        star = 1.0
    elif kind == "drift":
        value = (hours / hours.max()) ** rng.choice([0.7, 1.0, 1.5])
    elif kind == "settling":
        value = 1.0 - np.exp(-hours / (hours.max() * rng.uniform(0.1, 0.5)))
    elif kind == "step":
        value = 1.0 * (hours > rng.uniform(0.2, 0.8) * hours.max())
    elif kind == "kelvin":
        value = (e.temp - 10.0) / np.abs(e.temp - 10.0).max()
    elif kind == "1/exptime":
        value, star = e.exptime.min() / e.exptime, e.exptime.min() / STAR_SECONDS
    elif kind == "order":
        value = np.arange(n) / (n - 1.0)
    elif kind == "angle":
        value = np.where(
            e.clp_in,
            np.cos(rng.integers(1, 4) * np.radians(np.nan_to_num(e.clp_angle)) + rng.uniform(0, 6)),
            0,
        )
    elif kind == "side":
        angle = np.where(e.clp_in, np.nan_to_num(e.clp_angle), 0.0)
        value = np.where(e.clp_in & (np.diff(angle, prepend=angle[0]) > 0), 1.0, 0.0)
    else:
        names = np.unique(e.kind)
        some = rng.permutation(names)[: rng.integers(1, len(names))]
        value, star = 1.0 * np.isin(e.kind, some), float(rng.integers(2))
        kind = f"kinds {'+'.join(sorted(map(str, some)))}{' and stars' if star else ''}"
    return str(kind), value, star


def draw(rng: np.random.Generator, calset: CalibrationSet) -> Hidden:
    """One thing that is hidden in a set."""
    where = str(
        rng.choice(
            ["ahead of polariser", "polariser", "behind polariser", "behind collimator", "half 1", "half 2", "gain",
             "power of counts", "leak", "moon", "standards"],
            p=[0.11, 0.09, 0.13, 0.13, 0.08, 0.08, 0.16, 0.05, 0.05, 0.07, 0.05],
        )
    )  # fmt: skip
    field_name, field = over_field(rng)
    law_name, values, star = law(rng, calset)
    cameras = np.zeros(4)
    if rng.random() < 0.5:
        cameras[rng.integers(4)] = 1.0
    else:
        cameras[2 * rng.integers(2) :][:2] = 1.0, rng.choice([-1.0, 1.0])
    if where in ("moon", "standards"):
        star = 0.0
    size = 10.0 ** rng.uniform(-3.6, -2.1)
    made, colour = generators(rng), over_colour(rng)
    if (
        min(field(*(e.ravel() for e in np.meshgrid(EDGES, EDGES))).min(), colour(BAND).min(), values.min())
        < 0.0
    ):
        made[np.diag_indices(4)] = 0.0  # a depolariser with the other sign would polarise
    text = f"{where}, {field_name}, {law_name}, {size:.1e}"
    return Hidden(text, where, size, made, field, colour, values, star, cameras, rng.uniform(0.3, 2.0))


# --------------------------------------------------------------------------------------------------------------- a set


class Sealed(NamedTuple):
    """A set, the text of what is hidden, its true matrix at places between the points, and the set without it.

    `clean` has the same noise.
    """

    calset: CalibrationSet
    text: str
    x: np.ndarray
    y: np.ndarray
    matrix: np.ndarray
    clean: CalibrationSet
    homes: frozenset[str] = frozenset()


def observed(side: int, seed: int, rng: np.random.Generator) -> CalibrationSet:
    """The exposures: times, temperatures and places, with light that is replaced."""
    plan = ObservingPlan(
        grid=side, standard_grid=3, polariser_angles=polariser_turn(18), moon_patches=6, standards=6
    )
    calset = simulate(plan, seed=seed, noiseless=True).calset
    e, n = calset.exposures, len(calset.exposures)
    seconds = np.where(e.clp_in, np.array([3.0, 10.0, 30.0])[np.arange(n) % 3], 60.0)
    hours = 24.0 * (e.mjd - e.mjd.min())
    kelvin = 10.0 + rng.uniform(-2, 2) + rng.uniform(-0.6, 0.6) * hours + 0.2 * rng.standard_normal(n)
    return dataclasses.replace(calset, exposures=dataclasses.replace(e, exptime=seconds, temp=kelvin))


def sealed(number: int, seed: int, side: int) -> Sealed:
    """The set of a number."""
    rng = np.random.default_rng([number, seed, 53])
    calset = observed(side, 7 * seed + number, rng)
    with tempfile.TemporaryDirectory() as folder:
        write_calibration_set(Path(folder) / "set.fits", calset)
        data = forward.load(Path(folder) / "set.fits")
    params = forward.nominal(len(calset.sources.q))
    params |= {name: params[name] + w * rng.standard_normal() for name, w in forward.PRIOR_WIDTH.items()}
    params["eta_1"], params["eta_2"] = min(params["eta_1"], 1.0), min(params["eta_2"], 1.0)
    params["delta"] = 0.8 + 0.03 * rng.standard_normal()
    params["throughput"][:, 0] *= 1.0 + 0.03 * rng.standard_normal(4)
    params["throughput"][:, 1:] = 0.004 * rng.standard_normal((4, 14))
    sources = calset.sources
    params["q"], params["u"] = (
        np.asarray(getattr(sources, name))
        + getattr(sources, f"{name}_err") * rng.standard_normal(len(sources.q))
        for name in "qu"
    )
    what = ("nothing", "tables")[number % 12] if number % 12 < 2 else "physics"
    one = draw(rng, calset) if what == "physics" else None
    expected = counts(params, data, calset, one)
    counted = rng.poisson(np.clip(expected, 0.0, None)) + 5.0 * rng.standard_normal(expected.shape)
    sigma = np.sqrt(np.maximum(counted, 1.0) + 25.0)
    table = TableIntensities.of(calset.intensities, calset.points)
    order = {
        pair: row
        for row, pair in enumerate(zip(data["point"].tolist(), data["exposure"].tolist(), strict=True))
    }
    numbers = np.array(
        [order[pair] for pair in zip(table.point.tolist(), table.exposure.tolist(), strict=True)]
    )
    measured = dataclasses.replace(table, counts=counted[numbers], sigma=sigma[numbers])
    calset = dataclasses.replace(calset, intensities=measured, origin="sealed")
    text, taken = what if one is None else one.text, calset
    if what == "tables":
        text, calset = mistaken(rng, calset)
    x, y = rng.uniform(-0.25, 0.25, (2, PLACES))
    clean = taken
    if one is not None:
        kept = counts(params, data, calset, None) + (counted - expected)
        clean = dataclasses.replace(taken, intensities=dataclasses.replace(measured, counts=kept[numbers]))
    homes = homes_of(text, "") if one is None else homes_of(one.where, text.split(", ")[2])
    return Sealed(calset, text, x, y, truth(params, taken, x, y, one), clean, frozenset(homes))


def counts(
    params: dict[str, Any], data: dict[str, Any], calset: CalibrationSet, one: Hidden | None
) -> np.ndarray:
    """Expected counts of every row."""
    x, y = data["x"], data["y"]
    state = forward.source_states(params, data)
    row, g = data["point"], np.zeros(len(data["point"]))
    pattern = np.zeros(len(x))
    if one is not None:
        g, pattern = one.law[data["exposure"]], one.size * one.field(x, y)
        h = (g * pattern[row])[:, None]
        if one.where == "ahead of polariser":
            sky = ~data["clp_in"]
            state = np.where(sky[:, None], state + h * state @ one.generator.T, state)
        elif one.where == "polariser":  # a layer that turns with it
            two = 2 * np.radians(np.nan_to_num(data["clp_angle"]))
            back = np.stack([state[:, 0], *_turned(state, two), state[:, 3]], axis=1)
            own = h * (back @ one.generator.T) + 0.5 * h**2 * (back @ one.second.generator.T)
            turned = np.stack([own[:, 0], *_turned(own, -two), own[:, 3]], axis=1)
            state = np.where(data["clp_in"][:, None], state + turned, state)
        elif one.where in ("moon", "standards"):
            chosen = data["kind"] == ("moon" if one.where == "moon" else "standard")
            angle = 6.0 * one.generator[1, 2] + (0.0 if one.where == "moon" else 1.0) * data["source"]
            extra = np.stack(
                [np.zeros(len(row)), np.cos(angle) + 0 * g, np.sin(angle) + 0 * g, np.zeros(len(row))], 1
            )
            state = np.where(chosen[:, None], state + 3.0 * h * extra, state)
    light = np.zeros((len(row), 4))
    for number, (name, teff, _) in enumerate(data["configurations"]):
        here = data["configuration"] == number
        band = forward.gauss(*forward.band(*data["filters"][name][:2], teff), NODES)
        plain, added = vectors(params, x, y, band, one)
        seen = plain[row[here]] + g[here, None, None] * added[row[here]]
        if one is not None:
            square = vectors(params, x, y, band, one.second)[1]
            seen += (g[here] ** 2)[:, None, None] * square[row[here]]
        light[here] = np.einsum("rki,ri->rk", seen, state[here])
    brightness = np.random.default_rng(len(row)).uniform(0.7, 1.0, len(row))
    expected = 4.0 * ELECTRONS * brightness[:, None] * light
    if one is not None and one.where in ("gain", "power of counts", "leak"):
        change = (g * pattern[row])[:, None] * one.cameras
        if one.where == "gain":
            expected = expected * (1.0 + change)
        elif one.where == "power of counts":
            expected = expected * (1.0 + change * np.clip(expected / ELECTRONS, 0.0, None) ** one.gamma)
        else:
            other = expected[:, [1, 2, 3, 0]]
            expected = expected + np.abs(change) * other
    return expected


def _turned(state: np.ndarray, two: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Q and U referred to axes turned by half of an angle."""
    c, s = np.cos(two), np.sin(two)
    return state[:, 1] * c + state[:, 2] * s, state[:, 2] * c - state[:, 1] * s


def truth(
    params: dict[str, Any], calset: CalibrationSet, x: np.ndarray, y: np.ndarray, one: Hidden | None
) -> np.ndarray:
    """The true matrix (place, 6) as stars see it."""
    curve = calset.filters[str(calset.exposures.filter[0])]
    band = forward.gauss(*forward.band(curve.wavelength, curve.throughput, TEFF), NODES)
    plain, added = vectors(params, x, y, band, one)
    seen = plain
    if one is not None:
        h = one.star * one.size * one.field(x, y)
        seen = plain + one.star * added + one.star**2 * vectors(params, x, y, band, one.second)[1]
        if one.where == "ahead of polariser":
            seen = seen + h[:, None, None] * (seen @ one.generator)
        elif one.where == "gain":
            seen = seen * (1.0 + h[:, None] * one.cameras)[..., None]
        elif one.where == "leak":
            seen = seen + np.abs(h[:, None] * one.cameras)[..., None] * seen[:, [1, 2, 3, 0]]
    return np.stack(list(forward.instrument_matrix(seen).values()), axis=1)


def mistaken(rng: np.random.Generator, calset: CalibrationSet) -> tuple[str, CalibrationSet]:
    """The set with one mistake in its tables."""
    e, n = calset.exposures, len(calset.exposures)
    through, sky = np.flatnonzero(e.clp_in), np.flatnonzero(e.kind == "moon")
    kind = str(rng.choice(["clock", "angle", "pair", "rotator", "catalogue", "colour of a lamp", "band"]))
    size = 10.0 ** rng.uniform(-1.0, 0.7)
    if kind == "clock":
        new = dataclasses.replace(e, mjd=np.where(np.isin(np.arange(n), sky), e.mjd + 0.02 * size, e.mjd))
    elif kind == "angle":
        angle = e.clp_angle.copy()
        angle[rng.choice(through)] += 0.1 * size
        new = e.placed(CLP=Position(e.clp_in, angle))
    elif kind == "pair":
        angle = e.clp_angle.copy()
        i = int(rng.integers(len(through) - 1))
        angle[through[[i, i + 1]]] = angle[through[[i + 1, i]]]
        new = e.placed(CLP=Position(e.clp_in, angle))
    elif kind == "rotator":
        new = dataclasses.replace(e, rotator=e.rotator + 0.3 * size)
    elif kind == "catalogue":
        factor = 1.0 + 0.02 * size
        changed = dataclasses.replace(
            calset.sources, q=calset.sources.q * factor, u=calset.sources.u * factor
        )
        return f"tables: standards × {factor:.3f}", dataclasses.replace(calset, sources=changed)
    elif kind == "colour of a lamp":
        new = dataclasses.replace(e, teff=np.where(e.clp_in, np.nan_to_num(e.teff, nan=3200.0) * 1.3, e.teff))
    else:
        moved = {
            k: dataclasses.replace(f, wavelength=f.wavelength + 0.002 * size)
            for k, f in calset.filters.items()
        }
        return f"tables: band by {2 * size:.2g} nm", dataclasses.replace(calset, filters=moved)
    return f"tables: {kind} ({size:.2g})", dataclasses.replace(calset, exposures=new)


# -------------------------------------------------------------------------------------------------------------- rates


class Outcome(NamedTuple):
    """What became of a set."""

    text: str
    held: float = np.nan
    before: Judged | None = None
    after: Judged | None = None
    verdict: str = ""
    p: float = 0.0
    has_class: bool = False
    seconds: float = np.nan
    right: str = ""


def outcome(number: int, options: argparse.Namespace) -> Outcome:
    """Fit and diagnose the set of a number."""
    one, began = sealed(number, options.seed, options.side), time.process_time()

    def became(**what: Any) -> Outcome:
        return Outcome(one.text, seconds=time.process_time() - began, **what)

    try:
        fitted = examined(refit(one.calset))
    except (DataError, ValueError) as error:
        return became(verdict=refusal_of(error))
    held = 0.0 if one.clean is one.calset else fitted.expansion.data - refit(one.clean).expansion.data
    before = judged(Calibration.from_fit(fitted), bool(fitted.trusted), one) if fitted.converged else None
    of_fit = {"held": held, "before": before}
    if options.refit_only:
        after = judged(_with_undetected(fitted), True, one) if fitted.trusted else None
        return became(**of_fit, after=after, p=np.nan)
    try:
        found = diagnose(one.calset, minutes=options.minutes)
    except (DataError, ValueError) as error:
        return became(**of_fit, verdict=refusal_of(error))
    return became(
        **of_fit,
        after=judged(found.calibration(), is_trusted(found), one),
        verdict=verdict_of(found),
        p=found.p_value,
        has_class=found.members.several,
        right=right_of(one, found),
    )


def is_trusted(diagnosis: Diagnosis) -> bool:
    """True if the product of a diagnosis may be used."""
    return diagnosis.after.trusted and diagnosis.verdict != "unexplained"


def verdict_of(diagnosis: Diagnosis) -> str:
    """The verdict, with the names and descriptions that were added."""
    names = (
        "; ".join(dict.fromkeys(c.candidate for c, *_ in step.descriptions))
        if step.descriptions
        else step.effect
        for step in diagnosis.steps
    )
    return f"{diagnosis.verdict} {', '.join(names)}".strip()


def refusal_of(error: Exception) -> str:
    """The verdict on a set that is refused."""
    return f"refused: {str(error)[:80]}"


def _with_undetected(fitted: FitResult) -> Calibration:
    """The calibration of a diagnosis that adds nothing to a fit."""
    state = examine(fitted, Hypotheses(), np.random.default_rng(0))
    return Calibration.from_fit(with_average(fitted, ambiguities(state, {})))


def line(number: int, one: Outcome) -> str:
    """The outcome of a set in a line."""

    def words(judged: Judged | None) -> str:
        if judged is None:
            return "no product"
        worst = np.median(np.abs(judged.elements), axis=0).max()
        trusted = "trusted" if judged.trusted else "not trusted"
        wrong = " and WRONG" * (judged.trusted and judged.wrong)
        return f"{trusted}{wrong} {judged.error:.1e} {100 * judged.beyond:.0f}% {worst:.1f}σ"

    return (
        f"{number}: {one.text} | Δχ² {one.held:.0f} | {words(one.before)} | p {one.p:.1e} {one.verdict} | "
        f"{words(one.after)} | {one.right or '-'} | {one.seconds:.0f} s"
    )


def sayable(text: str) -> bool:
    """True if descriptions hold exactly what is hidden: alike over the field, with a law that they have."""
    if text == "nothing" or text.startswith("tables"):
        return text != "nothing"
    where, field, law, *_ = text.split(", ")
    single = {"step", "1/exptime", "order", "side"} if where in ("polariser", "gain") else set()
    return field == "uniform" and where != "power of counts" and law in {"none", "kelvin"} | single


def table(outcomes: list[Outcome]) -> str:
    """Rates, as they are asked for."""
    rows: list[tuple[str, str]] = []

    def rate(words: str, those: Iterable[bool]) -> None:
        counted = list(those)
        count, of = sum(counted), len(counted)
        text = f"{count} of {of}"
        if of:
            low, high = (100 * float(limit) for limit in binomtest(count, of).proportion_ci(0.95))
            text += f" ({100 * count / of:.1f} %; 95 %: {low:.1f} to {high:.1f} %)"
        rows.append((words, text))

    products = [o for o in outcomes if o.after is not None]
    judged = {
        "fit": [(o, o.before) for o in outcomes if o.before is not None],
        "diagnosis": [(o, o.after) for o in outcomes if o.after is not None],
    }
    for name, some in judged.items():
        rate(f"{name}: trusted", (j.trusted for _, j in some))
        trusted = [(o, j) for o, j in some if j.trusted]
        wrong = f"{name}: trusted and wrong"
        rate(f"{wrong}, Δχ² of the truth ≥ {HELD:g}", (j.wrong for o, j in trusted if o.held >= HELD))
        rate(f"{wrong}, all", (j.wrong for _, j in trusted))
        rate(f"{wrong}, by stars", (j.beyond > FEW for _, j in trusted))
        rate(f"{wrong}, something stated", (j.wrong for o, j in trusted if o.right and name == "diagnosis"))
        for least in (-np.inf, HELD):
            chances = [j.chance for o, j in trusted if o.held >= least]
            words = f"{name}: by chance, from their own covariances" + f", Δχ² ≥ {least:g}" * (least == HELD)
            rows.append((words, f"{sum(chances):.1f} of {len(chances)}"))
    both = [(o, o.before, o.after) for o in products if o.before is not None and o.after is not None]
    rate(
        "matrix worse by more than 1.2 × after the diagnosis", (a.error > WORSE * b.error for _, b, a in both)
    )
    above = (a.error > WORSE * max(b.error, a.stated) for _, b, a in both)
    rate("that, and worse than its own errors say by as much", above)
    rate("matrix worse, and trusted", (a.trusted and a.error > WORSE * b.error for _, b, a in both))
    rate("fit trusted while the diagnosis has p < 10⁻⁴", (b.trusted and o.p < 1e-4 for o, b, _ in both))
    null = [o for o in outcomes if o.text == "nothing"]
    rate("nothing hidden: alarms", (not o.verdict.startswith("consistent") for o in null))
    rate("nothing hidden: fits not trusted", (o.before is None or not o.before.trusted for o in null))
    rate(
        f"unexplained, of those with Δχ² ≥ {HELD:g}",
        ("unexplained" in o.verdict for o in products if o.held >= HELD),
    )
    strong = [o for o in products if sayable(o.text) and o.held >= CLEAR]
    rate(
        f"can be said, Δχ² ≥ {CLEAR:g}: right or in the class",
        (o.right in ("right", "class") for o in strong),
    )
    rate(
        "something stated, and nothing of it or of its class is true", (o.right == "wrong" for o in products)
    )
    whole = (o.right == "wrong" and o.verdict.startswith("effect_found") for o in products)
    rate("that, as the whole explanation", whole)
    stated = [o.right for o in products if o.right]
    rows.append(
        (
            "stated: right; or in the class",
            f"{stated.count('right')}; {stated.count('class')} of {len(stated)}",
        )
    )
    with_class = [(o, o.after) for o in products if o.has_class and o.after is not None]
    for explained in (False, True):
        judged_so = [a for o, a in with_class if not explained or o.verdict.startswith("effect_found")]
        for what in ("stars", "elements") if judged_so else ():
            pulls = np.concatenate([getattr(a, what).ravel() for a in judged_so])
            inside = ", ".join(f"{100 * np.mean(np.abs(pulls) < k):.0f}" for k in (1.0, 2.0))
            words = f"products with a class{', explained' * explained}: pulls of {what} rms; inside 1σ, 2σ"
            rows.append((words, f"{np.sqrt(np.mean(pulls**2)):.2f}; {inside} %"))
    return "\n".join(f"{name:75s} {value}" for name, value in rows)


def main() -> int:
    parser = options_of(__doc__, sets=400, first=0, seed=53, side=8, minutes=3.0)
    parser.add_argument("--budget", type=float, default=np.inf, help="minutes after which no set is begun")
    parser.add_argument("--refit-only", action="store_true")
    parser.add_argument("--save", type=Path, help="file of the outcomes so far, written after every set")
    parser.add_argument("--join", type=Path, nargs="+", help="files of outcomes: print their table")
    options = parser.parse_args()
    if options.join:
        print(table([one for file in options.join for one in pickle.loads(file.read_bytes())]))
        return 0
    jax.config.update("jax_enable_x64", True)
    outcomes, end = [], time.monotonic() + 60.0 * options.budget
    for number in range(options.first, options.first + options.sets):
        if time.monotonic() > end:
            break
        outcomes.append(outcome(number, options))
        print(line(number, outcomes[-1]), flush=True)
        if options.save:
            options.save.write_bytes(pickle.dumps(outcomes))
        jax.clear_caches()  # the programs of every set are others
    print(table(outcomes))
    return 0


if __name__ == "__main__":
    sys.exit(main())
