"""Equivalence class of each addition of a diagnosis: candidates indistinguishable from it, and their effect on stars.

Additions    effects with a name, and groups of descriptions. The class of an addition has as members all candidates
             that could take its place and would not be improbable there (`thresholds.IMPROBABLE`), by one linear step.
             Their prior probabilities are equal: a name does not make a candidate more probable.
One step     A model without some amplitudes a leaves r + D of the residuals r, D = −J_a a. Other columns K take their
             place with b = −(KᵀPK + W⁻²)⁻¹ KᵀP(r + D), W their prior widths, and all other parameters move by
             −J_o⁺ (D + K b), where P projects off the other columns J_o. Exact where everything is linear.
Kinds        An effect in exposures of one KIND is a difference between that KIND and all others; residuals do not
             show which of the two is wrong. "In all other kinds, with the other sign" is an equally probable member.
             Ahead of the polariser there is no such change, as exposures through it would not show it: then "in KIND
             standard, and when stars are observed", which are seen alike, is an equally probable member.
Stars        A member changes the matrix by its own column, and through the shifts of the other parameters.
             Equivalent members count once. The product is their mean, and its covariance has their spread: values and
             covariance of a model that includes all of them, each amplitude 0 in the models of the others.
Limits       To first order. Structural effects, other descriptions and patterns of a single place have no description
             and no part in it.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Collection, Iterator, Mapping, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy import special

from walop_jax.calibration.accuracy import measures_u, p_errors, sample_stars
from walop_jax.calibration.matrix import first_setting, matrix_slopes, of_matrix
from walop_jax.diagnosis import thresholds
from walop_jax.diagnosis.class_product import Answer, OpenQuestion, WeightedChanges, changes_in, distinct
from walop_jax.diagnosis.exact import amplitude_positions, beyond_prior, context_of, prior_width, signature
from walop_jax.diagnosis.examination import Examination, follow_physics
from walop_jax.diagnosis.hypotheses import texts_of
from walop_jax.diagnosis.score import FAINTEST, best_scale, log_bayes
from walop_jax.diagnosis.synonyms import ALIKE
from walop_jax.diagnosis.undetected_errors import usual_exposure
from walop_jax.fit.refit import PRIOR_EDGE
from walop_jax.io.shapes import AnyMatrix, AnyVector
from walop_jax.likelihood.starlight import added_to_starlight
from walop_jax.model.effects import Described
from walop_jax.model.effects.change import KINDS, Change, InExposures, patched
from walop_jax.model.effects.in_models import effects_of
from walop_jax.model.effects.optics import GENERATORS

_STANDARDS = "kind standard"
"""The factor of a change in exposures of standards alone."""
MOST_ASKED, MOST_MEMBERS = 64, 12  # of a class: candidates, and members with different effects on stars
MOST_CHANGES = 400
"""Changes in the members of a class beside the addition, so that the optics of its product can be compiled. Six members
that are smooth fields of all kinds of optics would have 1400."""


def classes_of(
    laid: LinearisedFit, added: Mapping[str, Collection[str]], given: Collection[str] = ()
) -> tuple[OpenQuestion, ...]:
    """The classes of what was added to a model, without those of a single member.

    `added` are effects and groups of descriptions, by name, each with the candidates reported as indistinguishable from
    it: with large residuals, where one linear step is inaccurate, these count as probable. `given` are descriptions
    that the model had before.
    """
    fit, model, design = laid.fit, laid.fit.model, laid.design
    groups, classes = [name for name in added if name not in model.effect_names], list[OpenQuestion]()
    for effect in effects_of(model):
        at = design.columns_of(model.positions(effect.name))
        if effect.name in added and not effect.kind.is_structural() and len(at):
            change, sums = signature(fit, effect.name), tuple(map(tuple, effect.first_order(model.template)))
            classes.append(laid.class_of(effect.name, at, change, sums, added[effect.name], frozenset()))
        for name, group in _groups(effect, groups, given) if groups and isinstance(effect, Described) else ():
            descriptions = [Change.parsed(text) for text in group]
            at = design.columns_of(
                [model.index(f"{Described.name}.{description.label}") for description in descriptions]
            )
            if len(at):
                change = -design.jacobian[: design.rows, at] @ fit.values[model.free[at]]
                sums = tuple(((1.0, description),) for description in descriptions)
                whole = frozenset((*name.split("; "), *group))
                called = "; ".join(dict.fromkeys(item.candidate for item in descriptions))
                classes.append(laid.class_of(called, at, change, sums, added.get(name, ()), whole))
    return tuple(group for group in classes if group.names)


def _groups(
    effect: Described, groups: Sequence[str], given: Collection[str]
) -> Iterator[tuple[str, tuple[str, ...]]]:
    """The groups of descriptions that were added, each with its name; one without a group is a group of its own."""
    ungrouped = [text for text in effect.sentences if text not in given]
    for name in groups:
        said = name.split("; ")
        group = tuple(text for text in ungrouped if text in said or Change.parsed(text).candidate in said)
        ungrouped = [text for text in ungrouped if text not in group]
        if group:
            yield name, group
    yield from ((text, (text,)) for text in ungrouped)


class LinearisedFit:
    """An examination laid out for one linear step from model to model.

    No amplitude of a plausible member is more than `largest` prior widths.
    """

    def __init__(self, state: Examination) -> None:
        self.state, self.fit, self.design = state, state.result, state.design
        calset, model = self.fit.calset, self.fit.model
        self.template = model.template
        self.columns = self.design.columns
        self.usual = usual_exposure(calset, self.template)
        self._added: dict[WeightedChanges, Float[np.ndarray, "p k 3"]] = {}
        self.amplitudes = [i for name in model.effect_names for i in amplitude_positions(model, name)]
        far = (beyond_prior(self.fit, name).values() for name in model.effect_names)
        self.largest = PRIOR_EDGE * max(itertools.chain((1.0,), *far))
        self._vectors: Float[np.ndarray, "p k 3"] | None = None
        instrument = model.instrument(self.fit.values)
        setting = first_setting(calset, instrument, self.usual)
        at = setting, calset.filters, calset.points.x, calset.points.y
        matrix, slopes = matrix_slopes(instrument, *at)
        self.matrix = matrix.reshape(len(matrix), -1)
        self.slopes = slopes.reshape(*self.matrix.shape, -1) @ model.selection()
        self.covariance = self.fit.covariance[np.ix_(model.free, model.free)]
        self.errors = np.sqrt(np.einsum("pmf,fg,pmg->pm", self.slopes, self.covariance, self.slopes))

    def added(
        self, sums: Sequence[WeightedChanges]
    ) -> tuple[Float[np.ndarray, "p k 3"], Float[np.ndarray, "p k 3 a"]]:
        """Analysis vectors of a star at the field points, and their derivatives with respect to each amplitude."""
        missing = [amplitude for amplitude in dict.fromkeys(sums) if amplitude not in self._added]
        if missing or self._vectors is None:
            self._vectors, new = added_to_starlight(self.columns, missing, self.usual)
            self._added |= dict(zip(missing, np.moveaxis(new, -1, 0), strict=True))
        changes = [self._added[amplitude] for amplitude in sums]
        return self._vectors, np.stack(changes, axis=-1) if changes else np.zeros((*self._vectors.shape, 0))

    @functools.cached_property
    def nothing_removed(self) -> LinearStep:
        """The linear step from the fit to the same model with further amplitudes."""
        return LinearStep(self, np.zeros(0, int), np.zeros(self.design.rows))

    def class_of(
        self,
        name: str,
        at: Int[np.ndarray, " a"],
        lost: AnyVector,
        sums: tuple[WeightedChanges, ...],
        alike: Collection[str],
        whole: frozenset[str],
    ) -> OpenQuestion:
        """Class of the addition with the amplitudes `at`; without it the residuals change by `lost`.

        `alike` are candidates reported as indistinguishable from it: probable, if their amplitudes are plausible.
        `whole` is the group of descriptions that was added, of which the addition is the part that remains; it is empty
        for an effect with a name.
        """
        step = LinearStep(self, at, lost)
        addition, widths = step.addition(name, sums)
        best, rivals = step.candidates(addition, alike, whole)
        rivals += step.smooth_fields(addition, best, whole)
        # Exact fits chose the addition: where it is less probable by one linear step, the step is inaccurate.
        by_step, members = [addition, *(member for member, _ in rivals)], [addition._replace(evidence=best)]
        for member, is_alike in rivals:
            evidence = self.raised(member.evidence, best) if is_alike else member.evidence
            members.append(member._replace(evidence=evidence))
        groups = self.distinct(members)
        both = [members[group[0]] for group in groups]
        if whole and (same := step.on_stars_as_well(addition)) is not None:
            both.append(same._replace(evidence=best))
        # Equivalent members count once: the counterpart in other KINDs is sought for one member of each group.
        for group in groups:
            twins = (step.in_other_kinds(by_step[i], None if i else widths) for i in group)
            if (twin := next(filter(None, twins), None)) is not None:
                both.append(twin._replace(evidence=members[group[0]].evidence + twin.evidence))
        chosen = [both[group[0]] for group in self.distinct(both)][:MOST_MEMBERS]
        chosen = [member for member in chosen if member.evidence > best - thresholds.IMPROBABLE]
        changes = itertools.accumulate((len(changes_in(member.sums)) for member in chosen[1:]), initial=0)
        chosen = [member for member, so_far in zip(chosen, changes, strict=True) if so_far <= MOST_CHANGES]
        weights = special.softmax([member.evidence for member in chosen])
        chosen = [
            member._replace(probability=float(weight)) for member, weight in zip(chosen, weights, strict=True)
        ]
        return OpenQuestion(name, at, tuple(chosen), *self._spread(chosen))

    def distinct(self, members: Sequence[Answer]) -> list[list[int]]:
        """Groups of members that change the matrix alike: that of the first member, then the most probable first."""
        evidence = np.array([np.inf, *(member.evidence for member in members[1:])])
        return distinct(evidence, np.stack([member.change for member in members]), self.errors, ALIKE)

    def raised(self, evidence: float, best: float) -> float:
        """The evidence of a candidate that is reported as indistinguishable, within the error of a linear step.

        With large residuals that error is unknown, and the candidate is taken to be as probable as the best one.
        """
        if self.state.scatter > 1.0:
            return best
        return min(best, evidence + max(thresholds.LINEAR_GOOD, thresholds.LINEAR * abs(best)))

    def _spread(self, members: Sequence[Answer]) -> tuple[float, float, float]:
        """Error of p of stars between members, error of the fit, and largest deviation of a member (`OpenQuestion`)."""
        weights = np.array([member.probability for member in members])
        away = np.stack([member.change for member in members])
        away = away - np.tensordot(weights, away, 1)
        between = np.einsum("k,kpi,kpj->pij", weights, away, away)
        total = np.sqrt(self.errors**2 + np.diagonal(between, axis1=1, axis2=2))
        far = np.median(np.abs(away) / np.where(total > 0, total, np.inf), axis=1).max(axis=1)
        off = float(far[weights > 1.0 - thresholds.CERTAIN].max(initial=0.0))
        return self.error_of_p(between), self.stated, off

    @functools.cached_property
    def stated(self) -> float:
        """Error of p of stars from the covariance of the fit."""
        return self.error_of_p(self.slopes @ self.covariance @ np.swapaxes(self.slopes, 1, 2))

    def error_of_p(self, square: Float[np.ndarray, "p m m"]) -> float:
        """Error of p of stars from a covariance of the matrix: median over the field."""
        if self.matrix.shape[1] == 6:
            good = measures_u(self.matrix.reshape(-1, 2, 3))
            errors = p_errors(self.matrix[good], square[good], sample_stars())
        else:  # no single exposure gives q and u
            errors = np.sqrt(np.diagonal(square, axis1=1, axis2=2).max(axis=1, initial=0.0))
        return float(np.median(errors)) if errors.size else 0.0


class LinearStep:
    """One linear step from the fit to a model without some amplitudes and with others."""

    def __init__(self, laid: LinearisedFit, at: Int[np.ndarray, " a"], lost: AnyVector) -> None:
        self.laid, self.at = laid, at
        design = laid.design
        self.lost = np.pad(lost, (0, len(design.residual) - len(lost)))
        self.rest = np.delete(np.arange(design.jacobian.shape[1]), at)
        self.projector, self.basis = design.without(at)
        self.left = self.projector(design.residual + self.lost)

    def addition(self, name: str, sums: tuple[WeightedChanges, ...]) -> tuple[Answer, AnyVector]:
        """The addition itself as a member, with its fitted values, and its prior widths."""
        fit, design, scatter = self.laid.fit, self.laid.design, self.laid.state.scatter
        positions = fit.model.free[self.at]
        column = design.jacobian[:, self.at]
        column[design.rows :] = 0.0  # without its prior, which enters through the widths
        projected = self.projector(column)
        parameters = [fit.model.parameters[i] for i in positions.tolist()]
        widths = np.array([prior_width(parameter) for parameter in parameters])
        evidence = log_bayes(projected.T @ projected, projected.T @ self.left, widths) / scatter**2
        return Answer(name, evidence, sums, np.zeros_like(self.laid.matrix)), widths

    def candidates(
        self, addition: Answer, alike: Collection[str], whole: frozenset[str]
    ) -> tuple[float, list[tuple[Answer, bool]]]:
        """The best evidence, and candidates not improbable relative to it; `alike` and `whole` as in `class_of`.

        Each candidate comes with True if it is among `alike`. A change that the model has already is no candidate for
        the place of the addition. If the addition is what remains of a group, its other descriptions dropped,
        the evidence of the whole group is compared with that of other groups; the group itself is then no member.
        """
        state, design, texts = self.laid.state, self.laid.design, _texts(addition.sums)
        gram, scores = state.space_beside(self.basis)[1].gram, design.products(state.columns, self.left)
        places, scored = state.bare.places(), []
        for probe in state.asked:
            at = places[probe.name]
            square = gram[at, at]
            if np.max(np.diag(square) * probe.widths**2, initial=0.0) < FAINTEST**2:
                continue
            evidence = log_bayes(square, scores[at], probe.widths) / state.scatter**2
            scored.append((evidence, bool({probe.name, probe.effect.name} & set(alike)), probe))
        scored.sort(key=lambda item: -item[0])
        groups = [item for item in scored if item[2].effect is Described]
        larger = [evidence for evidence, _, probe in groups if set(texts_of(probe)) > texts and whole]
        best = max([min([addition.evidence, *larger[:1]]), *(evidence for evidence, *_ in scored[:1])])
        least, chosen = best - thresholds.IMPROBABLE, []
        for evidence, close, probe in scored:
            if len(chosen) == MOST_ASKED or (evidence <= least and not close):
                continue
            at = places[probe.name]
            covariance = np.linalg.inv(gram[at, at] + np.diag(probe.widths**-2.0))
            amplitudes = -covariance @ scores[at]
            close = close and bool(np.abs(amplitudes / probe.widths).max() <= self.laid.largest)
            likely = (self.laid.raised(evidence, best) if close else evidence) > least
            if not likely or not follow_physics(probe, amplitudes, covariance):
                continue
            sums = tuple(
                tuple(total) for member in probe.group for total in member.first_order(self.laid.template)
            )
            # The addition is among the candidates, by itself or as a whole: it is no further member.
            own = _texts(sums) in (texts, whole)
            if len(sums) == len(probe.widths) and not own and self._can_be_said(sums):
                chosen.append((probe, evidence, close, sums))
        self.laid.added([total for *_, sums in chosen for total in sums])  # all of them in one go
        members = []
        for probe, evidence, close, sums in chosen:
            column = design.stacked([state.candidates[probe.name].columns])
            members.append((self.member(probe.name, sums, column, probe.widths, evidence), close))
        return best, members

    def smooth_fields(
        self, addition: Answer, best: float, whole: frozenset[str]
    ) -> list[tuple[Answer, bool]]:
        """Members of the class of a smooth field: others that would not be improbable in its place.

        Each comes with True, as one of `alike` in `candidates`. Once the addition is out of the model, the Gram matrix
        of a field is the one beside the addition plus the products of its columns with the basis of the addition.
        """
        texts = (*_texts(addition.sums), *whole)
        names = {Change.parsed(text).candidate for text in texts if " * field " in text}
        smooth, design = self.laid.state.smooth if names else None, self.laid.design
        if smooth is None:
            return []
        along, disturbances = smooth.products(self.basis), smooth.bases[1]
        # Behind what single exposures take up, as the Gram matrices are.
        left = self.left - disturbances @ (disturbances.T @ self.left)
        scores = smooth.products(left[:, None])[:, 0]
        laid = dict[str, tuple[AnyMatrix, AnyVector, AnyVector]]()  # Gram matrix, scores, prior widths
        for (name, at), gram in zip(smooth.places.items(), smooth.grams, strict=True):
            laid[name] = gram + along[at] @ along[at].T, scores[at], smooth.widths_of(name)
        evidence = {name: log_bayes(*of) / self.laid.state.scatter**2 for name, of in laid.items()}
        own = max((value for name, value in evidence.items() if names == set(name.split("; "))), default=best)
        near = {name: value for name, value in evidence.items() if value > own - thresholds.IMPROBABLE}
        members = list[tuple[Answer, bool]]()
        for name in sorted(near, key=near.__getitem__, reverse=True)[: thresholds.MOST_CLASSES]:
            (member,) = smooth.probe(name).group
            sums = tuple(map(tuple, member.first_order(self.laid.template)))
            if names == set(name.split("; ")) or not self._can_be_said(sums):
                continue
            column = design.stacked([smooth.candidate(name).columns])
            widths = best_scale(*laid[name]) * smooth.widths_of(name)
            members.append((self.member(name, sums, column, widths, best + near[name] - own), True))
        return members

    def on_stars_as_well(self, addition: Answer) -> Answer | None:
        """The change of an addition ahead of the polariser in exposures of standards, as one of stars as well.

        None for an addition of another kind. The residuals are the same.
        """
        changes, template = addition.changes, self.laid.template
        of_standards = all(
            c.kind in GENERATORS and c.is_of_sky(template) and _STANDARDS in c.factors for c in changes
        )
        if not changes or not of_standards:
            return None

        sums = tuple(
            tuple((size, c.without(_STANDARDS)) for size, c in amplitude) for amplitude in addition.sums
        )
        if not self._can_be_said(sums):
            return None
        column = self.laid.design.stacked([self.laid.columns.of(addition.sums)])
        name = "; ".join(f"{change.text}, and of stars" for change in changes)
        return self.member(name, sums, column, self._widths(addition.sums), addition.evidence)

    def in_other_kinds(self, member: Answer, widths: AnyVector | None = None) -> Answer | None:
        """The counterpart of a member that acts in some KINDs of exposures alone: in all others, with the other sign.

        A span of time that holds all exposures of some KINDs, and no others, may be these KINDs. None for a member that
        is not about KINDs. The `evidence` of the counterpart is given relative to that of the member. `widths` are the
        prior widths of the member; None: those of its descriptions.
        """
        in_kinds = {description: self._kinds_of(description) for description in changes_in(member.sums)}
        kinds = {names for _, names in in_kinds.values()}
        exposures, design = self.laid.fit.calset.exposures, self.laid.design
        here = next(iter(kinds)) if len(kinds) == 1 else frozenset()
        other_kinds = [str(name) for name in np.unique(exposures.kind) if str(name) not in here]
        if not here or not other_kinds:
            return None

        def elsewhere(description: Change, other: str) -> Change:
            law, _ = in_kinds[description]
            factors = (f"kind {other}" if text == law else text for text in description.factors)
            return dataclasses.replace(description, factors=tuple(factors))

        sums = tuple(
            tuple(
                (-size, elsewhere(description, new)) for size, description in amplitude for new in other_kinds
            )
            for amplitude in member.sums
        )
        if not self._can_be_said(sums):
            return None
        column = design.stacked([self.laid.columns.of(sums)])
        widths = self._widths(sums) if widths is None else widths
        name = "; ".join(description.text for description in changes_in(sums))
        twin = self.member(name, sums, column, widths)
        # It is the same difference between KINDs, told from the other side: as probable, whatever the throughputs are.
        alike = max(thresholds.CERTAIN_ODDS, thresholds.LINEAR * abs(member.evidence))
        near = abs(twin.evidence - member.evidence) < alike
        return twin._replace(evidence=0.0 if near else twin.evidence - member.evidence)

    def _kinds_of(self, change: Change) -> tuple[str, frozenset[str]]:
        """The factor by which a change acts in exposures of some KINDs and in no others, and these KINDs.

        Both are empty for a change without such a factor.
        """
        exposures, kind = InExposures(self.laid.columns.exposures), self.laid.fit.calset.exposures.kind
        for law in change.grows_with:
            if law.form in ("kind", "hours"):
                inside = np.asarray(law.value(exposures, change.units)) > 0.0
                names = frozenset(map(str, kind[inside]))
                if np.array_equal(inside, np.isin(kind, sorted(names))):
                    return law.text, names
        return "", frozenset()

    def member(
        self,
        name: str,
        sums: tuple[WeightedChanges, ...],
        column: AnyMatrix,
        widths: AnyVector,
        evidence: float | None = None,
    ) -> Answer:
        """The member with the amplitudes `sums` in the place of the addition, at the minimum of that model.

        `evidence`, if it is given, replaces the evidence of the linear step.
        """
        laid, projected = self.laid, self.projector(column)
        square, along = projected.T @ projected, projected.T @ self.left
        if evidence is None:
            evidence = log_bayes(square, along, widths) / laid.state.scatter**2
        covariance = np.linalg.inv(square + np.diag(widths**-2.0))
        amplitudes = -covariance @ along
        count = len(laid.fit.model.free)
        values, slopes = np.zeros(count), np.zeros((count, len(widths)))
        change = np.column_stack([self.lost + column @ amplitudes, column])
        moved = -self.projector.taken_up(self.projector.basis.T @ change)
        values[self.rest], slopes[self.rest] = moved[:, 0], moved[:, 1:]
        at = laid.fit.model.free[self.at]
        values[self.at] = -laid.fit.values[at] * np.isin(at, laid.amplitudes)  # not of shapes: these stay
        vectors, added = laid.added(sums)
        change = of_matrix(vectors, added @ amplitudes, laid.template.cameras.pairs)
        change = change.reshape(laid.matrix.shape) + laid.slopes @ values
        return Answer(name, evidence, sums, change, amplitudes, covariance, values, slopes)

    def _widths(self, sums: Sequence[WeightedChanges]) -> AnyVector:
        """Prior widths of amplitudes, each that of its first change."""
        largest = context_of(self.laid.fit).largest
        return np.array([amplitude[0][1].width(largest) for amplitude in sums])

    def _can_be_said(self, sums: Sequence[WeightedChanges]) -> bool:
        """True if a model can include all descriptions."""
        descriptions = changes_in(sums)
        stated = {text for effect in effects_of(self.laid.fit.model) for text in effect.stated}
        if not all(map(self.laid.columns.has, sums)) or not all(
            s.kind in KINDS and all(isinstance(f, str) for f in s.factors) and s.text not in stated
            for s in descriptions
        ):
            return False
        bare = dataclasses.replace(self.laid.template, effects=())
        try:
            patched(bare, [(description, jnp.zeros(())) for description in descriptions])
        except ValueError:
            return False
        return True


def _texts(sums: Sequence[WeightedChanges]) -> set[str]:
    """The descriptions of some amplitudes."""
    return {description.text for description in changes_in(sums)}
