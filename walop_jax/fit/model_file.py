"""Models from data, from a model file (TOML, docs: files), or from neither.

The scale of the throughput is a gauge unless a flux is known: the constant of camera N0 is held then. Of two cameras,
and where every arm has a flux of its own, the whole series of the first one is: only ratios can be known.
"""

from __future__ import annotations

import dataclasses
import fnmatch
import json
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import tomlkit

from walop_jax.data.kinds import POLARISER
from walop_jax.data.merge import parts_of
from walop_jax.data.records import CalibrationSet
from walop_jax.data.settings import Settings
from walop_jax.instruments.description import shipped
from walop_jax.io.errors import DataError
from walop_jax.io.text import parse_toml
from walop_jax.io.toml import Reader, Table
from walop_jax.model.effects import EFFECTS, Context, EffectKind, effect_by_name
from walop_jax.model.effects.catalogue import entries, is_own
from walop_jax.model.instrument import Instrument, adapted, as_designed, nominal_instrument
from walop_jax.model.laws import laws_of
from walop_jax.model.parameters import Parameter, check_names, unknown_name
from walop_jax.model.sources import MoonSky, Standards
from walop_jax.model.specification import THROUGHPUT, Model, effect_context, make_model, with_effects
from walop_jax.model.standards import half_range, standards_of

LEVEL_POINTS = 256
"""Field points from which the start value of a throughput is taken: a start need not be exact."""

TABLES = ("model", "effects", "catalogue", "parameters", "law")
PARAMETER: Table = {
    "start": float, "prior": Any, "free": bool, "tie": str, "unit": Any, "scale": float, "about": Any,
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class ModelTable:
    """The [model] table: what decides which parameters there are. None: as in the base model.

    `choices` are those of effects, `entries` those of effects that do not come with the package.
    """

    instrument: str | None = None
    plates: str | None = None
    throughput_degree: int | None = None
    effects: tuple[str, ...] = ()
    choices: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    entries: Mapping[str, Any] = dataclasses.field(default_factory=dict)


def header_of(model: Model) -> ModelTable:
    """Choices that decide which parameters a model has."""
    instrument = model.template
    choices = {effect.name: effect.choices() for effect in model.effects}
    return ModelTable(
        instrument=model.name,
        plates=instrument.plates,
        throughput_degree=instrument.throughput.degree,
        effects=model.effect_names,
        choices={name: values for name, values in choices.items() if values},
        entries={effect.name: effect.entry.table for effect in model.effects if is_own(effect)},
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
    if header.entries:
        document["catalogue"] = dict(header.entries)
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
    """The model that a TOML text describes; `build` makes the base model for its [model] table.

    Raises ValueError naming the table and key that is wrong, and what to write instead.
    """
    try:
        content = parse_toml(text)
    except ValueError as error:
        raise ValueError(f"the model file is {error}") from None
    check_names("table", content, TABLES)
    for key in content:
        if not isinstance(content[key], Mapping):
            raise ValueError(f"{key} = {content[key]!r} must be a table, [{key}]")
    header = _header(*(content.get(table, {}) for table in TABLES[:3]))
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
    laws = {name: law.document() for name, law in laws_of(content.get("law", {})).items()}
    kinds = [kind.name for kind in model.catalogue]
    for name in laws:
        if not fnmatch.filter(model.names, name) and re.split("[.#]", name)[0] not in kinds:
            raise unknown_name("parameter of [law]", name, model.names)
    return dataclasses.replace(model, parameters=changed, laws=laws)


def _header(table: Mapping[str, Any], choices: Mapping[str, Any], entries: Mapping[str, Any]) -> ModelTable:
    hints = {"instrument": str, "plates": str, "throughput_degree": int, "effects": tuple[str, ...]}
    options = Reader("").values(hints, table, "model")
    effects = options.get("effects", ())
    if not 0 <= (degree := options.get("throughput_degree", 0)) <= 12:
        raise ValueError(f"[model] throughput_degree = {degree!r} must be a whole number from 0 to 12")
    check_names("effect (it has choices but is not in the list of [model])", choices, effects)
    for name, values in choices.items():
        if not isinstance(values, Mapping):
            raise ValueError(f"[effects] {name} = {values!r} must be a table, [effects.{name}]")
    return ModelTable(**options, choices=choices, entries=entries)


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


Catalogue = Sequence[EffectKind]


GAUGE = "throughput.n0.p00"
SKY_AND_STARS = (MoonSky.name, Standards.name)  # parts that are not the instrument's
LEVEL = 0.5  # of a throughput whose scale is a gauge


def base_model(
    calset: CalibrationSet,
    instrument: Instrument | None = None,
    *,
    plates: str | None = None,
    throughput_degree: int | None = None,
) -> Model:
    """The base model (docs: model) for the instrument and standards of a calibration set.

    `instrument` is the one as designed, needed where its name is not one that comes with the package; `plates` and
    `throughput_degree` replace what it says. Raises `DataError` for an instrument that nobody knows, and ValueError
    for one of another name than the set's, or without a moving element that the set has in the beam.

    >>> walop.base_model(calset)["pupil.magnification"].prior
    (15.63, 0.05)
    """
    sources, level = calset.sources, _level(calset)
    standards = standards_of(sources, calset.exposures, calset.filters)
    instrument = as_designed(instrument or instrument_of(calset))
    if instrument.name != calset.instrument:
        raise ValueError(
            f"the data come from {calset.instrument}, the instrument described is {instrument.name}"
        )
    if len(instrument.cameras) != calset.cameras:
        raise ValueError(
            f"{instrument.name} has {len(instrument.cameras)} cameras, the data have {calset.cameras}"
        )
    present = Settings.of(calset.exposures, [p for p in calset.exposures.positions if p != POLARISER])
    present.check_moving(instrument.patched().moving())
    instrument = adapted(
        instrument,
        standards=standards,
        plates=plates,
        throughput_degree=throughput_degree,
        throughput=level,
    )
    priors = {}
    for i, name in enumerate(standards.names):
        priors[f"standard.{name}.q"] = (float(sources.q[i]), float(sources.q_err[i]))
        priors[f"standard.{name}.u"] = (float(sources.u[i]), float(sources.u_err[i]))
    for i in standards.unknown:
        wavelength, _ = standards.bands[i]
        width = half_range(sources, i, calset.exposures, calset.filters)
        priors[f"standard.{standards.names[i]}.wavelength"] = (wavelength, width)
    model = make_model(calset.instrument, instrument, priors=priors)
    for i in model.positions(THROUGHPUT):
        p = model.parameters[i]
        model = model.change(p.name, scale=p.scale * level / LEVEL, loose=level)
    for name in gauges(model, has_known_flux(calset)):
        model = model.change(name, free=False)
    if not calset.exposures.direct("moon").any():
        model = model.change("sky.depolarisation", free=False)
    return model


def _level(calset: CalibrationSet) -> float:
    """Level of the throughput: that of the first field points with a known flux, `LEVEL` where there are none.

    A camera gets half of the unpolarised light: N = T/2.
    """
    for subset, points, exposures in parts_of(calset):
        stated = calset.exposures.flux_known[exposures]
        for start in range(0, len(points) if stated.any() else 0, LEVEL_POINTS):
            block = subset.block(start, min(start + LEVEL_POINTS, len(points)))
            counts = block.counts[block.used & stated]
            if counts.size:
                return float(2.0 * counts.mean())
    return LEVEL


def gauges(model: Model, flux_known: bool) -> list[str]:
    """Parameters that fluxes take up: the scale of the throughput, or all that the cameras of an arm have in common."""
    cameras = model.template.cameras
    if flux_known and not cameras.split:
        return []
    units = tuple(f"throughput.n{camera}." for camera in cameras.units)
    return [name for name in model.names if name.startswith(units)] if units else [GAUGE]


def instrument_of(calset: CalibrationSet) -> Instrument:
    """The instrument of a set as designed, if it comes with the package; `DataError` with advice if not."""
    if calset.instrument not in shipped():
        raise DataError(
            f"INSTRUME is {calset.instrument!r}, which does not come with the package ({', '.join(shipped())}): give "
            "its description, --instrument FILE or instrument=Instrument.read(FILE)"
        )
    return nominal_instrument(calset.instrument)


def has_known_flux(calset: CalibrationSet) -> bool:
    """True if any exposure is of KIND `flux`, so that the overall scale of the throughput is measured."""
    return bool(calset.exposures.flux_known.any())


def model_for(
    calset: CalibrationSet,
    text: str = "",
    instrument: Instrument | None = None,
    catalogue: Catalogue = EFFECTS,
) -> Model:
    """The base model of a calibration set, changed as a model file (TOML text) says; `instrument` as for `base_model`.

    `catalogue` are the effects that the file may name.
    Raises ValueError for anything in the text that does not exist or does not fit the data.
    """

    def build(header: ModelTable) -> Model:
        model = base_model(
            calset, instrument, plates=header.plates, throughput_degree=header.throughput_degree
        )
        model = dataclasses.replace(model, catalogue=known_to(header, catalogue))
        context = effect_context(model.template, calset.exposures)
        return _with_effects(model, header, context)

    return parse(text, build)


def model_like(calset: CalibrationSet, old: Model) -> Model:
    """The model `old` for another calibration set: its plates, effects, priors, ties and what it holds.

    Sky and standards are those of the new set. Raises ValueError for a set of another instrument.
    """
    header = header_of(old)
    model = base_model(calset, old.template, plates=header.plates, throughput_degree=header.throughput_degree)
    own_kinds = dict.fromkeys((*(effect.kind for effect in old.template.effects), *old.catalogue))
    model = dataclasses.replace(model, catalogue=tuple(own_kinds))
    model = _with_effects(model, header, effect_context(model.template, calset.exposures))
    unchanged = {p.name: p for p in old.parameters if p.name != GAUGE and p.part not in SKY_AND_STARS}
    parameters = tuple(
        dataclasses.replace(
            p, free=unchanged[p.name].free, prior=unchanged[p.name].prior, tie=unchanged[p.name].tie
        )
        if p.name in unchanged
        else p
        for p in model.parameters
    )
    return dataclasses.replace(model, parameters=parameters, laws=old.laws)


def model_without_data(
    instrument: str | Instrument,
    text: str = "",
    *,
    standards: Standards | Sequence[tuple[str, float, float]] = (),
    context: Context | None = None,
    catalogue: Catalogue = EFFECTS,
) -> Model:
    """The model of an instrument as designed, for no data in particular.

    `instrument` is one that comes with the package, by name, or any other; `standards` are (name, q, u), or the source
    itself; `context` says what effects that grow with the data need to know of them; `catalogue` are those the text may
    name. Raises `DataError` for an unknown instrument and ValueError as `model_for` does.
    """
    design = nominal_instrument(instrument) if isinstance(instrument, str) else as_designed(instrument)

    def build(header: ModelTable) -> Model:
        nominal = adapted(
            design, standards=standards, plates=header.plates, throughput_degree=header.throughput_degree
        )
        model = make_model(nominal.name, nominal, frozen=(GAUGE,))
        model = dataclasses.replace(model, catalogue=known_to(header, catalogue))
        conditions = context or Context(
            sources=nominal.standard.names, cameras=nominal.cameras.names, units=nominal.units
        )
        return _with_effects(model, header, conditions)

    return parse(text, build)


def known_to(header: ModelTable, catalogue: Catalogue) -> tuple[EffectKind, ...]:
    """A catalogue with the entries that a model file brings along; those of the catalogue stay."""
    names = {effect.name for effect in catalogue}
    stated = {name: table for name, table in header.entries.items() if name not in names}
    return (*catalogue, *entries(stated))


def _with_effects(model: Model, header: ModelTable, context: Context) -> Model:
    effects: list[Any] = []
    for name in header.effects:
        choices: Mapping[str, Any] = header.choices.get(name, {})
        kind = effect_by_name(name, model.catalogue)
        effects.append(kind.of(context, **choices) if choices else kind)
    return with_effects(model, effects, context) if effects else model


def effects_text(names: Sequence[str]) -> str:
    """The model file that adds effects by name and changes nothing else."""
    return f"[model]\neffects = {json.dumps(list(names))}\n" if names else ""
