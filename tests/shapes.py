"""Checks of every annotated type and shape of the package, which `conftest.py` puts into its import."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import types
from collections.abc import Callable
from typing import Any, get_type_hints

import jaxtyping
from beartype import BeartypeConf, beartype
from beartype.roar import BeartypeDecorHintException

# As in PEP 484, and as pyright has it, an int may stand where a float is asked for.
_beartype = beartype(conf=BeartypeConf(is_pep484_tower=True, violation_type=jaxtyping.TypeCheckError))
_jaxtyped = jaxtyping.jaxtyped
_TOGETHER = _jaxtyped("context")
_RESOLVED: dict[tuple[str, Any], Any] = {}


def check_package() -> None:
    """Check the package from its import on, which must come later."""
    jaxtyping.install_import_hook("walop_jax", "shapes.checked")
    jaxtyping.jaxtyped = lambda typechecker: typechecker  # what the hook puts at every function and class


def checked(function: Any) -> Any:
    """A function whose arguments and result are checked, equal names of axes together; a dataclass made by such.

    What `jaxtyping.jaxtyped` does with `beartype`, in a third of its time: arguments are bound and checked once. The
    check is made at the first call: most functions of the package are never called in a process of tests.
    """
    if inspect.isclass(function):
        if dataclasses.is_dataclass(function) and not hasattr(function.__init__, "checked"):
            function.__init__ = checked(function.__init__)
        return function
    if inspect.isgeneratorfunction(function):  # its arguments count when it is called, not when it begins
        return _jaxtyped(function, typechecker=_comparing)
    if not function.__annotations__:
        return function
    inner: Callable[..., Any] | None = None

    @functools.wraps(function)
    def outer(*args: Any, **kwargs: Any) -> Any:
        nonlocal inner
        inner = inner or _comparing(_with_resolved(function))
        with _TOGETHER:
            return inner(*args, **kwargs)

    outer.checked = True
    return outer


def _with_resolved(function: types.FunctionType) -> types.FunctionType:
    """A copy whose annotations are types."""
    copy = types.FunctionType(
        function.__code__,
        function.__globals__,
        function.__name__,
        function.__defaults__,
        function.__closure__,
    )
    copy.__module__, copy.__qualname__ = function.__module__, function.__qualname__
    copy.__kwdefaults__ = function.__kwdefaults__
    copy.__annotations__ = {name: _resolved(one, function) for name, one in function.__annotations__.items()}
    return copy


def _comparing(function: Callable[..., Any]) -> Callable[..., Any]:
    """`beartype`, which knows no class to compare `Self` and protocols with: such functions stay as they are."""
    try:
        return _beartype(function)
    except BeartypeDecorHintException:
        return function


def _resolved(annotation: Any, function: Callable[..., Any]) -> Any:
    """An annotation without quotes, also inside; what only exists for pyright, or not yet, is Any."""
    key = function.__module__, annotation
    if key not in _RESOLVED:
        unread = types.SimpleNamespace(__annotations__={"hint": annotation})
        try:
            _RESOLVED[key] = get_type_hints(unread, function.__globals__)["hint"]
        except Exception:
            return Any
    return _RESOLVED[key]
