"""Findings of a diagnosis: values, descriptions, locations, and the content of `diagnosis.json` (docs: files)."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int

from walop_jax.calibration.calibration import Calibration
from walop_jax.data.records import Exposures
from walop_jax.diagnosis import thresholds
from walop_jax.diagnosis.class_product import OpenQuestion, Questions
from walop_jax.diagnosis.design import Design, positions_of
from walop_jax.diagnosis.reasons import why
from walop_jax.fit.refit import FitResult
from walop_jax.fit.verdict import Doubt, Quality, Verdict
from walop_jax.io.display import Display, Drawn
from walop_jax.io.plain_tables import astropy_table
from walop_jax.io.shapes import ResidualCube
from walop_jax.io.text import per_cent, plain, probability, some, value_and_error, with_error
from walop_jax.model import legendre
from walop_jax.model.effects import Described
from walop_jax.model.effects.change import Change

HARMONICS = (0, 1, 2, 3, 4)
FIELD_WORDS = ("uniform", "gradient", "quadratic", "cubic", "fourth order")
DIFFERENT = 0.1  # of the total: smaller differences are ignored
FEWEST_FREE = 4  # degrees of freedom of the exposures beyond their settings, for a trend to be determined
SHARE = 0.2  # a group is mentioned when it carries this share of the largest


def _named(groups: dict[str, float]) -> str:
    total, largest = sum(groups.values()) or 1.0, max(groups.values(), default=0.0)
    order = sorted(groups.items(), key=lambda group: -group[1])
    shares = ((name, round(value / total, 3)) for name, value in order)
    least = SHARE * round(largest / total, 3)
    return ", ".join(f"{name} {100 * share:.0f}%" for name, share in shares if share >= least)


def _harmonics(
    design: Design, pattern: Float[np.ndarray, "p e k"]
) -> tuple[dict[str, float], Float[np.ndarray, " p"]]:
    """Power of each harmonic of the polariser angle, and the field map of the strongest one."""
    e = design.fit.calset.exposures
    use = np.flatnonzero(e.clp_in & design.measured.used.any(axis=0))
    if len(use) < 3:
        return {}, pattern.sum(axis=(1, 2))
    angle = np.deg2rad(e.clp_angle[use])
    power: dict[str, float] = {}
    best, field = -1.0, pattern[:, use].sum(axis=(1, 2))
    for harmonic in HARMONICS:
        waves = [np.cos(harmonic * angle), np.sin(harmonic * angle)][: 2 if harmonic else 1]
        unit = [wave / (float(np.linalg.norm(wave)) or 1.0) for wave in waves]
        amplitudes = [np.einsum("pek,e->pk", pattern[:, use], wave) for wave in unit]
        square = float(sum((a**2).sum() for a in amplitudes))
        power[f"{harmonic}θ"] = square
        if square > best:
            strongest = max(amplitudes, key=lambda a: float((a**2).sum()))
            best, field = square, strongest[:, int((strongest**2).sum(axis=0).argmax())]
    return power, field


def _field_words(design: Design, field: Float[np.ndarray, " p"]) -> str:
    points = design.fit.calset.points
    basis = legendre.basis(points.x, points.y, 4, design.fit.model.template.units.field)
    degree = np.array([i + j for i, j in legendre.terms(4)])
    if len(field) <= len(degree):
        return "too few points to decide"
    total = float(field @ field) or 1.0
    explained, words = 0.0, {}
    for d in range(5):
        columns = basis[:, degree <= d]
        fitted = columns @ np.linalg.lstsq(columns, field, rcond=None)[0]
        share = float(fitted @ fitted) / total
        words[FIELD_WORDS[d]] = max(share - explained, 0.0)
        explained = max(share, explained)
    words["fine structure"] = max(1.0 - explained, 0.0)
    return _named(words)


def describe(design: Design, rows: Float[np.ndarray, " _"]) -> dict[str, Any]:
    """Place of a change of the residuals (data rows of `design`), as `where` of diagnosis.json (docs: files).

    None where its shares equal those of a uniform change of all rows: these reflect the plan, not the change.
    """
    cube = design.cube(rows)
    square = cube**2
    e, names = design.fit.calset.exposures, design.fit.model.template.cameras.names
    by_exposure, point_counts = square.sum(axis=(0, 2)), design.measured.used.sum(axis=0)

    def grouped(labels: np.ndarray) -> str | None:
        sums = by_exposure, point_counts
        return _differing(*({str(n): float(of[labels == n].sum()) for n in np.unique(labels)} for of in sums))

    stood = {prefix: positions_of(e, prefix) for prefix in design.measured.likelihood.plan.moving}
    harmonics, field = _harmonics(design, cube)
    labels = [e.kind, e.filter, *(at.astype(str) for at in stood.values())]
    settings = np.unique(labels, axis=1, return_inverse=True)[1]
    trend = _trend(e, settings.ravel(), np.sqrt(by_exposure / np.maximum(len(names) * point_counts, 1)))
    cameras = dict(zip(names, square.sum(axis=(0, 1)).tolist(), strict=True))
    return {
        "camera": _differing(cameras, dict.fromkeys(names, 1.0)),
        "field": _field_words(design, field),
        "clp_harmonic": _differing(harmonics, {name: 1.0 if name == "0θ" else 2.0 for name in harmonics}),
        "wavelength": grouped(e.filter),
        "kind": grouped(e.kind),
        "time": "grows with time" if trend > 0.7 else "shrinks with time" if trend < -0.7 else None,
    } | {prefix: grouped(at) for prefix, at in stood.items() if len(np.unique(at)) > 1}


def _differing(groups: dict[str, float], plan: dict[str, float]) -> str | None:
    """Shares of groups in words where a tenth of the whole lies elsewhere than in the plan."""
    total, plan_total = sum(groups.values()) or 1.0, sum(plan.values()) or 1.0
    moved = 0.5 * sum(abs(groups[name] / total - plan[name] / plan_total) for name in groups)
    return _named(groups) if moved > DIFFERENT else None


def _trend(e: Exposures, settings: Int[np.ndarray, " e"], rms: Float[np.ndarray, " e"]) -> float:
    """Correlation of the rms of exposures with their order in time, among those that a plan has alike.

    Both are projected off kind, setting and angle of the polariser (first and second harmonic of 2θ): a plan
    goes through these in order, so that they are degenerate with time.
    """
    alike = [settings == number for number in np.unique(settings)]
    through = e.clp_in & np.isfinite(e.clp_angle)
    angle = np.deg2rad(np.where(through, e.clp_angle, 0.0))
    waves = [np.where(through, wave(n * angle), 0.0) for n in (2, 4) for wave in (np.cos, np.sin)]
    columns = np.stack([*alike, *waves], axis=1).astype(float)
    base = np.linalg.svd(columns, full_matrices=False)
    base = base[0][:, base[1] > 1e-9 * base[1][0]]
    order = np.argsort(np.argsort(e.mjd)).astype(float)
    residuals = [column - base @ (base.T @ column) for column in (order, rms)]
    size = [float(np.linalg.norm(column)) for column in residuals]
    free = len(e) - base.shape[1]
    if free < FEWEST_FREE or size[0] < 1e-9 * len(e) or size[1] < DIFFERENT * float(np.linalg.norm(rms)):
        return 0.0
    return float(residuals[0] @ residuals[1]) / (size[0] * size[1])


DiagnosisVerdict = Literal["consistent", "effect_found", "wrong_number", "unexplained"]


@dataclasses.dataclass(frozen=True)
class FitComparison:
    """Fits without and with an addition: χ², data left out of a fit, and what it changes.

    `change_of_qu` is the largest change that adding it makes to calibrated q or u of a star with p ≤ 5 % at any field
    point. `residual_before` and `residual_after` are the residuals (data − model, in standard deviations as given;
    point, exposure, camera) at the time it was added; where another name has been dropped since, they and χ² are of
    fits without that name. `heldout_gain` is the gain in ln p of the data left out where their mean square became
    larger (NaN: it did not).
    """

    chi2_before: float = float("nan")
    chi2_after: float = float("nan")
    dof_after: int = 0
    heldout_scheme: str = ""
    heldout_before: float = float("nan")
    heldout_after: float = float("nan")
    heldout_gain: float = float("nan")
    change_of_qu: float = float("nan")
    residual_before: ResidualCube = dataclasses.field(default_factory=lambda: np.zeros((0, 0, 4)))
    residual_after: ResidualCube = dataclasses.field(default_factory=lambda: np.zeros((0, 0, 4)))

    @property
    def confirmed(self) -> bool:
        """True if held-out data agree better with the addition than without, or are more probable with it.

        A smooth field knows little of parts of the field that were left out, and knows that it does.
        """
        return self.heldout_after < self.heldout_before or self.heldout_gain > 0.0

    @property
    def negligible(self) -> bool:
        """True if it is negligible for calibrated q and u."""
        return self.change_of_qu < thresholds.NEGLIGIBLE


@dataclasses.dataclass(frozen=True, kw_only=True)
class Step(FitComparison):
    """One identified, added and confirmed effect; `parameters` hold (value, sigma, unit).

    `score` and `p_value` (corrected for all that was tried) are of the linear test, `log_bayes` of the refit.
    `far` are amplitudes that lie beyond what their prior allows, in its widths: the data have refuted that prior.
    `robust_ratio` are the errors of its parameters when every exposure may have a disturbance of its own, over the
    errors stated. `choices` are discrete (which camera, which star), `alternatives` other shapes of the same effect
    that explain the data as well. `equivalent` are the effects indistinguishable from it in this data set, `separation`
    is the distance (σ) of each rival from it. `descriptions` are those of an effect without a name
    (`described`) with amplitude and error, `nameless` descriptions that it may be instead.
    `also_called` are other names of it and of those, by name (`synonyms`). `about` is the effect in words with its
    place, `probability` that of its name among all names of the list, given that one of them is true (NaN: unknown).
    """

    effect: str
    parameters: dict[str, tuple[float, float, str]]
    score: float
    p_value: float
    log_bayes: float
    robust_ratio: float = float("nan")
    far: dict[str, float] = dataclasses.field(default_factory=dict)
    choices: dict[str, Any] = dataclasses.field(default_factory=dict)
    alternatives: tuple[str, ...] = ()
    equivalent: tuple[str, ...] = ()
    separation: dict[str, float] = dataclasses.field(default_factory=dict)
    separated_by: str = ""
    where: dict[str, Any] = dataclasses.field(default_factory=dict)
    descriptions: tuple[tuple[Change, float, float], ...] = ()
    nameless: tuple[str, ...] = ()
    also_called: Mapping[str, tuple[str, ...]] = dataclasses.field(default_factory=dict)
    about: str = ""
    probability: float = float("nan")

    def __repr__(self) -> str:
        """What it says, in one line: its residuals are arrays of the size of the data."""
        return f"Step({self.in_words}; χ² {self.chi2_before:.4g} → {self.chi2_after:.4g})"

    @property
    def shown(self) -> dict[str, tuple[float, float, str]]:
        """The parameters for a reader: a smooth field has one row, its rms over the field, and not its terms."""
        terms = {change.label for change, *_ in self.descriptions if change.candidate != change.text}
        single = {name: entry for name, entry in self.parameters.items() if name not in terms}
        smooth = [entry for entry in _said(self.descriptions) if "terms" in entry]
        return single | {
            entry["sentence"]: (entry["value"], entry["sigma"], entry["unit"]) for entry in smooth
        }

    @property
    def in_words(self) -> str:
        """What is missing, where, how large it is and how probable its name.

        For example "a dark spot in front of one camera, O2: depth 0.0060 ± 0.0005, x 0.11 ± 0.01 deg (blemish,
        probability 0.97)". What has no name is told by its descriptions, or by the change of the instrument.
        """
        likely = "above 0.99" if self.probability > 0.99 else f"{self.probability:.2g}"
        known = [f"probability {likely}"] if math.isfinite(self.probability) else []
        if self.descriptions:
            words = " and ".join(entry["words"] for entry in _said(self.descriptions))
            return f"{words} ({known[0]})" if known else words
        if change := self.choices.get("change", ""):
            return f"{change} ({self.effect})"
        sizes = {
            name: f"{with_error(value, sigma)} {unit}".rstrip()
            for name, (value, sigma, unit) in self.parameters.items()
        }
        told = sizes.values() if len(sizes) == 1 else (f"{name} {size}" for name, size in sizes.items())
        what = f"{self.about or self.effect}: {', '.join(told)}" if sizes else self.about or self.effect
        return f"{what} ({', '.join([self.effect, *known])})"


@dataclasses.dataclass(frozen=True)
class Unexplained:
    """Remainder that has no name; `free_form` are the blocks of the free-form term that was added for it.

    `chi2_before` and `chi2_after` are without and with that term, `change_of_qu` is what it changes in calibrated q
    and u of a star with p ≤ 5 %. `parts` are names that were taken out again because they explain a part only, with
    what they leave. `number` is the number that the set states which, if it is wrong, is the explanation: it leaves
    nothing but noise.
    """

    p_value: float
    description: str
    patterns: tuple[tuple[str, float], ...]
    free_form: tuple[str, ...] = ()
    chi2_before: float = float("nan")
    chi2_after: float = float("nan")
    change_of_qu: float = float("nan")
    parts: tuple[str, ...] = ()
    number: str = ""


@dataclasses.dataclass(frozen=True)
class Choice:
    """A trial change of the description.

    `left` is the ratio of squared residuals after one linear step, with the change and without it,
    and `better_by` the gain in χ², data and priors, when all is fitted (NaN: not fitted).
    """

    change: str
    left: float
    better_by: float = float("nan")

    @property
    def gains(self) -> bool:
        """True if residuals are smaller with the change, by the linear step or by the fit."""
        return self.left < 1.0 or self.better_by > 0.0


@dataclasses.dataclass(frozen=True, repr=False)
class Diagnosis(Drawn):
    """Effects that a model lacks, according to one calibration set.

    `candidates` are (effect, score, corrected p) in the first examination; `before` is the fit of the model given,
    `after` that of the extended one; `remaining_p` is the global p of the final residuals. `choices` are other
    descriptions of the instrument that were tried, the best first; none where nothing, or only a name, was missing.
    `noise_scale` is the scatter of what no candidate explains over what N_ERR says, `noise_p` the chance that noise of
    the stated size scatters as much. `classes` are significant effects of the first examination with those that
    these data cannot tell from them, `limits` what effects that were not found stay below: rows of `diagnosis.json`.
    `members` are the classes of what was added, with what their members do to stars, `rounds` all that was tried or
    ranked, with the reason for which it was not added, `not_scored` what was not, and why. `descriptions` counts those
    that were scored.
    """

    _first_figure = "ladder"

    verdict: DiagnosisVerdict
    steps: tuple[Step, ...]
    candidates: tuple[tuple[str, float, float], ...]
    limits: tuple[Mapping[str, Any], ...]
    untestable: tuple[str, ...]
    unexplained: Unexplained | None
    p_value: float
    remaining_p: float
    before: FitResult
    after: FitResult
    seconds: float
    points: int
    noise_scale: float = float("nan")
    noise_p: float = float("nan")
    choices: tuple[Choice, ...] = ()
    classes: tuple[Mapping[str, Any], ...] = ()
    ended: str = ""
    members: Questions = dataclasses.field(default_factory=Questions)
    rounds: tuple[Any, ...] = ()
    not_scored: Mapping[str, str] = dataclasses.field(default_factory=dict)
    descriptions: int = 0

    @property
    def complete(self) -> bool:
        """True if nothing is left that the model found does not explain."""
        return self.verdict in ("consistent", "effect_found")

    @property
    def subject(self) -> str:
        """What its first line is about."""
        return f"Diagnosis ({self.verdict.replace('_', ' ')})"

    def why(self, name: str) -> str:
        """Reasons for which an effect, a description or a change of the instrument was not named, with numbers.

        ValueError, with the nearest names, for what is none of them.
        """
        return why(document(self), name)

    def calibration(self) -> Calibration:
        """The calibration of the extended model: mean over indistinguishable models, with their spread."""
        return Calibration.from_fit(self.after)

    @property
    def caution(self) -> str:
        """Caution about these findings; empty when there is none."""
        cautions = []
        if self.ended:
            cautions.append(
                f"the search ended after {self.ended} with this model, the best so far: allow more minutes, if it was "
                "you who set them, or start from it as --model"
            )
        looked_at = len(self.after.calset.points)
        if looked_at < self.points:
            what = f"{looked_at} of {self.points} field points were looked at"
            if self.after.calset.fine is not None:
                what = f"{looked_at} field points, joined from {self.points} cells, were looked at"
            cautions.append(f"{what}, and fitted: refit all of them with the model found")
        if len(self.steps) > thresholds.MOST_SENTENCES:
            cautions.append(
                f"{len(self.steps)} names were needed: something that is not in the catalogue can look like several "
                "that are"
            )
        widened = ((s.effect, name, widths) for s in self.steps for name, widths in s.far.items())
        if far := ", ".join(f"{effect}.{name} ({widths:.0f} widths)" for effect, name, widths in widened):
            cautions.append(f"far beyond its prior, which was widened: {far}")
        ratio = thresholds.LARGEST_ROBUST_RATIO
        if weak := ", ".join(s.effect for s in self.steps if s.robust_ratio > ratio):
            cautions.append(
                f"errors of {weak} are too small by more than a factor {ratio:g} if single exposures have disturbances "
                "of their own"
            )
        return "; ".join(cautions)

    def to_table(self) -> Any:
        """The parameters of all identified effects, as an astropy table."""
        rows = [(s, name, *entry) for s in self.steps for name, entry in s.parameters.items()]
        return astropy_table(
            {
                "EFFECT": (np.array([s.effect for s, *_ in rows], "U32"), "", "effect"),
                "PARAMETER": (np.array([name for _, name, *_ in rows], "U96"), "", "its parameter"),
                "VALUE": (np.array([v for _, _, v, _, _ in rows], float), "", "fitted value"),
                "SIGMA": (np.array([s for _, _, _, s, _ in rows], float), "", "standard error"),
                "UNIT": (np.array([u for *_, u in rows], "U16"), "", "unit of the numbers of this row"),
                "P_VALUE": (np.array([s.p_value for s, *_ in rows], float), "", "corrected for all tried"),
            },
            {"VERDICT": self.verdict},
        )

    def display(self) -> Display:
        """The verdict and the findings."""
        rows = []
        for step in self.steps:
            entries: dict[str, Any] = {name: (value, 0.0, "") for name, value in step.choices.items()}
            for name, (value, sigma, unit) in (entries | step.shown).items():
                texts = value_and_error(value, sigma)
                if name == "camera" and name in step.choices:
                    texts = (str(self.after.model.template.cameras.names[int(value)]), "")
                rows.append((step.effect, name, *texts, unit, probability(step.p_value).removeprefix("= ")))
        before, after = (fit.chi2 / max(fit.dof, 1) for fit in (self.before, self.after))
        found = [step.in_words for step in self.steps]
        if self.unexplained is not None:
            found.append(self.unexplained.number or "something without a name")
        first, *further = found or ["nothing beyond the starting model"]
        shown = Display(
            title=f"{self.subject}: not examined",
            facts=(
                ("found", first),
                *(("", f"and {text}") for text in further),
                ("χ²/dof", f"{before:.4g} → {after:.4g}"),
                ("p of the starting model", probability(self.p_value).removeprefix("= ")),
                ("field points", str(self.points)),
            ),
            head=("effect", "parameter", ">value", ">error", "unit", ">p"),
            rows=tuple(rows),
            notes=tuple(sentences(document(self))),
        )
        if self.after.verdict is None:
            return shown
        verdict = of_diagnosis(self.after.verdict, self.unexplained, self.subject, complete=self.complete)
        return verdict.on_top_of(shown)


def of_diagnosis(fit: Verdict, left: Unexplained | None, subject: str, *, complete: bool) -> Verdict:
    """The verdict on a diagnosis, given that on its fit and what is left over."""
    if complete:
        return fit.with_doubts((), subject=subject)
    fit = dataclasses.replace(fit, doubts=tuple(map(_without_advice_to_diagnose, fit.doubts)))
    what = "something without a name is missing from the model" if left is None else left.description
    off, cure = None, f"{_SHOWS_WHERE}; describe its cause with --effects, and diagnose again"
    if left is not None and left.number:
        what, cure = f"{left.number} is wrong", "correct the number that the set states, and fit again"
    elif left is not None and math.isfinite(left.change_of_qu):
        off = left.change_of_qu
    return fit.with_doubts([Doubt(Quality(0), what, off=off, remedy=cure)], subject=subject)


_SHOWS_WHERE = "walop-jax report shows where it is"


def _without_advice_to_diagnose(doubt: Doubt) -> Doubt:
    """A doubt about the fit of a diagnosis, without the advice to make a diagnosis: this is one."""
    if not re.search(_ADVICE, f"{doubt.sentence} {doubt.cure}"):
        return doubt
    return dataclasses.replace(doubt, sentence=re.sub(_ADVICE, "", doubt.sentence), remedy=_SHOWS_WHERE)


_ADVICE = r"(: | \(|; | )walop-jax diagnose looks for [a-z ]+\)?$"


def descriptions_of(result: FitResult) -> tuple[tuple[Change, float, float], ...]:
    """The descriptions of a fitted model, each with its amplitude and standard error."""
    if Described.name not in result.model.effect_names:
        return ()
    effect = result.model.instrument(result.values).effect(Described.name)
    assert isinstance(effect, Described)
    index, units = result.model.index, result.model.template.units
    sigma = (float(result.sigma[index(f"{Described.name}.{change.label}")]) for change, _ in effect.terms())
    return tuple(
        (change.counted_in(units), float(amplitude), error)
        for (change, amplitude), error in zip(effect.terms(), sigma, strict=True)
    )


def _said(descriptions: Sequence[tuple[Change, float, float]]) -> Iterator[dict[str, Any]]:
    """An entry of diagnosis.json for each description; the terms of a smooth field have one together."""
    together: dict[str, list[tuple[Change, float, float]]] = {}
    for change, amplitude, sigma in descriptions:
        together.setdefault(change.candidate, []).append((change, amplitude, sigma))
    for name, terms in together.items():
        first = terms[0][0]
        yield _described(*terms[0]) if name == first.text else _smooth(name, terms)


def _smooth(name: str, terms: Sequence[tuple[Change, float, float]]) -> dict[str, Any]:
    """The entry of a smooth field: `value` is its root mean square over a square field of the scale of the instrument.

    The terms are products of Legendre polynomials, so that their mean squares add. `sigma` leaves out correlations of
    their amplitudes.
    """
    sizes = np.array([(size * change.smooth_rms, error * change.smooth_rms) for change, size, error in terms])
    value = float(np.sqrt(np.sum(sizes[:, 0] ** 2)))
    sigma = (
        float(np.sqrt(np.sum((sizes[:, 0] * sizes[:, 1]) ** 2))) / value
        if value
        else float(sizes[:, 1].max())
    )
    first = terms[0][0]
    law = dataclasses.replace(first, factors=first.beside_field)
    entry = _described(law, value, sigma)
    dependence = ["in a smooth field", *entry["dependence"]]
    kind, size = entry["words"].split(", ")[0].split(": ")
    words = f"{kind}: {size} rms, {', '.join(dependence)}"
    further = {change.text: {"value": size, "sigma": error} for change, size, error in terms}
    return entry | {
        "sentence": name, "dependence": dependence, "words": words, "tested_by": first.tested_by, "terms": further,
    }  # fmt: skip


def _described(change: Change, amplitude: float, sigma: float) -> dict[str, Any]:
    unit = Described.numbers()[change.parameter].unit
    value, error = value_and_error(amplitude, sigma)
    kind, *dependence = change.in_words().split(", ")
    return {
        "sentence": change.text,
        "kind": change.kind,
        "place": f"{change.relation} {change.place}",
        "dependence": dependence,
        "value": amplitude,
        "sigma": sigma,
        "unit": unit,
        "words": f"{kind}: {value} ± {error}{' ' if unit else ''}{unit}{''.join(f', {d}' for d in dependence)}",
        "tested_by": change.tested_by,
    }


_AS_THEY_ARE = (
    "effect", "score", "p_value", "chi2_before", "chi2_after", "heldout_before", "heldout_after", "heldout_scheme",
    "heldout_gain", "alternatives", "equivalent", "nameless", "also_called", "separated_by", "where", "confirmed",
    "log_bayes", "negligible", "probability",
)  # fmt: skip


def _step(step: Step) -> dict[str, Any]:
    entries = {name: (value, 0.0, "") for name, value in step.choices.items()} | step.parameters
    near = sorted(step.separation.items(), key=lambda s: s[1])
    return {name: getattr(step, name) for name in _AS_THEY_ARE} | {
        "parameters": {n: {"value": v, "sigma": s, "unit": unit} for n, (v, s, unit) in entries.items()},
        "sentences": list(_said(step.descriptions)),
        "change_of_qu": step.change_of_qu,
        "robust_error_ratio": step.robust_ratio,
        "separation_sigma": {name: value for name, value in near if math.isfinite(value)},
    }


def sentences(content: Mapping[str, Any]) -> Iterator[str]:
    """Sentences beside the numbers of a diagnosis, from the content of diagnosis.json: the same in `print`, the command
    and the page."""
    for step in content["steps"]:
        yield from _of_step(step)
    remainder = content.get("unexplained")
    if remainder:
        yield remainder["description"]
        if remainder.get("free_form"):
            yield (
                f"added as a free-form term ({', '.join(remainder['free_form'])}): χ² {remainder['chi2_before']:.1f} → "
                f"{remainder['chi2_after']:.1f}"
            )
    choices = content.get("choices", ())
    fitted = [choice for choice in choices if choice["better_by"] is not None]
    if choices:
        yield f"{len(choices)} other descriptions of the instrument were compared, {len(fitted)} of them fitted"
    for choice in fitted:
        sense = "smaller" if choice["better_by"] > 0 else "larger"
        yield f"{choice['change']}: χ² {sense} by {abs(choice['better_by']):.4g}"
    for alike in content.get("classes", ())[: thresholds.SHOWN]:
        yield (
            f"before anything was added {alike['effect']} was significant too; these data cannot distinguish it from "
            f"{some(alike['equivalent'], thresholds.SHOWN)}; what would: {alike['separated_by']}"
        )
    if content.get("cannot_be_tested"):
        yield f"not tested, since these data cannot show it: {', '.join(content['cannot_be_tested'])}"
    if content.get("caution"):
        yield content["caution"]


def _of_step(step: Mapping[str, Any]) -> Iterator[str]:
    """The sentences about one identified effect."""
    name = step["effect"]
    for sentence in step.get("sentences", ()):
        yield f"{sentence['words']}: {sentence['tested_by']}"
    for alternative in step.get("alternatives", ()):
        yield f"{name}: equally consistent with {alternative}"
    held = ""
    if step.get("heldout_before") is not None and step.get("heldout_after") is not None:
        means = f"{step['heldout_before']:.3g} → {step['heldout_after']:.3g}"
        held = f"; mean squared residual of data left out ({step.get('heldout_scheme', '')}) {means}"
        if (gain := step.get("heldout_gain")) is not None:
            held += f", ln p of these data larger by {gain:.3g}"
    yield f"{name}: χ² {step['chi2_before']:.1f} → {step['chi2_after']:.1f}{held}"
    if step.get("change_of_qu") is not None:
        size = f"{per_cent(step['change_of_qu'])} %"
        yield f"{name} changes calibrated q and u by up to {size}{', which is negligible' * bool(step['negligible'])}"
    places = [f"{key}: {value}" for key, value in step.get("where", {}).items() if value is not None]
    if places := "; by ".join(place for place in places if not place.endswith(" 100%")):
        words = (
            places.replace("_", " ")
            .replace("%", " %")
            .replace("clp harmonic", "harmonic of the polariser angle")
        )
        yield f"{name}, share of the misfit that it removes, by {words}"
    others = step.get("also_called", {})
    for called in (name, *(sentence["sentence"] for sentence in step.get("sentences", ()))):
        if called in others:
            yield f"{called}: also called {some(others[called], thresholds.SHOWN)}, which is the same change"
    rivals = (*step.get("equivalent", ()), *step.get("nameless", ()))
    if rivals:
        yield f"{name}: these data cannot distinguish it from {some(rivals, thresholds.SHOWN)}"
    if rivals and step.get("separated_by"):
        yield f"what would: {step['separated_by']}"


def document(diagnosis: Diagnosis) -> dict[str, Any]:
    """The content of diagnosis.json."""
    remainder, before, after = diagnosis.unexplained, diagnosis.before, diagnosis.after
    unexplained = None
    if remainder is not None:
        patterns = [{"pattern": name, "p_value": p} for name, p in remainder.patterns]
        unexplained = dataclasses.asdict(remainder) | {"patterns": patterns}
    content = {
        "verdict": diagnosis.verdict,
        "steps": [_step(step) for step in diagnosis.steps],
        "candidates": [
            {"effect": name, "score": score, "p_value": p} for name, score, p in diagnosis.candidates
        ],
        "unexplained": unexplained,
        "p_value": diagnosis.p_value,
        "remaining_p_value": diagnosis.remaining_p,
        "noise_scale": diagnosis.noise_scale,
        "noise_p_value": diagnosis.noise_p,
        "limits": diagnosis.limits,
        "choices": [dataclasses.asdict(choice) for choice in diagnosis.choices],
        "classes": diagnosis.classes,
        "members": [
            {
                "added": addition.about,
                "members": [{"name": m.name, "probability": m.probability} for m in addition.members],
                "spread_of_p": addition.spread,
                "stated_error_of_p": addition.stated,
                "farthest_element_sigma": addition.off,
            }
            for addition in diagnosis.members.additions
        ],
        "shape": _shape(diagnosis.members.shape),
        "undetected": _shape(diagnosis.members.undetected),
        "cannot_be_tested": diagnosis.untestable,
        "chi2_per_dof_before": before.chi2 / max(before.dof, 1),
        "chi2_per_dof_after": after.chi2 / max(after.dof, 1),
        "rounds": [dataclasses.asdict(turn) for turn in diagnosis.rounds],
        "not_scored": diagnosis.not_scored,
        "descriptions": diagnosis.descriptions,
        "caution": diagnosis.caution,
        "policy": thresholds.in_use(),
        "seconds": diagnosis.seconds,
    }
    return plain(content)


def _shape(shape: OpenQuestion | None) -> dict[str, Any] | None:
    """The entry of deviations that are in the product."""
    if shape is None:
        return None
    return {
        "deviations": sum(len(member.sums) for member in shape.members),
        "spread_of_p": shape.spread,
        "stated_error_of_p": shape.stated,
    }
