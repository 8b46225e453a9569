"""`Model`: the list of parameters of an instrument, each free, fixed or tied to another, with its prior.

A vector of values, the freedom of each parameter and the priors have one order, that of the tree; names come from the
tree as well (`parameters.leaves`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int

from walop_jax.io.plain_tables import astropy_table
from walop_jax.io.shapes import Vector
from walop_jax.model.compiled import array
from walop_jax.model.elements.wave_plate import Layer, WavePlate
from walop_jax.model.instrument import Instrument
from walop_jax.model.parameters import Parameter, check_names, leaves, unknown_name, values_of, with_values

THROUGHPUT = "throughput"
"""The part of an instrument that is a smooth map: single terms of it have no meaning."""
GAUGE = "throughput.n0.p00"
"""Its constant for the first camera: the scale of all counts, held where no flux is known."""


@dataclasses.dataclass(frozen=True, repr=False)
class Model:
    """An instrument with its parameters. Immutable: every change returns a new model.

    The model knows nothing of effects but that each one of `template.effects` has a `name` and a method
    `patch(instrument)`; `model.effects.in_models` adds and removes them. It keeps two things for others: `catalogue`,
    the effects that can be added by name (None: those that come with the package), and `laws`, the changes of
    parameters from night to night: the [law] tables of a model file (`model.laws`), unused in a fit of one set.

    >>> model = walop.base_model(calset)
    >>> model.names[:2]
    ('sky.depolarisation', 'standard.STD00.q')
    """

    name: str
    template: Instrument
    parameters: tuple[Parameter, ...]
    catalogue: tuple[Any, ...] | None = None
    laws: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def __repr__(self) -> str:
        effects = ", ".join(self.effect_names) or "none beyond the base model"
        counts = f"{len(self.parameters)} parameters, {len(self.free)} free"
        return f"Model of {self.name}: {counts}; effects: {effects}"

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
            "STATE": (np.array([p.freedom or "free" for p in self.parameters]), "", "free, fixed or tied"),
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
    def effect_names(self) -> tuple[str, ...]:
        """Names of the active effects, in the order in which they change the instrument."""
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
        """Position (n) of the master of each parameter: of the parameter that it is tied to, else its own."""
        place = {p.name: i for i, p in enumerate(self.parameters)}
        return np.array([place[p.tie or p.name] for p in self.parameters], int)

    @property
    def start(self) -> Vector:
        """Start values of all parameters (n), each in its unit; a tied parameter starts at the start value of its
        master.
        """
        return np.array([p.start for p in self.parameters], float)[self.masters]

    @property
    def free(self) -> Int[np.ndarray, " f"]:
        """Positions of the free parameters."""
        return np.array([i for i, p in enumerate(self.parameters) if p.free and p.tie is None], int)

    def selection(self) -> Float[np.ndarray, "n f"]:
        """Matrix (n, f) of ones and zeros: derivative of all parameters in the free ones; a tied one follows its
        master.
        """
        return (self.masters[:, None] == self.free).astype(float)

    def full(self, free_values: Float[np.ndarray, " f"], others: Vector | None = None) -> Vector:
        """All parameters (n) from the values of the free ones (f).

        Fixed parameters are taken from `others`, by default from the start values; a tied parameter has the value of
        its master.
        """
        values = self.start if others is None else np.array(others, float)
        values[self.free] = free_values
        return values[self.masters]

    def thicknesses(self) -> dict[int, Layer]:
        """The free parameters that are thicknesses of crystal layers, by position, each with its layer.

        The layer next to the air behind each plate comes first. A thickness that several layers share is listed once.
        They are found by writing NaN into one parameter at a time and looking which layer has become NaN.
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
        """Positions of the free parameters that are thicknesses of air gaps ahead of plates; only effects have such.

        They are found as in `thicknesses`, by writing NaN into one parameter at a time.
        """
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
        """A full vector of values (n) as a dictionary by name: {"pupil.magnification": 15.67, …}."""
        return dict(zip(self.names, values, strict=True))

    def instrument(self, values: Float[Any, " n"] | None = None) -> Instrument:
        """The instrument with a full vector of values (n, default: start values) in its tree; differentiable in arrays
        of JAX.
        """
        if values is None or not isinstance(values, jax.Array):
            values = np.asarray(self.start if values is None else values, float)
        return with_values(self.template)(values)

    def rearranged(self, values: Vector, arrange: Callable[[Instrument], Instrument]) -> Model | None:
        """The model of the instrument at `values` (n) with its elements arranged otherwise, which are its start values.

        `arrange` is given the bare instrument; its effects act on what comes back. Unlike an effect that does the same,
        this keeps the structure: instruments that differ in the angles of their plates share a program. Ties are
        undone, since an exchange of layers exchanges their parameters. None comes back where an element, and its
        parameters with it, was taken out.
        """
        built = self.instrument(values)
        template = dataclasses.replace(arrange(dataclasses.replace(built, effects=())), effects=built.effects)
        start = np.asarray(values_of(template)).tolist()
        if len(start) != len(self.parameters):
            return None
        parameters = zip(self.parameters, start, strict=True)
        started = tuple(dataclasses.replace(p, start=value, tie=None) for p, value in parameters)
        return dataclasses.replace(self, template=template, parameters=started)


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
    fixed: Sequence[str] = (),
) -> Model:
    """The model of an instrument at its nominal values with the priors of its declarations.

    `priors` adds priors by name (catalogue errors of standards), `fixed` names the parameters that are not fitted.
    """
    priors = dict(priors or {})
    parameters = [
        dataclasses.replace(p.at(value, priors.pop(p.name, None)), free=p.name not in fixed)
        for p, value in zip(leaves(instrument), np.asarray(values_of(instrument)).tolist(), strict=True)
    ]
    names = [p.name for p in parameters]
    for master in [p.tie for p in parameters if p.tie is not None and p.tie not in names]:
        raise unknown_name("parameter to tie to", master, names)
    for missing in [*priors, *(f for f in fixed if f not in names)]:
        raise unknown_name("parameter", missing, names)
    return Model(name=name, template=jax.tree.map(array, instrument), parameters=tuple(parameters))
