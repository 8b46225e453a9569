"""Draws of a posterior as `posterior.nc` holds them, ArviZ InferenceData, and calibrations that use them.

posterior.nc   draws of every coefficient that varies. Walkers of an ensemble are not independent chains, so a chain
               here is an ensemble: its draws are all walkers at steps spread evenly over the run. R-hat and effective
               sample sizes are those of `result`, kept as attributes.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from walop_jax.calibration.calibration import Calibration
from walop_jax.data.records import InputFile
from walop_jax.io.errors import fail

DRAWS = 200  # of a posterior, that stand for it in matrices
INFLATION = "noise.ln_f"
_AGAIN = "run walop-jax sample again"


def arviz() -> Any:
    """ArviZ, without the announcement that it makes when it is imported."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import arviz

    return arviz


def digest(*parts: Any) -> str:
    """SHA-256 of arrays, texts and numbers."""
    total = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray) and part.dtype.kind not in "OUS":
            total.update(f"{part.dtype.str}{part.shape}".encode() + np.ascontiguousarray(part).tobytes())
        else:
            total.update(repr(part.tolist() if isinstance(part, np.ndarray) else part).encode() + b"\n")
    return total.hexdigest()


def digest_of_fit(inputs: Sequence[InputFile], names: Sequence[str], values: np.ndarray) -> str:
    """Digest that tells a fit from all others: of its data, its parameters and their values, to the last bit."""
    return digest(sorted(entry.sha256 for entry in inputs), list(names), np.asarray(values, float))


def read_inference_data(path: str | os.PathLike[str]) -> Any:
    """A `posterior.nc` as ArviZ InferenceData; `DataError` if it cannot be read."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return arviz().from_netcdf(str(path), engine="h5netcdf")
    except Exception as error:
        raise fail(f"cannot be read: {error}", file=path, advice=_AGAIN) from error


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
        raise fail(f"cannot be read: {error}", file=path, advice=_AGAIN) from error
    held.pop(INFLATION, None)
    if set(held) | set(fixed) != set(names):
        odd = sorted((set(held) | set(fixed)) ^ set(names))
        raise fail(f"is of another model ({', '.join(odd[:3])})", file=path, advice=_AGAIN)
    if fit is not None and posterior.attrs.get("fit") != fit:
        advice = "give the posterior of this calibration, or run walop-jax sample again"
        raise fail("is of another fit with the same parameters", file=path, advice=advice)
    if not trusted:
        advice = "see the warnings of the fit, or go on with walop-jax sample --resume"
        raise fail(f"is not to be trusted: {posterior.attrs['verdict']}", file=path, advice=advice)
    count = len(next(iter(held.values())))
    return np.stack([held.get(name, np.full(count, fixed.get(name, np.nan))) for name in names], axis=1)


def with_draws(calibration: Calibration, path: str | os.PathLike[str], count: int = DRAWS) -> Calibration:
    """The calibration with `count` draws of a `posterior.nc`, over which its matrices are averaged.

    `DataError` for a file of another model or another fit, or not trusted.
    """
    draws = _draws_of(calibration, path)
    chosen = np.random.default_rng(0).permutation(len(draws))[:count]
    return dataclasses.replace(calibration, draws=draws[chosen])


def with_moments(calibration: Calibration, path: str | os.PathLike[str]) -> Calibration:
    """The calibration with mean and covariance of all draws of a `posterior.nc` in place of the fit's.

    For linear propagation, star by star. `DataError` as in `with_draws`.
    """
    draws = _draws_of(calibration, path)
    return dataclasses.replace(calibration, values=draws.mean(axis=0), covariance=np.cov(draws, rowvar=False))


def _draws_of(calibration: Calibration, path: str | os.PathLike[str]) -> Float[np.ndarray, "d n"]:
    names = calibration.model.names
    return read_draws(path, names, digest_of_fit(calibration.inputs, names, calibration.values))
