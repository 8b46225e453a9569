"""Deviations of missing physics from its description: any change of polarisation at a place, cubic over the field.

Never a candidate: products of a diagnosis include them, with a covariance, where what was added has no name
(`diagnosis.description_shape`).

Equation    M → M_Δ M_R M_D M of `optics`, where each of the nine components of r, d, k is Σ_p c_p f_p(x, y)
Symbols     f_p products of the factors x, y, r2, x2-y2, xy: all polynomials to the third degree
Source      Lu & Chipman 1996, JOSA A 13, 1106: every Mueller matrix near the identity is such a product
Neutral     all zero
Revealed by nothing: data that show them would have given another description
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Self

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from walop_jax.model.conventions import OF_WALOP, Units
from walop_jax.model.effects.base import Context, Effect
from walop_jax.model.effects.change import AtPoint, Change, product
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
    """A change of polarisation with a polynomial over the field for each generator."""

    sizes: Float[Array, "g p"] | float = 0.0
    axis: Float[Array, ""] | float = 0.0
    units: Units = eqx.field(static=True, default=OF_WALOP)

    kind: ClassVar[str] = "deviations"

    def mueller(self, ray: Ray) -> Mueller:
        """Diattenuation, then retardance, then depolarisation."""
        at = AtPoint(ray.x, ray.y)
        basis = jnp.stack([product(names, at, self.units) + 0.0 * ray.x for names in CUBIC], axis=-1)
        return near_identity(
            dict(zip(GENERATORS, jnp.moveaxis(basis @ jnp.asarray(self.sizes).T, -1, 0), strict=True))
        )


class Deviations(Effect):
    """Deviations from descriptions: any change of polarisation at some places, cubic over the field."""

    sizes: Float[Array, "a g p"] = param(
        unit="", about="share, or retardance in rad", source=f"{SOURCE}; width: expected size", width=0.003
    )
    places: tuple[str, ...] = eqx.field(static=True, default=(), converter=tuple)

    name: ClassVar[str] = "deviations"
    starts = ()
    reference: ClassVar[str] = SOURCE
    revealed_by: ClassVar[str] = "nothing: data that show them would have given another description"

    @classmethod
    def neutral(cls, context: Context) -> Self:
        """None."""
        return cls.of(context)

    @classmethod
    def of(cls, context: Context, **values: Any) -> Self:
        """Those of some `places`, each a preposition and an element, with their `sizes` (zero by default)."""
        places = tuple(values.get("places", ()))
        shape = (len(places), len(GENERATORS), len(CUBIC))
        return cls(sizes=jnp.broadcast_to(jnp.asarray(values.get("sizes", 0.0), float), shape), places=places)

    def labels(self, field: str) -> Sequence[str]:
        """Place, generator and pattern, as in a description without blanks."""
        return [
            Change(kind, *_parted(place), names).label
            for place in self.places
            for kind in GENERATORS
            for names in CUBIC
        ]

    def patch(self, instrument: Instrument) -> Instrument:
        """One more element at every place."""
        for sizes, text in zip(self.sizes, self.places, strict=True):
            where, place = _parted(text)
            moves = instrument.element(place).moves if where == "of" else None
            element = Polynomials(name=self.name, moves=moves, sizes=sizes, units=instrument.units)
            instrument = beside(instrument, element, where, place)
        return instrument


def _parted(place: str) -> tuple[str, str]:
    """Preposition and element."""
    where, _, element = place.rpartition(" ")
    return where, element
