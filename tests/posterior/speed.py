"""Effective samples per second: this package, plain emcee on a NumPy model, whitened NUTS; in one run, on one core.

    python tests/posterior/speed.py [CALSET.fits] [--nuts 200] [--plain-steps 4000]

ours          `sample` on the surrogate. Cold: from the fit, with compilation, building and checking. Warm: once more.
plain emcee   stretch move, 2 d walkers, all coefficients, NumPy model of `tests/oracle`. One evaluation is timed;
              τ is measured on the same posterior with the surrogate's cheap density in place of the model. A chain
              shorter than 50 τ underestimates τ, which favours plain emcee.
NUTS          the sampler `nuts`: exact gradients of all coefficients, coordinates whitened by the fit; one chain.

Counted is the worst of the physics coefficients.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

CORE = min(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 0


def pin() -> None:
    """One core, one thread; before JAX and BLAS start."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {CORE})


def measure(path: Path, nuts_draws: int, plain_steps: int) -> dict[str, Any]:
    import emcee
    import jax
    import numpy as np

    jax.config.update("jax_enable_x64", True)
    from emcee.autocorr import integrated_time
    from oracle import fit as oracle_fit
    from oracle import forward

    from walop_jax.data.calset import read_calibration_set
    from walop_jax.fit.base_model import base_model
    from walop_jax.fit.refit import fit
    from walop_jax.likelihood.likelihood import Likelihood
    from walop_jax.posterior.nuts import Nuts
    from walop_jax.posterior.result import Options
    from walop_jax.posterior.sampling import sample
    from walop_jax.posterior.surrogate import build_surrogate
    from walop_jax.posterior.target import ExactPosterior, Target, choose_sampled

    calset = read_calibration_set(path)
    likelihood = Likelihood.of(calset, base_model(calset))
    result = fit(likelihood).judged()
    target = Target(result)
    found: dict[str, Any] = {"core": CORE, "coefficients": len(target.free)}

    began = time.perf_counter()
    first = sample(result, Options(seed=1))
    found["ours_cold_seconds"] = time.perf_counter() - began
    began = time.perf_counter()
    second = sample(result, Options(seed=2))
    found["ours_warm_seconds"] = time.perf_counter() - began
    for name, run in (("cold", first), ("warm", second)):
        found[f"ours_{name}_ess"] = float(run.convergence.ess.min())
        found[f"ours_{name}_trusted"] = run.trusted
        found[f"ours_{name}_ess_per_second"] = found[f"ours_{name}_ess"] / found[f"ours_{name}_seconds"]

    data = forward.load(path)
    start = forward.nominal(data["sources"]["Q"].size)
    start["q"], start["u"] = data["sources"]["Q"].copy(), data["sources"]["U"].copy()
    vector = oracle_fit.Vector(start, data)
    x, rng = vector.pack(start), np.random.default_rng(0)
    nodes = likelihood.plan.wavelength.shape[0]
    times = []
    for _ in range(5):
        began = time.perf_counter()
        r = forward.residuals(
            vector.unpack(x + 1e-3 * vector.steps * rng.standard_normal(x.size)), data, nodes
        )
        _ = -0.5 * float(r @ r)
        times.append(time.perf_counter() - began)
    found["numpy_evaluation_seconds"] = float(np.median(times))

    surrogate = build_surrogate(target, order=2)
    k, s = surrogate.along.shape[1], surrogate.across.shape[1]
    both = np.concatenate([surrogate.along, surrogate.across], axis=1)

    def joint(w: np.ndarray) -> np.ndarray:
        y = np.concatenate([surrogate.features(w[:, :k]), w[:, k:]], axis=1)
        return -0.5 * np.sum((y @ (surrogate.data + surrogate.prior)) * y, axis=1)

    walkers = 2 * (k + s)
    sampler = emcee.EnsembleSampler(walkers, k + s, joint, vectorize=True)
    sampler.run_mcmc(rng.standard_normal((walkers, k + s)), plain_steps)
    chain = sampler.get_chain(discard=plain_steps // 10)
    physical = np.einsum("twk,fk->twf", chain, both[surrogate.sampled])
    tau = max(float(integrated_time(physical[:, :, [i]], quiet=True, tol=0)[0]) for i in range(k))
    found |= {"plain_tau": tau, "plain_steps_over_tau": len(chain) / tau, "plain_walkers": walkers}
    found["plain_ess_per_second"] = 1.0 / (tau * found["numpy_evaluation_seconds"])

    if nuts_draws:
        nuts, density = Nuts(warm_up=60), ExactPosterior(target, choose_sampled(target)).density()
        began = time.perf_counter()
        state = nuts.start(density, (0, 0))
        ready = time.perf_counter()
        _, stretch = nuts.advance(density, state, nuts_draws)
        seconds, preparation = time.perf_counter() - ready, ready - began
        draws = stretch.positions[:, 0] @ target.root.T
        ess = []
        for i in surrogate.sampled:
            one = draws[:, i] - draws[:, i].mean()
            ess.append(
                [
                    len(one) / float(integrated_time(v[:, None, None], quiet=True, tol=0)[0])
                    for v in (one, one**2)
                ]
            )
        worst = np.min(ess, axis=0)
        found |= {
            "nuts_seconds": seconds,
            "nuts_preparation_seconds": preparation,
            "nuts_gradients": stretch.counts["gradients"],
            "nuts_divergences": stretch.counts["divergences"],
            "nuts_ess_per_second": float(worst[0] / seconds),
            "nuts_ess_of_squares_per_second": float(worst[1] / seconds),
        }
        found["gain_over_nuts_warm"] = found["ours_warm_ess_per_second"] / found["nuts_ess_per_second"]
        found["gain_over_nuts_cold"] = found["ours_cold_ess"] / found["ours_cold_seconds"] * (
            (seconds + preparation) / worst[0]
        )  # fmt: skip
    found["gain_over_plain_cold"] = found["ours_cold_ess_per_second"] / found["plain_ess_per_second"]
    found["gain_over_plain_warm"] = found["ours_warm_ess_per_second"] / found["plain_ess_per_second"]
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    default = Path(__file__).resolve().parents[2] / "fits_data" / "walop_south_small.fits"
    parser.add_argument("calset", nargs="?", type=Path, default=default)
    parser.add_argument("--nuts", type=int, default=200)
    parser.add_argument("--plain-steps", type=int, default=4000)
    chosen = parser.parse_args()
    pin()
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
    print(json.dumps(measure(chosen.calset, chosen.nuts, chosen.plain_steps), indent=1))


if __name__ == "__main__":
    main()
