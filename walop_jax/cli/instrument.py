"""`walop-jax instrument`: an instrument as described, printed and checked."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated

import typer

from walop_jax.cli.common import JsonOption, QuietOption, print_json, switch_on_jax

if TYPE_CHECKING:
    from walop_jax.runs.instrument import CheckedInstrument

Source = Annotated[
    str | None,
    typer.Argument(
        metavar="[NAME|FILE.toml]", help="A shipped instrument or a description file; none: list them."
    ),
]
TextOption = Annotated[
    bool, typer.Option("--text", help="Print the description itself, to start one's own from.")
]


def instrument(
    source: Source = None, text: TextOption = False, quiet: QuietOption = False, json: JsonOption = False
) -> None:
    """Print and check an instrument: its elements, cameras and parameters, from its description file.

    The description is read, every element is made, and light is sent through it on the axis and at the edge of the
    field. Without a name the instruments that come with the package are listed.
    """
    from walop_jax.instruments.description import described, read_description, shipped

    if source is None:
        names = {name: described(name).about for name in shipped()}
        if json:
            print_json(names)
        elif not quiet:
            width = max(map(len, names))
            for name, about in names.items():
                typer.echo(f"{name:<{width}}  {about}")
        return
    if text:
        typer.echo(read_description(source).text, nl=False)
        return
    switch_on_jax()
    from walop_jax.runs.instrument import check_instrument

    found = check_instrument(source)
    if json:
        print_json(found.document())
    elif not quiet:
        for line in table(found):
            typer.echo(line)


def table(found: CheckedInstrument) -> Iterator[str]:
    """The instrument as lines of text."""
    design = found.instrument
    yield f"{design.name}: {len(design.cameras)} cameras ({', '.join(design.cameras.names)})"
    yield "light path  " + " > ".join((*found.train, *(("arms",) if len(found.arms) > 1 else ())))
    for name, path in found.arms.items():
        yield f"  {name:<10}" + " > ".join(path)
    if found.moving:
        yield "moves       " + ", ".join(f"{prefix}_IN, {prefix}_ANGLE" for prefix in found.moving)
    yield f"field       to {design.field_limit:g} deg"
    yield ""
    shown = [p for p in found.model.parameters if not p.name.startswith("throughput.")]
    width = max(map(len, (p.name for p in shown)), default=0)
    for p in shown:
        prior = "free" if p.prior is None else f"+- {p.prior[1]:g}"
        yield f"{p.name:<{width}}  {p.start:>10g} {prior:<10} {p.unit:<6} {p.about}"
    hidden = len(found.model.parameters) - len(shown)
    yield f"and {hidden} coefficients of the throughput"
