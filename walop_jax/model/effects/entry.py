"""Effects as values: parameters that are amplitudes of changes, described by an entry of a catalogue.

An effect is to first order Σ_p v_p Σ_i s_pi c_i over its parameters p, v their values, c changes and s the sizes of
these for one unit. A polar pair, a size and an angle, has two changes with cos and sin of the angle.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from walop_jax.model.alternatives import alternatives, changed
from walop_jax.model.conventions import EXTINCTION
from walop_jax.model.effects.base import Context, Effect, Scalar, numbered_camera
from walop_jax.model.effects.change import Change, patched, place_of_star
from walop_jax.model.elements.wave_plate import WavePlate
from walop_jax.model.instrument import Instrument
from walop_jax.model.parameters import Parameter, as_number, unknown_name

NO_STANDARD = "there is no standard star"

EVERY: Mapping[str, Callable[[Instrument], Sequence[str]]] = {
    "camera": lambda instrument: instrument.cameras.names,
    "analyser": lambda instrument: [f"{arm.name}.{arm.path[-1]}" for arm in instrument.arms],
    "wave_plate": lambda instrument: instrument.places(WavePlate),
    "standard": lambda instrument: list(map(place_of_star, instrument.standard.names)),
}
"""Places of `every`."""


class Member(NamedTuple):
    """A parameter of an entry: keys of its table in a file. The angle of a polar pair has no changes of its own.

    `turns` is the phase of cos and sin (rad) for one unit of that angle.
    """

    name: str
    declared: Parameter
    does: tuple[str, ...] = ()
    per_unit: tuple[float, ...] = ()
    said: tuple[str, ...] = ()
    each: str = ""
    polar: str = ""
    turns: float = 1.0
    is_axis: bool = False
    absolute: bool = False
    neutral: float = 0.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Entry:
    """An effect of a catalogue; `table` is its table in the file. It has the attributes of a class of effects.

    `choices` are words, or "cameras" or "stars"; `arrangement` is a change of `alternatives`. `hwp1_axis` is one: its
    parameter `angle` is the amplitude of `axis of half1.plate`.
    """

    name: str
    members: tuple[Member, ...]
    choices: tuple[tuple[str, str | tuple[str, ...]], ...]
    arrangement: str
    reference: str
    revealed_by: str
    separated_by: str
    one_sided: tuple[str, ...]
    over_field: bool
    watched: bool = False
    table: Mapping[str, Any] = dataclasses.field(compare=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "__doc__", f"{self.table['about']}.")

    def __hash__(self) -> int:
        return hash(self.name)

    def __repr__(self) -> str:
        numbers = (f"{n} [{p.unit}]" if p.unit else n for n, p in self.numbers().items())
        return f"{self.name}({', '.join(numbers)})"

    @property
    def polar(self) -> Member | None:
        """The size of its polar pair, if it has one."""
        return next((member for member in self.members if member.polar), None)

    @property
    def shape(self) -> tuple[str, ...]:
        """Names of the non-linear parameters: the angles of polar pairs."""
        return tuple(member.polar for member in self.members if member.polar)

    def numbers(self) -> dict[str, Parameter]:
        """The parameters by name, as declared."""
        return {member.name: member.declared for member in self.members}

    def amplitudes(self) -> tuple[str, ...]:
        """Names of the parameters with a linear effect at neutral."""
        return tuple(member.name for member in self.members if member.does)

    def is_structural(self) -> bool:
        """True for an effect without parameters, which is present or absent."""
        return not self.members

    def head(self) -> str:
        """Equation, symbols, source, neutral values and revealing data."""
        neutral = [f"{member.name} = {member.neutral:g}" for member in self.members if member.does]
        units = {
            name: f" [{declared.unit}]" * bool(declared.unit) for name, declared in self.numbers().items()
        }
        page = {
            "Equation": self.table.get("equation"),
            "Symbols": "; ".join(f"{n}{units[n]} {declared.about}" for n, declared in self.numbers().items()),
            "Source": self.reference,
            "Neutral": ", ".join(neutral + [f"whatever the {angle}" for angle in self.shape])
            or "none: it is there or it is not",
            "Revealed by": self.revealed_by,
            "Note": self.table.get("note"),
        }
        return "\n".join(f"{title:<12}{text}" for title, text in page.items() if text)

    def neutral(self, context: Context) -> Named:
        """The effect at neutral values, with the first of all choices."""
        labels = {
            "camera": [f"n{k}" for k in range(len(context.cameras))],
            "moon exposure": list(map(str, context.moon_ids)),
            "standard": list(map(place_of_star, context.sources)),
        }
        values = {
            member.name: as_number(
                np.full(
                    (len(labels[member.each]),) if member.each else (),
                    context.extinction if member.absolute else member.neutral,
                )
            )
            for member in self.members
        }
        first = {"cameras": 0, "stars": next(iter(context.sources), "")}
        chosen = tuple((name, first[of] if isinstance(of, str) else of[0]) for name, of in self.choices)
        several = {member.each for member in self.members if member.each}
        labelled = tuple((each, tuple(labels[each])) for each in sorted(several))
        moon = context.moon if "moon exposure" in several else ()
        return Named(values=values, entry=self, chosen=chosen, labelled=labelled, moon=moon)

    def of(self, context: Context, **values: Any) -> Named:
        """The effect with some values and choices, as `Effect.of`."""
        return self.neutral(context).given(context, **values)

    def probes(self, context: Context) -> tuple[tuple[Named, ...], ...]:
        """Effects at neutral for every choice, and for both directions of a polar pair."""
        choices: Mapping[Any, Sequence[Any]] = {
            "cameras": range(len(context.cameras)),
            "stars": context.sources,
        }
        names, polar = [name for name, _ in self.choices], self.polar
        shapes: list[dict[str, Any]] = [{}]
        if polar is not None:
            shapes = [{polar.polar: phase / polar.turns} for phase in (0.0, 0.5 * np.pi)]
        return tuple(
            tuple(self.of(context, **dict(zip(names, chosen, strict=True)), **shape) for shape in shapes)
            for chosen in itertools.product(*(choices.get(of, of) for _, of in self.choices))
        )

    def combine(self, group: Sequence[Any], amplitudes: Sequence[float] | Float[np.ndarray, " a"]) -> Named:
        """The effect from fitted amplitudes, as `Effect.combine`; for a polar pair size and angle from its two
        directions.
        """
        if (polar := self.polar) is None:
            return group[0].moved(amplitudes)
        first, second = amplitudes
        angle = np.arctan2(second, first) / polar.turns
        return group[0].replaced(**{polar.name: np.hypot(first, second), polar.polar: angle})


class Named(Effect):
    """An effect of an entry. Parameters and choices, by name, are its attributes as well.

    `labelled` are the labels of the values of an array, by what there is a value for each of (`Member.each`): the
    EXPOSURE number of an exposure of the Moon, the name of a star. `moon` are the positions of the Moon exposures.
    """

    values: dict[str, Array]
    entry: Entry = eqx.field(static=True)
    chosen: tuple[tuple[str, Any], ...] = eqx.field(static=True)
    labelled: tuple[tuple[str, tuple[str, ...]], ...] = eqx.field(static=True)
    moon: tuple[int, ...] = eqx.field(static=True)

    def __check_init__(self) -> None:
        chosen = self.choices()
        for choice, allowed in self.entry.choices:
            if not isinstance(allowed, str) and chosen[choice] not in allowed:
                what = f"{choice} {chosen[choice]!r} does not exist"
                raise ValueError(f"{self.name}: {what}, choose {' or '.join(allowed)}")

    def __getattr__(self, name: str) -> Any:
        for inside in (vars(self).get("values", {}), dict(vars(self).get("chosen", ()))):
            if name in inside:
                return inside[name]
        raise AttributeError(f"there is no parameter or choice {name!r}")

    @property
    def kind(self) -> Any:
        """The entry that it was made of."""
        return self.entry

    @property
    def name(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The name of its entry."""
        return self.entry.name

    def labels(self, field: str) -> Sequence[str]:
        """One name for each camera, standard, or exposure of the Moon by its EXPOSURE number; else the field's own."""
        each = next(member.each for member in self.entry.members if member.name == field)
        return tuple(f"{field}.{label}" for label in dict(self.labelled)[each]) if each else (field,)

    def choices(self) -> dict[str, Any]:
        """The choices of its entry, with what was chosen."""
        return dict(self.chosen)

    def replaced(self, **values: Any) -> Named:
        """The effect with other values of parameters, or other choices."""
        numbers = {name: as_number(values.get(name, old)) for name, old in self.values.items()}
        chosen = tuple((name, values.get(name, old)) for name, old in self.chosen)
        return dataclasses.replace(self, values=numbers, chosen=chosen)

    def standard_form(self) -> Named:
        """The effect with positive sizes of polar pairs and angles in (−π, π] or, for an axis, [0°, 180°)."""
        if (polar := self.entry.polar) is None:
            return self
        size, angle = float(self.values[polar.name]), float(self.values[polar.polar])
        phase = polar.turns * angle + (np.pi if size < 0 else 0.0)
        phase = phase % (2.0 * np.pi) if polar.is_axis else np.angle(np.exp(1j * phase))
        return self.replaced(**{polar.name: abs(size), polar.polar: phase / polar.turns})

    def lacks(self, instrument: Instrument) -> str:
        """The part that the instrument lacks for the effect, in words; also where no star is available for a choice."""
        if "" in self.choices().values() or ("standard", ()) in self.labelled:
            return NO_STANDARD
        if not (arrangement := self.entry.arrangement):
            return super().lacks(instrument)
        available = alternatives(dataclasses.replace(instrument, effects=()))
        return "" if arrangement in available else str(unknown_name("arrangement", arrangement, available))

    # ------------------------------------------------------------------------------------ its action

    def patch(self, instrument: Instrument) -> Instrument:
        """The instrument with all changes at their sizes."""
        if self.entry.arrangement:
            return changed(instrument, self.entry.arrangement)
        terms = [
            (change, size * value)
            for member in self.entry.members
            for value, item in zip(
                self._values(member, instrument), self._parts(member, instrument), strict=False
            )
            for size, change in item
        ]
        return patched(instrument, terms)

    def first_order(self, instrument: Instrument) -> tuple[tuple[tuple[float, Change], ...], ...]:
        """The changes of each amplitude, with their sizes for one unit of it."""
        return tuple(
            tuple((float(size), change) for size, change in combination)
            for member in self.entry.members
            for combination in self._parts(member, instrument)
        )

    def as_descriptions(self, instrument: Instrument) -> tuple[str, ...]:
        """The changes in the grammar of a diagnosis."""
        return tuple(
            _behind(Change.parsed(text), instrument).text
            for member in self.entry.members
            for sentence in member.said
            for expanded in self._each(member, sentence, instrument)
            for text in expanded
        )

    @property
    def stated(self) -> tuple[str, ...]:
        """The changes of numbers of which its parameters are the values."""
        return tuple(text for member in self.entry.members if member.absolute for text in member.does)

    def _values(self, member: Member, instrument: Instrument) -> list[Scalar]:
        value = self.values[member.name]
        if member.absolute:
            polariser = instrument.polariser
            value = value - (EXTINCTION if polariser is None else polariser.extinction)
        return list(value) if jnp.ndim(value) else [value]

    def _parts(self, member: Member, instrument: Instrument) -> list[list[tuple[Any, Change]]]:
        """For each value of a parameter the changes, with their sizes for one unit of it."""
        weights: tuple[Any, ...] = (1.0,) * len(member.does)
        if member.polar:
            angle = self.values[member.polar]
            phase = member.turns * (angle if isinstance(angle, Tracer) else np.asarray(angle))
            of = jnp if isinstance(phase, jax.Array) else np  # known ones need no program
            weights = (of.cos(phase), of.sin(phase))
        texts = [self._each(member, text, instrument) for text in member.does]
        return [
            [
                (size * weight, Change.parsed(text))
                for size, weight, items in zip(member.per_unit, weights, row, strict=True)
                for text in items
            ]
            for row in zip(*texts, strict=True)
        ]

    def _each(self, member: Member, text: str, instrument: Instrument) -> list[list[str]]:
        """The expanded texts of a text, for each value of a parameter."""
        chosen = self.choices()
        if "camera" in chosen:
            names = instrument.cameras.names
            chosen["camera"] = names[numbered_camera(self.name, chosen["camera"], names)]
        text = text.format_map({name: place_of_star(str(value)) for name, value in chosen.items()})
        expanded = list(_expanded(text, instrument))
        if member.each in EVERY:
            return [[item] for item in expanded]
        if member.each:
            return [[f"{item} * exposure {at}" for item in expanded] for at in self.moon]
        return [expanded]


def _expanded(text: str, instrument: Instrument) -> Iterator[str]:
    head, keyword, tail = text.partition("every ")
    if not keyword:
        yield text
        return
    name, blank, remainder = tail.partition(" ")
    for number, place in enumerate(EVERY[name](instrument)):
        origin = instrument.cameras.orthogonal[number] if name == "camera" else 0
        yield f"{head.replace(' of orthogonal ', f' of {instrument.cameras.names[origin]} ')}{place}{blank}{remainder}"


def _behind(change: Change, instrument: Instrument) -> Change:
    """The same place relative to the element ahead of it, if any."""
    if change.relation != "ahead of" or change.kind.startswith("displacement"):
        return change
    arm, _, name = change.place.rpartition(".")
    path = next((candidate.path for candidate in instrument.arms if candidate.name == arm), instrument.path)
    at = path.index(name) if name in path else 0
    polariser = instrument.polariser
    if not at or (polariser is not None and name == polariser.name):
        return change
    before = f"{arm}.{path[at - 1]}" if arm else path[at - 1]
    return dataclasses.replace(change, relation="behind", place=before)
