"""The commands for callers in Python: one function each, of the same name, on what is in memory or in files.

Wherever a set is wanted it may be a `CalibrationSet`, a path or several; wherever a calibration is wanted, a fit, a
calibration, or the path of a product or a run.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.certify import certify as check_product
from walop_jax.calibration.certify import validity
from walop_jax.calibration.from_file import read_calibration
from walop_jax.calibration.matrix_table import matrix_columns, provenance
from walop_jax.data import DEFAULT_FILTER, read_calibration_set
from walop_jax.data.catalogue import read_catalogue
from walop_jax.data.field_points import field_points
from walop_jax.data.from_arrays import checked
from walop_jax.data.records import KINDS, CalibrationSet
from walop_jax.data.settings import Settings
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.data.user_tables import InputTable, extended, in_memory, read_input_table
from walop_jax.diagnosis import workflow
from walop_jax.diagnosis.detection_limits import detection_limits
from walop_jax.diagnosis.findings import Diagnosis
from walop_jax.diagnosis.limits_found import DetectionLimits
from walop_jax.diagnosis.trust import examined
from walop_jax.fit import refit as fitting
from walop_jax.fit.model_builder import model_for
from walop_jax.fit.refit import FitResult
from walop_jax.io.errors import errors_naming
from walop_jax.io.text import read_text
from walop_jax.likelihood.processes import Processes
from walop_jax.model.effects import EFFECTS, Effect
from walop_jax.model.instrument import Instrument
from walop_jax.model.specification import Model
from walop_jax.model.trace import Sightline, Stage
from walop_jax.model.trace import trace as trace_stages
from walop_jax.paper.comparison import Comparison
from walop_jax.paper.comparison import compare as compare_with_paper
from walop_jax.posterior import Options, PosteriorSample, with_draws, with_moments
from walop_jax.posterior import sample as sample_fit
from walop_jax.runs.certify import Certificate, certify_product
from walop_jax.runs.compare import compare_methods
from walop_jax.runs.diagnose import diagnose_sets
from walop_jax.runs.reading import Run
from walop_jax.runs.refit import refit_sets
from walop_jax.runs.report import Page, write_report
from walop_jax.runs.sample import sample_run
from walop_jax.runs.trace import trace_source
from walop_jax.science import epoch as epochs
from walop_jax.science.apply import apply as apply_to_rows
from walop_jax.science.epoch import Epoch
from walop_jax.science.polarisation import ESTIMATORS
from walop_jax.science.star_errors import Truth
from walop_jax.science.stokes_columns import header, stokes_columns
from walop_jax.simulation.observing_plan import ObservingPlan
from walop_jax.simulation.simulate import as_planned

Path_ = str | os.PathLike[str]
SetLike = CalibrationSet | Path_ | Sequence[Path_]
CalibrationLike = Calibration | FitResult | Run | Path_
ModelLike = Model | Path_
Tell = Callable[[str], None]


def refit(
    data: SetLike,
    model: ModelLike | None = None,
    *,
    instrument: Instrument | Path_ | None = None,
    catalogue: Sequence[type[Effect]] = EFFECTS,
    output: Path_ | None = None,
    overwrite: bool = False,
    folder: Path_ | None = None,
    progress: Tell | None = None,
    memory: float | None = None,
    processes: Processes | None = None,
) -> FitResult:
    """Fit a calibration set jointly: `walop-jax refit`.

    `model` is one, or a model file (default: the base model); `instrument` a description or its name (default: what
    the data say); `catalogue` the effects that a model file may name. With `output` (data from files) the folder of
    a run is written. `folder`, `memory` (bytes) and `processes` are for large sets, as in `fit.refit.refit`;
    `progress` is told what is being done. Raises `DataError` for data that cannot be trusted, ValueError for a
    model that does not fit.
    """
    if output is not None:
        options: dict[str, Any] = _run_options(data, model, instrument, catalogue, overwrite, progress)
        options |= {"memory": memory, "processes": processes}
        return refit_sets(output=output, **options).result
    calset, chosen = _set_and_model(data, model, instrument, catalogue)
    return examined(
        fitting.refit(calset, chosen, folder=folder, progress=progress, memory=memory, processes=processes)
    )


def diagnose(
    data: SetLike,
    model: ModelLike | None = None,
    *,
    instrument: Instrument | Path_ | None = None,
    catalogue: Sequence[type[Effect]] = EFFECTS,
    seed: int = 0,
    output: Path_ | None = None,
    overwrite: bool = False,
    progress: Tell | None = None,
) -> Diagnosis:
    """Find, name and add what the model lacks: `walop-jax diagnose`. Arguments as for `refit`.

    `catalogue` are the effects that may be named: `(*walop.EFFECTS, MyEffect)` adds one of your own.
    """
    if output is not None:
        options = _run_options(data, model, instrument, catalogue, overwrite, progress)
        return diagnose_sets(output=output, seed=seed, **options).diagnosis
    calset, chosen = _set_and_model(data, model, instrument, catalogue)
    return workflow.diagnose(calset, chosen, catalogue=catalogue, seed=seed, progress=progress)


def sample(
    fit: FitResult | Path_,
    *,
    resume: bool = False,
    overwrite: bool = False,
    catalogue: Sequence[type[Effect]] = EFFECTS,
    **options: Any,
) -> PosteriorSample:
    """Sample the posterior around a fit, or around that of a run, which is then written: `walop-jax sample`.

    `options` are the fields of `walop.Options`: `sampler`, `seed`, `parameters`, `maximum_steps`, …
    """
    if options.get("parameters") is not None:
        options["parameters"] = tuple(options["parameters"])
    chosen = Options(**options)
    if isinstance(fit, FitResult):
        return sample_fit(fit, chosen)
    return sample_run(fit, chosen, resume=resume, overwrite=overwrite, catalogue=catalogue).posterior


def matrix(
    calibration: CalibrationLike, x: Any, y: Any = None, *, posterior: Path_ | None = None, **columns: Any
) -> Any:
    """The instrument matrix and its errors at field points, as an astropy table: `walop-jax matrix`.

    `x`, `y` in degrees or as quantities, or a table (a path, an astropy table, columns by name) in place of `x`. Other
    `columns`, such as `TEFF`, `FILTER`, `CHWP_ANGLE`, are those of the command (docs: files), in small letters if you
    like. Beyond the field of the instrument rows are NaN with FLAG 32. With `posterior` (a `posterior.nc`) values and
    errors are those of its draws.
    """
    there = _calibration(calibration)
    table = _table(x if y is None else {"X": x, "Y": y}, columns)
    wanted = field_points(table, there.model.template.patched(), there.always_in)
    chosen = there if posterior is None else with_draws(there, posterior)
    with errors_naming(table.path):
        added = matrix_columns(chosen, wanted.x, wanted.y, wanted.settings, wanted.outside)
    cards = provenance(there.to_product().content_hash(), there, drawn=posterior is not None)
    return extended(table, added, cards)


def apply(
    calibration: CalibrationLike,
    catalogue: Any,
    *,
    estimator: str = ESTIMATORS[0],
    saturation: float = math.inf,
    posterior: Path_ | None = None,
    force: bool = False,
) -> Any:
    """Stokes parameters of stars from their intensities, as an astropy table: `walop-jax apply`.

    `catalogue` is a path, an astropy table, or columns by name: X, Y, N, N_ERR and those that the command knows (docs:
    files). Counts (electrons) from `saturation` on are not used; `estimator` is that of the degree of polarisation, MAS
    or WK; with `posterior` (a `posterior.nc`) mean and covariance are those of its draws; with `force` also stars whose
    filter or temperature the calibration does not cover.
    """
    there, table = _calibration(calibration), _table(catalogue, {})
    chosen = there if posterior is None else with_moments(there, posterior)
    rows = read_catalogue(table, there.model.template.patched(), saturation, always_in=there.always_in)
    with errors_naming(table.path):
        stars = apply_to_rows(chosen, rows, force=force)
    cards = header(there.to_product().content_hash(), estimator, float(np.mean(np.isfinite(rows.rotator))))
    return extended(table, stokes_columns(stars, rows.star, estimator), cards)


def compare(
    data: SetLike,
    calibration: CalibrationLike | None = None,
    *,
    truth: Truth | None = None,
    filter: str = DEFAULT_FILTER,
    model: ModelLike | None = None,
    instrument: Instrument | Path_ | None = None,
    catalogue: Sequence[type[Effect]] = EFFECTS,
    seed: int = 0,
    output: Path_ | None = None,
    overwrite: bool = False,
    progress: Tell | None = None,
) -> Comparison:
    """The method of Paper II beside the joint model on the same data: `walop-jax compare`.

    `calibration` is the joint fit (default: made here, with `model`, `instrument` and `catalogue` as for `refit`). With
    `output` (data from files) the folder of a run is written, and the joint fit is always made.

    Raises ValueError for a `calibration` or `truth` in memory together with `output`.
    """
    if output is not None:
        if calibration is not None or truth is not None:
            raise ValueError("with output the joint fit is made anew: leave calibration and truth out")
        options = _run_options(data, model, instrument, catalogue, overwrite, progress)
        return compare_methods(output=output, filter_name=filter, seed=seed, **options).comparison
    if calibration is None:
        calset, chosen = _set_and_model(data, model, instrument, catalogue)
        joint = Calibration.from_fit(examined(fitting.refit(calset, chosen, progress=progress)))
    else:
        calset, joint = _set(data), _calibration(calibration)
    return compare_with_paper(calset, joint, truth, filter, seed)


def certify(calibration: CalibrationLike, catalogue: Sequence[type[Effect]] = EFFECTS) -> Certificate:
    """Check whether a calibration is fit for use: `walop-jax certify`."""
    if isinstance(calibration, Run):
        return certify_product(calibration.folder, catalogue)
    if not isinstance(calibration, Calibration | FitResult):
        return certify_product(calibration, catalogue)
    product = _calibration(calibration).to_product()
    parents = tuple(entry.sha256 for entry in product.inputs)
    checks = tuple(check_product(product, catalogue))
    return Certificate(Path("in memory"), checks, validity(product), product.content_hash(), parents)


def epoch(old: CalibrationLike, new: SetLike) -> Epoch:
    """Whether an old calibration still fits new data, and what has moved: `walop-jax epoch`."""
    calibration = _calibration(old)
    return epochs.epoch(calibration, examined(epochs.fit_like(calibration, _set(new))))


def limits(
    data: FitResult | ObservingPlan | SetLike,
    model: ModelLike | None = None,
    *,
    catalogue: Sequence[type[Effect]] = EFFECTS,
    seed: int = 0,
    progress: Tell | None = None,
) -> DetectionLimits:
    """At which size effects would be detected and named, and what those may do that are not: `walop-jax limits`.

    `data` is a fit, an observing plan, or what `refit` takes. `limits(...).to_table()` is a row for each effect and
    parameter.
    """
    if isinstance(data, ObservingPlan):
        data = as_planned(data)
    fit = data if isinstance(data, FitResult) else refit(data, model, catalogue=catalogue)
    return detection_limits(fit, catalogue=catalogue, seed=seed, progress=progress)


def report(run: Path_, output: Path_ | None = None, *, overwrite: bool = False) -> Page:
    """Write the page about a run: `walop-jax report`."""
    return write_report(run, output, overwrite=overwrite)


def trace(
    x: float = 0.0,
    y: float = 0.0,
    q: float = 0.0,
    u: float = 0.0,
    *,
    angle: float = math.nan,
    filter: str = DEFAULT_FILTER,
    teff: float = math.nan,
    calibration: CalibrationLike | None = None,
    instrument: Instrument | Path_ | None = None,
    **positions: float,
) -> tuple[Stage, ...]:
    """The light of one source at every place of the instrument: `walop-jax trace`.

    Field position in degrees, Stokes parameters of the source; `angle` of the polariser (deg; NaN: out), `teff` (K;
    NaN: flat photon spectrum), `positions` of other moving elements by the prefix of their columns (deg). The
    instrument is that of a `calibration`, or one as designed (default: the first of the family).
    """
    settings = Settings.default(1, filter).at(**{name.upper(): value for name, value in positions.items()})
    settings.teff[0] = teff
    line = Sightline(x=x, y=y, q=q, u=u, clp_angle=angle, setting=settings)
    if calibration is None and not isinstance(instrument, Instrument):
        return trace_source(line, instrument=instrument).stages
    if calibration is None:
        from walop_jax.data.filters import builtin_filter

        assert isinstance(instrument, Instrument)
        return trace_stages(instrument, builtin_filter(filter), line)
    there = _calibration(calibration)
    return trace_stages(there.model.instrument(there.values), there.filter_curve(filter), line)


# ------------------------------------------------------------------------------------ what was given as what


def _set(data: SetLike, instrument: Instrument | None = None) -> CalibrationSet:
    """A checked set: files are checked as they are read, tables in memory here."""
    if not isinstance(data, CalibrationSet):
        kinds = () if instrument is None else instrument.kinds
        return read_calibration_set(*_paths(data), kinds=kinds)
    if data.inputs or not isinstance(data.intensities, TableIntensities):
        return data
    return checked(data, set(data.exposures.kind.tolist()) - set(KINDS))


def _paths(data: SetLike) -> tuple[Path_, ...]:
    if isinstance(data, CalibrationSet):
        paths = tuple(entry.path for entry in data.inputs)
        if not paths:
            raise ValueError("a run is made from files: write the set first, walop_jax.write_calibration_set")
        return paths
    return (data,) if isinstance(data, str | os.PathLike) else tuple(data)


def _set_and_model(
    data: SetLike,
    model: ModelLike | None,
    instrument: Instrument | Path_ | None,
    catalogue: Sequence[type[Effect]],
) -> tuple[CalibrationSet, Model]:
    design = Instrument.read(instrument) if isinstance(instrument, str | os.PathLike) else instrument
    calset = _set(data, design)
    if isinstance(model, Model):
        return calset, model
    with errors_naming(model):
        return calset, model_for(calset, "" if model is None else read_text(model), design, catalogue)


def _run_options(
    data: SetLike,
    model: ModelLike | None,
    instrument: Instrument | Path_ | None,
    catalogue: Sequence[type[Effect]],
    overwrite: bool,
    progress: Tell | None,
) -> dict[str, Any]:
    if isinstance(model, Model) or isinstance(instrument, Instrument):
        raise ValueError("with output, give model and instrument as files, so that the run can be made again")
    return {
        "calsets": _paths(data), "model": model, "instrument": instrument, "catalogue": catalogue,
        "overwrite": overwrite, "progress": progress,
    }  # fmt: skip


def _calibration(given: CalibrationLike) -> Calibration:
    if isinstance(given, Calibration):
        return given
    if isinstance(given, FitResult):
        return Calibration.from_fit(given)
    if not isinstance(given, Run | str | os.PathLike):
        raise TypeError(
            f"a calibration, a fit, a run or the path of one is needed, not {type(given).__name__}"
        )
    return read_calibration(given.folder if isinstance(given, Run) else given).calibration


def _table(given: Any, columns: dict[str, Any]) -> InputTable:
    if isinstance(given, str | os.PathLike):
        return read_input_table(given)
    if columns:
        given = {str(k): given[k] for k in getattr(given, "colnames", given)}
        given |= {name.upper(): values for name, values in columns.items()}
    return in_memory(given)
