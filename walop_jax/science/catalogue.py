"""Tables that an instrument is asked about: field points, and catalogues of stars (docs: files).

Catalogues have one row per star and exposure, an intensity of every camera.
"""

from __future__ import annotations

import dataclasses
import os
import re
from collections.abc import Collection, Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from walop_jax.data.schema import EXPOSURES, MISSING, Column, check, finite, plain_column
from walop_jax.data.settings import TEMPERATURE, Settings
from walop_jax.data.table_intensities import equal_rows
from walop_jax.data.units import Place
from walop_jax.data.user_tables import (
    InputTable,
    empty_cells,
    numeric_column,
    read_input_table,
    vector_columns,
)
from walop_jax.io.errors import rows_text
from walop_jax.model.instrument import Instrument

_NEGATIVE = 5.0  # sigma: what noise about a subtracted background may do, and no more
_SINGLE = 1  # point: it may lie outside without a doubt about its unit
_WHOLE = 1e-4  # deg: angles in radians that are so close to whole degrees are not read as degrees
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
    source: InputTable,
    instrument: Instrument,
    always_in: Collection[str] = (),
    never_in: Collection[str] = (),
) -> FieldPoints:
    """The X, Y and optional settings of a table of field points of an instrument.

    A moving element has the columns `<P>_ANGLE` and `<P>_IN`; without the latter it is in the beam where it has an
    angle. Of column prefixes, those `always_in` must have an angle, and those `never_in`, in the beam in no exposure of
    the calibration, are in it only where `<P>_IN` says so. Single points outside the field are marked; if most of
    them lie outside, the unit must be wrong.

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
            what = (
                f"the angle of {prefix} is missing, which was in the beam in all exposures of the calibration"
            )
            advice = (
                f"give the column {name} (deg, NaN: out); for all points of walop-jax matrix --at {prefix}=0"
            )
            raise place.fail(what, name, advice)
        angle = numeric_column(source, name, EXPOSURES["CLP_ANGLE"])
        _doubt_radians(source, name, angle, place)
        inside, unstated = np.isfinite(angle), np.ones(source.rows, bool)
        if f"{prefix}_IN" in source.names:
            rule = EXPOSURES["CHWP_IN"]
            unstated = empty_cells(source, f"{prefix}_IN", rule)
            inside = np.where(unstated, inside, numeric_column(source, f"{prefix}_IN", rule))
        if prefix in never_in:
            what = f"has values, but no exposure of the calibration had {prefix} in the beam: was it, in"
            advice = f"add {prefix}_IN: F where it was out, T where it was in"
            place.refuse(inside & unstated, what, name, advice)
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


def _doubt_radians(source: InputTable, name: str, angle: Float[np.ndarray, " n"], place: Place) -> None:
    """Refuse angles without a unit that are whole degrees if they are radians; remark on others within ±2π."""
    column = source.column(name)
    if column is None or getattr(column, "unit", None):
        return
    turned = angle[np.isfinite(angle) & (angle != 0)]
    if not turned.size or np.abs(turned).max() > 6.2832 or np.all(turned == np.round(turned)):
        return
    degrees = np.rad2deg(turned)
    if np.all(np.abs(degrees - np.round(degrees)) < _WHOLE):
        what = (
            f"has no unit and is a whole number of degrees in radians ({turned[0]:.6g} = {degrees[0]:.0f}°)"
        )
        raise place.fail(what, name, "give degrees, or state the unit of the column")
    source.remarks.append(f"{name} has no unit and lies within ±2π: taken to be degrees; are these radians?")


def true_matrices(
    path: str | os.PathLike[str], instrument: Instrument
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
    `spoilt` marks rows in which a camera was flagged, `copy` those that repeat another row of their star to the last
    bit, which are not used, and `repeated` those that have the counts of another star or setting. `star` numbers the
    stars from 0; `sky` [electron] is what was subtracted (None: not stated); `rotator` [deg] is NaN for results in the
    instrument frame, `time` [MJD, d] where it is not known. `remarks` say what is odd in the table, and what of it is
    not used.
    """

    points: FieldPoints
    counts: Float[np.ndarray, "n k"]
    sigma: Float[np.ndarray, "n k"]
    spoilt: Bool[np.ndarray, " n"]
    copy: Bool[np.ndarray, " n"]
    repeated: Bool[np.ndarray, " n"]
    star: Int[np.ndarray, " n"]
    rotator: Float[np.ndarray, " n"]
    time: Float[np.ndarray, " n"]
    remarks: tuple[str, ...] = ()
    sky: Float[np.ndarray, "n k"] | None = None

    def __len__(self) -> int:
        return len(self.star)

    def of_rows(self, keep: Bool[np.ndarray, " n"]) -> Catalogue:
        """Some of the rows; stars are numbered anew."""
        if keep.all():
            return self
        whole = {
            f.name: getattr(self, f.name)
            for f in dataclasses.fields(self)
            if f.name not in ("points", "remarks") and getattr(self, f.name) is not None
        }
        p = self.points
        points = FieldPoints(p.x[keep], p.y[keep], p.settings[np.flatnonzero(keep)], p.outside[keep])
        some = Catalogue(points=points, **{name: values[keep] for name, values in whole.items()})
        return dataclasses.replace(some, star=np.unique(some.star, return_inverse=True)[1].reshape(-1))


def read_catalogue(
    source: InputTable,
    instrument: Instrument,
    saturation: float = np.inf,
    *,
    always_in: Collection[str] = (),
    never_in: Collection[str] = (),
) -> Catalogue:
    """The catalogue in a table of an instrument; `always_in` and `never_in` as for `field_points`.

    Counts from `saturation` [electron] on, or below −5 σ, are not used.

    Raises `DataError` naming file, column and rows for anything that cannot be meant: errors that are not
    above 0, a ROTATOR that only some rows of a star have.
    """
    place = Place(source.path, "")
    points, cameras = field_points(source, instrument, always_in, never_in), len(instrument.cameras)
    rule = Column("float", "electron", width=cameras, shape_advice=f"one row holds all {cameras} cameras")
    counts, sigma = vector_columns(source, ("N", "N_ERR"), rule, instrument.cameras.names)
    advice = "standard errors in electrons; NaN for a camera that is not to be used"
    place.refuse(np.isfinite(counts) & (sigma <= 0), "is not above 0", "N_ERR", advice)
    flagged = _flagged(source, instrument.cameras.names, place)
    bad = flagged | (counts >= saturation) | (counts < -_NEGATIVE * sigma)
    rotator, time = (numeric_column(source, name, EXPOSURES[name]) for name in ("ROTATOR", "MJD"))
    check({"ROTATOR": rotator, "MJD": time}, {name: EXPOSURES[name] for name in ("ROTATOR", "MJD")}, place)
    _doubt_radians(source, "ROTATOR", rotator, place)
    star = _stars(source, points, place)
    on_sky = np.isfinite(rotator)
    most = np.zeros(star.max() + 1, bool)
    most[star[on_sky]] = True
    mixed = np.flatnonzero(most[star] & ~on_sky)
    if mixed.size:
        what = f"is missing in {rows_text(mixed)}, but other rows of the same ID have it"
        raise place.fail(what, "ROTATOR", "give it for all rows of a star, or for none")
    if on_sky.any() and not on_sky.all():
        missing = rows_text(np.flatnonzero(~on_sky))
        source.remarks.append(f"ROTATOR is missing in {missing}: these are in the frame of the instrument")
    sky = None
    if {"SKY", "SKY0", "SKY_0"} & set(source.names):
        (sky,) = vector_columns(source, ("SKY",), rule, instrument.cameras.names)
        place.refuse(sky < 0, "is below 0", "SKY", "the level of the sky that was subtracted, in electrons")
    copy, repeated = _copies(source, points, counts, sigma, rotator, star)
    bad |= copy[:, None]
    return Catalogue(
        points=points,
        counts=np.where(bad, np.nan, counts),
        sigma=np.where(bad, np.nan, sigma),
        spoilt=np.any(bad, axis=1) & ~copy,
        copy=copy,
        repeated=repeated,
        star=star,
        rotator=rotator,
        time=time,
        remarks=source.about(),
        sky=sky,
    )


_OF_RESULTS = ({"QU_COV", "P_DEBIASED"}, {"M21_ERR", "M22_ERR", "P_ERR"})
"""Columns of `apply` and of `matrix`: where they are, FLAG is that of a star or of a point, not of cameras."""


def _flagged(source: InputTable, cameras: Sequence[str], place: Place) -> Bool[np.ndarray, "n k"]:
    """Cameras that the catalogue itself says are not to be used: N_FLAG, FLAG, or a column for each camera."""
    flagged = np.zeros((source.rows, len(cameras)), bool)
    earlier = any(names <= set(source.names) for names in _OF_RESULTS)
    for name in ("N_FLAG",) if earlier else ("N_FLAG", "FLAG"):
        if source.column(name) is not None:
            flagged |= _bits(source, name, len(cameras), place)
    for k, camera in enumerate(cameras):
        for name in (f"N{k}_FLAG", f"N_FLAG{k}", f"{camera.upper()}_FLAG"):
            if name in source.names:
                flagged[:, k] |= _bits(source, name, 1, place)[:, 0]
    return flagged


def _bits(source: InputTable, name: str, cameras: int, place: Place) -> Bool[np.ndarray, "n m"]:
    """True where a column of flags has any bit set, for all cameras or for each: whole numbers, truth values, texts."""
    values, missing, _ = plain_column(source.column(name), name, Column("int"), place)
    values, missing = values.reshape(source.rows, -1), missing.reshape(source.rows, -1)
    if values.dtype.kind in "OSU":
        texts, of = np.unique(np.char.strip(values.astype(str)), return_inverse=True)
        values = np.array([_bit(text.lower(), name, place) for text in texts])[of].reshape(values.shape)
    elif values.dtype.kind == "f":
        missing = missing | np.isnan(values)
    several = values.dtype.kind == "b" and values.shape[1] > 1 and values.shape[1] != cameras  # single bits
    whole = values.dtype.kind in "iubf" and np.all(missing | (values == np.round(values)))
    if not whole or (values.shape[1] not in (1, cameras) and not several):
        what = f"is neither one integer in a row nor {cameras}"
        raise place.fail(what, name, "bits as in a calibration set")
    flagged = (values != 0) & ~missing
    return flagged.any(axis=1, keepdims=True) if several else flagged


def _bit(text: str, name: str, place: Place) -> bool:
    if text in (*MISSING, "f", "false", "no"):
        return False
    digits = re.fullmatch(r"0x([0-9a-f]+)|0b([01]+)|(\d+)(?:\.0*)?", text)
    if digits is None and text not in ("t", "true", "yes"):
        what = f"{text!r} is neither a number nor true or false"
        raise place.fail(what, name, "write bits as in a calibration set")
    return digits is None or set("".join(filter(None, digits.groups()))) != {"0"}


_NO_ID = (*MISSING, "-1", "unknown")


def _stars(source: InputTable, points: FieldPoints, place: Place) -> Int[np.ndarray, " n"]:
    """Number of the star of every row: by ID and FILTER; a row without an ID is a star of its own.

    IDs that are missing, empty or negative are none.
    """
    rows = np.arange(source.rows)
    column = source.column("ID")
    if column is None:
        return rows
    values, missing, _ = plain_column(column, "ID", Column("str"), place)
    if values.ndim == 2 and values.shape[1] == 1:
        values, missing = values[:, 0], missing[:, 0]
    if values.ndim != 1:
        raise place.fail(f"has shape {values.shape[1:]} in a row, one value is needed", "ID", "split it")
    if values.dtype.kind == "f":
        largest = 2.0 ** (np.finfo(values.dtype).nmant + 1)
        missing = missing | np.isnan(values)
        what = f"is a float beyond 2**{np.finfo(values.dtype).nmant + 1}, where neighbouring numbers are one"
        advice = "write identifiers as integers or as text"
        place.refuse(~missing & (np.abs(values) >= largest), what, "ID", advice)
    if values.dtype.kind in "iuf":
        unknown = ~missing & ((values < 0) | (values == np.iinfo(np.uint64).max))
    else:
        values = np.char.strip(values.astype(str))
        missing = missing | (values == "")
        negative = np.char.startswith(values, "-") & np.char.isdigit(np.char.lstrip(values, "-"))
        unknown = ~missing & (negative | np.isin(np.char.lower(values), _NO_ID))
    if unknown.any():
        which = rows_text(np.flatnonzero(unknown))
        source.remarks.append(
            f"ID is {values[unknown][0]} in {which}: unknown, a star of its own in each row"
        )
    _, name = np.unique(values, return_inverse=True)
    _, band = np.unique(points.settings.filter, return_inverse=True)
    key = name.reshape(-1) * (band.max() + 1) + band.reshape(-1)
    alone = key.max() + 1 + rows
    return np.unique(np.where(missing | unknown, alone, key), return_inverse=True)[1].reshape(-1)


def _copies(
    source: InputTable,
    points: FieldPoints,
    counts: Float[np.ndarray, "n k"],
    sigma: Float[np.ndarray, "n k"],
    rotator: Float[np.ndarray, " n"],
    star: Int[np.ndarray, " n"],
) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Rows that repeat one of their star, and rows with the position and counts of another star or setting.

    Noise does not repeat to the digits of a float32 in two cameras or more: such rows are one measurement, that with
    most cameras is kept.
    """
    seen = np.isfinite(counts)
    measured = seen.any(axis=1)
    same = equal_rows([*counts.T, *sigma.T, points.x, points.y])
    for pattern in np.unique(seen[measured & ~seen.all(axis=1)], axis=0):
        cameras = np.flatnonzero(pattern)
        rows = np.flatnonzero(seen[:, cameras].all(axis=1)) if len(cameras) > 1 else cameras[:0]
        rows = rows[np.argsort(-seen[rows].sum(axis=1), kind="stable")]
        group = equal_rows(
            [*counts[rows][:, cameras].T, *sigma[rows][:, cameras].T, points.x[rows], points.y[rows]]
        )
        _, best = np.unique(group, return_index=True)
        same[rows] = same[rows[best[group]]]
    copy = repeated = np.zeros(len(star), bool)
    if np.bincount(same[measured], minlength=1).max() < 2:
        return copy, repeated
    settings = points.settings
    angles = [np.mod(angle, 360.0) for angle in (*settings.positions.values(), rotator)]
    _, band = np.unique(settings.filter, return_inverse=True)
    order = np.argsort(-seen.sum(axis=1), kind="stable")
    group = equal_rows([same, star, band.reshape(-1), *angles])
    first = order[np.unique(group[order], return_index=True)[1]]
    copy = measured & ~np.isin(np.arange(len(star)), first)
    repeated = measured & (np.bincount(same[measured & ~copy], minlength=len(star))[same] > 1)
    if copy.any():
        which = rows_text(np.flatnonzero(copy))
        source.remarks.append(f"{which}: copies of another row of the same star, left out")
    if repeated.any():
        which = rows_text(np.flatnonzero(repeated))
        what = "the same place and counts under another ID or setting: they are one measurement"
        source.remarks.append(f"{which}: {what}")
    return copy, repeated
