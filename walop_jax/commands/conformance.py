"""`walop-jax conformance`: questions on conventions for other programs, and the judgement on their answers."""

from __future__ import annotations

import csv
import dataclasses
import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from walop_jax.commands.command import Job, Option, Outcome, UsageError, command
from walop_jax.commands.inputs import PathLike
from walop_jax.io.display import Display, Displayed
from walop_jax.io.errors import fail, nearest
from walop_jax.io.text import read_text, some

if TYPE_CHECKING:
    from walop_jax.science.conformance import Deviation

CASES, GIVEN, ANSWERS, RESULTS, README = "cases.csv", "given.csv", "answers.csv", "results.csv", "README.txt"
OUTPUTS = (CASES, GIVEN, ANSWERS, RESULTS, README)
TEXT = """Questions on signs, frames, order of cameras, errors and bias for programs that reduce polarimetry.

cases.csv     CASE, TOPIC, QUESTION (quantities in capitals are those of the other files)
given.csv     the numbers of each case: CASE, QUANTITY, VALUE
results.csv   fill in VALUE, in any order of rows; a case that does not concern your program may stay empty
answers.csv   the right answers

Units: degrees; q, u, v and p are fractions; electrons. q = +1 is an electric vector along +X, u = +1 one at
+45 degrees, angles grow from +X towards +Y; on the sky from north through east. All conventions:
walop-jax docs conventions.
An answer is right within 1e-6 of its value (1e-12 where that is 0), an angle within 1e-5 degrees, modulo 180.

    walop-jax conformance --check FOLDER
"""
NUMBER = "{:.15g}"
SHOWN = 4  # numbers that one mistake explains
MAKE = Option("Write the questions as tables.", "FOLDER", Path)
CHECK = Option("Judge FOLDER/results.csv.", "FOLDER", Path)


@dataclasses.dataclass(frozen=True, repr=False)
class Conformance(Displayed):
    """Number of values that were asked for, and those that are not right."""

    asked: int
    deviations: tuple[Deviation, ...]

    def document(self) -> dict[str, Any]:
        """Everything as plain data."""
        return {
            "asked": self.asked,
            "right": self.asked - len(self.deviations),
            "deviations": [dataclasses.asdict(entry) for entry in self.deviations],
        }

    def display(self) -> Display:
        """Number of right values, and the wrong ones: each mistake once, with all that it explains."""
        groups: dict[str, list[Deviation]] = {}
        for one in self.deviations:
            groups.setdefault("no answer" if one.answer is None else one.mistake, []).append(one)
        notes = []
        for mistake, found in groups.items():
            if not mistake or len(found) == 1:
                notes += map(str, found)
                continue
            notes.append(f"{mistake}: {some([f'{one.case} {one.quantity}' for one in found], SHOWN)}")
        right = self.asked - len(self.deviations)
        return Display(f"{right} of {self.asked} numbers are right", notes=tuple(notes))


@command(jax=False, writes=())
def conformance(
    job: Job,
    *,
    make: Annotated[PathLike | None, MAKE] = None,
    check: Annotated[PathLike | None, CHECK] = None,
) -> Outcome[int | Conformance]:
    """Put another program to the test: 43 small questions on signs, frames, order of cameras, errors and bias.

    --make writes cases.csv (the questions), given.csv (their numbers), answers.csv and results.csv, whose column VALUE
    the other program fills in. --check holds that against the answers and names the usual mistakes; exit code 1 if
    anything differs.

    In Python: the number of questions, or a `Conformance`.

    >>> walop.conformance(make="pack")  # doctest: +SKIP
    """
    if (make is None) == (check is None):
        raise UsageError("give either --make FOLDER or --check FOLDER")
    if make is not None:
        number = _make(job, make)
        return Outcome(
            number, lambda: {"output": str(make), "cases": number}, lambda: f"{number} questions: {make}"
        )
    assert check is not None
    found = _checked(check)
    wrong = f"{check}: see above, and README.txt there"
    return Outcome(
        found, found.document, lambda: found.display().text(), failure=wrong if found.deviations else ""
    )


def _make(job: Job, folder: PathLike) -> int:
    """Write the questions, and a table of results to be filled in; return how many questions there are."""
    from walop_jax.io.folder import output_folder
    from walop_jax.science.conformance import cases

    found = list(cases())
    given = [(c.name, key, NUMBER.format(v)) for c in found for key, v in c.given.items()]
    answers = [(c.name, key, NUMBER.format(v)) for c in found for key, v in c.answers.items()]
    head = ("CASE", "QUANTITY", "VALUE")
    with output_folder(folder, OUTPUTS, overwrite=job.overwrite) as out, out.filled() as there:
        _write(there / CASES, ("CASE", "TOPIC", "QUESTION"), ((c.name, c.topic, c.question) for c in found))
        _write(there / GIVEN, head, given)
        _write(there / ANSWERS, head, answers)
        _write(there / RESULTS, head, ((case, key, "") for case, key, _ in answers))
        (there / README).write_text(TEXT, encoding="utf-8")
    return len(found)


def _checked(folder: PathLike) -> Conformance:
    """Hold `results.csv` of a folder against the right answers.

    Raises `DataError` for a file that cannot be read, a case or quantity that is not asked for, and one that is there
    twice.
    """
    from walop_jax.science.conformance import cases, judge

    path = Path(folder) / RESULTS
    asked = {(case.name, quantity) for case in cases() for quantity in case.answers}
    answers: dict[tuple[str, str], float | None] = {}
    for number, row in enumerate(csv.DictReader(io.StringIO(read_text(path)))):
        key = (str(row.get("CASE") or "").strip(), str(row.get("QUANTITY") or "").strip())
        if key not in asked:
            names = [" ".join(entry) for entry in asked]
            what = f"{' '.join(key).strip()!r} is not asked for, in row {number} (counted from 0)"
            raise fail(what, file=path, advice=nearest(" ".join(key), names))
        if key in answers:
            raise fail(
                f"{' '.join(key)} is there twice, again in row {number}", file=path, advice="remove one"
            )
        text = str(row.get("VALUE") or "").strip()
        try:
            answers[key] = float(text) if text else None
        except ValueError:
            what = f"{text!r} is not a number, in row {number} (counted from 0)"
            raise fail(what, file=path, column="VALUE", advice="correct it or leave it empty") from None
    return Conformance(len(asked), judge(answers))


def _write(path: Path, head: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(head)
        writer.writerows(rows)
