"""Additions of `walop-jax apply` to a catalogue: columns, one value per row, and the cards of the header."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from walop_jax.science.apply import COOL, HOT, Stars
from walop_jax.science.catalogue_check import CatalogueCheck
from walop_jax.science.polarisation import polarisation

Columns = dict[str, tuple[np.ndarray, str, str]]  # values, description, unit


def stokes_columns(stars: Stars, star: Int[np.ndarray, " n"], estimator: str) -> Columns:
    """The columns added to a catalogue (docs: files); all rows of a star hold the result of the star.

    Raises ValueError for an unknown `estimator` of the degree of polarisation.
    """
    covariance = stars.covariance
    light = polarisation(stars.qu, covariance, estimator)
    error = np.sqrt(np.einsum("sii->si", covariance))
    photon = np.sqrt(np.einsum("sii->si", stars.photon))

    def pair(end: str, values: Float[np.ndarray, "s 2"], about: str) -> dict[str, tuple[np.ndarray, str]]:
        return {f"{name}{end}": (values[:, k], about.format(name)) for k, name in enumerate("QU")}

    columns = {
        "Q": (stars.qu[:, 0], "q of the star: on the sky where ROTATOR is given"),
        "U": (stars.qu[:, 1], "u of the star: on the sky where ROTATOR is given"),
        **pair("_ERR", error, "standard error of {}: photons, calibration, colour"),
        "QU_COV": (covariance[:, 0, 1], "covariance of Q and U"),
        "QU_PHOTON": (stars.photon[:, 0, 1], "the share of the photons in QU_COV"),
        "P": (light.degree, "degree of polarisation"),
        "P_DEBIASED": (light.debiased, f"degree of polarisation without its bias, {estimator}"),
        "P_ERR": (light.degree_error, "standard error of P"),
        "EVPA": (light.angle, "electric vector angle: north to east, or from +X"),
        "EVPA_ERR": (light.angle_error, "standard error of EVPA"),
        **pair("_PHOTON", photon, "the share of the photons in {}_ERR"),
        **pair("_COLOUR", stars.colour, "error of {} if TEFF is ignored"),
        **pair(
            "_HIDDEN", stars.hidden, "largest shift of {} by a mistake that calibration data would not show"
        ),
        "CHI2": (stars.chi2, "chi squared of the rows of the star"),
        "DOF": (stars.dof.astype(np.int32), "degrees of freedom of CHI2"),
        "NROWS": (stars.rows.astype(np.int32), "rows that were combined"),
        "FLAG": (stars.flag.astype(np.int32), "quality bits, 0 is good"),
    }
    if stars.sky_bound is not None:
        columns["SKY_BOUND"] = (
            stars.sky_bound,
            "largest shift of Q, U by sky left over that is not excluded",
        )
    units = {"EVPA": "deg", "EVPA_ERR": "deg"}
    return {name: (values[star], about, units.get(name, "")) for name, (values, about) in columns.items()}


def header(product: str, estimator: str, on_sky: float, check: CatalogueCheck) -> dict[str, Any]:
    """Cards of the output: the calibration (hash of its content), estimator, frame, colours, and the check."""
    frame = {0.0: "instrument", 1.0: "sky"}.get(on_sky, "sky where ROTATOR is given, else instrument")
    factors = np.sqrt(check.scale)
    return {
        "CALHASH": product,
        "PESTIM": "Plaszczynski et al. 2014" if estimator == "MAS" else "Wardle and Kronberg 1974",
        "QUFRAME": frame,
        "POLCCONV": "IAU",
        "TIMESYS": "UTC",
        "COLOURS": f"without TEFF: half the difference of {COOL:g} and {HOT:g} K",
        "HOLDS": check.holds,
        "CHI2DOF": round(check.noise, 6),
        "PHOTFAC1": round(float(factors[0]), 6),
        "PHOTFAC2": round(float(factors[1]), 6),
    }
