"""The folder of a run: the names of its files, and what commands have written there, read when it is asked for."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from walop_jax.calibration import FAILED, PRODUCT, SUMMARY, read_calibration
from walop_jax.calibration.calibration import Calibration
from walop_jax.data import CalibrationSet, read_calibration_set
from walop_jax.fit.model_builder import model_for
from walop_jax.fit.refit import FitResult, fit, with_honest_errors
from walop_jax.fit.verdict import STATED
from walop_jax.io.display import Display, Displayed
from walop_jax.io.errors import fail
from walop_jax.io.text import read_json
from walop_jax.likelihood import limits
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects import EFFECTS, Effect
from walop_jax.posterior.files import read_inference_data

DIAGNOSIS, COMPARISON, EPOCH, LIMITS = "diagnosis.json", "comparison.json", "epoch.json", "limits.json"
POSTERIOR, INTERVALS, CORNER, SAMPLE = "posterior.nc", "posterior.ecsv", "posterior_corner.png", "sample.json"
DOCUMENTS = {
    "summary": SUMMARY,
    "diagnosis": DIAGNOSIS,
    "sample": SAMPLE,
    "comparison": COMPARISON,
    "epoch": EPOCH,
    "limits": LIMITS,
}
"""The documents that a run may hold, and their files."""

SAME_FIT = 0.05  # standard errors


@dataclasses.dataclass(frozen=True, repr=False)
class Run(Displayed):
    """The folder of a run; everything in it is read when it is asked for. None stands for what is not there.

    `catalogue` are the effects that its model may have.
    """

    folder: Path
    catalogue: Sequence[type[Effect]] = EFFECTS

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
    def product(self) -> Calibration | None:
        """The calibration as its file holds it, its model not rebuilt."""
        return read_calibration(self.folder, rebuild=False) if PRODUCT in self else None

    @functools.cached_property
    def calibration(self) -> Calibration | None:
        """The calibration."""
        return read_calibration(self.folder, self.catalogue) if PRODUCT in self else None

    @functools.cached_property
    def documents(self) -> dict[str, dict[str, Any]]:
        """The JSON documents of the run by name: summary, diagnosis, sample, comparison, epoch, limits."""
        return {name: read_json(self.folder / file) for name, file in DOCUMENTS.items() if file in self}

    @functools.cached_property
    def posterior(self) -> Any:
        """The draws as ArviZ InferenceData."""
        return read_inference_data(self.folder / POSTERIOR) if POSTERIOR in self else None

    @functools.cached_property
    def calset(self) -> CalibrationSet:
        """The data of the fit, found as they were named, in the folder of the run, or beside it.

        Raises `DataError` where the run does not say what they were, and where they are not there or have changed.
        """
        inputs = () if self.product is None else self.product.inputs
        if not inputs:
            advice = "make it with walop-jax refit"
            raise fail("does not say what it was fitted to", file=self.folder, advice=advice)
        calset = read_calibration_set(*(self._located(entry.path) for entry in inputs))
        if sorted(entry.sha256 for entry in calset.inputs) != sorted(entry.sha256 for entry in inputs):
            raise fail("the data have changed since the fit", file=inputs[0].path, advice="refit them")
        return calset

    def _located(self, path: Path) -> Path:
        for folder in (Path(), self.folder, self.folder.parent):
            if (folder / path).exists():
                return folder / path
        what = "the data of this run are not there any more"
        raise fail(what, file=path, advice="put them back, or refit")

    def fit(self, model_text: str | None = None) -> FitResult:
        """The fit of the run, made once more from where it ended; `model_text` is the model file of the fit.

        Raises `DataError` when the data are missing, not those of the fit or too many to be sampled, and when the fit
        does not come out as the calibration says (another model, or another version of the physics). Errors are made as
        those of the calibration were, and the verdict is its verdict.
        """
        self.wanted(PRODUCT, "give the RUN of walop-jax refit or diagnose")
        calset, calibration = self.calset, self.calibration
        assert calibration is not None
        text = "\n".join(calibration.model_lines) if model_text is None else model_text
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

    def display(self) -> Display:
        """The files, and the calibration if there is one."""
        found = self.documents
        files = {"calibration": PRODUCT, "posterior": POSTERIOR}
        held = [name for name, file in files.items() if file in self]
        facts = [("holds", ", ".join([*held, *found]) or "nothing")]
        if "diagnosis" in found:
            facts.append(("verdict", str(found["diagnosis"].get("verdict"))))
        inner = Display("") if self.calibration is None else self.calibration.display()
        return dataclasses.replace(
            inner, title=f"Run {self.folder}. {inner.title}".removesuffix(". "), facts=(*facts, *inner.facts)
        )
