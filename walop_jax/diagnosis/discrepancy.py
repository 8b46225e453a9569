"""Model discrepancy in the product of a diagnosis: deviations from descriptions, and undetected changes.

Shape        A description without a name is the simplest one that explains the data: a polynomial over the field, one
             law over the exposures, one kind of polarisation. Its cause has no reason to be so simple. Deviations from
             it are a Gaussian process,
                 δ(x, t) = Σ_j c_j f_j(x, t),   c_j ~ N(0, s²/(n ⟨f_j²⟩))
             f_j products of a pattern over the field (all polynomials to the third degree), a law over the exposures
             (none, those of the descriptions, other slow ones) for each kind of polarisation (`GENERATORS`; of cameras
             and other numbers the kind itself); n patterns × laws, s rms size of the descriptions of that place in the
             data: every kind may be as large as what was described, in any shape. In a product, stars have the
             deviations that are the same in all exposures, and those with a law that a description has; all others
             only shift the parameters. With mean c and
             covariance C of the amplitudes by one linear step, E[c cᵀ] = C + c cᵀ is added to the covariance; values
             stay those of the fit: of hundreds of amplitudes, the mean is mostly noise.
Undetected   With elements that the model does not let vary, the matrix has errors of 10⁻⁶, which no experiment has.
             There may be further changes δ of polarisation: at a place of the train a diattenuation, retardance or
             depolarisation, of one degree d ≤ 3 over the field, its prior widths at all `score.SCALES`. Each of these
             n groups g is there or not, with a probability π = 1/n beforehand: one change is expected. By the
             evidence B_g of one linear step,
                 E[δδᵀ] = Σ_g p_g (C_g + c_g c_gᵀ),   p_g = π B_g / (1 − π + π B_g)
             is added to the covariance; values stay those of the fit. A change that the data exclude adds nothing; one
             of which the data say nothing adds its prior variance; one that they suggest without an alarm adds its
             size. One more change is expected among the candidates that differ between calibration exposures or are not
             seen by stars (in time, temperature, KIND, counts, single exposures), and one among the numbers that the
             set states and the data measure (TEFF, ROTATOR, the clock, coordinates), which may be wrong by up to ten of
             their standard errors (`thresholds.MOST_WIDTHS`): these only shift the parameters. Of a change in exposures
             of one KIND nothing says whether stars have it, as a gain of standards, which are stars: they have it with
             a probability of a half. Numbers of which the data say nothing are those of `undetected_errors`.
Starlight    To first order any such change acts on a star like a change ahead of the train, but for a turn in one arm
             alone: what is ahead of the train turns q and u alike. A few changes there, chosen one after the other (a
             Cholesky decomposition with pivots), carry the covariance of the matrix.
Sources      model discrepancy as a Gaussian process, Kennedy & O'Hagan 2001, J. R. Stat. Soc. B 63, 425; mean over
             models that were not chosen, Draper 1995, J. R. Stat. Soc. B 57, 45
Limits       First order; in the usual setting of the plates. Undetected changes of finer structure are not in it.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from jaxtyping import Float
from scipy import linalg, special

from walop_jax.calibration.matrix import of_matrix
from walop_jax.diagnosis import thresholds
from walop_jax.diagnosis.class_members import LinearisedFit, LinearStep, classes_of
from walop_jax.diagnosis.class_product import Answer, OpenQuestion, Questions, WeightedChanges, mixture
from walop_jax.diagnosis.examination import Examination
from walop_jax.diagnosis.grammar import FEWEST_POINTS, Dependences, places_of
from walop_jax.diagnosis.hypotheses import Probe
from walop_jax.diagnosis.score import SCALES, log_bayes_by_scale
from walop_jax.diagnosis.stated_conditions import condition_scores
from walop_jax.fit.refit import FitResult
from walop_jax.io.shapes import AnyMatrix, AnyVector
from walop_jax.likelihood.columns import Columns
from walop_jax.likelihood.inverses import square_root
from walop_jax.model.effects import Described, FreeForm
from walop_jax.model.effects.change import AMPLITUDES, SINGLE, SLOW, Change, InExposures
from walop_jax.model.effects.deviations import CUBIC
from walop_jax.model.effects.factors import COUNTS, EXPOSURE
from walop_jax.model.effects.optics import GENERATORS, generators_of
from walop_jax.model.instrument import Instrument

LEFT_OUT = 0.02  # share of the variance of the elements of the matrix that a product may lack in the mean
DEGREES = tuple(sum(2 if factor in ("r2", "x2-y2", "xy") else 1 for factor in names) for names in CUBIC)


def ambiguities(
    state: Examination, added: Mapping[str, Collection[str]], given: Collection[str] = ()
) -> Questions:
    """Classes of the additions to a model, deviations from its descriptions, and undetected changes.

    `added` are effects and groups of descriptions, by name, each with the candidates that are reported as
    indistinguishable from it, `given` descriptions that the model had before (`class_members.classes_of`).
    """
    if not state.result.model.template.cameras.pairs:
        return Questions()
    laid = LinearisedFit(state)
    return Questions(
        additions=classes_of(laid, added, given),
        shape=shape_of(laid) if added else None,
        undetected=undetected(laid),
    )


def _slopes(
    laid: LinearisedFit, sums: Sequence[WeightedChanges], values: AnyMatrix
) -> Float[np.ndarray, "p m a"]:
    """Slopes of the elements of the matrix in amplitudes, which change the free parameters by `values` as well."""
    vectors, added = laid.added(sums)
    direct = of_matrix(vectors[:, None], np.moveaxis(added, -1, 1), laid.template.cameras.pairs)
    return np.moveaxis(direct, 1, -1).reshape(*laid.matrix.shape, -1) + laid.slopes @ values


# ------------------------------------------------------------------------------ deviations from a description


def shape_of(laid: LinearisedFit) -> OpenQuestion | None:
    """Deviations from the shapes of all descriptions, by one linear step; None without a description."""
    if FreeForm.name in laid.fit.model.effect_names:  # it has every shape
        return None
    changes, widths, laws = shape_changes(laid.fit, laid.columns)
    if not changes:
        return None
    sums: tuple[WeightedChanges, ...] = tuple(((1.0, change),) for change in changes)
    step = laid.nothing_removed
    column = laid.design.stacked([laid.columns.of(sums)])
    member = _of_second_moment(step.member("deviations", sums, column, widths, 0.0))
    slopes = _slopes(laid, sums, member.slopes)
    between = slopes @ member.covariance @ np.swapaxes(slopes, 1, 2)
    # Terms that are zero in the usual setting act on stars at another temperature: look at the steady part.
    steady = [dataclasses.replace(change, factors=change.over_field) for change in changes]
    _, at_any = laid.added([((1.0, change),) for change in steady])
    acting = np.abs(at_any).max(axis=(0, 1, 2)) > 0
    # Stars get no dependence that no description has: each one would cost a program of derivatives.
    on_stars = tuple(
        j for j, c in enumerate(changes) if acting[j] and c.applies_to_catalogue and c.beside_field in laws
    )
    member = member._replace(acting=on_stars)
    return OpenQuestion.of_errors(
        "deviations from descriptions", member, laid.error_of_p(between), laid.stated
    )


def _of_second_moment(member: Answer) -> Answer:
    """The member with the mean 0 of its amplitudes c and E[c cᵀ] as their covariance: values are those of the fit."""
    moment = member.covariance + np.outer(member.amplitudes, member.amplitudes)
    count = len(member.values)
    return member._replace(
        amplitudes=np.zeros_like(member.amplitudes),
        covariance=moment,
        values=np.zeros(count),
        change=np.zeros((0, 0)),
    )


_OPTICS = {name.partition(" ")[0] for name in GENERATORS} | {"turn"}


class _Place(NamedTuple):
    """Changes of one kind of quantity at one place."""

    kinds: tuple[str, ...]
    where: str
    place: str
    origin: str


def shape_changes(fit: FitResult, columns: Columns) -> tuple[list[Change], AnyVector, set[tuple[str, ...]]]:
    """Deviations from the shapes of the descriptions in a model, their prior widths, and the laws described."""
    instrument = fit.model.instrument(fit.values)
    if not any(isinstance(effect, Described) for effect in instrument.effects):
        return [], np.zeros(0), set()
    described = instrument.effect(Described.name)
    assert isinstance(described, Described)
    data, squares = _AtData.of(columns), dict[_Place, float]()
    laws: dict[_Place, dict[tuple[str, ...], None]] = {}
    for change, amplitude in described.terms():
        optical = change.kind.partition(" ")[0] in _OPTICS
        place = _Place(
            GENERATORS if optical else (change.kind,), change.relation, change.place, change.origin
        )
        parts = generators_of(change.kind) if optical else ((change.kind, 1.0, ()),)
        for _, coefficient, factors in parts:
            size = float(amplitude) * coefficient * data.rms(change.times(*factors))
            squares[place] = squares.get(place, 0.0) + size**2
        laws.setdefault(place, {(): None}).setdefault(change.beside_field)
    listed = set(described.sentences)
    changes, widths = list[Change](), list[float]()
    for place, square in squares.items():
        shapes = list(_shapes(place, tuple(laws[place]), fit, columns))
        count = len(shapes) / len(place.kinds)
        for change in shapes:
            rms = data.rms(change)
            if change.text not in listed and square * rms > 0.0:
                changes.append(change)
                widths.append(np.sqrt(square / max(count, 1.0)) / rms)
    return changes, np.array(widths), set().union(*laws.values())


def _shapes(
    place: _Place, laws: Sequence[tuple[str, ...]], fit: FitResult, columns: Columns
) -> Iterator[Change]:
    """All changes at a place that the model can include: patterns over the field with `laws`, and other slow ones.

    Steady gains are left out: the throughput has them. Other steady numbers of cameras have the first four patterns.
    """
    exposures, template = fit.calset.exposures, fit.model.template
    over_field = len(fit.calset.points) >= FEWEST_POINTS
    dependences = Dependences(exposures, over_field, (), np.ones(len(exposures), bool))
    slow = [law for form in (*SLOW, *SINGLE) for law in dependences.of(form)] if len(laws) > 1 else []
    for law in dict.fromkeys((*laws, *slow)):
        patterns = CUBIC if law or place.kinds == GENERATORS else CUBIC[:4]
        for pattern, kind in itertools.product(patterns if over_field else CUBIC[:1], place.kinds):
            change = Change(kind, place.where, place.place, (*pattern, *law), place.origin)
            try:
                change.check_factors(template)
            except ValueError:
                continue
            if columns.has(((1.0, change),)) and (law or kind != "gain"):
                yield change


@dataclasses.dataclass(frozen=True)
class _AtData(InExposures):
    """The (point, exposure) of a set; `wavelength` (µm) is the mean of the band of each exposure."""

    wavelength: Any = 0.0
    used: Any = None

    @classmethod
    def of(cls, columns: Columns) -> Self:
        """The (point, exposure) pairs of a likelihood."""
        points, plan = columns.likelihood.calset.points, columns.plan
        wavelength = columns.wavelength[np.asarray(plan.band_of)[:, 0]]
        return cls(
            columns.exposures, points.x[:, None], points.y[:, None], wavelength, columns.likelihood.used
        )

    def rms(self, change: Change) -> float:
        """Root mean square of the factors of a change."""
        sizes = np.nan_to_num(np.asarray(change.factor(self), float))
        return float(np.sqrt(np.mean(np.broadcast_to(sizes, self.used.shape)[self.used] ** 2)))


# ------------------------------------------------------------------------------------------ undetected changes


class _Block(NamedTuple):
    """Undetected changes at one place: their amplitudes, and the groups that are hypotheses by themselves.

    `gram` and `scores` are products of their columns, projected off the free parameters, with each other and with the
    residuals; `slopes` is the change of the free parameters by each.
    """

    sums: tuple[WeightedChanges, ...]
    widths: AnyVector
    groups: tuple[list[int], ...]
    gram: AnyMatrix
    scores: AnyVector
    slopes: AnyMatrix


def undetected(laid: LinearisedFit) -> OpenQuestion | None:
    """Covariance of undetected changes, expressed by changes ahead of the train; None if there are no such changes."""
    if not (places := _steady_places(laid)):
        return None
    step, data, front = laid.nothing_removed, _AtData.of(laid.columns), places[0]
    blocks = {place: block for place in places if (block := _block(laid, step, data, *place)) is not None}
    # Without light from the sky nothing ahead of the polariser is in the data.
    tried = [block for place, block in blocks.items() if place != front or block.gram.any()]
    if not tried or front not in blocks:
        return None
    factor = _factor_of_matrix(laid, step, tried)
    ahead = blocks[front]
    slopes = _slopes(laid, ahead.sums, ahead.slopes)
    total = np.sqrt(laid.errors**2 + np.sum(factor**2, axis=-1))
    unit = np.where(total > 0.0, total, np.inf)[..., None]
    columns, whole = ((of / unit).reshape(total.size, -1) for of in (slopes, factor))
    few = square_root(whole @ whole.T)  # the same covariance by fewer columns
    chosen, loadings = _carrying(columns, few)
    if not chosen:
        return None
    covariance = loadings @ loadings.T
    between = slopes[..., chosen] @ covariance @ np.swapaxes(slopes[..., chosen], 1, 2)
    member = Answer(
        "undetected",
        0.0,
        tuple(ahead.sums[j] for j in chosen),
        amplitudes=np.zeros(len(chosen)),
        covariance=covariance,
        slopes=ahead.slopes[:, chosen],
    )
    return OpenQuestion.of_errors(
        "changes that the data would not show", member, laid.error_of_p(between), laid.stated
    )


def _factor_of_matrix(
    laid: LinearisedFit, step: LinearStep, blocks: Sequence[_Block]
) -> Float[np.ndarray, "p m a"]:
    """F, with F Fᵀ the covariance of the matrix by all undetected changes, of which `blocks` are the steady ones."""
    moments = _second_moments(blocks, laid.state.scatter)
    steady = [
        _slopes(laid, block.sums, block.slopes) @ square_root(moment)
        for block, moment in zip(blocks, moments, strict=True)
    ]
    numbers = laid.slopes @ _of_stated_numbers(laid, step)
    of_stars, alone = _of_exposures(laid, step)
    return np.concatenate([*steady, of_stars, laid.slopes @ alone, numbers], axis=-1)


def _steady_places(laid: LinearisedFit) -> list[tuple[str, str]]:
    """Places of the train, that ahead of it first, whether or not exposures show it."""
    bare = dataclasses.replace(laid.template, effects=())
    places = list(itertools.chain(*places_of(bare, laid.fit.calset.exposures)))
    front = places[:1] if bare.ahead_of_polariser is None else [bare.ahead_of_polariser]
    return [*front, *(place for place in places if place not in front)]


def _block(laid: LinearisedFit, step: LinearStep, data: _AtData, where: str, place: str) -> _Block | None:
    """The undetected changes of a place; None of a place that has none."""
    over_field = len(laid.fit.calset.points) >= FEWEST_POINTS
    changes, degrees = list[Change](), list[tuple[str, int]]()
    for (pattern, degree), kind in itertools.product(zip(CUBIC, DEGREES, strict=True), GENERATORS):
        change = Change(kind, where, place, pattern)
        if (over_field or not degree) and laid.columns.has(((1.0, change),)) and data.rms(change) > 0.0:
            changes.append(change)
            degrees.append((kind.partition(" ")[0], degree))
    if not changes:
        return None
    groups = {key: [i for i, of in enumerate(degrees) if of == key] for key in dict.fromkeys(degrees)}
    patterns = {key: len({changes[i].factors for i in group}) for key, group in groups.items()}
    widths = np.array(
        [
            AMPLITUDES[change.parameter].width / (np.sqrt(patterns[key]) * data.rms(change))
            for change, key in zip(changes, degrees, strict=True)
        ]
    )
    sums = tuple(((1.0, change),) for change in changes)
    column = laid.design.stacked([laid.columns.of(sums)])
    along = step.projector.basis.T @ column
    projected = column - step.projector.basis @ along
    return _Block(
        sums, widths, tuple(groups.values()), projected.T @ projected, projected.T @ step.left,
        -step.projector.taken_up(along),
    )  # fmt: skip


def _second_moments(blocks: Sequence[_Block], scatter: float) -> list[AnyMatrix]:
    """E[c cᵀ] of the amplitudes of every block, each group being there or not; evidence in units of `scatter`."""
    odds, moments = _odds(sum(len(block.groups) for block in blocks)), []
    for block in blocks:
        moment = np.zeros_like(block.gram)
        for group in block.groups:
            at = np.ix_(group, group)
            moment[at] = _second_moment(
                block.gram[at], block.scores[group], block.widths[group], odds, scatter
            )
        moments.append(moment)
    return moments


def _odds(groups: int) -> float:
    """ln of the prior odds of one of `groups` groups being there at one given scale, against its absence."""
    prior = thresholds.EXPECTED / max(groups, 2)
    return float(np.log(prior / (1.0 - prior) / len(SCALES)))


def _second_moment(
    gram: AnyMatrix, scores: AnyVector, widths: AnyVector, odds: float, scatter: float
) -> AnyMatrix:
    """E[c cᵀ] of the amplitudes of a group: the mixture over its scales and its absence, about 0."""
    value, vector = np.linalg.eigh(gram * np.outer(widths, widths))
    value, along = np.clip(value, 0.0, None), vector.T @ (scores * widths)
    there = odds + log_bayes_by_scale(value, along, SCALES) / scatter**2
    weights = special.softmax([*there, 0.0])
    variance = SCALES[:, None] ** 2 / (1.0 + np.outer(SCALES**2, value))  # scale, amplitude
    none = np.zeros((1, len(widths)))
    means = np.concatenate([variance * along, none])
    mean, covariance = mixture(weights, means, [np.diag(of) for of in np.concatenate([variance, none])])
    vector = widths[:, None] * vector
    return vector @ (covariance + np.outer(mean, mean)) @ vector.T


def _of_exposures(laid: LinearisedFit, step: LinearStep) -> tuple[Float[np.ndarray, "p m _"], AnyMatrix]:
    """Undetected changes that differ between exposures: factors F of two covariances F Fᵀ.

    These are the candidates of an examination that depend on time, temperature, KIND, counts or an exposure, or that
    do not change the light of a star. Those in exposures of one KIND are in the light of stars with a probability of a
    half: the first factor is of the covariance of the matrix then. All others only shift the free parameters, of whose
    covariance the second factor is.
    """
    state, count = laid.state, len(laid.fit.model.free)
    differing = [probe for probe in state.asked if _no_starlight(probe, laid.template)]
    scores, places = laid.design.products(state.columns, step.left), state.bare.places()
    slopes = -step.projector.taken_up(laid.design.products(state.columns, step.projector.basis).T)
    covariance, odds = np.zeros((count, count)), _odds(len(differing))
    sums, shifts, roots = list[WeightedChanges](), [slopes[:, :0]], [np.zeros((0, 0))]
    for probe in differing:
        at = places[probe.name]
        moment = _second_moment(state.bare.gram[at, at], scores[at], probe.widths, odds, state.scatter)
        if on_stars := _of_stars_as_well(laid, probe):
            moment *= 0.5
            sums += on_stars
            shifts.append(slopes[:, at])
            roots.append(square_root(moment))
        covariance += slopes[:, at] @ moment @ slopes[:, at].T
    of_matrix = _slopes(laid, sums, np.concatenate(shifts, axis=1)) @ linalg.block_diag(*roots)
    return of_matrix, square_root(covariance)


def _of_stars_as_well(laid: LinearisedFit, probe: Probe) -> tuple[WeightedChanges, ...]:
    """What a candidate in exposures of one KIND does to stars, if they have it; empty: it is no such candidate."""
    groups = [total for member in probe.group for total in member.first_order(laid.template)]
    kinds = {f for total in groups for _, c in total for f in c.grows_with if f.form == "kind"}
    if len(kinds) != 1:
        return ()
    (kind,) = kinds
    steady = tuple(tuple((size, c.without(kind.text)) for size, c in total) for total in groups)
    same = all(kind.text in c.factors for total in groups for _, c in total)
    return steady if same and all(map(laid.columns.has, steady)) else ()


def _of_stated_numbers(laid: LinearisedFit, step: LinearStep) -> AnyMatrix:
    """F, with F Fᵀ the covariance of the free parameters by numbers of the set that may be wrong, each there or not.

    These are the numbers that the data measure. What stars are observed under as well, the wavelengths of a filter, is
    left out: what the parameters take up of it is right for stars.
    """
    numbers = [
        number
        for number in condition_scores(laid.design).items
        if number.alive.all() and not number.stated.seen_by_stars and number.stated.error > 0.0
    ]
    if not numbers:
        return np.zeros((len(laid.fit.model.free), 0))
    columns = np.hstack([number.single.candidate.columns for number in numbers])
    scores, odds, scatter = step.projector(columns).T @ step.left, _odds(len(numbers)), laid.state.scatter
    moments = [
        _second_moment(
            np.diag(number.rest),
            score,
            np.array([thresholds.MOST_WIDTHS * number.stated.error]),
            odds,
            scatter,
        ).item()
        for number, score in zip(numbers, scores[:, None], strict=True)
    ]
    return -step.projector.taken_up(step.projector.basis.T @ columns) * np.sqrt(moments)


def _no_starlight(probe: Probe, template: Instrument) -> bool:
    """True of a candidate that changes calibration exposures and not the light of stars in the usual setting."""
    changes = [c for member in probe.group for total in member.first_order(template) for _, c in total]
    laws = ({item.depends_on for item in change.grows_with} & {EXPOSURE, COUNTS} for change in changes)
    return bool(changes) and all(
        law or not c.applies_to_catalogue for law, c in zip(laws, changes, strict=True)
    )


def _carrying(columns: AnyMatrix, factor: AnyMatrix) -> tuple[list[int], AnyMatrix]:
    """Few `columns`, and loadings L, with columns[:, chosen] L Lᵀ columns[:, chosen]ᵀ close to factor factorᵀ.

    Rows count in units of their own total error, so that badly known elements of the matrix do not hide well known
    ones. One after the other the column that explains most of the rest, until less than `LEFT_OUT` of a row is left in
    the mean over the rows.
    """
    remaining, rest, chosen = columns.copy(), factor.copy(), list[int]()
    length = np.linalg.norm(columns, axis=0)
    while len(chosen) < columns.shape[1] and np.sum(rest**2) > LEFT_OUT * len(rest):
        norm = np.linalg.norm(remaining, axis=0)
        unit = remaining / np.where(norm > 1e-6 * length, norm, np.inf)
        explained = np.sum((unit.T @ rest) ** 2, axis=1)
        best = int(np.argmax(explained))
        if explained[best] <= 0.0:
            break
        chosen.append(best)
        direction = unit[:, best, None]
        remaining -= direction @ (direction.T @ remaining)
        rest -= direction @ (direction.T @ rest)
    return chosen, np.linalg.lstsq(columns[:, chosen], factor, rcond=None)[0]
