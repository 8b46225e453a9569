"""The product of a diagnosis: the mean over everything that it leaves open, with the spread in the covariance.

Questions    What is it that was added: which of the members of its class? How does it deviate from its description? Is
             each change there that the data would not show? A question has members k with probabilities w_k; different
             questions are taken as independent.
Equation     m̄ = m + Σ_q (m̄_q − m),   C = C_m + Σ_q (C_q − C_m), with the law of total variance for each question:
                 m̄_q = Σ_k w_k m_k,   C_q = Σ_k w_k [C_k + (m_k − m̄_q)(m_k − m̄_q)ᵀ]
Symbols      m, C_m values and covariance of the fit; m_k values in model k, of numbers that may be 0 in some of them;
             C_k their covariance. The w_k of a class are proportional to the evidence of its members.
Source       Leamer 1978, Specification Searches, ch. 4; Hoeting et al. 1999, Stat. Sci. 14, 382 (law of total variance)
Model        that of the fit with the changes of all members of all questions. An amplitude is 0 in the models of the
             others, so that values and covariance of the mixture are sufficient: the matrix, errors of stars and maps
             follow as for any other calibration. Members with the same effect on the result count once. Deviations and
             undetected changes are hundreds: those that act on starlight are the effect `deviations`. Their mean is
             mostly noise; the product has the values of the fit, and their second moment E[c cᵀ] as covariance.
Trust        Where the effects of members on stars differ by more than the goal, by more than the errors of the fit, or
             by more than `thresholds.SEPARATION` errors of an element of the matrix, only a class was identified and
             the product is not trusted: the ambiguity dominates the error. Likewise for the error of p from deviations.
Limits       to first order.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from walop_jax.calibration.accuracy import GOAL
from walop_jax.calibration.calibration import Calibration
from walop_jax.diagnosis import thresholds
from walop_jax.fit.refit import FitResult
from walop_jax.io.shapes import AnyMatrix, AnyVector
from walop_jax.io.text import per_cent, some, two_digits
from walop_jax.likelihood.inverses import pseudo_inverse
from walop_jax.model.effects import Context, Described, Deviations
from walop_jax.model.effects.change import Change
from walop_jax.model.effects.in_models import effect_context, with_descriptions, with_effects
from walop_jax.model.effects.optics import GENERATORS
from walop_jax.model.specification import Model

WeightedChanges = tuple[tuple[float, Change], ...]
"""One amplitude: a sum of descriptions with their coefficients."""


def changes_in(sums: Sequence[WeightedChanges]) -> list[Change]:
    """All descriptions of some amplitudes."""
    return [description for amplitude in sums for _, description in amplitude]


class Answer(NamedTuple):
    """One answer to a question: its `name` in words, its `evidence` (ln B; 0 without the addition), its amplitudes.

    Every amplitude is a sum of weighted changes (`sums`). `values` (n) is the change of the free parameters of the fit,
    by which amplitudes of the addition become 0; `slopes` (n, a) are its derivatives by the `amplitudes` (a), whose
    covariance is `covariance` (a, a). All four are empty for the addition itself, which is in the fit. `change` (p, m)
    is that of the elements of the matrix at the field points. `acting` are the positions of the amplitudes that act on
    starlight and are in the model of the product (None: all); the others only shift the parameters.
    """

    name: str
    evidence: float
    sums: tuple[WeightedChanges, ...]
    change: Float[np.ndarray, "p m"] = np.zeros((0, 0))
    amplitudes: AnyVector = np.zeros(0)
    covariance: AnyMatrix = np.zeros((0, 0))
    values: AnyVector = np.zeros(0)
    slopes: AnyMatrix = np.zeros((0, 0))
    probability: float = 1.0
    acting: tuple[int, ...] | None = None

    @property
    def changes(self) -> list[Change]:
        """All changes of its amplitudes."""
        return changes_in(self.sums)

    @property
    def on_stars(self) -> tuple[WeightedChanges, ...]:
        """Its amplitudes as the model of the product has them: nothing where they do not act on starlight."""
        if self.acting is None:
            return self.sums
        return tuple(total if j in self.acting else () for j, total in enumerate(self.sums))


class OpenQuestion(NamedTuple):
    """What a diagnosis leaves open about one thing, and the possible answers.

    Without an independent zero of the polariser `clp_zero` and `rotator_zero` are the members of a class: both turn the
    sky against the polariser. A retardance was described as growing with r², and the data would hardly show a part that
    grows with r⁴: that question has one member, with this change, the value 0 and an error.

    `about` is the addition of a class, which is its first member, with the positions `at` of its amplitudes among the
    free parameters; of other questions it is in words. `spread` is the error of p of stars between members, `stated`
    that of the fit, medians over the field; `off` by how many errors of the product the farthest member lies
    from it, of those above a probability of 1 − `thresholds.CERTAIN`: median over the field, worst element. The changes
    of its members are in the effect `effect` of the product.
    """

    about: str
    at: Int[np.ndarray, " a"]
    members: tuple[Answer, ...]
    spread: float
    stated: float
    off: float = 0.0
    effect: str = Described.name

    @classmethod
    def of_errors(cls, about: str, member: Answer, spread: float, stated: float) -> OpenQuestion:
        """A question with one answer: changes that are in the errors of the product, and not in its values."""
        return cls(about, np.zeros(0, int), (member,), spread, stated, 0.0, Deviations.name)

    @property
    def names(self) -> tuple[str, ...]:
        """Members of a class other than the addition itself."""
        return tuple(member.name for member in self.members[1:])


class Questions(NamedTuple):
    """All that a diagnosis leaves open: who its additions are, how they deviate from their descriptions, what hides.

    `undetected` are changes that the data would not show.
    """

    additions: tuple[OpenQuestion, ...] = ()
    shape: OpenQuestion | None = None
    undetected: OpenQuestion | None = None

    def __bool__(self) -> bool:
        return self.several or self.undetected is not None

    @property
    def several(self) -> bool:
        """True if the product is a mean over models."""
        return bool(self.additions) or self.shape is not None

    @property
    def of_errors(self) -> tuple[OpenQuestion, ...]:
        """Those whose changes are in the errors of the product alone."""
        return tuple(one for one in (self.shape, self.undetected) if one is not None)

    def averaged(self, calibration: Calibration) -> Calibration:
        """The calibration of a fit as the mean over the answers (the function `averaged`)."""
        return averaged(calibration, self)

    def deviations(self, model: Model, context: Context) -> Deviations | None:
        """The effect that includes all of `of_errors` that acts on stars, zero; None if nothing does."""
        described = [] if self.shape is None else changes_in(self.shape.members[0].on_stars)
        changes = [c for one in self.of_errors for member in one.members for c in changes_in(member.on_stars)]
        # Ahead of the polariser no element may depend on exposures; its light may.
        optical = (change for change in described if change.kind in GENERATORS)
        places = dict.fromkeys(
            _place(c) for c in optical if not c.beside_field or not c.is_of_sky(model.template)
        )
        others = [c.text for c in changes if c.kind not in GENERATORS or _place(c) not in places]
        return Deviations.of(context, places=places, sentences=others) if changes else None


def _place(change: Change) -> str:
    """Place and dependence of a change of polarisation, as `Deviations` lists it."""
    return " * ".join((f"{change.relation} {change.place}", *change.beside_field))


def with_average(result: FitResult, questions: Questions) -> FitResult:
    """The fit whose calibration is the mean over what is open."""
    return dataclasses.replace(result, alternatives=questions) if questions else result


def averaged(calibration: Calibration, questions: Questions) -> Calibration:
    """The calibration of a fit as the mean over the answers to some questions, their spread in the covariance."""
    if not questions:
        return calibration
    old, model = calibration.model, _holding(calibration, questions)
    said = _said_by_name(old)
    parts = [p.part for p in model.parameters]
    new = [i for i, name in enumerate(model.names) if name not in old.names and parts[i] != Deviations.name]
    if new:
        model = _with_ties(model, new, _derivatives(model, Described.name, _of_additions(questions), said))
    place = np.array([model.index(name) for name in old.names])
    count, free = len(model.parameters), old.free
    start, fitted = np.zeros(count), np.zeros((count, count))
    start[place] = calibration.values
    fitted[np.ix_(place, place)] = calibration.covariance
    into = np.zeros((count, len(free)))
    into[place] = old.selection()
    values, covariance = start.copy(), fitted.copy()
    for question in (*questions.additions, *questions.of_errors):
        # What was added is 0 in the models of other members; without an addition the parameters are as free as before.
        conditional, means, errors = fitted, list[AnyVector](), list[AnyMatrix]()
        if len(question.at):
            of_free = calibration.covariance[np.ix_(free, free)]
            conditional = into @ known_apart_from(of_free, question.at) @ into.T
        for member in question.members:
            if not len(member.amplitudes):  # the addition itself, which was fitted
                means.append(start)
                errors.append(fitted)
                continue
            amplitudes = _derivatives(
                model, question.effect, member.on_stars, said if len(question.at) else None
            )
            slopes = into @ member.slopes + amplitudes
            moved = into @ member.values if len(member.values) else 0.0
            means.append(start + moved + amplitudes @ member.amplitudes)
            errors.append(conditional + slopes @ member.covariance @ slopes.T)
        weights = np.array([member.probability for member in question.members])
        mean, spread = mixture(weights, np.stack(means), errors)
        values += mean - start
        covariance += spread - fitted
    # Held at their values: fits of other data would not constrain them.
    held = [
        dataclasses.replace(p, free=False, start=float(value)) if p.part == Deviations.name else p
        for p, value in zip(model.parameters, values, strict=True)
    ]
    model = dataclasses.replace(model, parameters=tuple(held))
    hidden = calibration.hidden
    if hidden is not None:
        changes = np.zeros((len(hidden), count))
        changes[:, place] = hidden.changes
        hidden = dataclasses.replace(hidden, changes=changes)
    return dataclasses.replace(
        calibration, model=model, values=values, covariance=_positive(covariance), hidden=hidden
    )


def _of_additions(questions: Questions) -> list[WeightedChanges]:
    """Amplitudes of all members of classes beside the additions themselves."""
    return [total for one in questions.additions for member in one.members[1:] for total in member.sums]


def _holding(calibration: Calibration, questions: Questions) -> Model:
    """The model with the changes of all members of classes that no effect of it says by a name, and with deviations."""
    model = calibration.model
    said = _said_by_name(model)
    texts = dict.fromkeys(s.text for s in changes_in(_of_additions(questions)) if s.text not in said)
    context = effect_context(model.template, calibration.exposures)
    if (effect := questions.deviations(model, context)) is not None:
        model = with_effects(model, [effect], context)
    if not texts:
        return model
    description = Described.saying(list(texts), np.zeros(len(texts)))
    return with_descriptions(model, description, context)


def _said_by_name(model: Model) -> dict[str, tuple[str, float]]:
    """Parameters of named effects that are the amplitude of one description, and its coefficient, by the description.

    What moves in a member of a class is then that parameter, and not a description of the same change beside it.
    """
    said: dict[str, tuple[str, float]] = {}
    for effect in model.template.effects:
        if isinstance(effect, Described | Deviations) or effect.kind.is_structural():
            continue
        names = [f"{effect.name}.{label}" for f in effect.kind.amplitudes() for label in effect.labels(f)]
        amplitudes = effect.first_order(model.template)
        for name, terms in zip(names, amplitudes, strict=False) if len(names) == len(amplitudes) else ():
            if len(terms) == 1 and name in model.names and model[name].free and model[name].tie is None:
                ((coefficient, description),) = terms
                said.setdefault(description.text, (name, coefficient))
    return said


def _derivatives(
    model: Model,
    effect: str,
    sums: Sequence[WeightedChanges],
    said: Mapping[str, tuple[str, float]] | None = None,
) -> Float[np.ndarray, "n a"]:
    """Derivative of all parameters by amplitudes, each a sum of changes that an effect of the model holds.

    Descriptions that are `said` by a parameter of another effect (`_said_by_name`) change that.
    """
    derivatives = np.zeros((len(model.parameters), len(sums)))
    for j, combination in enumerate(sums):
        for size, description in combination:
            name, coefficient = (said or {}).get(description.text, (f"{effect}.{description.label}", 1.0))
            derivatives[model.index(name), j] += size / coefficient
    return derivatives


def _with_ties(model: Model, new: Sequence[int], amplitudes: Float[np.ndarray, "n a"]) -> Model:
    """The model in which the descriptions `new` of one amplitude are one parameter, so that the covariance is proper.

    What is the same multiple of the amplitudes as an earlier description is tied to it; any other combination of
    earlier ones is held: its value and errors follow from theirs.
    """
    parameters, alike = list(model.parameters), dict[bytes, list[int]]()
    # An orthonormal basis of the combinations that are free: of thousands, each is held against all before it.
    basis, rank = np.zeros((min(len(new), amplitudes.shape[1]), amplitudes.shape[1])), 0
    for i in new:
        row, group = amplitudes[i], alike.setdefault((amplitudes[i] != 0.0).tobytes(), [])
        same = next(
            (k for k in group if np.allclose(amplitudes[k], row, rtol=thresholds.ROUNDING, atol=0.0)), None
        )
        if same is not None:
            parameters[i] = dataclasses.replace(parameters[i], tie=parameters[same].name)
            continue
        remainder = row
        for _ in range(2):  # what rounding leaves the second time is nothing (Giraud et al. 2005)
            remainder = remainder - (basis[:rank] @ remainder) @ basis[:rank]
        if np.abs(remainder).max() <= thresholds.ROUNDING * np.abs(row).max():
            parameters[i] = dataclasses.replace(parameters[i], free=False)
        else:
            group.append(i)
            basis[rank], rank = remainder / np.linalg.norm(remainder), rank + 1
    return dataclasses.replace(model, parameters=tuple(parameters))


def _positive(matrix: AnyMatrix) -> AnyMatrix:
    """The symmetric matrix without directions of negative variance, which differences of rounding make."""
    scale = np.sqrt(np.clip(np.diag(matrix), 0.0, None))
    unit = np.where(scale > 0, scale, 1.0)
    value, vector = np.linalg.eigh(0.5 * (matrix + matrix.T) / np.outer(unit, unit))
    if value.min(initial=0.0) >= 0.0:
        return 0.5 * (matrix + matrix.T)
    clipped = (vector * np.clip(value, 0.0, None)) @ vector.T * np.outer(unit, unit)
    return np.where(np.outer(scale > 0, scale > 0), 0.5 * (clipped + clipped.T), 0.0)


def only_a_class(questions: Questions) -> Iterator[str]:
    """A sentence on each class whose members differ by so much that nothing of it may be trusted, and on deviations."""
    for group in questions.additions:
        if not (_dominates(group.spread, group.stated) or group.off > thresholds.SEPARATION):
            continue
        names = some([f"{m.name} ({100 * m.probability:.0f} %)" for m in group.members[1:]], thresholds.SHOWN)
        yield (
            f"only a class of causes was named: {group.about} ({100 * group.members[0].probability:.0f} %) or {names}, "
            f"with different effects on stars (p by {per_cent(group.spread)} %, median, where the "
            f"errors of the fit are {per_cent(group.stated)} %; elements of the matrix by up to "
            f"{two_digits(group.off)} errors): {_deciding(group)}"
        )
    shape = questions.shape
    if shape is not None and _dominates(shape.spread, shape.stated):
        yield (
            "the cause was described, not named: over the field, over the exposures and in its kind of polarisation it "
            f"may differ from the description (p by {per_cent(shape.spread)} %, median, where the errors of "
            f"the fit are {per_cent(shape.stated)} %)"
        )


def mixture(
    weights: AnyVector, values: Float[np.ndarray, "k n"], covariances: Sequence[AnyMatrix]
) -> tuple[AnyVector, AnyMatrix]:
    """Mean and covariance over models of some probabilities, by the law of total variance."""
    mean = weights @ values
    away = values - mean
    covariance = (away * weights[:, None]).T @ away
    for weight, within in zip(weights, covariances, strict=True):
        covariance += weight * within
    return mean, covariance


def known_apart_from(covariance: AnyMatrix, at: Int[np.ndarray, " k"]) -> AnyMatrix:
    """Conditional covariance of all others given the parameters `at`: C − C_a C_aa⁺ C_aᵀ, 0 in the rows of these."""
    across = covariance[:, at]
    conditional = covariance - across @ pseudo_inverse(covariance[np.ix_(at, at)], 1e-12) @ across.T
    conditional[at], conditional[:, at] = 0.0, 0.0
    return 0.5 * (conditional + conditional.T)


def distinct(
    evidence: AnyVector, changes: Float[np.ndarray, "k p m"], errors: Float[np.ndarray, "p m"], alike: float
) -> list[list[int]]:
    """Groups of equivalent models, the most probable of each first; best groups first.

    Two are equivalent where their changes differ by less than `alike` of the errors, rms over places, in every element.
    """
    scale = np.where(errors > 0, errors, np.inf)
    groups: list[list[int]] = []
    for k in np.argsort(-evidence, kind="stable").tolist():
        apart = (np.sqrt(np.mean(((changes[k] - changes[g[0]]) / scale) ** 2, axis=0)).max() for g in groups)
        same = next((group for group, distance in zip(groups, apart, strict=True) if distance < alike), None)
        groups.append([k]) if same is None else same.append(k)
    return groups


def _dominates(spread: float, stated: float) -> bool:
    """True if an ambiguity is larger than the goal, or than both the errors of the fit and `thresholds.NEGLIGIBLE`."""
    return spread > min(GOAL, max(stated, thresholds.NEGLIGIBLE))


def _deciding(group: OpenQuestion) -> str:
    """Observations that would distinguish the members."""
    tests = [s.tested_by for member in group.members for total in member.sums for _, s in total[:1]]
    observations = some(list(dict.fromkeys(tests)), 2) if tests else "other exposures"
    return f"what would decide: {observations}; walop-jax plan --separate RUN plans the exposures"
