"""The posterior around the fit of a run: chains kept on the way, then draws, intervals and figures beside the fit."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.product import CalibrationProduct, read_product, write_product
from walop_jax.calibration.summary import PRODUCT
from walop_jax.io.errors import fail
from walop_jax.io.folder import OutputFolder, output_folder
from walop_jax.io.plain_tables import write_columns
from walop_jax.io.text import json_text, read_text
from walop_jax.model.effects import EFFECTS, Effect
from walop_jax.posterior import (
    Checkpoints,
    Options,
    PosteriorSample,
    Report,
    digest_of_fit,
    fit_of_run,
    sample,
    write_posterior,
)
from walop_jax.reports.posterior_figures import (
    MOST_IN_CORNER,
    corner_figure,
    informed,
    save_figure,
    trace_figure,
)
from walop_jax.reports.run import CORNER, INTERVALS, POSTERIOR, SAMPLE

CHAINS = "sampling"
"""Folder, in that of the run, of the checkpoints."""

INTERVALS_FITS, TRACE = "posterior.fits", "posterior_trace.png"
OUTPUTS = (POSTERIOR, INTERVALS_FITS, INTERVALS, CORNER, TRACE, SAMPLE)


@dataclasses.dataclass(frozen=True)
class SampledRun:
    """A posterior, and the content of `sample.json`."""

    posterior: PosteriorSample
    summary: dict[str, Any]


def sample_run(
    run: str | os.PathLike[str],
    options: Options | None = None,
    *,
    model: str | os.PathLike[str] | None = None,
    resume: bool = False,
    overwrite: bool = False,
    catalogue: Sequence[type[Effect]] = EFFECTS,
    progress: Report | None = None,
) -> SampledRun:
    """Sample the posterior around the fit in the folder `run`, and write it there.

    Checkpoints lie in `run`/sampling: with `resume` an interrupted call goes on from them, bit for bit. `model` is
    the TOML file of the fit, by default the model that `calibration.fits` holds. A posterior that is to be trusted
    puts its covariance into `calibration.fits`; another is written and marked so, and `calibration.fits` stays.

    `catalogue` are the effects that the model may have; `progress` is told what is done, how much of it, τ and the
    effective sample size. Raises `DataError` if `run` is no folder of a fit, holds a posterior already (neither
    `resume` nor `overwrite`), or does not fit its data any more; and as `posterior.sample` does.
    """
    folder = Path(run)
    if not folder.is_dir():
        raise fail("is not a folder", file=folder, advice="give the RUN of walop-jax refit")
    text = None if model is None else read_text(model)
    found = [name for name in OUTPUTS if (folder / name).exists()]
    if found and not (overwrite or resume):
        raise fail(f"holds {found[0]} already", file=folder, advice="go on with --resume, or --overwrite it")
    with output_folder(folder, OUTPUTS, overwrite=True) as out:
        product = read_product(folder / PRODUCT)
        result = fit_of_run(product, folder, text, catalogue)
        if overwrite and not resume:
            Checkpoints(folder / CHAINS, {}).clear()
        posterior = sample(result, options, folder=folder / CHAINS, resume=resume, report=progress)
        table = product.parameters
        fitted = digest_of_fit(product.inputs, table.name.tolist(), table.value)
        posterior = dataclasses.replace(posterior, of_trusted_fit=product.verdict.trusted, fit=fitted)
        summary = posterior.document()
        _write(out, product, posterior, summary, catalogue)
    return SampledRun(posterior, summary)


def _write(
    out: OutputFolder,
    product: CalibrationProduct,
    posterior: PosteriorSample,
    summary: dict[str, Any],
    catalogue: Sequence[type[Effect]],
) -> None:
    units = dict(zip(posterior.names, posterior.units, strict=True))
    sampled = [units.get(name, "") for name in posterior.sampled]
    notes = {"TRUSTED": posterior.trusted, "STEPS": posterior.convergence.steps}
    names = OUTPUTS + ((PRODUCT,) if posterior.trusted else ())
    with out.filled(names) as folder:
        write_posterior(folder / POSTERIOR, posterior)
        for name in (INTERVALS_FITS, INTERVALS):
            write_columns(folder / name, posterior.intervals(), notes)
        shown, draws = _in_corner(posterior, product)
        save_figure(folder / CORNER, corner_figure(draws, shown, [units.get(name, "") for name in shown]))
        trace = trace_figure(
            posterior.chains, posterior.sampled, sampled, posterior.thin, posterior.convergence.tau
        )
        save_figure(folder / TRACE, trace)
        (folder / SAMPLE).write_text(json_text(summary), encoding="utf-8")
        if posterior.trusted:
            write_product(folder / PRODUCT, _with_covariance(product, posterior, catalogue))


def _in_corner(posterior: PosteriorSample, product: CalibrationProduct) -> tuple[tuple[str, ...], np.ndarray]:
    """Names and draws of the sampled coefficients that the data constrain best, as many as a figure can label."""
    draws = _sampled_draws(posterior)
    spread = dict(zip(posterior.sampled, draws.std(axis=0).tolist(), strict=True))
    table = product.parameters
    prior = dict(zip(table.name.tolist(), table.prior_width.tolist(), strict=True))
    shown = informed(posterior.sampled, spread, prior)[:MOST_IN_CORNER] or posterior.sampled[:MOST_IN_CORNER]
    return shown, draws[:, [posterior.sampled.index(name) for name in shown]]


def _sampled_draws(posterior: PosteriorSample) -> np.ndarray:
    """Draws of the sampled coefficients (draw, coefficient), the factor on the errors last where it is sampled."""
    columns = [posterior.names.index(name) for name in posterior.sampled if name in posterior.names]
    draws = posterior.draws.reshape(-1, len(posterior.names))[:, columns]
    if posterior.ln_f is None:
        return draws
    return np.concatenate([draws, posterior.ln_f.reshape(-1, 1)], axis=1)


def _with_covariance(
    product: CalibrationProduct, posterior: PosteriorSample, catalogue: Sequence[type[Effect]]
) -> CalibrationProduct:
    """The product with the covariance of the posterior in place of that of the fit."""
    calibration = Calibration.from_product(product, catalogue)
    verdict = dataclasses.replace(
        calibration.verdict, covariance_from="posterior", errors_from=posterior.errors_from
    )
    return dataclasses.replace(calibration, covariance=posterior.covariance, verdict=verdict).to_product()
