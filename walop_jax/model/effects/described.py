"""Missing physics without a name: changes (`change`), each with an amplitude; several of them are one effect.

Not in the catalogue: `diagnose` tries all possible changes of an instrument and its exposures
(`diagnosis/grammar.py`) beside the names, and adds one that explains the data better than any name.

Equation    that of each change: `optics`, `numbers`, `cameras`
Source      Lu & Chipman 1996, JOSA A 13, 1106: every Mueller matrix near the identity is a product of these
Neutral     all zero
Revealed by data without an equally good named explanation
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator, Sequence
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from walop_jax.model.alternatives import changed
from walop_jax.model.compiled import array
from walop_jax.model.effects.base import Context, Effect, Scalar
from walop_jax.model.effects.change import AMPLITUDES, Change, patched
from walop_jax.model.effects.optics import SOURCE
from walop_jax.model.instrument import Instrument
from walop_jax.model.parameters import param, unknown_name


def _amplitude(name: str) -> Any:
    unit, about, width = AMPLITUDES[name]
    return param(unit=unit, about=about, source=f"{SOURCE}; width: expected size", width=width)


@functools.lru_cache(maxsize=64)
def _zeros(count: int) -> Float[Array, " n"]:
    """Zeros, shared by the thousands of changes without a size."""
    with jax.ensure_compile_time_eval():
        return array(np.zeros(count))


class Described(Effect):
    """Descriptions of missing physics, each with an amplitude in the parameter of its unit."""

    share: Float[Array, " a"] = _amplitude("share")
    retardance: Float[Array, " b"] = _amplitude("retardance")
    angle: Float[Array, " c"] = _amplitude("angle")
    displacement: Float[Array, " f"] = _amplitude("displacement")
    length: Float[Array, " d"] = _amplitude("length")
    wavelength: Float[Array, " w"] = _amplitude("wavelength")
    number: Float[Array, " n"] = _amplitude("number")
    sentences: tuple[str, ...] = eqx.field(static=True, default=(), converter=tuple)

    name: ClassVar[str] = "described"
    starts = ()  # changes are found by `diagnosis.grammar`
    reference: ClassVar[str] = SOURCE
    revealed_by: ClassVar[str] = "data that no name explains as well"
    separated_by: ClassVar[str] = "exposures in which its dependence differs from that of the others"

    @classmethod
    def neutral(cls, context: Context) -> Self:
        """The effect without any description."""
        return cls.of(context)

    @classmethod
    def of(cls, context: Context, **values: Any) -> Self:
        """The effect with some descriptions, their amplitudes 0 unless given. Raises ValueError for an invalid
        description.
        """
        neutral: Any = _without_size(tuple(values.pop("sentences", ())))
        if unknown := sorted(set(values) - set(AMPLITUDES)):
            raise unknown_name(f"parameter of {cls.name}", unknown[0], (*AMPLITUDES, "sentences"))
        like = {name: getattr(neutral, name) for name in values}
        sizes = {n: jnp.broadcast_to(jnp.asarray(values[n], float), like[n].shape) for n in values}
        return dataclasses.replace(neutral, **sizes) if sizes else neutral

    @classmethod
    def combine(cls, group: Sequence[Any], amplitudes: Sequence[float] | Float[np.ndarray, " a"]) -> Self:
        """One effect of several members, each of which has a single change."""
        return cls.saying([text for member in group for text in member.sentences], amplitudes)

    @classmethod
    def saying(cls, sentences: Sequence[str], amplitudes: Sequence[float] | Float[np.ndarray, " a"]) -> Self:
        """Descriptions with their amplitudes, in the same order."""
        held: dict[str, list[float]] = {}
        for text, amplitude in zip(sentences, amplitudes, strict=True):
            held.setdefault(Change.parsed(text).parameter, []).append(float(amplitude))
        return cls.of(Context(), sentences=sentences, **held)

    def joined(self, other: Described) -> Described:
        """The union of both sets of changes."""
        new = [(s.text, float(a)) for s, a in other.terms() if s.text not in self.sentences]
        terms = [(s.text, float(a)) for s, a in self.terms()] + new
        return Described.saying([text for text, _ in terms], [value for _, value in terms])

    def labels(self, field: str) -> Sequence[str]:
        """The descriptions themselves, without blanks."""
        return [change.label for change in map(Change.parsed, self.sentences) if change.parameter == field]

    def prior_widths(self, context: Context) -> dict[str, float]:
        """The widths by label: every change is as large as its kind may be where its factors are largest."""
        changes = [Change.parsed(text) for text in self.sentences]
        ordered = (change for name in AMPLITUDES for change in changes if change.parameter == name)
        return {change.label: change.width(context.largest) for change in ordered}

    def terms(self) -> Iterator[tuple[Change, Scalar]]:
        """Every change with its amplitude."""
        amplitudes = {name: iter(getattr(self, name)) for name in AMPLITUDES}
        for change in map(Change.parsed, self.sentences):
            yield change, next(amplitudes[change.parameter])

    def first_order(self, instrument: Instrument) -> tuple[tuple[tuple[float, Change], ...], ...]:
        """For each amplitude its one change, with the coefficient 1."""
        changes = [Change.parsed(text) for text in self.sentences]
        return tuple(((1.0, c),) for name in AMPLITUDES for c in changes if c.parameter == name)

    def patch(self, instrument: Instrument) -> Instrument:
        """The instrument with all changes, changes at one place together."""
        return patched(instrument, self.terms())


@functools.lru_cache(maxsize=8192)
def _without_size(sentences: tuple[str, ...]) -> Described:
    """Descriptions with all amplitudes zero, made once: every list of candidates has them."""
    held = [Change.parsed(text).parameter for text in sentences]
    return Described(**{name: _zeros(held.count(name)) for name in AMPLITUDES}, sentences=sentences)


class OtherDescription(Effect):
    """The instrument differs from its description: elements in another order, turned, left out, of another crystal.

    Not in the catalogue: after a poor fit `diagnose` tries every possible change of the instrument
    (`model/alternatives.py`), and adds the one that the data demand. The description file is then to be corrected.
    `change` is its sentence; several are joined by "; ".
    """

    change: str = eqx.field(static=True, default="")

    name: ClassVar[str] = "other_description"
    reference: ClassVar[str] = (
        "conventions of signs, angles and orders that two parties understand differently"
    )
    revealed_by: ClassVar[str] = "any data that the instrument as described does not explain"
    separated_by: ClassVar[str] = (
        "field points far from the axis, several filters, the calibration plate at 22.5 deg"
    )

    def patch(self, instrument: Instrument) -> Instrument:
        """Rearrange the instrument by the change. Raises ValueError for a change without a place in it."""
        return changed(instrument, self.change)
