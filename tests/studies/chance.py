"""How often chance alone puts many stars beyond three errors: errors of stars all come from one calibration.

    python tests/studies/chance.py [--draws 20000] [--seed 4] [--side 8]

The error of a calibration is one draw from its covariance, common to all stars: where it is large in one direction of
the parameters, all stars that see that direction are off together. Of a sound set whose covariance is exact, the share
of stars with q or u beyond three stated errors (p = 2 %, 400 places, |det| above 0.1) therefore scatters far more than
that of independent stars. Printed are its mean, and how often it exceeds some limits: what a study of sealed sets finds
above these numbers is the fault of a calibration, and not below them.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from study_options import options_of  # noqa: E402

import walop_jax as walop  # noqa: E402
from walop_jax.calibration.matrix import matrix_slopes  # noqa: E402
from walop_jax.data.settings import Settings  # noqa: E402

LIMITS = (0.01, 0.02, 0.03, 0.05, 0.1, 0.2)
PLACES, STAR_P, BEYOND, TOGETHER = 400, 0.02, 3.0, 500


def relative_errors(calibration: walop.Calibration) -> np.ndarray:
    """Errors of q and u over the stated ones (star, 2, direction), of unit normal numbers."""
    rng = np.random.default_rng(5)
    x, y = rng.uniform(-0.29, 0.29, (2, PLACES))
    angle = rng.uniform(0.0, 2.0 * np.pi, PLACES)
    star = np.stack([np.ones(PLACES), STAR_P * np.cos(angle), STAR_P * np.sin(angle)], axis=1)
    instrument = calibration.model.instrument(calibration.values)
    setting = Settings.default(1, calibration.usual_filter)
    matrix, slopes = (
        np.asarray(part) for part in matrix_slopes(instrument, setting, calibration.filters, x, y)
    )
    seen = np.abs(np.linalg.det(matrix[:, :, 1:])) >= 0.1
    inverse = np.linalg.inv(matrix[seen][:, :, 1:])
    of_stars = np.einsum("pij,pjkf,pk->pif", inverse, slopes[seen], star[seen])
    return relative(of_stars, calibration.covariance)


def relative(slopes: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Errors (place, quantity, direction) of unit normal numbers, over the stated ones, by slopes in parameters."""
    value, vector = np.linalg.eigh(covariance)
    along = slopes @ (vector * np.sqrt(np.clip(value, 0.0, None)))
    return along / np.linalg.norm(along, axis=2, keepdims=True)


def main() -> None:
    """Print the study."""
    options = options_of(__doc__, draws=20_000, seed=4, side=8).parse_args()
    calset = walop.simulate(walop.ObservingPlan(grid=options.side), seed=options.seed).calset
    errors = relative_errors(walop.Calibration.from_fit(walop.refit(calset)))
    rng, shares = np.random.default_rng(options.seed), []
    for _ in range(0, options.draws, TOGETHER):
        pulls = np.einsum("pik,nk->npi", errors, rng.standard_normal((TOGETHER, errors.shape[2])))
        shares.append(np.mean(np.abs(pulls).max(axis=2) > BEYOND, axis=1))
    share = np.concatenate(shares)
    print(f"stars beyond {BEYOND:g} errors: {100 * share.mean():.2f} % in the mean of {len(share)} draws")
    for limit in LIMITS:
        print(f"more than {100 * limit:.0f} %: in {100 * np.mean(share > limit):.2f} % of the draws")


if __name__ == "__main__":
    main()
