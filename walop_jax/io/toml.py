"""Tables of TOML files, read by the annotations of their records: each value checked, unknown keys with advice."""

from __future__ import annotations

import dataclasses
import re
import types
import typing
from collections.abc import Iterable, Mapping
from typing import Any

from walop_jax.io.errors import DataError, nearest

Table = Mapping[str, Any]

NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
LARGEST = 1e300
OUT = "out"
"""None, of a number that may be none: an element that is not in the beam."""


@dataclasses.dataclass(frozen=True)
class Reader:
    """Values of a file, checked one by one; `where` (if any) begins every message, `place` is the table."""

    where: str

    def fault(self, place: str, what: str) -> DataError:
        """The error for something that is wrong in a table."""
        text = f"[{place}] {what}" if place else what
        return DataError(f"{self.where}: {text}" if self.where else text)

    def known(self, table: Table, keys: Iterable[str], place: str) -> None:
        """Raise `DataError` for a key that is none of those known."""
        for key in table:
            if key not in keys:
                raise self.fault(place, f"there is no key {key!r}; {nearest(key, keys)}")

    def table(self, value: Any, place: str, what: str = "") -> Table:
        """A table of the file; `DataError` for anything else."""
        if not isinstance(value, Mapping):
            raise self.fault(place, f"{what}{value!r} must be a table")
        return value

    def name(self, value: Any, place: str) -> str:
        """A name that parts of an instrument may have."""
        if not NAME.fullmatch(self.text(value, "name", place)):
            raise self.fault(place, f"{value!r} cannot be a name: letters, digits and _, a letter first")
        return value

    def words(self, value: Any, key: str, place: str) -> tuple[str, ...]:
        """A list of names, each of which occurs once."""
        if not (isinstance(value, list) and value and all(isinstance(word, str) for word in value)):
            raise self.fault(place, f"{key} = {value!r} must be a list of names")
        if len(set(value)) != len(value):
            raise self.fault(place, f"{key} names something twice: {', '.join(value)}")
        return tuple(value)

    def text(self, value: Any, key: str, place: str) -> str:
        """A text on one line."""
        if not isinstance(value, str) or not value.isprintable() or not value.strip():
            raise self.fault(place, f"{key} = {value!r} must be a text on one line")
        return value

    def number(self, value: Any, key: str, place: str) -> float:
        """A finite number; `DataError` for anything else."""
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= LARGEST:
            shown = repr(value) if len(repr(value)) < 80 else "that"
            kind = "one number" if isinstance(value, list) else "a finite number"
            raise self.fault(place, f"{key} = {shown} must be {kind}")
        return float(value)

    def numbers(self, value: Any, key: str, place: str) -> tuple[float, ...]:
        """A list of finite numbers."""
        if not isinstance(value, list) or not value:
            raise self.fault(place, f"{key} = {value!r} must be a list of numbers")
        return tuple(self.number(entry, f"{key}[{i}]", place) for i, entry in enumerate(value))

    def positive(self, value: Any, key: str, place: str, advice: str = "") -> float:
        """A number above 0; `DataError`, with `advice`, for anything else."""
        number = self.number(value, key, place)
        if number <= 0:
            raise self.fault(place, f"{key} = {number:g} must be above 0{advice}")
        return number

    def flag(self, value: Any, key: str, place: str) -> bool:
        """A truth value; `DataError` for anything else."""
        if not isinstance(value, bool):
            raise self.fault(place, f"{key} = {value!r} must be true or false")
        return value

    def whole(self, value: Any, key: str, place: str) -> int:
        """A whole number; `DataError` for anything else."""
        if isinstance(value, bool) or not isinstance(value, int):
            raise self.fault(place, f"{key} = {value!r} must be a whole number")
        return value

    def values(self, hints: Table, table: Any, place: str) -> dict[str, Any]:
        """The values of a table, each converted to the type annotated for its key; keys are those of `hints`."""
        self.known(self.table(table, place), hints, place)
        return {key: self.value(hints[key], value, key, place) for key, value in table.items()}

    def value(self, hint: Any, value: Any, key: str, place: str) -> Any:
        """A value as an annotation wants it: lists as tuples, `OUT` as None where a number may be that."""
        kind, options = typing.get_origin(hint), typing.get_args(hint)
        if kind in (typing.Union, types.UnionType):
            hint = next(option for option in options if option is not types.NoneType)
            return None if hint is float and value == OUT else self.value(hint, value, key, place)
        if kind is tuple:
            pair = options[-1] is not ...
            if not isinstance(value, list | tuple) or (pair and len(value) != len(options)):
                what = "names" if options[0] is str else "two numbers" if pair else "numbers"
                raise self.fault(place, f"{key} = {value!r} must be a list of {what}")
            return tuple(self.value(options[0], entry, key, place) for entry in value)
        if isinstance(kind, type) and issubclass(kind, Mapping):
            entries = self.table(value, place, f"{key} = ").items()
            return {name: self.value(options[1], entry, name, key) for name, entry in entries}
        read = {float: self.number, int: self.whole, bool: self.flag, str: self.text}.get(hint)
        return value if read is None else read(value, key, place)
