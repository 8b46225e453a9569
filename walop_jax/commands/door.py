"""The public door: what a caller gives to a function, held against what the function asks for.

An unknown keyword is an error with the nearest names, a wrong kind of argument one with what was given and what is
wanted, before anything is done.
"""

from __future__ import annotations

import builtins
import collections.abc
import contextlib
import functools
import inspect
import numbers
import os
import sys
import types
import typing
from collections.abc import Callable, Mapping
from typing import Any

PathLike = str | os.PathLike[str]
SHARED = {"Any": Any, "Mapping": Mapping, "PathLike": PathLike, "Sequence": collections.abc.Sequence}
"""Names that the annotations of shared arguments use."""

WORDS = {
    "CalibrationSet": "a calibration set",
    "Model": "a model",
    "Calibration": "a calibration",
    "FitResult": "a fit",
    "Run": "a run",
    "Instrument": "an instrument",
    "ObservingPlan": "an observing plan",
    "PathLike": "a path",
    "Sequence": "several in a list",
    "Mapping": "a dict",
    "Callable": "a function",
    "NoneType": "None",
    "str": "a text",
    "float": "a number",
    "int": "a whole number",
    "bool": "True or False",
}
"""Kinds of arguments, as messages name them."""


IN_THE_SESSION = ("forward",)

OF_MODELS = ("free", "fixed", "fix", "frozen", "start", "prior", "priors", "tie", "ties", "bounds")
IN_THE_MODEL = (
    "the model says that of its parameters: model=base_model(calset).change('half1.wedge', free=False)"
)
"""Advice on arguments that users of other fitting programs expect."""


class _Names(dict[str, Any]):
    """The names that an annotation may use: of its module, of Python, and the public ones, loaded when asked for.

    Those that are imported for type checkers only, and are not public, stand for anything; all do where `load` is not
    wanted.
    """

    def __init__(self, names: Mapping[str, Any], load: bool = True) -> None:
        super().__init__(names)
        self.load = load

    def __missing__(self, name: str) -> Any:
        import walop_jax

        if hasattr(builtins, name):
            return getattr(builtins, name)
        return getattr(walop_jax, name, Any) if self.load else Any


def annotation(function: Callable[..., Any], parameter: inspect.Parameter) -> Any:
    """The annotation of a parameter, evaluated as far as it can be without loading anything heavy."""
    text = parameter.annotation
    names = _Names(vars(sys.modules[function.__module__]), load=False)
    return eval(text, {}, names) if isinstance(text, str) else text


def kind_in_short(function: Callable[..., Any], parameter: inspect.Parameter) -> Any:
    """The annotation of a parameter without what the command line makes of it."""
    text = parameter.annotation
    if not isinstance(text, str):
        return text
    if text.startswith("Annotated["):
        inner, depth = text.removeprefix("Annotated["), 0
        for k, character in enumerate(inner):
            depth += (character == "[") - (character == "]")
            if character == "," and depth == 0:
                return inner[:k]
    alias = vars(sys.modules[function.__module__]).get(text)
    kind = typing.get_args(alias)[0] if typing.get_origin(alias) is typing.Annotated else text
    return kind.__forward_arg__ if isinstance(kind, typing.ForwardRef) else kind


def bound(
    name: str, signature: inspect.Signature, function: Callable[..., Any], args: tuple[Any, ...], kwargs: Any
) -> dict[str, Any]:
    """The arguments of a call by name, with defaults. Raises TypeError, in a sentence, for what does not fit."""
    parameters = signature.parameters
    kinds = {p.kind for p in parameters.values()}
    if inspect.Parameter.VAR_KEYWORD not in kinds:
        for key in kwargs:
            if key not in parameters:
                from walop_jax.io.errors import nearest

                advice = (
                    IN_THE_MODEL if key in OF_MODELS and "model" in parameters else nearest(key, parameters)
                )
                raise TypeError(f"{name}: there is no argument {key!r}; {advice}")
    try:
        found = signature.bind(*args, **kwargs)
    except TypeError as error:
        raise TypeError(f"{name}: {error}; the arguments are {', '.join(parameters)}") from None
    hints = {key: _kind(function, p) for key, p in parameters.items() if key in found.arguments}
    wrong = {}
    for key, value in found.arguments.items():
        p = parameters[key]
        if p.kind is not inspect.Parameter.VAR_KEYWORD and value is not p.default:
            several = value if p.kind is inspect.Parameter.VAR_POSITIONAL else (value,)
            wrong.update((key, one) for one in several if not _fits(one, hints[key]))
    for key, value in wrong.items():
        swapped = [other for other in wrong if other != key and _fits(value, hints[other])]
        advice = f"; exchange {key} and {swapped[0]}" if swapped else ""
        raise TypeError(f"{name}: {key} is {_described(value)}, but {_wanted(hints[key])} is wanted{advice}")
    found.apply_defaults()
    return dict(found.arguments)


def checked(function: Callable[..., Any], name: str) -> Callable[..., Any]:
    """The function with its arguments looked at before the call, which computes in float64.

    What the session itself compiles later (`IN_THE_SESSION`) is made in the session as it is.
    """
    from walop_jax.model.compiled import float64

    signature = inspect.signature(function)

    @functools.wraps(function)
    def run(*args: Any, **kwargs: Any) -> Any:
        bound(name, signature, function, args, kwargs)
        with contextlib.nullcontext() if name in IN_THE_SESSION else float64():
            return function(*args, **kwargs)

    run.__module__, run.__qualname__ = "walop_jax", name  # where it is found again, by pickle as well
    return run


def _kind(function: Callable[..., Any], parameter: inspect.Parameter) -> Any:
    """The kind of argument that a parameter asks for; Any where that cannot be told."""
    found = parameter.annotation
    names = _Names(SHARED | vars(sys.modules[function.__module__]))
    for _ in range(4):
        if isinstance(found, str):
            found = eval(found, {}, names)
        elif typing.get_origin(found) is typing.Annotated:
            found = typing.get_args(found)[0]
        elif isinstance(found, typing.ForwardRef):
            found = found.__forward_arg__
    return found


def _fits(value: Any, kind: Any) -> bool:
    """True if a value is of a kind, as far as that can be told: a doubt is no error."""
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if kind is Any:
        return True
    if isinstance(kind, typing.ForwardRef):
        return True
    if origin in (typing.Union, types.UnionType):
        return any(_fits(value, one) for one in inner)
    if origin is typing.Literal:
        return value in inner
    if kind is None or kind is types.NoneType:
        return value is None
    if origin is type:
        return isinstance(value, type)
    if origin is collections.abc.Callable:
        return callable(value)
    kind = origin or kind
    if kind in (collections.abc.Sequence, collections.abc.Collection, list, tuple):
        if isinstance(value, str | bytes | Mapping) or not isinstance(value, collections.abc.Iterable):
            return False
        one = inner[0] if inner and kind is not tuple else Any
        return not isinstance(value, list | tuple) or all(_fits(entry, one) for entry in value)
    if kind is float:
        return isinstance(value, numbers.Real) or _is_scalar(value)
    if kind is int:
        return isinstance(value, numbers.Integral) or _is_scalar(value)
    if kind is bool:
        return isinstance(value, bool | int) or type(value).__name__ == "bool"
    if not isinstance(kind, type) or kind.__module__.startswith("jaxtyping"):
        return True
    return isinstance(value, kind)


def _is_scalar(value: Any) -> bool:
    return getattr(value, "shape", None) == ()


def _described(value: Any) -> str:
    """A value as a message names it."""
    name = type(value).__name__
    if isinstance(value, str | os.PathLike):
        return f"the path {os.fspath(value)!r}" if isinstance(value, os.PathLike) else f"the text {value!r}"
    if isinstance(value, bool | int | float) or value is None:
        return repr(value)
    return WORDS.get(name, f"a {name}")


def _wanted(kind: Any) -> str:
    """A kind as a message names it."""
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        words = list(dict.fromkeys(_wanted(one) for one in inner if one is not types.NoneType))
        if "a path" in words and "a text" in words:
            words.remove("a text")
        return " or ".join(words)
    if origin is typing.Literal:
        return " or ".join(repr(one) for one in inner)
    name = getattr(origin or kind, "__name__", str(kind))
    return WORDS.get(name, f"a {name}")
