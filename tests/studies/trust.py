"""Is what is trusted right, and what is right trusted? Sealed sets: sound ones, mistakes in the data, hidden effects.

    python tests/studies/trust.py [--sets 600] [--first 0] [--seed 77]

A third of the sets each: sound; with one mistake of `mistakes`, at a size that is drawn over two and a half decades,
from invisible to gross; with one effect of the catalogue at a size that is drawn over two decades. What a set gets
depends on its number and the seed alone. Each is fitted with the base model and examined. It is judged star by star:
stars polarised by 2 % are calibrated, at the field points where |det| of the matrix is 0.1 or more, with the matrix of
the fit, and the calibration is wrong if q or u is off by more than three times its stated errors (rms over the stars,
the worse of the two), against the instrument that made the data, gains of single field points included. Of what is
trusted and wrong the right reading of the same data is fitted as well: where that gains less than Δχ² = 30, the data do
not hold what would give the mistake away. Printed is each set, and how many of each kind were trusted or not, right or
wrong.
"""

from __future__ import annotations

import contextlib
import dataclasses
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from changed_sets import block_of, with_block  # noqa: E402
from small_run import SMALL  # noqa: E402
from study_options import options_of  # noqa: E402

from walop_jax.calibration.calibration import Calibration  # noqa: E402
from walop_jax.calibration.matrix import sky_vectors  # noqa: E402
from walop_jax.data.records import CalibrationSet, Position  # noqa: E402
from walop_jax.data.settings import Settings  # noqa: E402
from walop_jax.diagnosis.trust import examined  # noqa: E402
from walop_jax.fit.refit import refit  # noqa: E402
from walop_jax.io.errors import DataError  # noqa: E402
from walop_jax.model import light  # noqa: E402
from walop_jax.model.effects import EFFECTS  # noqa: E402
from walop_jax.model.effects.in_models import with_effects  # noqa: E402
from walop_jax.model.instrument import Instrument  # noqa: E402
from walop_jax.model.planning import plan_for_settings  # noqa: E402
from walop_jax.simulation.simulate import simulate  # noqa: E402

WRONG = 3.0
HELD = 30.0
"""Δχ² of the right reading from which the data hold what tells it from the wrong one."""
Change = Callable[[CalibrationSet], CalibrationSet]


class Judged(NamedTuple):
    """What was hidden in a set, whether its fit is trusted, and the error of its stars over the stated one.

    `gain` is the Δχ² of the right reading, asked of what is trusted and wrong (else nan).
    """

    kind: str
    what: str
    trusted: bool
    off: float
    gain: float = np.nan

    @property
    def cell(self) -> str:
        """Trusted or not, right or wrong; of what is trusted and wrong, whether the data could tell."""
        if not self.trusted:
            return f"not trusted, {'wrong' if self.off > WRONG else 'right'}"
        if self.off <= WRONG:
            return "trusted, right"
        return f"trusted, wrong, {'seen' if self.gain >= HELD else 'not seen'} by the data"


class UndetectedError(NamedTuple):
    """A set changed, and what the gains of the cameras at its field points became: (point, camera), 1 for most."""

    calset: CalibrationSet
    gains: np.ndarray


def mistakes(rng: np.random.Generator) -> dict[str, Callable[[CalibrationSet], UndetectedError]]:
    """One mistake of each kind; those with a size have it drawn: 1 is about what the data just show."""
    size = 10.0 ** rng.uniform(-1.5, 1.0)

    def plain(change: Change) -> Callable[[CalibrationSet], UndetectedError]:
        return lambda calset: UndetectedError(change(calset), np.ones((len(calset.points), calset.cameras)))

    def counted(
        change: Callable[[CalibrationSet, np.ndarray], np.ndarray],
    ) -> Callable[[CalibrationSet], UndetectedError]:
        return plain(lambda c: with_block(c, counts=change(c, block_of(c).counts.copy())))

    def columns(**changed: Callable[[CalibrationSet], Any]) -> Callable[[CalibrationSet], UndetectedError]:
        def change(c: CalibrationSet) -> CalibrationSet:
            e = dataclasses.replace(c.exposures, **{name: new(c) for name, new in changed.items()})
            return dataclasses.replace(c, exposures=e)

        return plain(change)

    def displaced(calset: CalibrationSet) -> CalibrationSet:
        points = dataclasses.replace(calset.points, x=calset.points.x + 0.003 * size)
        return with_block(dataclasses.replace(calset, points=points), x=points.x)

    def camera(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[CalibrationSet], UndetectedError]:
        def changed(_: CalibrationSet, counts: np.ndarray) -> np.ndarray:
            k = rng.integers(counts.shape[-1])
            counts[..., k] = change(counts[..., k])
            return counts

        return counted(changed)

    def scattered(_: CalibrationSet, counts: np.ndarray) -> np.ndarray:
        share = 1e-3 * size * rng.uniform(0.0, 1.0, counts.shape[-1])
        return counts + share * np.median(counts, axis=0)

    def leaking(_: CalibrationSet, counts: np.ndarray) -> np.ndarray:
        a, b = rng.permutation(counts.shape[-1])[:2]
        counts[..., a] += 1e-3 * size * counts[..., b]
        return counts

    def flickering(_: CalibrationSet, counts: np.ndarray) -> np.ndarray:
        e, k = rng.integers(counts.shape[1]), rng.integers(counts.shape[2])
        counts[:, e, k] *= 1.0 + 1e-3 * size
        return counts

    def drifting(_: CalibrationSet, counts: np.ndarray) -> np.ndarray:
        k = rng.integers(counts.shape[2])
        counts[..., k] *= 1.0 + 1e-3 * size * np.linspace(-1.0, 1.0, counts.shape[1])
        return counts

    def pedestal_of_standards(calset: CalibrationSet, counts: np.ndarray) -> np.ndarray:
        counts[:, calset.exposures.kind == "standard"] += 2000.0 * size
        return counts

    def rough(share: float) -> Callable[[CalibrationSet], UndetectedError]:
        def change(calset: CalibrationSet) -> UndetectedError:
            there = block_of(calset).counts
            shape = (there.shape[0], there.shape[2])
            gains = 1.0 + 5e-4 * size / np.sqrt(share) * rng.standard_normal(shape) * (
                rng.random(shape) < share
            )
            return UndetectedError(with_block(calset, counts=there * gains[:, None]), gains)

        return change

    def misplaced(_: CalibrationSet, counts: np.ndarray) -> np.ndarray:
        k, share = rng.integers(counts.shape[2]), min(0.01 * size, 1.0)
        counts[..., k] = (1.0 - share) * counts[..., k] + share * np.roll(counts[..., k], 1, axis=0)
        return counts

    def dark(_: CalibrationSet, counts: np.ndarray) -> np.ndarray:
        counts[..., rng.integers(counts.shape[2])] = 0.0
        return counts

    def glitch(calset: CalibrationSet) -> dict[str, Position]:
        angle = calset.exposures.clp_angle.copy()
        angle[rng.choice(np.flatnonzero(calset.exposures.clp_in))] += 0.05 * size
        return {**calset.exposures.positions, "CLP": Position.at(angle)}

    def lamp(calset: CalibrationSet) -> np.ndarray:
        e = calset.exposures
        return e.teff * np.where(e.kind == "clp", 1.0 - 0.3 * min(size, 2.0), 1.0)

    def of_date(calset: CalibrationSet) -> np.ndarray:
        e = calset.exposures
        return np.where(e.kind == "moon", e.ra + 0.3 * size, e.ra)

    def catalogue(calset: CalibrationSet) -> CalibrationSet:
        q = calset.sources.q.copy()
        q[rng.integers(len(q))] += 0.001 * size
        return dataclasses.replace(calset, sources=dataclasses.replace(calset.sources, q=q))

    def curve(calset: CalibrationSet) -> CalibrationSet:
        moved = {
            name: dataclasses.replace(f, wavelength=f.wavelength + 0.002 * size)
            for name, f in calset.filters.items()
        }
        return dataclasses.replace(calset, filters=moved)

    def errors_of_one(calset: CalibrationSet) -> CalibrationSet:
        sigma = block_of(calset).sigma.copy()
        sigma[..., rng.integers(sigma.shape[2])] *= 1.0 + 0.3 * size
        return with_block(calset, sigma=sigma)

    return {
        "light left in": counted(lambda _, counts: counts + 500.0 * size),
        "field displaced": plain(displaced),
        "dark camera": counted(dark),
        "errors too large": plain(lambda c: with_block(c, sigma=100.0 * block_of(c).sigma)),
        "errors too small": plain(lambda c: with_block(c, sigma=0.01 * block_of(c).sigma)),
        "errors of one camera": plain(errors_of_one),
        "lamp of another temperature": columns(teff=lamp),
        "cameras exchanged": plain(
            lambda c: with_block(
                c, counts=block_of(c).counts[..., [2, 3, 0, 1]], sigma=block_of(c).sigma[..., [2, 3, 0, 1]]
            )
        ),
        "polariser backwards": columns(
            positions=lambda c: {**c.exposures.positions, "CLP": Position.at(-c.exposures.clp_angle)}
        ),
        "polariser off once": columns(positions=glitch),
        "camera not linear": camera(lambda counts: counts * (1.0 - 3e-4 * size * counts / 1e6)),
        "scattered light": counted(scattered),
        "light of another camera": counted(leaking),
        "one exposure of a camera": counted(flickering),
        "camera that drifts": counted(drifting),
        "sky left in standards": counted(pedestal_of_standards),
        "gains of field points": rough(1.0),
        "dust on a few field points": rough(0.1),
        "points misplaced in one camera": counted(misplaced),
        "sky coordinates": columns(ra=of_date),
        "clock": columns(mjd=lambda c: c.exposures.mjd + 0.01 * size),
        "rotator": columns(rotator=lambda c: c.exposures.rotator + 0.2 * size),
        "catalogue of standards": plain(catalogue),
        "filter curve": plain(curve),
    }


def off_by(calibration: Calibration, truth: Instrument, calset: CalibrationSet, gains: np.ndarray) -> float:
    """Error of calibrated q and u over the stated one, rms over the stars at the field points, the worse of both.

    A star s = (q, u) has m = m₀ + A s in the true instrument; the calibration makes A⁻¹(m − m₀) of it.
    """
    x, y = calset.points.x, calset.points.y
    setting = Settings.default(len(x), "SDSS-r")
    made, covariance = calibration.matrix(x, y, setting)
    plan = plan_for_settings(truth, setting[:1], calset.filters)
    vectors = sky_vectors(truth, plan, x, y)[:, 0] * gains[:, :, None]
    true = np.asarray(light.instrument_matrix(jnp.asarray(vectors), truth.cameras.pairs))
    made = made.reshape(true.shape)
    good = np.abs(np.linalg.det(made[:, :, 1:])) >= 0.1
    angle = np.random.default_rng(5).uniform(0.0, 2.0 * np.pi, len(x))
    star = np.stack([np.ones(len(x)), 0.02 * np.cos(angle), 0.02 * np.sin(angle)], axis=1)[good]
    inverse = np.linalg.inv(made[good][:, :, 1:])
    error = np.einsum("pij,pjk,pk->pi", inverse, (true - made)[good], star)
    slope = np.einsum("pij,pk->pijk", inverse, star).reshape(len(star), 2, 6)
    stated = np.sqrt(np.einsum("pia,pab,pib->pi", slope, covariance[good], slope))
    return float(np.sqrt(np.mean((error / stated) ** 2, axis=0)).max())


def judged(number: int, seed: int) -> Judged:
    """One sealed set, fitted and held against the truth."""
    rng = np.random.default_rng([number, seed])
    kind = ("sound", "mistake", "hidden effect")[number % 3]
    what, effects = "", ()
    if kind == "hidden effect":
        effect = EFFECTS[int(rng.integers(len(EFFECTS)))]
        what, context = effect.name, SMALL.context()
        neutral = effect.of(context)
        size = {
            name: np.asarray(getattr(neutral, name))
            + 10.0 ** rng.uniform(-1.5, 0.5)
            * effect.numbers()[name].width
            * rng.standard_normal(np.shape(getattr(neutral, name)))
            for name in effect.amplitudes()
        }
        size |= {name: np.abs(size[name]) for name in effect.one_sided}
        made = None
        while made is None:  # what would take more light away than there is is made smaller
            effects = (effect.of(context, **{n: v.tolist() for n, v in size.items()}),)
            with contextlib.suppress(ValueError):
                made = simulate(SMALL, seed=1000 * seed + number, effects=effects)
            size = {name: value / 2.0 for name, value in size.items()}
    else:
        made = simulate(SMALL, seed=1000 * seed + number)
    data, gains = made.calset, np.ones((len(made.calset.points), made.calset.cameras))
    if kind == "mistake":
        chosen = mistakes(rng)
        what = list(chosen)[int(rng.integers(len(chosen)))]
        data, gains = chosen[what](data)
    try:
        result = examined(refit(data))
    except (DataError, ValueError):
        return Judged(kind, what, trusted=False, off=np.inf)
    if not result.converged:
        return Judged(kind, what, trusted=False, off=np.inf)
    calibration = Calibration.from_fit(result)
    off = off_by(calibration, made.truth, made.calset, gains)
    if not result.trusted or off <= WRONG:
        return Judged(kind, what, bool(result.trusted), off)
    right = refit(made.calset, with_effects(result.model, effects, SMALL.context()) if effects else None)
    return Judged(kind, what, trusted=True, off=off, gain=result.chi2 - right.chi2)


def main() -> int:
    options = options_of(__doc__, sets=600, first=0, seed=77).parse_args()
    jax.config.update("jax_enable_x64", True)
    found: Counter[tuple[str, str]] = Counter()
    for number in range(options.first, options.first + options.sets):
        one = judged(number, options.seed)
        found[one.kind, one.cell] += 1
        print(
            f"{number}: {one.kind} {one.what}: {one.cell} ({one.off:.2f} × stated, {one.gain:.1f})",
            flush=True,
        )
    for (kind, cell), times in sorted(found.items()):
        print(f"{kind}: {cell}: {times}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
