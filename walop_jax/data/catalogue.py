"""Tables that an instrument is asked about: field points, and catalogues of stars (docs: files).

Catalogues have one row per star and exposure, an intensity of every camera.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Collection, Mapping, Sequence, Sized
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from walop_jax.data.schema import EXPOSURES, Column, Place, check, finite
from walop_jax.data.settings import TEMPERATURE, Settings
from walop_jax.data.user_tables import InputTable, numeric_column, read_input_table, vector_column
from walop_jax.io.errors import rows_text

_NEGATIVE = 5.0  # sigma: what noise about a subtracted background may do, and no more
_SINGLE = 1  # point: it may lie outside without a doubt about its unit
_FINITE = finite("correct or remove these rows")


def _also_finite(column: Column, missing: object) -> Column:
    """A column of a calibration set in a table of field points, where a number is needed in every row."""
    return dataclasses.replace(column, missing=missing, rules=(_FINITE, *column.rules))


POINT_COLUMNS: Mapping[str, Column] = {
    "X": Column("float", "deg", rules=(_FINITE,)),
    "Y": Column("float", "deg", rules=(_FINITE,)),
    "TEFF": EXPOSURES["TEFF"],
    "FILTER": EXPOSURES["FILTER"],
    "TEMP": _also_finite(EXPOSURES["TEMP"], TEMPERATURE),
    "HA": _also_finite(EXPOSURES["HA"], 0.0),
}


@runtime_checkable
class NamedCameras(Sized, Protocol):
    """Cameras as a table needs to know them."""

    @property
    def names(self) -> Sequence[str]:
        """Their names, in order."""
        ...

    @property
    def pairs(self) -> Sized:
        """Those of the arms with two: a row of the matrix each."""
        ...


@runtime_checkable
class InstrumentOfTables(Protocol):
    """The instrument of a table, as that needs to know it; the field reaches to ±`field_limit` (deg)."""

    @property
    def name(self) -> str:
        """Its name."""
        ...

    @property
    def field_limit(self) -> float:
        """Largest |X|, |Y| (deg)."""
        ...

    @property
    def cameras(self) -> NamedCameras:
        """Its cameras."""
        ...

    def moving(self) -> tuple[str, ...]:
        """Column prefixes of its moving elements behind the polariser."""
        ...


@dataclasses.dataclass(frozen=True)
class FieldPoints:
    """Field points, and the optical settings there, for which an instrument matrix is asked.

    `x`, `y` in degrees; `outside` marks points beyond the field of the instrument.
    """

    x: Float[np.ndarray, " n"]
    y: Float[np.ndarray, " n"]
    settings: Settings
    outside: Bool[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.x)


def field_points(
    source: InputTable, instrument: InstrumentOfTables, always_in: Collection[str] = ()
) -> FieldPoints:
    """The X, Y and optional settings of a table of field points of an instrument.

    A moving element has the columns `<P>_ANGLE` and `<P>_IN`; without the latter it is in the beam where it has an
    angle. The elements `always_in` (column prefixes) must have an angle. Single points outside the field are marked; if
    most of them lie outside, the unit must be wrong.

    Raises `DataError` naming file, column and row for anything that cannot be meant.
    """
    place = Place(source.path, "")
    columns = {name: numeric_column(source, name, rule) for name, rule in POINT_COLUMNS.items()}
    check(columns, POINT_COLUMNS, place)
    x, y = columns["X"], columns["Y"]
    positions = {}
    for prefix in instrument.moving():
        name = f"{prefix}_ANGLE"
        if prefix in always_in and name not in source.names:
            advice = (
                f"give it in a table: {prefix} was in the beam in all exposures of the calibration (NaN: out)"
            )
            raise place.fail("the column is missing", name, advice)
        angle = numeric_column(source, name, EXPOSURES["CLP_ANGLE"])
        inside = np.isfinite(angle)
        if f"{prefix}_IN" in source.names:
            inside = numeric_column(source, f"{prefix}_IN", EXPOSURES["CHWP_IN"])
        advice = f"{prefix}_IN is true: give the angle"
        place.refuse(inside & ~np.isfinite(angle), "is not finite", name, advice)
        check({name: angle}, {name: EXPOSURES["CLP_ANGLE"]}, place)
        positions[prefix] = np.where(inside, angle, np.nan)
    limit = instrument.field_limit
    outside = np.maximum(np.abs(x), np.abs(y)) > limit
    if len(x) > _SINGLE and np.mean(outside) > 0.5:
        raise place.fail(
            f"most points lie outside ±{limit:g}° of {instrument.name}: {rows_text(np.flatnonzero(outside))}",
            "X, Y",
            "field coordinates are in degrees: are these arcmin or pixels?",
        )
    settings = Settings(
        filter=columns["FILTER"],
        teff=columns["TEFF"],
        temperature=columns["TEMP"],
        hour_angle=columns["HA"],
        positions=positions,
    )
    return FieldPoints(x=x, y=y, settings=settings, outside=outside)


def true_matrices(
    path: str | os.PathLike[str], instrument: InstrumentOfTables
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, "n m"]]:
    """X, Y (deg) and M21, M22, … of a table of true matrices, three for each arm.

    Raises `DataError` for what is missing or not finite.
    """
    source = read_input_table(path)
    points = field_points(source, instrument)
    names = [f"M{arm + 2}{column}" for arm in range(len(instrument.cameras.pairs)) for column in (1, 2, 3)]
    matrix = np.stack([numeric_column(source, name, Column("float")) for name in names], axis=1)
    Place(path, "").refuse(
        ~np.isfinite(matrix), "not finite", f"{names[0]} … {names[-1]}", "remove these rows"
    )
    return points.x, points.y, matrix


# ------------------------------------------------------------------------------------ stars


@dataclasses.dataclass(frozen=True)
class Catalogue:
    """The rows of a science catalogue.

    `points` are positions and settings; `counts` and `sigma` [electron] are NaN where a camera is not used;
    `spoilt` marks rows in which a camera was flagged. `star` numbers the stars from 0; `rotator` [deg] is NaN
    for results in the instrument frame, `time` [MJD, d] where it is not known.
    """

    points: FieldPoints
    counts: Float[np.ndarray, "n k"]
    sigma: Float[np.ndarray, "n k"]
    spoilt: Bool[np.ndarray, " n"]
    star: Int[np.ndarray, " n"]
    rotator: Float[np.ndarray, " n"]
    time: Float[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.star)

    def of_rows(self, keep: Bool[np.ndarray, " n"]) -> Catalogue:
        """Some of the rows; stars are numbered anew."""
        if keep.all():
            return self
        whole = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name != "points"}
        p = self.points
        points = FieldPoints(p.x[keep], p.y[keep], p.settings[np.flatnonzero(keep)], p.outside[keep])
        some = Catalogue(points=points, **{name: values[keep] for name, values in whole.items()})
        return dataclasses.replace(some, star=np.unique(some.star, return_inverse=True)[1].reshape(-1))


def read_catalogue(
    source: InputTable,
    instrument: InstrumentOfTables,
    saturation: float = np.inf,
    *,
    always_in: Collection[str] = (),
) -> Catalogue:
    """The catalogue in a table of an instrument; `always_in` as for `field_points`.

    Counts from `saturation` [electron] on, or below −5 σ, are not used.

    Raises `DataError` naming file, column and rows for anything that cannot be meant: errors that are not
    above 0, a ROTATOR that only some rows of a star have.
    """
    place = Place(source.path, "")
    points, cameras = field_points(source, instrument, always_in), len(instrument.cameras)
    rule = Column("float", "electron", width=cameras, shape_advice=f"one row holds all {cameras} cameras")
    counts, sigma = (vector_column(source, name, rule, instrument.cameras.names) for name in ("N", "N_ERR"))
    advice = "standard errors in electrons; NaN for a camera that is not to be used"
    place.refuse(np.isfinite(counts) & (sigma <= 0), "is not above 0", "N_ERR", advice)
    bad = _flagged(source, cameras, place) | (counts >= saturation) | (counts < -_NEGATIVE * sigma)
    rotator = numeric_column(source, "ROTATOR", EXPOSURES["ROTATOR"])
    star = _stars(source, points)
    on_sky = np.isfinite(rotator)
    most = np.zeros(star.max() + 1, bool)
    most[star[on_sky]] = True
    mixed = np.flatnonzero(most[star] & ~on_sky)
    if mixed.size:
        what = f"is missing in {rows_text(mixed)}, but other rows of the same ID have it"
        raise place.fail(what, "ROTATOR", "give it for all rows of a star, or for none")
    return Catalogue(
        points=points,
        counts=np.where(bad, np.nan, counts),
        sigma=np.where(bad, np.nan, sigma),
        spoilt=np.any(bad, axis=1),
        star=star,
        rotator=rotator,
        time=numeric_column(source, "MJD", EXPOSURES["MJD"]),
    )


def _flagged(source: InputTable, cameras: int, place: Place) -> Bool[np.ndarray, "n k"]:
    """Cameras that the catalogue itself says are not to be used."""
    if "N_FLAG" not in source.names:
        return np.zeros((source.rows, cameras), bool)
    column = source.table.columns[source.names.index("N_FLAG")]
    bits = np.ma.filled(np.ma.asarray(column), 0)
    if bits.dtype.kind not in "iub" or bits.shape[1:] not in ((), (cameras,)):
        what = f"is neither one integer in a row nor {cameras}"
        raise place.fail(what, "N_FLAG", "bits as in a calibration set")
    return np.broadcast_to(bits.reshape(source.rows, -1) != 0, (source.rows, cameras))


def _stars(source: InputTable, points: FieldPoints) -> Int[np.ndarray, " n"]:
    """Number of the star of every row: by ID and FILTER; a row without an ID is a star of its own."""
    rows = np.arange(source.rows)
    if "ID" not in source.names:
        return rows
    column = source.table.columns[source.names.index("ID")]
    masked = np.broadcast_to(np.asarray(getattr(column, "mask", False)), rows.shape)
    values = np.ma.getdata(np.ma.asarray(column))
    if values.dtype.kind not in "iu":
        values = np.char.strip(values.astype(str))
        masked = masked | (values == "") | (values == "nan")
    _, name = np.unique(values, return_inverse=True)
    _, band = np.unique(points.settings.filter, return_inverse=True)
    key = name.reshape(-1) * (band.max() + 1) + band.reshape(-1)
    alone = key.max() + 1 + rows
    return np.unique(np.where(masked, alone, key), return_inverse=True)[1].reshape(-1)
