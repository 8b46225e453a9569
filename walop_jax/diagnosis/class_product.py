"""The product of a diagnosis: mean over the classes of its additions, with their spread in the covariance.

Model        that of the fit with the sentences of all members of all classes. An amplitude is 0 in the models of the
             others, so that values and covariance of the mixture (`class_average`) are sufficient: the matrix,
             errors of stars and maps follow as for any other calibration.
Trust        Where the effects of members on stars differ by more than the goal, or by more than the errors of the fit,
             only a class was identified and the product is not trusted: the ambiguity dominates the error.
Limits       to first order; different additions are taken as independent.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Collection, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.thresholds import GOAL
from walop_jax.diagnosis import thresholds
from walop_jax.diagnosis.class_average import known_apart_from, mixture
from walop_jax.fit.refit import FitResult
from walop_jax.io.text import some, two_digits
from walop_jax.model.effects import Context, Described, Deviations
from walop_jax.model.effects.change import Change as Sentence
from walop_jax.model.specification import Model, effect_context, model_without, with_effects

Vector = Float[np.ndarray, " _"]
Matrix = Float[np.ndarray, "_ _"]
Sum = tuple[tuple[float, Sentence], ...]
"""One amplitude: a sum of sentences with their coefficients."""

FAR = 3.0  # errors of the product that no plausible member may lie from an element of it, in the median
_SAME = 1e-9  # of a row of coefficients, which earlier rows must hold for it to be a combination of them
_SHOWN = 4  # members listed in a sentence


class Likeness(NamedTuple):
    """One member of a class: its words, ln B against the model without what was added, its amplitudes in sentences.

    `values` is the change of the free parameters of the fit, where those of what was added become 0, `slopes` is that
    by its amplitudes, which have a `covariance`; `change` that of the elements of the matrix at the field points.
    """

    name: str
    evidence: float
    sums: tuple[Sum, ...]
    amplitudes: Vector
    covariance: Matrix
    values: Vector
    slopes: Matrix
    change: Float[np.ndarray, "p m"]
    probability: float = 0.0


class ClassOf(NamedTuple):
    """An addition, and the members of its class, itself first.

    `at` are the positions of its amplitudes among the free parameters. `spread` is the error of p of stars between
    members, `stated` that of the fit, medians over the field; `off` by how many errors of the product the farthest
    member lies from it, in the median of the field, the worst element.
    """

    added: str
    at: Int[np.ndarray, " a"]
    members: tuple[Likeness, ...]
    spread: float
    stated: float
    off: float

    @property
    def names(self) -> tuple[str, ...]:
        """Members other than the addition itself."""
        return tuple(member.name for member in self.members[1:])


class Shape(NamedTuple):
    """Deviations from the shapes of all descriptions of a model, and errors of p of stars: from them, from the fit.

    In a product those at the positions `in_words` are sentences, those at `in_optics` are in `Deviations`; the others
    act on no star.
    """

    deviations: Likeness
    in_words: tuple[int, ...]
    in_optics: tuple[int, ...]
    spread: float
    stated: float

    @property
    def sums(self) -> tuple[Sum, ...]:
        """Those in words."""
        return tuple(self.deviations.sums[j] for j in self.in_words)

    @property
    def optical(self) -> dict[int, Sentence]:
        """Those of `Deviations`, by position."""
        return {j: self.deviations.sums[j][0][1] for j in self.in_optics}

    @property
    def places(self) -> tuple[str, ...]:
        """Places of `Deviations`."""
        return tuple(dict.fromkeys(f"{change.where} {change.place}" for change in self.optical.values()))


class Classes(NamedTuple):
    """Ambiguities of a diagnosis: classes of its additions that have other members, and shapes of descriptions."""

    additions: tuple[ClassOf, ...] = ()
    shape: Shape | None = None

    def __bool__(self) -> bool:
        return bool(self.additions) or self.shape is not None

    @property
    def sums(self) -> Iterator[tuple[Sum, ...]]:
        """Amplitudes of all members but the additions themselves, and of deviations that grow with anything."""
        yield from (member.sums for addition in self.additions for member in addition.members[1:])
        if self.shape is not None:
            yield self.shape.sums


def with_average(result: FitResult, classes: Classes) -> FitResult:
    """The fit whose calibration is the mean over the classes of its additions."""
    if not classes:
        return result
    context = effect_context(result.model.template, result.calset.exposures)
    mean = functools.partial(averaged, classes=classes, context=context)
    return dataclasses.replace(result, averaged=mean)


def averaged(calibration: Calibration, classes: Classes, context: Context) -> Calibration:
    """The calibration of a fit as the mean over the classes of its additions, with their spread in the covariance.

    Its model includes all members, as sentences; different additions are taken as independent.
    """
    if not classes:
        return calibration
    old, model = calibration.model, _holding(calibration, classes, context)
    held = _parameters_of(classes, model) - set(old.names)
    new = [i for i, name in enumerate(model.names) if name not in old.names and name not in held]
    derivatives = list(_amplitudes_of(model, classes))
    if classes.shape is not None:
        derivatives.append(_deviations_of(model, classes.shape))
    model = _with_ties(model, new, np.concatenate(derivatives, axis=1))
    place = np.array([model.index(name) for name in old.names])
    count, free = len(model.parameters), old.free
    start, fitted = np.zeros(count), np.zeros((count, count))
    start[place] = calibration.values
    fitted[np.ix_(place, place)] = calibration.covariance
    into = np.zeros((count, len(old.names)))
    into[place, np.arange(len(old.names))] = 1.0
    into = into @ old.selection()
    of_free = calibration.covariance[np.ix_(free, free)]
    values, covariance = start.copy(), fitted.copy()
    amplitude_columns = iter(derivatives)
    for group in classes.additions:
        conditional = into @ known_apart_from(of_free, group.at) @ into.T
        means, errors = [start], [fitted]
        for member in group.members[1:]:
            amplitudes = next(amplitude_columns)
            slopes = into @ member.slopes + amplitudes
            means.append(start + into @ member.values + amplitudes @ member.amplitudes)
            errors.append(conditional + slopes @ member.covariance @ slopes.T)
        average = mixture(np.array([member.probability for member in group.members]), np.stack(means), errors)
        values += average.mean - start
        covariance += average.covariance - fitted
    if classes.shape is not None:  # the descriptions remain: their parameters are as free as before
        deviations, amplitudes = classes.shape.deviations, derivatives[-1]
        slopes = into @ deviations.slopes + amplitudes
        values += into @ deviations.values + amplitudes @ deviations.amplitudes
        covariance += slopes @ deviations.covariance @ slopes.T
        model = _with_held(model, held, values)
    hidden = calibration.hidden
    if hidden is not None:
        changes = np.zeros((len(hidden), count))
        changes[:, place] = hidden.changes
        hidden = dataclasses.replace(hidden, changes=changes)
    return dataclasses.replace(
        calibration, model=model, values=values, covariance=_positive(covariance), hidden=hidden
    )


def _holding(calibration: Calibration, classes: Classes, context: Context) -> Model:
    """The model with the sentences of all members."""
    texts = dict.fromkeys(
        sentence.text for sums in classes.sums for amplitude in sums for _, sentence in amplitude
    )
    model = calibration.model
    if classes.shape is not None and classes.shape.places:
        model = with_effects(model, [Deviations.of(context, places=classes.shape.places)], context)
    description = Described.saying(list(texts), np.zeros(len(texts)))
    if Described.name in model.effect_names:
        earlier = calibration.model.instrument(calibration.values).effect(Described.name)
        assert isinstance(earlier, Described)
        parameters = {p.name: p for p in model.parameters}
        wider = with_effects(model_without(model, Described.name), [earlier.joined(description)], context)
        return dataclasses.replace(
            wider, parameters=tuple(parameters.get(p.name, p) for p in wider.parameters)
        )
    return with_effects(model, [description], context)


def _amplitudes_of(model: Model, classes: Classes) -> Iterator[Float[np.ndarray, "n a"]]:
    """Derivative of all parameters by the amplitudes of every member but the first of each class, in order."""
    yield from (
        _derivatives(model, member.sums) for addition in classes.additions for member in addition.members[1:]
    )


def _deviations_of(model: Model, shape: Shape) -> Float[np.ndarray, "n a"]:
    """Derivative of all parameters by the amplitudes of deviations."""
    derivatives = np.zeros((len(model.parameters), len(shape.deviations.sums)))
    derivatives[:, list(shape.in_words)] = _derivatives(model, shape.sums)
    for j, change in shape.optical.items():
        derivatives[model.index(f"{Deviations.name}.{change.label}"), j] = 1.0
    return derivatives


def _derivatives(model: Model, sums: Sequence[Sum]) -> Float[np.ndarray, "n a"]:
    derivatives = np.zeros((len(model.parameters), len(sums)))
    for j, combination in enumerate(sums):
        for size, sentence in combination:
            derivatives[model.index(f"{Described.name}.{sentence.label}"), j] += size
    return derivatives


def _with_ties(model: Model, new: Sequence[int], amplitudes: Float[np.ndarray, "n a"]) -> Model:
    """The model in which the sentences `new` of one amplitude are one parameter, so that the covariance is proper.

    What is the same multiple of the amplitudes as an earlier sentence is tied to it; any other combination of earlier
    ones is held: its value and errors follow from theirs.
    """
    parameters, free = list(model.parameters), list[int]()
    for i in new:
        row, earlier = amplitudes[i], amplitudes[free]
        same = next((k for k in free if np.allclose(amplitudes[k], row, rtol=_SAME, atol=0.0)), None)
        remainder = row - np.linalg.lstsq(earlier.T, row, rcond=None)[0] @ earlier if free else row
        if same is not None:
            parameters[i] = dataclasses.replace(parameters[i], tie=parameters[same].name)
        elif np.abs(remainder).max() <= _SAME * np.abs(row).max():
            parameters[i] = dataclasses.replace(parameters[i], free=False)
        else:
            free.append(i)
    return dataclasses.replace(model, parameters=tuple(parameters))


def _parameters_of(classes: Classes, model: Model) -> set[str]:
    """Parameters of deviations from shapes alone."""
    members, deviations = (
        {f"{Described.name}.{sentence.label}" for total in sums for _, sentence in total}
        for sums in (
            [total for addition in classes.additions for m in addition.members[1:] for total in m.sums],
            () if classes.shape is None else classes.shape.sums,
        )
    )
    return (deviations - members) | {p.name for p in model.parameters if p.part == Deviations.name}


def _with_held(model: Model, names: Collection[str], values: Vector) -> Model:
    """The model with deviations held at their values: fits of other data would not constrain them."""
    parameters = [
        dataclasses.replace(p, free=False, start=float(value)) if p.name in names else p
        for p, value in zip(model.parameters, values, strict=True)
    ]
    return dataclasses.replace(model, parameters=tuple(parameters))


def _positive(matrix: Matrix) -> Matrix:
    """The symmetric matrix without directions of negative variance, which differences of rounding make."""
    scale = np.sqrt(np.clip(np.diag(matrix), 0.0, None))
    unit = np.where(scale > 0, scale, 1.0)
    value, vector = np.linalg.eigh(0.5 * (matrix + matrix.T) / np.outer(unit, unit))
    if value.min(initial=0.0) >= 0.0:
        return 0.5 * (matrix + matrix.T)
    clipped = (vector * np.clip(value, 0.0, None)) @ vector.T * np.outer(unit, unit)
    return np.where(np.outer(scale > 0, scale > 0), 0.5 * (clipped + clipped.T), 0.0)


def only_a_class(classes: Classes) -> Iterator[str]:
    """A sentence on each class whose members differ by so much that nothing of it may be trusted, and on shapes."""
    for group in classes.additions:
        if not (_dominates(group.spread, group.stated) or group.off > FAR):
            continue
        names = some([f"{m.name} ({100 * m.probability:.0f} %)" for m in group.members[1:]], _SHOWN)
        yield (
            f"only a class of causes was named: {group.added} ({100 * group.members[0].probability:.0f} %) or {names}, "
            f"with different effects on stars (p by {two_digits(100 * group.spread)} %, median, where the "
            f"errors of the fit are {two_digits(100 * group.stated)} %; elements of the matrix by up to "
            f"{two_digits(group.off)} errors): {_deciding(group)}"
        )
    shape = classes.shape
    if shape is not None and _dominates(shape.spread, shape.stated):
        yield (
            "the cause was described, not named: over the field, over the exposures and in its kind of polarisation it "
            f"may differ from the description (p by {two_digits(100 * shape.spread)} %, median, where the errors of "
            f"the fit are {two_digits(100 * shape.stated)} %)"
        )


def _dominates(spread: float, stated: float) -> bool:
    """True if an ambiguity is larger than the goal, or than the errors of the fit."""
    return spread > min(GOAL, max(stated, thresholds.NEGLIGIBLE))


def _deciding(group: ClassOf) -> str:
    """Observations that would distinguish the members."""
    tests = [s.tested_by for member in group.members for total in member.sums for _, s in total[:1]]
    observations = some(list(dict.fromkeys(tests)), 2) if tests else "other exposures"
    return f"what would decide: {observations}; walop-jax plan --criterion apart finds the exposures"
