"""Tables as arguments of commands, and tables with the columns that a calibration adds."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from walop_jax.commands.command import Job, Outcome, PathLike, UsageError, several
from walop_jax.commands.products import NOT_CARRIED_OVER, left_out_cards, left_out_sentences

if TYPE_CHECKING:
    from walop_jax import Calibration
    from walop_jax.data.user_tables import InputTable
    from walop_jax.fit.verdict import Quality


def table_of(given: Any, columns: Mapping[str, Any]) -> InputTable:
    """A table: a file of one, an astropy table, or columns by name; `columns` are added, or replace its own."""
    from walop_jax.data.user_tables import in_memory, read_input_table

    named = {name.upper(): values for name, values in columns.items()}
    if isinstance(given, Mapping):
        return in_memory({key: given[key] for key in given if str(key).upper() not in named} | named)
    read = read_input_table(given) if isinstance(given, str | os.PathLike) else in_memory(given)
    if not named:
        return read
    unchanged = {key: read.table[key] for key in read.table.colnames if str(key).upper() not in named}
    combined = in_memory(unchanged | named, str(read.path))
    combined.table.meta.update(read.table.meta)
    combined.remarks.extend(read.remarks)
    return combined


def named_tables(given: Any) -> list[tuple[str, InputTable]]:
    """Tables, of files or in memory, with the names by which messages call them."""
    if not several(given):
        raise UsageError("give at least one table", "catalogues")
    return [
        (str(entry) if isinstance(entry, str | os.PathLike) else f"catalogue {number}", table_of(entry, {}))
        for number, entry in enumerate(several(given), start=1)
    ]


def table_outcome(
    job: Job,
    held: Calibration,
    table: InputTable,
    columns: Mapping[str, tuple[Any, ...]],
    cards: Mapping[str, Any],
    output: PathLike | None,
    *,
    counted: Mapping[Quality, str],
    warnings: Sequence[str] = (),
    extra: Mapping[str, Any] | None = None,
    remade: Callable[[Any], tuple[Any, Sequence[str]]] | None = None,
) -> Outcome[Any]:
    """A table with the columns added by a calibration, written if it has an output.

    The bits of FLAG that are `counted` have a warning each, unless it is empty; `extra` goes into the document. Columns
    of the table that are not used or are replaced are named. `remade` makes another table of that, with remarks.
    """
    from walop_jax.data.user_tables import extended
    from walop_jax.io.plain_tables import not_in, write_table

    lost = held.left_behind
    extended_table = extended(table, columns, {**cards, **left_out_cards(lost)})
    extended_table, other_remarks = (extended_table, ()) if remade is None else remade(extended_table)
    if output is not None:
        write_table(output, extended_table, overwrite=job.overwrite)
        warnings = [*warnings, *not_in(output, extended_table)]
    counts = {bit: int((columns["FLAG"][0] & bit > 0).sum()) for bit in sorted(counted)}
    remarks = table.about(columns)
    document = {
        "output": output,
        "rows": table.rows,
        "trusted": held.verdict.trusted,
        "flags": {str(int(bit)): count for bit, count in counts.items()},
        "product": held.content_hash(),
        NOT_CARRIED_OVER: list(lost),
        "remarks": list(remarks),
        **(extra or {}),
    }
    about = (f"{counts[bit]} {sentence}" for bit, sentence in counted.items() if sentence and counts[bit])
    of_table = (f"{table.path}: {text}" for text in (*remarks, *other_remarks, *warnings, *about))
    sentences = (*held.warnings, *left_out_sentences(lost, held.path), *of_table)
    return Outcome(extended_table, document, warnings=sentences)
