"""A run as figures and pages read it: what a figure needs, and the contents of a page, checked against each other."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from walop_jax.calibration.calibration import Calibration, Product
from walop_jax.calibration.matrix import MatrixMaps
from walop_jax.data.user_tables import read_input_table
from walop_jax.diagnosis.figure_data import DiagnosisFigureData, figure_data, read_figure_data
from walop_jax.diagnosis.findings import Diagnosis
from walop_jax.diagnosis.limits_found import DetectionLimits
from walop_jax.fit.refit import FitResult
from walop_jax.io.errors import DataError, fail
from walop_jax.io.names import (
    COMMISSIONING,
    CORNER,
    DIAGNOSIS,
    FIGURE_DATA,
    INTERVALS,
    LIMITS,
    POSTERIOR,
    PRODUCT,
    SAMPLE,
    SUMMARY,
)
from walop_jax.io.text import read_json
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects.free_form import FreeForm
from walop_jax.posterior.files import Run
from walop_jax.posterior.result import PosteriorSample
from walop_jax.reports.style import PAGE, Canvas

SUMMARY_KEYS = ("chi2", "dof", "n_data", "parameters", "converged", "message", "versions", "inputs")
DIAGNOSIS_KEYS = ("verdict", "steps", "candidates", "unexplained")
DEFAULTS: dict[str, Any] = {"warnings": [], "remarks": [], "misfit": None}  # what a summary may lack
SAME_CHI2 = 1e-6  # relative difference of χ²/dof of one and the same fit, read from two files

T = TypeVar("T")
Drawable = FitResult | Calibration | Diagnosis | PosteriorSample | Run
_IN_MEMORY = {PRODUCT: "product", POSTERIOR: "posterior", FIGURE_DATA: "figure_data"}
"""Attributes in which a result in memory holds what the file of a run would."""


@dataclasses.dataclass(frozen=True, repr=False)
class FigureSource(Run):
    """The run that a figure is drawn from; what it needs and is not there is a `DataError`.

    `parameters` are coefficients by name; `place` (deg) is a field point; `step` numbers the effects of a diagnosis;
    `reference` are values to be marked, by name; `canvas` is where to draw. `in_memory`: there is no folder, all that
    there is was put into the cached properties by `of`.
    """

    parameters: tuple[str, ...] = ()
    place: tuple[float, float] = (0.0, 0.0)
    step: int = 1
    reference: Mapping[str, float] | None = None
    canvas: Canvas = PAGE
    in_memory: bool = False

    @classmethod
    def of(cls, given: Drawable, **options: Any) -> FigureSource:
        """Source of the figures of a result in memory, or of the folder of a run."""
        if isinstance(given, Run):
            return cls(given.folder, given.catalogue, given.data, **options)
        made = cls(Path("in memory"), in_memory=True, **options)
        held: dict[str, Any] = {"documents": {}, "product": None, "calibration": None, "posterior": None}
        if isinstance(given, PosteriorSample):
            held |= {"posterior": given.to_arviz(), "sample": given}
            model = None if given.likelihood is None else given.likelihood.model
            held["prior_width"] = (
                {} if model is None else {p.name: p.width or np.nan for p in model.parameters}
            )
        if isinstance(given, Diagnosis):
            held["figure_data"] = figure_data(given)
        fit = given.after if isinstance(given, Diagnosis) else given
        if isinstance(fit, FitResult):
            held |= {"calset": fit.calset, "likelihood": fit.likelihood}
            fit = Calibration.from_fit(fit)
        if isinstance(fit, Calibration):
            held |= {"product": fit, "calibration": fit}
        vars(made).update(held)
        return made

    def __contains__(self, name: str) -> bool:
        """True where a file is there, or what it would hold is in memory."""
        if self.in_memory:
            return vars(self).get(_IN_MEMORY.get(name, "")) is not None
        return super().__contains__(name)

    def wanted(self, name: str, advice: str) -> Path:
        """As for any run; what is held in memory has no file."""
        if not self.in_memory:
            return super().wanted(name, advice)
        if name not in self:
            raise fail(f"there is no {name} of this result in memory", advice=advice)
        return self.folder / name

    @functools.cached_property
    def sample(self) -> PosteriorSample | None:
        """A posterior in memory, which has the walkers as well."""
        return None

    @functools.cached_property
    def figure_data(self) -> DiagnosisFigureData:
        """Data of the figures of a diagnosis."""
        return read_figure_data(self.wanted(FIGURE_DATA, "it comes with walop-jax diagnose"))

    @functools.cached_property
    def prior_width(self) -> Mapping[str, float]:
        """Widths of the priors by name, as far as they are known."""
        parameters = () if self.product is None else self.product.parameters
        return {p.name: np.nan if p.prior is None else p.prior[1] for p in parameters}

    @property
    def examined(self) -> int:
        """Number of the comparison of a diagnosis that is asked for."""
        count = len(self.figure_data.comparisons) - 1
        if self.step > count:
            found = f"the diagnosis added {count or 'no'} effect{'s' if count != 1 else ''}"
            raise fail(
                f"step {self.step}: {found}", advice="step 0 compares the starting with the final model"
            )
        return self.step

    @functools.cached_property
    def likelihood(self) -> Likelihood:
        """The likelihood of the data of the run under its model."""
        return Likelihood.of(self.calset, self.rebuilt.model)

    @property
    def maps(self) -> MatrixMaps:
        """The maps of the file, which need no model."""
        return self.stored.maps

    @property
    def stored(self) -> Calibration | Product:
        """Contents of the file, or the calibration in memory."""
        self.wanted(PRODUCT, "give the RUN of walop-jax refit or diagnose")
        assert self.product is not None
        return self.product

    @property
    def limits(self) -> DetectionLimits:
        """The detection limits of the data."""
        return read_limits(self.wanted(LIMITS, "run walop-jax limits -o RUN first"))


@dataclasses.dataclass(frozen=True)
class RunContents:
    """The contents of a run; None for what is not there. `missing` says what that means for a page.

    `source` is what figures are drawn from. `summary`, `diagnosis` and `sample` are the contents of the JSON files;
    `intervals` are rows of the table of posterior intervals; `corner` are the bytes of a PNG; `limits` is what
    `limits` has found for the same data, `commissioning` is a go or no-go with its reasons.
    """

    source: FigureSource
    summary: dict[str, Any]
    product: Calibration | Product | None
    diagnosis: dict[str, Any] | None
    figure_data: DiagnosisFigureData | None
    sample: dict[str, Any] | None
    intervals: tuple[dict[str, Any], ...]
    corner: bytes | None
    limits: DetectionLimits | None
    commissioning: dict[str, Any] | None
    missing: tuple[str, ...]


def read_run(run: Run | Path) -> RunContents:
    """Read the folder of a `refit` or `diagnose`, with what `sample` may have added.

    Raises `DataError`, with advice, if it is no such folder or if its summary or diagnosis cannot be read; other
    files that are absent or damaged are left out and listed in `missing`.
    """
    source = FigureSource(run) if isinstance(run, Path) else FigureSource.of(run)
    source.wanted(SUMMARY, "give the RUN of walop-jax refit or diagnose")
    folder = source.folder
    missing: list[str] = []

    def optional(name: str, read: Callable[[Path], T], lost: str, wanted: bool = True) -> T | None:
        if name not in source:
            if wanted:
                missing.append(f"{name} is not there: {lost}.")
            return None
        try:
            return read(folder / name)
        except (DataError, OSError) as error:
            missing.append(f"{name} cannot be used ({error}): {lost}.")
            return None

    summary = DEFAULTS | _document(folder / SUMMARY, SUMMARY_KEYS)
    product = optional(PRODUCT, lambda _: source.product, "no maps of the matrix, no pulls from the priors")
    diagnosis = _document(folder / DIAGNOSIS, DIAGNOSIS_KEYS) if DIAGNOSIS in source else None
    pictures = None
    if diagnosis is not None:
        lost = "no maps of the residuals, no curves, no ladder of χ²"
        pictures = optional(FIGURE_DATA, lambda _: source.figure_data, lost)
        names = [step["effect"] for step in diagnosis["steps"]]
        drawn = [] if pictures is None else [one.effect for one in pictures.comparisons[1:]]
        if pictures is not None and drawn not in (names, [*names, FreeForm.name]):
            missing.append(
                f"{FIGURE_DATA} is of another diagnosis than {DIAGNOSIS}: its pictures are left out."
            )
            pictures = None
        if _another_fit(summary, diagnosis):
            missing.append(
                f"{DIAGNOSIS} is of another fit than {SUMMARY}: this folder was written to again since."
            )
    sampled = POSTERIOR in source
    rest = {
        "sample": optional(SAMPLE, lambda path: _document(path, ()), "no verdict on the sampling", sampled),
        "intervals": optional(INTERVALS, _intervals, "no table of the posterior", sampled) or (),
        "corner": optional(CORNER, Path.read_bytes, "no corner plot", sampled),
        "limits": optional(LIMITS, lambda path: _limits(path, summary), "no protection level", False),
        "commissioning": optional(
            COMMISSIONING, lambda path: _document(path, ("go", "requirements")), "no go or no-go", False
        ),
    }
    if product is not None and diagnosis is None:
        try:
            source.calset  # noqa: B018
        except (ValueError, OSError) as error:
            missing.append(f"Residuals are not drawn: {error}.")
    return RunContents(source, summary, product, diagnosis, pictures, missing=tuple(missing), **rest)


def _document(path: Path, keys: tuple[str, ...]) -> dict[str, Any]:
    content = read_json(path)
    lacking = [key for key in keys if not isinstance(content, dict) or key not in content]
    if lacking or not isinstance(content, dict):
        what = f"has no {lacking[0]!r}" if lacking else "is not a summary"
        raise fail(what, file=path, advice="run the command that made it again")
    return content


def read_limits(path: Path) -> DetectionLimits:
    """The content of a `limits.json`. Raises `DataError` if it is none."""
    try:
        return DetectionLimits.from_document(_document(path, ("limits", "effects", "protection")))
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise fail(
            f"is not what walop-jax limits writes: {error}", file=path, advice="run it again"
        ) from error


def _limits(path: Path, summary: dict[str, Any]) -> DetectionLimits:
    """The limits of the data behind a summary; those of other data are refused."""
    of, wanted = (
        {entry["sha256"] for entry in document["inputs"]}
        for document in (_document(path, ("inputs",)), summary)
    )
    if of != wanted:
        raise fail("is of other data", file=path, advice="run walop-jax limits on the sets of this run")
    return read_limits(path)


def _another_fit(summary: dict[str, Any], diagnosis: dict[str, Any]) -> bool:
    said = diagnosis.get("chi2_per_dof_after")
    ratio = summary["chi2"] / max(summary["dof"], 1)
    return said is not None and abs(said - ratio) > SAME_CHI2 * ratio


def _intervals(path: Path) -> tuple[dict[str, Any], ...]:
    """Rows of the sampled coefficients: those that have an effective sample size."""
    table = read_input_table(path).table
    names = ("NAME", "UNIT", "MEDIAN", "LOW68", "HIGH68", "LOW95", "HIGH95", "ESS")
    lacking = [name for name in names if name not in table.colnames]
    if lacking:
        raise fail("the column is missing", file=path, column=lacking[0])
    # An empty text comes back masked.
    columns = {
        name: np.ma.filled(np.ma.asarray(table[name]), "" if name in names[:2] else np.nan) for name in names
    }
    rows = [{name: column[i] for name, column in columns.items()} for i in range(len(table))]
    return tuple(row for row in rows if np.isfinite(float(row["ESS"])))
