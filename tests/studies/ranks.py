"""Simulation-based calibration of the posterior: is the truth any draw of it, for as-built instruments from the prior?

    python tests/studies/ranks.py [--sets 200] [--output ranks.png]                                   (a minute)

Each set has an instrument of its own, drawn from the priors, and noise of its own. All are fitted together
(`walop.refit_many`), and the rank of every true value among 1000 draws of its posterior (normal, with the covariance of
the fit) is taken. If the posterior is right, ranks are uniform.

Source   Talts et al. 2018, arXiv 1804.06788; simultaneous bands of the empirical distribution: Säilynoja, Bürkner &
         Vehtari 2022, Statistics and Computing 32, 32 (here by simulation).
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int
from scipy import stats

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from small_run import SMALL  # noqa: E402
from study_options import options_of  # noqa: E402

from walop_jax.fit.many import ManyFits, refit_many  # noqa: E402
from walop_jax.simulation.simulate import simulate, truth_values  # noqa: E402

DRAWS, CONFIDENCE = 1000, 0.99
BANDS = 4000  # simulated samples of uniform ranks, for the band


class Ranks(NamedTuple):
    """Ranks of the truth among the draws, set by set and parameter by parameter, and the names of these."""

    names: tuple[str, ...]
    ranks: Int[np.ndarray, "s p"]

    @property
    def fractions(self) -> Float[np.ndarray, "s p"]:
        """Ranks from 0 to 1, in the middle of their steps."""
        return (self.ranks + 0.5) / (DRAWS + 1)

    def p_values(self) -> Float[np.ndarray, " p"]:
        """p of each parameter for uniform ranks (Kolmogorov and Smirnov)."""
        return np.array([stats.kstest(column, "uniform").pvalue for column in self.fractions.T])

    def outside(self, level: float) -> float:
        """The fraction of all ranks outside of the central interval of a level."""
        return float(np.mean(np.abs(self.fractions - 0.5) > 0.5 * level))


def fitted_sets(count: int, seed: int = 0) -> tuple[ManyFits, list[dict[str, float]]]:
    """Fits of sets of as many as-built instruments, and the true values of each."""
    drawn = [simulate(SMALL, seed=1000 + seed + n) for n in range(count)]
    return refit_many([one.calset for one in drawn]), [truth_values(one.truth) for one in drawn]


def ranks_of(fits: ManyFits, truths: list[dict[str, float]], seed: int = 0) -> Ranks:
    """The ranks of the true values of the free parameters that vary with the instrument."""
    model, rng = fits[0].model, np.random.default_rng(seed)
    kept = [i for i in model.free if np.ptp([truth[model.names[i]] for truth in truths]) > 0]
    ranks = np.zeros((len(fits), len(kept)), int)
    for row, (one, truth) in enumerate(zip(fits.fits, truths, strict=True)):
        for column, i in enumerate(kept):
            draws = one.values[i] + one.sigma[i] * rng.standard_normal(DRAWS)
            ranks[row, column] = np.sum(draws < truth[model.names[i]])
    return Ranks(tuple(model.names[i] for i in kept), ranks)


def band(count: int, seed: int = 0) -> Float[np.ndarray, " c"]:
    """Half the width of a band around the uniform distribution that holds all of a sample's with `CONFIDENCE`.

    At the places `np.linspace(0, 1, 101)`.
    """
    at, rng = np.linspace(0.0, 1.0, 101), np.random.default_rng(seed)
    spread = np.sqrt(np.clip(at * (1.0 - at), 1e-12, None) / count)
    worst = []
    for _ in range(BANDS):
        sample = np.sort(rng.random(count))
        away = np.abs(np.searchsorted(sample, at, side="right") / count - at) / spread
        worst.append(away[1:-1].max())
    return float(np.quantile(worst, CONFIDENCE)) * spread


def figure(ranks: Ranks, path: Path) -> None:
    """The distribution of the ranks of every parameter less the uniform one, with the band for a single parameter."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    at = np.linspace(0.0, 1.0, 101)
    half = band(len(ranks.ranks))
    drawing, axes = plt.subplots(figsize=(89.0 / 25.4, 62.0 / 25.4), layout="constrained")
    for column in ranks.fractions.T:
        ordered = np.sort(column)
        axes.plot(at, np.searchsorted(ordered, at, side="right") / len(ordered) - at, color="0.6", lw=0.4)
    axes.fill_between(at, -half, half, color="tab:blue", alpha=0.25, lw=0, label=f"{CONFIDENCE:.0%} band")
    axes.set(xlabel="rank of the truth / draws", ylabel="distribution − uniform", xlim=(0, 1))
    axes.tick_params(labelsize=7)
    axes.xaxis.label.set_size(8)
    axes.yaxis.label.set_size(8)
    axes.legend(fontsize=6, frameon=False, loc="upper right")
    drawing.savefig(path, dpi=200)
    plt.close(drawing)


def main(sets: int = 200, output: Path | None = None) -> None:
    """Print how uniform the ranks are."""
    fits, truths = fitted_sets(sets)
    ranks = ranks_of(fits, truths)
    p, half = ranks.p_values(), band(sets)
    at = np.linspace(0.0, 1.0, 101)
    inside = 0
    for column in ranks.fractions.T:
        away = np.searchsorted(np.sort(column), at, side="right") / sets - at
        inside += bool(np.all(np.abs(away[1:-1]) <= half[1:-1]))
    good = int(fits.converged.sum())
    print(f"{sets} instruments, {len(p)} parameters, {good} fits converged, {fits.seconds:.0f} s")
    for level in (0.68, 0.95, 0.99):
        print(f"outside of {level:.0%} intervals: {ranks.outside(level):.4f}, expected {1 - level:.4f}")
    low = int(np.argmin(p))
    corrected = 1.0 - (1.0 - p[low]) ** len(p)
    print(f"smallest p of a parameter {p[low]:.3g} ({ranks.names[low]}); among {len(p)}: {corrected:.3g}")
    print(f"parameters within their {CONFIDENCE:.0%} band: {inside} of {len(p)}")
    if output is not None:
        figure(ranks, output)
        print(f"written to {output}")


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    parser = options_of(__doc__, sets=200)
    parser.add_argument("--output", type=Path, default=None)
    options = parser.parse_args()
    main(options.sets, options.output)
