"""Effects in a model: those that it has, those that it knows by name, and the model with more or fewer of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from types import SimpleNamespace

import equinox as eqx
import jax
import numpy as np

from walop_jax.data.records import CalibrationSet, Exposures
from walop_jax.model.compiled import array
from walop_jax.model.conventions import EXTINCTION
from walop_jax.model.effects import EFFECTS, Described, EffectKind, effect_by_name, in_order
from walop_jax.model.effects.base import Context, Effect
from walop_jax.model.effects.factors import largest_factors
from walop_jax.model.instrument import Instrument
from walop_jax.model.parameters import leaves, values_of
from walop_jax.model.planning import hours_of
from walop_jax.model.specification import Model, make_model


def known_effects(model: Model) -> tuple[EffectKind, ...]:
    """The effects that can be added to a model by name: its own catalogue, or the one that comes with the package."""
    return EFFECTS if model.catalogue is None else model.catalogue


def effects_of(model: Model) -> tuple[Effect, ...]:
    """The active effects of a model, in the order of the light path."""
    return tuple(effect for effect in model.template.effects if isinstance(effect, Effect))


def effect_context(instrument: Instrument, exposures: Exposures) -> Context:
    """Facts about a data set for effects: its Moon exposures, its standards, its exposures and their conditions."""
    moon, e = np.flatnonzero(exposures.direct("moon")), exposures
    at = SimpleNamespace(
        hours=hours_of(e), hour_angle=e.ha, temperature=e.temp, exptime=e.exptime, number=np.arange(len(e))
    )
    return Context(
        exposures=len(exposures),
        moon=tuple(moon.tolist()),
        moon_ids=tuple(np.asarray(exposures.exposure)[moon].tolist()),
        sources=instrument.standard.names,
        cameras=instrument.cameras.names,
        extinction=float(polariser.extinction) if (polariser := instrument.polariser) else EXTINCTION,
        units=instrument.units,
        largest=largest_factors(at, instrument.units),
    )


def with_effects(
    model: Model, effects: Sequence[str | EffectKind | Effect], data: Context | CalibrationSet
) -> Model:
    """The model with effects added for some data, in the order of the light path, otherwise unchanged.

    A name or a class adds the effect at its neutral value, at the shape of its first probe; an instance starts at its
    values. Priors are centred on neutral, with the widths of the declarations. Raises ValueError for an unknown
    name, for a duplicate effect, for two effects on one number, and for the name of an effect that has nothing to
    change by itself (`described` without descriptions).

    >>> walop.with_effects(walop.base_model(calset), ["hwp1_axis"], calset).effect_names
    ('hwp1_axis',)
    """
    context = data if isinstance(data, Context) else effect_context(model.template, data.exposures)
    active = list(model.template.effects)
    starts, widths = {}, dict[str, float]()
    for effect in effects:
        if not isinstance(effect, Effect):
            kind = effect_by_name(effect, known_effects(model)) if isinstance(effect, str) else effect
            effect = next((group[0] for group in kind.probes(context)), kind.neutral(context))
            if not leaves(effect) and eqx.tree_equal(effect.patch(model.template), model.template):
                raise ValueError(
                    f"effect {effect.name!r} changes nothing unless it is said what it changes: give its choices, in a "
                    f"model file in [effects.{effect.name}] (sentences = [...] for descriptions), in Python an effect "
                    f"of walop.effect_by_name({effect.name!r})"
                )
        if effect.name in (present.name for present in active):
            raise ValueError(f"effect {effect.name!r} is in the model already")
        active.append(effect)
        neutral = effect.at_neutral(context)
        names = [f"{effect.name}.{leaf.name}" for leaf in leaves(effect)]
        values = zip(np.asarray(values_of(effect)), np.asarray(values_of(neutral)), strict=True)
        starts |= dict(zip(names, values, strict=True))
        widths |= {f"{effect.name}.{label}": w for label, w in effect.prior_widths(context).items()}
    sentences = {text for effect in active if isinstance(effect, Described) for text in effect.sentences}
    for effect in active:
        for text in sentences.intersection(effect.stated):
            raise ValueError(
                f"effect {effect.name!r} and {text!r} change the same number: leave one of them out"
            )
    instrument = dataclasses.replace(model.template, effects=in_order(active))
    # An effect that does not fit the instrument is an error here.
    jax.eval_shape(lambda i: i.patched(), instrument)
    by_name = {p.name: p for p in model.parameters}
    parameters = []
    for p in make_model(model.name, instrument).parameters:
        if p.name in starts:
            start, neutral = map(float, starts[p.name])
            prior = None if p.prior is None else (neutral, widths.get(p.name, p.prior[1]))
            by_name[p.name] = dataclasses.replace(p, start=start, prior=prior)
        parameters.append(by_name[p.name])
    return dataclasses.replace(model, template=jax.tree.map(array, instrument), parameters=tuple(parameters))


def with_descriptions(model: Model, description: Described, data: Context | CalibrationSet) -> Model:
    """The model with further descriptions; those that it has keep their parameters."""
    if Described.name not in model.effect_names:
        return with_effects(model, [description], data)
    earlier = model.template.effect(Described.name)
    assert isinstance(earlier, Described)
    parameters = {p.name: p for p in model.parameters}
    wider = with_effects(model_without(model, Described.name), [earlier.joined(description)], data)
    return dataclasses.replace(wider, parameters=tuple(parameters.get(p.name, p) for p in wider.parameters))


def model_without(model: Model, name: str) -> Model:
    """The model without one effect."""
    effects = tuple(effect for effect in model.template.effects if effect.name != name)
    removed = model.positions(name)
    parameters = tuple(p for i, p in enumerate(model.parameters) if i not in removed)
    template = dataclasses.replace(model.template, effects=effects)
    return dataclasses.replace(model, template=template, parameters=parameters)
