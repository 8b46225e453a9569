"""Files: `posterior.nc`, which is ArviZ InferenceData, the chain of emcee, and the folder of a run.

posterior.nc   draws of every coefficient that varies. Walkers of an ensemble are not independent chains, so a chain
               here is an ensemble: its draws are all walkers at steps spread evenly over the run. R-hat and effective
               sample sizes are those of `result`, kept as attributes.
Chain          `sampling/chain.h5`: the chains of emcee so far, as its own back end reads them, so that an interrupted
               run can go on. With the fingerprint of data, model, priors, sampler, settings and versions. It is written
               anew after every block of steps: a kill at any moment loses the block being computed.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import io
import json
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from jaxtyping import Float

from walop_jax.calibration.calibration import Calibration, Product
from walop_jax.calibration.product import read_calibration, read_product
from walop_jax.data.calset import read_calibration_set
from walop_jax.data.records import CalibrationSet, InputFile
from walop_jax.fit.model_file import model_for
from walop_jax.fit.parameter_table import ParameterValue
from walop_jax.fit.refit import FitResult, fit, with_honest_errors
from walop_jax.fit.verdict import STATED
from walop_jax.io.atomic import atomic_path
from walop_jax.io.display import Display, Result
from walop_jax.io.errors import fail
from walop_jax.io.names import DOCUMENTS, FAILED, POSTERIOR, PRODUCT, SUMMARY
from walop_jax.io.text import read_json, two_digits
from walop_jax.likelihood import limits
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects import EFFECTS, Effect
from walop_jax.posterior.emcee import emcee_state, random_attributes
from walop_jax.posterior.result import PosteriorSample, arviz
from walop_jax.posterior.samplers import State, Stretch
from walop_jax.posterior.target import INFLATION

DRAWS = 200  # of a posterior, that stand for it in matrices
CHAIN = "chain.h5"
_ADVICE = "sample into another folder, or start anew with --overwrite"
_AGAIN = "run walop-jax sample again"


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


# ------------------------------------------------------------------------------------------- posterior.nc


def write_posterior(path: str | os.PathLike[str], sample: PosteriorSample) -> None:
    """Write `posterior.nc` (netCDF 4), a group for each of ArviZ's.

    It appears whole or not at all. Raises `DataError` as `atomic_path` does.
    """
    import h5netcdf
    from xarray.backends import H5NetCDFStore

    data = sample.to_arviz()

    def fill(file: h5py.File) -> None:
        with warnings.catch_warnings(), h5netcdf.File(file, "a") as content:
            warnings.simplefilter("ignore")
            for group in data.groups():
                data[group].dump_to_store(H5NetCDFStore(content, group=group, mode="a"))

    _write_hdf5(path, fill)


def _write_hdf5(
    path: str | os.PathLike[str], fill: Callable[[h5py.File], None], overwrite: bool = False
) -> None:
    """Write an HDF5 file that `fill` fills, in memory first: HDF5 does not survive a disk that is full."""
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        fill(file)
    with atomic_path(path, overwrite=overwrite) as temporary:
        temporary.write_bytes(buffer.getbuffer())


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


# -------------------------------------------------------------------------------------------------- the chain


class Chain:
    """The chain of emcee in the folder of a run: `emcee.backends.HDFBackend(path, name="ensemble0")`, … reads it.

    `fingerprint` says what it was sampled from, and with.
    """

    def __init__(self, folder: str | os.PathLike[str], fingerprint: Mapping[str, str]) -> None:
        self.path, self.fingerprint = Path(folder) / CHAIN, dict(fingerprint)

    def save(self, states: Sequence[State], stretches: Sequence[Stretch], seconds: float) -> None:
        """Write all ensembles with their states at the end, in the place of what is there."""
        self.path.parent.mkdir(parents=True, exist_ok=True)

        def fill(file: h5py.File) -> None:
            file.attrs.update({"fingerprint": json.dumps(self.fingerprint), "seconds": seconds})
            for number, (state, stretch) in enumerate(zip(states, stretches, strict=True)):
                steps, walkers, dimension = stretch.positions.shape
                group = file.create_group(f"ensemble{number}")
                group.attrs.update(
                    {"version": "3", "nwalkers": walkers, "ndim": dimension, "has_blobs": False}
                )
                group.attrs.update({"iteration": steps, **random_attributes(state)})
                group["chain"], group["log_prob"] = stretch.positions, stretch.log_density
                group["accepted"] = stretch.acceptance.sum(axis=0)

        _write_hdf5(self.path, fill, overwrite=True)

    def load(self) -> tuple[list[State], list[Stretch], float]:
        """All ensembles, their states at the end, and the seconds that they took.

        `DataError` for a file that cannot be read, and for one of anything else.
        """
        from emcee.backends import HDFBackend

        try:
            with h5py.File(self.path, "r") as file:
                before, seconds = (
                    json.loads(str(file.attrs["fingerprint"])),
                    float(str(file.attrs["seconds"])),
                )
                count = len(file)
            kept: list[Any] = [
                HDFBackend(str(self.path), name=f"ensemble{n}", read_only=True) for n in range(count)
            ]
            stretches = [Stretch(k.get_chain(), k.get_log_prob(), _shares(k)) for k in kept]
            states = [
                emcee_state(s.positions[-1], s.log_density[-1], k.random_state)
                for s, k in zip(stretches, kept, strict=True)
            ]
        except Exception as error:  # whatever a damaged file brings about
            raise fail(f"cannot be read: {error}", file=self.path, advice=_ADVICE) from error
        keys = sorted({*before, *self.fingerprint})
        changed = [key for key in keys if before.get(key) != self.fingerprint.get(key)]
        if changed:
            what = ", ".join(
                f"{k} ({before.get(k, 'none')[:12]} → {self.fingerprint.get(k, 'none')[:12]})"
                for k in changed
            )
            raise fail(f"was sampled with other {what}", file=self.path, advice=_ADVICE)
        return states, stretches, seconds


def _shares(kept: Any) -> Float[np.ndarray, "n w"]:
    """Shares of proposals accepted: of a chain that was kept, the mean of each walker."""
    return np.repeat(kept.accepted[None] / kept.iteration, kept.iteration, axis=0)


VERDICTS: Mapping[str, Callable[[Mapping[str, Any]], str]] = {
    "diagnosis": lambda d: str(d["verdict"]),
    "commissioning": lambda d: "go" if d["go"] else "no-go",
    "epoch": lambda d: (
        f"the old calibration {'still holds' if d.get('fits') and d.get('new_trusted') else 'does not hold'}"
    ),
    "survey": lambda d: "trusted" if d["trusted"] else "not trusted",
    "watch": lambda d: "the calibration holds" if d["holds"] else "the calibration is not known to hold",
    "plan": lambda d: f"{d['what']}: {d['value']:.3g} {d['unit']}".rstrip(),
}
"""Documents in a few words."""

SAME_FIT = 0.05  # standard errors


@dataclasses.dataclass(frozen=True, repr=False)
class Run(Result):
    """The folder of a run; everything in it is read when it is asked for. None stands for what is not there.

    `catalogue` are the effects that its model may have, `data` the sets of its fit (default: where they were, in the
    folder of the run, or beside it).

    >>> walop.read("RUN")["pupil.magnification"]
    15.6675 ± 0.0051
    """

    folder: Path
    catalogue: Sequence[type[Effect]] = EFFECTS
    data: Sequence[str | os.PathLike[str]] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "folder", Path(self.folder))

    def __contains__(self, name: str) -> bool:
        return (self.folder / name).exists()

    def wanted(self, name: str, advice: str) -> Path:
        """The path of a file of the run; `DataError`, with advice, where it is not there."""
        if not self.folder.is_dir():
            advice = "give the RUN of walop-jax refit or diagnose"
            raise fail("is not the folder of a run", file=self.folder, advice=advice)
        if name in (SUMMARY, PRODUCT) and name not in self and FAILED in self:
            what = f"the fit of this run did not converge; {FAILED} says how it ended"
            raise fail(what, file=self.folder, advice="look at the data with walop-jax inspect, then refit")
        if name not in self:
            raise fail(f"holds no {name}", file=self.folder, advice=advice)
        return self.folder / name

    @functools.cached_property
    def product(self) -> Product | None:
        """Contents of the file of the calibration, its model not rebuilt."""
        return read_product(self.folder) if PRODUCT in self else None

    @functools.cached_property
    def calibration(self) -> Calibration | None:
        """The calibration."""
        return read_calibration(self.folder, self.catalogue) if PRODUCT in self else None

    @property
    def rebuilt(self) -> Calibration:
        """The calibration; `DataError` where there is none."""
        self.wanted(PRODUCT, "give the RUN of walop-jax refit or diagnose")
        assert self.calibration is not None
        return self.calibration

    @functools.cached_property
    def documents(self) -> dict[str, dict[str, Any]]:
        """The JSON documents of the run by name: those of `DOCUMENTS` that are there."""
        return {name: read_json(self.folder / file) for name, file in DOCUMENTS.items() if file in self}

    @functools.cached_property
    def posterior(self) -> Any:
        """The draws as ArviZ InferenceData."""
        return read_inference_data(self.folder / POSTERIOR) if POSTERIOR in self else None

    @functools.cached_property
    def calset(self) -> CalibrationSet:
        """The data of the fit.

        Raises `DataError` where the run does not say what they were, and where they are not there or have changed.
        """
        inputs = () if self.product is None else self.product.inputs
        if not inputs:
            advice = "make it with walop-jax refit"
            raise fail("does not say what it was fitted to", file=self.folder, advice=advice)
        calset = read_calibration_set(*(self.data or [self._located(entry.path) for entry in inputs]))
        if sorted(entry.sha256 for entry in calset.inputs) != sorted(entry.sha256 for entry in inputs):
            raise fail("these are not the data of the fit any more", file=inputs[0].path, advice="refit them")
        return calset

    def _located(self, path: Path) -> Path:
        beside = self.folder.resolve()
        for folder in (Path(), beside, *beside.parents):
            for there in (folder / path, folder / path.name):
                if there.exists():
                    return there
        raise fail(
            f"cannot be found, neither from {Path.cwd()} nor beside {self.folder}",
            file=path,
            advice="say where it is (--data FILE, for each set of the fit), or copy it into the folder of the run",
        )

    def fit(self, model_text: str | None = None) -> FitResult:
        """The fit of the run, made once more from where it ended; `model_text` is the model file of the fit.

        Raises `DataError` when the data are missing, not those of the fit or too many to be sampled, and when the fit
        does not come out as the calibration says (another model, or another version of the physics). Errors are made as
        those of the calibration were, and the verdict is its verdict.
        """
        calibration, calset = self.rebuilt, self.calset
        text = "\n".join(calibration.product.model_lines) if model_text is None else model_text
        model = model_for(calset, text, calibration.design, self.catalogue)
        if model.names != calibration.model.names:
            advice = "run walop-jax refit with this model first"
            raise fail("was fitted with another model", file=self.folder, advice=advice)
        likelihood = Likelihood.of(calset, model)
        if likelihood.layout.large:
            raise fail(
                f"has {len(calset.points)} field points: the posterior of so many is as good as normal, and "
                "calibration.fits holds its covariance",
                file=calibration.inputs[0].path,
                advice=f"sample sets of up to {limits.LARGE_ABOVE} points; walop-jax compress makes one of frames",
            )
        result = fit(likelihood, start=calibration.values)
        away = np.abs(result.values - calibration.values) / np.where(result.sigma > 0, result.sigma, 1.0)
        if not result.converged or np.max(away) > SAME_FIT:
            name = model.names[int(np.argmax(away))]
            raise fail(
                f"fitted again, {name} moves by {np.max(away):.2g} standard errors", file=self.folder,
                advice="run walop-jax refit with this model and version first",
            )  # fmt: skip
        if calibration.verdict.errors_from != STATED:
            result = with_honest_errors(result)
        verdict = calibration.verdict
        if result.errors_from != verdict.errors_from and verdict.covariance_from == "fit":
            result = dataclasses.replace(
                result, covariance=calibration.covariance, errors_from=verdict.errors_from
            )
        return dataclasses.replace(result, verdict=verdict)

    def __getitem__(self, name: str) -> ParameterValue:
        """A parameter of the calibration by name, with its error; `DataError` where there is no calibration."""
        return self.rebuilt[name]

    def display(self) -> Display:
        """The files, and the calibration if there is one."""
        found = self.documents
        files = {"calibration": PRODUCT, "posterior": POSTERIOR}
        held = [name for name, file in files.items() if file in self]
        facts = [("holds", ", ".join([*held, *found]) or "nothing")]
        known = found.get("summary", {}).get("accuracy_of_p")
        if known and found["summary"].get("trusted"):
            share = f"below 0.1 % over {100 * known['share_below_goal']:.0f} % of it"
            facts.append(
                ("p of a star", f"{two_digits(100 * known['median'])} % (median of the field), {share}")
            )
        facts += [(name, VERDICTS[name](found[name])) for name in VERDICTS if name in found]
        inner = Display("") if self.calibration is None else self.calibration.display()
        return dataclasses.replace(
            inner, title=f"Run {self.folder}. {inner.title}".removesuffix(". "), facts=(*facts, *inner.facts)
        )
