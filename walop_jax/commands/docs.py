"""`walop-jax docs`: the reference pages that come with the package."""

from __future__ import annotations

from pathlib import Path

from walop_jax.commands.command import Job, Option, Outcome, UsageError, command
from walop_jax.io.errors import nearest

OPTIONS = {
    "topic": Option("Page to print; without it, the list.", metavar="[TOPIC]", kind=str, placed=True),
}


@command(jax=False, options=OPTIONS)
def docs(job: Job, topic: str | None = None) -> Outcome[str]:
    """Print a reference page, or the list of pages.

    Recipes, conventions, file formats, the model, effects, how to add an effect or an instrument, vocabulary, sources.

    In Python: the text of the page, or the list.

    >>> print(walop.docs("conventions").splitlines()[0])
    # Conventions
    """
    texts = pages()
    if topic is None:
        width = max(map(len, texts))
        text = "\n".join(f"{key:<{width}}   {about(page)}" for key, page in texts.items())
    elif (text := texts.get(topic.lower().removesuffix(".md"), "")) == "":
        advice = f"{nearest(topic, texts)} (walop-jax docs lists all)"
        raise UsageError(f"there is no page {topic!r}; {advice}", "topic")
    return Outcome(text, {"topic": topic, "text": text}, text, markdown=topic is not None)


def pages() -> dict[str, str]:
    """The Markdown text of every page by topic, in alphabetical order."""
    files = (Path(__file__).parents[1] / "docs").glob("*.md")
    return dict(sorted((file.stem, file.read_text("utf-8")) for file in files if file.stem != "index"))


def about(text: str) -> str:
    """The first sentence of a page, below its title."""
    return text.splitlines()[2]
