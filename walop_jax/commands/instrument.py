"""`walop-jax instrument`: an instrument as described, printed and checked."""

from __future__ import annotations

from typing import Any

from walop_jax.commands.command import Job, Listing, Option, Outcome, PathLike, UsageError, command
from walop_jax.io.errors import errors_naming

OPTIONS = {
    "source": Option(
        "A shipped instrument or a description file; none: list them.",
        metavar="[NAME|FILE.toml]",
        kind=str,
        placed=True,
    ),
    "text": Option("Print the description itself, to start one's own from."),
}


@command(jax=False, elements=True, options=OPTIONS)
def instrument(job: Job, source: PathLike | None = None, *, text: bool = False) -> Outcome[Any]:
    """Print and check an instrument: its elements, cameras and parameters, from its description file.

    The description is read, every element is made, and light is sent through it on the axis and at the edge of the
    field. Without a name the instruments that come with the package are listed.

    In Python: a `CheckedInstrument`, whose `instrument` is the instrument; without a name, a line about each, by name;
    with `text`, the description. Raises `DataError` for a description that is wrong, and for optics that are not finite
    or give more light than came in.

    >>> print(walop.instrument("WALOP-SOUTH"))
    WALOP-SOUTH: 4 cameras (O1, E1, O2, E2)
    ...
    """
    from walop_jax.instruments.description import described, read_description, shipped

    if source is None:
        if text:
            raise UsageError("name the instrument whose description is wanted", "source")
        names = Listing({name: described(name).about for name in shipped()})
        return Outcome(names, names, repr(names))
    if text:
        written = read_description(source).text
        return Outcome(written, {"name": str(source), "text": written}, written)
    job.use_jax()
    from walop_jax.calibration.checked_instrument import checked

    with errors_naming(source):
        checked_instrument = checked(source)
    return Outcome(checked_instrument)
