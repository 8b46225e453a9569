"""`walop-jax affected`: which catalogues must be made again when a calibration is replaced?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from walop_jax.commands.apply import calibration_for, stars_of
from walop_jax.commands.command import Job, Option, Outcome, PathLike, UsageError, command
from walop_jax.commands.products import Effects, Product
from walop_jax.commands.tables import named_tables
from walop_jax.io.errors import errors_naming
from walop_jax.io.names import AFFECTED

if TYPE_CHECKING:
    from walop_jax.science.affected import Affected


OPTIONS = {
    "old": Option(
        "Calibration that the catalogues were reduced with, or its run.",
        metavar="OLD",
        kind=Path,
        placed=True,
    ),
    "new": Option("Calibration that takes its place.", metavar="NEW", kind=Path, placed=True),
    "catalogues": Option(
        "Catalogues, as apply reads or writes them.", metavar="CATALOGUE...", kind=list[Path], placed=True
    ),
    "output": Option("Folder for affected.json.", metavar="RUN", kind=Path, short="-o"),
    "limit": Option(
        "Shift (standard errors) from which a result is made again (default: 0.5).",
        metavar="SIGMA",
        kind=float,
    ),
}


@command(stages=("reading", "tabulating"), writes=(AFFECTED,), options=OPTIONS)
def affected(
    job: Job,
    old: Product,
    new: Product,
    catalogues: Any,
    *,
    output: PathLike | None = None,
    limit: float = 0.5,
    effects: Effects = None,
) -> Outcome[Affected]:
    """List the catalogues that a new calibration changes, and by how much.

    The stars are reduced from their rows by both calibrations; the shift of q and u is given in standard errors of the
    old result, by catalogue and night. A night must be made again where more than 5 % of its stars shift by more than
    the limit, or gain or lose their result. OLD and NEW may be surveys (walop-jax stack), with stars of one night in a
    catalogue: the calibrations at their time are taken.

    Exit code 0 where nothing has to be made again, 3 where something has.

    In Python: an `Affected`; `catalogues` is a path, an astropy table, columns by name, or several of them in a list.

    >>> walop.affected("OLD", "NEW", ["night1.fits", "night2.fits"]).again  # doctest: +SKIP
    """
    from walop_jax.science.affected import Affected
    from walop_jax.science.affected import affected as nights_of

    if not limit > 0:
        raise UsageError(f"{limit} must be above 0 standard errors", "limit")
    nights, warnings, replaced, replacing = [], [], list[str](), list[str]()
    job.begin("reading")
    for name, table in named_tables(catalogues):
        before, after = (calibration_for(product, table, effects, force=True) for product in (old, new))
        if before.instrument != after.instrument:
            what = f"OLD is a calibration of {before.instrument}, NEW one of {after.instrument}"
            raise UsageError(f"{what}: give two of one instrument", "new")
        replaced.append(before.content_hash())
        replacing.append(after.content_hash())
        rows = stars_of(table, before)
        warnings += [f"{name}: {remark}" for remark in rows.remarks if remark.startswith("INSTRUME")]
        made_with = str(table.table.meta.get("CALHASH", ""))
        if made_with == replacing[-1] != replaced[-1]:
            warnings.append(f"{name}: was made with the new calibration already")
        elif made_with and made_with != replaced[-1]:
            warnings.append(f"{name}: was made with a calibration that is neither the old nor the new one")
        job.tell(f"{len(rows)} rows of {name}", "tabulating")
        with errors_naming(table.path):
            shifted = list(nights_of(before, after, rows, name, limit))
        nights += shifted
        if beyond := sum(night.beyond for night in shifted):
            what = "stars have a filter or temperature that the new one does not cover"
            warnings.append(f"{name}: {beyond} {what}")
    first, second = (", ".join(dict.fromkeys(hashes)) for hashes in (replaced, replacing))
    shifts = Affected(first, second, limit, tuple(nights), tuple(warnings))
    return Outcome(shifts, saved_as=AFFECTED, warnings=shifts.warnings, trusted=not shifts.again)
