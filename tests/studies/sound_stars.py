"""Are sound catalogues of stars quiet, of any instrument and size? And how many stars show an exchange inside an arm?

    python tests/studies/sound_stars.py [--sound 500] [--each 20] [--only DESIGN]

Sound: catalogues of five designs (WALOP-SOUTH with and without its calibration plate, WALOP-NORTH, WALOP-LAB, two
beams behind a half-wave plate that turns), 30 to 10⁵ stars of 10³ to 10⁷ electrons a camera, of one or three nights,
with and without TEFF, through instruments that differ from the calibration by errors drawn from its covariance. A
catalogue is quiet if `apply` says nothing against it: no other reading, no change, no place, no error that is off; and
`check` as little: no history of any change, no error that is off. A single exposure of WALOP-NORTH has no camera to
spare, of which `check` says just that.

Inside an arm: stars of WALOP-SOUTH with interstellar polarisation that is structured over the field; O1 and E1 are
exchanged, or O1 is 1 % brighter against E1. Printed is how many of catalogues of so many stars tell it, and for the one
per cent the share that the bound promises: a normal number of the size over its error, which is known from the noise
and the scatter of the stars' own polarisation, beyond the alarm.
"""

from __future__ import annotations

import dataclasses
import functools
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from one_arm import POLARISER, one_arm  # noqa: E402
from scipy import special  # noqa: E402
from small_run import SEED, SMALL, WITH_PLATE  # noqa: E402
from study_options import options_of  # noqa: E402

from walop_jax.calibration.analysis_vectors import AnalysisVectors  # noqa: E402
from walop_jax.calibration.calibration import Calibration  # noqa: E402
from walop_jax.data.settings import Settings  # noqa: E402
from walop_jax.data.user_tables import in_memory  # noqa: E402
from walop_jax.fit.base_model import base_model  # noqa: E402
from walop_jax.fit.refit import refit  # noqa: E402
from walop_jax.io.errors import DataError  # noqa: E402
from walop_jax.model.instrument import Instrument  # noqa: E402
from walop_jax.science import apply as application  # noqa: E402
from walop_jax.science import watch as watching  # noqa: E402
from walop_jax.science.apply import Stars, apply  # noqa: E402
from walop_jax.science.catalogue import Catalogue, read_catalogue  # noqa: E402
from walop_jax.science.star_columns import ALARM, threshold  # noqa: E402
from walop_jax.science.watch import with_rivals  # noqa: E402
from walop_jax.simulation.observing_plan import ObservingPlan  # noqa: E402
from walop_jax.simulation.simulate import simulate  # noqa: E402

SIZES = {30: 0.3, 100: 0.3, 300: 0.2, 1000: 0.12, 10_000: 0.07, 100_000: 0.01}
"""Stars of a catalogue, and the share of catalogues that have so many."""
INSIDE = (30, 60, 120, 250, 500, 1000, 4000)
Positions = tuple[dict[str, float | None], ...]


@dataclasses.dataclass(frozen=True)
class Design:
    """A plan whose fit is the calibration, and the positions of moving elements at which each star is seen."""

    plan: ObservingPlan
    positions: Positions


TURNING = (
    POLARISER
    + """
[elements.plate]
kind = "retarder"
moves = "HWP"
delta = { value = 3.1416, sigma = 0.02, unit = "rad" }
axis = { value = 0.0, sigma = 0.5, unit = "deg" }
"""
)


def dual_beam() -> Instrument:
    """Two beams behind a half-wave plate that turns, as most polarimeters have them."""
    text = one_arm("DUAL", ["polariser", "plate"], TURNING, field="limit = 0.2", degree=1)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "dual.toml"
        file.write_text(text)
        return Instrument.read(file)


@functools.cache
def designs() -> dict[str, Design]:
    """The designs by name."""
    turned = (0.0, 22.5, 45.0, 67.5)
    dual = ObservingPlan(
        dual_beam(), grid=5, moon_patches=0, standards=3, moving={"HWP": turned}, throughput_degree=1
    )
    return {
        "WALOP-SOUTH": Design(SMALL, ({},)),
        "WALOP-SOUTH with its plate": Design(WITH_PLATE, ({"CHWP": None}, {"CHWP": 22.5})),
        "WALOP-NORTH": Design(dataclasses.replace(SMALL, instrument="WALOP-NORTH"), ({},)),
        "WALOP-LAB": Design(ObservingPlan("WALOP-LAB", standards=3, moon_patches=3), ({},)),
        "two beams": Design(dual, tuple({"HWP": angle} for angle in turned)),
    }


@functools.cache
def vectors(name: str) -> AnalysisVectors:
    """Those of the calibration of a design."""
    plan = designs()[name].plan
    calset = simulate(plan, seed=SEED).calset
    own = plan.instrument if isinstance(plan.instrument, Instrument) else None
    return AnalysisVectors(Calibration.from_fit(refit(calset, base_model(calset, own)).with_verdict()))


def true_vectors(v: AnalysisVectors, setting: Settings, x: Any, y: Any, change: Any) -> np.ndarray:
    """Analysis vectors of an instrument whose parameters differ by `change` from those of the calibration."""
    teff, setting = np.full(len(x), 5500.0), v.reduced(setting)
    local = v.derivatives(setting, x, y, teff)
    series = np.einsum("pkst,pm->pkstm", local.throughput, v.basis(x, y))
    slopes = np.concatenate([local.plain, series.reshape(*series.shape[:3], -1)], axis=-1)
    return v.coloured(setting, x, y, teff) + slopes @ change


def catalogue(name: str, count: int, seed: int) -> Catalogue:
    """A sound catalogue of so many stars."""
    rng, v, design = np.random.default_rng([count, seed]), vectors(name), designs()[name]
    calibration = v.calibration
    instrument = calibration.model.template.patched()
    off = v.root @ rng.standard_normal(v.root.shape[1])
    place = rng.uniform(-1.0, 1.0, (2, count)) * 0.9 * float(np.abs(calset_field(name)).max())
    if name == "WALOP-LAB":
        place[1] = 0.0
    x, y = place
    p, angle = rng.uniform(0.0, 0.05, count), rng.uniform(0.0, np.pi, count)
    s = np.stack([np.ones(count), p * np.cos(2 * angle), p * np.sin(2 * angle)], axis=1)
    flux = 10.0 ** rng.uniform(3.0, 7.0, count)[:, None]
    night = rng.integers(0, 1 + 2 * (seed % 2), count)
    rows = []
    for positions in design.positions:
        a = true_vectors(v, Settings.default(1).at(**positions), x, y, off)
        counts = 4.0 * flux * np.einsum("pks,ps->pk", a, s)
        error = np.sqrt(np.maximum(counts, 0.0) + 400.0)
        there = {"ID": np.arange(count), "X": x, "Y": y, "N_ERR": error, "MJD": 60000.0 + night}
        there["N"] = counts + error * rng.standard_normal(counts.shape)
        if seed % 3:
            there["TEFF"] = np.full(count, 5500.0)
        for prefix, position in positions.items():
            there[f"{prefix}_ANGLE"] = np.full(count, np.nan if position is None else position)
        rows.append(there)
    table = in_memory({key: np.concatenate([r[key] for r in rows]) for key in rows[0]})
    moved = {"always_in": calibration.always_in, "never_in": calibration.never_in}
    return read_catalogue(table, instrument, **moved, filters=tuple(calibration.filters))


@functools.cache
def calset_field(name: str) -> np.ndarray:
    """Positions (deg) of the points of the calibration."""
    points = simulate(designs()[name].plan, seed=SEED).calset.points
    return np.stack([points.x, points.y])


def said(found: Stars, stars: Catalogue) -> str:
    """The first sentence against a catalogue; empty where it is quiet."""
    return next(iter((*stars.doubts, *found.check.warnings())), "")


def reduced(name: str, stars: Catalogue) -> Stars:
    """The stars by the tables of a design, made once."""
    tables, made = vectors(name), AnalysisVectors
    application.AnalysisVectors = lambda held: tables if held is tables.calibration else made(held)
    return apply(tables.calibration, stars)


@functools.cache
def tables_of_check(name: str) -> AnalysisVectors:
    """Those of the calibration of a design with the optics that may have changed beside its parameters."""
    return AnalysisVectors(with_rivals(vectors(name).calibration))


def watched(name: str, stars: Catalogue) -> str:
    """The first sentence of `check` against a catalogue by the tables of a design, made once; empty: none."""
    tables = vectors(name)
    watching.AnalysisVectors = lambda held: tables if held is tables.calibration else tables_of_check(name)
    try:
        return next(iter(watching.watch(tables.calibration, [stars]).warnings), "")
    except DataError as error:
        if name != "WALOP-NORTH" or "no star has a camera to spare" not in str(error):
            raise
        return ""


def sound(total: int, only: str) -> None:
    """Print the false alarms of sound catalogues, design by design, of those designs that hold a word."""
    alarms = 0
    each = -(-total // len(designs()))
    for name in (name for name in designs() if only in name):
        start, mine, number = time.process_time(), 0, 0
        for count, share in SIZES.items():
            for seed in range(round(share * each)):
                stars = catalogue(name, count, seed)
                told = {"apply": said(reduced(name, stars), stars), "check": watched(name, stars)}
                number += 1
                mine += any(told.values())
                for command, text in told.items():
                    if text:
                        print(f"  {command} of {name}, {count} stars, seed {seed}: {text}", flush=True)
        alarms += mine
        print(f"{name}: {mine} alarms in {number} ({time.process_time() - start:.0f} s)", flush=True)
    print(f"all: {alarms} alarms", flush=True)


# ------------------------------------------------------------------------------------------------ inside an arm


def interstellar(x: np.ndarray, y: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """q and u of stars: a mean of a per cent, structure of the field, and a scatter of their own."""
    qu = np.outer(np.ones(len(x)), rng.normal(0.0, 0.01, 2)) + rng.normal(0.0, 0.004, (len(x), 2))
    for _ in range(6):
        phase, way = rng.uniform(0.0, 2.0 * np.pi), rng.normal(0.0, 6.0, 2)
        qu += 0.002 * np.outer(np.cos(way[0] * x + way[1] * y + phase), rng.normal(0.0, 1.0, 2))
    return qu


def inside(count: int, seed: int, change: str) -> tuple[bool, bool, float]:
    """Of a catalogue with a change inside an arm: is it said, is it named, and the share that the bound promises."""
    name = "WALOP-SOUTH"
    rng, v = np.random.default_rng([count, seed, 7]), vectors(name)
    x, y = rng.uniform(-0.27, 0.27, (2, count))
    s = np.column_stack([np.ones(count), interstellar(x, y, rng)])
    a = true_vectors(v, Settings.default(1), x, y, v.root @ rng.standard_normal(v.root.shape[1]))
    counts = 10.0 ** rng.uniform(4.6, 6.6, count)[:, None] * np.einsum("pks,ps->pk", a, s) / 0.25
    size = 0.01
    if change == "balance":
        counts = counts * np.array([1.0 + 0.5 * size, 1.0 - 0.5 * size, 1.0, 1.0])
    error = np.sqrt(counts + 400.0)
    n = counts + error * rng.standard_normal(counts.shape)
    if change == "exchange":
        n, error = n[:, [1, 0, 2, 3]], error[:, [1, 0, 2, 3]]
    table = in_memory({"X": x, "Y": y, "N": n, "N_ERR": error, "TEFF": np.full(count, 5500.0)})
    stars = read_catalogue(table, v.calibration.model.template.patched())
    found = reduced(name, stars)
    text, own = said(found, stars), found.check.own
    if change == "exchange":
        return bool(text), "in the order E1, O1, O2, E2" in text, np.nan
    mine = None if own is None else next(t for t in own.tests if t.cameras == ("O1", "E1"))
    promised = 0.0
    if own is not None and mine is not None and np.isfinite(mine.error):
        alarm = threshold(ALARM / len(own.tests))
        promised = float(special.ndtr(size / mine.error - alarm) + special.ndtr(-size / mine.error - alarm))
    named = own is not None and any(c.cameras == ("O1", "E1") and c.size > 0 for c in own.alike)
    return bool(text), named, promised


def main() -> None:
    """Print the study."""
    parser = options_of(__doc__, sound=500, each=20)
    parser.add_argument("--only", default="")
    given = parser.parse_args()
    for count in INSIDE:
        for change in ("exchange", "balance"):
            if not given.each:
                continue
            answers = np.array([inside(count, seed, change) for seed in range(given.each)], float)
            text, named, promised = answers.mean(axis=0)
            bound = f", the bound promises {100 * promised:.0f} %" if change == "balance" else ""
            print(
                f"{change}, {count} stars: said {100 * text:.0f} %, named {100 * named:.0f} %{bound}",
                flush=True,
            )
    sound(given.sound, given.only)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
