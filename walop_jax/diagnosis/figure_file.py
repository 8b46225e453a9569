"""What the figures of a diagnosis are drawn from, `diagnosis.fits` (DIAGVERS = 1): small arrays, no data set.

    LADDER       MODEL, CHI2, DOF: the starting model and every model after it, a row for each
    SHARES       GROUP (camera, kind, filter or exposure), MEMBER, EXPECTED, BEFORE, AFTER: sums of squared
                 residuals of the starting and the final model, and what noise alone gives
    COMPARISONS  COMPARISON, EFFECT, COMBINATION, HARMONIC: row 0 compares the starting with the final model
                 (no EFFECT), the others a model without and with one effect. COMBINATION says in words which
                 combination of the exposures shows the difference best; HARMONIC is that of the polariser
                 angle, -1 where the combination is none
    FIELD        COMPARISON, POINT, X, Y (deg); BEFORE, AFTER: the residuals in that combination;
                 EXPLAINED: their difference, what the effect makes once all other parameters have followed;
                 MEAN_BEFORE, MEAN_AFTER, RMS_BEFORE, RMS_AFTER: over all exposures of the point
    CURVES       COMPARISON, EXPOSURE, KIND, MJD (d), CLP_ANGLE (deg; NaN: out); BEFORE, AFTER, EXPLAINED:
                 mean over the field, with the field pattern of EXPLAINED in that camera as weight (rms 1);
                 ERROR: standard error of BEFORE and AFTER, from the scatter over the field

Columns of FIELD and CURVES without a unit are (data - model) in standard deviations of one intensity as N_ERR
gives them, one value for each camera, in the order of SHARES. NaN where there are no data. Values of FIELD in a
combination, BEFORE and AFTER, have standard deviation 1 (where the flux is free √(1 − 1/K) with K cameras, 0.87 of
four) if there is noise alone.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from typing import Any

import numpy as np
from astropy.io import fits
from jaxtyping import Float, Int, Shaped

from walop_jax.data.records import Points
from walop_jax.data.schema import Column, Place, read_table
from walop_jax.data.write import sign_and_write, table_hdu
from walop_jax.io.atomic import atomic_path
from walop_jax.io.errors import DataError, fail
from walop_jax.io.fits_reading import UNREADABLE, one_line, open_fits
from walop_jax.io.text import in_ascii

FIGURE_DATA = "diagnosis.fits"
DIAGVERS = 1
"""Version of the file format that is written, and the newest that is read."""

Names = Shaped[np.ndarray, " _"]
Vector = Float[np.ndarray, " _"]
PointMap = Float[np.ndarray, "p k"]
Curve = Float[np.ndarray, "e k"]

_SIGMA = "(data - model) in standard deviations, a value for each camera"
_CAMERAS = Column("float", width=None)
_TABLES: Mapping[str, Mapping[str, tuple[Column, str]]] = {
    "LADDER": {
        "MODEL": (Column("str"), "the starting model, or what was added to it"),
        "CHI2": (Column("float"), "chi squared of data and priors"),
        "DOF": (Column("int"), "degrees of freedom"),
    },
    "SHARES": {
        "GROUP": (Column("str"), "camera, kind, filter or exposure"),
        "MEMBER": (Column("str"), "which one"),
        "EXPECTED": (Column("float"), "sum of squared residuals of noise alone"),
        "BEFORE": (Column("float"), "sum of squared residuals, starting model"),
        "AFTER": (Column("float"), "sum of squared residuals, final model"),
    },
    "COMPARISONS": {
        "COMPARISON": (Column("int"), "number, 0: starting model and final model"),
        "EFFECT": (Column("str"), "what was added"),
        "COMBINATION": (Column("str"), "combination of exposures of FIELD"),
        "HARMONIC": (Column("int"), "of the polariser angle; -1: none"),
    },
    "FIELD": {
        "COMPARISON": (Column("int"), "row of COMPARISONS"),
        "POINT": (Column("int"), "field point"),
        "X": (Column("float", "deg"), "field coordinate"),
        "Y": (Column("float", "deg"), "field coordinate"),
        "BEFORE": (_CAMERAS, f"combined residual: {_SIGMA}"),
        "AFTER": (_CAMERAS, "the same with the effect"),
        "EXPLAINED": (_CAMERAS, "BEFORE - AFTER: the effect"),
        "MEAN_BEFORE": (_CAMERAS, "mean over exposures"),
        "MEAN_AFTER": (_CAMERAS, "mean over exposures"),
        "RMS_BEFORE": (_CAMERAS, "rms over exposures"),
        "RMS_AFTER": (_CAMERAS, "rms over exposures"),
    },
    "CURVES": {
        "COMPARISON": (Column("int"), "row of COMPARISONS"),
        "EXPOSURE": (Column("int"), "exposure id"),
        "KIND": (Column("str"), "KIND of the exposure"),
        "MJD": (Column("float", "d"), "UTC mid-exposure"),
        "CLP_ANGLE": (Column("float", "deg"), "polariser angle; NaN: out"),
        "BEFORE": (_CAMERAS, f"weighted mean over the field: {_SIGMA}"),
        "ERROR": (_CAMERAS, "standard error of BEFORE and AFTER"),
        "AFTER": (_CAMERAS, "the same with the effect"),
        "EXPLAINED": (_CAMERAS, "BEFORE - AFTER: the effect"),
    },
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Ladder:
    """χ² and degrees of freedom of the starting model and of every model after it; `model` says what joined."""

    model: Names
    chi2: Vector
    dof: Int[np.ndarray, " _"]


@dataclasses.dataclass(frozen=True)
class Shares:
    """Sums of squared residuals by group (camera, kind, filter, exposure) and member of the group.

    `expected` is what noise alone gives; `before` and `after` are of the starting and the final model.
    """

    group: Names
    member: Names
    expected: Vector
    before: Vector
    after: Vector


@dataclasses.dataclass(frozen=True)
class ResidualComparison:
    """Residuals without and with something, as maps over the field and as curves over the exposures.

    `effect` is empty where the starting model is compared with the final one. `combination` (plain ASCII) and
    `harmonic` say which combination of the exposures the maps show; the module says what the columns are.
    """

    effect: str
    combination: str
    harmonic: int
    before: PointMap
    after: PointMap
    mean_before: PointMap
    mean_after: PointMap
    rms_before: PointMap
    rms_after: PointMap
    curve_before: Curve
    curve_error: Curve
    curve_after: Curve

    @property
    def explained(self) -> PointMap:
        """What the effect makes of the maps, all other parameters having followed."""
        return self.before - self.after

    @property
    def curve_explained(self) -> Curve:
        """What the effect makes of the curves, all other parameters having followed."""
        return self.curve_before - self.curve_after


@dataclasses.dataclass(frozen=True)
class ExposureLabels:
    """What the exposures of the curves are: id, kind, MJD (d) and polariser angle (deg; NaN: out)."""

    exposure: Int[np.ndarray, " e"]
    kind: Shaped[np.ndarray, " e"]
    mjd: Float[np.ndarray, " e"]
    clp_angle: Float[np.ndarray, " e"]


@dataclasses.dataclass(frozen=True)
class DiagnosisFigureData:
    """Everything that `diagnosis.fits` holds; `comparisons[0]` is of the starting and the final model."""

    points: Points
    exposures: ExposureLabels
    ladder: Ladder
    shares: Shares
    comparisons: tuple[ResidualComparison, ...]

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras, in the order of the columns."""
        return tuple(str(name) for name in self.shares.member[self.shares.group == "camera"])


def write_figure_data(
    path: str | os.PathLike[str], data: DiagnosisFigureData, *, overwrite: bool = False
) -> None:
    """Write `diagnosis.fits` with checksums; the file appears whole or not at all.

    Raises `DataError` if the file exists and `overwrite` is False, and if the folder is missing or read-only.
    """
    primary = fits.PrimaryHDU()
    primary.header["DIAGVERS"] = (DIAGVERS, "version of the format of these pictures")
    primary.header["CREATOR"] = "walop-jax"
    hdus: list[Any] = [primary]
    for name, columns in _columns(data).items():
        hdu = table_hdu(name, columns, path, {key: rule for key, (rule, _) in _TABLES[name].items()})
        for number, (_, about) in enumerate(_TABLES[name].values(), start=1):
            hdu.header[f"TCOMM{number}"] = about
        hdus.append(hdu)
    with atomic_path(path, overwrite=overwrite) as temporary:
        sign_and_write(hdus, temporary)


def _columns(data: DiagnosisFigureData) -> dict[str, dict[str, np.ndarray]]:
    points, exposures, all_of = data.points, data.exposures, data.comparisons
    count, many = len(all_of), np.arange(len(all_of))

    def stacked(name: str) -> np.ndarray:
        return np.concatenate([getattr(one, name) for one in all_of])

    def record(rows: Ladder | Shares) -> dict[str, np.ndarray]:
        return {f.name.upper(): getattr(rows, f.name) for f in dataclasses.fields(rows)}

    maps = ("before", "after", "explained", "mean_before", "mean_after", "rms_before", "rms_after")
    return {
        "LADDER": record(data.ladder),
        "SHARES": record(data.shares),
        "COMPARISONS": {
            "COMPARISON": many,
            "EFFECT": np.array([one.effect for one in all_of]),
            "COMBINATION": np.array([in_ascii(one.combination) for one in all_of]),
            "HARMONIC": np.array([one.harmonic for one in all_of]),
        },
        "FIELD": {
            "COMPARISON": np.repeat(many, len(points)),
            **{name.upper(): np.tile(getattr(points, name), count) for name in ("point", "x", "y")},
            **{name.upper(): stacked(name) for name in maps},
        },
        "CURVES": {
            "COMPARISON": np.repeat(many, len(exposures.exposure)),
            **{
                field.name.upper(): np.tile(getattr(exposures, field.name), count)
                for field in dataclasses.fields(exposures)
            },
            **{n.upper(): stacked(f"curve_{n}") for n in ("before", "error", "after", "explained")},
        },
    }


def read_figure_data(path: str | os.PathLike[str]) -> DiagnosisFigureData:
    """Read `diagnosis.fits`.

    Raises `DataError`, with advice, for a file that is damaged, of another kind or from a newer version.
    """
    with open_fits(path) as opened:
        version = opened.hdus[0].header.get("DIAGVERS")
        if version != DIAGVERS:
            found = "is missing" if version is None else f"is {version}, this program reads {DIAGVERS}"
            raise fail(found, file=path, column="DIAGVERS", advice="run walop-jax diagnose again")
        units = {hdu.name.strip().upper(): hdu for hdu in opened.hdus[1:]}
        try:
            tables: dict[str, dict[str, Any]] = {}
            for name, columns in _TABLES.items():
                rules = {key: rule for key, (rule, _) in columns.items()}
                tables[name] = read_table(units[name], rules, Place(path, name))[0]
            return _figure_data(tables)
        except DataError:
            raise
        except UNREADABLE as error:
            raise fail(
                f"cannot be read: {one_line(error)}", file=path, advice="run walop-jax diagnose again"
            ) from error


def _figure_data(tables: Mapping[str, Mapping[str, Any]]) -> DiagnosisFigureData:
    field, curves, about = tables["FIELD"], tables["CURVES"], tables["COMPARISONS"]
    comparisons = []
    for number in about["COMPARISON"]:
        here, there = field["COMPARISON"] == number, curves["COMPARISON"] == number
        maps = ("before", "after", "mean_before", "mean_after", "rms_before", "rms_after")
        comparisons.append(
            ResidualComparison(
                effect=str(about["EFFECT"][number]),
                combination=str(about["COMBINATION"][number]),
                harmonic=int(about["HARMONIC"][number]),
                **{name: field[name.upper()][here] for name in maps},
                **{f"curve_{n}": curves[n.upper()][there] for n in ("before", "error", "after")},
            )
        )
    first, rows = field["COMPARISON"] == 0, curves["COMPARISON"] == 0
    return DiagnosisFigureData(
        points=Points(*(field[name][first] for name in ("POINT", "X", "Y"))),
        exposures=ExposureLabels(
            *(curves[name][rows] for name in ("EXPOSURE", "KIND", "MJD", "CLP_ANGLE")),
        ),
        ladder=Ladder(**{name.lower(): values for name, values in tables["LADDER"].items()}),
        shares=Shares(**{name.lower(): values for name, values in tables["SHARES"].items()}),
        comparisons=tuple(comparisons),
    )
