"""`walop-jax standards`: standard stars that come with the package."""

from __future__ import annotations

from typing import Any

from walop_jax.commands.command import Job, Option, Outcome, UsageError, command
from walop_jax.commands.products import InstrumentLike

OPTIONS = {
    "near": Option(
        "Sorted by the distance from a direction (deg); one number for each.", metavar="RA,DEC", kind=str
    ),
    "up": Option(
        "Those above 30° at a time (UTC) at the site of the instrument, the highest first.",
        metavar="MJD",
        kind=float,
    ),
}


@command(jax=False, options=OPTIONS)
def standards(
    job: Job,
    *,
    near: str | tuple[float, float] | None = None,
    up: float | None = None,
    instrument: InstrumentLike = None,
) -> Outcome[Any]:
    """List standard stars with band, errors, variability and source.

    The table is dated; its columns are those of SOURCES, and more. Errors of angles hold how much they vary.

    In Python: an astropy QTable.

    >>> table = walop.standards(near=(308.0, 41.0))
    >>> str(table["NAME"][0]), str(table["FILTER"][0])
    ('VI Cyg 12', 'R')
    """
    import numpy as np

    from walop_jax.data.records import Site
    from walop_jax.data.schema import EXPOSURES, check
    from walop_jax.data.standards import LOWEST, shipped_standards
    from walop_jax.data.units import Place
    from walop_jax.instruments.description import default_name, read_description
    from walop_jax.sky.directions import separation
    from walop_jax.sky.moon import altitude

    table = shipped_standards()
    ra, dec = (np.asarray(table[name].to_value("deg"), float) for name in ("RA", "DEC"))
    if near is not None:
        away = separation(ra, dec, *_direction(near))
        table["DISTANCE"] = away * table["RA"].unit
        nearest = np.argsort(away, kind="stable")
        table, ra, dec = table[nearest], ra[nearest], dec[nearest]
    if up is None and instrument is not None:
        raise UsageError("its site matters for stars that are up alone; see --up", "instrument")
    if up is not None:
        if up != up:
            raise UsageError("up = nan must be a time (MJD)", "up")
        check({"MJD": np.array([up])}, {"MJD": EXPOSURES["MJD"]}, Place("up", ""))
        described: Any = default_name() if instrument is None else instrument
        place: Any = described.site if hasattr(described, "site") else read_description(described).place
        if not (site := Site(*place[:4])).known:
            raise UsageError("the site of this instrument is not known", "instrument")
        height = altitude(np.full(len(ra), up), ra, dec, site)
        order = np.arange(len(ra)) if near is not None else np.argsort(-height, kind="stable")
        table["ALTITUDE"] = height * table["RA"].unit
        table = table[order[height[order] >= LOWEST]]
    columns = {name: getattr(table[name], "value", table[name]).tolist() for name in table.colnames}
    rows = [dict(zip(columns, cells, strict=True)) for cells in zip(*columns.values(), strict=True)]
    return Outcome(table, {**table.meta, "standards": rows}, _lines(table))


def _direction(near: str | tuple[float, float]) -> tuple[float, float]:
    try:
        ra, dec = (float(coordinate) for coordinate in (near.split(",") if isinstance(near, str) else near))
    except ValueError:
        wanted = "right ascension and declination in degrees: 308.2,41.2"
        raise UsageError(f"near = {near!r} must be {wanted}", "near") from None
    if not -90.0 <= dec <= 90.0:
        raise UsageError(f"near = {near!r}: a declination is between -90 and 90 degrees", "near")
    if not -360.0 <= ra <= 360.0:
        raise UsageError(f"near = {near!r}: a right ascension is between 0 and 360 degrees", "near")
    return ra, dec


def _lines(table: Any) -> str:
    """The table for a terminal: per cent and degrees."""
    shown = table["NAME", "RA", "DEC", "FILTER", "P", "P_ERR", "ANGLE", "ANGLE_SCATTER"].copy()
    for name in ("P", "P_ERR"):
        shown[name] = 100.0 * shown[name]
        shown[name].info.format = ".3f"
    shown.rename_columns(("P", "P_ERR"), ("P (%)", "error (%)"))
    shown["REFERENCE"] = [str(text).split(",")[0] for text in table["REFERENCE"]]
    head = f"standards of {table.meta['date']}, version {table.meta['version']}; {table.meta['source']}"
    return "\n".join([*shown.pformat(max_lines=-1, max_width=-1, show_unit=True), "", head])
