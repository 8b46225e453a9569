"""Parameters with unit, meaning, source and prior; their names follow from their tree.

`Parameter` is the only record of a number. A component declares its numbers in one of three ways:

    param     a permanent parameter of every instance: δ of the moonlit sky, the amplitude of an effect
    number    a number that is a parameter only if the description of the instrument says so: thickness of a plate
    row       several numbers of that kind in one array: the values of a curve over wavelength

The description lists the parameters among the numbers, with prior and source (`Element.declared`). There is no second
list of names: names follow from the tree. The value in the tree has the unit of the declaration (um or deg, for
example), and conversions are part of the equations.
"""

from __future__ import annotations

import dataclasses
import functools
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from walop_jax.io.code import blank
from walop_jax.io.errors import nearest
from walop_jax.io.text import in_its_unit
from walop_jax.model.compiled import array, float64

PARAMETER = "walop_jax.parameter"
NUMBER = "walop_jax.number"
SEVERAL = "walop_jax.several"

ParameterVector = Float[Array, " n"]
Scalar = Float[Array, ""]
NAME = re.compile(r"[A-Za-z0-9_.+*-]+")
"""Valid names of parameters, in models and in files."""

AnyComponent = TypeVar("AnyComponent", bound="Component")
Result = TypeVar("Result")


@dataclasses.dataclass(frozen=True, repr=False)
class Parameter:
    """One number of an instrument: its name, what is known of it beforehand, and whether a fit varies it.

    `prior` is (mean, standard deviation) or None; `scale` the natural step of a solver; `loose` the width of a weak
    pull toward `start`, which bounds combinations that the data hardly see and is no prior knowledge; `tie` the name of
    the parameter whose value this one takes. `part` is the component, as for `Instrument.changed`: "half1.plate",
    "throughput", "sky", or the name of an effect. All are in `unit`.

    A number is `declared` before it has a value. The mean of its prior is then relative to the value that comes: ±0.3
    about the measured angle. Its `scale` may be 0, and follows from the prior or the value. A `name` that is given
    replaces the name that the tree would give: `pupil.magnification` for the magnification of the element `pupil`.

    >>> walop.base_model(calset)["pupil.magnification"]
    Parameter pupil.magnification = 15.63, prior 15.63 ± 0.05, free: field-to-pupil magnification
    """

    name: str
    unit: str
    about: str
    source: str
    start: float = 0.0
    prior: tuple[float, float] | None = None
    free: bool = True
    scale: float = 0.0
    loose: float | None = None
    tie: str | None = None
    part: str = ""

    def __repr__(self) -> str:
        value = in_its_unit(f"{self.start:.7g}", self.unit)
        prior = "" if self.prior is None else f", prior {self.prior[0]:.7g} ± {self.prior[1]:.2g}"
        return (
            f"Parameter {self.name or '(declared)'} = {value}{prior}, {self.freedom or 'free'}: {self.about}"
        )

    @property
    def width(self) -> float | None:
        """Standard deviation of the prior, None where there is none."""
        return None if self.prior is None else self.prior[1]

    @property
    def freedom(self) -> str:
        """ "fixed", or "tied to NAME"; an empty string for a free parameter."""
        return f"tied to {self.tie}" if self.tie is not None else "" if self.free else "fixed"

    def at(self, value: float, prior: tuple[float, float] | None = None) -> Parameter:
        """This declaration with the value `value`; `prior` (mean, standard deviation) replaces the declared prior."""
        if prior is None and self.prior is not None:
            prior = value + self.prior[0], self.prior[1]
        scale = prior[1] if prior is not None else self.scale or max(abs(value), 1e-3)
        return dataclasses.replace(self, start=value, prior=prior, scale=scale)

    def checked(self) -> Parameter:
        """The parameter itself. Raises ValueError for an invalid name and for meaningless numbers."""
        if not NAME.fullmatch(self.name):
            raise ValueError(f"parameter {self.name!r}: a name has letters, digits and _ . + - * only")
        if not _finite(self.start):
            raise ValueError(f"parameter {self.name}: start = {self.start!r} must be a finite number")
        if self.prior is not None:
            is_pair = isinstance(self.prior, tuple) and len(self.prior) == 2 and all(map(_finite, self.prior))
            if not is_pair or self.prior[1] <= 0:
                raise ValueError(
                    f"parameter {self.name}: prior = {self.prior!r} must be None, or the tuple (mean, standard "
                    "deviation), finite and the second above 0"
                )
        if not (_finite(self.scale) and self.scale > 0):
            raise ValueError(f"parameter {self.name}: scale = {self.scale!r} must be a number above 0")
        return self


def _finite(value: Any) -> bool:
    return isinstance(value, int | float | np.number) and bool(np.isfinite(value))


def param(
    unit: str,
    about: str,
    source: str,
    *,
    width: float | None = None,
    scale: float | None = None,
    loose: float | None = None,
    default: float | tuple[()] | None = None,
) -> Any:
    """Declare a parameter of an Equinox module; values become float64 arrays.

    >>> gain = walop.param(unit="", about="gain of the camera", source="measured", width=0.01)
    """
    prior = None if width is None else (0.0, width)
    declared = Parameter("", unit, about, source, prior=prior, scale=scale or 0.0, loose=loose)
    extra: dict[str, Any] = {} if default is None else {"default": default}
    return eqx.field(metadata={PARAMETER: declared}, converter=as_number, **extra)


def number(unit: str, about: str, *, default: float | None = 0.0) -> Any:
    """Declare a number of an Equinox module, optionally a parameter in a description.

    Values become float64 arrays; None stays, for an absent number.

    >>> class Sheet(walop.Element):
    ...     thickness: walop.Scalar = walop.number("um", "thickness", default=50.0)
    >>> Sheet().thickness
    Array(50., dtype=float64)
    """
    metadata = {NUMBER: Parameter("", unit, about, ""), SEVERAL: False}
    return eqx.field(metadata=metadata, converter=as_number, default=default)


def row(unit: str, about: str) -> Any:
    """Declare a row of numbers, absent unless given, otherwise as `number`."""
    metadata = {NUMBER: Parameter("", unit, about, ""), SEVERAL: True}
    return eqx.field(metadata=metadata, converter=as_number, default=None)


def as_number(value: Any) -> Any:
    """A value as a float64 array; None stays None.

    The type is explicit: numbers of Python are weakly typed, and beside arrays they would be compiled as programs of
    their own.
    """
    if value is None or (isinstance(value, jax.Array) and value.dtype == float and not value.weak_type):
        return value
    if isinstance(value, bool | int | float | np.ndarray | np.generic):
        return array(value, float)  # a tenth of the time: lists of candidates hold thousands of numbers
    with float64():
        return jnp.asarray(value, float)


def unknown_name(what: str, name: str, known: Iterable[str]) -> ValueError:
    """The ValueError for an unknown name, which lists the nearest valid names."""
    return ValueError(f"there is no {what} {name!r}; {nearest(name, known)}")


def check_names(what: str, names: Iterable[str], known: Collection[str]) -> None:
    """Raise ValueError, with the nearest names, for the first unknown name."""
    for name in names:
        if name not in known:
            raise unknown_name(what, name, known)


class Component(eqx.Module):
    """A piece of the instrument; a fit may vary its declared parameters."""

    # Methods of Equinox modules are trees, whose making took a tenth of a second fit; these are plain methods.
    __getattribute__ = object.__getattribute__

    def __reduce__(self) -> tuple[Any, ...]:
        return blank, (type(self),), self.__getstate__()

    def labels(self, field: str) -> Sequence[str]:
        """Names, within this component, of the elements of the parameter `field`; "" is the component's own name."""
        return (field,)

    def declarations(self) -> Mapping[str, Parameter]:
        """The parameters of this component, by field: those that its class declares and those that the description
        `declared`.
        """
        return {**field_declarations(type(self)), **dict(getattr(self, "declared", ()))}


Holder = tuple[str, ...]
"""Path to an array of the tree: fields and positions."""


def _arrays(
    component: Component, part: str = "", path: Holder = ()
) -> Iterator[tuple[Holder, tuple[Parameter, ...]]]:
    """The parameters of every array of a tree, in the order in which the tree is flattened."""
    declared = component.declarations()
    for field in dataclasses.fields(component):
        if field.metadata.get("static", False):
            continue
        value, holder = getattr(component, field.name), (*path, field.name)
        if field.name in declared:
            yield holder, _named(component, field.name, declared[field.name], value, part)
        elif isinstance(value, dict):
            for name in (name for name in declared if name in value):
                yield (*holder, name), _named(component, name, declared[name], value[name], part)
        elif isinstance(value, tuple):
            for i, child in enumerate(value):
                if isinstance(child, Component) and hasattr(child, "name"):
                    name: Any = child.name
                    yield from _arrays(child, f"{part}.{name}".strip("."), (*holder, str(i)))
        elif isinstance(value, Component):
            yield from _arrays(value, f"{part}.{field.name}".strip("."), holder)


def _named(
    component: Component, name: str, declared: Parameter, value: Any, part: str
) -> tuple[Parameter, ...]:
    """The parameters of one array: one for a number, one for each element of a row."""
    labels = component.labels(name)
    if len(labels) != np.size(value):
        raise ValueError(f"{type(component).__name__}.{name}: {len(labels)} labels, {np.size(value)} values")
    names = (declared.name or f"{part}.{label}".strip(".") for label in labels)
    return tuple(dataclasses.replace(declared, name=name, part=part) for name in names)


def leaves(component: Component) -> tuple[Parameter, ...]:
    """Every parameter of a component as declared, with its name and place, in the order of `values_of`."""
    return tuple(parameter for _, array in _arrays(component) for parameter in array)


def field_declarations(kind: type[Component]) -> dict[str, Parameter]:
    """The permanent parameters of a component class, by field name."""
    return {f.name: f.metadata[PARAMETER] for f in dataclasses.fields(kind) if PARAMETER in f.metadata}


def numbers_of(kind: type[Component]) -> dict[str, Parameter]:
    """The numbers of a component class, by field name."""
    return {f.name: f.metadata[NUMBER] for f in dataclasses.fields(kind) if NUMBER in f.metadata}


def is_row(kind: type[Component], number: str) -> bool:
    """True if a number of a component class is a row of values."""
    return next(f.metadata[SEVERAL] for f in dataclasses.fields(kind) if f.name == number)


# -------------------------------------------------------------------------------- the tree and the vector


def by_shapes(function: Callable[..., Result]) -> Callable[..., Result]:
    """Decorator for a function whose result depends only on the structure of its trees and the shapes of their arrays.

    The function is called with `jax.ShapeDtypeStruct` in the place of arrays, once for each structure; its result is
    kept.
    """

    @functools.lru_cache(maxsize=1024)
    def of_shapes(structure: Any, shapes: tuple[tuple[tuple[int, ...], str], ...]) -> Result:
        return function(*jax.tree.unflatten(structure, [jax.ShapeDtypeStruct(*shape) for shape in shapes]))

    @functools.wraps(function)
    def call(*trees: Any) -> Result:
        arrays, structure = jax.tree.flatten(trees)
        return of_shapes(structure, tuple((np.shape(a), jnp.result_type(a).name) for a in arrays))

    return call


@by_shapes
def parameter_places(component: Component) -> tuple[tuple[int, int], ...]:
    """For every parameter array its position among the leaves of the flattened tree, and its size."""
    flat, _ = jax.tree_util.tree_flatten_with_path(component)

    def key(entry: Any) -> str:
        return str(next(getattr(entry, of) for of in ("name", "idx", "key") if hasattr(entry, of)))

    position = {tuple(map(key, path)): i for i, (path, _) in enumerate(flat)}
    return tuple((position[holder], len(array)) for holder, array in _arrays(component) if array)


def values_of(component: Component) -> ParameterVector:
    """The parameters of a component as one vector (n), in the order of `leaves`, each in its unit."""
    arrays = jax.tree_util.tree_leaves(component)
    chosen = [arrays[i] for i, _ in parameter_places(component)]
    tracer: Any = jax.core.Tracer  # pyright: ignore[reportAttributeAccessIssue]
    if not any(isinstance(array, tracer) for array in chosen):
        # By numpy: operations of JAX outside of a program are each compiled as one of their own.
        return array(np.concatenate([np.zeros(0), *map(np.ravel, chosen)]))
    return jnp.concatenate([jnp.ravel(array) for array in chosen])


def with_values(component: AnyComponent) -> Callable[[ParameterVector | np.ndarray], AnyComponent]:
    """A function that takes a vector (n) of parameters and returns the component with these in their places.

    A vector of numpy is cut by numpy, without a compiled program.
    """
    arrays, structure = jax.tree_util.tree_flatten(component)
    places = [i for i, _ in parameter_places(component)]
    shapes = [np.shape(arrays[i]) for i in places]
    ends = np.cumsum([int(np.prod(shape)) for shape in shapes])[:-1]

    def replaced(values: ParameterVector | np.ndarray) -> AnyComponent:
        filled, split = list(arrays), np.split if isinstance(values, np.ndarray) else jnp.split
        for i, segment, shape in zip(places, split(values, ends), shapes, strict=True) if places else ():
            filled[i] = array(segment.reshape(shape))
        return jax.tree_util.tree_unflatten(structure, filled)

    return replaced
