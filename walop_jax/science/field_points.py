"""Tables of field points that an instrument is asked about, with the optical settings there (docs: files)."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Collection, Mapping

import numpy as np
from jaxtyping import Bool, Float

from walop_jax.data.schema import EXPOSURES, TURN, Column, check, finite
from walop_jax.data.settings import TEMPERATURE, Settings, nearest_hours, same_filters
from walop_jax.data.units import Place
from walop_jax.data.user_tables import InputTable, empty_cells, numeric_column, read_input_table
from walop_jax.io.errors import rows_text
from walop_jax.model.dependence import needs
from walop_jax.model.instrument import Instrument

ANOTHER_PLACE = 0.005  # deg: positions that lie farther apart are two places of the field
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


SETTINGS = tuple(name for name in POINT_COLUMNS if name not in ("X", "Y"))

_ASSUMED = (
    ("TEMP", "temperature", f"{TEMPERATURE:g} Celsius"),
    ("HA", "hour_angle", "the meridian"),
)


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
    *,
    everywhere: bool = True,
    filters: Collection[str] = (),
) -> FieldPoints:
    """The X, Y and optional settings of a table of field points of an instrument.

    A moving element has the columns `<P>_ANGLE` and `<P>_IN`; without `<P>_IN` it is in the beam where it has an angle.
    `<P>_TURN` (absent: 0) is by how much it turns during the exposure, about that angle. Elements whose prefix is in
    `always_in` must have an angle; elements in `never_in`, which were in the beam in no exposure of the calibration,
    are in the beam only where `<P>_IN` says so. Single points outside the field are marked; if most points lie outside,
    the unit must be wrong. Points without a position are an error if a position is needed `everywhere`; otherwise they
    are marked as well, with a remark. `filters` are names that are known, in whose spelling FILTER is returned.

    Raises `DataError` naming file, column and row for anything that cannot be meant.
    """
    place = Place(source.path, "")
    columns = {name: numeric_column(source, name, rule) for name, rule in POINT_COLUMNS.items()}
    x, y = columns["X"], columns["Y"]
    lost = ~np.isfinite(x + y)
    if lost.any() and not (everywhere or lost.all()):
        where = rows_text(np.flatnonzero(lost))
        source.remarks.append(
            f"X or Y is not finite in {where}: these rows are left out (no result, FLAG 16384)"
        )
        x, y = (np.where(lost, 0.0, values) for values in (x, y))
    needed = POINT_COLUMNS if everywhere or lost.all() else {n: POINT_COLUMNS[n] for n in SETTINGS}
    check(columns, needed, place)
    columns["FILTER"] = _as_known(columns["FILTER"], filters, source)
    moving = instrument.moving()
    missing = [prefix for prefix in moving if prefix in always_in and f"{prefix}_ANGLE" not in source.names]
    if missing:
        options = " ".join(f"--at {prefix}=0" for prefix in missing)
        raise place.fail(
            f"the angle of {' and of '.join(missing)} is missing, in the beam in all exposures of the calibration",
            ", ".join(f"{prefix}_ANGLE" for prefix in missing),
            f"give the column (deg, NaN: out); the same for all points: walop-jax matrix {options}",
        )
    positions, turns = {}, {}
    for prefix in moving:
        name = f"{prefix}_ANGLE"
        angle = numeric_column(source, name, EXPOSURES["CLP_ANGLE"])
        doubt_radians(source, name, angle, place)
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
        if f"{prefix}_TURN" in source.names:
            turn = numeric_column(source, f"{prefix}_TURN", TURN)
            check({f"{prefix}_TURN": turn}, {f"{prefix}_TURN": TURN}, place)
            turns[prefix] = np.where(inside, np.abs(turn), 0.0)
    limit = instrument.field_limit
    outside = np.maximum(np.abs(x), np.abs(y)) > limit
    if len(x) > _SINGLE and np.mean(outside[~lost]) > 0.5:
        what = (
            f"most points lie outside ±{limit:g}° of {instrument.name}: {rows_text(np.flatnonzero(outside))}"
        )
        raise place.fail(what, "X, Y", _beyond(x[~lost], y[~lost], limit))
    for name, condition, assumed in _ASSUMED:
        if name not in source.names and condition in needs(instrument).conditions:
            what = f"is missing, and the optics of this calibration depend on it: {assumed} is assumed"
            source.remarks.append(f"{name} {what}; add the column")
    columns["HA"] = nearest_hours(columns["HA"])
    stated = (columns[name] for name in ("FILTER", "TEFF", "TEMP", "HA"))
    return FieldPoints(x, y, Settings(*stated, positions=positions, turns=turns), outside | lost)


def _as_known(names: np.ndarray, known: Collection[str], source: InputTable) -> np.ndarray:
    """Names of filters in the spelling that is known, where there is one that differs in case, blanks, dashes alone."""
    for name in np.unique(names).tolist():
        same = same_filters(name, known)
        if len(same) == 1 and same[0] != name:
            names = np.where(
                names == name, same[0], names.astype(f"U{max(names.dtype.itemsize // 4, len(same[0]))}")
            )
            source.remarks.append(f"FILTER {name!r} is taken as {same[0]!r}")
    return names


def doubt_radians(source: InputTable, name: str, angle: Float[np.ndarray, " n"], place: Place) -> None:
    """Refuse angles without a unit that are whole degrees if they are radians; remark on others within ±2π."""
    column = source.column(name)
    if column is None or getattr(column, "unit", None):
        return
    turned = angle[np.isfinite(angle) & (angle != 0)]
    if not turned.size or np.abs(turned).max() > 6.2832 or np.all(turned == np.round(turned)):
        return
    degrees = np.rad2deg(turned)
    if np.all(np.abs(degrees - np.round(degrees)) < _WHOLE):
        number = f"{turned[0]:.6g} = {degrees[0]:.0f}°"
        what = f"has no unit and is a whole number of degrees in radians ({number})"
        raise place.fail(what, name, "give degrees, or state the unit of the column")
    source.remarks.append(f"{name} has no unit and lies within ±2π: taken to be degrees; are these radians?")


def true_matrices(
    path: str | os.PathLike[str], instrument: Instrument
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, "n m"]]:
    """X, Y (deg) and M21, M22, … of a table of true matrices, three for each arm; `DataError` if not finite."""
    source = read_input_table(path)
    points = field_points(source, instrument)
    names = [f"M{arm + 2}{column}" for arm in range(len(instrument.cameras.pairs)) for column in (1, 2, 3)]
    matrix = np.stack([numeric_column(source, name, Column("float")) for name in names], axis=1)
    names = f"{names[0]} … {names[-1]}"
    Place(path, "").refuse(~np.isfinite(matrix), "not finite", names, "remove these rows")
    return points.x, points.y, matrix


def _beyond(x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"], limit: float) -> str:
    """What positions (deg) may be of which most lie beyond ±`limit`."""
    middle = [0.5 * float(values.min() + values.max()) for values in (x, y)]
    inside = max(float(np.ptp(x)), float(np.ptp(y))) <= 2.0 * limit
    if inside:
        where = f"X smaller by {middle[0]:.3g}° and Y by {middle[1]:.3g}°"
        return f"with {where} all would lie inside: is their zero the corner of the frame? It is the field centre"
    return "field coordinates are in degrees: are these arcmin or pixels?"
