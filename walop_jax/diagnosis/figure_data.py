"""Data of the figures of a diagnosis, `diagnosis.fits` (DIAGVERS = 1): small arrays, no data set.

Its tables are those of `_TABLES` (docs: files). Columns of FIELD and CURVES without a unit are (data - model) in
standard deviations of one intensity as N_ERR gives them. Values of FIELD in a combination, BEFORE and AFTER, have
standard deviation 1 (where the flux is free √(1 − 1/K) with K cameras, 0.87 of four) if there is noise alone.

_Combination  r_pk = Σ_e w_e r_pek / (Σ_e w_e² over the used ones)^½ keeps unit noise. The weights w are those of
             the named combination (a harmonic of the polariser angle at its best phase, the mean of a kind of
             exposures, a trend with time) that holds most of the power of the disagreement; if all of them hold less
             than `WORDS_FROM` of what the best weights do (principal component over the exposures), the latter.
Curve        c_ek = Σ_p v_pk r_pek / Σ_p v_pk², with v the field pattern of the difference in that camera, rms 1: a
             pattern that changes sign over the field does not average out.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from astropy.io import fits
from jaxtyping import Bool, Float, Shaped

from walop_jax.data.hdus import sign_and_write, table_hdu
from walop_jax.data.records import Exposures, Points
from walop_jax.data.schema import Column, read_table
from walop_jax.data.units import Place
from walop_jax.diagnosis.findings import HARMONICS, Diagnosis
from walop_jax.io.atomic import atomic_path
from walop_jax.io.errors import fail
from walop_jax.io.fits_reading import open_fits
from walop_jax.io.shapes import ResidualCube
from walop_jax.io.text import in_ascii
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects import FreeForm

DIAGVERS = 1
"""Version of the file format that is written, and the newest that is read."""

FigureColumns = Mapping[str, Shaped[np.ndarray, " _"]]
"""Columns of a table by name."""

PointMap = Float[np.ndarray, "p k"]
PerCamera = Mapping[str, Float[np.ndarray, "_ k"]]

_OF_EXPOSURES = ("EXPOSURE", "KIND", "MJD", "CLP_ANGLE")
_SIGMA = "(data - model) in standard deviations, a value for each camera"
_CAMERAS = Column("float", width=None)
_TABLES: Mapping[str, Mapping[str, tuple[Column, str]]] = {
    "LADDER": {
        "MODEL": (Column("str"), "the starting model, or the addition to it"),
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
        "EFFECT": (Column("str"), "the addition"),
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
class ResidualComparison:
    """Residuals without and with an effect, as maps over the field and as curves over the exposures.

    `effect` is empty where the starting model is compared with the final one. `combination` (plain ASCII) and
    `harmonic` identify the combination of the exposures in the maps. `field` (points) and `curves` (exposures) are the
    columns of FIELD and CURVES with a value for each camera (`_TABLES`).
    """

    effect: str
    combination: str
    harmonic: int
    field: PerCamera
    curves: PerCamera


@dataclasses.dataclass(frozen=True)
class DiagnosisFigureData:
    """Content of `diagnosis.fits`; `comparisons[0]` is that of the starting and the final model.

    `ladder` and `shares` are the tables of these names, `exposures` the columns of CURVES that identify them.
    """

    points: Points
    exposures: FigureColumns
    ladder: FigureColumns
    shares: FigureColumns
    comparisons: tuple[ResidualComparison, ...]

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras, in the order of the columns."""
        return tuple(str(name) for name in self.shares["MEMBER"][self.shares["GROUP"] == "camera"])


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


def _columns(data: DiagnosisFigureData) -> dict[str, Mapping[str, np.ndarray]]:
    points, exposures, all_of = data.points, data.exposures, data.comparisons
    count, many = len(all_of), np.arange(len(all_of))

    def stacked(of_each: Sequence[PerCamera]) -> PerCamera:
        return {name: np.concatenate([columns[name] for columns in of_each]) for name in of_each[0]}

    return {
        "LADDER": data.ladder,
        "SHARES": data.shares,
        "COMPARISONS": {
            "COMPARISON": many,
            "EFFECT": np.array([comparison.effect for comparison in all_of]),
            "COMBINATION": np.array([in_ascii(comparison.combination) for comparison in all_of]),
            "HARMONIC": np.array([comparison.harmonic for comparison in all_of]),
        },
        "FIELD": {
            "COMPARISON": np.repeat(many, len(points)),
            **{name.upper(): np.tile(getattr(points, name), count) for name in ("point", "x", "y")},
            **stacked([comparison.field for comparison in all_of]),
        },
        "CURVES": {
            "COMPARISON": np.repeat(many, len(exposures["EXPOSURE"])),
            **{name: np.tile(values, count) for name, values in exposures.items()},
            **stacked([comparison.curves for comparison in all_of]),
        },
    }


def read_figure_data(path: str | os.PathLike[str]) -> DiagnosisFigureData:
    """Read `diagnosis.fits`.

    Raises `DataError`, with advice, for a file that is damaged, of another kind or from a newer version.
    """
    again = "run walop-jax diagnose again"
    with open_fits(path, again) as opened:
        version = opened.hdus[0].header.get("DIAGVERS")
        if version != DIAGVERS:
            message = "is missing" if version is None else f"is {version}, this program reads {DIAGVERS}"
            raise fail(message, file=path, column="DIAGVERS", advice=again)
        units = {hdu.name.strip().upper(): hdu for hdu in opened.hdus[1:]}
        tables: dict[str, dict[str, Any]] = {}
        for name, columns in _TABLES.items():
            rules = {key: rule for key, (rule, _) in columns.items()}
            tables[name] = read_table(units[name], rules, Place(path, name))[0]
        return _figure_data(tables)


def _figure_data(tables: Mapping[str, Mapping[str, Any]]) -> DiagnosisFigureData:
    field, curves, about = tables["FIELD"], tables["CURVES"], tables["COMPARISONS"]

    def of_number(name: str, number: int) -> PerCamera:
        rows = tables[name]["COMPARISON"] == number
        return {key: tables[name][key][rows] for key, (rule, _) in _TABLES[name].items() if rule is _CAMERAS}

    rows = zip(*(about[name].tolist() for name in _TABLES["COMPARISONS"]), strict=True)
    comparisons = [
        ResidualComparison(effect, combination, harmonic, of_number("FIELD", i), of_number("CURVES", i))
        for i, effect, combination, harmonic in rows
    ]
    first, rows = field["COMPARISON"] == 0, curves["COMPARISON"] == 0
    return DiagnosisFigureData(
        points=Points(*(field[name][first] for name in ("POINT", "X", "Y"))),
        exposures={name: curves[name][rows] for name in _OF_EXPOSURES},
        ladder=tables["LADDER"],
        shares=tables["SHARES"],
        comparisons=tuple(comparisons),
    )


# ------------------------------------------------------------------------------------------------ made from a diagnosis

Weight = Float[np.ndarray, " e"]
Used = Bool[np.ndarray, "p e"]

WORDS_FROM = 0.3  # share of the best weights' power with which a combination in words is preferred
LEAST_COVERAGE = 0.5  # share of Σ w² that the exposures of a point must hold for the point to be shown


@dataclasses.dataclass(frozen=True)
class _Combination:
    """Weights of the exposures (norm 1), their description, and the harmonic of the polariser angle or −1."""

    words: str
    weight: Weight
    harmonic: int = -1

    def of(self, cube: ResidualCube, used: Used) -> PointMap:
        """The combined residuals of every point and camera; NaN where too few of the exposures are used."""
        present = used @ self.weight**2
        norm = np.where(present > LEAST_COVERAGE, np.sqrt(present), np.nan)
        return np.einsum("pek,e->pk", cube, self.weight) / norm[:, None]


def figure_data(diagnosis: Diagnosis) -> DiagnosisFigureData:
    """The arrays from which the figures of a diagnosis are drawn, residuals with the errors as given.

    A free-form term that is in the final model without being a step comes as a last comparison of its own.
    """
    start, final = diagnosis.before, diagnosis.after
    exposures, used = final.calset.exposures, final.likelihood.used
    after = final.likelihood.residuals(final.values)[1]
    before = after if start is final else start.likelihood.residuals(start.values)[1]
    pairs = [("", before, after)]
    pairs += [(step.effect, step.residual_before, step.residual_after) for step in diagnosis.steps]
    if _unnamed_term(diagnosis):
        pairs.append((FreeForm.name, pairs[-1][2] if diagnosis.steps else before, after))
    angle = np.where(exposures.clp_in, exposures.clp_angle, np.nan)
    columns = exposures.exposure, exposures.kind, exposures.mjd, angle
    return DiagnosisFigureData(
        points=final.calset.points,
        exposures=dict(zip(_OF_EXPOSURES, columns, strict=True)),
        ladder=_ladder(diagnosis),
        shares=_shares(final.likelihood, before, after),
        comparisons=tuple(compare_residuals(*pair, used, exposures) for pair in pairs),
    )


def _unnamed_term(diagnosis: Diagnosis) -> bool:
    names = [*diagnosis.before.model.effect_names, *(step.effect for step in diagnosis.steps)]
    return FreeForm.name in diagnosis.after.model.effect_names and FreeForm.name not in names


def compare_residuals(
    effect: str, before: ResidualCube, after: ResidualCube, used: Used, exposures: Exposures
) -> ResidualComparison:
    """Two cubes of residuals (σ; 0 where unused) side by side, in the combination that shows their difference.

    Without a difference the combination is the one that shows the residuals themselves.
    """
    change = before - after
    shown = change if np.any(change) else before
    best = best_combination(shown, used, exposures)
    pattern = np.nan_to_num(best.of(shown, used))
    size = np.sqrt(np.mean(pattern**2, axis=0))
    pattern = np.where(size > 0, pattern / np.where(size > 0, size, 1.0), 1.0)
    power = used.T.astype(float) @ pattern**2
    weight = np.where(power > 0, power, np.nan)
    curve, curve_after = (np.einsum("pek,pk->ek", cube, pattern) / weight for cube in (before, after))
    scatter = np.sqrt(np.einsum("pek,pk->ek", after**2, pattern**2)) / weight
    rows = used.sum(axis=1, keepdims=True)
    rows = np.where(rows > 0, rows, np.nan)
    field = {"BEFORE": best.of(before, used), "AFTER": best.of(after, used)}
    field["EXPLAINED"] = field["BEFORE"] - field["AFTER"]
    for name, cube in (("BEFORE", before), ("AFTER", after)):
        field[f"MEAN_{name}"] = cube.sum(axis=1) / rows
        field[f"RMS_{name}"] = np.sqrt((cube**2).sum(axis=1) / rows)
    curves = {"BEFORE": curve, "ERROR": scatter, "AFTER": curve_after, "EXPLAINED": curve - curve_after}
    return ResidualComparison(effect, best.words, best.harmonic, field, curves)


def best_combination(cube: ResidualCube, used: Used, exposures: Exposures) -> _Combination:
    """The combination of the exposures in which a pattern (σ) shows best, in words wherever that is possible."""

    def power(combination: _Combination) -> float:
        return float(np.nansum(combination.of(cube, used) ** 2))

    flat = np.moveaxis(cube, 1, -1).reshape(-1, cube.shape[1])
    principal = np.linalg.eigh(flat.T @ flat)[1][:, -1]
    principal = principal * (np.sign(principal[np.abs(principal).argmax()]) or 1.0)
    free = _Combination("the combination of all exposures that shows it best", principal)
    named = max(_in_words(cube, used, exposures), key=power, default=free)
    return named if power(named) >= WORDS_FROM * power(free) else free


def _in_words(cube: ResidualCube, used: Used, exposures: Exposures) -> Iterator[_Combination]:
    measured = used.any(axis=0)
    through = exposures.clp_in & measured
    angle = np.deg2rad(np.where(through, exposures.clp_angle, 0.0))
    for harmonic in HARMONICS[1:]:
        waves = [np.where(through, wave(harmonic * angle), 0.0) for wave in (np.cos, np.sin)]
        # The phase at which cos φ · (cosine part) + sin φ · (sine part) has the largest power.
        cosine, sine = (np.einsum("pek,e->pk", cube, wave) for wave in waves)
        power = np.sum(cosine**2) - np.sum(sine**2)
        phase = 0.5 * float(np.arctan2(2.0 * np.sum(cosine * sine), power))
        weight = waves[0] * np.cos(phase) + waves[1] * np.sin(phase)
        if np.linalg.norm(weight) > 1e-6:
            words = f"cos({harmonic} theta - {np.rad2deg(phase) % 360:.0f} deg), theta the polariser angle"
            yield _Combination(words, weight / np.linalg.norm(weight), harmonic)
    for kind in np.unique(exposures.kind[measured]):
        weight = ((exposures.kind == kind) & measured).astype(float)
        yield _Combination(f"mean of the {kind} exposures", weight / np.linalg.norm(weight))
    hours = np.where(measured, exposures.mjd - exposures.mjd[measured].mean(), 0.0)
    if np.all(np.isfinite(hours)) and np.any(hours):
        yield _Combination("trend with time", hours / np.linalg.norm(hours))


def _ladder(diagnosis: Diagnosis) -> FigureColumns:
    """Starting model, every addition, and the final fit where it differs from that of the last addition."""
    final = diagnosis.after
    rungs = [("starting model", diagnosis.before.chi2, diagnosis.before.dof)]
    rungs += [(step.effect, step.chi2_after, step.dof_after) for step in diagnosis.steps]
    if abs(final.chi2 - rungs[-1][1]) > 1e-6 * final.chi2:
        rungs.append((FreeForm.name if _unnamed_term(diagnosis) else "final fit", final.chi2, final.dof))
    model, chi2, freedom = zip(*rungs, strict=True)
    return {"MODEL": np.array(model), "CHI2": np.array(chi2, float), "DOF": np.array(freedom, int)}


def _shares(likelihood: Likelihood, before: ResidualCube, after: ResidualCube) -> FigureColumns:
    """Sums of squared residuals by camera, kind, filter and exposure."""
    e, names = likelihood.calset.exposures, likelihood.model.template.cameras.names
    share = likelihood.data_per_row / len(names)
    expected = (likelihood.used.sum(axis=0) * share)[:, None] * np.ones(len(names))
    squares = np.stack([expected, (before**2).sum(axis=0), (after**2).sum(axis=0)])  # (…, exposure, camera)
    rows = [("camera", camera, *squares[..., k].sum(axis=1)) for k, camera in enumerate(names)]
    for group, label in (("kind", e.kind), ("filter", e.filter), ("exposure", e.exposure)):
        rows += [(group, str(m), *squares[:, label == m].sum(axis=(1, 2))) for m in np.unique(label)]
    return {
        name: np.array(column)
        for name, column in zip(_TABLES["SHARES"], zip(*rows, strict=True), strict=True)
    }
