"""Pages about single effects and elements, from their docstrings, declarations and stored numbers."""

from __future__ import annotations

import inspect
import json
import sys
from collections.abc import Iterator, Mapping
from importlib.resources import files
from typing import Any

from walop_jax.model.effects import EFFECTS, EffectKind
from walop_jax.model.elements.base import Element
from walop_jax.model.elements.registry import ELEMENTS
from walop_jax.model.parameters import numbers_of, unknown_name

NUMBERS = "gallery.json"

_UNSEEN = 3.0  # standard deviations below which two effects may be confused
_NOTHING = 5e-4  # per cent of the matrix: not worth a number


TOPICS: Mapping[str, Mapping[str, Any]] = {
    "effect": {effect.name: effect for effect in EFFECTS},
    "element": {kind.kind: kind for kind in ELEMENTS},
}
"""Subjects of a page of their own: effects, and kinds of elements, by name."""


def page(topic: str, name: str) -> str:
    """The page about an effect or a kind of element (`TOPICS`), as Markdown.

    Raises ValueError for an unknown name, with the names related to its words, or the nearest ones.
    """
    subjects = TOPICS[topic]
    if name not in subjects:
        listing = f"walop-jax docs {topic} lists all"
        meanings = {key: _about(kind) for key, kind in subjects.items()}
        raise ValueError(f"{unknown_name(topic, name, meanings)} ({listing})")
    paragraphs = _effect(subjects[name]) if topic == "effect" else _element(subjects[name])
    return "\n\n".join(paragraphs) + "\n"


def listed(topic: str) -> str:
    """All effects, or all kinds of elements, each with a few words."""
    width = max(map(len, TOPICS[topic]))
    return "\n".join(f"{name:<{width}}  {_about(kind)}" for name, kind in TOPICS[topic].items()) + "\n"


def numbers() -> dict[str, Any]:
    """The numbers of the pages: `plan` in words, and by effect the results of `diagnosis.detection_limits` and the rms
    change of the matrix (per cent) at its usual size."""
    return json.loads((files("walop_jax") / "docs" / NUMBERS).read_text(encoding="utf-8"))


def _about(kind: Any) -> str:
    return inspect.cleandoc(kind.__doc__ or "").splitlines()[0].rstrip(".")


def _effect(effect: EffectKind) -> Iterator[str]:
    """The paragraphs of the page of an effect."""
    yield from (f"# {effect.name}", f"{_about(effect)}.", *_indented(effect.head()))
    yield from _table(
        ("parameter", "unit", "usual size", "meaning"),
        [
            (n, d.unit, "" if d.width is None else f"{d.width:g}", d.about)
            for n, d in effect.numbers().items()
        ],
    )
    head = f"\n{effect.head()}"
    if effect.revealed_by and "\nRevealed" not in head:
        yield f"**Revealed by** {effect.revealed_by}."
    gallery = numbers()
    entry = gallery["effects"].get(effect.name)
    if entry is not None:
        yield from _maps(entry)
    yield "## How small it may be, and its signature"
    if entry is None:
        yield f"The example ({gallery['plan']}) has no numbers of it: its exposures do not show it, or were not asked."
    else:
        yield f"In a run of {gallery['plan']}:"
        yield "\n".join(_sizes(entry))
    if effect.separated_by:
        yield f"**Separated by** {effect.separated_by}."
    if effect.reference and "\nSource" not in head:
        yield f"Source: {effect.reference}."


def _maps(entry: Mapping[str, Any]) -> Iterator[str]:
    """Changes of the maps of the instrument matrix, at its usual size."""
    yield "## Its effect on the maps"
    size = f"{entry['parameter']} = {entry['usual']:g}{_unit(entry)}"
    if any(value >= _NOTHING for value in entry["maps"].values()):
        yield f"At {size} the elements of the instrument matrix change by (rms over the field, per cent)"
        yield from _table(tuple(entry["maps"]), [tuple(f"{value:.2g}" for value in entry["maps"].values())])
    else:
        yield f"Nothing: at {size} it disturbs the calibration data, not the light of the stars."


def _sizes(entry: Mapping[str, Any]) -> Iterator[str]:
    smallest, largest = entry["found"]
    seldom = f", {largest:.2g} in the shape that shows least" if largest > 1.05 * smallest else ""
    yield f"- found, 99 times in 100, from {entry['parameter']} = {smallest:.2g}{_unit(entry)} on{seldom}"
    named = entry["named"]
    if named is None or named > 1e3 * largest:
        yield "- named alone at no size: the first effect below makes the same pattern there"
    else:
        yield f"- named alone, 99 times in 100, from {named:.2g}{_unit(entry)} on{', in every shape' if seldom else ''}"
    for rival, separation in entry["rivals"]:
        verdict = "can be mistaken for" if separation < _UNSEEN else f"{separation:.1f} σ away from"
        yield f"- at the size from which it is found, {verdict} `{rival}`"


def _unit(entry: Mapping[str, Any]) -> str:
    return f" {entry['unit']}" if entry["unit"] else ""


def _element(kind: type[Element]) -> Iterator[str]:
    """The paragraphs of the page of a kind of elements."""
    head = inspect.cleandoc(kind.__doc__ or "")
    if "\nEquation " not in head:  # it is in the head of the file
        head = inspect.cleandoc(sys.modules[kind.__module__].__doc__ or "")
    yield from (f"# {kind.kind}", f"{_about(kind)}.", *_indented(head.partition("\n")[2].strip("\n")))
    yield from _table(
        ("number", "unit", "meaning"), [(n, d.unit, d.about) for n, d in numbers_of(kind).items()]
    )
    changed = [effect.name for effect in EFFECTS if kind.kind and kind.kind in effect.head().lower()]
    if changed:
        yield f"Effects that name it: {', '.join(f'`{name}`' for name in changed)}."
    if kind.reference and "\nSource" not in head:
        yield f"Source: {kind.reference}."


def _indented(head: str) -> Iterator[str]:
    """Equation and symbols, as in the head of a file."""
    if head:
        yield "\n".join(f"    {line}".rstrip() for line in head.splitlines())


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> Iterator[str]:
    if rows:
        listed = [f"| {' | '.join(cell.replace('|', '/') for cell in row)} |" for row in rows]
        yield "\n".join((f"| {' | '.join(head)} |", f"|{' --- |' * len(head)}", *listed))
