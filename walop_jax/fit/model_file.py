"""The model as a TOML text: every parameter with unit, start, prior, free or not; and back.

    [model]
    instrument = "WALOP-SOUTH"
    plates = "waves"            # or "fixed_axis", the paper's approximation
    throughput_degree = 4
    effects = ["clp_wobble"]    # effects beyond the base model, by name

    [effects.blemish]           # discrete choices of an effect that has some
    camera = 2

    [parameters."half2.plate.mgf2"]
    start = 1930.0
    prior = [1930.0, 1.0]       # mean and standard deviation, or "none"
    free = true
    tie = "half1.plate.mgf2"    # optional: takes the value of another parameter

A file may hold any part of this; what it does not mention stays as in the base model. Names that do not exist
are errors that list the nearest ones.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

import tomlkit

from walop_jax.io.text import parse_toml
from walop_jax.model.parameters import Parameter, unknown_name
from walop_jax.model.specification import Model

TABLES = ("model", "effects", "parameters")
MODEL_KEYS = ("instrument", "plates", "throughput_degree", "effects")
PARAMETER_KEYS = ("start", "prior", "free", "tie", "unit", "scale", "about")


@dataclasses.dataclass(frozen=True)
class Header:
    """The [model] table: what decides which parameters there are. None: as in the base model."""

    instrument: str | None = None
    plates: str | None = None
    throughput_degree: int | None = None
    effects: tuple[str, ...] = ()
    choices: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)


def header_of(model: Model) -> Header:
    """What decides which parameters a model has."""
    instrument = model.template
    choices = {effect.name: effect.choices() for effect in instrument.effects}
    return Header(
        instrument=model.name,
        plates=instrument.plates,
        throughput_degree=instrument.throughput.degree,
        effects=model.effect_names,
        choices={name: values for name, values in choices.items() if values},
    )


def render(model: Model) -> str:
    """The TOML text of a model."""
    header = header_of(model)
    document = tomlkit.document()
    document.add(
        tomlkit.comment(f"Model of {model.name}. Change what you need; delete the rest if you like.")
    )
    table = tomlkit.table()
    table["instrument"] = header.instrument
    if header.plates is not None:
        table["plates"] = header.plates
    table["throughput_degree"] = header.throughput_degree
    table["effects"] = list(header.effects)
    document["model"] = table
    if header.choices:
        document["effects"] = dict(header.choices)
    parameters = tomlkit.table(is_super_table=True)
    for p in model.parameters:
        entry = tomlkit.table()
        entry["start"] = p.start
        if p.about:
            entry["start"].comment(p.about)
        entry["unit"] = p.unit
        entry["prior"] = list(p.prior) if p.prior is not None else "none"
        entry["free"] = p.free
        if p.tie is not None:
            entry["tie"] = p.tie
        entry["scale"] = p.scale
        parameters[p.name] = entry
    document["parameters"] = parameters
    return tomlkit.dumps(document)


def parse(text: str, build: Callable[[Header], Model]) -> Model:
    """The model that a TOML text describes; `build` makes the base model for its [model] table.

    Raises ValueError naming the table and key that is wrong, and what to write instead.
    """
    try:
        content = parse_toml(text)
    except ValueError as error:
        raise ValueError(f"the model file is {error}") from None
    for key in content:
        if key not in TABLES:
            raise unknown_name("table", key, TABLES)
        if not isinstance(content[key], Mapping):
            raise ValueError(f"{key} = {content[key]!r} must be a table, [{key}]")
    header = _header(content.get("model", {}), content.get("effects", {}))
    model = build(header)
    if header.instrument is not None and header.instrument != model.name:
        raise ValueError(f"[model] instrument is {header.instrument}, but the data come from {model.name}")
    changes: dict[str, dict[str, Any]] = {}
    for name, entry in content.get("parameters", {}).items():
        parameter = model[name]
        if not isinstance(entry, Mapping):
            raise ValueError(f'[parameters."{name}"] must be a table; names with dots stand in quotes')
        changes[name] = _changes(parameter, entry)
    changed = tuple(dataclasses.replace(p, **changes.get(p.name, {})) for p in model.parameters)
    return dataclasses.replace(model, parameters=changed)


def _header(table: Mapping[str, Any], choices: Mapping[str, Any]) -> Header:
    for key in table:
        if key not in MODEL_KEYS:
            raise unknown_name("key of [model]", key, MODEL_KEYS)
    effects = table.get("effects", [])
    if not (isinstance(effects, list) and all(isinstance(name, str) for name in effects)):
        raise ValueError('[model] effects must be a list of names, e.g. effects = ["clp_wobble"]')
    degree = table.get("throughput_degree")
    if degree is not None and not (isinstance(degree, int) and 0 <= degree <= 12):
        raise ValueError(f"[model] throughput_degree = {degree!r} must be a whole number from 0 to 12")
    for name, values in choices.items():
        if name not in effects:
            raise unknown_name("effect (it has choices but is not in the list of [model])", name, effects)
        if not isinstance(values, Mapping):
            raise ValueError(f"[effects] {name} = {values!r} must be a table, [effects.{name}]")
    return Header(table.get("instrument"), table.get("plates"), degree, tuple(effects), choices)


def _number(name: str, key: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f'[parameters."{name}"] {key} = {value!r} must be a finite number')
    return float(value)


def _changes(parameter: Parameter, entry: Mapping[str, Any]) -> dict[str, Any]:
    name, changes = parameter.name, {}
    for key, value in entry.items():
        if key not in PARAMETER_KEYS:
            raise unknown_name(f'key of [parameters."{name}"]', key, PARAMETER_KEYS)
        if key == "unit":
            if value != parameter.unit:
                raise ValueError(
                    f'[parameters."{name}"] unit is {parameter.unit!r}, not {value!r}; convert the values'
                )
        elif key in ("start", "scale"):
            changes[key] = _number(name, key, value)
        elif key == "prior":
            if value == "none":
                changes[key] = None
            elif isinstance(value, list) and len(value) == 2:
                changes[key] = (_number(name, key, value[0]), _number(name, key, value[1]))
            else:
                raise ValueError(
                    f'[parameters."{name}"] prior = {value!r} must be [mean, standard deviation] or "none"'
                )
        elif key == "free":
            if not isinstance(value, bool):
                raise ValueError(f'[parameters."{name}"] free = {value!r} must be true or false')
            changes[key] = value
        elif key == "tie":
            changes[key] = str(value)
    return changes
