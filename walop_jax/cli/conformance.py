"""`walop-jax conformance`: questions on conventions for other programs, and the judgement on their answers."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from walop_jax.cli.common import CommandError, JsonOption, OverwriteOption, QuietOption, print_json

MakeOption = Annotated[
    Path | None, typer.Option("--make", metavar="FOLDER", help="Write the questions as tables.")
]
CheckOption = Annotated[
    Path | None, typer.Option("--check", metavar="FOLDER", help="Judge FOLDER/results.csv.")
]


def conformance(
    make: MakeOption = None,
    check: CheckOption = None,
    overwrite: OverwriteOption = False,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Put another program to the test: 40 small questions on signs, frames, order of cameras, errors and bias.

    --make writes cases.csv (the questions), given.csv (their numbers), answers.csv and results.csv, whose column VALUE
    the other program fills in. --check holds that against the answers and names the usual mistakes; exit code 1 if
    anything differs.
    """
    if (make is None) == (check is None):
        raise typer.BadParameter("give either --make FOLDER or --check FOLDER")
    from walop_jax.runs.conformance import check_conformance, make_conformance

    if make is not None:
        number = make_conformance(make, overwrite=overwrite)
        if json:
            print_json({"output": str(make), "cases": number})
        elif not quiet:
            typer.echo(f"{number} questions: {make}")
        return
    assert check is not None
    found = check_conformance(check)
    if json:
        print_json(found.document())
    elif not quiet:
        for deviation in found.deviations:
            typer.echo(str(deviation))
        typer.echo(f"{found.asked - len(found.deviations)} of {found.asked} numbers are right")
    if found.deviations:
        raise CommandError(f"{check}: {len(found.deviations)} of {found.asked} numbers are not right")
