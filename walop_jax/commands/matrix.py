"""`walop-jax matrix`: the instrument matrix and its errors at field points."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from walop_jax.commands import products
from walop_jax.commands.command import Job, Option, Outcome, PathLike, UsageError, command, typed
from walop_jax.commands.tables import table_of, table_outcome
from walop_jax.io.errors import errors_naming, fail, nearest

OPTIONS = {
    "calibration": Option(
        "Calibration product, or the folder of a run.", metavar="RUN/calibration.fits", kind=Path, placed=True
    ),
    "x": Option("One field point: X (deg).", kind=float),
    "y": Option("The same: Y (deg).", kind=float),
    "points": Option("FITS, CSV, ECSV or VOTable with X, Y in degrees.", metavar="TABLE", kind=Path),
    "output": Option(
        "Table to write (.fits, .csv, .ecsv); needed with --points.", metavar="OUT", kind=Path, short="-o"
    ),
    "teff": Option("Colour temperature (K); without it, a flat spectrum.", kind=float),
    "filter": Option("Filter of the calibration, or SDSS-r.", kind=str),
}


@command(writes="table", options=OPTIONS)
def matrix(
    job: Job,
    calibration: products.CalibrationLike,
    x: Any = None,
    y: Any = None,
    *,
    points: Any = None,
    output: PathLike | None = None,
    posterior: products.Posterior = None,
    effects: products.Effects = None,
    at: products.Angles = None,
    teff: Any = None,
    filter: Any = None,
) -> Outcome[Any]:
    """Give the instrument matrix at a field point, or at every point of a table.

    Added are M21, M22, M23, M31, M32, M33 and their errors (three for each arm), and P_ERR: the standard error of p of
    a star with p ≤ 5 %, from the calibration alone.

    X and Y in degrees; optional TEFF, FILTER, TEMP, HA (absent: flat spectrum, SDSS-r, 10 Celsius, on the
    meridian), and CHWP_ANGLE, CHWP_IN, or the same columns of any other moving element (absent: out of the beam).

    FLAG is added: 16 high cross-talk (a single exposure can hardly be inverted there), 32 beyond the field
    points of the calibration, 64 filter or temperature that the calibration has not seen. Beyond the field
    of the instrument (0.35 degrees for the WALOPs) there is no value: NaN and FLAG 32.

    Columns of a table that are not used are named.

    In Python: an astropy table, for `x`, `y` (degrees or quantities) or for the table `points`: a path, an astropy
    table, columns by name (the other quantities above among them).

    >>> print(walop.matrix(result, x=0.1, y=-0.05))
    field point X +0.100°, Y −0.050°
      m21 0.0716... ± 0.000...
    """
    from walop_jax.calibration.matrix_table import MatrixTable
    from walop_jax.fit.verdict import Quality
    from walop_jax.posterior.draws import with_draws
    from walop_jax.science.field_points import field_points

    if (points is None) == (x is None and y is None):
        raise UsageError("give the place: --x and --y, or a table of places", "points")
    if points is None and (x is None or y is None):
        raise UsageError("a field point needs both x and y", "y")
    if job.typed and points is not None and output is None:
        if "," in str(points) and not Path(points).exists():
            raise UsageError("it is no table; a single field point is --x 0.1 --y 0.2", "points")
        raise UsageError("name the table to be written", "output")
    held = products.calibration_of(calibration, effects)
    instrument = held.model.template.patched()
    moving, columns = instrument.moving(), {}
    for prefix, angle in products.angles_of(at).items():
        if prefix not in moving:
            raise UsageError(f"there is no moving element {prefix!r}; {nearest(prefix, moving)}", "at")
        columns |= {f"{prefix}_IN": True, f"{prefix}_ANGLE": angle}
    columns |= {name: value for name, value in (("TEFF", teff), ("FILTER", filter)) if value is not None}
    table = table_of({"X": x, "Y": y} if points is None else points, columns)
    never = [prefix for prefix in held.never_in if f"{prefix}_ANGLE" not in columns]
    places = field_points(table, instrument, held.always_in, never, filters=tuple(held.filters))
    if points is None and places.outside.all():
        what = f"beyond the field of {instrument.name} (±{instrument.field_limit:g}°)"
        raise fail(what, column="X, Y", advice="give degrees; are these arcmin?")
    job.tell("working out the matrix")
    used = held if posterior is None else with_draws(held, posterior)
    with errors_naming(table.path):
        added = used.matrix_columns(places.x, places.y, places.settings, places.outside)
    outcome = table_outcome(
        job,
        held,
        table,
        added,
        used.provenance(held.content_hash()),
        output,
        counted={
            Quality.HIGH_CROSSTALK: "",
            Quality.BEYOND_FIELD: "point(s) beyond the calibrated field: extrapolated, or NaN (FLAG 32)",
            Quality.BEYOND_SETTINGS: "row(s) with a filter or temperature not in the calibration (FLAG 64)",
        },
        extra={} if x is None else {"matrix": {name: column[0].tolist() for name, column in added.items()}},
    )
    result = MatrixTable(outcome.value, copy=False)
    result.meanings = {int(bit): bit.meaning for bit in Quality}
    result.reading = instrument.reading_in_words
    crossed = outcome.content["flags"][str(int(Quality.HIGH_CROSSTALK))]
    text = f"{output}: {table.rows} rows, {crossed} of them in zones of high cross-talk"
    advice = (typed("matrix", "RUN", "--points", "TABLE", "-o", "OUT.fits"),) if output is None else ()
    return dataclasses.replace(
        outcome, value=result, text=str(result) if output is None else text, next=advice
    )
