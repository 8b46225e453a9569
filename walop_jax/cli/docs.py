"""`walop-jax docs`: the reference pages that come with the package."""

from __future__ import annotations

from typing import Annotated

import typer

Topic = Annotated[str | None, typer.Argument(metavar="TOPIC", help="Page to print; without it, the list.")]
WIDEST = 120  # columns: longer lines are hard to read


def docs(topic: Topic = None) -> None:
    """Print a reference page, or the list of pages.

    Conventions, file formats, the model, effects, how to add an effect or an instrument, vocabulary, sources.
    """
    from rich.console import Console
    from rich.markdown import Markdown

    from walop_jax.io.errors import nearest

    found = pages()
    if topic is None:
        width = max(map(len, found))
        for name, text in found.items():
            typer.echo(f"{name:<{width}}   {about(text)}")
        return
    text = found.get(topic.lower().removesuffix(".md"))
    if text is None:
        raise typer.BadParameter(f"there is no page {topic!r}: {nearest(topic, found)}", param_hint="TOPIC")
    console = Console()
    if console.is_terminal:
        Console(width=min(console.width, WIDEST)).print(Markdown(text, hyperlinks=False))
    else:
        typer.echo(text, nl=False)


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
