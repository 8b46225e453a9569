"""Scores of changes that vary over the field in any smooth way: one candidate for each place and law.

A smooth field f(X, Y) is a Gaussian process, expanded in Legendre polynomials to the sixth degree, of cameras to the
eighth. The terms become less probable with their degree (`model.effects.factors.smooth_deviations`). Columns are not
written out: the column of a term is that of the same change without a pattern, times the values of the term at the
field points.

Equation    C_{cf} = c F_f,   C_{cf}ᵀ V = Σ_p F_pf (c_pᵀ V_p)
            and behind the free parameters and the disturbances of single exposures G = CᵀC − (CᵀB)(CᵀB)ᵀ, s = CᵀPr
Symbols     c column of a change without a pattern over the field, c_p its rows of the field point p; F_pf value of the
            term f there; V any columns of rows; B = [Q, Z], Q an orthonormal basis of the derivatives by the
            free parameters, Z Zᵀ the part that single exposures take up (`examination.common_mode`); P = 1 − BBᵀ;
            r residuals
Limits      Ghosts of the model, 10⁻³ of the light, carry the pattern of the field point at which they are seen, and not
            that of the opposite one, from which they come. A fit has them exactly.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np
from jaxtyping import Float

from walop_jax.diagnosis.design import Design
from walop_jax.diagnosis.hypotheses import Probe, Ranked, SmoothField
from walop_jax.diagnosis.score import ABSORBED, FAINTEST, Candidate, ScoreSpace, ScoreTable, best_scale
from walop_jax.io.shapes import AnyMatrix, AnyVector
from walop_jax.model import legendre
from walop_jax.model.effects import Context
from walop_jax.model.effects.factors import FINEST_DEGREE, smooth_deviations

TOGETHER = 4_000_000  # products of columns at single field points that are held at once: 32 MB


@dataclasses.dataclass(frozen=True, eq=False)
class SmoothFields:
    """The smooth fields that a fit may lack, with their products behind the free parameters.

    `bases` are Q and Z (module docstring), by rows of data and priors, `synonyms` other names of candidates.
    """

    design: Design
    fields: Sequence[SmoothField]
    context: Context
    bases: tuple[AnyMatrix, AnyMatrix]
    synonyms: Mapping[str, tuple[str, ...]] = dataclasses.field(default_factory=dict)

    def behind(self, columns: Float[np.ndarray, "d n"]) -> Float[np.ndarray, "d n"]:
        """What neither the free parameters nor the disturbances of single exposures take up of columns, by rows."""
        rows = [basis[: len(columns)] for basis in self.bases]
        taken = [basis.T @ columns for basis in rows]
        return columns - sum(
            (basis @ along for basis, along in zip(rows, taken, strict=True)), np.zeros_like(columns)
        )

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the candidates."""
        return tuple(field.name for field in self.fields)

    @cached_property
    def _number(self) -> dict[str, int]:
        return {name: number for number, name in enumerate(self.names)}

    @cached_property
    def sizes(self) -> tuple[int, ...]:
        """Number of amplitudes of each."""
        return tuple(len(field.changes) * len(field.terms) for field in self.fields)

    @cached_property
    def places(self) -> dict[str, slice]:
        """Slices of the amplitudes, by candidate."""
        stops = np.cumsum(self.sizes).tolist()
        return {n: slice(b - k, b) for n, k, b in zip(self.names, self.sizes, stops, strict=True)}

    @cached_property
    def widths(self) -> AnyVector:
        """Prior widths of all amplitudes, one candidate after the other; those that data cannot show have 0."""
        widths = np.concatenate([self.widths_of(name) for name in self.names])
        after = np.concatenate([np.diag(gram) for gram in self.grams])
        before = np.concatenate(self._squares)
        shown = (after > ABSORBED * before) & (np.sqrt(np.clip(after, 0.0, None)) * widths > FAINTEST)
        return np.where(shown, widths, 0.0)

    def widths_of(self, name: str) -> AnyVector:
        """Prior widths of the amplitudes of one candidate, whatever the data can show."""
        field = self.fields[self._number[name]]
        return np.repeat([change.width(self.context.largest) for change in field.changes], len(field.terms))

    @cached_property
    def scores(self) -> AnyVector:
        """CᵀPr of all amplitudes."""
        return self.products(self.behind(self.design.residual[:, None]))[:, 0]

    @property
    def grams(self) -> list[AnyMatrix]:
        """The Gram matrix of each candidate, behind the free parameters and the disturbances of single exposures."""
        return self._grams_and_squares[0]

    def products(self, rows: Float[np.ndarray, "d n"]) -> Float[np.ndarray, "a n"]:
        """CᵀV of all amplitudes with any columns V, of which only the rows of data count."""
        sums = self._sums(rows)
        return np.concatenate([self._of_field(sums, number) for number in range(len(self.fields))])

    def columns(self, name: str) -> AnyMatrix:
        """The columns of one candidate, rows of data in units of the noise."""
        number = self._number[name]
        of_changes = self._columns[:, self._of[number]].astype(float)
        terms = self._terms[self.design.point, : len(self.fields[number].terms)]
        return (of_changes[:, :, None] * terms[:, None, :]).reshape(len(terms), -1)

    def candidate(self, name: str) -> Candidate:
        """One of them with the columns that a fit would have: exact derivatives at the fit."""
        probe = self.probe(name)
        (member,) = probe.group
        columns = self.design.columns.of(member.first_order(self.design.fit.model.template))
        return Candidate(name, columns, probe.widths)

    def probe(self, name: str) -> Probe:
        """One of them as a description of the grammar."""
        return self.fields[self._number[name]].probe(self.context)

    def ranked(self, name: str, noise: float) -> Ranked:
        """One of them with its score, as a candidate that can be fitted; `noise` is the scatter of the residuals.

        Between the points a field is as large as its prior says. How large the field is as a whole the data know: it is
        fitted with the most probable of the `SCALES` of the prior.
        """
        number = self._number[name]
        scores, gram = self.scores[self.places[name]], self.grams[number]
        probe, free, before = self.probe(name), self.design.projector.free, self._squares[number]
        space = ScoreSpace((name,), (self.sizes[number],), probe.widths, before, gram, free)
        score = space.table_after(ScoreTable((), noise, 1.0, 1.0), scores)[name]
        information, pull = gram / noise**2, scores / noise**2
        scale = best_scale(information, pull, probe.widths)
        covariance = np.linalg.inv(information + np.diag((scale * probe.widths) ** -2.0))
        score = dataclasses.replace(score, amplitudes=-covariance @ pull, covariance=covariance)
        return Ranked(probe, score, score.log_bayes, scale=scale)

    # ------------------------------------------------------------------------------------------------ the columns

    @cached_property
    def _place(self) -> dict[str, int]:
        """Numbers of the distinct changes without a pattern over the field, by their texts."""
        texts = dict.fromkeys(change.text for field in self.fields for change in field.changes)
        return {text: number for number, text in enumerate(texts)}

    @cached_property
    def _of(self) -> list[list[int]]:
        """Numbers of the changes of each candidate."""
        return [[self._place[change.text] for change in field.changes] for field in self.fields]

    @cached_property
    def _columns(self) -> Float[np.ndarray, "d c"]:
        """Columns of the distinct changes, without a pattern over the field, in units of the noise."""
        distinct = {change.text: change for field in self.fields for change in field.changes}
        _, columns = self.design.columns.rounded([[(1.0, change)] for change in distinct.values()], 0)
        return columns / np.float32(self.design.fit.noise_scale)

    @cached_property
    def _terms(self) -> Float[np.ndarray, "p f"]:
        """Values of the terms of a smooth field at the field points, times their standard deviations."""
        points, units = self.design.fit.calset.points, self.design.fit.model.template.units
        sigma = np.array(
            [smooth_deviations()[i] * smooth_deviations()[j] for i, j in legendre.terms(FINEST_DEGREE)]
        )
        return np.asarray(legendre.basis(points.x, points.y, FINEST_DEGREE, units.field)) * sigma

    @cached_property
    def _rows_of_points(self) -> list[slice]:
        """Rows of data of every field point; those of a point lie together."""
        ends = np.cumsum(
            np.bincount(self.design.point, minlength=len(self.design.fit.calset.points))
        ).tolist()
        return [slice(first, stop) for first, stop in zip([0, *ends], ends, strict=False)]

    def _sums(self, rows: Float[np.ndarray, "d n"]) -> Float[np.ndarray, "f c n"]:
        """Σ_p F_pf c_pᵀ V_p of all terms f and distinct changes c."""
        points, count = self._terms.shape
        changes, columns = len(self._place), rows.shape[1]
        sums = np.empty((count, changes, columns))
        size = max(1, TOGETHER // max(1, points * columns))
        for first in range(0, changes, size):
            some = slice(first, first + size)
            of_points = np.stack([self._columns[at, some].T @ rows[at] for at in self._rows_of_points])
            of_terms = self._terms.T @ of_points.reshape(points, -1)
            sums[:, some] = of_terms.reshape(count, *of_points.shape[1:])
        return sums

    def _of_field(self, sums: Float[np.ndarray, "f c n"], number: int) -> Float[np.ndarray, "a n"]:
        """The sums of one candidate: its changes one after the other, of each all terms."""
        of_changes = sums[: len(self.fields[number].terms), self._of[number]].swapaxes(0, 1)
        return of_changes.reshape(self.sizes[number], sums.shape[2])

    @property
    def _squares(self) -> list[AnyVector]:
        """Squares of the columns of each candidate, ahead of any projection."""
        return self._grams_and_squares[1]

    @cached_property
    def _grams_and_squares(self) -> tuple[list[AnyMatrix], list[AnyVector]]:
        """The Gram matrices behind the bases, and their diagonals ahead of any projection."""
        grams, squares = list[AnyMatrix](), list[AnyVector]()
        of_pairs = {
            count: np.einsum("pf,pg->pfg", *[self._terms[:, :count]] * 2).reshape(len(self._terms), -1)
            for count in {len(field.terms) for field in self.fields}
        }
        taken = [self._sums(basis) for basis in self.bases]
        for number, (field, places) in enumerate(zip(self.fields, self._of, strict=True)):
            count, own = len(field.terms), np.ascontiguousarray(self._columns[:, places], float)
            of_points = np.stack([own[at].T @ own[at] for at in self._rows_of_points])
            gram = of_points.reshape(len(of_points), -1).T @ of_pairs[count]
            gram = gram.reshape(*of_points.shape[1:], count, count).transpose(0, 2, 1, 3)
            gram = gram.reshape(len(places) * count, -1)
            squares.append(np.diag(gram).copy())
            for sums in taken:
                along = self._of_field(sums, number)
                gram -= along @ along.T
            grams.append(gram)
        return grams, squares
