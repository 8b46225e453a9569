"""The catalogue of effects: entries of a TOML file (`entry`), and classes.

    [flexure]
    about = "Field displaced in proportion to the hour angle"
    source = "Tinyanont et al. 2019, arXiv:1811.03138"
    revealed_by = "polariser exposures at different hour angles"
    separated_by = "the same polariser angles at several hour angles and at one temperature"
    rate_x = { does = "displacement x ahead of pupil * hour angle", unit = "deg/h", width = 0.003, about = "along X" }
    rate_y = { does = "displacement y ahead of pupil * hour angle", unit = "deg/h", width = 0.003, about = "along Y" }

Parameters are the keys that hold a table:

    does        the change (`change`) with the parameter as amplitude; `every NAME` means all of them (`EVERY`), all
                alike, `{choice}` a choice of the entry
    per_unit    amplitude of the change for one unit of the parameter (1)
    said        the same, to first order, in the grammar of a diagnosis, where that differs
    each        "camera": one value for each of `every camera`; "standard": for each of `every standard`;
                "moon exposure": for each exposure of the Moon
    polar       name of the parameter of its angle: `does` has two changes, for cos and sin of `turns` × the angle
    absolute    true: the extinction itself instead of an addition to it; `neutral` is its value without the effect
    unit, about, width, scale, loose    as for `parameters.param`

Keys of an entry: about, equation, note, source, revealed_by, separated_by; one_sided (parameters that physics keeps
above neutral), over_field (true: visible only in several field points), watched (true: a change of the optics that
`check` looks for in stars), choices ({ camera = "cameras" },
{ source = "stars" }, or a list of words), arrangement (a change of `alternatives`; such an effect has no parameter),
class (an effect of this package that is not linear in all its numbers), part (of the page of effects, which begins with
this one).
"""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import os
import re
from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Any, TypeGuard

import numpy as np

from walop_jax.io.code import classes_of
from walop_jax.io.errors import PathLike, fail
from walop_jax.io.text import parse_toml, read_text
from walop_jax.model.effects.base import Effect
from walop_jax.model.effects.change import Change
from walop_jax.model.effects.entry import NO_STANDARD, Entry, Member, Named
from walop_jax.model.instrument import Instrument
from walop_jax.model.parameters import Parameter, check_names

FILE = "catalogue.toml"
NEEDED = ("about", "source", "revealed_by", "separated_by")
KEYS = (
    "part", *NEEDED, "equation", "symbols", "note", "arrangement", "class", "one_sided", "over_field", "watched",
    "choices",
)  # fmt: skip
PARAMETER_KEYS = (
    "does", "per_unit", "said", "each", "polar", "turns", "absolute", "neutral", "unit", "about", "width", "scale",
    "loose",
)  # fmt: skip
EACH = ("camera", "standard", "moon exposure")
RADIANS = {"rad": 1.0, "deg": np.pi / 180.0}

EffectKind = type[Effect] | Entry
"""An entry, or a class: makes effects of one name."""


def entries(content: Mapping[str, Any]) -> tuple[EffectKind, ...]:
    """The effects of tables, by name. Raises ValueError, with entry and key, for invalid tables."""
    result = []
    for name, table in content.items():
        if not isinstance(table, Mapping):
            raise ValueError(f"{name} = {table!r} must be a table, [{name}]")
        try:
            if "class" in table:
                module = importlib.import_module(f"walop_jax.model.effects.{name}")
                result.append(getattr(module, table["class"]))
            else:
                result.append(_entry(name, table))
        except (TypeError, ValueError) as error:
            raise ValueError(f"[{name}] {error}") from None
    return tuple(result)


def _entry(name: str, table: Mapping[str, Any]) -> Entry:
    parameters = {
        key: value for key, value in table.items() if key not in KEYS and isinstance(value, Mapping)
    }
    check_names("key", [key for key in table if key not in parameters], KEYS)
    for key in NEEDED:
        if not isinstance(table.get(key), str):
            raise ValueError(f"needs {key} = a text")
    if not parameters and "arrangement" not in table:
        raise ValueError("needs a parameter, a key that holds a table with does = …")
    choices = {key: of if isinstance(of, str) else tuple(of) for key, of in table.get("choices", {}).items()}
    for key in (*parameters, *choices):
        if hasattr(Named, key) or key in {field.name for field in dataclasses.fields(Named)}:
            raise ValueError(f"{key}: every effect has something of this name; give it another one")
    return Entry(
        name=name,
        members=tuple(_member(key, parameters, table["source"], choices) for key in parameters),
        choices=tuple(choices.items()),
        arrangement=table.get("arrangement", ""),
        reference=table["source"],
        revealed_by=table["revealed_by"],
        separated_by=table["separated_by"],
        one_sided=tuple(table.get("one_sided", ())),
        over_field=bool(table.get("over_field", False)),
        watched=bool(table.get("watched", False)),
        table=table,
    )


def _member(
    name: str, parameters: Mapping[str, Mapping[str, Any]], source: str, choices: Mapping[str, Any]
) -> Member:
    settings = parameters[name]
    check_names(f"key of {name}", settings, PARAMETER_KEYS)
    numbers = {key: float(settings[key]) for key in ("width", "scale", "loose") if key in settings}
    if "unit" not in settings or "about" not in settings or not numbers:
        raise ValueError(f"{name}: needs unit, about, and width or scale and loose")
    prior = (0.0, numbers["width"]) if "width" in numbers else None
    declared = Parameter(
        "",
        settings["unit"],
        settings["about"],
        source,
        prior=prior,
        scale=numbers.get("scale", 0.0),
        loose=numbers.get("loose"),
    )
    neutral, does = float(settings.get("neutral", 0.0)), _texts(settings.get("does", ()))
    if not does:
        if name not in (parameter.get("polar") for parameter in parameters.values()):
            raise ValueError(f"{name}: needs does = a change")
        return Member(name, declared, neutral=neutral)
    sentences = _texts(settings.get("said", does))
    for text in (*does, *sentences):
        check_names(f"choice of {name}", re.findall(r"{(\w*)}", text), choices)
        Change.parsed(re.sub(r"[{}]", "", text.replace("every ", "every_")))
    per_unit = settings.get("per_unit", 1.0)
    sizes = tuple(map(float, per_unit)) if isinstance(per_unit, Sequence) else (float(per_unit),) * len(does)
    polar, index = settings.get("polar", ""), settings.get("each", "")
    if (polar and (polar not in parameters or len(does) != 2)) or len(sizes) != len(does):
        raise ValueError(f"{name}: polar = the name of a parameter; does and per_unit then have two elements")
    check_names("each", [index] if index else (), EACH)
    absolute, turns = bool(settings.get("absolute", False)), float(settings.get("turns", 1.0))
    if absolute and any(Change.parsed(text).kind != "extinction" for text in does):
        raise ValueError(
            f"{name}: absolute = true is for the extinction of the polariser only; give the change instead"
        )
    unit = RADIANS[parameters[polar]["unit"]] if polar else 1.0
    return Member(
        name, declared, does, sizes, sentences, index, polar, turns * unit, turns == 2, absolute, neutral
    )


def _texts(value: Any) -> tuple[str, ...]:
    return (value,) if isinstance(value, str) else tuple(value)


def own_entries(path: PathLike) -> tuple[EffectKind, ...]:
    """The effects of a user's TOML file. Raises `DataError`, with file, entry and key, for invalid entries."""
    text = read_text(path)
    try:
        return entries(parse_toml(text))
    except ValueError as error:
        raise fail(str(error), file=path, advice="see walop-jax docs adding-an-effect") from None


EFFECTS = entries(parse_toml((files("walop_jax.model.effects") / FILE).read_text(encoding="utf-8")))
"""All effects, in the order of the light path."""


def applies(effect: Effect, instrument: Instrument) -> bool:
    """True if an instrument has the places of an effect of a catalogue.

    Raises ValueError, with the nearest names, for a user's effect, which is meant for this instrument.
    """
    lacking = effect.lacks(instrument)
    if lacking and lacking != NO_STANDARD and effect.kind not in EFFECTS:
        raise ValueError(f"effect {effect.name!r}: {lacking}")
    return not lacking


def is_own(effect: Effect) -> TypeGuard[Named]:
    """True for an entry of a user's catalogue."""
    return isinstance(effect, Named) and effect.kind not in EFFECTS


def catalogue_with(own: PathLike | None) -> tuple[EffectKind, ...]:
    """The catalogue followed by the effects of a file (None: nothing more): entries of a TOML file, classes of Python.

    A Python file is run. Raises `DataError` if that fails, and for a file without effects, or with an effect without a
    name or with that of another.
    """
    if own is None:
        return EFFECTS
    if os.fspath(own).endswith(".toml"):
        by_name = {effect.name: effect for effect in own_entries(own)}
    else:
        by_name = classes_of(
            own,
            Effect,
            "give a TOML file, or Python with subclasses of Effect (walop-jax docs adding-an-effect)",
        )
        by_name = {name: effect for name, effect in by_name.items() if not inspect.isabstract(effect)}
    if not by_name:
        raise fail("defines no effect", file=own, advice="see walop-jax docs adding-an-effect")
    names = {effect.name for effect in EFFECTS}
    for class_name, effect in by_name.items():
        if not effect.name or effect.name in names:
            what = f"{class_name} has {'the name of another effect' if effect.name else 'no name'}"
            raise fail(what, file=own, advice="give it a name of its own")
        names.add(effect.name)
    return (*EFFECTS, *by_name.values())
