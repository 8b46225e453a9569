"""Do the intervals of stars hold the truth where the calibration has structure, a mistake, or a detector's coefficient?

    python tests/studies/intervals.py [--runs 60] [--frames 12]                                         (an hour)

Runs are simulated, calibrated and examined; `apply` then works on 200 stars of each, of 4·10⁶ electrons. Printed is how
often q and u lie within 1 and 1.96 stated errors of the truth, with the scatter between runs, and how often they do
where what a hidden mistake may add (Q_HIDDEN, U_HIDDEN) is taken off.

scattered light   0.06 % of the median counts in O1, 0.018 % in O2, of calibration exposures alone
gains             of every field point and camera, 0.1 % rms, the same in all exposures; stars have gains of their own
frames            the same as a wave of five pixels over whole frames, 0.1 %
no TEFF           stars of 3500 to 10 000 K (95 %, normal in 1/T) whose colour nobody told
non-linearity     coefficients of all cameras fitted; stars of a tenth and of three times the light
"""

from __future__ import annotations

import dataclasses
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from changed_sets import block_of, with_block  # noqa: E402
from frame_run import frame_run  # noqa: E402
from frames_file import write_frames  # noqa: E402
from small_run import SMALL  # noqa: E402
from study_options import options_of  # noqa: E402

from walop_jax.calibration.calibration import Calibration  # noqa: E402
from walop_jax.calibration.matrix import sky_vectors  # noqa: E402
from walop_jax.data.calset import read_calibration_set  # noqa: E402
from walop_jax.data.grid import Grid  # noqa: E402
from walop_jax.data.records import CalibrationSet  # noqa: E402
from walop_jax.data.settings import Settings  # noqa: E402
from walop_jax.data.user_tables import in_memory  # noqa: E402
from walop_jax.diagnosis.trust import examined  # noqa: E402
from walop_jax.fit.base_model import base_model  # noqa: E402
from walop_jax.fit.refit import FitResult, fit, refit, with_empirical_covariance  # noqa: E402
from walop_jax.fit.verdict import Quality  # noqa: E402
from walop_jax.likelihood.likelihood import Likelihood  # noqa: E402
from walop_jax.model.effects import effect_by_name  # noqa: E402
from walop_jax.model.effects.in_models import with_effects  # noqa: E402
from walop_jax.model.instrument import Instrument  # noqa: E402
from walop_jax.model.planning import plan_for_settings  # noqa: E402
from walop_jax.science.apply import apply  # noqa: E402
from walop_jax.science.catalogue import read_catalogue  # noqa: E402
from walop_jax.science.colours import COOL, HOT  # noqa: E402
from walop_jax.simulation.simulate import simulate  # noqa: E402

STARS, ELECTRONS, COLOURS = 200, 4e6, 16
GAIN = 1e-3
Gains = Callable[[np.random.Generator, np.ndarray], np.ndarray]


def of_unit_gain(rng: np.random.Generator, x: np.ndarray) -> np.ndarray:
    return np.ones((len(x), 4))


def rough(rng: np.random.Generator, x: np.ndarray) -> np.ndarray:
    return 1.0 + GAIN * rng.standard_normal((len(x), 4))


def wave(rng: np.random.Generator, x: np.ndarray) -> np.ndarray:
    """Stars fall anywhere on the wave."""
    return 1.0 + GAIN * np.sin(rng.uniform(0.0, 2.0 * np.pi, (len(x), 1)) + np.arange(4))


def pulls(
    calibration: Calibration,
    truth: Instrument,
    calset: CalibrationSet,
    rng: np.random.Generator,
    *,
    gains: Gains = of_unit_gain,
    told: bool = True,
    electrons: float = ELECTRONS,
    detector: np.ndarray | float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """(value − truth) / error of q and u of stars, and the same less what a hidden mistake may add; nan where u is not
    measured (FLAG 16).

    `told`: whether TEFF is in the catalogue; `detector`: what the cameras report too much at 10⁶ electrons.
    """
    reach = 0.9 * float(np.abs(calset.points.x).max())
    x, y = rng.uniform(-reach, reach, (2, STARS))
    inverse = rng.normal((1 / COOL + 1 / HOT) / 2, (1 / COOL - 1 / HOT) / (2 * 1.96), STARS)
    # Colours of equal probability: each star has the nearest of them.
    teff = 1.0 / np.quantile(inverse, (np.arange(COLOURS) + 0.5) / COLOURS)
    colour = np.argmin(np.abs(1.0 / teff - inverse[:, None]), axis=1)
    if told:
        teff = np.full(COLOURS, 5772.0)
    p, angle = rng.uniform(0.0, 0.05, STARS), rng.uniform(0.0, np.pi, STARS)
    qu = np.stack([p * np.cos(2 * angle), p * np.sin(2 * angle)], axis=1)
    settings = dataclasses.replace(Settings.default(COLOURS, "SDSS-r"), teff=teff)
    plan = plan_for_settings(truth, settings, calset.filters)
    vectors = sky_vectors(truth, plan, x, y)[np.arange(STARS), np.asarray(plan.band_of)[colour, 0], :, :3]
    light = electrons * np.einsum("pks,ps->pk", vectors, np.column_stack([np.ones(STARS), qu]))
    light *= gains(rng, x)
    error = np.sqrt(light + 900.0)
    light = light + error * rng.standard_normal(light.shape)
    columns = {"X": x, "Y": y, "N": light * (1.0 + detector * light / 1e6), "N_ERR": error}
    if told:
        columns["TEFF"] = np.full(STARS, 5772.0)
    catalogue = read_catalogue(
        in_memory(columns), calibration.model.template.patched(), always_in=calibration.always_in
    )
    found = apply(calibration, catalogue)
    off, sigma = found.qu - qu, np.sqrt(np.einsum("sii->si", found.covariance))
    good = (found.flag & (Quality.HIGH_CROSSTALK | Quality.NO_STOKES) == 0)[:, None]
    beyond = np.maximum(np.abs(off) - found.hidden, 0.0)
    return np.where(good, off / sigma, np.nan), np.where(good, beyond / sigma, np.nan)


def scattered(runs: int) -> Iterator[tuple[FitResult, tuple[np.ndarray, np.ndarray]]]:
    for seed in range(runs):
        made = simulate(SMALL, seed=100 + seed)
        counts = block_of(made.calset).counts
        counts = counts + np.array([6e-4, 1.8e-4, 0.0, 0.0]) * np.median(counts, axis=0)
        found = examined(refit(with_block(made.calset, counts=counts)))
        yield found, pulls(Calibration.from_fit(found), made.truth, made.calset, np.random.default_rng(seed))


def gains(runs: int) -> Iterator[tuple[FitResult, tuple[np.ndarray, np.ndarray]]]:
    for seed in range(runs):
        made, rng = simulate(SMALL, seed=200 + seed), np.random.default_rng(seed)
        counts = block_of(made.calset).counts
        counts = counts * rough(rng, made.calset.points.x)[:, None]
        found = examined(refit(with_block(made.calset, counts=counts)))
        yield found, pulls(Calibration.from_fit(found), made.truth, made.calset, rng, gains=rough)


def frames(runs: int) -> Iterator[tuple[FitResult, tuple[np.ndarray, np.ndarray]]]:
    """Whole frames, read as cells."""
    side = 72
    plan = frame_run(side)
    step = 2 * plan.field / (side - 1)
    grid = Grid(side, side, (1.0, 1.0), (-plan.field, -plan.field), ((step, 0.0), (0.0, step)))
    phase = 2 * np.pi * (np.arange(side**2) % side)[:, None] / 5 + np.arange(4)
    for seed in range(runs):
        made = simulate(plan, seed=300 + seed)
        counts = block_of(made.calset).counts * (1 + GAIN * np.sin(phase))[:, None]
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "frames.fits"
            write_frames(path, with_block(made.calset, counts=counts), grid, dtype="f8")
            calset = read_calibration_set(path)
            model = base_model(calset, throughput_degree=2)
            found = examined(with_empirical_covariance(fit(Likelihood.of(calset, model))), as_written=True)
            rng = np.random.default_rng(seed)
            yield found, pulls(Calibration.from_fit(found), made.truth, made.calset, rng, gains=wave)


def colours(runs: int) -> Iterator[tuple[FitResult, tuple[np.ndarray, np.ndarray]]]:
    for seed in range(runs):
        made = simulate(SMALL, seed=400 + seed)
        found, rng = examined(refit(made.calset)), np.random.default_rng(seed)
        yield found, pulls(Calibration.from_fit(found), made.truth, made.calset, rng, told=False)


def detectors(runs: int) -> Iterator[tuple[FitResult, tuple[np.ndarray, np.ndarray]]]:
    kind, context = effect_by_name("nonlinearity"), SMALL.context()
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        size = rng.normal(0.0, 5e-4, 4)
        made = simulate(SMALL, seed=500 + seed, effects=(kind.of(context, coefficient=size.tolist()),))
        model = with_effects(base_model(made.calset), [kind.neutral(context)], context)
        found = examined(refit(made.calset, model))
        calibration = Calibration.from_fit(found)
        both = [
            pulls(calibration, made.truth, made.calset, rng, electrons=flux * ELECTRONS, detector=size)
            for flux in (0.1, 3.0)
        ]
        yield found, tuple(np.concatenate(pair) for pair in zip(*both, strict=True))


def share(runs: list[np.ndarray], within: float) -> str:
    each = np.array(
        [np.mean(np.abs(one[np.isfinite(one)]) < within) for one in runs if np.isfinite(one).any()]
    )
    if len(each) < 2:
        return "—"
    return f"{100 * each.mean():.1f} ± {100 * each.std(ddof=1) / np.sqrt(len(each)):.1f} %"


def main() -> int:
    options = options_of(__doc__, runs=60, frames=12).parse_args()
    jax.config.update("jax_enable_x64", True)
    for name, study, runs in (
        ("no TEFF", colours, options.runs),
        ("gains", gains, options.runs),
        ("non-linearity", detectors, options.runs),
        ("scattered light", scattered, options.runs),
        ("frames", frames, options.frames),
    ):
        done = list(study(runs))
        stated, beside = ([found[i] for _, found in done] for i in (0, 1))
        trusted = sum(bool(result.trusted) for result, _ in done)
        structured = sum(bool(result.verdict and result.verdict.structure) for result, _ in done)
        print(
            f"{name}: {len(done)} runs, {trusted} trusted, {structured} with structure; stated "
            f"{share(stated, 1.0)}, {share(stated, 1.96)}; with what could hide {share(beside, 1.0)}, "
            f"{share(beside, 1.96)}; flagged {100 * np.mean([np.isnan(one).mean() for one in stated]):.1f} %",
            flush=True,
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
