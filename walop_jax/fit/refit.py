"""The joint fit of a calibration set: start values, the search for the minimum, gates, covariance."""

from __future__ import annotations

import dataclasses
import importlib
import time
from collections.abc import Iterator, Sequence
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float

from walop_jax.data.clipped import Clipped
from walop_jax.data.records import CalibrationSet
from walop_jax.fit.base_model import base_model
from walop_jax.fit.minimise import Minimum
from walop_jax.fit.parameter_table import Fitted, parameter_notes
from walop_jax.fit.robust import robust_errors
from walop_jax.fit.search import find_minimum, with_errors_fitted
from walop_jax.fit.verdict import (
    NO_STRUCTURE,
    STATED,
    SUSPECT_SIGMA,
    Doubt,
    Hidden,
    Quality,
    Structure,
    Verdict,
    excess,
    explains,
)
from walop_jax.io.display import Display
from walop_jax.io.progress import Stage, Tell
from walop_jax.io.shapes import Matrix, Vector
from walop_jax.io.text import in_its_unit
from walop_jax.likelihood.inverses import whitening
from walop_jax.likelihood.layout import curves_of
from walop_jax.likelihood.likelihood import Expansion, Likelihood
from walop_jax.likelihood.runner import Runner
from walop_jax.model.noise import NOISE
from walop_jax.model.planning import extrapolations
from walop_jax.model.specification import Model

NEARLY = 1.15  # χ²/dof that errors stated seven per cent too small give
TOO_LOW = 0.8  # χ²/dof below which the stated errors are those of something else
PRIOR_EDGE = 4.0  # standard deviations
EXCESS_NOISE = 0.5  # sigma
LAYOUTS = 5  # times that wavelength nodes are laid out anew for thicker retarders
ILL_CONDITIONED = 1e6  # for each intensity: eigenvalues of data grow with their number, not those of priors


class Alternatives(Protocol):
    """What a diagnosis leaves open about a fit (`diagnosis.class_product.Classes`)."""

    @property
    def several(self) -> bool:
        """True if other models explain the data as well; False if only undetected changes widen the errors."""
        ...

    def averaged(self, calibration: Any) -> Any:
        """The calibration of the fit as the mean over all models, with their spread in its covariance."""
        ...


@dataclasses.dataclass(frozen=True, repr=False)
class FitResult(Fitted):
    """A fit, the likelihood that it maximises, and the verdict on it.

    `values` (n) and `covariance` (n, n) are of all parameters in tree order, each in its unit; fixed parameters have no
    variance. `verdict` is None until the residuals are examined (`diagnosis.trust.examined`); to ask for `trusted`
    before that is an error. `errors_from` is the source of the covariance: the stated errors of the data (`STATED`) or
    the residuals. `hidden` are the errors that the data would not show, None until the residuals are examined.
    `alternatives` are the other models that a diagnosis could not tell apart from this one: the calibration of the fit
    is the mean over all of them. `clipped` are the rows that the fit left out as outliers, None if it was not asked to
    (`outliers.clipped`).

    >>> result.value("pupil.magnification")[0].__round__(2)
    15.67
    >>> table = result.to_table()
    """

    _working = ("of", "with_verdict", "with_remark", "with_doubt", "checked_verdict")

    likelihood: Likelihood
    values: Vector
    covariance: Matrix
    expansion: Expansion
    minimum: Minimum[Expansion]
    seconds: float
    errors_from: str = STATED
    verdict: Verdict | None = None
    hidden: Hidden | None = None
    alternatives: Alternatives | None = None
    clipped: Clipped | None = None

    def __post_init__(self) -> None:
        # Whatever asks the likelihood of a fit for its points gets the errors that were fitted.
        if self.likelihood.fits_errors:
            object.__setattr__(self, "likelihood", self.likelihood.with_errors_at(self.values))

    @classmethod
    def of(cls, likelihood: Likelihood, *, noise_scale: float | None = None) -> FitResult:
        """The fit of a likelihood, as `fit` makes it: its residuals are not examined, its errors are as stated.

        For fits that are compared: a `noise_scale` that is given multiplies the errors of the data.
        """
        return fit(likelihood, noise_scale=noise_scale)

    @property
    def model(self) -> Model:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The model that was fitted."""
        return self.likelihood.model

    @property
    def calset(self) -> CalibrationSet:
        """The calibration set that was fitted."""
        return self.likelihood.calset

    @property
    def n_data(self) -> int:
        """Number of intensities used."""
        return self.expansion.n_data

    @property
    def dof(self) -> int:
        """Degrees of freedom: data and priors less fluxes and free parameters."""
        return self.expansion.dof

    @property
    def chi2(self) -> float:
        """χ² of data and priors."""
        return self.expansion.chi2

    @property
    def excess(self) -> float:
        """How many standard deviations χ² lies above its expectation (`verdict.excess`)."""
        return excess(self.chi2, self.dof)

    @property
    def converged(self) -> bool:
        """True if the minimum was reached and is well conditioned."""
        return self.minimum.converged

    @property
    def noise_scale(self) -> float:
        """Factor on the errors of the data under which the minimum was sought; 1 unless the model is far off."""
        return self.expansion.noise_scale

    @property
    def explains_data(self) -> bool:
        """True if χ² is what noise alone would give."""
        return explains(self.chi2, self.dof)

    @property
    def nearly_explains_data(self) -> bool:
        """True if the excess of χ² is small enough for the stated errors alone to explain."""
        return self.dof > 0 and not self.explains_data and bool(self.chi2 < NEARLY * self.dof)

    @property
    def errors_too_large(self) -> bool:
        """True if χ² is far smaller than noise of the stated size would make it."""
        return bool(self.excess < -SUSPECT_SIGMA and self.chi2 < TOO_LOW * self.dof)

    @property
    def at_prior_edge(self) -> tuple[str, ...]:
        """Names of the parameters that lie more than `PRIOR_EDGE` prior widths from their prior."""
        return tuple(
            p.name
            for p, value in zip(self.model.parameters, self.values, strict=True)
            if p.free and p.prior is not None and abs(value - p.prior[0]) > PRIOR_EDGE * p.prior[1]
        )

    def with_verdict(
        self,
        doubts: Sequence[str] = (),
        *,
        noiseless: bool = False,
        structure: Structure = NO_STRUCTURE,
        remedies: Sequence[str] = (),
    ) -> FitResult:
        """The fit with the verdict on it; `doubts` are the sentences that its residuals hold against it.

        `noiseless` data are expected counts, those of a plan: they may scatter less than their errors. `structure` is
        what its field points differ by beyond the model. `remedies` are what would explain data that the model does
        not, the best first: sentences that take the place of the advice to look for missing effects.
        """
        verdict = Verdict(
            chi2=self.chi2,
            dof=self.dof,
            n_data=self.n_data,
            noise_scale=self.noise_scale,
            converged=self.converged,
            doubts=tuple(_doubts(self, doubts, examined=True, noiseless=noiseless, remedies=remedies)),
            errors_from=self.errors_from,
            structure=structure,
        )
        return dataclasses.replace(self, verdict=verdict)

    def with_remark(self, sentence: str) -> FitResult:
        """The fit with one more sentence in its verdict, which forbids nothing."""
        return self.with_doubt(Quality(0), sentence)

    def with_doubt(self, bit: Quality, sentence: str) -> FitResult:
        """The fit with one more doubt in its verdict; it forbids trust unless `bit` is 0."""
        verdict = self.checked_verdict()
        against = (*verdict.doubts, Doubt(bit, sentence, blocking=bool(bit)))
        return dataclasses.replace(self, verdict=dataclasses.replace(verdict, doubts=against))

    def checked_verdict(self) -> Verdict:
        """The verdict; raises RuntimeError for a fit without one."""
        if self.verdict is None:
            what = "the residuals of this fit are not examined yet: call walop_jax.diagnosis.trust.examined(fit), as"
            raise RuntimeError(f"{what} walop_jax.refit and walop_jax.diagnose do")
        return self.verdict

    @property
    def trusted(self) -> bool:
        """True if no doubt about the fit forbids its use (`Verdict.trusted`); RuntimeError without a verdict."""
        return self.checked_verdict().trusted

    @property
    def warnings(self) -> tuple[str, ...]:
        """The sentences of the verdict; of a fit that was not examined, those on χ², priors and convergence."""
        if self.verdict is not None:
            return self.verdict.warnings
        doubts = _doubts(self, (), examined=False, noiseless=False)
        return tuple(doubt.sentence for doubt in doubts if doubt.sentence)

    def residuals(self) -> Float[np.ndarray, "p e k"]:
        """(measured − model)/σ of every intensity (field point, exposure, camera), fluxes eliminated; 0 where unused.

        >>> result.residuals().shape
        (29, 14, 4)
        """
        return self.likelihood.residuals(self.values)[1]

    def value(self, name: str) -> tuple[float, float]:
        """Value and standard error of a parameter, in its unit."""
        return self[name][:2]

    def to_arviz(self, draws: int = 1000, seed: int = 0) -> Any:
        """The parameters that vary, for ArviZ: 4 chains of independent draws from values and covariance.

        Exact as far as the model is linear within the errors; `walop_jax.sample` draws from the posterior itself.
        """
        return importlib.import_module("walop_jax")._to_arviz(self, draws, seed)

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on parameters missing in its table, on unconstrained ones, and on errors that the data would not
        show.
        """
        notes = parameter_notes(self.model, self.sigma)
        if self.hidden is None or not len(self.hidden):
            return notes
        return (*notes, self.hidden.in_words())

    def display(self) -> Display:
        """The verdict and the parameters."""
        facts = {
            "χ²/dof": f"{self.chi2:.1f} / {self.dof} = {self.chi2 / max(self.dof, 1):.4g}, from {self.n_data} "
            f"intensities, {len(self.model.free)} free parameters",
            "effects": ", ".join(self.model.effect_names) or "none beyond the base model",
            "errors from": self.errors_from,
        }
        if self.clipped is not None:
            facts["outliers"] = str(self.clipped)
        shown = self.shown(f"Fit of {self.model.name}: not examined", facts, (*self.notes, *self.warnings))
        if self.verdict is None:
            return shown
        subject, known_by = (
            f"Fit of {self.model.name}",
            "walop.check(fit) works it out" if self.trusted else "",
        )
        return dataclasses.replace(self.verdict, subject=subject, stars=known_by).on_top_of(shown)


def covariance(model: Model, expansion: Expansion) -> Matrix:
    """Covariance of all parameters: the inverse of JᵀJ, priors included, ties expanded."""
    root = model.selection() @ whitening(expansion.matrix, 1e-15)
    return root @ root.T


def fit(
    likelihood: Likelihood,
    *,
    start: Vector | None = None,
    noise_scale: float | None = None,
    target_objective: float | None = None,
) -> FitResult:
    """Maximise a likelihood with its priors, from the start values of the model or `start` (a full vector).

    A model whose χ²/dof stays above `search.FAR_OFF` would be bent out of all physical shape: priors mean nothing
    beside such residuals. The errors of the data are then scaled until χ²/dof is 1, the minimum is sought again, from
    plates one order of retardance away as well, and the result says so (`noise_scale`, `warnings`). A `noise_scale`
    that is given is kept, with no other start, so that fits can be compared. `target_objective` is the objective of the
    fit with which this one is compared: a search that has not come below it when it should have converged is given up.
    The minimum of a large set (`Layout.large`) is sought on a sample of its points; a pass over all of them gives
    the step from there to its own, and another one shows that nothing is left to do.
    Raises ValueError when the exposures cannot determine the instrument.
    """
    began = time.perf_counter()
    first = likelihood.model.start if start is None else np.asarray(start, float)
    # Where errors of the data have parameters, the instrument is sought first, with errors held.
    likelihood = likelihood.with_errors_at(first)
    best = find_minimum(likelihood, first, noise_scale, target_objective)
    for _ in range(LAYOUTS):
        # Retarders that a fit has made thicker need more wavelengths than those that it began with.
        before, likelihood = likelihood, likelihood.following(best.x)
        if likelihood is before:
            break
        likelihood = likelihood.with_errors_at(first)
        best = find_minimum(likelihood, best.x, noise_scale, target_objective)
    if likelihood.model.template.noise is not None:
        best = with_errors_fitted(likelihood, best, first, noise_scale or 1.0)
    return fit_at(likelihood, best, time.perf_counter() - began)


def fit_at(likelihood: Likelihood, best: Minimum[Expansion], seconds: float) -> FitResult:
    """The fit of a likelihood whose minimum was found (its `x` a full vector) in so many seconds.

    Raises ValueError for a free parameter without a prior on which nothing in the data depends.
    """
    model = likelihood.model
    if idle := [model.parameters[i].name for i in model.free[np.diag(best.expansion.matrix) == 0.0]]:
        what = f"nothing in the data depends on {', '.join(idle)}, free and without a prior"
        them = "it" if len(idle) == 1 else "them"
        raise ValueError(f"{what}: fix {them} (free = false) or set a prior in the model file")
    return FitResult(
        likelihood=likelihood.with_errors_at(best.x),
        values=best.x,
        covariance=covariance(model, best.expansion),
        expansion=best.expansion,
        minimum=best,
        seconds=seconds,
    )


def with_empirical_covariance(result: FitResult) -> FitResult:
    """The fit with a covariance made from its residuals where it does not explain the data (`robust`).

    A fit that explains its data comes back as it is. Only the covariance changes; the verdict is to be made anew. It is
    for reported errors: model comparison keeps the stated ones.
    """
    if result.explains_data or result.errors_from != STATED or result.dof <= 0 or not result.converged:
        return result
    robust, made_from = robust_errors(result.likelihood, result.values, result.expansion)
    select = result.model.selection()
    errors = select @ robust @ select.T
    return dataclasses.replace(result, covariance=errors, errors_from=made_from, verdict=None)


def _doubts(
    result: FitResult,
    doubts: Sequence[str],
    *,
    examined: bool,
    noiseless: bool,
    remedies: Sequence[str] = (),
) -> Iterator[Doubt]:
    """All doubts about a fit, with remarks. The only place where bits and trust are decided.

    A χ² that is a few per cent too large while the residuals, once examined, show nothing but noise is put down to the
    stated errors.
    """
    yield from (Doubt(Quality.DOUBTED, sentence) for sentence in remedies)
    ratio = result.chi2 / max(result.dof, 1)
    excess = Quality.EXCESS_NOISE if ratio > 1.0 + EXCESS_NOISE**2 else Quality(0)
    if not result.converged:
        yield Doubt(Quality.NOT_CONVERGED, result.minimum.message)
    if result.minimum.condition > ILL_CONDITIONED * result.n_data:
        yield Doubt(Quality.ILL_CONDITIONED, "", blocking=False)
    if result.dof <= 0:
        what = f"{result.n_data} intensities for {len(result.model.free)} free parameters: nothing is left to test"
        yield Doubt(Quality.UNEXPLAINED | excess, what)
    elif examined and not doubts and result.nearly_explains_data:
        what = f"χ²/dof = {ratio:.4g} with nothing but noise in the residuals: the stated errors N_ERR are"
        yield Doubt(excess, f"{what} {100 * (np.sqrt(ratio) - 1):.2g} % too small", blocking=False)
    elif not result.explains_data:
        what = f"the model does not explain the data: χ²/dof = {ratio:.4g}, where 1 is expected"
        advice = "" if remedies else " (walop-jax diagnose looks for missing effects)"
        yield Doubt(Quality.UNEXPLAINED | excess, f"{what}; do not use this calibration{advice}")
    elif result.errors_too_large and not noiseless:
        what = f"χ²/dof = {ratio:.4g}: N_ERR is not the standard error of N"
        advice = "check the gain, and whether N_ERR holds variances or other units"
        yield Doubt(Quality.ERRORS_TOO_LARGE, f"{what}; {advice}")
    elif excess:
        yield Doubt(excess, "", blocking=False)  # so few degrees of freedom that noise alone may do it
    if result.noise_scale > 1.0:
        bit = Quality.EXCESS_NOISE if result.noise_scale**2 > 1.0 + EXCESS_NOISE**2 else Quality(0)
        text = f"to reach a solution the errors of the data were multiplied by {result.noise_scale:.3g}"
        yield Doubt(bit, f"{text}: the fit is poor", blocking=False)
    yield from (Doubt(Quality(0), sentence, blocking=False) for sentence in _of_errors(result))
    instrument = result.model.instrument(result.values).patched()
    for sentence in extrapolations(instrument, curves_of(result.calset)):
        yield Doubt(Quality(0), sentence, blocking=False)
    for name in result.at_prior_edge:
        p, value = result.model[name], result.value(name)[0]
        assert p.prior is not None
        pull = (value - p.prior[0]) / p.prior[1]
        text = f"{name} = {in_its_unit(f'{value:.6g}', p.unit)} lies {pull:+.1f} prior widths from {p.prior[0]:g}"
        yield Doubt(Quality.AT_PRIOR_EDGE, text)
    yield from (Doubt(Quality.DOUBTED, sentence) for sentence in doubts)
    if result.errors_from != STATED:
        reason = result.errors_from.removeprefix("residuals: ").replace("chi2/dof", "χ²/dof")
        for short, text in ((" states", " states of the exposures"), (" cells", " cells of the field")):
            reason = reason.replace(short, text)
        text = f"errors of parameters are estimated from the scatter of the residuals ({reason})"
        yield Doubt(Quality(0), text, blocking=False)


def _of_errors(result: FitResult) -> Iterator[str]:
    """A sentence with the values of the fitted terms of the errors of the data; none if no term was fitted."""
    fitted = [i for i in result.model.positions(NOISE).tolist() if result.sigma[i] > 0]
    if fitted:
        terms = ", ".join(f"{result.model.names[i]} = {result[result.model.names[i]]}" for i in fitted)
        yield f"the errors of the data were fitted, so that χ² tells nothing of them: {terms}"


def refit(
    calset: CalibrationSet,
    model: Model | None = None,
    *,
    progress: Tell | None = None,
) -> FitResult:
    """Fit a calibration set with `model` (default: the base model).

    `progress` is called with a line about each step. Errors are those of `with_empirical_covariance`. Raises what `fit`
    raises.
    """
    runner = Runner(progress=progress)
    likelihood = Likelihood.of(calset, model or base_model(calset), runner=runner)
    runner.tell(Stage("preparing the fit", "fitting"))
    return with_empirical_covariance(fit(likelihood))
