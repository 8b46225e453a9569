"""`walop-jax docs`: the reference pages that come with the package."""

from __future__ import annotations

from pathlib import Path

from walop_jax.commands.command import Job, Outcome, UsageError, command
from walop_jax.io.errors import nearest

SINGLE = {
    "effect": "One effect; without a name, the list of all.",
    "element": "One kind of element of an instrument; without a name, the list of all.",
}


@command(jax=False)
def docs(job: Job, topic: str | None = None, name: str | None = None) -> Outcome[str]:
    """Print a reference page, or the list of pages.

    Recipes, conventions, file formats, the model, effects, how to add an effect or an instrument, vocabulary, sources;
    and `effect NAME` or `element NAME` for a page about a single one: equation, parameters, at what size it is found,
    its rivals.

    In Python: its text.

    >>> print(walop.docs("conventions").splitlines()[0])
    # Conventions
    """
    texts = pages()
    if name is not None and topic not in SINGLE:
        raise UsageError(f"{name!r} follows neither effect nor element", "name")
    if topic in SINGLE:
        text = _single(job, topic, name)
    elif topic is None:
        listed = {key: about(text) for key, text in texts.items()}
        listed |= {f"{key} NAME": words for key, words in SINGLE.items()}
        width = max(map(len, listed))
        text = "\n".join(f"{key:<{width}}   {words}" for key, words in listed.items())
    elif (text := texts.get(topic.lower().removesuffix(".md"), "")) == "":
        advice = f"{nearest(topic, (*texts, *SINGLE))} (walop-jax docs lists all)"
        raise UsageError(f"there is no page {topic!r}; {advice}", "topic")
    markdown = topic is not None and (name is not None or topic not in SINGLE)
    return Outcome(text, {"topic": topic, "name": name, "text": text}, text, markdown=markdown)


def _single(job: Job, topic: str, name: str | None) -> str:
    """The page about one effect or element, or the list of all."""
    job.use_jax()
    from walop_jax.model import gallery

    if name is None:
        return gallery.listed(topic)
    try:
        return gallery.page(topic, name)
    except ValueError as error:
        raise UsageError(str(error), "name") from None


def pages() -> dict[str, str]:
    """The Markdown text of every page by topic, in alphabetical order."""
    files = (Path(__file__).parents[1] / "docs").glob("*.md")
    return dict(sorted((file.stem, file.read_text("utf-8")) for file in files if file.stem != "index"))


def about(text: str) -> str:
    """The first sentence of a page, below its title."""
    return text.splitlines()[2]
