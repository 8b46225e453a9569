"""Code that is only read: do the names exist that it takes from the package, and do its calls fit their signatures?

Types of variables follow from what functions say they return, as far as they say it; nothing else is complained of.
"""

from __future__ import annotations

import ast
import dataclasses
import functools
import importlib
import inspect
import pkgutil
import re
import types
from collections.abc import Sequence
from typing import Any, NamedTuple

import walop_jax
from walop_jax.io.display import Drawn
from walop_jax.reports.named import FIGURES, OF_RESULTS


class _An(NamedTuple):
    """Some object of a class."""

    kind: type


def complaints(cells: Sequence[str], own: Sequence[str] = ()) -> list[str]:
    """What does not exist or does not fit in pieces of code that share their variables.

    `own` are modules beside the code that count as the package's.
    """
    reader = _Reader(("walop_jax", *own))
    for cell in cells:
        reader.visit(ast.parse(cell))
    return reader.found


class _Reader(ast.NodeVisitor):
    def __init__(self, ours: tuple[str, ...]) -> None:
        self.ours, self.found, self.known = ours, list[str](), dict[str, Any]()

    def visit_Import(self, node: ast.Import) -> None:
        for name in node.names:
            module = importlib.import_module(name.name) if self._own(name.name) else None
            self.known[name.asname or name.name] = module

    def visit_ImportFrom(self, node: ast.ImportFrom) -> None:
        module = importlib.import_module(str(node.module)) if self._own(str(node.module)) else None
        for name in node.names:
            self.known[name.asname or name.name] = None if module is None else self._member(module, name.name)

    def visit_Assign(self, node: ast.Assign) -> None:
        value = self._value(node.value)
        for target in node.targets:
            if isinstance(target, ast.Tuple):
                fields = (
                    value.kind._fields if isinstance(value, _An) and hasattr(value.kind, "_fields") else ()
                )
                for k, one in enumerate(target.elts):
                    self._bind(one, self._member(value, fields[k]) if k < len(fields) else None)
            else:
                self._bind(target, value)

    def visit_For(self, node: ast.For) -> None:
        self._value(node.iter)
        self._bind(node.target, None)
        for line in node.body:
            self.visit(line)

    def visit_Attribute(self, node: ast.Attribute) -> None:
        self._value(node)

    def visit_Call(self, node: ast.Call) -> None:
        self._value(node)

    def _bind(self, target: ast.AST, value: Any) -> None:
        for one in ast.walk(target):
            if isinstance(one, ast.Name):
                self.known[one.id] = value if one is target else None

    def _own(self, module: str) -> bool:
        return module.split(".")[0] in self.ours

    def _value(self, node: ast.AST) -> Any:
        """The object that an expression stands for, or some object of its class; None: nobody knows."""
        if isinstance(node, ast.Name):
            return self.known.get(node.id)
        if isinstance(node, ast.Attribute):
            return self._member(self._value(node.value), node.attr)
        if not isinstance(node, ast.Call):
            self.generic_visit(node)
            return None
        function = self._value(node.func)
        for argument in (*node.args, *(word.value for word in node.keywords)):
            self._value(argument)
        return self._called(function, node) if callable(function) and not isinstance(function, _An) else None

    def _member(self, of: Any, name: str) -> Any:
        if isinstance(of, _An):
            said = _annotations(of.kind)
            if not any(_may_have(one, name) for one in _family(of.kind)):
                self.found.append(f"{of.kind.__name__} has no {name}")
            member = inspect.getattr_static(of.kind, name, None)
            if isinstance(member, types.FunctionType):
                return types.MethodType(member, of)
            getter = getattr(member, "fget", None) or getattr(member, "func", None)
            return _some(said.get(name) if getter is None else getter.__annotations__.get("return"))
        if of is None or not (inspect.ismodule(of) or inspect.isclass(of)):
            return None
        if inspect.ismodule(of) and not hasattr(of, name):
            try:
                return importlib.import_module(f"{of.__name__}.{name}")
            except ImportError:
                self.found.append(f"{of.__name__} has no {name}")
        return getattr(of, name, None)

    def _called(self, function: Any, node: ast.Call) -> Any:
        of = getattr(function, "__self__", None)
        drawn = isinstance(of, _An) and issubclass(of.kind, Drawn) and function.__name__ == "plot"
        named = getattr(node.args[0], "value", None) if drawn and node.args else None
        if isinstance(named, str) and named not in {**FIGURES, **OF_RESULTS}:
            self.found.append(f"there is no figure {named}")
        starred = [one for one in node.args if isinstance(one, ast.Starred)]
        any_words = inspect.isclass(function) and issubclass(function, Exception)  # they have no signature
        if not starred and not any_words and all(word.arg for word in node.keywords):
            words = {str(word.arg): None for word in node.keywords}
            try:
                inspect.signature(function).bind(*(None for _ in node.args), **words)
            except TypeError as error:
                self.found.append(f"{ast.unparse(node.func)}: {error}")
        if inspect.isclass(function):
            return _An(function)
        command = getattr(function, "command", None)
        return _some((function if command is None else command.body).__annotations__.get("return"))


def _annotations(kind: type) -> dict[str, Any]:
    return {
        name: text
        for one in reversed(kind.__mro__)
        for name, text in vars(one).get("__annotations__", {}).items()
    }


def _family(kind: type) -> list[type]:
    """A class and all that are made of it: what is there may be any of them."""
    return [kind, *(one for child in kind.__subclasses__() for one in _family(child))]


def _may_have(kind: type, name: str) -> bool:
    by_hand = "__init__" in vars(kind) and not dataclasses.is_dataclass(kind)  # gives itself what it likes
    return by_hand or hasattr(kind, name) or name in _annotations(kind)


@functools.cache
def _classes() -> dict[str, type]:
    """All classes of the package; names are there once (`test_house`)."""
    found: dict[str, type] = {}
    for module in pkgutil.walk_packages(walop_jax.__path__, "walop_jax."):
        if not module.name.startswith(("walop_jax.__main__", "walop_jax.docs")):
            held = vars(importlib.import_module(module.name)).values()
            found |= {
                kind.__name__: kind
                for kind in held
                if inspect.isclass(kind) and kind.__module__ == module.name
            }
    return found


def _some(annotation: Any) -> _An | None:
    """Some object of the class that an annotation names."""
    name = getattr(annotation, "__forward_arg__", annotation)
    name = name if isinstance(name, str) else getattr(name, "__name__", "")
    kind = _classes().get(re.sub(r"^Outcome\[(\w+)\]$", r"\1", name))
    return None if kind is None else _An(kind)
