"""`walop-jax exposures`: a table of EXPOSURES of an observatory's headers, its log, or an executed schedule."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from walop_jax.commands.command import Job, Outcome, PathLike, UsageError, command, several


@command(writes="table", jax=False)
def exposures(
    job: Job,
    files: PathLike | Sequence[PathLike],
    *,
    words: PathLike | None = None,
    output: PathLike | None = None,
) -> Outcome[Any]:
    """Make the table EXPOSURES of a calibration set from the records of an observatory.

    WORDS.toml assigns header words (keys of a log, columns of a table) to columns, in which unit, and what
    is made of it (walop-jax docs files). Words that are missing, units that do not fit and values that cannot be meant
    are errors, with file and word. An executed schedule (format v4) needs the numbers of its filters alone.

    In Python: an astropy table; its columns are those of `from_arrays`.

    >>> walop.exposures(["night/0001.fits", "night/0002.fits"], words="words.toml")  # doctest: +SKIP
    """
    from walop_jax.data.header_words import exposures_table, json_content, read_words
    from walop_jax.data.schedule import is_schedule, read_schedule
    from walop_jax.data.schema import EXPOSURES
    from walop_jax.io.plain_tables import astropy_table, write_table

    if words is None:
        raise UsageError("give the file that assigns words to columns", "words")
    paths = several(files)
    rules = read_words(words)
    single = len(paths) == 1 and Path(paths[0]).suffix.lower() == ".json"
    content = json_content(paths[0]) if single else None
    if is_schedule(content):
        columns, remarks = read_schedule(paths[0], rules.filters, content)
    else:
        columns, remarks = exposures_table(paths, rules, content)
    units = {name: "deg" for name in columns if name.endswith(("_ANGLE", "_TURN"))}
    units |= {name: rule.unit for name, rule in EXPOSURES.items()}
    table = astropy_table({name: (values, units.get(name, ""), "") for name, values in columns.items()})
    if output is not None:
        write_table(output, table, overwrite=job.overwrite)
    document = {"output": output, "exposures": len(table), "columns": table.colnames, "remarks": remarks}
    return Outcome(table, document, f"{output}: {len(table)} exposures", warnings=remarks)
