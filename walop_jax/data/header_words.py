"""Exposures from the words of an observatory: headers of FITS files, exports of a telescope's log, tables of words.

A TOML file says which word is which column of EXPOSURES, in which unit, and how it is converted (docs: files): no
code of an observatory's own. Expressions are arithmetic; nothing else is evaluated.
"""

from __future__ import annotations

import ast
import dataclasses
import json
import math
import operator
import os
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from walop_jax.data.kinds import KINDS
from walop_jax.data.schema import EXPOSURES, MISSING, Column, check, table_of, table_rules
from walop_jax.data.table_files import read_table_file
from walop_jax.data.units import Place, convert_unit, sexagesimal
from walop_jax.io.errors import errors_naming, fail, nearest
from walop_jax.io.text import parse_toml, read_text
from walop_jax.io.toml import Reader

WORD: Mapping[str, Any] = {
    "word": Any, "unit": str, "expression": str, "values": Mapping[str, Any], "value": Any, "optional": bool,
}  # fmt: skip
TOP: Mapping[str, Any] = {"extension": int, "rows": str, "filters": Mapping[str, int], "schedule": Any}
"""Entries of a file of words beside its columns: extension of FITS files, where the rows of a JSON file are, numbers of
filters and facts of schedules (`data.schedule`)."""
_SEXAGESIMAL = re.compile(r"[+-]?\d+[: ]\d+[: ]\d+(\.\d*)?")
_MOVES = re.compile(r"[A-Z][A-Z0-9_]*_(IN|ANGLE|TURN)")
_INSIDE = dict.fromkeys(("t", "true", "1", "in"), True) | dict.fromkeys(("f", "false", "0", "out"), False)
_OPERATORS: Mapping[type[ast.AST], Callable[..., Any]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv,
    ast.Pow: operator.pow, ast.Mod: operator.mod, ast.USub: operator.neg, ast.UAdd: operator.pos,
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Word:
    """Origin of a column: the first of `words` that is there, or a fixed `value`.

    `values` replace those of the word (names of filters, kinds, positions), `unit` is that of the word, `expression`
    makes the value of the column of x, the value in the unit of the column, and of other columns by name.
    """

    words: tuple[str, ...]
    unit: str = ""
    expression: str = ""
    values: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    value: Any = None
    optional: bool = False


@dataclasses.dataclass(frozen=True)
class Words:
    """The words of an observatory by column of EXPOSURES, and the other entries of its file (`TOP`)."""

    columns: Mapping[str, Word]
    extension: int = 0
    rows: str = ""
    filters: Mapping[str, int] = dataclasses.field(default_factory=dict)
    schedule: Mapping[str, Any] = dataclasses.field(default_factory=dict)


def read_words(path: str | os.PathLike[str]) -> Words:
    """The words in a file. Raises `DataError` for a column that EXPOSURES do not have, and for unknown keys."""
    with errors_naming(path):
        return words_of(parse_toml(read_text(path)))


def words_of(content: Mapping[str, Any]) -> Words:
    """The words in the tables of a TOML file."""
    read, columns = Reader(""), {}
    for name, table in content.items():
        if name in TOP:
            continue
        if name not in EXPOSURES and not _MOVES.fullmatch(name):
            raise read.fault("", f"EXPOSURES have no column {name!r}; {nearest(name, [*EXPOSURES, *TOP])}")
        settings = read.values(WORD, table, name)
        words = settings.pop("word", ())
        words = (words,) if isinstance(words, str) else tuple(words)
        if bool(words) == ("value" in settings) or not all(isinstance(word, str) for word in words):
            raise read.fault(
                name, 'needs word = "…", a list of words of which the first is taken, or value = …'
            )
        if settings.get("expression"):
            names = _names(settings["expression"], read, name)
            if odd := names - {"x", *content}:
                raise read.fault(
                    name, f"expression: there is no {sorted(odd)[0]!r}; {nearest(sorted(odd)[0], content)}"
                )
        columns[name] = Word(words, **settings)
    top = read.values(TOP, {key: value for key, value in content.items() if key in TOP}, "")
    return Words(columns, **top)


def exposures_table(
    paths: Sequence[str | os.PathLike[str]], words: Words
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Columns of EXPOSURES, one row for each exposure in the files, their names in FILE; and remarks.

    Raises `DataError`, with file, word and column, for words that are missing, have another unit, or a value that
    cannot be meant.
    """
    records = [(str(path), record) for path in map(Path, paths) for record in _records(path, words)]
    if not records:
        raise fail("no exposures in these files", advice="name FITS files, a JSON file or a table")
    rows = [_row(record, words, file) for file, record in records]
    names = list(dict.fromkeys(name for row in rows for name in row))
    if "KIND" not in names:
        raise Place(records[0][0], "").fail(
            "the kind of the exposures is not known", "KIND", "add [KIND] to the words"
        )
    place = Place(", ".join(dict.fromkeys(file for file, _ in records)), "EXPOSURES")
    columns = {name: _column([row.get(name) for row in rows], name) for name in names}
    columns.setdefault("EXPOSURE", np.arange(len(rows)))
    rules = table_rules("EXPOSURES", list(columns), place)
    table = table_of(columns, rules, place)
    table["KIND"] = np.char.lower(table["KIND"])
    for kind in np.unique(table["KIND"]).tolist():
        if kind not in KINDS:
            place.refuse(
                table["KIND"] == kind,
                f"{kind!r} is not a kind,",
                "KIND",
                f"list it in values; {nearest(kind, KINDS)}",
            )
    check(table, {name: rule for name, rule in rules.items() if name in table}, place)
    absent = [name for name in EXPOSURES if name not in columns and not _MOVES.fullmatch(name)]
    remarks = [f"no word for {', '.join(absent)}: taken as not known"] if absent else []
    return table | {"FILE": np.array([file for file, _ in records])}, remarks


def of_header(
    header: Mapping[str, Any], words: Words, names: Collection[str], file: str | os.PathLike[str]
) -> dict[str, Any]:
    """The columns `names` that `words` make of one header, those that have a word."""
    wanted = {name: word for name, word in words.columns.items() if name in names}
    used = {
        other
        for word in wanted.values()
        if word.expression
        for other in _names(word.expression, Reader(""), "")
    }
    needed = wanted | {name: word for name, word in words.columns.items() if name in used}
    row = _row({key: header[key] for key in dict.fromkeys(header) if key}, Words(needed), str(file))
    return {name: value for name, value in row.items() if name in wanted}


# ------------------------------------------------------------------------------------------------ files and records


def _records(path: Path, words: Words) -> Iterator[Mapping[str, Any]]:
    """The words of every exposure in a file: one of a FITS file, one for each record or row of others."""
    suffix = path.suffix.lower()
    if suffix in (".json", ".jsonl"):
        yield from _of_json(path, words.rows)
    elif suffix in (".fits", ".fit", ".fts", ".gz", ".fz"):
        from astropy.io import fits

        try:
            header: Any = fits.getheader(path, words.extension)
        except (OSError, IndexError, KeyError) as error:
            raise fail(
                f"has no header to read: {error}", file=path, advice="check the name and `extension`"
            ) from error
        yield {key: header[key] for key in dict.fromkeys(header) if key}
    else:
        _, table, _ = read_table_file(path, ())
        for row in table:
            yield {name: _unmasked(row[name]) for name in table.colnames}


def _of_json(path: Path, rows: str) -> Iterator[Mapping[str, Any]]:
    text = read_text(path)
    try:
        content = json.loads(text)
    except (json.JSONDecodeError, RecursionError) as error:
        try:
            content = [json.loads(line) for line in text.splitlines() if line.strip()]
        except (json.JSONDecodeError, RecursionError):
            raise fail(f"is no JSON: {error}", file=path, advice="export the log again") from None
    for key in filter(None, rows.split(".")):
        if not isinstance(content, Mapping) or key not in content:
            keys = list(content) if isinstance(content, Mapping) else []
            raise fail(
                f"rows = {rows!r}: there is no {key!r}",
                file=path,
                advice=nearest(key, keys) if keys else "",
            )
        content = content[key]
    if not isinstance(content, list) or not all(isinstance(record, Mapping) for record in content):
        raise fail("holds no list of records", file=path, advice='give its place: rows = "data.exposures"')
    yield from content


def _unmasked(value: Any) -> Any:
    return None if np.ma.is_masked(value) else value.item() if hasattr(value, "item") else value


def _found(record: Mapping[str, Any], word: str) -> Any:
    """The value of a word, a path of words in nested records ("hwp.angle"); None where it is not there or empty."""
    value: Any = record
    if word in record:
        value = record[word]
    else:
        for key in word.split("."):
            value = value.get(key) if isinstance(value, Mapping) else None
    if isinstance(value, Mapping) and len(value) == 1 and (key := next(iter(value))).startswith("$"):
        value = value[key]  # of a document database: {"$date": …}
    return None if isinstance(value, str) and value.strip().lower() in MISSING else value


# --------------------------------------------------------------------------------------------------- values of words


def _row(record: Mapping[str, Any], words: Words, file: str) -> dict[str, Any]:
    """The columns of one exposure."""
    place, row, converted = Place(file, ""), {}, dict[str, Any]()
    rules = table_rules("EXPOSURES", list(words.columns), place)
    for name, word in words.columns.items():
        value = (
            word.value
            if not word.words
            else next((v for w in word.words if (v := _found(record, w)) is not None), None)
        )
        if value is None:
            if word.optional:
                continue
            listed = " or ".join(word.words)
            there = any(name_of in record for name_of in word.words)
            like = nearest(word.words[0], record) if record and not there else ""
            raise place.fail(
                f"the word {listed} is {'empty' if there else 'missing'}",
                name,
                f"{like}{'; ' if like else ''}optional = true where it may be absent",
            )
        converted[name] = _value(value, name, rules[name], word, place)
    for name, value in converted.items():
        expression = words.columns[name].expression
        row[name] = (
            value if not expression else _evaluated(expression, {**converted, "x": value}, name, place)
        )
    return row


def _value(value: Any, name: str, rule: Column, word: Word, place: Place) -> Any:
    """A value in the unit and of the kind of its column."""
    if word.values:
        keys = {key.upper(): replacement for key, replacement in word.values.items()}
        text = _text(value).upper()
        if text not in keys:
            raise place.fail(f"{word.words[0]} = {value!r} is none of its values", name, nearest(text, keys))
        value = keys[text]
    what = f"{' or '.join(word.words) or 'value'} = {value!r}"
    if rule.kind == "str":
        return _text(value)
    if rule.kind == "bool":
        text = _text(value).lower()
        if text not in _INSIDE:
            raise place.fail(
                f"{what} is neither true nor false", name, 'give its meaning: values = { "…" = true }'
            )
        return _INSIDE[text]
    number = _number(value, name, rule, word, place, what)
    if rule.kind == "int":
        if number != round(number):
            raise place.fail(f"{what} is not a whole number", name, "give an expression, or another word")
        return int(number)
    return number


def _number(value: Any, name: str, rule: Column, word: Word, place: Place, what: str) -> float:
    if isinstance(value, str) and rule.unit == "d" and not _is_number(value):
        from astropy.time import Time

        try:
            days: Any = Time(value.strip().rstrip("Z"), scale="utc").mjd
            return float(days)
        except ValueError:
            raise place.fail(
                f"{what} is no date", name, "as 2026-11-26T01:02:03, or a number of days"
            ) from None
    if isinstance(value, str) and rule.unit in ("deg", "h") and _SEXAGESIMAL.fullmatch(value.strip()):
        number = sexagesimal(value)
        if not word.unit:
            raise place.fail(
                f"{what} may be hours or degrees", name, 'give unit = "hourangle" or unit = "deg"'
            )
    elif isinstance(value, bool) or not _is_number(value):
        raise place.fail(f"{what} is not a number", name, "give another word, or values = { … }")
    else:
        number = float(value)
    if not word.unit:
        return number
    return float(convert_unit(np.array([number]), word.unit, rule.unit, name, place)[0])


def _text(value: Any) -> str:
    return str(int(value)) if isinstance(value, float) and value == int(value) else str(value).strip()


def _is_number(value: Any) -> bool:
    try:
        return math.isfinite(float(value))
    except (TypeError, ValueError):
        return False


def _column(values: Sequence[Any], name: str) -> np.ndarray:
    """The values of all exposures; missing ones are those of an absent column."""
    rule = EXPOSURES.get(name)
    missing = (
        False if name.endswith("_IN") else 0.0 if name.endswith("_TURN") else rule.missing if rule else np.nan
    )
    return np.array([missing if value is None else value for value in values])


def _names(expression: str, read: Reader, name: str) -> set[str]:
    try:
        tree = ast.parse(expression, mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise read.fault(name, f"expression = {expression!r} cannot be read: as in x + 90") from None
    allowed = (ast.BinOp, ast.UnaryOp, ast.Constant, ast.Name, ast.Load, *_OPERATORS)
    for node in ast.walk(tree):
        number = not isinstance(node, ast.Constant) or type(node.value) in (int, float)
        if not isinstance(node, allowed) or not number:
            raise read.fault(
                name, f"expression = {expression!r} may hold numbers, columns, + - * / % ** and ( ) only"
            )
    return {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}


def _evaluated(expression: str, values: Mapping[str, Any], name: str, place: Place) -> float:
    def of(node: Any) -> float:
        if isinstance(node, ast.Constant):
            return float(node.value)  # pyright: ignore[reportArgumentType]: `_names` lets numbers pass alone
        if isinstance(node, ast.Name):
            if not isinstance(values.get(node.id), int | float):
                raise place.fail(f"{expression!r} needs {node.id}, which is not known", name, "give its word")
            return float(values[node.id])
        operands = (node.operand,) if isinstance(node, ast.UnaryOp) else (node.left, node.right)
        return _OPERATORS[type(node.op)](*map(of, operands))

    try:
        result = of(ast.parse(expression, mode="eval").body)
    except (ZeroDivisionError, OverflowError) as error:
        raise place.fail(f"{expression!r}: {error}", name, "correct the expression") from None
    if isinstance(result, complex) or not np.isfinite(result):
        raise place.fail(f"{expression!r} is not finite", name, "correct the expression")
    return result
