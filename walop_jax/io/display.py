"""Display of results where they are looked at: in a terminal as text, in a notebook as HTML."""

from __future__ import annotations

import abc
import dataclasses
import html
import importlib
import itertools
import re
from collections.abc import Collection, Iterator, Mapping
from typing import Any, ClassVar

from walop_jax.io.code import blank
from walop_jax.io.errors import PathLike

MOST_LINES = 25
"""Largest number of lines of the `repr` of a result."""


@dataclasses.dataclass(frozen=True)
class Display:
    """A title, facts (name, text), a table, and notes below it.

    `head` names the columns of the table; those that begin with ">" are flush right.
    """

    title: str
    facts: tuple[tuple[str, str], ...] = ()
    head: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()
    notes: tuple[str, ...] = ()

    def text(self) -> str:
        """Plain text without a final newline."""
        return "\n".join(self._lines())

    def _lines(self) -> Iterator[str]:
        yield self.title
        width = max((len(name) for name, _ in self.facts), default=0)
        for name, value in self.facts:
            yield f"  {name:<{width}}  {signed(value)}"
        if self.rows:
            table = [tuple(name.removeprefix(">") for name in self.head), *self.rows]
            widths = [max(len(row[k]) for row in table) for k in range(len(self.head))]
            for row in table:
                cells = (
                    f"{signed(cell):>{w}}" if name.startswith(">") else f"{signed(cell):<{w}}"
                    for cell, w, name in zip(row, widths, self.head, strict=True)
                )
                yield ("  " + "  ".join(cells)).rstrip()
        yield from (f"  {note}" for note in self.notes)

    def document(self) -> dict[str, Any]:
        """The display as plain data."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> Display:
        """The display that a `document` was made of. Raises KeyError or TypeError for any other document."""
        return cls(
            str(document["title"]),
            tuple((str(name), str(words)) for name, words in document["facts"]),
            tuple(map(str, document["head"])),
            tuple(tuple(map(str, row)) for row in document["rows"]),
            tuple(map(str, document["notes"])),
        )

    def without(self, gone: Collection[str]) -> Display:
        """The display without the facts of these names; a line without a name goes with the line above it."""
        facts, dropped = [], False
        for name, text in self.facts:
            dropped = name in gone if name else dropped
            if not dropped:
                facts.append((name, text))
        return dataclasses.replace(self, facts=tuple(facts))

    def shortened(self, most: int) -> Display:
        """The display in at most `most` lines: rows of the table are left out, and it says how many."""
        room = most - 3 - len(self.facts) - len(self.notes)
        if len(self.rows) <= room + 1:
            return self
        rows = self.rows[: max(room, 1)]
        note = f"… and {len(self.rows) - len(rows)} more rows"
        return dataclasses.replace(self, rows=rows, notes=(note, *self.notes))

    def html(self) -> str:
        """HTML that takes its colours from the page that it stands in."""
        return "".join(self._elements())

    def _elements(self) -> Iterator[str]:
        yield f"<div><p><strong>{html.escape(self.title)}</strong></p>"
        if self.facts:
            rows = (f"<tr>{_cell('th', name)}{_cell('td', signed(value))}</tr>" for name, value in self.facts)
            yield f"<table>{''.join(rows)}</table>"
        if self.rows:
            head = "".join(_cell("th", name.removeprefix(">"), name) for name in self.head)
            cells = (map(_cell, itertools.repeat("td"), map(signed, row), self.head) for row in self.rows)
            body = "".join(f"<tr>{''.join(row)}</tr>" for row in cells)
            yield f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
        yield from (f"<p>{html.escape(note)}</p>" for note in self.notes)
        yield "</div>"


def signed(text: str) -> str:
    """A fact or a cell with true minus signs; hyphens of names, dates and options stay."""
    return re.sub(r"(?<![^\s(])-(?=\.?\d)", "−", text)


def _cell(tag: str, text: str, column: str = "") -> str:
    side = "right; font-variant-numeric: tabular-nums" if column.startswith(">") else "left"
    return f'<{tag} style="text-align: {side}">{html.escape(text)}</{tag}>'


class ShortDir:
    """Something whose `dir`, and with it the completion of names in a session, lists what a user may want.

    `_working` are the parts and methods by which other rooms make and change it: they are left out.
    """

    _working: ClassVar[tuple[str, ...]] = ()

    def __dir__(self) -> list[str]:
        working = {name for cls in type(self).__mro__ for name in vars(cls).get("_working", ())}
        return sorted(set(super().__dir__()) - working)


class Displayed(ShortDir, abc.ABC):
    """Something that shows itself as a short table instead of as everything that it holds."""

    @abc.abstractmethod
    def display(self) -> Display:
        """Title, facts, table and notes to show."""

    def __reduce__(self) -> tuple[Any, ...]:
        return blank, (type(self),), self.__getstate__()

    def __repr__(self) -> str:
        return self.display().shortened(MOST_LINES).text()

    def _repr_html_(self) -> str:
        return self.display().shortened(MOST_LINES).html()

    def summary(self) -> str:
        """Everything that there is to show, as text."""
        return self.display().text()


class Drawn(Displayed):
    """Something of which there are figures; the class says which one to begin with."""

    _first_figure: ClassVar[str]

    def plot(self, name: str | None = None, **options: Any) -> Any:
        """Draw one of its figures, given by name (default: the first one).

        `walop_jax.plot(self)` lists the names; `options` are the options of `walop_jax.plot`.
        """
        return importlib.import_module("walop_jax").plot(self, name or self._first_figure, **options)


class Result(Drawn):
    """Base class of results with a calibration, which the public functions take."""

    _first_figure = "matrix"

    def report(self, output: PathLike, **options: Any) -> Any:
        """Write the HTML page about it."""
        return importlib.import_module("walop_jax").report(self, output, **options)

    def save(self, folder: PathLike, *, overwrite: bool = False) -> None:
        """Write it as the folder of a run, which every command reads."""
        importlib.import_module("walop_jax")._save(self, folder, overwrite=overwrite)
