"""What the notebook on the optical design of WALOP-North needs: its data, numbers to compare, descriptions."""

from __future__ import annotations

import dataclasses
import os
import subprocess
from pathlib import Path

import numpy as np
from zemax import import_transmissions

import walop_jax as walop
from walop_jax import CalibrationSet, FitResult, Settings

REPOSITORY = "https://github.com/HeisenbergK/NewWALOPCalibrate2Dens"
ELEMENTS = ("m22", "m23", "m32", "m33")

# What one would have written before looking: plates, wedges and magnification of the family, the calibration plate out
# of the beam as the data say, wedges that leave the plane of vibration alone, ideal lenses and analysers.
NOMINAL = """
name = "WALOP-NORTH"
like = "WALOP-NORTH"
[elements.chwp]
always_in = {plate_in}
[arms.half1.elements.wedge]
frame = "{frame}"
[arms.half2.elements.wedge]
frame = "{frame}"
"""
AT_NOMINAL = {
    "pupil.magnification": 19.5, "pupil.distortion": 0.0, "pupil.aspect": 0.0,
    "half2.plate.quartz": 2407.0, "half2.plate.mgf2": 1930.0, "half2.wedge": 0.230, "half2.plate.axis": 22.5,
    "half1.efficiency": 0.999, "half2.efficiency": 0.999,
}  # fmt: skip
PIECES = (
    "pupil.aspect", "half2.frame.skew", "half2.plate.mgf2.slope", "half2.plate.mgf2.bend", "half2.plate.mgf2.twist",
    "lenses.delta", "lenses.slope", "lenses.bend", "half1.contrast", "half2.contrast", "collimator.diattenuation",
    "collimator.q", "collimator.u",
)  # fmt: skip


def design_set(folder: str | Path = "walop_north_design") -> CalibrationSet:
    """The transmissions of the optical design as a calibration set.

    Where NORTH_DESIGN names a set it is read. Else the text exports are fetched from their public repository (git) and
    imported by `zemax.py`, once.
    """
    named = os.environ.get("NORTH_DESIGN")
    if named:
        return walop.read(named)
    folder = Path(folder)
    made = folder / "walop_north_design.fits"
    if not made.exists():
        source = folder / "repository"
        if not source.exists():
            subprocess.run(["git", "clone", "--depth", "1", REPOSITORY, str(source)], check=True)
        exports = next(
            path.parent for path in sorted(source.rglob("Config_1")) if path.parent.name != "Unpol"
        )
        walop.write_calibration_set(made, import_transmissions(exports)[0])
    return walop.read(made)


def spread_points(calset: CalibrationSet, count: int) -> CalibrationSet:
    """The set with so many of its field points, or a few less, spread evenly by the golden section."""
    rows = np.unique((np.mod(0.6180339887498949 * np.arange(count), 1.0) * len(calset.points)).astype(int))
    arrays = calset.to_arrays()
    return walop.from_arrays(
        **arrays | {name: arrays[name][rows] for name in ("counts", "errors", "x", "y", "source")}
    )


def cube(calset: CalibrationSet) -> np.ndarray:
    """Transmissions (point, exposure, camera)."""
    return calset.intensities.block(0, len(calset.points)).counts


def colours(calset: CalibrationSet) -> np.ndarray:
    """Wavelengths of the filters (um), in order."""
    return np.array(sorted(float(curve.wavelength[0]) for curve in calset.filters.values()))


def measured_matrix(calset: CalibrationSet) -> tuple[np.ndarray, np.ndarray]:
    """m22, m23, m32, m33 (point, wavelength, 4); cos and sin 4 theta in each camera (point, wavelength, camera, 2).

    By least squares on the linear states: the difference of two cameras over the mean of their sum.
    """
    counts, e = cube(calset), calset.exposures
    wavelength = np.array([calset.filters[name].wavelength[0] for name in e.filter])
    found, fourth = [], []
    for colour in colours(calset):
        rows = np.flatnonzero((wavelength == colour) & e.clp_in)
        theta = np.deg2rad(e.clp_angle[rows])
        waves = [
            np.ones_like(theta),
            np.cos(2 * theta),
            np.sin(2 * theta),
            np.cos(4 * theta),
            np.sin(4 * theta),
        ]
        data = counts[:, rows].swapaxes(0, 1).reshape(len(rows), -1)

        def harmonics(n, waves=waves, data=data):
            solution = np.linalg.lstsq(np.stack(waves[:n], axis=1), data)[0]
            return np.moveaxis(solution.reshape(n, len(counts), -1), 0, -1)

        three, five = harmonics(3), harmonics(5)
        arms = [
            (three[:, a, 1:] - three[:, b, 1:]) / (three[:, a, :1] + three[:, b, :1])
            for a, b in ((0, 1), (2, 3))
        ]
        found.append(np.concatenate(arms, axis=-1))
        fourth.append(five[..., 3:] / five[..., :1])
    return np.stack(found, axis=1), np.stack(fourth, axis=1)


def calibration_of(result: FitResult) -> walop.Calibration:
    """The calibration of a fit, whatever it leaves: that is what the notebook is about."""
    return walop.Calibration.from_fit(result.with_verdict())


def predicted_matrix(calibration, x, y, wavelengths):
    """The same four elements from a calibration, and their standard errors."""
    values, errors = [], []
    for wavelength in wavelengths:
        settings = Settings.default(len(x), f"MONO-{1e4 * wavelength:.0f}")
        matrix, covariance = calibration.matrix(x, y, settings)
        values.append(matrix[:, [1, 2, 4, 5]])
        errors.append(np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))[:, [1, 2, 4, 5]])
    return np.stack(values, axis=1), np.stack(errors, axis=1)


def shares_left(result) -> float:
    """Rms of what a fit leaves of the transmissions, in units of the light of an arm at that point and wavelength."""
    likelihood = result.likelihood
    _, residual = likelihood.residuals(result.values)
    counts, weight = (likelihood.points.gathered(name) for name in ("counts", "weight"))
    left = np.where(weight > 0, residual / np.where(weight > 0, weight, 1.0), 0.0)
    arm = np.repeat(counts.reshape(*counts.shape[:2], 2, 2).sum(axis=-1), 2, axis=-1)
    return float(np.sqrt(np.mean((left / arm)[likelihood.used] ** 2)))


def part(
    calset: CalibrationSet, points: np.ndarray | None = None, wavelength: float | None = None
) -> CalibrationSet:
    """The set without the points where `points` is False, or without a wavelength (um)."""
    rows = calset.intensities
    used = np.ones(len(rows.point), bool)
    if points is not None:
        used &= points[rows.point]
    if wavelength is not None:
        of_exposure = np.array([calset.filters[name].wavelength[0] for name in calset.exposures.filter])
        used &= of_exposure[rows.exposure] != wavelength
    return dataclasses.replace(calset, intensities=rows.using(used))


def described(folder: str | Path, *, plate_in: bool, frame: str) -> Path:
    """A description file of the instrument with these choices."""
    path = Path(folder) / f"north_{frame}_{'in' if plate_in else 'out'}.toml"
    path.write_text(NOMINAL.format(plate_in=str(plate_in).lower(), frame=frame))
    return path
