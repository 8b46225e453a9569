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
import re
import typing
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from walop_jax.data.celestial import made_icrs
from walop_jax.data.kinds import KINDS
from walop_jax.data.schema import EXPOSURES, MISSING, Column, check, table_of, table_rules
from walop_jax.data.table_files import read_table_file
from walop_jax.data.units import Place, convert_unit, degrees_of, is_sexagesimal, mjd_of
from walop_jax.io.errors import PathLike, errors_naming, fail, nearest
from walop_jax.io.text import parse_toml, read_text
from walop_jax.io.toml import Reader

FACTS = ("name", "pi", "mode", "observer")
MODES = ("manual", "auto")
LONGEST = 100  # characters of a fact
MJD_1970 = 40587.0
TOLERATED = 2.0 / 86400.0  # d: times are of whole seconds
_JSON, _FITS = {".json", ".jsonl"}, {".fits", ".fit", ".fts", ".gz", ".fz"}
_MOVES = re.compile(r"[A-Z][A-Z0-9_]*_(IN|ANGLE|TURN)")
_INSIDE: Mapping[str, bool] = {
    **dict.fromkeys(("t", "true", "1", "in"), True),
    **dict.fromkeys(("f", "false", "0", "out"), False),
}
_OPERATORS: Mapping[type[ast.AST], Callable[..., Any]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv,
    ast.Pow: operator.pow, ast.Mod: operator.mod, ast.USub: operator.neg, ast.UAdd: operator.pos,
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Word:
    """How one column of EXPOSURES is made: from the first of the words in `word` that is there, or a fixed `value`.

    `values` replaces values of the word (names of filters, kinds, positions); `unit` is the unit of the word.
    `expression` makes the value of the column from x, the value of the word in the unit of the column, and from the
    final values of other columns, by name. Example: `word = ["ROTANGLE"]`, `expression = "360 - x"`.
    """

    word: tuple[str, ...] = ()
    unit: str = ""
    expression: str = ""
    values: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    value: Any = None
    optional: bool = False


@dataclasses.dataclass(frozen=True)
class Words:
    """The words of an observatory by column of EXPOSURES, and the other entries of its file.

    `extension` is the extension of FITS files with the words, `rows` says where the rows of a JSON file are, `filters`
    gives the numbers of filters and `schedule` the facts of schedules (`data.schedule`).
    """

    columns: Mapping[str, Word]
    extension: int = 0
    rows: str = ""
    filters: Mapping[str, int] = dataclasses.field(default_factory=dict)
    schedule: Mapping[str, str] = dataclasses.field(default_factory=dict)


def read_words(path: PathLike) -> Words:
    """The words in a file. Raises `DataError` for a column that EXPOSURES do not have, and for unknown keys."""
    with errors_naming(path):
        return words_of(parse_toml(read_text(path)))


def words_of(content: Mapping[str, Any]) -> Words:
    """The words in the tables of a TOML file."""
    read, columns, of_word = Reader(""), {}, typing.get_type_hints(Word)
    tops = {key: kind for key, kind in typing.get_type_hints(Words).items() if key != "columns"}
    for name, table in content.items():
        if name in tops:
            continue
        if name not in EXPOSURES and not _MOVES.fullmatch(name):
            raise read.fault("", f"EXPOSURES have no column {name!r}; {nearest(name, [*EXPOSURES, *tops])}")
        table = read.table(table, name)
        if isinstance(single := table.get("word"), str):
            table = {**table, "word": (single,)}
        columns[name] = word = Word(**read.values(of_word, table, name))
        if bool(word.word) == ("value" in table):
            what = 'needs word = "…", a list of words of which the first is taken, or value = …'
            raise read.fault(name, what)
        if word.expression and (odd := _names(word.expression, read, name) - {"x", *content}):
            raise read.fault(name, f"expression: there is no {min(odd)!r}; {nearest(min(odd), content)}")
    top = read.values(tops, {key: value for key, value in content.items() if key in tops}, "")
    read.known(facts := top.get("schedule", {}), FACTS, "schedule")
    if (mode := facts.get("mode", MODES[0])) not in MODES:
        raise read.fault("schedule", f"mode = {mode!r} is neither {' nor '.join(MODES)}")
    if long := [key for key, text in facts.items() if len(text) > LONGEST]:
        raise read.fault("schedule", f"{long[0]} has more than {LONGEST} characters")
    return Words(columns, **top)


def exposures_table(
    paths: Sequence[PathLike], words: Words, content: Any = None
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Columns of EXPOSURES, one row for each exposure in the files, their names in FILE; and remarks.

    `content` is that of the only file, JSON, where it has been read. KIND `clp` is taken through the polariser where no
    word states CLP_IN. Raises `DataError`, with file, word and column, for words that are missing, have another unit,
    or a value that cannot be meant.
    """
    records = [(str(path), record) for path in map(Path, paths) for record in _records(path, words, content)]
    if not records:
        raise fail("no exposures in these files", advice="name FITS files, a JSON file or a table")
    rows = [_row(record, words.columns, file) for file, record in records]
    converted = [
        _made_icrs(row, record, words, file) for row, (file, record) in zip(rows, records, strict=True)
    ]
    there = set().union(*rows, ("EXPOSURE",))
    through = [row for row in rows if "CLP_IN" not in row and str(row.get("KIND")).lower() == "clp"]
    for row in through:
        row["CLP_IN"] = True
    table = columns_of(rows, ", ".join(dict.fromkeys(file for file, _ in records)))
    absent = [name for name in EXPOSURES if name not in there and not _MOVES.fullmatch(name)]
    remarks = [f"no word for {', '.join(absent)}: taken as not known"] if absent else []
    suffixes = {Path(path).suffix.lower() for path in paths}
    if words.rows and not suffixes & _JSON:
        remarks.append(f"rows = {words.rows!r} of the words is not used: no file is JSON")
    if words.extension and not suffixes & _FITS:
        remarks.append(f"extension = {words.extension} of the words is not used: no file is FITS")
    for frame in dict.fromkeys(filter(None, converted)):
        remarks.append(f"RA and DEC of {converted.count(frame)} exposures are in {frame}: converted to ICRS")
    if through:
        remarks.append(f"CLP_IN is not stated in {len(through)} exposures of KIND clp: taken as true")
    if unknown := int(np.sum(table["CLP_IN"] & np.isnan(table.get("CLP_ANGLE", np.array(np.nan))))):
        remarks.append(f"CLP_ANGLE is not known in {unknown} exposures through the polariser: a fit needs it")
    if early := overlapping(table["MJD"], table["EXPTIME"]):
        what = "begin before the one ahead of them has ended: is a record there twice, or a file for each camera?"
        remarks.append(f"{early} exposures {what} MJD is the middle, in UTC")
    return table | {"FILE": np.array([file for file, _ in records])}, remarks


def columns_of(rows: Sequence[Mapping[str, Any]], file: str) -> dict[str, np.ndarray]:
    """Columns of EXPOSURES, checked, of rows by name; missing values are those of an absent column."""
    place, names = Place(file, "EXPOSURES"), list(dict.fromkeys(name for row in rows for name in row))
    if "KIND" not in names:
        raise place.fail("the kind of the exposures is not known", "KIND", "add [KIND] to the words")
    rules = table_rules("EXPOSURES", names, place)
    unknown = {"bool": False, "float": np.nan}
    missing = {n: unknown.get(r.kind) if r.missing is None else r.missing for n, r in rules.items()}
    columns = {name: np.array([row.get(name, missing[name]) for row in rows]) for name in names}
    table = table_of({"EXPOSURE": np.arange(len(rows)), **columns}, rules, place)
    table["KIND"] = np.char.lower(table["KIND"])
    for kind in np.unique(table["KIND"]).tolist():
        if kind not in KINDS:
            what = f"{kind!r} is not a kind,"
            place.refuse(table["KIND"] == kind, what, "KIND", f"list it in values; {nearest(kind, KINDS)}")
    check(table, {name: rule for name, rule in rules.items() if name in table}, place)
    return table


def overlapping(mjd: np.ndarray, exptime: np.ndarray) -> int:
    """The number of exposures that begin before the one ahead of them, in time, has ended."""
    order = np.argsort(mjd, kind="stable")
    middle, half = mjd[order], np.nan_to_num(exptime[order]) / 2.0 / 86400.0
    return int(np.sum((middle - half)[1:] < (middle + half)[:-1] - TOLERATED))


def of_header(
    header: Mapping[str, Any], words: Words, names: Collection[str], file: PathLike
) -> dict[str, Any]:
    """The columns `names` that `words` make of one header, those that have a word."""
    needed, waiting = dict[str, Word](), list(names)
    while waiting:  # with what their expressions need, and what that needs
        name = waiting.pop()
        if name in words.columns and name not in needed:
            word = needed[name] = words.columns[name]
            waiting += _operands(word.expression)
    row = _row(_plain(header), needed, str(file))
    _made_icrs(row, header, words, str(file))
    return {name: value for name, value in row.items() if name in names}


def _plain(header: Mapping[str, Any]) -> dict[str, Any]:
    """The words of a header, the first of each name."""
    return {key: header[key] for key in dict.fromkeys(header) if key}


# ------------------------------------------------------------------------------------------------ files and records


def _records(path: Path, words: Words, content: Any) -> Iterator[Mapping[str, Any]]:
    """The words of every exposure in a file: one of a FITS file, one for each record or row of others."""
    suffix = path.suffix.lower()
    if suffix in _JSON:
        yield from _of_json(path, words.rows, json_content(path) if content is None else content)
    elif suffix in _FITS:
        from astropy.io import fits

        try:
            header: Any = fits.getheader(path, words.extension)
        except (OSError, IndexError, KeyError) as error:
            advice = "check the name and `extension`"
            raise fail(f"has no header to read: {error}", file=path, advice=advice) from error
        yield _plain(header)
    else:
        table = read_table_file(path, ())[1]
        yield from (dict(zip(table.colnames, row, strict=True)) for row in table.iterrows())


def json_content(path: PathLike) -> Any:
    """The content of a JSON file, a list where it has a record in each line."""
    text = read_text(path)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        try:
            return [json.loads(line) for line in text.splitlines() if line.strip()]
        except (ValueError, RecursionError):
            raise fail(f"is no JSON: {error}", file=path, advice="export or write it again") from None


def _of_json(path: Path, rows: str, content: Any) -> Iterator[Mapping[str, Any]]:
    for key in filter(None, rows.split(".")):
        if not isinstance(content, Mapping) or key not in content:
            advice = nearest(key, content) if content and isinstance(content, Mapping) else ""
            raise fail(f"rows = {rows!r}: there is no {key!r}", file=path, advice=advice)
        content = content[key]
    if not isinstance(content, list) or not all(isinstance(record, Mapping) for record in content):
        raise fail("holds no list of records", file=path, advice='give its place: rows = "data.exposures"')
    yield from content


def _found(record: Mapping[str, Any], word: str) -> Any:
    """The value of a word, a path of words in nested records ("hwp.angle"); None where it is not there or empty."""
    value: Any = record
    if word in record:
        value = record[word]
    else:
        for key in word.split("."):
            value = value.get(key) if isinstance(value, Mapping) else None
    while isinstance(value, Mapping) and len(value) == 1 and (key := next(iter(value))).startswith("$"):
        value = value[key]  # of a document database: {"$date": {"$numberLong": milliseconds since 1970}}
        if key == "$date" and not isinstance(value, str):
            value = MJD_1970 + float(_found({"": value}, "")) / 86400e3
    if np.ma.is_masked(value):
        return None
    value = getattr(value, "item", lambda: value)()  # of numpy
    empty = isinstance(value, float) and math.isnan(value)
    return None if empty or (isinstance(value, str) and value.strip().lower() in MISSING) else value


# --------------------------------------------------------------------------------------------------- values of words


def _row(record: Mapping[str, Any], words: Mapping[str, Word], file: str) -> dict[str, Any]:
    """The columns of one exposure."""
    place, converted = Place(file, ""), dict[str, Any]()
    rules = table_rules("EXPOSURES", list(words), place)
    for name, word in words.items():
        there = (value for of in word.word if (value := _found(record, of)) is not None)
        if (value := next(there, word.value)) is None:
            if word.optional:
                continue
            listed = " or ".join(word.word)
            empty = any(of in record for of in word.word)
            like = f"{nearest(word.word[0], record)}; " if record and not empty else ""
            what = f"the word {listed} is {'empty' if empty else 'missing'}"
            raise place.fail(what, name, f"{like}optional = true where it may be absent")
        converted[name] = _value(value, name, rules[name], word, place)
    waiting = {name: word.expression for name, word in words.items() if word.expression and name in converted}
    while waiting:  # first those whose operands are as they will be
        ready = [name for name, text in waiting.items() if not (_operands(text) - {name}) & set(waiting)]
        if not ready:
            what = f"the expressions of {' and '.join(waiting)} need each other"
            raise place.fail(what, next(iter(waiting)), "give one of them without the other")
        for name in ready:
            operands = {**converted, "x": converted[name]}
            converted[name] = _evaluated(waiting.pop(name), operands, name, place)
    return converted


def _made_icrs(row: dict[str, Any], record: Mapping[str, Any], words: Words, file: str) -> str:
    """Put RA and DEC of a row into ICRS, where they are words of a record in another system; its name, "" for ICRS."""
    if not {"RA", "DEC"} <= set(row) or any(words.columns[name].value is not None for name in ("RA", "DEC")):
        return ""
    place = Place(file, "")
    ra, dec, frame = made_icrs(record, row["RA"], row["DEC"], row.get("MJD", math.nan), place)
    row |= {"RA": float(ra), "DEC": float(dec)}
    return "" if frame.is_icrs else frame.system if frame.system == "GAPPT" else str(frame)


def _value(value: Any, name: str, rule: Column, word: Word, place: Place) -> Any:
    """A value in the unit and of the kind of its column."""
    if word.values:
        keys = {key.upper(): replacement for key, replacement in word.values.items()}
        text = _text(value).upper()
        if text not in keys:
            raise place.fail(f"{word.word[0]} = {value!r} is none of its values", name, nearest(text, keys))
        value = keys[text]
    what = f"{' or '.join(word.word) or 'value'} = {value!r}"
    if rule.kind == "str":
        return _text(value)
    if rule.kind == "bool":
        if (inside := _INSIDE.get(_text(value).lower())) is None:
            advice = 'give its meaning: values = { "…" = true }'
            raise place.fail(f"{what} is neither true nor false", name, advice)
        return inside
    number = _number(value, name, rule, word, place, what)
    if rule.kind == "int":
        if number != round(number):
            raise place.fail(f"{what} is not a whole number", name, "give an expression, or another word")
        return int(number)
    return number


def _number(value: Any, name: str, rule: Column, word: Word, place: Place, what: str) -> float:
    if isinstance(value, str) and rule.unit == "d" and not _is_number(value):
        try:
            return mjd_of(value)
        except ValueError:
            advice = "as 2026-11-26T01:02:03, or a number of days"
            raise place.fail(f"{what} is no date", name, advice) from None
    if is_sexagesimal(value) and rule.unit in ("deg", "h"):
        with_unit = "h" in value or "d" in value
        try:
            value = float(degrees_of(value, "deg"))  # 6h30m is 97.5 deg, 6:30 is 6.5 of the word's unit
        except ValueError:
            raise place.fail(f"{what} is no angle", name, "as 06:30:12.5, minutes below 60") from None
        if with_unit:
            return value / 15.0 if rule.unit == "h" else value
        if not word.unit:
            advice = 'give unit = "hourangle" or unit = "deg"'
            raise place.fail(f"{what} may be hours or degrees", name, advice)
    if isinstance(value, bool) or not _is_number(value):
        raise place.fail(f"{what} is not a number", name, "give another word, or values = { … }")
    numbers = np.array([float(value)])
    return float((convert_unit(numbers, word.unit, rule.unit, name, place) if word.unit else numbers)[0])


def _text(value: Any) -> str:
    return str(int(value)) if isinstance(value, float) and value == int(value) else str(value).strip()


def _is_number(value: Any) -> bool:
    try:
        return math.isfinite(float(value))
    except (TypeError, ValueError):
        return False


def _names(expression: str, read: Reader, name: str) -> set[str]:
    try:
        tree = ast.parse(expression, mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise read.fault(name, f"expression = {expression!r} cannot be read: as in x + 90") from None
    allowed = (ast.BinOp, ast.UnaryOp, ast.Constant, ast.Name, ast.Load, *_OPERATORS)
    for node in ast.walk(tree):
        number = not isinstance(node, ast.Constant) or type(node.value) in (int, float)
        if not isinstance(node, allowed) or not number:
            what = f"expression = {expression!r} may hold numbers, columns, + - * / % ** and ( ) only"
            raise read.fault(name, what)
    return {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}


def _operands(expression: str) -> set[str]:
    """Names in an expression that has been checked."""
    return _names(expression, Reader(""), "") if expression else set()


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
