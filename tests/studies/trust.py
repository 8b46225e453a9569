"""Is what is trusted right, and what is right trusted? Sealed sets: sound ones, mistakes in the data, hidden effects.

    python tests/studies/trust.py [--sets 300] [--first 0]

A third of the sets each: sound; with one mistake (light left in, the field displaced, a dark camera, errors in another
unit, a lamp of another temperature, cameras or angles mixed up); with one effect of the catalogue at a size that is
drawn over two decades. Each is fitted with the base model and examined. A calibration is wrong if the matrix over the
field is off by more than three times its stated errors (rms over points and elements, against the instrument that made
the data). Of what is trusted and wrong the right reading of the same data is fitted as well: where that gains less than
Δχ² = 30, the data do not hold what would give the mistake away. Printed is each set, and how many of each kind were
trusted or not, right or wrong.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from matrix_at import matrix_at  # noqa: E402
from small_run import SMALL  # noqa: E402

from walop_jax.calibration.calibration import Calibration  # noqa: E402
from walop_jax.data.records import CalibrationSet  # noqa: E402
from walop_jax.data.settings import Settings  # noqa: E402
from walop_jax.data.table_intensities import TableIntensities  # noqa: E402
from walop_jax.diagnosis.trust import examined  # noqa: E402
from walop_jax.fit.refit import refit  # noqa: E402
from walop_jax.io.errors import DataError  # noqa: E402
from walop_jax.model.effects import EFFECTS  # noqa: E402
from walop_jax.model.parameters import field_declarations  # noqa: E402
from walop_jax.model.specification import with_effects  # noqa: E402
from walop_jax.simulation.simulate import simulate  # noqa: E402

WRONG = 3.0
HELD = 30.0
"""Δχ² of the right reading from which the data hold what tells it from the wrong one."""
Change = Callable[[CalibrationSet], CalibrationSet]


class Judged(NamedTuple):
    """What was hidden in a set, whether its fit is trusted, and the error of the matrix over the stated one.

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


def with_block(calset: CalibrationSet, **changed: np.ndarray) -> CalibrationSet:
    block = dataclasses.replace(calset.intensities.block(0, len(calset.points)), **changed)
    return dataclasses.replace(calset, intensities=TableIntensities.dense(calset.points, block))


def mistakes(rng: np.random.Generator) -> dict[str, Change]:
    """One mistake of each kind, some of them at a size that is drawn."""
    size = 10.0 ** rng.uniform(-1.0, 0.5)

    def block(calset: CalibrationSet):
        return calset.intensities.block(0, len(calset.points))

    def displaced(calset: CalibrationSet) -> CalibrationSet:
        points = dataclasses.replace(calset.points, x=calset.points.x + 0.01 * size)
        return with_block(dataclasses.replace(calset, points=points), x=points.x)

    def dark(calset: CalibrationSet) -> CalibrationSet:
        counts = block(calset).counts.copy()
        counts[..., rng.integers(4)] = 0.0
        return with_block(calset, counts=counts)

    def lamp(calset: CalibrationSet) -> CalibrationSet:
        said = np.where(calset.exposures.kind == "clp", 3200.0, calset.exposures.teff)
        return dataclasses.replace(calset, exposures=dataclasses.replace(calset.exposures, teff=said))

    def backwards(calset: CalibrationSet) -> CalibrationSet:
        e = calset.exposures
        return dataclasses.replace(calset, exposures=dataclasses.replace(e, clp_angle=-e.clp_angle))

    return {
        "light left in": lambda c: with_block(c, counts=block(c).counts + 2000.0 * size),
        "field displaced": displaced,
        "dark camera": dark,
        "errors too large": lambda c: with_block(c, sigma=100.0 * block(c).sigma),
        "errors too small": lambda c: with_block(c, sigma=0.01 * block(c).sigma),
        "lamp of another temperature": lamp,
        "cameras exchanged": lambda c: with_block(
            c, counts=block(c).counts[..., [2, 3, 0, 1]], sigma=block(c).sigma[..., [2, 3, 0, 1]]
        ),
        "polariser backwards": backwards,
    }


def judged(number: int) -> Judged:
    """One sealed set, fitted and held against the truth."""
    rng = np.random.default_rng([number, 77])
    kind = ("sound", "mistake", "hidden effect")[number % 3]
    what, effects = "", ()
    if kind == "hidden effect":
        effect = EFFECTS[int(rng.integers(len(EFFECTS)))]
        what, context = effect.name, SMALL.context()
        neutral = effect.of(context)
        size = {
            name: np.asarray(getattr(neutral, name))
            + 10.0 ** rng.uniform(-1.5, 0.5)
            * field_declarations(effect)[name].width
            * rng.standard_normal(np.shape(getattr(neutral, name)))
            for name in effect.amplitudes()
        }
        size |= {name: np.abs(size[name]) for name in effect.one_sided}
        made = None
        while made is None:  # what would take more light away than there is is made smaller
            effects = (effect.of(context, **{n: v.tolist() for n, v in size.items()}),)
            with contextlib.suppress(ValueError):
                made = simulate(SMALL, seed=1000 + number, effects=effects)
            size = {name: value / 2.0 for name, value in size.items()}
    else:
        made = simulate(SMALL, seed=1000 + number)
    truth, data = made.truth, made.calset
    if kind == "mistake":
        chosen = mistakes(rng)
        what = list(chosen)[int(rng.integers(len(chosen)))]
        data = chosen[what](data)
    try:
        result = examined(refit(data))
    except (DataError, ValueError):
        return Judged(kind, what, trusted=False, off=np.inf)
    calibration = Calibration.from_fit(result)
    setting = Settings.default(len(made.calset.points), "SDSS-r")
    x, y = made.calset.points.x, made.calset.points.y
    found, covariance = calibration.matrix(x, y, setting)
    error = np.sqrt(np.einsum("pii->pi", covariance))
    off = float(np.sqrt(np.mean(((found - matrix_at(truth, made.calset)) / error) ** 2)))
    if not result.trusted or off <= WRONG:
        return Judged(kind, what, bool(result.trusted), off)
    right = refit(made.calset, with_effects(result.model, effects, SMALL.context()) if effects else None)
    return Judged(kind, what, trusted=True, off=off, gain=result.chi2 - right.chi2)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sets", type=int, default=300)
    parser.add_argument("--first", type=int, default=0)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    found: Counter[tuple[str, str]] = Counter()
    for number in range(options.first, options.first + options.sets):
        one = judged(number)
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
