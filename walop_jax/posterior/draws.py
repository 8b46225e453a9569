"""Draws of a posterior as `posterior.nc` holds them, in the groups of ArviZ, and calibrations that use them.

posterior.nc   draws of every coefficient that varies. Walkers of an ensemble are not independent chains, so a chain
               here is an ensemble: its draws are all walkers at steps spread evenly over the run. R-hat and effective
               sample sizes are those of `result`, kept as attributes.
"""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.metadata
import json
import os
import warnings
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from walop_jax.calibration.calibration import Calibration
from walop_jax.data.records import InputFile
from walop_jax.io.errors import fail
from walop_jax.likelihood.inverses import square_root

if TYPE_CHECKING:  # slow to import, and most commands read no posterior
    from xarray import Dataset, DataTree

DRAWS = 200  # of a posterior, that stand for it in matrices
INFLATION = "noise.ln_f"
"""Variable in the posteriors of earlier versions: ln of a factor on the errors, which was no parameter of the model."""
_AGAIN = "run walop-jax sample again"

A_MEAN = "is the mean over models that its data cannot separate, and no fit of a single one"
"""Said of a calibration that cannot be sampled."""


def as_arviz(groups: DataTree) -> Any:
    """Groups of a posterior as the installed ArviZ takes them: InferenceData (before ArviZ 1), or the tree itself."""
    if int(importlib.metadata.version("arviz").split(".")[0]) >= 1:
        return groups
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the announcement that it makes when it is imported
        import arviz
    data: dict[str, Any] = {name: node.to_dataset() for name, node in groups.children.items()}
    return arviz.InferenceData(**data)


def group_of_draws(draws: Mapping[str, Float[np.ndarray, "c d"]], units: Mapping[str, str] = {}) -> Dataset:
    """Draws of quantities, with units of some, as a group: chains × draws, by number."""
    from xarray import Dataset

    chains, count = next(iter(draws.values())).shape
    place = {"chain": np.arange(chains), "draw": np.arange(count)}
    dims, about = ("chain", "draw"), {name: {"units": unit or "1"} for name, unit in units.items()}
    return Dataset({name: (dims, values, about.get(name)) for name, values in draws.items()}, coords=place)


def digest(*items: Any) -> str:
    """SHA-256 of arrays, texts and numbers."""
    total = hashlib.sha256()
    for item in items:
        if isinstance(item, np.ndarray) and item.dtype.kind not in "OUS":
            total.update(f"{item.dtype.str}{item.shape}".encode() + np.ascontiguousarray(item).tobytes())
        else:
            total.update(repr(item.tolist() if isinstance(item, np.ndarray) else item).encode() + b"\n")
    return total.hexdigest()


def digest_of_fit(inputs: Sequence[InputFile], names: Sequence[str], values: np.ndarray) -> str:
    """Digest that identifies a fit: of its data, its parameters and their values, to the last bit."""
    return digest(sorted(entry.sha256 for entry in inputs), list(names), np.asarray(values, float))


def read_groups(path: str | os.PathLike[str]) -> DataTree:
    """The groups of a `posterior.nc`; `DataError` if it cannot be read."""
    import xarray

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return xarray.open_datatree(path, engine="h5netcdf").load()
    except Exception as error:
        raise fail(f"cannot be read: {error}", file=path, advice=_AGAIN) from error


def read_draws(path: Any, names: tuple[str, ...], fit: str | None = None) -> Float[np.ndarray, "d n"]:
    """Draws (d, n) of the parameters `names`, all chains one after the other; fixed parameters keep their value.

    `path` is the path of a `posterior.nc`, or a posterior in memory. `fit` is the `digest_of_fit` of the fit that was
    sampled around; None: any fit. Raises `DataError` for a file that cannot be read, is of another model or another
    fit, or may not be trusted.
    """
    if isinstance(path, str | os.PathLike):
        groups = read_groups(path)
    else:  # `Run.posterior` and `to_arviz` are groups already; ArviZ 0.x has a `groups` that lists names
        groups, path = path.groups() if hasattr(path, "draws") else path, "the posterior"
    try:
        posterior = groups["posterior"]
        fixed = json.loads(posterior.attrs["fixed"])
        trusted = bool(posterior.attrs["trusted"])
        held = {name: np.asarray(posterior[name].values).ravel() for name in map(str, posterior.data_vars)}
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


def with_draws(calibration: Calibration, path: Any, count: int = DRAWS) -> Calibration:
    """The calibration with `count` draws of a posterior, a file or in memory, over which its matrices are averaged."""
    draws, rng = _draws_of(calibration, path), np.random.default_rng(0)
    chosen, fitted = rng.permutation(len(draws))[:count], calibration.fitted
    # Deviations that a diagnosis adds are independent of the fit.
    root = square_root(calibration.widened(np.zeros((len(fitted), len(fitted)))))
    whole = calibration.values + rng.standard_normal((len(chosen), len(root))) @ root.T
    whole[:, fitted] += draws[chosen] - calibration.values[fitted]
    return dataclasses.replace(calibration, draws=whole)


def with_moments(calibration: Calibration, path: Any) -> Calibration:
    """The calibration with mean and covariance of all draws of a posterior, for linear propagation, star by star."""
    draws, values = _draws_of(calibration, path), calibration.values.copy()
    values[calibration.fitted] = draws.mean(axis=0)
    covariance = calibration.widened(np.cov(draws, rowvar=False))
    return dataclasses.replace(calibration, values=values, covariance=covariance)


def digest_of(calibration: Calibration) -> str:
    """The `digest_of_fit` of the fit of a calibration."""
    fitted, names = calibration.fitted, calibration.model.names
    return digest_of_fit(calibration.inputs, [names[i] for i in fitted], calibration.values[fitted])


def _draws_of(calibration: Calibration, path: Any) -> Float[np.ndarray, "d f"]:
    """Draws of the parameters of the fit."""
    names = calibration.model.names
    return read_draws(path, tuple(names[i] for i in calibration.fitted), digest_of(calibration))
