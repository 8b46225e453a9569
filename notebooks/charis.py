"""What a user of a polarimeter of his own writes: an importer of his table, and the yardstick he is used to."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import tables
from astropy.table import Table
from scipy.optimize import least_squares
from tables import bench_set

from walop_jax import CalibrationSet, FilterCurve

RESOLUTION = 19.0  # λ/FWHM of the low-resolution mode: wider than the step between bins


def bin_curve(number: int, centre: float) -> FilterCurve:
    """A bin as a Gaussian band of the resolution of the spectrograph."""
    sigma = centre / RESOLUTION / 2.3548
    wavelength = centre + sigma * np.linspace(-3.0, 3.0, 61)
    return FilterCurve(f"BIN{number:02d}", wavelength, np.exp(-0.5 * ((wavelength - centre) / sigma) ** 2))


def charis_set(table: Table | str | Path, floor: float = 1e-3, mjd: float = 60000.0) -> CalibrationSet:
    """The table (BIN, WAVELENGTH um, HWP_ANGLE deg, ROTATOR_ANGLE deg, N, N_ERR) as one field point that sees lamps.

    `floor`, a share of the mean of the two beams, is added to the photon errors in quadrature: what is left of the best
    models is 30 times larger than photon noise and the same in all bins, photon noise is not.
    """
    rows = table if isinstance(table, Table) else Table.read(table, format="ascii.ecsv")
    counts, photon = np.asarray(rows["N"], float), np.asarray(rows["N_ERR"], float)
    bins, first = np.unique(rows["BIN"], return_index=True)
    curves = [
        bin_curve(int(b), float(w)) for b, w in zip(bins, np.asarray(rows["WAVELENGTH"])[first], strict=True)
    ]
    moving = {"HWP": np.asarray(rows["HWP_ANGLE"], float), "DEROT": np.asarray(rows["ROTATOR_ANGLE"], float)}
    return bench_set(
        "CHARIS-INTERNAL", "measured; public repository UCSB-Exoplanet-Polarimetry-Lab/pyPolCal", "lamp", curves,
        np.searchsorted(bins, rows["BIN"]), counts, np.hypot(photon, floor * counts.mean(axis=1, keepdims=True)),
        moving, polariser=np.zeros(len(rows)), mjd=mjd,
    )  # fmt: skip


def asymmetry(left, right):
    """(N0 - N1)/(N0 + N1)."""
    return (left - right) / (left + right)


def left_over(result, values=None):
    """Measured minus predicted (N0 - N1)/(N0 + N1), bin by plate angle by derotator angle (bins, 8, 8).

    `values` are those of another fit of the same model, e.g. to a part of the set.
    """
    counts = result.likelihood.points.gathered("counts")[0]
    model = counts - tables.left_over(result, values)
    return (asymmetry(*counts.T) - asymmetry(*model.T)).reshape(-1, 8, 8)


def bin_by_bin(measured, plate, derotator, left_out=None, ratio=False):
    """The yardstick: two retardances, three angles and an efficiency for each bin, fitted by least squares.

    `measured` is (N0 - N1)/(N0 + N1) of one bin (8, 8), the angles in degrees; `left_out` is a column of it that is
    predicted only. `ratio`: the beams may have a ratio as well, which is fairer. Returns measured minus predicted.
    """
    h, d = np.meshgrid(np.deg2rad(plate), np.deg2rad(derotator), indexing="ij")
    used = np.arange(8) != (-1 if left_out is None else left_out)

    def retarded(q, u, v, delta, axis):
        c, s = np.cos(2 * axis), np.sin(2 * axis)
        along, across = c * q + s * u, c * u - s * q
        across, v = np.cos(delta) * across + np.sin(delta) * v, np.cos(delta) * v - np.sin(delta) * across
        return c * along - s * across, s * along + c * across, v

    def off(p):
        light = retarded(np.cos(2 * p[4]), np.sin(2 * p[4]), 0.0, p[0], h + p[2])
        expected = p[5] * retarded(*light, p[1], d + p[3])[0]
        return measured - (expected + p[6]) / (1.0 + p[6] * expected) if ratio else measured - expected

    starts = [
        (plates, turn, 0.0, 0.0, 0.0, 1.0, *((0.0,) if ratio else ()))
        for plates in (2.95, 3.35)
        for turn in (0.5, 1.5, 2.5, 3.2, 4.0, 5.0)
    ]
    fits = [least_squares(lambda p: off(p)[:, used].ravel(), start, method="lm") for start in starts]
    return off(min(fits, key=lambda fit: fit.cost).x)
