"""How results show themselves where they are looked at: in a terminal as text, in a notebook as HTML."""

from __future__ import annotations

import abc
import dataclasses
import html
from collections.abc import Iterator


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
            yield f"  {name:<{width}}  {value}"
        if self.rows:
            table = [tuple(name.removeprefix(">") for name in self.head), *self.rows]
            widths = [max(len(row[k]) for row in table) for k in range(len(self.head))]
            for row in table:
                cells = (
                    f"{cell:>{w}}" if name.startswith(">") else f"{cell:<{w}}"
                    for cell, w, name in zip(row, widths, self.head, strict=True)
                )
                yield ("  " + "  ".join(cells)).rstrip()
        yield from (f"  {note}" for note in self.notes)

    def html(self) -> str:
        """HTML that takes its colours from the page that it stands in."""
        return "".join(self._elements())

    def _elements(self) -> Iterator[str]:
        yield f"<div><p><strong>{html.escape(self.title)}</strong></p>"
        if self.facts:
            rows = (
                f"<tr><th {_LEFT}>{html.escape(name)}</th><td {_LEFT}>{html.escape(value)}</td></tr>"
                for name, value in self.facts
            )
            yield f"<table>{''.join(rows)}</table>"
        if self.rows:
            sides = [_RIGHT if name.startswith(">") else _LEFT for name in self.head]
            head = "".join(
                f"<th {side}>{html.escape(name.removeprefix('>'))}</th>"
                for name, side in zip(self.head, sides, strict=True)
            )
            body = "".join(
                "<tr>"
                + "".join(
                    f"<td {side}>{html.escape(cell)}</td>" for cell, side in zip(row, sides, strict=True)
                )
                + "</tr>"
                for row in self.rows
            )
            yield f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
        yield from (f"<p>{html.escape(note)}</p>" for note in self.notes)
        yield "</div>"


_LEFT, _RIGHT = 'style="text-align: left"', 'style="text-align: right; font-variant-numeric: tabular-nums"'


class Displayed(abc.ABC):
    """Something that shows itself as a short table instead of as everything that it holds."""

    @abc.abstractmethod
    def display(self) -> Display:
        """What to show."""

    def __repr__(self) -> str:
        return self.display().text()

    def _repr_html_(self) -> str:
        return self.display().html()
