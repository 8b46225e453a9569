"""Catalogues of stars: a row for each star and exposure, an intensity of every camera (docs: files)."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Int

from walop_jax.data import plausible, user_tables
from walop_jax.data.repeats import equal_rows
from walop_jax.data.schema import EXPOSURES, MISSING, Column, check, plain_column
from walop_jax.data.units import Place
from walop_jax.data.user_tables import InputTable
from walop_jax.io.errors import rows_text
from walop_jax.io.shapes import CountsOfRows, Vector
from walop_jax.model.instrument import Instrument
from walop_jax.science.catalogue_doubts import (
    ceilings,
    errors_of_cameras,
    field_against_sky,
    many_are_full,
    not_measured,
    stars_of_one_name,
    units_of_counts,
)
from walop_jax.science.colours import LIMITS, SOURCE, temperature_of
from walop_jax.science.field_points import ANOTHER_PLACE, FieldPoints, doubt_radians, field_points
from walop_jax.sky.directions import same_stars

RowNumbers = Int[np.ndarray, " n"]
ChosenRows = Bool[np.ndarray, " n"]
_NEGATIVE = 5.0  # sigma: what noise about a subtracted background may do, and no more
SAME_PLACE = 1.0  # arcsec


@dataclasses.dataclass(frozen=True)
class Catalogue:
    """The rows of a science catalogue.

    `points` are positions and settings, `teff_err` the errors of the colour temperatures [K] (0: none); `counts` and
    `sigma` [electron] are NaN where a camera is not used; `spoilt` marks rows in which a camera was flagged; `copy`
    marks rows that repeat another row of their star to the last bit, which are not used, and `repeated` rows with the
    counts of another star or setting. `star` numbers the stars from 0; `sky` [electron] is the level that was
    subtracted (None: not stated); `rotator` [deg] is NaN for results in the instrument frame, `time` [MJD, d] NaN where
    it is not known. `remarks` name oddities of the table, and unused columns; `doubts` concern the whole catalogue,
    whose results are then not to be trusted.
    """

    points: FieldPoints
    teff_err: Vector
    counts: CountsOfRows
    sigma: CountsOfRows
    spoilt: ChosenRows
    copy: ChosenRows
    repeated: ChosenRows
    star: RowNumbers
    rotator: Vector
    time: Vector
    remarks: tuple[str, ...] = ()
    sky: CountsOfRows | None = None
    doubts: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.star)

    def of_rows(self, keep: ChosenRows) -> Catalogue:
        """Some of the rows; stars are numbered anew."""
        if keep.all():
            return self
        columns: dict[str, Any] = {n: v[keep] for n, v in vars(self).items() if isinstance(v, np.ndarray)}
        p = self.points
        points = FieldPoints(p.x[keep], p.y[keep], p.settings[np.flatnonzero(keep)], p.outside[keep])
        subset = Catalogue(points=points, **columns)
        return dataclasses.replace(subset, star=np.unique(subset.star, return_inverse=True)[1].reshape(-1))


def read_catalogue(
    source: InputTable,
    instrument: Instrument,
    saturation: float = np.inf,
    *,
    always_in: Collection[str] = (),
    never_in: Collection[str] = (),
    filters: Collection[str] = (),
) -> Catalogue:
    """The catalogue in a table of an instrument; `always_in`, `never_in` and `filters` as for `field_points`.

    Counts from `saturation` [electron] on, or below −5 σ, are not used.

    Raises `DataError` naming file, column and rows for anything that cannot be meant: errors that are not
    above 0, a ROTATOR that only some rows of a star have.
    """
    place = Place(source.path, "")
    points = field_points(source, instrument, always_in, never_in, everywhere=False, filters=filters)
    cameras = len(instrument.cameras)
    rule = Column("float", "electron", width=cameras, shape_advice=f"one row holds all {cameras} cameras")
    counts, sigma = user_tables.vector_columns(source, ("N", "N_ERR"), rule, instrument.cameras.names)
    points, teff_err = _with_colours(source, points, place)
    absent = not_measured(counts, sigma)
    if absent.any():
        which = rows_text(np.flatnonzero(absent.any(axis=1)))
        what = f"N and N_ERR are {counts[absent][0]:g} in {which}: taken as not measured"
        source.remarks.append(what)
        counts, sigma = (np.where(absent, np.nan, values) for values in (counts, sigma))
    advice = "standard errors in electrons; NaN for a camera that is not to be used"
    place.refuse(np.isfinite(counts) & (sigma <= 0), "is not above 0", "N_ERR", advice)
    flagged = _flagged(source, instrument.cameras.names, place)
    bad = flagged | (counts >= saturation) | (counts < -_NEGATIVE * sigma)
    rotator, time = (user_tables.numeric_column(source, name, EXPOSURES[name]) for name in ("ROTATOR", "MJD"))
    check({"ROTATOR": rotator, "MJD": time}, {name: EXPOSURES[name] for name in ("ROTATOR", "MJD")}, place)
    doubt_radians(source, "ROTATOR", rotator, place)
    star = _stars(source, points, place)
    on_sky = np.isfinite(rotator)
    has_rotator = np.zeros(star.max() + 1, bool)
    has_rotator[star[on_sky]] = True
    mixed = np.flatnonzero(has_rotator[star] & ~on_sky)
    if mixed.size:
        what = f"is missing in {rows_text(mixed)}, but other rows of the same ID have it"
        raise place.fail(what, "ROTATOR", "give it for all rows of a star, or for none")
    if on_sky.any() and not on_sky.all():
        missing = rows_text(np.flatnonzero(~on_sky))
        source.remarks.append(f"ROTATOR is missing in {missing}: these are in the frame of the instrument")
    sky = None
    if any(
        {*form} & {*source.names} for form in user_tables.spellings("SKY", cameras, instrument.cameras.names)
    ):
        (sky,) = user_tables.vector_columns(source, ("SKY",), rule, instrument.cameras.names)
        place.refuse(sky < 0, "is below 0", "SKY", "the level of the sky that was subtracted, in electrons")
    stated = str(source.table.meta.get("INSTRUME", instrument.name))
    doubts = list(field_against_sky(source, points.x, points.y, rotator))
    if stated.upper() != instrument.name.upper():
        doubts.insert(0, f"INSTRUME of the table is {stated}, the calibration is of {instrument.name}")
    doubts += units_of_counts(np.where(bad, np.nan, counts), sigma)
    doubts += stars_of_one_name(star, points.x, points.y, time)
    names = instrument.cameras.names
    columns, unflagged = {"MJD": time, "TEMP": points.settings.temperature}, np.asarray(~bad.any(axis=1))
    full = [f"{column} {what}" for column, what in ceilings(counts, unflagged, names)]
    (doubts if many_are_full(counts) else source.remarks).extend(full)
    odd = [
        *plausible.of_columns(columns, plausible.today()),
        *plausible.of_angles("ROTATOR", rotator, radians=False),
        *plausible.of_wraps(counts, sigma, cameras=names),
    ]
    source.remarks.extend(f"{column} {what}" for column, what in odd)
    source.remarks.extend(errors_of_cameras(counts, sigma, names))
    copy, repeated = _copies(source, instrument, points, counts, sigma, rotator, star)
    bad |= copy[:, None]
    return Catalogue(
        points=points,
        teff_err=teff_err,
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
        doubts=tuple(doubts),
    )


CARRIED = ("RA", "DEC", "BLENDED", "ID_FLAG", *user_tables.OF_STARS)
"""Columns that are about the stars, and go through as they are."""


def _with_colours(source: InputTable, points: FieldPoints, place: Place) -> tuple[FieldPoints, Vector]:
    """Field points with the temperatures that BP_RP gives where there is no TEFF, and the errors of all of them (K)."""
    source.used.update(set(CARRIED) & set(source.names))
    source.lacking.update({"SOURCE_ID"} - set(source.names))
    teff, error = points.settings.teff, np.nan_to_num(user_tables.column_of_stars(source, "TEFF_ERR"))
    place.refuse(error < 0, "is below 0", "TEFF_ERR", "standard errors in K")
    error = np.where(np.isnan(teff), 0.0, error)
    colour = np.where(np.isnan(teff), user_tables.column_of_stars(source, "BP_RP"), np.nan)
    from_colour = np.isfinite(colour)
    if not from_colour.any():
        return points, error
    temperature, off = temperature_of(colour, user_tables.column_of_stars(source, "BP_RP_ERR"))
    within = np.isfinite(temperature)
    source.remarks.append(f"TEFF of {int(within.sum())} rows is made of BP_RP ({SOURCE})")
    if beyond := int(np.sum(from_colour & ~within)):
        limits = f"{LIMITS[0]:g} … {LIMITS[1]:g} mag"
        what = "their errors are those of unknown colours"
        source.remarks.append(f"BP_RP of {beyond} rows lies beyond {limits}: {what}")
    settings = dataclasses.replace(points.settings, teff=np.where(within, temperature, teff))
    return dataclasses.replace(points, settings=settings), np.where(within, off, error)


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
    integers = values.dtype.kind in "iubf" and np.all(missing | (values == np.round(values)))
    if not integers or (values.shape[1] not in (1, cameras) and not several):
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


def _stars(source: InputTable, points: FieldPoints, place: Place) -> RowNumbers:
    """Number of the star of every row: by FILTER, and ID, SOURCE_ID or position; a row without is a star of its own."""
    rows = np.arange(source.rows)
    named = next((name for name in ("ID", "SOURCE_ID") if name in source.names), "ID")
    column = source.column(named)
    if column is None:
        return _by_position(source, points) if {"RA", "DEC"} <= set(source.names) else rows
    values, missing, _ = plain_column(column, named, Column("str"), place)
    if values.ndim == 2 and values.shape[1] == 1:
        values, missing = values[:, 0], missing[:, 0]
    if values.ndim != 1:
        raise place.fail(f"has shape {values.shape[1:]} in a row, one value is needed", "ID", "split it")
    if values.dtype.kind == "f":
        missing = missing | np.isnan(values)
        user_tables.refuse_rounded(values, missing, named, place)
    if values.dtype.kind in "iuf":
        unknown = ~missing & ((values < 0) | (values == np.iinfo(np.uint64).max))
    else:
        values = np.char.strip(values.astype(str))
        missing = missing | (values == "")
        negative = np.char.startswith(values, "-") & np.char.isdigit(np.char.lstrip(values, "-"))
        unknown = ~missing & (negative | np.isin(np.char.lower(values), _NO_ID))
    if unknown.any():
        which = rows_text(np.flatnonzero(unknown))
        what = "unknown, a star of its own in each row"
        source.remarks.append(f"{named} is {values[unknown][0]} in {which}: {what}")
    name = np.unique(values, return_inverse=True)[1].reshape(-1)
    return _numbered(name, missing | unknown, points)


def _numbered(name: RowNumbers, alone: ChosenRows, points: FieldPoints) -> RowNumbers:
    """Numbers of stars by their name and filter; rows that are `alone` have each a number of their own."""
    band = np.unique(points.settings.filter, return_inverse=True)[1].reshape(-1)
    key = name * (band.max() + 1) + band
    single = key.max() + 1 + np.arange(len(key))
    return np.unique(np.where(alone, single, key), return_inverse=True)[1].reshape(-1)


def _by_position(source: InputTable, points: FieldPoints) -> RowNumbers:
    """Numbers of stars by RA and DEC: rows within `SAME_PLACE` that are not of one exposure are one star."""
    ra, dec = user_tables.sky_positions(source)
    time = user_tables.numeric_column(source, "MJD", Column("float", "d", missing=np.nan))
    located = np.isfinite(ra) & np.isfinite(dec)
    name = np.zeros(len(ra), int)
    name[located] = same_stars(ra[located], dec[located], SAME_PLACE)
    # Two stars of one exposure are two stars, however close: by time, or by the place in the field where it is unknown.
    cell = np.round(np.stack([points.x, points.y], axis=1) / ANOTHER_PLACE)
    dated = np.stack([time, np.full(len(time), np.inf)], axis=1)
    exposure = np.where(np.isfinite(time)[:, None], dated, cell)
    key = np.column_stack([name, exposure])
    _, of, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    crowded = np.zeros(name.max() + 1, bool)
    crowded[name[count[of.reshape(-1)] > 1]] = True
    alone = ~located | crowded[name]
    star = _numbered(name, alone, points)
    if (several := len(star) - star.max() - 1) > 0:
        source.remarks.append(
            f"{several} rows are further rows of stars at the same RA and DEC (within {SAME_PLACE:g} arcsec): combined"
        )
    return star


def _copies(
    source: InputTable,
    instrument: Instrument,
    points: FieldPoints,
    counts: CountsOfRows,
    sigma: CountsOfRows,
    rotator: Vector,
    star: RowNumbers,
) -> tuple[ChosenRows, ChosenRows]:
    """Rows that repeat one of their star, and rows with the position and counts of another star or setting.

    Noise does not repeat to the digits of a float32 in two cameras or more: such rows are one measurement, that with
    most cameras is kept.
    """
    counted = np.isfinite(counts)
    measured = counted.any(axis=1)
    same = equal_rows([*counts.T, *sigma.T, points.x, points.y])
    for pattern in np.unique(counted[measured & ~counted.all(axis=1)], axis=0):
        cameras = np.flatnonzero(pattern)
        rows = np.flatnonzero(counted[:, cameras].all(axis=1)) if len(cameras) > 1 else cameras[:0]
        rows = rows[np.argsort(-counted[rows].sum(axis=1), kind="stable")]
        numbers = [*counts[rows][:, cameras].T, *sigma[rows][:, cameras].T]
        group = equal_rows([*numbers, points.x[rows], points.y[rows]])
        _, best = np.unique(group, return_index=True)
        same[rows] = same[rows[best[group]]]
    copy = repeated = np.zeros(len(star), bool)
    if np.bincount(same[measured], minlength=1).max() < 2:
        return copy, repeated
    settings = points.settings
    places = [instrument.within_period(prefix, at) for prefix, at in settings.positions.items()]
    _, band = np.unique(settings.filter, return_inverse=True)
    order = np.argsort(-counted.sum(axis=1), kind="stable")
    group = equal_rows([same, star, band.reshape(-1), *places, np.mod(rotator, 360.0)])
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
