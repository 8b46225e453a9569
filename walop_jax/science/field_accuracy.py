"""Accuracy of the degree of polarisation over the field of a calibration, its limits, and errors that could hide.

Stars with p ≤ 5 % at any angle, without photon noise. An error δm of the instrument matrix makes
δ(q, u) = −M⁻¹ (δm₁ + δM (q, u)), hence its variance along the polarisation, averaged over the stars, is the error of p.
What limits it are the parameters without whose errors that variance would shrink most: with a group G of them known
exactly, covariance C becomes C − C_G C_GG⁻¹ C_Gᵀ.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import numpy as np
from jaxtyping import Bool, Float

from walop_jax.calibration.accuracy import (
    GOAL,
    LARGEST_P,
    NODES,
    SHARE,
    SIZE,
    TOLERANCE,
    field_measured,
    measures_u,
    p_errors,
    p_forms,
    reached,
    sample_stars,
)
from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.could_hide import CouldHide, could_hide, off_by, unmeasured
from walop_jax.data.inspection import Finding, inspect
from walop_jax.fit.refit import FitResult
from walop_jax.fit.verdict import NOT_MEASURED, Doubt, Quality, Verdict
from walop_jax.io.text import beside, per_cent, two_digits
from walop_jax.likelihood.inverses import whitening

COARSE = 8  # the same where the question is what limits it
FEW_STARS = 20
NEXT_HIDDEN = 2  # undetected errors, told beside the worst

GROUPS = {
    "throughput": "the relative throughput of the cameras",
    "collimator": "the diattenuation of the collimator",
    "standard": "the catalogue values of the standards",
    "sky": "the polarisation of the moonlit sky",
    "pupil": "the mapping from the field to the pupil",
    "half1": "the plates and the wedge of HWP1",
    "half2": "the plates and the wedge of HWP2",
    "chwp": "the plates of the calibration half-wave plate",
}
"""Parameters by the first part of their names, in words."""


@dataclasses.dataclass(frozen=True)
class FieldAccuracy:
    """Standard error of p (a fraction) over the field, from the calibration alone: rms over stars with p ≤ 5 %.

    `extent` is left, right, bottom and top in degrees. `limited_by` is what most of the error comes from. A systematic
    error that the data would not have shown, the worst of them `hidden_by`, can make q or u wrong by `hidden`, the
    median over the field (NaN: not computed), at its just undetected size, `hidden_worst` where it is largest; `remedy`
    is the measurement that would show it; `next_hidden` are those that follow. `not_measured` are the errors on which
    the data hold no information. `without_u` is the fraction of the field where a single exposure carries almost no
    information on u, `with_u` says where it does (None: everywhere). `goal` is what p of a star is wanted to: the
    calibration may make half of it.
    """

    error: Float[np.ndarray, "y x"]
    extent: tuple[float, float, float, float]
    filter: str
    limited_by: str = ""
    hidden: float = np.nan
    hidden_by: str = ""
    trusted: bool = True
    without_u: float = 0.0
    hidden_worst: float = np.nan
    remedy: str = ""
    not_measured: tuple[CouldHide, ...] = ()
    with_u: Bool[np.ndarray, "y x"] | None = None
    goal: float = GOAL
    next_hidden: tuple[CouldHide, ...] = ()

    @property
    def reached(self) -> float:
        """The error of p that the fraction `SHARE` stays below, of the field where one exposure measures u."""
        return reached(self.error if self.with_u is None else self.error[self.with_u])

    @property
    def field_measured(self) -> str:
        """The part of the field of which `reached` is the error, in words."""
        return field_measured(self.without_u)

    @property
    def share(self) -> float:
        """Fraction of the field in which the error is below the goal."""
        return float(np.mean(self.error < self.goal))

    @property
    def requirements(self) -> tuple[Requirement, ...]:
        """Requirements of the goal: all that acts on stars is measured, p is known, and no larger error could hide."""
        allowed = self.goal / 2
        what = f"effects of {two_digits(100 * allowed)} % on stars are measured"
        asked = []
        for name, gap in unmeasured(self.not_measured).items():
            size, _ = beside(100 * gap.error[0], 100 * allowed)
            found = f"{name} not measured, {off_by(*gap.error, shown=size)} at the usual size"
            asked.append(Requirement(what, gap.error[0] <= allowed, found, gap.remedy, off=gap.error[0]))
        light = two_digits((self.reached / allowed) ** 2)  # errors fall with its square root
        advice = f"{light} times the light; walop-jax plan RUN --goal {100 * allowed:.2g} gives the time that it takes"
        if self.without_u > 1.0 - SHARE and self.median <= allowed:
            strip = f"the strip without u ({100 * self.without_u:.0f} % of the field)"
            advice = f"observe {strip} with the plate at 22.5° as well"
        if not self.reached < LARGEST_P:  # not known, or as large as what is to be measured
            advice = "no single exposure measures both q and u: observe with the plate at 22.5° as well"
        asked.append(_p_known(self.reached, allowed, self.field_measured, advice, needed=False))
        if self.hidden > 0:
            what = f"no error above {two_digits(100 * self.goal)} % goes undetected: {self.hidden_by}"
            size, _ = beside(100 * self.hidden, 100 * self.goal)
            found = f"a systematic error of {size} % of q or u would go undetected"
            advice = self.remedy or "walop-jax limits lists the exposures that would show it"
            asked.append(
                Requirement(what, self.hidden <= self.goal, found, advice, needed=False, off=self.hidden)
            )
        return tuple(asked)

    @property
    def middle(self) -> Requirement:
        """The requirement of a go on p: that it is known in half of the field."""
        return known_in_half(self.median, self.goal, self.limited_by.split(" (")[0])

    @property
    def shortfalls(self) -> tuple[Requirement, ...]:
        """Everything that the calibration lacks for the goal; empty: it is good enough."""
        if not self.trusted:
            advice = "walop-jax diagnose looks for missing effects"
            return (Requirement("", False, "the calibration is not trusted", advice),)
        return tuple(need for need in self.requirements if not need.met)

    @property
    def median(self) -> float:
        """Median over the field of the error of p, a fraction."""
        return float(np.median(self.error))

    def document(self) -> dict[str, object]:
        """As plain data, `accuracy_of_p` of summary.json; shares, not per cent."""
        return {
            "median": self.median, "share_below_goal": self.share, "goal": self.goal, "filter": self.filter,
            "limited_by": self.limited_by, "hidden": self.hidden, "hidden_by": self.hidden_by,
            "hidden_worst": self.hidden_worst, "not_measured": [entry.name for entry in self.not_measured],
            "reached": self.reached, "good_enough": not self.shortfalls,
            "shortfalls": [{"what": lack.found, "advice": lack.advice} for lack in self.shortfalls],
        }  # fmt: skip

    def facts(self, *, complete: bool = True) -> tuple[tuple[str, str], ...]:
        """The answer in a few lines: accuracy, its limits, errors that could hide; of a `complete` model or not."""
        if not self.trusted:
            return (("p of a star", "not known: the calibration is not trusted"),)
        apart = " behind the telescope" if self.not_measured else ""
        if not all(each.ahead for each in self.not_measured):
            apart = " apart from quantities not measured"
        goal, lacks = f"{100 * self.goal:.3g} %", self.shortfalls
        median_error = f"{per_cent(self.median)} %{apart} (median error for p ≤ 5 %)"
        median_error += f"; below {goal} over {100 * self.share:.0f} % of the field"
        lines = [("p of a star", median_error if complete else f"{median_error}, if nothing were missing")]
        if complete:
            no = f"no, for {len(lacks)} reason{'s' if len(lacks) > 1 else ''} above"
            lines.append(
                (
                    f"good for {goal}",
                    no if lacks else f"yes: {per_cent(self.reached)} % in {self.field_measured}",
                )
            )
        if self.limited_by:
            lines.append(("limited by", self.limited_by))
        if self.not_measured:
            gaps = unmeasured(self.not_measured).items()
            lines.append(("not measured", "; ".join(f"{name}: {off_by(*lack.error)}" for name, lack in gaps)))
        if self.hidden > 0:
            lines += [("undetectable", off_by(self.hidden, self.hidden_worst)), ("caused by", self.hidden_by)]
        if self.hidden > 0 and self.remedy:
            lines.append(("remedy", self.remedy))
        return tuple(lines)

    @property
    def further_facts(self) -> tuple[tuple[str, str], ...]:
        """The errors that could hide beside the worst one, each with its effect on stars and what would show it."""
        lines = (
            f"{entry.in_words}: {off_by(*entry.error)}{f'; {entry.remedy}' if entry.remedy else ''}"
            for entry in self.next_hidden
        )
        return tuple(("could hide as well" if number == 0 else "", line) for number, line in enumerate(lines))


@dataclasses.dataclass(frozen=True)
class Requirement:
    """A requirement on a calibration: whether it is met, the result, advice if not; `needed`: a reason against a go.

    `off` is by how much q or u of stars are wrong or uncertain where it is not met, as a fraction (None: not known).
    """

    what: str
    met: bool
    found: str
    advice: str = ""
    needed: bool = True
    off: float | None = None

    @property
    def doubt(self) -> Doubt:
        """The doubt that it is if it is not met."""
        return Doubt(Quality(0), self.found, blocking=self.needed, off=self.off, remedy=self.advice)


def _p_known(error: float, allowed: float, where: str, advice: str, *, needed: bool = True) -> Requirement:
    size, limit = beside(100 * error, 100 * allowed)
    found = f"{size} % in {where}, {limit} % allowed"
    # An error that is NaN is not known.
    off = error if np.isfinite(error) else None
    return Requirement(f"p known to {limit} % in {where}", error <= allowed, found, advice, needed, off)


def known_in_half(error: float, goal: float = GOAL, cause: str = "") -> Requirement:
    """The requirement of a go on p; `error` is the median over the field, `cause` what most of it comes from."""
    allowed = goal / 2
    light = two_digits((error / allowed) ** 2)  # errors fall with its square root
    source = f" (most of the error comes from {cause})" if cause else ""
    advice = f"{light} times the light{source}, over several nights: walop-jax stack, walop-jax plan"
    if not error < LARGEST_P:  # not known, or as large as what is to be measured: light alone does not help
        advice = (
            "observe with the calibration plate at 22.5° as well: elsewhere one exposure does not measure u"
        )
    return _p_known(error, allowed, "50 % of the field", advice)


def accuracy_of_fit(result: FitResult, goal: float = GOAL) -> FieldAccuracy | None:
    """How well stars are known with the calibration of a fit; None for a fit that did not converge.

    None as well for an instrument that is not one of two arms (`field_accuracy`).
    """
    return field_accuracy(Calibration.from_fit(result), goal=goal) if result.converged else None


def for_stars(
    verdict: Verdict,
    accuracy: FieldAccuracy | None,
    findings: Iterable[Finding] = (),
    *,
    complete: bool = True,
) -> Verdict:
    """The verdict on a calibration for stars: the verdict on its fit, with what it lacks for their accuracy.

    `accuracy` is the accuracy of p over the field (None: not asked), `findings` are the findings of `inspect` about its
    data. The accuracy of a fit that is not trusted, or not `complete`, is not known, and no reason for anything; nor
    are notes.
    """
    doubts = [
        Doubt(Quality(0), finding.what, blocking=finding.severity == "fault", remedy=finding.advice)
        for finding in findings
        if finding.severity != "note"
    ]
    if accuracy is None:
        return verdict.with_doubts(doubts)
    if verdict.trusted and complete:
        needs = (accuracy.middle, *accuracy.requirements)
        doubts = [*(need.doubt for need in needs if not need.met), *doubts]
    if verdict.trusted and accuracy.not_measured:  # said with its size
        said = NOT_MEASURED.partition("{")[0]
        kept = tuple(doubt for doubt in verdict.doubts if not doubt.sentence.startswith(said))
        verdict = dataclasses.replace(verdict, doubts=kept)
    return verdict.with_doubts(doubts, stars=dict(accuracy.facts(complete=complete))["p of a star"])


def verdict_of_fit(result: FitResult, accuracy: FieldAccuracy | None, *, complete: bool = True) -> Verdict:
    """The verdict on a fit for stars, with what `inspect` finds in its data; `accuracy` is that of its calibration."""
    of_fit = dataclasses.replace(result.checked_verdict(), subject=f"Fit of {result.model.name}")
    findings = inspect(result.calset).findings if result.converged else ()
    return for_stars(of_fit, accuracy, findings, complete=complete)


def field_accuracy(calibration: Calibration, size: int = SIZE, goal: float = GOAL) -> FieldAccuracy | None:
    """The map for an instrument with two arms, in the usual settings; None for others: they need several exposures."""
    if len(calibration.model.template.cameras.pairs) != 2:
        return None
    settings = calibration.usual_settings(filter_name=calibration.usual_filter)
    x, y = np.concatenate([calibration.raster(size), calibration.raster(COARSE)], axis=1)
    matrix, covariance, slopes = calibration.over_field(x, y, settings, NODES, TOLERANCE)
    error = p_errors(matrix[: size**2], covariance[: size**2]).reshape(size, size)
    with_u = measures_u(matrix[: size**2].reshape(-1, 2, 3)).reshape(size, size)
    undetected = could_hide(calibration)
    worst = undetected[0] if undetected else None
    nothing = np.nan if calibration.hidden is None else 0.0
    return FieldAccuracy(
        error,
        calibration.field,
        calibration.usual_filter,
        limited_by=_limited_by(calibration, matrix[size**2 :], slopes[size**2 :]),
        hidden=nothing if worst is None else worst.error[0],
        hidden_by="" if worst is None else worst.in_words,
        hidden_worst=nothing if worst is None else worst.error[1],
        remedy="" if worst is None else worst.remedy,
        not_measured=tuple(each for each in undetected if not each.measured),
        trusted=calibration.verdict.trusted,
        without_u=float(np.mean(~with_u)),
        with_u=with_u,
        goal=goal,
        next_hidden=undetected[1 : 1 + NEXT_HIDDEN],
    )


def _limited_by(
    calibration: Calibration, matrix: Float[np.ndarray, "p 6"], slopes: Float[np.ndarray, "p 6 n"]
) -> str:
    """The group of parameters with most of the variance of p, in the median of the field, in words."""
    form = p_forms(matrix, sample_stars(FEW_STARS)) @ slopes
    covariance = calibration.covariance
    projected = form @ covariance
    total = np.mean(np.sum(projected * form, axis=-1), axis=1)
    owners = np.array([str(name).split(".")[0] for name in calibration.model.names])
    shares = {}
    for owner in dict.fromkeys(owners.tolist()):
        group = np.flatnonzero((owners == owner) & (np.diag(covariance) > 0))
        if group.size:
            root = whitening(covariance[np.ix_(group, group)], 1e-15)
            gone = np.mean(np.sum((projected[..., group] @ root) ** 2, axis=-1), axis=1)
            shares[owner] = float(np.nanmedian(gone / total))
    largest = max(shares, key=lambda owner: shares[owner], default="")
    if not largest:
        return ""
    share = f"{100 * min(shares[largest], 1.0):.0f} % of the variance"
    return f"{GROUPS.get(largest, f'the parameters {largest}.*')} ({share})"
