"""One catalogue value that is wrong, or a star that varies.

Equation    (Q, U) of the star → (Q + q, U + u), equatorial frame
Symbols     q, u difference from the catalogue; source: name of the star
Source      some classical standards vary (Blinov et al. 2023, A&A 677,
            A144).
Neutral     q = u = 0
Revealed by one star that is off by the same Stokes parameters wherever in the field it stands.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Self

import equinox as eqx

from walop_jax.model.effects.base import Context, Effect, Scalar
from walop_jax.model.parameters import param, unknown_name

if TYPE_CHECKING:
    from walop_jax.model.instrument import Instrument

SOURCE = "Blinov et al. 2023, A&A 677, A144"


class StandardOutlier(Effect):
    """Stokes parameters of one standard that differ from the catalogue."""

    q: Scalar = param(unit="", about="added to the catalogue q", source=SOURCE, width=0.005, default=0.0)
    u: Scalar = param(unit="", about="added to the catalogue u", source=SOURCE, width=0.005, default=0.0)
    source: str = eqx.field(static=True, default="")

    name: ClassVar[str] = "standard_outlier"
    reference: ClassVar[str] = SOURCE
    revealed_by: ClassVar[str] = "several standards, one of which disagrees with the others"
    separated_by: ClassVar[str] = (
        "the star at several ROTATOR angles: a wrong catalogue turns with the sky, the telescope not"
    )

    @classmethod
    def neutral(cls, context: Context) -> Self:
        """The first star, as catalogued."""
        return cls(source=context.sources[0] if context.sources else "")

    @classmethod
    def probes(cls, context: Context) -> tuple[tuple[Self, ...], ...]:
        """Any one of the stars."""
        return tuple((cls(source=name),) for name in context.sources)

    def in_sentences(self, instrument: Instrument) -> tuple[str, ...]:
        """The two Stokes parameters of the star."""
        del instrument
        return tuple(f"polarisation {axis} of {self.source.replace(' ', '_')}" for axis in "qu")

    def patch(self, instrument: Instrument) -> Instrument:
        """Move the values of the star."""
        from walop_jax.model.instrument import NoSuchPlaceError

        names = instrument.standard.names
        if self.source not in names:
            raise NoSuchPlaceError(str(unknown_name("standard star", self.source, names)))
        row = names.index(self.source)
        return instrument.changed(
            "standard", q=lambda q: q.at[row].add(self.q), u=lambda u: u.at[row].add(self.u)
        )
