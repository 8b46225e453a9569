"""A run as figures and pages read it: data of a figure, and contents of a page, checked against each other."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from walop_jax.calibration.accuracy import GOAL
from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.matrix import MatrixMaps
from walop_jax.data.records import CalibrationSet
from walop_jax.diagnosis.detection_limits import DetectionLimits
from walop_jax.diagnosis.figure_data import DiagnosisFigureData, figure_data, read_figure_data
from walop_jax.diagnosis.findings import Diagnosis
from walop_jax.fit.refit import FitResult
from walop_jax.io import names
from walop_jax.io.errors import fail
from walop_jax.io.run_folder import OF_A_FIT, RunFolder
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects.free_form import FreeForm
from walop_jax.nights.survey import Survey
from walop_jax.paper.comparison import Comparison
from walop_jax.posterior.result import PosteriorSample
from walop_jax.posterior.run import Run
from walop_jax.reports.style import PAGE, Canvas
from walop_jax.science.field_accuracy import FieldAccuracy, field_accuracy

SUMMARY_KEYS = ("chi2", "dof", "n_data", "parameters", "converged", "message", "versions", "inputs")
DIAGNOSIS_KEYS = ("verdict", "steps", "candidates", "unexplained")
DEFAULTS: dict[str, Any] = {"warnings": [], "remarks": [], "misfit": None}  # keys that a summary may lack
SAME_CHI2 = 1e-6  # relative difference of χ²/dof of one and the same fit, read from two files

T = TypeVar("T")
DATA = "data"
COMPARISON, SURVEY = "comparison", "survey"
Drawable = FitResult | Calibration | Diagnosis | PosteriorSample | Run | Comparison | Survey | CalibrationSet


@dataclasses.dataclass(frozen=True, repr=False)
class FigureSource:
    """The run, or the result in memory, from which a figure is drawn; missing data are a `DataError`.

    `held` are the contents of a result in memory, under the names of the files of a run that would hold them; its data
    are `DATA`, others have names of their own; it has no `run`. `sample` is a posterior in memory, which has the
    walkers as well. `parameters` are coefficients by name; `place` (deg) is a field point, or several for the
    modulation; `step` numbers the effects of a diagnosis; `reference` are values to be marked, by name; `canvas` is
    where to draw, `goal` the error of p that is wanted.
    """

    run: Run | None = None
    held: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    sample: PosteriorSample | None = None
    parameters: tuple[str, ...] = ()
    place: tuple[Any, Any] = (0.0, 0.0)
    step: int = 1
    reference: Mapping[str, float] | None = None
    canvas: Canvas = PAGE
    goal: float = GOAL

    @classmethod
    def of(cls, given: Drawable, **options: Any) -> FigureSource:
        """Source of the figures of a result in memory, or of the folder of a run."""
        if isinstance(given, Run):
            return cls(given, **options)
        if isinstance(given, PosteriorSample):
            return cls(held={names.POSTERIOR: given.groups()}, sample=given, **options)
        if isinstance(given, Calibration | Comparison | Survey | CalibrationSet):
            keys = {Calibration: names.PRODUCT, Comparison: COMPARISON, Survey: SURVEY, CalibrationSet: DATA}
            return cls(held={keys[type(given)]: given}, **options)
        result = given.after if isinstance(given, Diagnosis) else given
        product = Calibration.from_fit(result)
        data = result.likelihood
        if product.model is not result.model:  # that of a mean over a class has its members as well
            data = Likelihood.of(result.calset, product.model)
        held = {DATA: data, names.PRODUCT: product}
        if isinstance(given, Diagnosis):
            held |= {names.FIGURE_DATA: figure_data(given)}
        return cls(held=held, **options)

    def on(self, canvas: Canvas) -> FigureSource:
        """This source with another canvas; results that were computed are kept."""
        other = copy.copy(self)
        object.__setattr__(other, "canvas", canvas)
        return other

    def __contains__(self, name: str) -> bool:
        if self.run is not None and name == DATA:  # of a run that names its data, which a survey does not
            return self.calibration is not None and bool(self.run.data or self.calibration.inputs)
        return name in (self.held if self.run is None else self.run)

    @property
    def folder(self) -> Path:
        """The folder of the run, for messages."""
        return Path(names.IN_MEMORY) if self.run is None else self.run.folder

    def _wanted(self, name: str, read: Callable[[Run], T | None], advice: str = OF_A_FIT) -> T:
        """Contents under the name of a file: those in memory, or `read` from the run, which must have it."""
        if self.run is not None:
            if name != DATA:
                self.run.wanted(name, advice)
            return read(self.run)  # pyright: ignore[reportReturnType]
        if name not in self.held:
            raise fail(f"there is no {name} of this result in memory", advice=advice)
        return self.held[name]

    @property
    def calibration(self) -> Calibration | None:
        """The calibration of the run or in memory; None without either."""
        return self.held.get(names.PRODUCT) if self.run is None else self.run.calibration

    @property
    def required_calibration(self) -> Calibration:
        """The calibration of the run or in memory; `DataError` without one."""
        return self._wanted(names.PRODUCT, lambda run: run.calibration)

    @property
    def maps(self) -> MatrixMaps:
        """The maps of the calibration, which need no model."""
        return self.required_calibration.maps

    @property
    def posterior(self) -> Any:
        """The draws, in the groups of ArviZ; None without any."""
        return self.held.get(names.POSTERIOR) if self.run is None else self.run.posterior

    @property
    def prior_width(self) -> Mapping[str, float]:
        """Widths of the priors by name, as far as they are known."""
        if self.sample is None:
            parameters = () if self.calibration is None else self.calibration.parameters
            return {p.name: np.nan if p.prior is None else p.prior[1] for p in parameters}
        likelihood = self.sample.likelihood
        return {} if likelihood is None else {p.name: p.width or np.nan for p in likelihood.model.parameters}

    @functools.cached_property
    def likelihood(self) -> Likelihood:
        """The likelihood of the data under the model of the calibration."""
        return self._wanted(DATA, lambda run: Likelihood.of(run.calset, run.required_calibration.model))

    @property
    def calset(self) -> CalibrationSet:
        """The data of the fit."""
        if isinstance(calset := self.held.get(DATA), CalibrationSet):
            return calset
        return self.likelihood.calset if self.run is None else self.run.calset

    @functools.cached_property
    def figure_data(self) -> DiagnosisFigureData:
        """Data of the figures of a diagnosis."""
        name, advice = names.FIGURE_DATA, "it comes with walop-jax diagnose"
        return self._wanted(name, lambda run: read_figure_data(run.folder / name), advice)

    @functools.cached_property
    def accuracy(self) -> FieldAccuracy | None:
        """The error of p over the field; None where one exposure holds no p."""
        return field_accuracy(self.required_calibration, goal=self.goal)

    @property
    def limits(self) -> DetectionLimits:
        """The detection limits of the data."""
        name, advice = names.LIMITS, "run walop-jax limits -o RUN first"
        return self._wanted(name, lambda run: read_limits(run.folder / name), advice)

    @property
    def examined(self) -> int:
        """Number of the comparison of a diagnosis that is asked for."""
        count = len(self.figure_data.comparisons) - 1
        if not 0 <= self.step <= count:
            result = f"the diagnosis added {count or 'no'} effect{'s' if count != 1 else ''}"
            advice = "step 0 compares the starting with the final model"
            raise fail(f"step {self.step}: {result}", advice=advice)
        return self.step


@dataclasses.dataclass(frozen=True)
class RunContents:
    """The contents of a run; None for files that are not there. `missing` names their sections of a page.

    `source` is what figures are drawn from. `summary`, `diagnosis` and `sample` are the contents of the JSON files;
    `corner` are the bytes of a PNG; `limits` are detection limits of the same data, `checked` is the answer of
    `walop-jax check` to whether this calibration is good, of the same content.
    """

    source: FigureSource
    summary: dict[str, Any]
    calibration: Calibration | None
    diagnosis: dict[str, Any] | None
    figure_data: DiagnosisFigureData | None
    sample: dict[str, Any] | None
    corner: bytes | None
    limits: DetectionLimits | None
    checked: dict[str, Any] | None
    missing: list[str]


@contextlib.contextmanager
def noted(missing: list[str], sentence: str) -> Iterator[None]:
    """Errors of data or files of the block as a `sentence`, with the error in place of {}, if it is not yet there."""
    try:
        yield
    except (ValueError, OSError) as error:
        if not any(str(error) in entry for entry in missing):
            missing.append(sentence.format(error))


def read_run(run: Run | Path) -> RunContents:
    """Read the folder of a `refit` or `diagnose`, with what `sample` may have added.

    Raises `DataError`, with advice, if it is no such folder or if its summary or diagnosis cannot be read; other
    files that are absent or damaged are left out and listed in `missing`.
    """
    run = Run(run) if isinstance(run, Path) else run
    run.wanted(names.SUMMARY)
    source = FigureSource(run)
    missing: list[str] = []

    def optional(name: str, read: Callable[[], T], lost: str, wanted: bool = True) -> T | None:
        if name in run:
            with noted(missing, f"{name} cannot be used ({{}}): {lost}."):
                return read()
        elif wanted:
            missing.append(f"{name} is not there: {lost}.")
        return None

    summary = DEFAULTS | run.document(names.SUMMARY, SUMMARY_KEYS)
    calibration = optional(
        names.PRODUCT, lambda: run.calibration, "no maps of the matrix, no pulls from the priors"
    )
    diagnosis = run.document(names.DIAGNOSIS, DIAGNOSIS_KEYS) if names.DIAGNOSIS in run else None
    pictures = None
    if diagnosis is not None:
        lost = "no maps of the residuals, no curves, no ladder of χ²"
        pictures = optional(names.FIGURE_DATA, lambda: source.figure_data, lost)
        effects = [step["effect"] for step in diagnosis["steps"]]
        drawn = [] if pictures is None else [comparison.effect for comparison in pictures.comparisons[1:]]
        if pictures is not None and drawn not in (effects, [*effects, FreeForm.name]):
            what = f"is of another diagnosis than {names.DIAGNOSIS}: its pictures are left out"
            missing.append(f"{names.FIGURE_DATA} {what}.")
            pictures = None
        stated, ratio = diagnosis.get("chi2_per_dof_after"), summary["chi2"] / max(summary["dof"], 1)
        if stated is not None and abs(stated - ratio) > SAME_CHI2 * ratio:
            what = f"is of another fit than {names.SUMMARY}: this folder was written to again since"
            missing.append(f"{names.DIAGNOSIS} {what}.")
    sampled, corner = names.POSTERIOR in run, names.CORNER
    contents = RunContents(
        source=source,
        summary=summary,
        calibration=calibration,
        diagnosis=diagnosis,
        figure_data=pictures,
        sample=optional(
            names.SAMPLE, lambda: run.document(names.SAMPLE), "no verdict on the sampling", sampled
        ),
        corner=optional(corner, (run.folder / corner).read_bytes, "no corner plot", sampled),
        limits=optional(names.LIMITS, lambda: _limits(run, summary), "no protection level", False),
        checked=optional(names.CHECK, lambda: _checked(run, calibration), "no go or no-go", False),
        missing=missing,
    )
    if calibration is not None and diagnosis is None:
        with noted(missing, "Residuals are not drawn: {}."):
            run.calset  # noqa: B018
    return contents


def read_limits(path: Path) -> DetectionLimits:
    """The content of a `limits.json`. Raises `DataError` if it is none."""
    try:
        content = RunFolder(path.parent).document(path.name, ("limits", "effects", "protection"))
        return DetectionLimits.from_document(content)
    except (KeyError, TypeError, ValueError, IndexError) as error:
        what = f"is not what walop-jax limits writes: {error}"
        raise fail(what, file=path, advice="run it again") from error


def _checked(run: Run, calibration: Calibration | None) -> dict[str, Any] | None:
    """The answer about the calibration of a run by itself; None for one about other questions, or another content."""
    document = run.document(names.CHECK, ("go",))
    same = calibration is not None and document.get("product") == calibration.content_hash()
    return document if same and "commissioning" in document else None


def _limits(run: Run, summary: dict[str, Any]) -> DetectionLimits:
    """The limits of the data behind a summary; those of other data are refused."""
    path, documents = run.folder / names.LIMITS, (run.document(names.LIMITS, ("inputs",)), summary)
    of, expected = ({entry["sha256"] for entry in document["inputs"]} for document in documents)
    if of != expected:
        raise fail("is of other data", file=path, advice="run walop-jax limits on the sets of this run")
    return read_limits(path)
