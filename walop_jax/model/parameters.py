"""Parameters that know their unit, meaning, source and prior; names derived from the tree that holds them.

A component declares what it can be asked about in two ways. `param` declares a parameter for good: whoever holds the
component has it. `number` declares a number that an instrument may leave fixed; which of them are parameters, with
which prior and from which source, the description of the instrument says (`Element.declared`). Nobody types a second
list of names: they follow from the tree. The value in the tree carries the unit of the declaration (e.g. um or deg),
conversions stand in the equations.
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

PARAMETER = "walop_jax.parameter"
NUMBER = "walop_jax.number"

Vector = Float[Array, " n"]
Shapes = tuple[tuple[tuple[int, ...], str], ...]
NAME = re.compile(r"[A-Za-z0-9_.+*-]+")
"""The names that a parameter may have, in a model as in every file that is written or read."""

AnyComponent = TypeVar("AnyComponent", bound="Component")


@dataclasses.dataclass(frozen=True)
class Declaration:
    """What is known of a parameter beforehand.

    `width` is the standard deviation of the as-built value (None: no prior), `scale` the step a solver should think
    in (the width where there is one). `loose` is the width of a very weak pull toward the start value that keeps
    combinations which the data hardly see from running away; it is no prior knowledge and is not counted as such.
    `name` replaces the name that follows from the tree; `tie` is the name of the parameter whose value it takes.
    """

    unit: str
    about: str
    source: str
    width: float | None = None
    scale: float | None = None
    loose: float | None = None
    name: str | None = None
    tie: str | None = None


class Number(NamedTuple):
    """Unit and meaning of a number that an instrument may leave fixed; `several`: a row of them, at wavelengths."""

    unit: str
    about: str
    several: bool = False


def param(
    *,
    unit: str,
    about: str,
    source: str,
    width: float | None = None,
    scale: float | None = None,
    loose: float | None = None,
    default: float | None = None,
) -> Any:
    """Declare a parameter of an Equinox module; values become float64 arrays."""
    declaration = Declaration(unit, about, source, width, scale, loose)
    extra: dict[str, Any] = {} if default is None else {"default": default}
    return eqx.field(metadata={PARAMETER: declaration}, converter=_array, **extra)


def number(*, unit: str, about: str, default: float | None = 0.0, several: bool = False) -> Any:
    """Declare a number of an Equinox module; values become float64 arrays, None stays: nothing of the kind."""
    return eqx.field(metadata={NUMBER: Number(unit, about, several)}, converter=_array, default=default)


def _array(value: Any) -> Any:
    # With its type said: numbers of weak type would be compiled anew beside arrays.
    return None if value is None else jnp.asarray(value, float)


def unknown_name(what: str, name: str, known: Iterable[str]) -> ValueError:
    """The error for a name that does not exist, with the nearest ones that do."""
    known = list(known)
    near = difflib.get_close_matches(name, known, n=3, cutoff=0.4)
    hint = f"nearest: {', '.join(near)}" if near else f"known: {', '.join(sorted(known)[:12])}"
    return ValueError(f"unknown {what} {name!r}; {hint}")


class Component(eqx.Module):
    """A piece of the instrument; what it declares is what a fit may vary."""

    def labels(self, field: str) -> Sequence[str]:
        """Names, within this component, of the elements of the parameter `field`; "" is the component's own name."""
        return (field,)

    def declarations(self) -> Mapping[str, Declaration]:
        """Its parameters, by field."""
        return field_declarations(type(self))


@dataclasses.dataclass(frozen=True)
class Leaf:
    """One number of the tree: its name, its declaration and the field that holds it."""

    name: str
    declaration: Declaration
    holder: tuple[str, ...]


def _arrays(component: Component, prefix: str, place: tuple[str, ...]) -> Iterator[tuple[Leaf, ...]]:
    """The numbers of every parameter array, in the order in which a tree is flattened."""
    declared = component.declarations()
    for field in dataclasses.fields(component):
        if field.metadata.get("static", False):
            continue
        value = getattr(component, field.name)
        here = (*place, field.name)
        if field.name in declared:
            labels, declaration = component.labels(field.name), declared[field.name]
            if len(labels) != np.size(value):
                raise ValueError(
                    f"{type(component).__name__}.{field.name}: {len(labels)} labels, {np.size(value)} values"
                )
            names = (declaration.name or f"{prefix}{label}".rstrip(".") for label in labels)
            yield tuple(Leaf(name, declaration, here) for name in names)
        elif isinstance(value, tuple):
            for i, child in enumerate(value):
                if isinstance(child, Component) and hasattr(child, "name"):
                    yield from _arrays(child, f"{prefix}{_name(child)}.", (*here, str(i)))
        elif isinstance(value, Component):
            yield from _arrays(value, f"{prefix}{field.name}.", here)


def _name(component: Any) -> str:
    return component.name


def leaves(component: Component) -> tuple[Leaf, ...]:
    """Every parameter of a component, in the order of `values_of`."""
    return tuple(leaf for array in _arrays(component, "", ()) for leaf in array)


def field_declarations(kind: type[Component]) -> dict[str, Declaration]:
    """The parameters that a component class declares for good, by field name."""
    return {f.name: f.metadata[PARAMETER] for f in dataclasses.fields(kind) if PARAMETER in f.metadata}


def numbers_of(kind: type[Component]) -> dict[str, Number]:
    """The numbers that a component class has, by field name."""
    return {f.name: f.metadata[NUMBER] for f in dataclasses.fields(kind) if NUMBER in f.metadata}


# -------------------------------------------------------------------------------- the tree and the vector


def parameter_places(component: Component) -> tuple[tuple[int, int], ...]:
    """For every parameter array its position among the leaves of the flattened tree, and its size."""
    return _places(*shapes_of(component))


@functools.lru_cache(maxsize=256)
def _places(structure: Any, shapes: Shapes) -> tuple[tuple[int, int], ...]:
    component = of_shapes(structure, shapes)
    flat, _ = jax.tree_util.tree_flatten_with_path(component)
    position = {tuple(_key(entry) for entry in path): i for i, (path, _) in enumerate(flat)}
    return tuple((position[array[0].holder], len(array)) for array in _arrays(component, "", ()) if array)


def _key(entry: Any) -> str:
    return str(entry.name if hasattr(entry, "name") else entry.idx)


def values_of(component: Component) -> Vector:
    """The parameters of a component as one vector."""
    arrays = jax.tree_util.tree_leaves(component)
    chosen = [arrays[i] for i, _ in parameter_places(component)]
    tracer: Any = jax.core.Tracer  # pyright: ignore[reportAttributeAccessIssue]
    if not any(isinstance(array, tracer) for array in chosen):
        # By numpy: operations of JAX outside of a program are each compiled as one of their own.
        return jnp.asarray(np.concatenate([np.zeros(0), *map(np.ravel, chosen)]))
    return jnp.concatenate([jnp.ravel(array) for array in chosen])


def shapes_of(tree: Any) -> tuple[Any, Shapes]:
    """Structure of a tree and the shapes and types of its arrays: what two programs have in common."""
    arrays, structure = jax.tree_util.tree_flatten(tree)
    return structure, tuple((tuple(np.shape(a)), jnp.result_type(a).name) for a in arrays)


def of_shapes(structure: Any, shapes: Shapes) -> Any:
    """The tree with shapes in the place of arrays, for `jax.eval_shape`."""
    return jax.tree_util.tree_unflatten(structure, [jax.ShapeDtypeStruct(s, d) for s, d in shapes])


def with_values(component: AnyComponent) -> Callable[[Vector | np.ndarray], AnyComponent]:
    """The function that puts a vector of parameters in the place of those of a component.

    A vector of numpy is cut by numpy, without a program.
    """
    arrays, structure = jax.tree_util.tree_flatten(component)
    places = [i for i, _ in parameter_places(component)]
    shapes = [np.shape(arrays[i]) for i in places]
    ends = np.cumsum([int(np.prod(shape)) for shape in shapes])[:-1]

    def replaced(values: Vector | np.ndarray) -> AnyComponent:
        filled, split = list(arrays), np.split if isinstance(values, np.ndarray) else jnp.split
        for i, part, shape in zip(places, split(values, ends), shapes, strict=True) if places else ():
            filled[i] = jnp.asarray(part.reshape(shape))
        return jax.tree_util.tree_unflatten(structure, filled)

    return replaced
