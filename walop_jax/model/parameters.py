"""Parameters that know their unit, meaning, source and prior; names derived from the tree that holds them.

A module declares a parameter with `param`; nobody types a second list of names. The value in the tree
carries the unit of the declaration (the unit of the contract, e.g. µm or deg), conversions stand in the
equations.
"""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

KEY = "walop_jax.parameter"


@dataclasses.dataclass(frozen=True)
class Declaration:
    """What a module says of one of its parameters.

    `width` is the standard deviation of the as-built value (None: no prior), `scale` the step a solver
    should think in (the width where there is one), `optical` whether it enters before the band integral.
    `loose` is the width of a very weak pull toward the start value that keeps combinations which the data
    hardly see from running away; it is no prior knowledge and is not counted as such.
    """

    unit: str
    about: str
    source: str
    width: float | None = None
    scale: float | None = None
    loose: float | None = None
    optical: bool = False


def param(
    *,
    unit: str,
    about: str,
    source: str,
    width: float | None = None,
    scale: float | None = None,
    loose: float | None = None,
    optical: bool = False,
    default: float | None = None,
) -> Any:
    """Declare a parameter of an Equinox module; values become float64 arrays."""
    declaration = Declaration(unit, about, source, width, scale, loose, optical)
    extra: dict[str, Any] = {} if default is None else {"default": default}
    return eqx.field(metadata={KEY: declaration}, converter=jnp.asarray, **extra)


def unknown_name(what: str, name: str, known: Iterable[str]) -> ValueError:
    """The error for a name that does not exist, with the nearest ones that do."""
    known = list(known)
    near = difflib.get_close_matches(name, known, n=3, cutoff=0.4)
    hint = f"nearest: {', '.join(near)}" if near else f"known: {', '.join(sorted(known)[:12])}"
    return ValueError(f"unknown {what} {name!r}; {hint}")


@dataclasses.dataclass(frozen=True)
class Leaf:
    """One number of the tree: its name, its declaration and the name of the module class that holds it."""

    name: str
    declaration: Declaration
    owner: str


class Component(eqx.Module):
    """A piece of the instrument; its `param` fields are what a fit may vary."""

    def labels(self, field: str) -> Sequence[str]:
        """Names, within this component, of the elements of the parameter `field`."""
        return (field,)


def _walk(component: Component, prefix: str) -> Iterator[Leaf]:
    for field in dataclasses.fields(component):
        if field.metadata.get("static", False):
            continue
        value = getattr(component, field.name)
        declaration = field.metadata.get(KEY)
        if declaration is not None:
            labels = component.labels(field.name)
            if len(labels) != np.size(value):
                raise ValueError(
                    f"{type(component).__name__}.{field.name}: {len(labels)} labels, {np.size(value)} values"
                )
            for label in labels:
                yield Leaf(f"{prefix}{label}", declaration, type(component).__name__)
        elif isinstance(value, tuple):
            for child in value:
                yield from _walk(child, f"{prefix}{child.name}.")
        else:
            yield from _walk(value, f"{prefix}{field.name}.")


def leaves(component: Component) -> tuple[Leaf, ...]:
    """Every number of the tree in the order in which `jax.flatten_util.ravel_pytree` lays them out."""
    return tuple(_walk(component, ""))


def field_declarations(kind: type[Component]) -> dict[str, Declaration]:
    """The parameters that a component class declares, by field name."""
    return {f.name: f.metadata[KEY] for f in dataclasses.fields(kind) if KEY in f.metadata}
