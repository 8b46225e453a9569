"""Changes of what is looked at: the polarisation of the Moon sky, and of a standard star."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import ClassVar

import jax.numpy as jnp

from walop_jax.model.effects.change import SKY, Change, Kind, Term
from walop_jax.model.instrument import Instrument, NoSuchPlaceError
from walop_jax.model.parameters import unknown_name
from walop_jax.model.sources import MoonPatches


class OfSource(Kind):
    """Of a star: Q + a, or U, in the equatorial frame; of the Moon sky: its degree; q or u in one exposure."""

    names: ClassVar[tuple[str, ...]] = ("polarisation q", "polarisation u", "polarisation")
    parameter: ClassVar[str] = "share"
    test: ClassVar[str] = "the same patch or star again at another ROTATOR angle"

    @classmethod
    def together(cls, change: Change) -> tuple[type[Kind], Hashable]:
        """All patches of the sky."""
        patch = change.place == SKY and change.kind != "polarisation"
        return cls, SKY if patch else change

    @classmethod
    def patch(cls, instrument: Instrument, terms: Sequence[Term]) -> Instrument:
        """Change the source."""
        change, size = terms[0]
        if change.place != SKY:
            return _of_star(instrument, terms)
        if change.kind == "polarisation":
            return instrument.changed("sky", missing=lambda p: -size if p is None else p - size)
        positions = tuple(dict.fromkeys(one.number for one, _ in terms))
        own = {axis: [jnp.zeros(())] * len(positions) for axis in "qu"}
        for one, value in terms:
            at = positions.index(one.number)
            own[one.kind[-1]][at] = own[one.kind[-1]][at] + value
        here = MoonPatches(jnp.stack(own["q"]), jnp.stack(own["u"]), positions)
        return instrument.changed("sky", patches=lambda there: here if there is None else there.joined(here))


def _of_star(instrument: Instrument, terms: Sequence[Term]) -> Instrument:
    names = [name.replace(" ", "_") for name in instrument.standard.names]
    for change, size in terms:
        axis = change.kind.removeprefix("polarisation").strip()
        if change.place not in names or not axis:
            known = [f"polarisation q of {name}" for name in names]
            raise NoSuchPlaceError(
                str(unknown_name("description", f"{change.kind} of {change.place}", known))
            )
        row = names.index(change.place)
        instrument = instrument.changed("standard", **{axis: _added(row, size)})
    return instrument


def _added(row: int, size: object) -> object:
    return lambda value: value.at[row].add(size)
