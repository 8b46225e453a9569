"""Science catalogues: one row per star and exposure, an intensity of every camera (docs: files).

| column | unit | meaning |
| --- | --- | --- |
| X, Y | deg | field position in the instrument frame |
| N, N_ERR | electron | the cameras, in the order of the instrument, and their errors (or N0, N1, …, N0_ERR, …) |
| ID | | rows of one ID (and one FILTER) are one star; without it every row is one |
| TEFF | K | colour temperature of the star; NaN: flat photon spectrum |
| `<P>_IN`, `<P>_ANGLE` | deg | moving elements behind the polariser, such as CHWP_IN, CHWP_ANGLE |
| ROTATOR | deg | position angle of +X; where it is given the results are on the sky |
| N_FLAG | | bits of the cameras as FLAG of a calibration set, one number or one per camera; any bit: not used |
| FILTER, TEMP, HA | Celsius, h | as for field points |
| MJD | d | mid-exposure: what changes with time is looked for |
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection

import numpy as np
from jaxtyping import Bool, Float, Int

from walop_jax.data.field_points import FieldPoints, InstrumentOfTables, field_points
from walop_jax.data.schema import Column, Place
from walop_jax.data.user_tables import InputTable, numeric_column, vector_column
from walop_jax.io.errors import rows_text

_ROTATOR, _TIME = Column("float", "deg", float("nan")), Column("float", "d", float("nan"))
_NEGATIVE = 5.0  # sigma: what noise about a subtracted background may do, and no more


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
    counts, sigma = (vector_column(source, name, rule) for name in ("N", "N_ERR"))
    impossible = np.flatnonzero(np.any(np.isfinite(counts) & (sigma <= 0), axis=1))
    if impossible.size:
        what = f"is not above 0 in {rows_text(impossible)}"
        raise place.fail(
            what, "N_ERR", "standard errors in electrons; NaN for a camera that is not to be used"
        )
    bad = _flagged(source, cameras, place) | (counts >= saturation) | (counts < -_NEGATIVE * sigma)
    rotator = numeric_column(source, "ROTATOR", _ROTATOR)
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
        time=numeric_column(source, "MJD", _TIME),
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
