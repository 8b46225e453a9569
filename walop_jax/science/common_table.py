"""The common table of stellar polarisation: written from the output of `apply`, and checked.

Panopoulou et al. 2025 (ApJS 276, 15) ask that catalogues of stellar polarisation share one tabular format. The names of
columns that their compilation has at CDS (J/ApJS/276/15: Name, RAJ2000, DEJ2000, Gmag, Pol, e_Pol, PA, e_PA) are taken
as they are there, p as a fraction; columns of a calibrated survey beyond them (q, u with covariances, the part of the
calibration, Galactic values) has names of the same kind. Every column has a unit (or is a pure number), a UCD and a
description.

    Galactic    (q + iu)_gal = (q + iu) exp(−2iψ),    PA_gal = PA − ψ,    C_gal = R C Rᵀ
                ψ position angle of Galactic north at the star, R the rotation of (q, u) by −2ψ
"""

from __future__ import annotations

import csv
import functools
import io
import os
from collections.abc import Mapping
from importlib.resources import files
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from walop_jax.data.schema import Column
from walop_jax.data.user_tables import InputTable, in_memory, numeric_column, read_input_table, sky_positions
from walop_jax.io.errors import fail
from walop_jax.io.plain_tables import astropy_table, faults_of_ucds
from walop_jax.io.shapes import Vector
from walop_jax.sky.directions import designations, galactic
from walop_jax.sky.position_angles import sky_to_instrument

Pairs = Float[np.ndarray, "n 2"]
Covariances = Float[np.ndarray, "n 2 2"]

REFERENCE = "Panopoulou et al. 2025, ApJS 276, 15"
MJD_ZERO = 2400000.5
_SAME = 1e-6  # of fractions that are computed in two ways
_SAME_ANGLE = 1e-3  # deg, likewise


class CommonColumn(NamedTuple):
    """A column of the common table; `of` is the column of `apply` that it is, "" where it is made of others."""

    unit: str
    ucd: str
    about: str
    of: str = ""
    needed: bool = True


@functools.cache
def columns() -> Mapping[str, CommonColumn]:
    """The columns by name, in their order (`common_table.csv`)."""
    text = (files("walop_jax.science") / "common_table.csv").read_text("utf-8")
    _, *rows = csv.reader(io.StringIO(text))
    return {name: CommonColumn(*words, needed=bool(needed)) for name, *words, needed in rows}


_WHOLE = ("dof", "Nobs", "Flag")


def to_galactic(qu: Pairs, covariance: Covariances, north: Vector) -> tuple[Pairs, Covariances]:
    """(q, u) and covariance from Galactic north, which has the position angle `north` (deg) at each star."""
    turn = np.stack(sky_to_instrument(np.array([1.0, 0.0]), np.array([0.0, 1.0]), north[:, None]), axis=1)
    return np.einsum("nij,nj->ni", turn, qu), turn @ covariance @ turn.swapaxes(1, 2)


def common_table(source: InputTable) -> tuple[Any, tuple[str, ...]]:
    """The common table of the output of `apply`, an astropy table with one row a star, and remarks.

    Stars without a result, and those in the frame of the instrument, are left out, with a remark.
    Raises `DataError` where RA, DEC or a column of `apply` is missing.
    """
    present = source.names
    of_sky = "give RA and DEC of the stars to apply (walop-jax gather does)"
    for name, advice in (("RA", of_sky), ("DEC", of_sky), ("QU_PHOTON", "it comes from walop-jax apply")):
        if name not in present:
            raise fail("the column is missing", file=source.path, column=name, advice=advice)

    units = {entry.of: entry.unit for entry in columns().values()} | {"ROTATOR": "deg", "MJD": "d"}

    def number(name: str) -> np.ndarray:
        return numeric_column(source, name, Column("float", units.get(name, ""), missing=np.nan))

    names = ("Q", "U", "Q_ERR", "U_ERR", "QU_COV", "Q_PHOTON", "U_PHOTON", "QU_PHOTON")
    values = {name: number(name) for name in names}
    rotator = number("ROTATOR")
    every_ra, every_dec = sky_positions(source)
    good = np.isfinite(values["Q"]) & np.isfinite(values["U"])
    placed = np.isfinite(every_ra) & np.isfinite(every_dec)
    sky = np.isfinite(rotator)
    key = np.stack([*values.values(), number("CHI2"), number("NROWS")], axis=1)
    first = np.unique(key, axis=0, return_index=True)[1]
    keep = np.sort(first[(good & sky & placed)[first]])
    remarks = []
    if not keep.size:
        what, advice = "has no star with a result on the sky", "give ROTATOR, RA and DEC to apply"
        raise fail(what, file=source.path, advice=advice)
    if lost := int(np.sum(~good)):
        remarks.append(f"{lost} rows without a result are left out")
    if unplaced := int(np.sum(good & ~placed)):
        remarks.append(f"{unplaced} rows without RA and DEC are left out")
    if inside := int(np.sum(good & ~sky)):
        remarks.append(f"{inside} rows in the frame of the instrument (no ROTATOR) are left out")
    ra, dec = np.mod(every_ra[keep], 360.0), every_dec[keep]
    remarks += _about_north(ra, dec, rotator[keep])
    rows = {name: column[keep] for name, column in values.items()}
    qu = np.stack([rows["Q"], rows["U"]], axis=1)
    covariance = _covariance(rows["Q_ERR"], rows["U_ERR"], rows["QU_COV"])
    systematic = covariance - _covariance(rows["Q_PHOTON"], rows["U_PHOTON"], rows["QU_PHOTON"])
    longitude, latitude, north = galactic(ra, dec)
    qu_gal, covariance_gal = to_galactic(qu, covariance, north)
    cells: dict[str, np.ndarray] = {
        "Name": designations(ra, dec), "GLON": longitude, "GLAT": latitude,
        "Inst": np.full(len(keep), str(source.table.meta.get("INSTRUME", "WALOP"))),
        "RAJ2000": ra, "DEJ2000": dec, "PA_gal": np.mod(number("EVPA")[keep] - north, 180.0),
    }  # fmt: skip
    if "MJD" in present and np.isfinite(number("MJD")[keep]).any():
        cells["JD"] = number("MJD")[keep] + MJD_ZERO
    for end, matrix in (("", covariance), ("_sys", systematic), ("_gal", covariance_gal)):
        cells[f"e_q{end}"], cells[f"e_u{end}"] = np.sqrt(np.maximum(np.einsum("nii->in", matrix), 0.0))
        cells[f"cov_qu{end}"] = matrix[:, 0, 1]
    for end, pair in (("", qu), ("_gal", qu_gal)):
        cells[f"q{end}"], cells[f"u{end}"] = pair.T
    for name, entry in columns().items():
        if name == "Filter":
            cells[name] = numeric_column(source, entry.of, Column("str", missing="SDSS-r"))[keep]
        elif name == "GaiaID" and entry.of in present:
            identity = np.ma.asarray(source.table.columns[present.index(entry.of)])[keep]
            cells[name] = np.ma.filled(identity, -1 if identity.dtype.kind in "iu" else "")
        elif entry.of in present and name not in cells:
            column = number(entry.of)[keep]
            cells[name] = column.astype(np.int64) if name in _WHOLE else column
    made = {name: entry for name, entry in columns().items() if name in cells}
    described = {name: (cells[name], entry.unit, entry.about) for name, entry in made.items()}
    carried = ("CALHASH", "PESTIM", "HOLDS", "TRUSTED", "ERRFROM")
    meta = {key: source.table.meta[key] for key in carried if key in source.table.meta}
    cards = {"POLCCONV": "IAU", "TIMESYS": "UTC", "RADESYS": "ICRS", "REFERENC": REFERENCE}
    table = astropy_table(described, {**cards, **meta})
    for name, column in table.columns.items():
        column.meta["ucd"] = columns()[name].ucd
    return table, tuple(remarks)


def _covariance(q: Vector, u: Vector, both: Vector) -> Covariances:
    return np.moveaxis(np.array([[q**2, both], [both, u**2]]), 2, 0)


def _about_north(ra: Vector, dec: Vector, rotator: Vector) -> list[str]:
    """A sentence where one ROTATOR for all stars leaves meridian convergence, RA times sin DEC, in their angles."""
    away = np.mod(ra - ra[0] + 180.0, 360.0) - 180.0
    off = float(np.ptp(away)) * float(np.abs(np.sin(np.deg2rad(dec))).max()) / 2.0
    if len(ra) < 2 or np.ptp(rotator) > 0.0 or off < 0.05:
        return []
    what = f"their angles refer to north at the field centre, up to {off:.2g} deg from their own"
    return [f"ROTATOR is the same for all stars: {what}; give that at each star (walop-jax gather does)"]


def in_common_form(made: Any) -> tuple[Any, tuple[str, ...]]:
    """The common table of an astropy table that `apply` made, and remarks: its faults, if any, among them."""
    table, remarks = common_table(in_memory(made, "the result"))
    return table, (*remarks, *check_common_table(table))


def check_common_table(table: Any) -> tuple[str, ...]:
    """Faults of a common table of stellar polarisation, in sentences; none: it is one.

    `table` is an astropy table or a path. Asked are columns, units, UCDs and descriptions, and whether the numbers
    agree with each other: Pol and PA with q and u (IAU, not COSMO), Galactic with equatorial values, errors with
    covariances.

    >>> walop.check_common_table("stars.vot")  # doctest: +SKIP
    ()
    """
    if isinstance(table, str | os.PathLike):
        table = read_input_table(table, ("Pol",)).table
    missing = (n for n, entry in columns().items() if entry.needed and n not in table.colnames)
    faults = [f"{name}: the column is missing" for name in missing]
    for name in table.colnames:
        column, entry = table[name], columns().get(name)
        if not column.description:
            faults.append(f"{name}: has no description")
        if entry is not None and str(column.unit or "") != entry.unit:
            faults.append(f"{name}: the unit is {column.unit or 'none'}, not {entry.unit or 'none'}")
        if entry is not None and column.meta.get("ucd", entry.ucd) != entry.ucd:
            faults.append(f"{name}: the UCD is {column.meta['ucd']}, not {entry.ucd}")
    faults += faults_of_ucds({name: table[name].meta.get("ucd", "") for name in table.colnames})
    for card, value in (("POLCCONV", "IAU"), ("TIMESYS", "UTC")):
        if str(table.meta.get(card, value)) != value:
            faults.append(f"{card} is {table.meta[card]}, not {value}: is the sign of u that of the IAU?")
    return tuple(faults) if faults else _wrong_numbers(table)


def _wrong_numbers(table: Any) -> tuple[str, ...]:
    """Sentences on rows whose numbers contradict each other."""
    numbers = [n for n in columns() if n in table.colnames and n not in ("Name", "Filter", "Inst", "GaiaID")]
    c = {name: np.ma.filled(np.ma.asarray(table[name], float), np.nan) for name in numbers}
    qu, p = np.stack([c["q"], c["u"]], axis=1), np.hypot(c["q"], c["u"])
    ra, dec = c["RAJ2000"], c["DEJ2000"]
    longitude, latitude, north = galactic(ra, np.clip(dec, -90.0, 90.0))
    turned, _ = to_galactic(qu, np.zeros((len(qu), 2, 2)), north)
    polarised, margin = p > _SAME, 1.0 + _SAME
    wrong = {
        "RAJ2000, DEJ2000: no direction": ~(np.maximum(np.abs(ra) / 4.0, np.abs(dec)) <= 90.0),
        "q, u: not finite": ~np.isfinite(p),
        "q, u: polarised by more than 1: in per cent?": p > 1.0 + 5.0 * np.hypot(c["e_q"], c["e_u"]),
        "e_q, e_u: not above 0": ~((c["e_q"] > 0) & (c["e_u"] > 0)),
        "cov_qu: larger than e_q e_u": np.abs(c["cov_qu"]) > margin * c["e_q"] * c["e_u"],
        "e_q_sys, e_u_sys: larger than e_q, e_u": (c["e_q_sys"] > margin * c["e_q"])
        | (c["e_u_sys"] > margin * c["e_u"]),
        "Pol: not the length of (q, u): in per cent, or debiased?": np.abs(c["Pol"] - p) > _SAME,
        "PA: not half the angle of (q, u): is the sign of u that of the IAU?": polarised
        & (_apart(c["PA"], np.rad2deg(0.5 * np.arctan2(c["u"], c["q"]))) > _SAME_ANGLE),
        "PA_gal: not PA from Galactic north": polarised
        & (_apart(c["PA_gal"], c["PA"] - north) > _SAME_ANGLE),
        "q_gal, u_gal: not q, u from Galactic north": np.abs(c["q_gal"] - turned[:, 0])
        + np.abs(c["u_gal"] - turned[:, 1])
        > _SAME,
        "GLON, GLAT: not those of RAJ2000, DEJ2000": _apart(c["GLON"], longitude, 360.0)
        + np.abs(c["GLAT"] - latitude)
        > _SAME_ANGLE,
    }
    there = ((what, int(rows.sum()), int(np.argmax(rows))) for what, rows in wrong.items() if rows.any())
    return tuple(f"{what} ({count} rows, the first {first}, counted from 0)" for what, count, first in there)


def _apart(one: np.ndarray, other: np.ndarray, turn: float = 180.0) -> np.ndarray:
    """Difference of angles (deg), that of whole turns apart."""
    return np.abs(np.mod(one - other + turn / 2.0, turn) - turn / 2.0)
