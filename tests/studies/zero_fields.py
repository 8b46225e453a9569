"""A field of zero polarisation beside one star that is stepped over the field, in equal time.

    PYTHONPATH=tests python tests/studies/zero_fields.py [--sets 10] [--stars 100]

Errors of the zero offsets M21, M31 (rms over the field), χ²/dof and what the offsets are off by in standard errors,
over some sets. A star is as bright as each of those of the field; where it is stepped it has 1/n of the time at each of
n places. Exposures of a field share its time.
"""

from __future__ import annotations

import dataclasses
import sys

import numpy as np
from matrix_at import matrix_at
from study_options import options_of

import walop_jax as walop
from walop_jax.calibration.matrix import matrices
from walop_jax.data.settings import Settings
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.fit.refit import fit
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.simulation.observing_plan import polariser_turn
from walop_jax.simulation.simulate import PhotonNoise, Simulated

BASE = walop.ObservingPlan(
    grid=4, standards=0, unpolarised=0, polariser_angles=polariser_turn(9), moon_patches=3,
    catalogue_error=1e-4, zero_error=1e-4, throughput_degree=2,
)  # fmt: skip


def shortened(run: Simulated, share: float, seed: int) -> walop.CalibrationSet:
    """The set with a share of the time for all exposures of stars: so many of the electrons, drawn from those there."""
    table = TableIntensities.of(run.calset.intensities, run.calset.points)
    star = run.calset.exposures.kind[table.exposure] == "standard"
    noise, rng = PhotonNoise(BASE.read_noise), np.random.default_rng(seed)
    counts, sigma = table.counts.copy(), table.sigma.copy()
    kept = rng.binomial(np.maximum(np.rint(counts[star]), 0.0).astype(int), share)
    read = BASE.read_noise * np.sqrt(1.0 - share**2) * rng.standard_normal(kept.shape)
    counts[star], sigma[star] = kept + read, noise.sigma(kept + read)
    return dataclasses.replace(run.calset, intensities=dataclasses.replace(table, counts=counts, sigma=sigma))


def main() -> None:
    parser = options_of(__doc__, sets=10, stars=100)
    parser.add_argument("--exposures", type=int, nargs="+", default=[1, 4])
    given = parser.parse_args()
    side = round(given.stars**0.5)
    one = dataclasses.replace(BASE, standards=1, unpolarised=1, standard_grid=side)
    plans = {"one star stepped": (one, 1.0 / side**2)}
    for exposures in given.exposures:
        for scatter in (0.0, 5e-4):
            field = dataclasses.replace(
                BASE, zero_stars=given.stars, zero_exposures=exposures, zero_scatter=scatter
            )
            plans[f"{given.stars} stars, {exposures} exposures, scatter {100 * scatter:g} %"] = (
                field, 1.0 / exposures,
            )  # fmt: skip
    x, y = (part.ravel() for part in np.meshgrid(*[np.linspace(-0.2, 0.2, 3)] * 2))
    for name, (plan, share) in plans.items():
        errors, pulls, ratio = [], [], []
        for seed in range(given.sets):
            run = walop.simulate(plan, seed=seed)
            calset = run.calset if share == 1.0 else shortened(run, share, seed)
            result = fit(Likelihood.of(calset, walop.base_model(calset, throughput_degree=2)))
            ratio.append(result.chi2 / result.dof)
            instrument = result.model.instrument(result.values)
            settings = Settings.default(len(x), str(calset.exposures.filter[0]))
            matrix, covariance = matrices(instrument, settings, calset.filters, x, y, result.covariance)
            error = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))[:, [0, 3]]
            errors.append(error)
            pulls.append((matrix - matrix_at(run.truth, calset, x, y))[:, [0, 3]] / error)
        size = 1e4 * np.sqrt(np.mean(np.square(errors), axis=(0, 1)))
        pull = np.sqrt(np.mean(np.square(pulls)))
        print(
            f"{name}: M21 {size[0]:.2f}, M31 {size[1]:.2f} (1e-4), chi2/dof {np.mean(ratio):.3f}, "
            f"rms pull {pull:.2f}", flush=True,
        )  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
