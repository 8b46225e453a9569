"""The questions of `science.conformance` as tables, and the judgement on the answers of another program."""

from __future__ import annotations

import csv
import dataclasses
import io
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from walop_jax.io.errors import fail, nearest
from walop_jax.io.folder import output_folder
from walop_jax.io.text import read_text
from walop_jax.science.conformance import Deviation, cases, judge

CASES, GIVEN, ANSWERS, RESULTS = "cases.csv", "given.csv", "answers.csv", "results.csv"
OUTPUTS = (CASES, GIVEN, ANSWERS, RESULTS)
NUMBER = "{:.15g}"


@dataclasses.dataclass(frozen=True)
class Conformance:
    """How many numbers were asked for, and those that are not right."""

    asked: int
    deviations: tuple[Deviation, ...]

    def document(self) -> dict[str, Any]:
        """Everything as plain data."""
        return {
            "asked": self.asked,
            "right": self.asked - len(self.deviations),
            "deviations": [dataclasses.asdict(entry) for entry in self.deviations],
        }


def make_conformance(folder: str | os.PathLike[str], *, overwrite: bool = False) -> int:
    """Write the questions, and a table of results to be filled in; return how many questions there are.

    Raises `DataError` for a folder that cannot be written or holds such tables already while `overwrite` is False.
    """
    found = list(cases())
    given = [(c.name, key, NUMBER.format(v)) for c in found for key, v in c.given.items()]
    answers = [(c.name, key, NUMBER.format(v)) for c in found for key, v in c.answers.items()]
    head = ("CASE", "QUANTITY", "VALUE")
    with output_folder(folder, OUTPUTS, overwrite=overwrite) as out, out.filled() as there:
        _write(there / CASES, ("CASE", "TOPIC", "QUESTION"), ((c.name, c.topic, c.question) for c in found))
        _write(there / GIVEN, head, given)
        _write(there / ANSWERS, head, answers)
        _write(there / RESULTS, head, ((case, key, "") for case, key, _ in answers))
    return len(found)


def check_conformance(folder: str | os.PathLike[str]) -> Conformance:
    """Hold `results.csv` of a folder against the right answers.

    Raises `DataError` for a file that cannot be read, a case or quantity that is not asked for, and one that is there
    twice.
    """
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
