"""Pages about single effects and elements, made of what their code says of them and of numbers kept beside the
pages."""

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

_UNSEEN = 3.0  # standard deviations below which one effect may be taken for another
_NOTHING = 5e-4  # per cent of the matrix: not worth a number


TOPICS: Mapping[str, Mapping[str, Any]] = {
    "effect": {effect.name: effect for effect in EFFECTS},
    "element": {kind.kind: kind for kind in ELEMENTS},
}
"""Subjects of a page of their own: effects, and kinds of elements, by name."""


def page(topic: str, name: str) -> str:
    """The page about an effect or a kind of element (`TOPICS`), as Markdown.

    Raises ValueError where there is none, with the names that the words of `name` speak of, or the nearest ones.
    """
    known = TOPICS[topic]
    if name not in known:
        every = f"walop-jax docs {topic} lists all"
        meanings = {one: _about(kind) for one, kind in known.items()}
        raise ValueError(f"{unknown_name(topic, name, meanings)} ({every})")
    made = _effect(known[name]) if topic == "effect" else _element(known[name])
    return "\n\n".join(made) + "\n"


def listed(topic: str) -> str:
    """All effects, or all kinds of elements, each with a few words."""
    width = max(map(len, TOPICS[topic]))
    return "\n".join(f"{name:<{width}}  {_about(kind)}" for name, kind in TOPICS[topic].items()) + "\n"


def numbers() -> dict[str, Any]:
    """The numbers of the pages: `plan` in words, and by effect what `diagnosis.detection_limits` finds for it, and
    the rms change of the matrix (per cent) at its usual size."""
    return json.loads((files("walop_jax") / "docs" / NUMBERS).read_text(encoding="utf-8"))


def _about(kind: Any) -> str:
    return inspect.cleandoc(kind.__doc__ or "").splitlines()[0].rstrip(".")


def _effect(effect: EffectKind) -> Iterator[str]:
    """The paragraphs of the page of an effect."""
    yield from (f"# {effect.name}", f"{_about(effect)}.", *_indented(effect.head()))
    yield from _table(
        ("parameter", "unit", "usual size", "what it is"),
        [
            (n, d.unit, "" if d.width is None else f"{d.width:g}", d.about)
            for n, d in effect.numbers().items()
        ],
    )
    said = f"\n{effect.head()}"
    if effect.revealed_by and "\nRevealed" not in said:
        yield f"**Revealed by** {effect.revealed_by}."
    found = numbers()
    one = found["effects"].get(effect.name)
    if one is not None:
        yield from _maps(one)
    yield "## How small it may be, and what it looks like"
    if one is None:
        yield f"The example ({found['plan']}) has no numbers of it: its exposures do not show it, or were not asked."
    else:
        yield f"In a run of {found['plan']}:"
        yield "\n".join(_sizes(one))
    if effect.separated_by:
        yield f"**Told apart by** {effect.separated_by}."
    if effect.reference and "\nSource" not in said:
        yield f"Source: {effect.reference}."


def _maps(one: Mapping[str, Any]) -> Iterator[str]:
    """Changes of the maps of the instrument matrix, at its usual size."""
    yield "## What it does to the maps"
    size = f"{one['parameter']} = {one['usual']:g}{_unit(one)}"
    if any(value >= _NOTHING for value in one["maps"].values()):
        yield f"At {size} the elements of the instrument matrix change by (rms over the field, per cent)"
        yield from _table(tuple(one["maps"]), [tuple(f"{value:.2g}" for value in one["maps"].values())])
    else:
        yield f"Nothing: at {size} it disturbs the calibration data, not the light of the stars."


def _sizes(one: Mapping[str, Any]) -> Iterator[str]:
    least, most = one["found"]
    seldom = f", {most:.2g} in the shape that shows least" if most > 1.05 * least else ""
    yield f"- found, 99 times in 100, from {one['parameter']} = {least:.2g}{_unit(one)} on{seldom}"
    named = one["named"]
    if named is None or named > 1e3 * most:
        yield "- named alone at no size: the first effect below makes the same pattern there"
    else:
        yield f"- named alone, 99 times in 100, from {named:.2g}{_unit(one)} on{', in every shape' if seldom else ''}"
    for rival, separation in one["rivals"]:
        verdict = "can be mistaken for" if separation < _UNSEEN else f"{separation:.1f} σ away from"
        yield f"- at the size from which it is found, {verdict} `{rival}`"


def _unit(one: Mapping[str, Any]) -> str:
    return f" {one['unit']}" if one["unit"] else ""


def _element(kind: type[Element]) -> Iterator[str]:
    """The paragraphs of the page of a kind of elements."""
    head = _head_text(kind)
    yield from (f"# {kind.kind}", f"{_about(kind)}.", *_indented(head.partition("\n")[2].strip("\n")))
    yield from _table(
        ("number", "unit", "what it is"), [(n, d.unit, d.about) for n, d in numbers_of(kind).items()]
    )
    changed = [effect.name for effect in EFFECTS if kind.kind and kind.kind in effect.head().lower()]
    if changed:
        yield f"Effects that speak of it: {', '.join(f'`{name}`' for name in changed)}."
    if kind.reference and "\nSource" not in head:
        yield f"Source: {kind.reference}."


def _head_text(kind: type[Any]) -> str:
    """The text with its equation: of the class, or of the head of its file."""
    own = inspect.cleandoc(kind.__doc__ or "")
    return own if "\nEquation " in own else inspect.cleandoc(sys.modules[kind.__module__].__doc__ or "")


def _indented(head: str) -> Iterator[str]:
    """Equation and symbols, as they stand in the head of a file."""
    if head:
        yield "\n".join(f"    {line}".rstrip() for line in head.splitlines())


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> Iterator[str]:
    if rows:
        listed = [f"| {' | '.join(cell.replace('|', '/') for cell in row)} |" for row in rows]
        yield "\n".join((f"| {' | '.join(head)} |", f"|{' --- |' * len(head)}", *listed))
