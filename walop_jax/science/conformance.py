"""The judge of answers to the questions on conventions (`conformance_pack`), which names the usual mistakes.

The tables hold what closed formulas of docs: conventions give; tests hold them against the package and numbers by hand.
"""

from __future__ import annotations

import csv
import dataclasses
import io
import math
from importlib.resources import files
from pathlib import Path
from typing import Any

from walop_jax.io.display import Display, Displayed
from walop_jax.io.errors import PathLike, fail, nearest
from walop_jax.io.folder import output_folder
from walop_jax.io.text import read_text, some

SHOWN = 4  # numbers that one mistake explains
ANGLES = ("EVPA", "EVPA_SKY")  # degrees, the same after half a turn
PACK = files("walop_jax") / "science" / "conformance_pack"

SHIPPED = ("cases.csv", "given.csv", "answers.csv", "README.txt")
RESULTS = "results.csv"
Key = tuple[str, str]  # a case and a quantity


@dataclasses.dataclass(frozen=True)
class Deviation:
    """An answer that is not right: None stands for none; `mistake` is the usual one with that answer, or empty."""

    case: str
    quantity: str
    answer: float | None
    expected: float
    mistake: str

    def __str__(self) -> str:
        if self.answer is None:
            return f"{self.case} {self.quantity}: no answer"
        hint = f": {self.mistake}" if self.mistake else ""
        return f"{self.case} {self.quantity}: {self.answer:.10g} where {self.expected:.10g} is right{hint}"


@dataclasses.dataclass(frozen=True, repr=False)
class Conformance(Displayed):
    """Number of values that were asked for, and those that are not right."""

    asked: int
    deviations: tuple[Deviation, ...]

    def document(self) -> dict[str, Any]:
        """Everything as plain data."""
        right = self.asked - len(self.deviations)
        wrong = [dataclasses.asdict(entry) for entry in self.deviations]
        return {"asked": self.asked, "right": right, "deviations": wrong}

    def display(self) -> Display:
        """Number of right values, and the wrong ones: each mistake once, with all that it explains."""
        groups: dict[str, list[Deviation]] = {}
        for entry in self.deviations:
            groups.setdefault("no answer" if entry.answer is None else entry.mistake, []).append(entry)
        notes = []
        for mistake, group in groups.items():
            if not mistake or len(group) == 1:
                notes += map(str, group)
            else:
                names = [f"{answer.case} {answer.quantity}" for answer in group]
                notes.append(f"{mistake}: {some(names, SHOWN)}")
        right = self.asked - len(self.deviations)
        return Display(f"{right} of {self.asked} numbers are right", notes=tuple(notes))


def rows(name: str) -> list[dict[str, str]]:
    """The rows of a table that comes with the package."""
    return list(csv.DictReader(io.StringIO((PACK / name).read_text("utf-8"))))


def values(name: str) -> dict[Key, float]:
    """The numbers of such a table by case and quantity."""
    return {(row["CASE"], row["QUANTITY"]): float(row["VALUE"]) for row in rows(name)}


def write_pack(place: PathLike, *, overwrite: bool = False) -> int:
    """Write the questions into a folder, with a table for the answers; gives their number."""
    expected = values("answers.csv")
    with output_folder(place, (*SHIPPED, RESULTS), overwrite=overwrite) as out, out.filled() as folder:
        for name in SHIPPED:
            (folder / name).write_text((PACK / name).read_text("utf-8"), encoding="utf-8")
        blank = "".join(f"{case},{quantity},\n" for case, quantity in expected)
        (folder / RESULTS).write_text(f"CASE,QUANTITY,VALUE\n{blank}", encoding="utf-8")
    return len({case for case, _ in expected})


def judge(answers: dict[Key, float | None]) -> Conformance:
    """Hold answers against the right ones, and name the first mistake that would answer the same."""
    expected, mistakes, wrong = values("answers.csv"), rows("mistakes.csv"), []
    for (case, quantity), right in expected.items():
        answer = answers.get((case, quantity))
        if not same(quantity, answer, right):
            asked = (row for row in mistakes if (row["CASE"], row["QUANTITY"]) == (case, quantity))
            likely = (row["MISTAKE"] for row in asked if same(quantity, answer, float(row["VALUE"])))
            wrong.append(Deviation(case, quantity, answer, right, next(likely, "")))
    return Conformance(len(expected), tuple(wrong))


def same(quantity: str, answer: float | None, expected: float) -> bool:
    """True if two numbers agree to 10⁻⁶, angles to 10⁻⁵ degrees."""
    if answer is None or not math.isfinite(answer):
        return False
    if quantity in ANGLES:
        return abs((answer - expected + 90.0) % 180.0 - 90.0) < 1e-5
    return abs(answer - expected) <= 1e-6 * abs(expected) + 1e-12


def answers_of(path: Path) -> dict[Key, float | None]:
    """The answers in a table of results.

    Raises `DataError` for a file that cannot be read, a case or quantity that is not asked for, and one that is there
    twice.
    """
    questions = values("answers.csv")
    answers: dict[Key, float | None] = {}
    for number, row in enumerate(csv.DictReader(io.StringIO(read_text(path)))):
        key = (str(row.get("CASE") or "").strip(), str(row.get("QUANTITY") or "").strip())
        name, where = " ".join(key).strip(), f"in row {number} (counted from 0)"
        if key not in questions:
            advice = nearest(name, map(" ".join, questions))
            raise fail(f"{name!r} is not asked for, {where}", file=path, advice=advice)
        if key in answers:
            raise fail(f"{name} is there twice, again in row {number}", file=path, advice="remove one")
        text = str(row.get("VALUE") or "").strip()
        try:
            answers[key] = float(text) if text else None
        except ValueError:
            advice = "correct it or leave it empty"
            what = f"{text!r} is not a number, {where}"
            raise fail(what, file=path, column="VALUE", advice=advice) from None
    return answers
