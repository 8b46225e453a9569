"""The catalogue of effects: entries of a TOML file, each made into a class of its own.

    [flexure]
    about = "Field displaced in proportion to the hour angle"
    source = "Tinyanont et al. 2019, arXiv:1811.03138"
    revealed_by = "polariser exposures at different hour angles"
    separated_by = "the same polariser angles at several hour angles and at one temperature"
    rate_x = { does = "displacement x ahead of pupil * hour angle", unit = "deg/h", width = 0.003, about = "along X" }
    rate_y = { does = "displacement y ahead of pupil * hour angle", unit = "deg/h", width = 0.003, about = "along Y" }

Parameters are the keys that hold a table:

    does        the change (`change`) that the parameter is the amplitude of; `every NAME` stands for all of them
                (`EVERY`), all alike, `{choice}` for a choice of the entry
    per_unit    amplitude of the change for one unit of the parameter (1)
    said        the same, to first order, as the grammar of a diagnosis writes it, where that differs
    each        "camera": one value for each of `every camera`; "moon exposure": for each exposure of the Moon
    polar       name of the parameter that is its angle: `does` has two changes, for cos and sin of `turns` × the angle
    absolute    true: the extinction itself instead of what is added to it; `neutral` is its value without the effect
    unit, about, width, scale, loose    as for `parameters.param`

Keys of an entry: about, equation, note, source, revealed_by, separated_by; one_sided (parameters that physics keeps
above neutral), over_field (true: only a number of field points can show it), choices ({ camera = "cameras" },
{ source = "stars" }, or a list of words), arrangement (a change of `alternatives`; such an effect has no parameter),
class (an effect of this package that is not linear in all its numbers), part (of the page of effects, which begins with
this one).
"""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import itertools
import os
import re
import sys
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib.resources import files
from typing import Any, ClassVar, NamedTuple, Self, TypeGuard

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from walop_jax.io.code import classes_of
from walop_jax.io.errors import fail
from walop_jax.io.text import parse_toml
from walop_jax.model.alternatives import alternatives, changed
from walop_jax.model.compiled import array
from walop_jax.model.conventions import EXTINCTION
from walop_jax.model.effects.base import Context, Effect, Scalar, numbered_camera
from walop_jax.model.effects.change import Change, patched
from walop_jax.model.elements import WavePlate
from walop_jax.model.instrument import Instrument
from walop_jax.model.parameters import field_declarations, param, unknown_name

FILE = "catalogue.toml"
TEXTS = (
    "part",
    "about",
    "equation",
    "symbols",
    "note",
    "source",
    "revealed_by",
    "separated_by",
    "arrangement",
    "class",
)
KEYS = (*TEXTS, "one_sided", "over_field", "choices")
PARAMETER_KEYS = (
    "does", "per_unit", "said", "each", "polar", "turns", "absolute", "neutral", "unit", "about", "width", "scale",
    "loose",
)  # fmt: skip
EACH = ("camera", "moon exposure")
NO_STANDARD = "there is no standard star"


EVERY: Mapping[str, Callable[[Instrument], Sequence[str]]] = {
    "camera": lambda instrument: instrument.cameras.names,
    "analyser": lambda instrument: [f"{arm.name}.{arm.path[-1]}" for arm in instrument.arms],
    "wave_plate": lambda instrument: instrument.places(WavePlate),
}
"""Places that `every` stands for."""


class Member(NamedTuple):
    """A parameter of an entry, and what it does."""

    name: str
    does: tuple[str, ...]
    per_unit: tuple[float, ...]
    said: tuple[str, ...]
    each: str
    polar: str
    turns: float
    absolute: bool


class Entry(Effect):
    """An effect of the catalogue: changes, and the parameters that are their amplitudes."""

    members: ClassVar[tuple[Member, ...]] = ()
    options: ClassVar[Mapping[str, Any]] = {}
    arrangement: ClassVar[str] = ""
    page: ClassVar[Mapping[str, str]] = {}
    entry: ClassVar[Mapping[str, Any]] = {}

    def __check_init__(self) -> None:
        for choice, known in self.options.items():
            if isinstance(known, list) and getattr(self, choice) not in known:
                what = f"{choice} {getattr(self, choice)!r} does not exist"
                raise ValueError(f"{self.name}: {what}, choose {' or '.join(known)}")

    @classmethod
    def head(cls) -> str:
        """Equation, symbols, source, neutral values and what reveals it."""
        lines = [f"{title:<12}{text}" for title, text in cls.page.items() if text]
        return "\n".join(lines)

    @classmethod
    def neutral(cls, context: Context) -> Self:
        """The effect with values that change nothing; choices are the first there are."""
        values: dict[str, Any] = {}
        for member in cls.members:
            if member.each == "camera":
                values[member.name] = array(np.zeros(len(context.cameras)))
            elif member.each:
                values[member.name] = array(np.zeros(len(context.moon)))
                values |= {"positions": context.moon, "ids": context.moon_ids}
            elif member.absolute:
                values[member.name] = array(context.extinction, float)
        if cls.options.get("source") == "stars":
            values["source"] = context.sources[0] if context.sources else ""
        return cls(**values)

    @classmethod
    def probes(cls, context: Context) -> tuple[tuple[Self, ...], ...]:
        """Every choice; of a polar pair both directions."""
        known = {"cameras": range(len(context.cameras)), "stars": context.sources}
        options = [known.get(one, one) if isinstance(one, str) else one for one in cls.options.values()]
        polar = next((member for member in cls.members if member.polar), None)
        shapes: list[dict[str, Any]] = [{}]
        if polar is not None:
            shapes = [{polar.polar: 0.0}, {polar.polar: _angle(cls, polar, 0.5 * np.pi)}]
        return tuple(
            tuple(cls.of(context, **dict(zip(cls.options, chosen, strict=True)), **shape) for shape in shapes)
            for chosen in itertools.product(*options)
        )

    @classmethod
    def combine(cls, group: Sequence[Any], amplitudes: Sequence[float] | Float[np.ndarray, " a"]) -> Self:
        """Size and angle from the two directions of a polar pair."""
        if len(group) == 1:
            return super().combine(group, amplitudes)
        (polar,) = (member for member in cls.members if member.polar)
        first, second = amplitudes
        angle = _angle(cls, polar, np.arctan2(second, first))
        return dataclasses.replace(group[0], **{polar.name: np.hypot(first, second), polar.polar: angle})

    def standard_form(self) -> Self:
        """Sizes of polar pairs positive, angles in (−π, π] or, of an axis, [0°, 180°)."""
        changed: dict[str, Any] = {}
        for member in (one for one in self.members if one.polar):
            size, angle = float(getattr(self, member.name)), getattr(self, member.polar)
            phase = self._phase(member, float(angle)) + (np.pi if size < 0 else 0.0)
            phase = phase % (2.0 * np.pi) if member.turns == 2 else np.angle(np.exp(1j * phase))
            changed |= {member.name: jnp.asarray(abs(size)), member.polar: _angle(type(self), member, phase)}
        return dataclasses.replace(self, **changed) if changed else self

    def labels(self, field: str) -> Sequence[str]:
        """One value for each camera, or for each exposure of the Moon by its EXPOSURE number."""
        each = next((member.each for member in self.members if member.name == field), "")
        if not each:
            return (field,)
        known = self.ids if each != "camera" else [f"n{k}" for k in range(len(getattr(self, field)))]  # pyright: ignore[reportAttributeAccessIssue]
        return tuple(f"{field}.{one}" for one in known)

    def choices(self) -> dict[str, Any]:
        """Those of the entry; exposures belong to the data."""
        return {name: getattr(self, name) for name in self.options}

    def lacks(self, instrument: Instrument) -> str:
        """As for any effect; there may be no star that a choice could name."""
        if "" in self.choices().values():
            return NO_STANDARD
        if not self.arrangement:
            return super().lacks(instrument)
        known = alternatives(dataclasses.replace(instrument, effects=()))
        return "" if self.arrangement in known else str(unknown_name("arrangement", self.arrangement, known))

    # ------------------------------------------------------------------------------------ what it does

    def patch(self, instrument: Instrument) -> Instrument:
        """All changes at their sizes."""
        if self.arrangement:
            return changed(instrument, self.arrangement)
        terms = [
            (change, size * value)
            for member in self.members
            for value, each in zip(
                self._values(member, instrument), self._parts(member, instrument), strict=True
            )
            for size, change in each
        ]
        return patched(instrument, terms)

    def first_order(self, instrument: Instrument) -> tuple[tuple[tuple[float, Change], ...], ...]:
        """The changes of each amplitude, with what one unit of it is of them; none where a subclass does more."""
        if type(self).patch is not Entry.patch:
            return ()
        return tuple(
            tuple((float(size), change) for size, change in each)
            for member in self.members
            for each in self._parts(member, instrument)
        )

    def in_sentences(self, instrument: Instrument) -> tuple[str, ...]:
        """The changes as the grammar of a diagnosis writes them."""
        return tuple(
            _behind(Change.parsed(text), instrument).text
            for member in self.members
            for said in member.said
            for each in self._each(member, said, instrument)
            for text in each
        )

    @property
    def stated(self) -> tuple[str, ...]:
        """The changes of the numbers that its parameters are themselves."""
        return tuple(text for member in self.members if member.absolute for text in member.does)

    def _values(self, member: Member, instrument: Instrument) -> list[Scalar]:
        value = getattr(self, member.name)
        if member.absolute:
            polariser = instrument.polariser
            value = value - (EXTINCTION if polariser is None else polariser.extinction)
        return list(value) if jnp.ndim(value) else [value]

    def _parts(self, member: Member, instrument: Instrument) -> list[list[tuple[Any, Change]]]:
        """For each value of a parameter the changes, with their sizes for one unit of it."""
        weights: tuple[Any, ...] = (1.0,) * len(member.does)
        if member.polar:
            phase = self._phase(member, getattr(self, member.polar))
            of = jnp if isinstance(phase, jax.Array) else np  # known ones need no program
            weights = (of.cos(phase), of.sin(phase))
        found: list[list[tuple[Any, Change]]] = []
        for text, size, weight in zip(member.does, member.per_unit, weights, strict=True):
            for i, texts in enumerate(self._each(member, text, instrument)):
                found += [[] for _ in range(i + 1 - len(found))]
                found[i] += [(size * weight, Change.parsed(one)) for one in texts]
        return found

    def _each(self, member: Member, text: str, instrument: Instrument) -> list[list[str]]:
        """The texts that one stands for, for each value of a parameter."""
        chosen = self.choices()
        if "camera" in chosen:
            names = instrument.cameras.names
            chosen["camera"] = names[numbered_camera(self.name, chosen["camera"], names)]
        text = text.format_map({name: str(value).replace(" ", "_") for name, value in chosen.items()})
        every = list(_expanded(text, instrument))
        if member.each == "camera":
            return [[one] for one in every]
        if member.each:
            return [[f"{one} * exposure {n}" for one in every] for n in self.positions]  # pyright: ignore[reportAttributeAccessIssue]
        return [every]

    def _phase(self, member: Member, angle: Any) -> Any:
        angle = angle if isinstance(angle, Tracer) else np.asarray(angle)
        return member.turns * (angle * _RADIANS[field_declarations(type(self))[member.polar].unit])


_RADIANS = {"rad": 1.0, "deg": np.pi / 180.0}


def _angle(kind: type[Effect], member: Member, phase: Any) -> Any:
    return phase / member.turns / _RADIANS[field_declarations(kind)[member.polar].unit]


def _expanded(text: str, instrument: Instrument) -> Iterator[str]:
    head, every, tail = text.partition("every ")
    if not every:
        yield text
        return
    name, blank, rest = tail.partition(" ")
    for number, place in enumerate(EVERY[name](instrument)):
        origin = instrument.cameras.orthogonal[number] if name == "camera" else 0
        yield f"{head.replace(' of orthogonal ', f' of {instrument.cameras.names[origin]} ')}{place}{blank}{rest}"


def _behind(change: Change, instrument: Instrument) -> Change:
    """The same place told from the other side, where there is an element ahead of it."""
    if change.where != "ahead of" or change.kind.startswith("displacement"):
        return change
    arm, _, name = change.place.rpartition(".")
    path = next((one.path for one in instrument.arms if one.name == arm), instrument.path)
    at = path.index(name) if name in path else 0
    polariser = instrument.polariser
    if not at or (polariser is not None and name == polariser.name):
        return change
    before = f"{arm}.{path[at - 1]}" if arm else path[at - 1]
    return dataclasses.replace(change, where="behind", place=before)


# ------------------------------------------------------------------------------------------- from a file


def entries(content: Mapping[str, Any], module: str) -> tuple[type[Effect], ...]:
    """The effects that tables describe, by name, as classes of a module.

    Raises ValueError, naming entry and key, for what is wrong.
    """
    sys.modules.setdefault(module, types.ModuleType(module))
    found = []
    for name, table in content.items():
        if not isinstance(table, Mapping):
            raise ValueError(f"{name} = {table!r} must be a table, [{name}]")
        try:
            found.append(_class_of(name, table) if "class" in table else _made(name, table, module))
        except (TypeError, ValueError) as error:
            raise ValueError(f"[{name}] {error}") from None
    return tuple(found)


def _class_of(name: str, table: Mapping[str, Any]) -> type[Effect]:
    found = getattr(importlib.import_module(f"walop_jax.model.effects.{name}"), table["class"])
    assert issubclass(found, Effect)
    return found


def _made(name: str, table: Mapping[str, Any], module: str) -> type[Effect]:
    parameters = {
        key: value for key, value in table.items() if key not in KEYS and isinstance(value, Mapping)
    }
    for key in table:
        if key not in KEYS and key not in parameters:
            raise unknown_name("key", key, KEYS)
    for key in ("about", "source", "revealed_by", "separated_by"):
        if not isinstance(table.get(key), str):
            raise ValueError(f"needs {key} = a text")
    if not parameters and "arrangement" not in table:
        raise ValueError("needs a parameter, a key that holds a table with does = …")
    members, fields, choices = [], {}, dict(table.get("choices", {}))
    for key, own in parameters.items():
        for each in own:
            if each not in PARAMETER_KEYS:
                raise unknown_name(f"key of {key}", each, PARAMETER_KEYS)
        fields[key] = _field(key, own, table["source"])
        if "does" in own:
            members.append(_member(key, own, parameters, choices))
        elif key not in (other.get("polar") for other in parameters.values()):
            raise ValueError(f"{key}: needs does = a change")
    page = {
        "Equation": table.get("equation", ""),
        "Symbols": "; ".join(_symbol(key, own) for key, own in parameters.items()),
        "Source": table["source"],
        "Neutral": _neutral(members, parameters) if members else "none: it is there or it is not",
        "Revealed by": table["revealed_by"],
        "Note": table.get("note", ""),
    }
    space: dict[str, Any] = {
        "__module__": module, "entry": table, "__doc__": f"{table['about']}.", "name": name, "members": tuple(members),
        "options": choices, "arrangement": table.get("arrangement", ""), "page": page, "reference": table["source"],
        "revealed_by": table["revealed_by"], "separated_by": table["separated_by"],
        "one_sided": tuple(table.get("one_sided", ())), "over_field": bool(table.get("over_field", False)),
        "shape": tuple(member.polar for member in members if member.polar),
    }  # fmt: skip
    annotations: dict[str, Any] = {}
    for key, (field, kind) in fields.items():
        space[key], annotations[key] = field, kind
    statics: dict[str, Any] = {key: _first(value) for key, value in choices.items()}
    if any(member.each == "moon exposure" for member in members):
        statics |= {"positions": (), "ids": ()}
    for key, value in statics.items():
        space[key], annotations[key] = eqx.field(static=True, default=value), type(value)
    space["__annotations__"] = annotations
    title = "".join(part.title() for part in name.split("_"))
    made = types.new_class(title, (Entry,), exec_body=lambda names: names.update(space))
    setattr(sys.modules[module], made.__name__, made)  # where pickle looks for it
    return made


def _symbol(name: str, own: Mapping[str, Any]) -> str:
    return f"{name} [{own['unit']}] {own['about']}" if own.get("unit") else f"{name} {own.get('about', '')}"


def _neutral(members: Sequence[Member], parameters: Mapping[str, Any]) -> str:
    values = [f"{one.name} = {parameters[one.name].get('neutral', 0.0):g}" for one in members]
    return ", ".join(values + [f"whatever the {one.polar}" for one in members if one.polar])


def _first(options: Any) -> Any:
    return {"cameras": 0, "stars": ""}[options] if isinstance(options, str) else options[0]


def _field(name: str, own: Mapping[str, Any], source: str) -> tuple[Any, Any]:
    said = {key: float(own[key]) for key in ("width", "scale", "loose") if key in own}
    if "unit" not in own or "about" not in own or not said:
        raise ValueError(f"{name}: needs unit, about, and width or scale and loose")
    default = None if "each" in own else float(own.get("neutral", 0.0))
    field = param(unit=own["unit"], about=own["about"], source=source, default=default, **said)
    return field, Float[Array, " n"] if "each" in own else Scalar


def _member(
    name: str, own: Mapping[str, Any], parameters: Mapping[str, Any], choices: Mapping[str, Any]
) -> Member:
    def texts(key: str, otherwise: tuple[str, ...]) -> tuple[str, ...]:
        value = own.get(key, otherwise)
        return (value,) if isinstance(value, str) else tuple(value)

    does = texts("does", ())
    for text in (*does, *texts("said", ())):
        for choice in re.findall(r"{(\w*)}", text):
            if choice not in choices:
                raise unknown_name(f"choice of {name}", choice, choices)
        Change.parsed(re.sub(r"[{}]", "", text.replace("every ", "every_")))
    per_unit = own.get("per_unit", 1.0)
    sizes = tuple(map(float, per_unit)) if isinstance(per_unit, Sequence) else (float(per_unit),) * len(does)
    polar, each = own.get("polar", ""), own.get("each", "")
    if (polar and (polar not in parameters or len(does) != 2)) or len(sizes) != len(does):
        raise ValueError(f"{name}: polar = the name of a parameter; does and per_unit then have two elements")
    if each and each not in EACH:
        raise unknown_name("each", each, EACH)
    turns, absolute = float(own.get("turns", 1.0)), bool(own.get("absolute", False))
    if absolute and any(Change.parsed(text).kind != "extinction" for text in does):
        raise ValueError(
            f"{name}: absolute is for the extinction of the polariser alone; say what is added instead"
        )
    return Member(name, does, sizes, texts("said", does), each, polar, turns, absolute)


def own_entries(path: str | os.PathLike[str]) -> tuple[type[Effect], ...]:
    """The effects of a user's TOML file. Raises `DataError`, naming file, entry and key, for what is wrong."""
    try:
        with open(path, encoding="utf-8") as file:
            text = file.read()
    except OSError as error:
        raise fail(f"cannot be read: {error.strerror}", file=path) from error
    module = f"walop_jax_own_{os.path.splitext(os.path.basename(path))[0]}"
    try:
        return entries(parse_toml(text), module)
    except ValueError as error:
        raise fail(str(error), file=path, advice="see walop-jax docs adding-an-effect") from None


EFFECTS = entries(parse_toml((files("walop_jax.model.effects") / FILE).read_text(encoding="utf-8")), __name__)
"""All effects, in the order in which light meets them."""


def applies(effect: Effect, instrument: Instrument) -> bool:
    """True if an instrument has what an effect of a catalogue acts on.

    Raises ValueError, with the nearest names, for an effect that does not come with the package: whoever wrote it meant
    this instrument.
    """
    lacking = effect.lacks(instrument)
    if lacking and lacking != NO_STANDARD and type(effect) not in EFFECTS:
        raise ValueError(f"effect {effect.name!r}: {lacking}")
    return not lacking


def is_own(effect: Effect) -> TypeGuard[Entry]:
    """True if an effect is an entry that does not come with the package."""
    return isinstance(effect, Entry) and type(effect) not in EFFECTS


def catalogue_with(own: str | os.PathLike[str] | None) -> tuple[type[Effect], ...]:
    """The catalogue followed by the effects of a file (None: nothing more): entries of a TOML file, classes of Python.

    A Python file is run. Raises `DataError` if it cannot be, defines no effect, or one without a name or with that of
    another.
    """
    if own is None:
        return EFFECTS
    if os.fspath(own).endswith(".toml"):
        found = {effect.name: effect for effect in own_entries(own)}
    else:
        found = classes_of(
            own,
            Effect,
            "give a TOML file, or Python with subclasses of Effect (walop-jax docs adding-an-effect)",
        )
        found = {name: effect for name, effect in found.items() if not inspect.isabstract(effect)}
    if not found:
        raise fail("defines no effect", file=own, advice="see walop-jax docs adding-an-effect")
    taken = {effect.name for effect in EFFECTS}
    for class_name, effect in found.items():
        if not effect.name or effect.name in taken:
            what = f"{class_name} has {'the name of another effect' if effect.name else 'no name'}"
            raise fail(what, file=own, advice="give it a name of its own")
        taken.add(effect.name)
    return (*EFFECTS, *found.values())
