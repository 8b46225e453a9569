"""A run: its folder, with the calibration, the data, the fit and the posterior that it stands for."""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.product import read_calibration
from walop_jax.data.calset import read_calibration_set
from walop_jax.data.clipped import read_clipped
from walop_jax.data.records import CalibrationSet
from walop_jax.fit.model_of_set import model_for
from walop_jax.fit.parameter_table import Fitted
from walop_jax.fit.refit import FitResult, fit, with_empirical_covariance
from walop_jax.fit.verdict import STATED
from walop_jax.io.display import Display
from walop_jax.io.errors import errors_naming, fail
from walop_jax.io.names import CLIPPED, MODEL, POSTERIOR, PRODUCT, SUMMARY
from walop_jax.io.run_folder import RunFolder
from walop_jax.io.shapes import Matrix, Vector
from walop_jax.io.text import per_cent
from walop_jax.likelihood import limits
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects import EFFECTS, Deviations, EffectKind
from walop_jax.model.effects.in_models import model_without
from walop_jax.model.specification import Model
from walop_jax.posterior.draws import A_MEAN, read_groups

SAME_FIT = 0.05  # standard errors


@dataclasses.dataclass(frozen=True, repr=False)
class Run(RunFolder, Fitted):  # pyright: ignore[reportIncompatibleVariableOverride]
    """The folder of a run; files are read when they are needed, and a missing file is None.

    `catalogue` are the effects that its model may have, `data` the sets of its fit (default: where they were, in the
    folder of the run, or beside it). Values, covariance, names and `to_table()` are taken from its calibration, as of a
    fit; `posterior` are the draws.

    >>> walop.read("RUN")["pupil.magnification"]
    15.6675 ± 0.0051
    """

    catalogue: Sequence[EffectKind] = dataclasses.field(default_factory=lambda: EFFECTS)
    data: Sequence[str | os.PathLike[str]] = ()

    @functools.cached_property
    def calibration(self) -> Calibration | None:
        """The calibration, also where its model cannot be built here (`Calibration.unavailable`)."""
        return read_calibration(self.folder, self.catalogue, any_model=True) if PRODUCT in self else None

    @property
    def required_calibration(self) -> Calibration:
        """The calibration; `DataError` where there is none."""
        self.wanted(PRODUCT)
        assert self.calibration is not None
        return self.calibration

    @property
    def model(self) -> Model:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The model that was fitted."""
        return self.required_calibration.model

    @property
    def values(self) -> Vector:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Values of all parameters."""
        return self.required_calibration.values

    @property
    def covariance(self) -> Matrix:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Covariance of all parameters."""
        return self.required_calibration.covariance

    @property
    def trusted(self) -> bool:
        """True if its calibration is to be trusted."""
        return self.required_calibration.verdict.trusted

    @functools.cached_property
    def posterior(self) -> Any:
        """The draws, in the groups of ArviZ."""
        return read_groups(self.folder / POSTERIOR) if POSTERIOR in self else None

    @functools.cached_property
    def calset(self) -> CalibrationSet:
        """The data of the fit, without the rows that it left out as outliers.

        Raises `DataError` where the run does not name them, or they are missing or have changed.
        """
        if self.calibration is None or not (inputs := self.calibration.inputs):
            advice = "make it with walop-jax refit"
            raise fail("does not name the data of its fit", file=self.folder, advice=advice)
        paths = self.data or [self._located(entry.path) for entry in inputs]
        cells = self.document(SUMMARY).get("cells") if SUMMARY in self else None
        calset = read_calibration_set(*paths, kinds=self.calibration.design.kinds, cells=cells)
        if sorted(entry.sha256 for entry in calset.inputs) != sorted(entry.sha256 for entry in inputs):
            raise fail("these are not the data of the fit any more", file=inputs[0].path, advice="refit them")
        if CLIPPED not in self:
            return calset
        with errors_naming(self.folder / CLIPPED):
            return read_clipped(self.folder / CLIPPED).taken_from(calset)

    def _located(self, path: Path) -> Path:
        beside = self.folder.resolve()
        for folder in (Path(), beside, *beside.parents):
            for candidate in (folder / path, folder / path.name):
                if candidate.exists():
                    return candidate
        advice = (
            "give its place (--data FILE, for each set of the fit), or copy it into the folder of the run"
        )
        what = f"cannot be found, neither from {Path.cwd()} nor beside {self.folder}"
        raise fail(what, file=path, advice=advice)

    def fit(self, model_text: str | None = None) -> FitResult:
        """The fit of the run, made once more from where it ended; `model_text` is the model file of the fit.

        Raises `DataError` when the data are missing, not those of the fit or too many to be sampled, and when the fit
        does not come out as the calibration says (another model, or another version of the physics), or is a mean over
        a class. Errors are made as those of the calibration were, and the verdict is its verdict.
        """
        diagnosis = self.documents.get("diagnosis", {})
        if diagnosis.get("members") or diagnosis.get("shape"):
            advice = f"fit one: walop-jax refit --model {self.folder / MODEL}, and take that run"
            raise fail(A_MEAN, file=self.folder, advice=advice)
        calibration, calset = self.required_calibration, self.calset
        text = "\n".join(calibration.model_lines) if model_text is None else model_text
        model = model_for(calset, text, calibration.design, self.catalogue)
        if Deviations.name in model.effect_names:
            model = model_without(model, Deviations.name)
        advice = "run walop-jax refit with this model and version first"
        fitted, names = calibration.fitted, calibration.model.names
        if model.names != tuple(names[i] for i in fitted):
            raise fail("was fitted with another model", file=self.folder, advice=advice)
        likelihood = Likelihood.of(calset, model)
        if likelihood.layout.large:
            what = "the posterior of so many is as good as normal, and calibration.fits holds its covariance"
            advice = f"sample a set of up to {limits.LARGE_ABOVE} points"
            many = f"has {len(calset.points)} field points"
            raise fail(f"{many}: {what}", file=calibration.inputs[0].path, advice=advice)
        values = calibration.values[fitted]
        result = fit(likelihood, start=values)
        away = np.abs(result.values - values) / np.where(result.sigma > 0, result.sigma, 1.0)
        if not result.converged or np.max(away) > SAME_FIT:
            what = f"{model.names[int(np.argmax(away))]} moves by {np.max(away):.2g} standard errors"
            raise fail(f"fitted again, {what}", file=self.folder, advice=advice)
        if calibration.verdict.errors_from != STATED:
            result = with_empirical_covariance(result)
        verdict = calibration.verdict
        if result.errors_from != verdict.errors_from and verdict.covariance_from == "fit":
            errors = {
                "covariance": calibration.covariance[np.ix_(fitted, fitted)],
                "errors_from": verdict.errors_from,
            }
            result = dataclasses.replace(result, **errors)
        return dataclasses.replace(result, verdict=verdict)

    def display(self) -> Display:
        """The files, and the calibration if there is one."""
        documents = self.documents
        files = {"calibration": PRODUCT, "posterior": POSTERIOR}
        held = [name for name, file in files.items() if file in self]
        facts = [("holds", ", ".join([*held, *documents]) or "nothing")]
        accuracy = documents.get("summary", {}).get("accuracy_of_p")
        if accuracy and documents["summary"].get("trusted"):
            share = f"below 0.1 % over {100 * accuracy['share_below_goal']:.0f} % of it"
            median = f"{per_cent(accuracy['median'])} % (median of the field)"
            facts.append(("p of a star", f"{median}, {share}"))
        others = {n: d["shown"]["title"] for n, d in documents.items() if "shown" in d and n != "summary"}
        facts += others.items()
        inner = Display("") if self.calibration is None else self.calibration.display()
        title = f"Run {self.folder}. {inner.title}".removesuffix(". ")
        return dataclasses.replace(inner, title=title, facts=(*facts, *inner.facts))
