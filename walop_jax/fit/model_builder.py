"""Models from data, from a model file, or from neither: the one place where the three come together.

The scale of the throughput is a gauge unless a flux is known: the constant of camera N0 is held then. Where every arm
has a flux of its own, the whole series of its first camera is.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from typing import Any

from walop_jax.data.records import CalibrationSet, Sources
from walop_jax.fit.model_file import Header, header_of, parse
from walop_jax.instruments.description import shipped
from walop_jax.io.errors import DataError
from walop_jax.likelihood import limits
from walop_jax.model.build import adapted, as_designed, nominal_instrument
from walop_jax.model.effects import EFFECTS, Context, Effect, effect_by_name
from walop_jax.model.instrument import Instrument
from walop_jax.model.sources import MoonSky, Standards
from walop_jax.model.specification import THROUGHPUT, Model, effect_context, make_model, with_effects

Catalogue = Sequence[type[Effect]]

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
    for one of another name than the set's.
    """
    names = standard_names(calset.sources)
    sources = calset.sources
    level = _throughput_level(calset) if has_known_flux(calset) else LEVEL
    instrument = as_designed(instrument or instrument_of(calset))
    if instrument.name != calset.instrument:
        raise ValueError(
            f"the data come from {calset.instrument}, the instrument described is {instrument.name}"
        )
    if len(instrument.cameras) != calset.cameras:
        raise ValueError(
            f"{instrument.name} has {len(instrument.cameras)} cameras, the data have {calset.cameras}"
        )
    instrument = adapted(
        instrument,
        standards=list(zip(names, sources.q, sources.u, strict=True)),
        plates=plates,
        throughput_degree=throughput_degree,
        throughput=level,
    )
    priors = {}
    for i, name in enumerate(names):
        priors[f"standard.{name}.q"] = (float(sources.q[i]), float(sources.q_err[i]))
        priors[f"standard.{name}.u"] = (float(sources.u[i]), float(sources.u_err[i]))
    model = make_model(calset.instrument, instrument, priors=priors)
    for i in model.positions(THROUGHPUT):
        p = model.parameters[i]
        model = model.change(p.name, scale=p.scale * level / LEVEL, loose=level)
    for name in _gauges(model, has_known_flux(calset)):
        model = model.change(name, free=False)
    if not ((calset.exposures.kind == "moon") & ~calset.exposures.clp_in).any():
        model = model.change("sky.depolarisation", free=False)
    return model


def _gauges(model: Model, flux_known: bool) -> list[str]:
    """What the fluxes take up: the scale of the throughput, or all that the cameras of an arm have in common."""
    cameras = model.template.cameras
    if cameras.split:
        first = tuple(f"throughput.n{a}." for a, _ in cameras.pairs)
        return [name for name in model.names if name.startswith(first)]
    return [] if flux_known else [GAUGE]


def instrument_of(calset: CalibrationSet) -> Instrument:
    """The instrument of a set as designed, if it comes with the package; `DataError` with advice if not."""
    if calset.instrument not in shipped():
        raise DataError(
            f"INSTRUME is {calset.instrument!r}, which does not come with the package ({', '.join(shipped())}): give "
            "its description, --instrument FILE or instrument=Instrument.read(FILE)"
        )
    return nominal_instrument(calset.instrument)


def standard_names(sources: Sources) -> tuple[str, ...]:
    """Unique names of the standards, usable in parameter names."""
    plain = [
        "".join(c if c.isalnum() else "_" for c in str(name).strip()) or f"source{number}"
        for number, name in zip(sources.source, sources.name, strict=True)
    ]
    names: list[str] = []
    for number, name in zip(sources.source, plain, strict=True):
        # A name that another star bears by right is not given to a namesake.
        unique = name
        while unique in names or (unique != name and unique in plain):
            unique = f"{unique}_{number}"
        names.append(unique)
    return tuple(names)


def has_known_flux(calset: CalibrationSet) -> bool:
    """Whether any exposure is of KIND `flux`, so that the overall scale of the throughput is measured."""
    return bool((calset.exposures.kind == "flux").any())


def _throughput_level(calset: CalibrationSet) -> float:
    # A camera gets half of the unpolarised light: N = T/2.
    block = calset.intensities.block(0, min(limits.LEVEL_POINTS, len(calset.points)))
    rows = block.used & (calset.exposures.kind == "flux")
    return float(2.0 * block.counts[rows].mean())


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

    def build(header: Header) -> Model:
        model = base_model(
            calset, instrument, plates=header.plates, throughput_degree=header.throughput_degree
        )
        context = effect_context(model.template, calset.exposures)
        return _with_effects(model, header, context, catalogue)

    return parse(text, build)


def model_like(calset: CalibrationSet, old: Model) -> Model:
    """The model `old` for another calibration set: its plates, effects, priors, ties and what it holds.

    Sky and standards are those of the new set. Raises ValueError for a set of another instrument.
    """
    header = header_of(old)
    model = base_model(calset, old.template, plates=header.plates, throughput_degree=header.throughput_degree)
    own = tuple(type(effect) for effect in old.template.effects)
    model = _with_effects(model, header, effect_context(model.template, calset.exposures), own)
    kept = {p.name: p for p in old.parameters if p.name != GAUGE and p.part not in SKY_AND_STARS}
    parameters = tuple(
        dataclasses.replace(p, free=kept[p.name].free, prior=kept[p.name].prior, tie=kept[p.name].tie)
        if p.name in kept
        else p
        for p in model.parameters
    )
    return dataclasses.replace(model, parameters=parameters)


def model_without_data(
    instrument: str | Instrument,
    text: str = "",
    *,
    standards: Sequence[tuple[str, float, float]] = (),
    context: Context | None = None,
    catalogue: Catalogue = EFFECTS,
) -> Model:
    """The model of an instrument as designed, for no data in particular.

    `instrument` is one that comes with the package, by name, or any other; `standards` are (name, q, u); `context`
    says what effects that grow with the data need to know of them; `catalogue` are those the text may name. Raises
    `DataError` for an unknown instrument and ValueError as `model_for` does.
    """
    design = nominal_instrument(instrument) if isinstance(instrument, str) else as_designed(instrument)

    def build(header: Header) -> Model:
        nominal = adapted(
            design, standards=standards, plates=header.plates, throughput_degree=header.throughput_degree
        )
        model = make_model(nominal.name, nominal, frozen=(GAUGE,))
        known = context or Context(sources=nominal.standard.names)
        return _with_effects(model, header, known, catalogue)

    return parse(text, build)


def _with_effects(model: Model, header: Header, context: Context, catalogue: Catalogue) -> Model:
    effects: list[Any] = []
    for name in header.effects:
        choices: Mapping[str, Any] = header.choices.get(name, {})
        kind = effect_by_name(name, catalogue)
        effects.append(kind.of(context, **choices) if choices else kind)
    return with_effects(model, effects, context) if effects else model


def effects_text(names: Sequence[str]) -> str:
    """The model file that adds effects by name and changes nothing else."""
    return f"[model]\neffects = {json.dumps(list(names))}\n" if names else ""
