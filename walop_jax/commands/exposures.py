"""`walop-jax exposures`: a table of EXPOSURES of an observatory's headers, its log, or an executed schedule."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from walop_jax.commands.command import Job, Option, Outcome, PathLike, UsageError, command, several

OPTIONS = {
    "files": Option(
        "FITS files, a JSON export of a log, a table of words or a schedule.",
        metavar="FILE...",
        kind=list[Path],
        placed=True,
    ),
    "words": Option(
        "Which word is which column, which numbers are filters.",
        metavar="WORDS.toml",
        kind=Path,
        required=True,
    ),
    "output": Option(
        "Table to write (.fits, .csv, .ecsv).", metavar="OUT", kind=Path, short="-o", required=True
    ),
}


@command(writes="table", jax=False, options=OPTIONS)
def exposures(
    job: Job,
    files: PathLike | Sequence[PathLike],
    *,
    words: PathLike | None = None,
    output: PathLike | None = None,
) -> Outcome[Any]:
    """Make the table EXPOSURES of a calibration set from the records of an observatory.

    WORDS.toml says which header word (key of a log, column of a table) is which column, in which unit it is, and how it
    is converted (walop-jax docs files). Words that are missing, units that do not fit and values that cannot be meant
    are errors, with file and word. An executed schedule (format v4) needs the numbers of its filters alone.

    In Python: an astropy table, with the columns that `from_arrays` takes.

    >>> walop.exposures(["night/0001.fits", "night/0002.fits"], words="words.toml")  # doctest: +SKIP
    """
    from walop_jax.data.header_words import read_words
    from walop_jax.data.schedule import exposures_as_table, read_exposures
    from walop_jax.io.plain_tables import write_table

    if words is None:
        raise UsageError("give the file that assigns words to columns", "words")
    columns, remarks = read_exposures(several(files), read_words(words))
    table = exposures_as_table(columns)
    if output is not None:
        write_table(output, table, overwrite=job.overwrite)
    document = {"output": output, "exposures": len(table), "columns": table.colnames, "remarks": remarks}
    return Outcome(table, document, f"{output}: {len(table)} exposures", warnings=remarks)
