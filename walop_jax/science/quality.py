"""Quality numbers of a night: standards against their catalogue, misfit, gains, accuracy; a table of nights, limits.

Equations   A standard as the other data see it, its own catalogue value taken out of the fit: with the covariance C and
            the value v of (q, u) in the fit, and the prior (c, W) of the catalogue,
                M⁻¹ = C⁻¹ − W⁻¹,   m = M (C⁻¹ v − W⁻¹ c)
            Angle ½ (c × m)/|c|² and ratio m·c/|c|² of the polarised ones, m − c of the others: means with weights
            1/(their variance and that of the catalogue).
Source      trending of polarised and unpolarised standards as in the quality reports of FORS2 (ESO)
Limits      C = W (nothing but the catalogue is known of a star): M is infinite, the star is left out.
"""

from __future__ import annotations

import csv
import dataclasses
import functools
import io
import os
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from walop_jax.calibration.accuracy import LARGEST_P
from walop_jax.calibration.calibration import Calibration
from walop_jax.data.schema import Column
from walop_jax.data.user_tables import numeric_column, read_input_table
from walop_jax.fit.verdict import Doubt
from walop_jax.fit.verdict import Quality as Bits
from walop_jax.io.atomic import check_output
from walop_jax.io.display import Display, Displayed
from walop_jax.io.errors import errors_naming, fail
from walop_jax.io.folder import locked
from walop_jax.io.plain_tables import astropy_table, stacked, table_format, write_table
from walop_jax.io.text import parse_toml, read_text, rounded, with_error
from walop_jax.io.toml import Reader
from walop_jax.science.field_accuracy import field_accuracy
from walop_jax.sky.nights import night_of

POLARISED = 0.005  # catalogued p from which a standard shows angle and p, and below which it shows the zero
HELD = 1e-3  # fraction of the information of the catalogue that the data must add to a star
BEYOND = 2.0  # standard errors beyond a limit

ERRORS = {"ANGLE": "ANGLE_ERR", "P_RATIO": "P_RATIO_ERR", "ZERO_Q": "ZERO_ERR", "ZERO_U": "ZERO_ERR"}
GAIN = "GAIN"
OUTSIDE = "OUTSIDE"
SAME = ("INSTRUME", "NIGHT", "FILTERS")
"""Columns that are alike in two rows of one night, of which the later one is kept."""
Limits = Mapping[str, tuple[float, float]]
SHOWN = {
    "CHI2DOF": (1.0, ""), "ANGLE": (1.0, "deg"), "P_RATIO": (1.0, ""), "ZERO_Q": (100.0, "%"), "ZERO_U": (100.0, "%"),
    "ACCURACY": (100.0, "%"),
}  # fmt: skip
"""Columns that are printed, with the factor and the unit in which they are."""
CURES = {
    "ANGLE": "check ROTATOR, and the angles of the standards in SOURCES",
    "P_RATIO": "check p of the standards in SOURCES, and the sky that was subtracted",
    "ZERO_Q": "observe unpolarised standards again; walop-jax diagnose looks for the polarisation of the telescope",
    "ZERO_U": "observe unpolarised standards again; walop-jax diagnose looks for the polarisation of the telescope",
    "STDCHI2": "look for a standard that is variable or mistaken: walop-jax diagnose",
    "CHI2DOF": "walop-jax diagnose looks for missing effects",
    "ACCURACY": "walop-jax plan RUN gives the exposures that are missing",
    "HIDDEN": "walop-jax check RUN names the exposures that would show it",
    "TRUSTED": "walop-jax diagnose looks for what is missing",
    GAIN: "look for dust, clouds or another gain: the other nights of the table have the usual gains",
}
"""Remedies of numbers outside their limits, by column."""


@functools.cache
def columns() -> Mapping[str, tuple[str, str]]:
    """Unit and description of the columns of every table of nights (`quality_columns.csv`), in their order."""
    text = (resources.files("walop_jax.science") / "quality_columns.csv").read_text("utf-8")
    _, *rows = csv.reader(io.StringIO(text))
    return {name: (unit, about) for name, unit, about in rows}


def numbers() -> list[str]:
    """The columns that are quality numbers, which follow the verdict; NaN where a run does not hold one."""
    names = [*columns()]
    return names[names.index("TRUSTED") + 1 :]


class Standard(NamedTuple):
    """(q, u) of a standard without its own catalogue value, its covariance, the catalogue's, and its variances."""

    name: str
    measured: Float[np.ndarray, " 2"]
    covariance: Float[np.ndarray, "2 2"]
    catalogue: Float[np.ndarray, " 2"]
    variance: Float[np.ndarray, " 2"]

    @property
    def difference(self) -> Float[np.ndarray, " 2"]:
        """Measured q, u less the catalogue values."""
        return self.measured - self.catalogue

    @property
    def total(self) -> Float[np.ndarray, "2 2"]:
        """Covariance (2, 2) of the difference: of the measurement and of the catalogue."""
        return self.covariance + np.diag(self.variance)


def standards(calibration: Calibration) -> list[Standard]:
    """The standards of a calibration as all else has measured them; none that the data do not measure."""
    model, measured_stars = calibration.model, []
    names = [model.names[i] for i in model.positions("standard")]
    for name in (entry.removesuffix(".q") for entry in names if entry.endswith(".q")):
        pair = [model.index(f"{name}.{axis}") for axis in "qu"]
        priors = [model.parameters[i].prior for i in pair]
        if not all(priors) or any(model.parameters[i].tie for i in pair):
            continue
        catalogue, width = np.array(priors, float).T
        information = np.linalg.inv(calibration.covariance[np.ix_(pair, pair)])
        added = information - np.diag(width**-2.0)
        if np.linalg.eigvalsh(width[:, None] * added * width).min() < HELD:
            continue
        covariance = np.linalg.inv(added)
        measured = covariance @ (information @ calibration.values[pair] - catalogue / width**2)
        measured_stars.append(Standard(name, measured, covariance, catalogue, width**2))
    return measured_stars


def _mean(measured: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Weighted mean of values with variances, and its standard error; NaN of nothing."""
    if not measured:
        return np.nan, np.nan
    values, variances = np.transpose(measured)
    weight = 1.0 / variances
    return float(np.sum(weight * values) / weight.sum()), float(weight.sum() ** -0.5)


def numbers_of(stars: Sequence[Standard]) -> dict[str, float]:
    """The quality numbers that standards give, by column."""
    polarised = [star for star in stars if np.hypot(*star.catalogue) >= POLARISED]
    zeros = [star for star in stars if np.hypot(*star.catalogue) < POLARISED]
    angle, ratio = [], []
    for star in polarised:
        p = np.hypot(*star.catalogue)
        along = star.catalogue / p
        across = np.array([-along[1], along[0]])
        turn = np.rad2deg(0.5 / p)
        angle.append((np.rad2deg(0.5 * across @ star.measured / p), turn**2 * across @ star.total @ across))
        ratio.append((along @ star.measured / p, along @ star.total @ along / p**2))
    zero = [_mean([(float(star.difference[k]), float(star.total[k, k])) for star in zeros]) for k in range(2)]
    chi2 = [star.difference @ np.linalg.solve(star.total, star.difference) for star in stars]
    angles, ratios = _mean(angle), _mean(ratio)
    return {
        "NSTD": len(polarised),
        **dict(zip(("ANGLE", "ANGLE_ERR"), angles, strict=True)),
        **dict(zip(("P_RATIO", "P_RATIO_ERR"), ratios, strict=True)),
        "NZERO": len(zeros),
        **dict(zip(("ZERO_Q", "ZERO_U"), (mean for mean, _ in zero), strict=True)),
        "ZERO_ERR": float(np.hypot(zero[0][1], zero[1][1]) / np.sqrt(2.0)),
        "STDCHI2": float(np.sum(chi2)) / (2 * len(stars)) if stars else np.nan,
    }


def quality_row(
    calibration: Calibration, run: str, accuracy: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Quality numbers of a calibration, of its last night; `accuracy`: `accuracy_of_p` of its summary, if any."""
    exposures, verdict = calibration.exposures, calibration.verdict
    if accuracy is None:
        field = field_accuracy(calibration)
        accuracy = {} if field is None else {"median": field.median, "hidden": field.hidden}
    median, hidden = (
        np.nan if (value := accuracy.get(name)) is None else float(value) for name in ("median", "hidden")
    )
    mjd = exposures.mjd[np.isfinite(exposures.mjd)]
    night = night_of(mjd, calibration.site.longitude)
    series = np.asarray(calibration.model.instrument(calibration.values).throughput.coefficients)[:, 0]
    gains = zip(calibration.model.template.cameras.names, series / series.mean(), strict=True)
    return {
        "NIGHT": float(night.max()) if night.size else np.nan,
        "MJD_BEG": float(mjd.min()) if mjd.size else np.nan,
        "MJD_END": float(mjd.max()) if mjd.size else np.nan,
        "NIGHTS": len(np.unique(night)),
        "INSTRUME": calibration.instrument,
        "FILTERS": ",".join(np.unique(exposures.filter).tolist()),
        "RUN": run,
        "CALHASH": calibration.content_hash(),
        "TRUSTED": verdict.trusted,
        "CHI2DOF": verdict.chi2 / max(verdict.dof, 1),
        **numbers_of(standards(calibration)),
        "ACCURACY": median,
        "HIDDEN": hidden,
        **{f"{GAIN}_{name.upper()}": float(gain) for name, gain in gains},
    }


def read_limits(path: str | os.PathLike[str] | None = None) -> Limits:
    """Limits by the name of a column (GAIN: of all cameras): those of a file, beside those of the package."""
    shipped = (resources.files("walop_jax.science") / "quality.toml").read_text(encoding="utf-8")
    limits = _limits(shipped)
    if path is not None:
        with errors_naming(path):
            limits |= _limits(read_text(path))
    return limits


def _limits(text: str) -> dict[str, tuple[float, float]]:
    read = Reader("")
    content = read.values(dict.fromkeys((*numbers(), GAIN), tuple[float, float]), parse_toml(text), "")
    for name, (low, high) in content.items():
        if not low < high:
            raise read.fault("", f"{name} = [{low:g}, {high:g}]: the lowest value must be below the highest")
    return content


OF_CAMERA = ("", "throughput of a camera over the mean of all")
RULES = dict.fromkeys(("INSTRUME", "FILTERS", "RUN", "CALHASH"), Column("str", missing=""))
RULES |= {"NIGHTS": Column("int", missing=0), "TRUSTED": Column("bool", missing=False)}


def table_of_nights(rows: Sequence[Mapping[str, Any]]) -> Any:
    """Rows as an astropy table with units and descriptions."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    values = {name: np.array([row.get(name, np.nan) for row in rows]) for name in names}
    return astropy_table({name: (values[name], *columns().get(name, OF_CAMERA)) for name in names})


def read_nights(path: Path) -> Any:
    """The table of nights in a file, in the units of `columns`; `DataError` for one that is none."""
    source = read_input_table(path, (*SAME, "CALHASH"))
    table = source.table
    if lacking := [name for name in (*SAME, "CALHASH") if name not in table.colnames]:
        what = "the column is missing: this is no table of quality numbers"
        advice = "name the table that walop-jax check --append has made, or a new one"
        raise fail(what, file=path, column=lacking[0], advice=advice)
    stated = [name for name in table.colnames if name in columns() or name.startswith(f"{GAIN}_")]
    about = {name: columns().get(name, OF_CAMERA) for name in stated}
    rules = {name: RULES.get(name, Column("float", about[name][0], missing=np.nan)) for name in stated}
    nights = astropy_table({n: (numeric_column(source, n, rules[n]), *about[n]) for n in stated})
    for name in (other for other in table.colnames if other not in stated):
        nights[name] = table[name]
    return nights


def joined(old: Any, new: Any) -> tuple[Any, list[str]]:
    """Both tables as one, in the order of the nights, and remarks; the later row of a night is kept."""
    rows = stacked(old, new)
    latest: dict[tuple[str, ...], int] = {}
    hashes, remarks = set[str](), []
    for number, row in enumerate(rows):
        content = str(row["CALHASH"])  # in the key of a row without a night, which replaces no other
        key = (*(str(row[name]) for name in SAME), content if np.isnan(row["NIGHT"]) else "")
        if content in hashes:
            remarks.append(f"{row['RUN']}: this calibration is in the table already")
            continue
        if key in latest:
            remarks.append(
                f"{row['RUN']}: takes the place of {rows[latest[key]]['RUN']} in night {float(key[1]):.0f}"
            )
        hashes.add(content)
        latest[key] = number
    table = rows[sorted(latest.values())]
    table.sort(["NIGHT", "FILTERS"])
    return table, remarks


def judge(table: Any, limits: Limits) -> Any:
    """The table with the column OUTSIDE: names of the numbers of each night that lie outside their limits."""
    outside: list[list[str]] = [[] for _ in range(len(table))]
    for name in table.colnames:
        camera = name.startswith(f"{GAIN}_")
        low, high = limits.get(GAIN if camera else name, (-np.inf, np.inf))
        if not (camera or name in numbers()):
            continue
        values, error = _plain(table[name]), _plain(table[ERRORS[name]]) if name in ERRORS else 0.0
        if camera:
            values = values / _medians_before(values, [(row["INSTRUME"], row["FILTERS"]) for row in table])
        beyond = np.maximum(low - values, values - high) > BEYOND * np.nan_to_num(error)
        for row in np.flatnonzero(beyond):
            outside[row].append(name)
    for row in np.flatnonzero(~np.asarray(table["TRUSTED"], bool)):
        outside[row].append("TRUSTED")
    table[OUTSIDE] = [" ".join(names) for names in outside]
    table[OUTSIDE].description = "numbers outside their limits"
    return table


def _plain(column: Any) -> Float[np.ndarray, " n"]:
    return np.ma.filled(np.ma.asarray(column, float), np.nan)


def _medians_before(values: Float[np.ndarray, " n"], alike: Sequence[object]) -> Float[np.ndarray, " n"]:
    """Median of all earlier rows of the same instrument and filters; of the first one itself."""
    medians = values.copy()
    for n, kind in enumerate(alike):
        if earlier := [values[k] for k in range(n) if alike[k] == kind and np.isfinite(values[k])]:
            medians[n] = np.median(earlier)
    return medians


@dataclasses.dataclass(frozen=True, repr=False)
class QualityRow(Displayed):
    """The row of a calibration (`mine`) in the `table` of nights, its limits, and remarks."""

    table: Any
    mine: Any
    limits: Limits
    output: str | None
    remarks: tuple[str, ...] = ()

    @property
    def outside(self) -> tuple[str, ...]:
        """Names of the numbers outside their limits."""
        return tuple(str(self.mine[OUTSIDE]).split())

    @property
    def night(self) -> str:
        """The evening (MJD) in words."""
        return f"night {self.mine['NIGHT']:.0f}" if np.isfinite(self.mine["NIGHT"]) else "this run"

    def _printed(self, name: str) -> str:
        factor, unit = SHOWN.get(name, (1.0, columns().get(name, ("", ""))[0]))
        value = self.mine[name]
        if name == "TRUSTED":
            return "F"
        if name not in ERRORS:
            return f"{rounded(factor * float(value))} {unit}".rstrip()
        return f"{with_error(factor * float(value), factor * float(self.mine[ERRORS[name]]))} {unit}".rstrip()

    def _off(self, name: str) -> float | None:
        """What a number does to q or u of a star with p = 5 %, as a fraction; None where that is not known."""
        value = float(self.mine[name])
        turned = 2.0 * LARGEST_P * np.deg2rad(value)
        known = {"ANGLE": turned, "P_RATIO": LARGEST_P * (value - 1.0)}
        known |= dict.fromkeys(("ZERO_Q", "ZERO_U", "ACCURACY", "HIDDEN"), value)
        return abs(float(known[name])) if name in known and np.isfinite(value) else None

    @property
    def against(self) -> tuple[Doubt, ...]:
        """A reason for every number outside its limits."""
        doubts = []
        for name in self.outside:
            of_kind = GAIN if name.startswith(f"{GAIN}_") else name
            low, high = self.limits.get(of_kind, (np.nan, np.nan))
            factor, unit = SHOWN.get(name, (1.0, columns().get(name, ("", ""))[0]))
            allowed = f", allowed {rounded(factor * low)} to {rounded(factor * high)} {unit}".rstrip()
            of_which = " (of the median before)" if of_kind == GAIN else ""
            what = f"{self.night}: {name} = {self._printed(name)}{allowed if np.isfinite(low + high) else ''}{of_which}"
            off = None if name == "TRUSTED" else self._off(name)
            doubts.append(Doubt(Bits.DOUBTED, what, off=off, remedy=CURES.get(of_kind, "")))
        return tuple(doubts)

    def document(self) -> dict[str, Any]:
        """Everything as plain data; `nights` are the rows of this calibration."""
        return {
            "output": self.output,
            "nights": [{name: np.asarray(self.mine[name]).item() for name in self.table.colnames}],
            "limits": {name: list(pair) for name, pair in self.limits.items()},
            "outside": list(self.outside),
            "remarks": list(self.remarks),
        }

    def display(self) -> Display:
        """The row, in the table that it was added to."""
        count = len(self.table)
        title = f"{self.output or 'Quality numbers'}: {count} night{'s' if count != 1 else ''}"
        head = (
            "night (MJD)",
            *(f">{name} ({unit})" if unit else f">{name}" for name, (_, unit) in SHOWN.items()),
        )
        values = (self._printed(name).removesuffix(f" {unit}") for name, (_, unit) in SHOWN.items())
        row = (f"{self.mine['NIGHT']:.0f}", *values, str(self.mine[OUTSIDE]))
        return Display(title, (), (*head, "outside"), (row,), self.remarks)


def append(path: str | os.PathLike[str] | None, new: Any, limits: Limits) -> tuple[Any, list[str]]:
    """Add nights to the table in a file, which is made if it is not there; the whole table, and remarks.

    Nothing is lost where it is killed, and of two processes the second one is notified of the first. Without a file
    the table is that of the new nights.
    """
    if path is None:
        table, remarks = joined(new[:0], new)
        return judge(table, limits), remarks
    table_format(path)
    target = check_output(path, overwrite=True)
    with locked(target.parent / f".walop-quality-{target.name}-lock", path):
        table, remarks = joined(read_nights(target) if target.exists() else new[:0], new)
        table = judge(table, limits)
        write_table(target, table, overwrite=True)
    return table, remarks
