"""A posterior as ArviZ InferenceData in a netCDF file, and as a table of intervals.

Walkers of an ensemble are not independent chains, so a chain here is an ensemble: its draws are all walkers
at steps spread evenly over the run. R-hat and effective sample sizes are those of `convergence`, kept as
attributes.
"""

from __future__ import annotations

import io
import json
import os
import warnings
from typing import Any

import h5py
import numpy as np
from jaxtyping import Float

from walop_jax.io.atomic import atomic_path
from walop_jax.io.errors import fail
from walop_jax.posterior.convergence import arviz
from walop_jax.posterior.result import PosteriorSample
from walop_jax.posterior.target import INFLATION

LEVELS = {"68": (0.1587, 0.8413), "95": (0.0228, 0.9772)}
"""Quantiles of the intervals: ± 1 and ± 2 standard deviations of a normal distribution."""

Column = tuple[np.ndarray, str, str]  # values, unit, description


def inference_data(sample: PosteriorSample) -> Any:
    """ArviZ InferenceData: one variable per coefficient that varies, under its name, with its unit."""
    varies = [i for i in range(len(sample.names)) if np.ptp(sample.draws[:, :, i]) > 0]
    posterior = {sample.names[i]: sample.draws[:, :, i] for i in varies}
    if sample.ln_f is not None:
        posterior[INFLATION] = sample.ln_f
    data = arviz().from_dict(posterior=posterior, sample_stats={"lp": sample.log_posterior})
    for i in varies:
        data.posterior[sample.names[i]].attrs["units"] = sample.units[i] or "1"
    v = sample.convergence
    for k, name in enumerate(v.names):
        if name not in data.posterior:  # it never moved
            continue
        evidence = {"autocorrelation_steps": v.tau[k], "effective_samples": v.ess[k], "r_hat": v.rhat[k]}
        data.posterior[name].attrs.update({key: float(value) for key, value in evidence.items()})
        data.posterior[name].attrs["sampled_by"] = sample.sampler
    data.posterior.attrs.update(
        {
            "sampler": sample.sampler,
            "converged": int(v.converged),
            "trusted": int(sample.trusted),
            "verdict": v.message() if sample.of_trusted_fit else "the fit is not trusted",
            "steps": v.steps,
            "acceptance": sample.acceptance,
            "fingerprint": json.dumps(sample.fingerprint),
            "fit": sample.fit,
            "fixed": json.dumps(
                {n: float(sample.draws[0, 0, i]) for i, n in enumerate(sample.names) if i not in varies}
            ),
        }
    )
    if sample.accuracy is not None:
        numbers = {"efficiency": sample.accuracy.efficiency, "spread": sample.accuracy.spread}
        data.posterior.attrs.update({f"surrogate_{key}": value for key, value in numbers.items()})
    return data


def write_posterior(
    path: str | os.PathLike[str], sample: PosteriorSample, *, overwrite: bool = False
) -> None:
    """Write `posterior.nc` (netCDF 4).

    It appears whole or not at all. Raises `DataError` as `atomic_path` does.
    """
    data = inference_data(sample)
    with atomic_path(path, overwrite=overwrite) as temporary:
        temporary.write_bytes(_netcdf(data))


def _netcdf(data: Any) -> memoryview:
    """The bytes of a netCDF file of ArviZ InferenceData, one group each.

    Made in memory: HDF5 does not survive a disk that is full.
    """
    import h5netcdf
    from xarray.backends import H5NetCDFStore

    buffer = io.BytesIO()
    with warnings.catch_warnings(), h5py.File(buffer, "w") as file:
        warnings.simplefilter("ignore")
        with h5netcdf.File(file, "a") as content:
            for group in data.groups():
                data[group].dump_to_store(H5NetCDFStore(content, group=group, mode="a"))
    return buffer.getbuffer()


def read_inference_data(path: str | os.PathLike[str]) -> Any:
    """A `posterior.nc` as ArviZ InferenceData; `DataError` if it cannot be read."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return arviz().from_netcdf(str(path), engine="h5netcdf")
    except Exception as error:
        raise fail(f"cannot be read: {error}", file=path, advice="run walop-jax sample again") from error


def read_draws(
    path: str | os.PathLike[str], names: tuple[str, ...], fit: str | None = None
) -> Float[np.ndarray, "d n"]:
    """Draws of the parameters `names`, all chains one after the other; fixed ones keep their value.

    `fit` is the `digest_of_fit` that was sampled around; None: whichever. Raises `DataError` for a file that cannot be
    read, is of another model or another fit, or may not be trusted.
    """
    data = read_inference_data(path)
    try:
        posterior = data.posterior
        fixed = json.loads(posterior.attrs["fixed"])
        trusted = bool(posterior.attrs["trusted"])
        held = {str(name): np.asarray(posterior[name].values).ravel() for name in posterior.data_vars}
    except Exception as error:
        raise fail(f"cannot be read: {error}", file=path, advice="run walop-jax sample again") from error
    held.pop(INFLATION, None)
    if set(held) | set(fixed) != set(names):
        odd = sorted((set(held) | set(fixed)) ^ set(names))
        raise fail(
            f"is of another model ({', '.join(odd[:3])})", file=path, advice="run walop-jax sample again"
        )
    if fit is not None and posterior.attrs.get("fit") != fit:
        advice = "give the posterior of this calibration, or run walop-jax sample again"
        raise fail("is of another fit with the same parameters", file=path, advice=advice)
    if not trusted:
        verdict = posterior.attrs["verdict"]
        raise fail(
            f"is not to be trusted: {verdict}",
            file=path,
            advice="see the warnings of the fit, or go on with walop-jax sample --resume",
        )
    count = len(next(iter(held.values())))
    return np.stack([held.get(name, np.full(count, fixed.get(name, np.nan))) for name in names], axis=1)


def intervals(sample: PosteriorSample) -> dict[str, Column]:
    """Median, 68 and 95 % intervals of every coefficient that varies, as columns with unit and description.

    τ, effective samples and R-hat are NaN for coefficients that are not sampled but drawn from their conditional
    distribution.
    """
    varies = [i for i in range(len(sample.names)) if np.ptp(sample.draws[:, :, i]) > 0]
    values = sample.draws.reshape(-1, len(sample.names))[:, varies]
    names, units = [sample.names[i] for i in varies], [sample.units[i] for i in varies]
    if sample.ln_f is not None:
        values = np.concatenate([values, sample.ln_f.reshape(-1, 1)], axis=1)
        names, units = [*names, INFLATION], [*units, ""]
    deviation = np.sqrt(np.diag(sample.covariance))[varies]
    deviation = np.append(deviation, values[:, len(varies) :].std(axis=0))
    columns: dict[str, Column] = {
        "NAME": (np.array(names), "", "coefficient"),
        "UNIT": (np.array(units), "", "unit of the numbers in this row"),
        "MEDIAN": (np.median(values, axis=0), "", "posterior median"),
        "SIGMA": (deviation, "", "posterior standard deviation"),
    }
    for label, levels in LEVELS.items():
        for side, level in zip(("LOW", "HIGH"), levels, strict=True):
            about = f"{'lower' if side == 'LOW' else 'upper'} end of the {label} % interval"
            columns[f"{side}{label}"] = np.quantile(values, level, axis=0), "", about
    v = sample.convergence
    for name, numbers, about in (
        ("TAU", v.tau, "autocorrelation time in steps"),
        ("ESS", v.ess, "effective samples"),
        ("RHAT", v.rhat, "R-hat between ensembles"),
    ):
        known = dict(zip(v.names, numbers, strict=True))
        columns[name] = np.array([known.get(name_, np.nan) for name_ in names]), "", about
    return columns


def report(sample: PosteriorSample) -> dict[str, Any]:
    """What the run found, as plain data, for `sample.json`."""
    v, a = sample.convergence, sample.accuracy
    return {
        "sampler": sample.sampler,
        "errors_from": sample.errors_from,
        "trusted": sample.trusted,
        "converged": v.converged,
        "message": v.message(sample.seconds_per_step),
        "warnings": list(sample.warnings),
        "steps": v.steps,
        "walkers": int(sample.chains.shape[2]),
        "ensembles": int(sample.chains.shape[0]),
        "acceptance": sample.acceptance,
        "autocorrelation_steps": {n: float(t) for n, t in zip(v.names, v.tau, strict=True)},
        "autocorrelation_history": list(v.history),
        "effective_samples": {n: float(t) for n, t in zip(v.names, v.ess, strict=True)},
        "r_hat": {n: float(t) for n, t in zip(v.names, v.rhat, strict=True)},
        "sampler_counts": dict(sample.counts),
        "surrogate": None
        if a is None
        else {
            "draws_checked": a.count,
            "spread": a.spread,
            "efficiency": a.efficiency,
            "largest_shift_sigma": list(a.shift),
            "largest_width_factor": list(a.width),
        },
        "seconds": sample.seconds,
        "fingerprint": sample.fingerprint,
    }
