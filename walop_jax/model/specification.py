"""The model as a list of parameters beside their instrument: free or tied ones, with priors.

Three things of one shape: values, freedom and priors. Names come from the tree (`parameters.leaves`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int

from walop_jax.data.records import CalibrationSet, Exposures
from walop_jax.io.display import Display, Displayed
from walop_jax.io.plain_tables import astropy_table
from walop_jax.io.text import with_error, with_minus_sign
from walop_jax.model.compiled import array
from walop_jax.model.conventions import EXTINCTION
from walop_jax.model.effects import EFFECTS, Described, EffectKind, effect_by_name, in_order
from walop_jax.model.effects.base import Context, Effect
from walop_jax.model.effects.factors import largest_factors
from walop_jax.model.elements.wave_plate import Layer, WavePlate
from walop_jax.model.instrument import Instrument
from walop_jax.model.parameters import Parameter, check_names, leaves, unknown_name, values_of, with_values
from walop_jax.model.planning import hours_of

Vector = Float[np.ndarray, " n"]
THROUGHPUT = "throughput"
"""The part of an instrument that is a smooth map: single terms of it have no meaning."""


@dataclasses.dataclass(frozen=True, repr=False)
class Model(Displayed):
    """An instrument with its parameters. Immutable: every change returns a new model.

    `catalogue` are the effects available by name, `laws` the changes of parameters from night to night: the [law]
    tables of a model file (`model.laws`), unused in a fit of one set.

    >>> model = walop.base_model(calset)
    >>> model.names[:2]
    ('sky.depolarisation', 'standard.STD00.q')
    """

    name: str
    template: Instrument
    parameters: tuple[Parameter, ...]
    catalogue: tuple[EffectKind, ...] = dataclasses.field(default_factory=lambda: EFFECTS)
    laws: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def display(self) -> Display:
        """The number of parameters, and all of them but the terms of the throughput."""
        effects = ", ".join(self.effect_names) or "none beyond the base model"
        counts = f"{len(self.parameters)} parameters, {len(self.free)} free"
        rows = tuple(
            (p.name, with_minus_sign(f"{p.start + 0.0:.6g}"), p.unit, prior, p.state, p.about)
            for p in sorted(self.parameters, key=lambda p: p.name.startswith("standard."))
            for prior in ("" if p.prior is None else with_error(p.prior[0] + 0.0, p.prior[1]),)
            if p.part != THROUGHPUT
        )
        hidden = len(self.positions(THROUGHPUT))
        note = (f"{hidden} throughput terms not shown; to_table() has them",) if hidden else ()
        head = ("parameter", ">start", "unit", "prior", "", "meaning")
        return Display(f"Model of {self.name}: {counts}; effects: {effects}", (), head, rows, note)

    def to_table(self) -> Any:
        """All parameters as an astropy table: start value, unit, prior, state and meaning."""
        return astropy_table(self.columns())

    def columns(self) -> dict[str, tuple[np.ndarray, str, str]]:
        """Columns of `to_table`: values, unit and meaning."""
        priors = np.array([p.prior or (np.nan, np.nan) for p in self.parameters]).reshape(-1, 2)
        return {
            "NAME": (np.array(self.names), "", "parameter"),
            "UNIT": (np.array([p.unit for p in self.parameters]), "", "unit of the numbers of this row"),
            "START": (self.start, "", "start value"),
            "PRIOR_MEAN": (priors[:, 0], "", "mean of the prior"),
            "PRIOR_SIGMA": (priors[:, 1], "", "standard deviation of the prior"),
            "STATE": (np.array([p.state or "free" for p in self.parameters]), "", "free, fixed or tied"),
            "ABOUT": (np.array([p.about for p in self.parameters]), "", "meaning"),
        }

    def __post_init__(self) -> None:
        names = self.names
        for p in self.parameters:
            p.checked()
            if p.tie is not None and (
                p.tie not in names or self.parameters[names.index(p.tie)].tie is not None
            ):
                raise ValueError(
                    f"parameter {p.name}: tied to {p.tie!r}, which does not exist or is itself tied"
                )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters, in tree order."""
        return tuple(p.name for p in self.parameters)

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The active effects, in the order of the light path."""
        return tuple(effect for effect in self.template.effects if isinstance(effect, Effect))

    @property
    def effect_names(self) -> tuple[str, ...]:
        """Names of the active effects, in the order of the light path."""
        return tuple(effect.name for effect in self.template.effects)

    def __getitem__(self, name: str) -> Parameter:
        return self.parameters[self.index(name)]

    def index(self, name: str) -> int:
        """Position of a parameter; ValueError with the nearest names when there is none."""
        try:
            return self.names.index(name)
        except ValueError:
            raise unknown_name("parameter", name, self.names) from None

    def positions(self, component: str) -> Int[np.ndarray, " _"]:
        """Positions of the parameters of a part or an effect, in tree order; none where the model has none."""
        owners = (f"{p.part}." for p in self.parameters)
        return np.array([i for i, owner in enumerate(owners) if owner.startswith(f"{component}.")], int)

    def change(self, name: str, **changes: Any) -> Model:
        """The model with fields of one parameter replaced. Raises ValueError for meaningless values."""
        i = self.index(name)
        check_names("field of a parameter", changes, Parameter.__dataclass_fields__)
        changed = dataclasses.replace(self.parameters[i], **changes).checked()
        return dataclasses.replace(
            self, parameters=(*self.parameters[:i], changed, *self.parameters[i + 1 :])
        )

    # ------------------------------------------------------------------------------ vectors and the tree

    @property
    def masters(self) -> Int[np.ndarray, " n"]:
        """For each parameter the position of its master: the parameter of its tie, else itself."""
        place = {p.name: i for i, p in enumerate(self.parameters)}
        return np.array([place[p.tie or p.name] for p in self.parameters], int)

    @property
    def start(self) -> Vector:
        """Start values of all parameters; a tied one starts where its master does."""
        return np.array([p.start for p in self.parameters], float)[self.masters]

    @property
    def free(self) -> Int[np.ndarray, " f"]:
        """Positions of the free parameters."""
        return np.array([i for i, p in enumerate(self.parameters) if p.free and p.tie is None], int)

    def selection(self) -> Float[np.ndarray, "n f"]:
        """Derivative of all parameters with respect to the free ones: ones, ties included."""
        return (self.masters[:, None] == self.free).astype(float)

    def full(self, free_values: Float[np.ndarray, " f"], others: Vector | None = None) -> Vector:
        """All parameters from the values of the free ones, the fixed ones from `others` (default: the start).

        A tied parameter has the value of its master, not that in `others`.
        """
        values = self.start if others is None else np.array(others, float)
        values[self.free] = free_values
        return values[self.masters]

    def thicknesses(self) -> dict[int, Layer]:
        """The free parameters that are thicknesses of crystal layers, by position, each with its layer.

        The layers next to the air behind each plate come first; a thickness shared by several layers is listed once.
        """
        behind: dict[int, Layer] = {}
        inside: dict[int, Layer] = {}
        masters, free, marked = self.masters, set(self.free.tolist()), float("nan")
        for place, plate in _wave_plates(self.template):
            layers = plate.layers
            for i, layer in enumerate(layers):
                new = (*layers[:i], dataclasses.replace(layer, thickness=marked), *layers[i + 1 :])
                at = np.flatnonzero(np.isnan(values_of(self.template.changed(place, layers=new))))
                for master in free.intersection(masters[at].tolist()):
                    (behind if i == len(layers) - 1 else inside).setdefault(master, layer)
        return behind | {master: layer for master, layer in inside.items() if master not in behind}

    def gaps(self) -> tuple[int, ...]:
        """Positions of the free thicknesses of air gaps ahead of plates, all from effects."""
        if not any(plate.air_gaps for _, plate in _wave_plates(self.template.patched())):
            return ()

        def moves_one(position: int) -> bool:
            marked = self.start
            marked[position] = np.nan
            plates = _wave_plates(self.instrument(marked[self.masters]).patched())
            return any(bool(np.isnan(gap.gap)) for _, plate in plates for gap in plate.air_gaps)

        of_effects = {i for name in self.effect_names for i in self.positions(name).tolist()}
        return tuple(i for i in self.free.tolist() if i in of_effects and moves_one(i))

    def named(self, values: Float[Any, " n"]) -> dict[str, Any]:
        """A full vector of values by the names of the parameters."""
        return dict(zip(self.names, values, strict=True))

    def instrument(self, values: Float[Any, " n"] | None = None) -> Instrument:
        """The instrument at a full vector of values (default: start values); differentiable in arrays of JAX."""
        if values is None or not isinstance(values, jax.Array):
            values = np.asarray(self.start if values is None else values, float)
        return with_values(self.template)(values)


def _wave_plates(instrument: Instrument) -> Iterator[tuple[str, WavePlate]]:
    """The wave plates of an instrument with their places."""
    for place in instrument.places(WavePlate):
        plate = instrument.element(place)
        assert isinstance(plate, WavePlate)
        yield place, plate


def series_indices(instrument: Instrument) -> Int[np.ndarray, " kt"]:
    """Positions of the throughput coefficients (cameras × terms, contiguous)."""
    return np.array([i for i, leaf in enumerate(leaves(instrument)) if leaf.part == THROUGHPUT], int)


def make_model(
    name: str,
    instrument: Instrument,
    *,
    priors: Mapping[str, tuple[float, float]] | None = None,
    frozen: Sequence[str] = (),
) -> Model:
    """The model of an instrument at its nominal values with the priors of its declarations.

    `priors` adds priors by name (catalogue errors of standards), `frozen` names fixed parameters.
    """
    priors = dict(priors or {})
    parameters = [
        dataclasses.replace(p.at(value, priors.pop(p.name, None)), free=p.name not in frozen)
        for p, value in zip(leaves(instrument), np.asarray(values_of(instrument)).tolist(), strict=True)
    ]
    names = [p.name for p in parameters]
    for master in [p.tie for p in parameters if p.tie is not None and p.tie not in names]:
        raise unknown_name("parameter to tie to", master, names)
    for missing in [*priors, *(f for f in frozen if f not in names)]:
        raise unknown_name("parameter", missing, names)
    return Model(name=name, template=jax.tree.map(array, instrument), parameters=tuple(parameters))


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
            kind = effect_by_name(effect, model.catalogue) if isinstance(effect, str) else effect
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


def with_sentences(model: Model, description: Described, data: Context | CalibrationSet) -> Model:
    """The model with further sentences; those that it has keep their parameters."""
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
