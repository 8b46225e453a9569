"""`walop-jax docs`: the reference pages that come with the package."""

from __future__ import annotations

from typing import Annotated

import typer

from walop_jax.cli.common import switch_on_jax

Topic = Annotated[
    str | None,
    typer.Argument(metavar="[TOPIC]", help="Page to print, or effect, or element; without it, the list."),
]
Name = Annotated[
    str | None, typer.Argument(metavar="[NAME]", help="Of an effect or a kind of element; none: list them.")
]
SINGLE = ("effect", "element")
WIDEST = 120  # columns: longer lines are hard to read


def docs(topic: Topic = None, name: Name = None) -> None:
    """Print a reference page, or the list of pages.

    Recipes, conventions, file formats, the model, effects, how to add an effect or an instrument, vocabulary, sources;
    and `effect NAME` or `element NAME` for a page about a single one: equation, parameters, at what size it is found,
    what it is confused with.
    """
    from walop_jax.io.errors import nearest

    if topic in SINGLE:
        _print(_single(topic, name), plain=name is None)
        return
    if name is not None:
        raise typer.BadParameter(f"{name!r} follows neither effect nor element", param_hint="NAME")
    found = pages()
    if topic is None:
        width = max(map(len, (*found, "element NAME")))
        for name, text in found.items():
            typer.echo(f"{name:<{width}}   {about(text)}")
        typer.echo(
            f"{'effect NAME':<{width}}   One effect; without a name, the list of effects and elements."
        )
        typer.echo(f"{'element NAME':<{width}}   One kind of element of an instrument.")
        return
    text = found.get(topic.lower().removesuffix(".md"))
    if text is None:
        raise typer.BadParameter(f"there is no page {topic!r}: {nearest(topic, found)}", param_hint="TOPIC")
    _print(text)


def _print(text: str, *, plain: bool = False) -> None:
    """Markdown, laid out on a terminal, as it is elsewhere; `plain` text as it is everywhere."""
    from rich.console import Console
    from rich.markdown import Markdown

    console = Console()
    if console.is_terminal and not plain:
        Console(width=min(console.width, WIDEST)).print(Markdown(text, hyperlinks=False))
    else:
        typer.echo(text, nl=False)


def _single(topic: str, name: str | None) -> str:
    """The page about one effect or element, or the list of all."""
    switch_on_jax()
    from walop_jax.model import gallery

    if name is None:
        return gallery.listed()
    try:
        return gallery.effect_page(name) if topic == "effect" else gallery.element_page(name)
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="NAME") from None


def pages() -> dict[str, str]:
    """The Markdown text of every page by topic, in alphabetical order."""
    from importlib.resources import files

    folder = files("walop_jax") / "docs"
    found = (entry for entry in folder.iterdir() if entry.name.endswith(".md"))
    texts = {entry.name.removesuffix(".md"): entry.read_text(encoding="utf-8") for entry in found}
    return dict(sorted(texts.items()))


def about(text: str) -> str:
    """What a page is about: its first sentence, which stands below the title."""
    return text.splitlines()[2]
