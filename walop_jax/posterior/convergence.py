"""Convergence of the ensembles of a sampler, and the number of steps that are still needed.

An ensemble is an independent run of a sampler, of one walker or of many.

Autocorrelation   τ per quantity, averaged over walkers of all ensembles (Goodman & Weare 2010, CAMCoS 5, 65;
                  Sokal's window with c = 5).
Effective samples for the mean of all walkers, by ArviZ (Vehtari et al. 2021, Bayesian Anal. 16, 667).
R-hat             rank-normalised, split and folded, by ArviZ (as above). Walkers of one ensemble are not independent
                  chains, so it is taken between halves of ensembles.
Rules             N > 50 τ; τ the same within 25 % after N/4, N/2 and N steps; R-hat < 1.01.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import warnings
from typing import Any

import numpy as np
from emcee.autocorr import integrated_time
from jaxtyping import Float

Chains = Float[np.ndarray, "e t w k"]  # ensembles, stored steps, walkers, quantities

LENGTHS = 50.0  # in units of τ
STABLE = 0.25  # allowed relative change of τ over each of two doublings
LARGEST_RHAT = 1.01
LEAST_STORED = 40  # steps, below which nothing is said
RANKED = (
    100_000  # positions per quantity that R-hat looks at: sorting more would take longer than sampling them
)


@dataclasses.dataclass(frozen=True)
class Convergence:
    """The evidence. `tau` is in steps, per quantity; `history` holds the worst τ after N/4, N/2 and N steps.

    `steps` are those kept after burn-in, `needed` how many more the rules ask for (0 when converged).
    """

    names: tuple[str, ...]
    steps: int
    tau: Float[np.ndarray, " k"]
    history: tuple[float, float, float]
    ess: Float[np.ndarray, " k"]
    rhat: Float[np.ndarray, " k"]
    needed: int
    reasons: tuple[str, ...]

    @property
    def converged(self) -> bool:
        """True if all rules hold."""
        return not self.reasons

    @property
    def worst(self) -> str:
        """Name of the quantity with the longest autocorrelation time."""
        return self.names[int(np.argmax(self.tau))]

    def message(self, seconds_per_step: float = math.nan) -> str:
        """One sentence for people."""
        if self.converged:
            return (
                f"converged: {self.steps} steps, {self.steps / self.tau.max():.0f} τ, "
                f"τ = {self.tau.max():.1f}, at least {self.ess.min():.0f} effective samples, "
                f"R-hat {self.rhat.max():.4f}"
            )
        time = "" if not np.isfinite(seconds_per_step) else f" (about {self.needed * seconds_per_step:.0f} s)"
        reasons = "; ".join(self.reasons)
        return f"NOT converged: {reasons}. Go on for {self.needed} steps or more{time} with --resume"


def autocorrelation(chains: Chains) -> Float[np.ndarray, " k"]:
    """τ in stored steps, per quantity; NaN for a quantity that never moved."""
    e, n, w, k = chains.shape
    tau = np.full(k, np.nan)
    for i in range(k):
        x = np.moveaxis(chains[..., i], 0, 1).reshape(n, e * w)
        if np.all(np.ptp(x, axis=0) > 0):
            tau[i] = float(integrated_time(x[:, :, None], quiet=True, tol=0)[0])
    return tau


def r_hat(chains: Chains) -> Float[np.ndarray, " k"]:
    """R-hat between the halves of all ensembles, per quantity; NaN for a quantity that never moved."""
    e, k = chains.shape[0], chains.shape[-1]
    parts = chains[:, :: max(1, chains[..., 0].size // RANKED)]
    az = arviz()
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.array([float(az.rhat(parts[..., i].reshape(e, -1))) for i in range(k)])


def effective_samples(chains: Chains) -> Float[np.ndarray, " k"]:
    """Number of independent draws that would give means as good, per quantity."""
    e, n, w, k = chains.shape
    walkers = np.moveaxis(chains, 2, 1).reshape(e * w, n, k)
    az = arviz()
    return np.array([float(az.ess(walkers[..., i], method="mean")) for i in range(k)])


def arviz() -> Any:
    """ArviZ, without the announcement that it makes when it is imported."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import arviz

    return arviz


def assess(chains: Chains, names: tuple[str, ...], thin: int = 1) -> Convergence:
    """Apply the rules to chains stored every `thin` steps, burn-in taken off."""
    n, k = chains.shape[1], chains.shape[-1]
    steps = n * thin
    if n < LEAST_STORED:
        nothing = np.full(k, np.nan)
        needed = LEAST_STORED * thin - steps
        reason = f"{steps} steps are too few to judge"
        return Convergence(
            names, steps, nothing, (np.nan, np.nan, np.nan), np.zeros(k), nothing, needed, (reason,)
        )
    quarter, half, tau = (autocorrelation(chains[:, :m]) * thin for m in (n // 4, n // 2, n))
    rhat = r_hat(chains)
    history = (float(np.max(quarter)), float(np.max(half)), float(np.max(tau)))
    reasons, needed = [], 0
    if not np.all(np.isfinite(tau)):
        stuck = [name for name, value in zip(names, tau, strict=True) if not np.isfinite(value)]
        return Convergence(names, steps, tau, history, np.zeros(k), rhat, steps, (f"{stuck[0]} never moved",))
    if steps <= LENGTHS * history[2]:
        reasons.append(
            f"{steps} steps are {steps / history[2]:.0f} τ of {history[2]:.0f}, fewer than {LENGTHS:.0f}"
        )
        needed = max(needed, math.ceil(1.1 * LENGTHS * history[2]) - steps)
    changes = [abs(b / a - 1.0) if a > 0 else np.inf for a, b in itertools.pairwise(history)]
    if not max(changes) < STABLE:
        reasons.append("τ still changes: " + " → ".join(f"{value:.0f}" for value in history))
        needed = max(needed, steps)
    if not np.max(rhat) < LARGEST_RHAT:
        worst = int(np.argmax(rhat))
        reasons.append(f"R-hat between ensembles is {rhat[worst]:.3f} for {names[worst]}")
        needed = max(needed, steps)
    ess = effective_samples(chains)
    return Convergence(names, steps, tau, history, ess, rhat, needed, tuple(reasons))
