"""Multi-filter sets with polarised standards of different colours, nothing else hidden: names that are false.

    PYTHONPATH=tests python tests/studies/colours_of_standards.py --sets 40 [--save FOLDER]

For each set: what a diagnosis names (nothing should be), and q, u of every star in every filter against the truth, in
standard errors of the fit. `--save` writes the sets, for versions that know no colours.
"""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from study_options import options_of

import walop_jax as walop
from walop_jax.model.sources import PointIllumination
from walop_jax.simulation.observing_plan import polariser_turn

PLAN = walop.ObservingPlan(
    grid=5, standard_grid=2, polariser_angles=polariser_turn(9), moon_patches=3, standards=5, unpolarised=2,
    filters=("NB-580", "NB-660", "SDSS-r"), star_lmax=(0.45, 0.55, 0.65), throughput_degree=2,
)  # fmt: skip


def of_stars(likelihood, instrument) -> np.ndarray:
    """(q, u) in the instrument frame of every star in the exposures of standards."""
    e = likelihood.calset.exposures
    number = np.flatnonzero(e.kind == "standard")
    source = np.full(len(e), -1)
    source[number] = likelihood.calset.intensities.block(0, len(likelihood.calset.points)).source.max(axis=0)[
        number
    ]
    illumination = PointIllumination(
        likelihood.plan.exposures, jnp.zeros((len(e), 2)), jnp.array(source), jnp.zeros(()), jnp.zeros(())
    )
    return instrument.standard.polarisation(illumination)[number]


def pulls(fit, truth) -> np.ndarray:
    """Differences from the truth in standard errors."""
    likelihood, model = fit.likelihood, fit.model

    def values_of(values):
        return of_stars(likelihood, model.instrument(values)).ravel()

    found, slopes = values_of(jnp.array(fit.values)), jax.jacfwd(values_of)(jnp.array(fit.values))
    error = np.sqrt(np.einsum("ij,jk,ik->i", slopes, fit.covariance, slopes))
    return (np.asarray(found) - np.asarray(of_stars(likelihood, truth)).ravel()) / error


def main() -> None:
    parser = options_of(__doc__, sets=40, first=0)
    parser.add_argument("--save", type=Path)
    given = parser.parse_args()
    false, every = 0, []
    for seed in range(given.first, given.first + given.sets):
        run = walop.simulate(PLAN, seed=seed)
        if given.save is not None:
            plain = dataclasses.replace(run.calset.sources, filter=None)
            walop.write_calibration_set(
                given.save / f"set{seed:02d}.fits", dataclasses.replace(run.calset, sources=plain)
            )
        diagnosis = walop.diagnose(run.calset)
        fit, exposures = diagnosis.before, run.calset.exposures
        every.append(np.abs(pulls(fit, run.truth)).reshape(-1, 2))
        named = [step.effect for step in diagnosis.steps]
        false += bool(named)
        print(
            f"seed {seed}: chi2/dof {fit.chi2 / fit.dof:.3f}, named {named or 'nothing'}; {coverage(every[-1])}",
            flush=True,
        )
    print(f"false names in {false} of {given.sets} sets; q, u of stars in each filter:")
    of_filter = exposures.filter[exposures.kind == "standard"]
    for name in PLAN.filters:
        print(f"{name}: {coverage(np.concatenate([off[of_filter == name] for off in every]))}")
    print(f"all: {coverage(np.concatenate(every))}")


def coverage(off: np.ndarray) -> str:
    """How many of the differences, in standard errors, are within 1 and 1.96."""
    within = [f"{int(np.sum(off < limit))} within {limit:g}" for limit in (1.0, 1.96)]
    return f"{off.size} values, {' and '.join(within)} standard errors"


if __name__ == "__main__":
    sys.exit(main())
