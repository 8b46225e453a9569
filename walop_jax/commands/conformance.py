"""`walop-jax conformance`: questions on conventions for other programs, and the judgement on their answers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from walop_jax.commands.command import Job, Outcome, PathLike, UsageError, command

if TYPE_CHECKING:
    from walop_jax.science.conformance import Conformance


@command(jax=False, writes=())
def conformance(
    job: Job, *, make: PathLike | None = None, check: PathLike | None = None
) -> Outcome[int | Conformance]:
    """Put another program to the test: 43 small questions on signs, frames, order of cameras, errors and bias.

    --make writes cases.csv (the questions), given.csv (their numbers), answers.csv and results.csv, whose column VALUE
    the other program fills in. --check compares that with the answers and names the usual errors; exit code 1 if
    anything differs.

    In Python: the number of questions, or a `Conformance`.

    >>> walop.conformance(make="pack")  # doctest: +SKIP
    """
    from walop_jax.science.conformance import RESULTS, answers_of, judge, write_pack

    if (make is None) == (check is None):
        raise UsageError("give either --make FOLDER or --check FOLDER")
    if make is not None:
        number = write_pack(make, overwrite=job.overwrite)
        return Outcome(number, {"output": str(make), "cases": number}, f"{number} questions: {make}")
    assert check is not None
    judged = judge(answers_of(Path(check) / RESULTS))
    wrong = f"{check}: see above, and README.txt there"
    return Outcome(judged, failure=wrong if judged.deviations else "")
