"""Effects written as text: `name`, `name=value`, `name=parameter:value,parameter:value`."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

from walop_jax.model.effects import EFFECTS, effect_by_name
from walop_jax.model.effects.base import Context, Effect
from walop_jax.model.parameters import field_declarations, unknown_name


def effect_from_text(text: str, context: Context, catalogue: Sequence[type[Effect]] = EFFECTS) -> Effect:
    """The effect of `catalogue` that a text stands for.

    A value is a number, numbers between slashes (one for each element of the parameter), or a word for a discrete
    choice. Raises ValueError, with the nearest names, for what does not exist, and for values that are missing.
    """
    name, _, rest = (part.strip() for part in text.partition("="))
    kind = effect_by_name(name, catalogue)
    parameters = tuple(field_declarations(kind))
    values: dict[str, Any] = {}
    if rest and ":" not in rest:
        if len(parameters) != 1:
            listed = f"{name}={','.join(f'{n}:…' for n in parameters)}" if parameters else f"{name} alone"
            raise ValueError(f"effect {name!r} has {len(parameters)} parameters, not one: give {listed}")
        values[parameters[0]] = _value(rest, name)
    elif rest:
        values = _named_values(rest, name)
    known = [field.name for field in dataclasses.fields(kind)]
    for parameter in values:
        if parameter not in known:
            error = unknown_name(f"parameter of {name}", parameter, known)
            raise ValueError(f"{error}; {name} takes {', '.join(known)}")
    if parameters and not any(parameter in values for parameter in kind.amplitudes()):
        wanted = " or ".join(kind.amplitudes())
        raise ValueError(f"effect {name!r} changes nothing without a value of {wanted}")
    try:
        return kind.of(context, **values)
    except (TypeError, ValueError) as error:
        raise ValueError(f"effect {name!r}: {rest!r} does not fit its parameters ({error})") from None


def _named_values(text: str, name: str) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for part in text.split(","):
        parameter, colon, value = (piece.strip() for piece in part.partition(":"))
        if not colon or not value or parameter in values:
            raise ValueError(f"effect {name!r}: {part!r} is not par:value (each once)")
        values[parameter] = _value(value, name)
    return values


def _value(text: str, name: str) -> Any:
    try:
        if "/" in text:
            return [float(part) for part in text.split("/")]
        return int(text) if text.lstrip("+-").isdigit() else float(text)
    except ValueError:
        if text.isidentifier():
            return text
        raise ValueError(f"effect {name!r}: {text!r} is not a number") from None
