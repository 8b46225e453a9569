"""The measured table as a calibration set: what the notebook does, in a form that tests can call."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from astropy.table import Table

from walop_jax.data.records import CalibrationSet, Exposures, FilterCurve, Points, Position, Site, Sources
from walop_jax.data.table_intensities import TableIntensities

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
    n, no = len(rows), np.full(len(rows), np.nan)
    bins, first = np.unique(rows["BIN"], return_index=True)
    curves = [
        bin_curve(int(b), float(w)) for b, w in zip(bins, np.asarray(rows["WAVELENGTH"])[first], strict=True)
    ]
    place = {int(b): curve.name for b, curve in zip(bins, curves, strict=True)}
    always = np.ones(n, bool)
    exposures = Exposures(
        exposure=np.arange(n),
        kind=np.full(n, "lamp"),
        mjd=np.full(n, mjd),
        exptime=np.full(n, 1.0),
        filter=np.array([place[int(b)] for b in rows["BIN"]]),
        clp_in=always,
        clp_angle=np.zeros(n),
        chwp_in=~always,
        chwp_angle=no,
        temp=no,
        ha=no,
        ra=no,
        dec=no,
        rotator=no,
        teff=no,
        moving={
            "HWP": Position(always, np.asarray(rows["HWP_ANGLE"], float)),
            "DEROT": Position(always, np.asarray(rows["ROTATOR_ANGLE"], float)),
        },
    )
    points = Points(np.array([0]), np.zeros(1), np.zeros(1))
    none = np.zeros(0)
    return CalibrationSet(
        instrument="CHARIS-INTERNAL",
        site=Site("", np.nan, np.nan, np.nan),
        origin="measured; public repository UCSB-Exoplanet-Polarimetry-Lab/pyPolCal",
        exposures=exposures,
        points=points,
        sources=Sources(np.zeros(0, int), np.zeros(0, str), none, none, none, none, none),
        filters={curve.name: curve for curve in curves},
        intensities=TableIntensities(
            n,
            points,
            exposure=np.arange(n),
            point=np.zeros(n, int),
            source=np.full(n, -1),
            counts=counts,
            sigma=np.hypot(photon, floor * counts.mean(axis=1, keepdims=True)),
            flag=np.zeros(n, int),
            used=always,
        ),
    )
