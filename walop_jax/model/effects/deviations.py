"""Deviations of missing physics from its description, at the same places.

Never a candidate: products of a diagnosis include them, with a covariance, where an addition has no name
(`diagnosis.class_members`). A fit of other data leaves them out.

Equation    M → M_Δ M_R M_D M of `optics`, each of the nine components of r, d, k being g Σ_p c_p f_p(x, y); other
            changes as in `change`
Symbols     f_p products of the factors x, y, r2, x2-y2, xy: all polynomials to the third degree; g the dependence on
            temperature, hour angle or wavelength that a place has (none: 1)
Source      Lu & Chipman 1996, JOSA A 13, 1106: every Mueller matrix near the identity is such a product
Neutral     all zero
Revealed by nothing: data that show them would have given another description
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any, ClassVar, Self

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from walop_jax.model.effects.base import Context, Effect
from walop_jax.model.effects.change import AtPoint, Change, patched, product
from walop_jax.model.effects.optics import GENERATORS, SOURCE, beside, near_identity
from walop_jax.model.elements.base import Element, Mueller
from walop_jax.model.instrument import Instrument
from walop_jax.model.parameters import param
from walop_jax.model.ray import Ray

CUBIC: tuple[tuple[str, ...], ...] = (
    (), ("x",), ("y",), ("r2",), ("x2-y2",), ("xy",), ("x", "r2"), ("y", "r2"), ("x", "x2-y2"), ("y", "x2-y2"),
)  # fmt: skip
"""All polynomials over the field to the third degree, as products of factors."""


class Polynomials(Element):
    """A change of polarisation with a polynomial over the field for each generator, times the factors of a place."""

    sizes: Float[Array, "g p"] | float = 0.0
    axis: Float[Array, ""] | float = 0.0
    of: Change | None = eqx.field(static=True, default=None)

    kind: ClassVar[str] = "deviations"

    def mueller(self, ray: Ray) -> Mueller:
        """Mueller matrices at the wavelengths of a ray: diattenuation, then retardance, then depolarisation."""
        assert self.of is not None
        at = AtPoint(ray.x, ray.y)
        basis = jnp.stack([product(names, at, self.of.units) + 0.0 * ray.x for names in CUBIC], axis=-1)
        components = jnp.moveaxis(basis @ jnp.asarray(self.sizes).T, -1, 0)
        factor = self.of.in_train(ray, self.axis)
        return near_identity({name: size * factor for name, size in zip(GENERATORS, components, strict=True)})


class Deviations(Effect):
    """Deviations from descriptions: any change of polarisation at some places, cubic over the field; other changes."""

    sizes: Float[Array, "a g p"] = param(
        "", "share, or retardance in rad", f"{SOURCE}; width: expected size", width=0.003
    )
    amounts: Float[Array, " n"] = param(
        "", "amplitude of another change", f"{SOURCE}; width: that of its kind", width=1.0
    )
    places: tuple[str, ...] = eqx.field(static=True, default=(), converter=tuple)
    sentences: tuple[str, ...] = eqx.field(static=True, default=(), converter=tuple)

    name: ClassVar[str] = "deviations"
    unlisted: ClassVar[str] = "changes of polarisation that the data would not show"
    starts = ()
    reference: ClassVar[str] = SOURCE
    revealed_by: ClassVar[str] = "nothing: data that show them would have given another description"

    @classmethod
    def neutral(cls, context: Context) -> Self:
        """The effect without any deviation."""
        return cls.of(context)

    @classmethod
    def of(cls, context: Context, **values: Any) -> Self:
        """Deviations at some `places` (relation, element, factors), and of other changes; 0 unless given.

        Raises ValueError for an unknown parameter.
        """
        places, sentences = (tuple(values.pop(name, ())) for name in ("places", "sentences"))
        sizes = jnp.zeros((len(places), len(GENERATORS), len(CUBIC)))
        none = cls(sizes=sizes, amounts=jnp.zeros(len(sentences)), places=places, sentences=sentences)
        return none.given(context, **values)

    def labels(self, field: str) -> Sequence[str]:
        """Names of the elements of a parameter: its descriptions without blanks."""
        if field == "amounts":
            return [Change.parsed(text).label for text in self.sentences]
        changes = map(_at, self.places)
        return [
            dataclasses.replace(change, kind=kind, factors=(*names, *change.factors)).label
            for change, kind, names in itertools.product(changes, GENERATORS, CUBIC)
        ]

    def patch(self, instrument: Instrument) -> Instrument:
        """One more element at every place, and the other changes.

        Raises ValueError for the polariser, through which no star is seen.
        """
        for sizes, text in zip(self.sizes, self.places, strict=True):
            change = _at(text).counted_in(instrument.units)
            if instrument.polariser is not None and text.startswith(f"of {instrument.polariser.name}"):
                raise ValueError(f"deviations {text!r}: the light of stars does not pass the polariser")
            moves = instrument.element(change.place).moves if change.relation == "of" else None
            element = Polynomials(name=self.name, moves=moves, sizes=sizes, of=change)
            instrument = beside(instrument, element, change.relation, change.place)
        return patched(instrument, zip(map(Change.parsed, self.sentences), self.amounts, strict=True))


def _at(place: str) -> Change:
    """A change at a place with its factors, of any kind."""
    return Change.parsed(f"{GENERATORS[0]} {place}")
