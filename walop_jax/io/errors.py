"""The one error of this room, and the wording that every message shares: what, where, what to do."""

from __future__ import annotations

import contextlib
import difflib
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

PathLike = str | os.PathLike[str]
_SHOWN = 5
"""Number of rows or names that a message spells out before it only counts the rest."""
_ALIKE, _SHORT = 0.75, 3
"""Likeness of a name that is misspelt; letters of a word that says nothing by itself."""


class DataError(ValueError):
    """An input cannot be trusted; the message states fault, place and remedy.

    >>> walop.read("nowhere.fits")
    Traceback (most recent call last):
        ...
    walop_jax.io.errors.DataError: nowhere.fits: there is no such file; check the name
    """


def fail(
    what: str, *, file: object = None, extension: str = "", column: str = "", advice: str = ""
) -> DataError:
    """Build a `DataError` whose message reads `file [EXTENSION] COLUMN: what; advice`."""
    place = " ".join(
        item for item in (str(file) if file else "", f"[{extension}]" if extension else "", column) if item
    )
    return DataError(printable(f"{place + ': ' if place else ''}{what}{'; ' + advice if advice else ''}"))


def printable(text: str) -> str:
    """The text on one line, with escapes for unprintable characters (of a damaged header, of a hostile name)."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


@contextlib.contextmanager
def errors_naming(path: PathLike | None) -> Iterator[None]:
    """Put the name of a file at the head of every ValueError of the block that does not hold it; None: of no file."""
    try:
        yield
    except ValueError as error:
        if path is None or str(path) in str(error):
            raise
        raise DataError(f"{path}: {error}") from error


def rows_text(rows: Sequence[int] | np.ndarray) -> str:
    """Name some table rows, counted from 0 as in numpy and astropy: `rows 3, 7 … (12 in all, from 0)`."""
    shown = ", ".join(str(int(row)) for row in rows[:_SHOWN])
    if len(rows) > _SHOWN:
        return f"rows {shown} … ({len(rows)} in all, counted from 0)"
    return f"row{'s' if len(rows) > 1 else ''} {shown} (counted from 0)"


def nearest(name: str, names: Iterable[str]) -> str:
    """Advice on a name that does not exist: the names most like it, or some of the names that there are.

    The values of a mapping are the meanings of its names: where no name is much like it, names whose meaning has a word
    of it are taken.
    """
    meanings = names if isinstance(names, Mapping) else {}
    names = sorted(set(names))
    if not names:
        return "there are none to choose from"
    close = difflib.get_close_matches(name, names, n=3, cutoff=_ALIKE if meanings else 0.4)
    if meanings and not close:
        words = [word for word in re.split(r"[\W_]+", name.lower()) if len(word) > _SHORT]
        texts = {key: f"{key} {meaning}".lower() for key, meaning in meanings.items()}
        close = [key for key, text in texts.items() if any(word in text for word in words)][:_SHOWN]
        close = close or difflib.get_close_matches(name, names, n=3, cutoff=0.4)
    if not close:
        lowered = {entry.lower(): entry for entry in names}
        close = [lowered[m] for m in difflib.get_close_matches(name.lower(), lowered, n=3, cutoff=0.4)]
    if close:
        return "did you mean " + " or ".join(repr(entry) for entry in close) + "?"
    return "known: " + ", ".join(names[:_SHOWN]) + (" …" if len(names) > _SHOWN else "")
