"""Model files (TOML, docs: files): their text, and the model of an instrument that one describes."""

from __future__ import annotations

import dataclasses
import fnmatch
import json
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import tomlkit

from walop_jax.io.text import parse_toml
from walop_jax.io.toml import Reader, Table
from walop_jax.model.effects import EFFECTS, Context, EffectKind, effect_by_name
from walop_jax.model.effects.catalogue import entries, is_own
from walop_jax.model.effects.in_models import effects_of, known_effects, with_effects
from walop_jax.model.instrument import Instrument, adapted, as_designed, nominal_instrument
from walop_jax.model.laws import laws_of
from walop_jax.model.noise import TERMS, noise_choices, with_noise
from walop_jax.model.parameters import Parameter, check_names, unknown_name
from walop_jax.model.sources import Standards
from walop_jax.model.specification import GAUGE, Model, make_model

TABLES = ("model", "effects", "catalogue", "noise", "parameters", "law")
PARAMETER: Table = {
    "start": float, "prior": Any, "free": bool, "tie": str, "unit": Any, "scale": float, "about": Any,
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class ModelTable:
    """The [model] table: what decides which parameters there are. None: as in the base model.

    `choices` are those of effects, `entries` those of effects that do not come with the package, `noise` the groups of
    intensities of the terms of the errors.
    """

    instrument: str | None = None
    plates: str | None = None
    throughput_degree: int | None = None
    effects: tuple[str, ...] = ()
    choices: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    entries: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    noise: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def of_instrument(self) -> dict[str, Any]:
        """The choices of the base model, by name."""
        return {"plates": self.plates, "throughput_degree": self.throughput_degree}


def header_of(model: Model) -> ModelTable:
    """Choices that decide which parameters a model has."""
    instrument = model.template
    choices = {effect.name: effect.choices() for effect in effects_of(model)}
    return ModelTable(
        instrument=model.name,
        plates=instrument.plates,
        throughput_degree=instrument.throughput.degree,
        effects=model.effect_names,
        choices={name: values for name, values in choices.items() if values},
        entries={effect.name: effect.entry.table for effect in effects_of(model) if is_own(effect)},
        noise=noise_choices(instrument),
    )


def render(model: Model) -> str:
    """The TOML text of a model."""
    header = header_of(model)
    document = tomlkit.document()
    comment = f"Model of {model.name}. Change what you need; delete the rest if you like."
    document.add(tomlkit.comment(comment))
    table = tomlkit.table()
    table["instrument"] = header.instrument
    if header.plates is not None:
        table["plates"] = header.plates
    table["throughput_degree"] = header.throughput_degree
    table["effects"] = list(header.effects)
    document["model"] = table
    if header.choices:
        document["effects"] = dict(header.choices)
    if header.entries:
        document["catalogue"] = dict(header.entries)
    if header.noise:
        document["noise"] = dict(header.noise)
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
    if model.laws:
        document["law"] = dict(model.laws)
    return tomlkit.dumps(document)


def parse(text: str, build: Callable[[ModelTable], Model]) -> Model:
    """The model of a TOML text, `build` making the base model; ValueError names table, key and remedy."""
    try:
        content = parse_toml(text)
    except ValueError as error:
        raise ValueError(f"the model file is {error}") from None
    check_names("table", content, TABLES)
    for key in content:
        if not isinstance(content[key], Mapping):
            raise ValueError(f"{key} = {content[key]!r} must be a table, [{key}]")
    header = _header(*(content.get(table, {}) for table in TABLES[:4]))
    model = build(header)
    if header.instrument is not None and header.instrument != model.name:
        raise ValueError(f"[model] instrument is {header.instrument}, but the data come from {model.name}")
    changes: dict[str, dict[str, Any]] = {}
    for name, entry in content.get("parameters", {}).items():
        parameter = model[name]
        if not isinstance(entry, Mapping):
            raise ValueError(f'[parameters."{name}"] must be a table; put names with dots in quotes')
        changes[name] = _changes(parameter, entry)
    changed = tuple(dataclasses.replace(p, **changes.get(p.name, {})) for p in model.parameters)
    laws = {name: law.document() for name, law in laws_of(content.get("law", {})).items()}
    kinds = [kind.name for kind in known_effects(model)]
    for name in laws:
        if not fnmatch.filter(model.names, name) and re.split("[.#]", name)[0] not in kinds:
            raise unknown_name("parameter of [law]", name, model.names)
    return dataclasses.replace(model, parameters=changed, laws=laws)


def _header(
    table: Mapping[str, Any],
    choices: Mapping[str, Any],
    entries: Mapping[str, Any],
    noise: Mapping[str, Any],
) -> ModelTable:
    hints = {"instrument": str, "plates": str, "throughput_degree": int, "effects": tuple[str, ...]}
    options = Reader("").values(hints, table, "model")
    effects = options.get("effects", ())
    if not 0 <= (degree := options.get("throughput_degree", 0)) <= 12:
        raise ValueError(f"[model] throughput_degree = {degree!r} must be a whole number from 0 to 12")
    check_names("effect (it has choices but is not in the list of [model])", choices, effects)
    for name, values in choices.items():
        if not isinstance(values, Mapping):
            raise ValueError(f"[effects] {name} = {values!r} must be a table, [effects.{name}]")
    check_names("key of [noise]", noise, TERMS)
    for key, groups in noise.items():
        if not isinstance(groups, str) and not (
            isinstance(groups, list) and all(isinstance(group, str) for group in groups)
        ):
            what = 'must be "all", "camera", a KIND or a camera, or a list of these'
            raise ValueError(f"[noise] {key} = {groups!r} {what}")
    return ModelTable(**options, choices=choices, entries=entries, noise=noise)


def _changes(parameter: Parameter, entry: Mapping[str, Any]) -> dict[str, Any]:
    place, read = f'parameters."{parameter.name}"', Reader("")
    changes = read.values(PARAMETER, entry, place)
    changes.pop("about", None)
    if (unit := changes.pop("unit", parameter.unit)) != parameter.unit:
        raise read.fault(place, f"unit is {parameter.unit!r}, not {unit!r}; convert the values")
    if (prior := changes.get("prior")) == "none":
        changes["prior"] = None
    elif isinstance(prior, list) and len(prior) == 2:
        changes["prior"] = read.value(tuple[float, float], prior, "prior", place)
    elif prior is not None:
        raise read.fault(place, f'prior = {prior!r} must be [mean, standard deviation] or "none"')
    return changes


EffectCatalogue = Sequence[EffectKind]


def model_without_data(
    instrument: str | Instrument,
    text: str = "",
    *,
    standards: Standards | Sequence[tuple[str, float, float]] = (),
    context: Context | None = None,
    catalogue: EffectCatalogue = EFFECTS,
) -> Model:
    """The model of an instrument as designed, for no data in particular.

    `instrument` is one that comes with the package, by name, or any other; `standards` are (name, q, u), or the source
    itself; `context` says what effects that grow with the data need to know of them; `catalogue` are those the text may
    name. Raises `DataError` for an unknown instrument and ValueError as `model_for` does.
    """
    design = nominal_instrument(instrument) if isinstance(instrument, str) else as_designed(instrument)

    def build(header: ModelTable) -> Model:
        nominal = adapted(design, standards=standards, **header.of_instrument())
        model = make_model(nominal.name, nominal, fixed=(GAUGE,))
        model = dataclasses.replace(model, catalogue=known_to(header, catalogue))
        facts = {"sources": nominal.standard.names, "cameras": nominal.cameras.names, "units": nominal.units}
        return with_effects_of(model, header, context or Context(**facts))

    return parse(text, build)


def known_to(header: ModelTable, catalogue: EffectCatalogue) -> tuple[EffectKind, ...]:
    """A catalogue with the entries that a model file brings along; those of the catalogue stay."""
    names = {effect.name for effect in catalogue}
    stated = {name: table for name, table in header.entries.items() if name not in names}
    return (*catalogue, *entries(stated))


def with_effects_of(model: Model, header: ModelTable, context: Context) -> Model:
    """The model with the effects of a [model] table, at its choices, and the terms of the errors."""
    effects: list[Any] = []
    for name in header.effects:
        choices: Mapping[str, Any] = header.choices.get(name, {})
        kind = effect_by_name(name, known_effects(model))
        effects.append(kind.of(context, **choices) if choices else kind)
    model = with_effects(model, effects, context) if effects else model
    return with_noise(model, **header.noise) if header.noise else model


def effects_text(names: Sequence[str]) -> str:
    """The model file that adds effects by name and changes nothing else."""
    return f"[model]\neffects = {json.dumps(list(names))}\n" if names else ""
