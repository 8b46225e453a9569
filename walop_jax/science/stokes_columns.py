"""Additions of `walop-jax apply` to a catalogue: columns, one value per row, cards of the header, and warnings."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from walop_jax.fit.verdict import Quality, Verdict
from walop_jax.io.text import in_ascii
from walop_jax.model.instrument import Instrument
from walop_jax.science.apply import Stars
from walop_jax.science.catalogue import Catalogue
from walop_jax.science.colours import COOL, HOT
from walop_jax.science.overlaps import extents
from walop_jax.science.polarisation import polarisation
from walop_jax.science.star_words import CatalogueCheck

FEW = 0.5  # of the rows
APART = 0.005  # deg: rows of one star that lie farther apart may be those of two
StokesColumns = dict[str, tuple[np.ndarray, str, str]]  # values, description, unit


def stokes_columns(stars: Stars, star: Int[np.ndarray, " n"], estimator: str) -> StokesColumns:
    """Columns added to a catalogue (docs: files), of stars in all their rows; ValueError for an unknown `estimator`."""
    covariance = stars.covariance
    light = polarisation(stars.qu, covariance, estimator)
    error = np.sqrt(np.einsum("sii->si", covariance))
    photon = np.sqrt(np.einsum("sii->si", stars.photon))

    def pair(end: str, values: Float[np.ndarray, "s 2"], about: str) -> dict[str, tuple[np.ndarray, str]]:
        return {f"{name}{end}": (values[:, k], about.format(name)) for k, name in enumerate("QU")}

    hidden = "largest shift of {} by a systematic error that calibration data would not show"
    columns = {
        "Q": (stars.qu[:, 0], "q of the star: on the sky where ROTATOR is given"),
        "U": (stars.qu[:, 1], "u of the star: on the sky where ROTATOR is given"),
        **pair("_ERR", error, "standard error of {}: photons, calibration, colour"),
        "QU_COV": (covariance[:, 0, 1], "covariance of Q and U"),
        "QU_PHOTON": (stars.photon[:, 0, 1], "the part of the photons in QU_COV"),
        "P": (light.degree, "degree of polarisation"),
        "P_DEBIASED": (light.debiased, f"degree of polarisation without its bias, {estimator}"),
        "P_ERR": (light.degree_error, "standard error of P"),
        "EVPA": (light.angle, "electric vector angle: north to east, or from +X"),
        "EVPA_ERR": (light.angle_error, "standard error of EVPA"),
        **pair("_PHOTON", photon, "the part of the photons in {}_ERR"),
        **pair("_COLOUR", stars.colour, "error of {} if TEFF is ignored"),
        **pair("_HIDDEN", stars.hidden, hidden),
        "CHI2": (stars.chi2, "chi squared of the rows of the star"),
        "DOF": (stars.dof.astype(np.int32), "degrees of freedom of CHI2"),
        "NROWS": (stars.rows.astype(np.int32), "rows that were combined"),
        "FLAG": (stars.flag.astype(np.int32), "quality bits, 0 is good"),
    }
    if stars.sky_bound is not None:
        about = "largest shift of Q, U by sky left over that is not excluded"
        columns["SKY_BOUND"] = (stars.sky_bound, about)
    units = {"EVPA": "deg", "EVPA_ERR": "deg"}
    return {name: (values[star], about, units.get(name, "")) for name, (values, about) in columns.items()}


def header(
    product: str, estimator: str, on_sky: float, check: CatalogueCheck, verdict: Verdict
) -> dict[str, Any]:
    """Cards of the output: the calibration (hash of its content), estimator, frame, colours, check and verdict."""
    frame = {0.0: "instrument", 1.0: "sky"}.get(on_sky, "sky where ROTATOR is given, else instrument")
    factors = np.sqrt(check.scale)
    return {
        "CALHASH": product,
        "PESTIM": "Plaszczynski et al. 2014" if estimator == "MAS" else "Wardle and Kronberg 1974",
        "QUFRAME": frame,
        "POLCCONV": "IAU",
        "TIMESYS": "UTC",
        "COLOURS": f"without TEFF: half the difference of {COOL:g} and {HOT:g} K",
        "TRUSTED": verdict.trusted,
        **({"DOUBT": in_ascii(verdict.objections[0])} if verdict.objections else {}),
        "HOLDS": check.holds,
        "CHI2DOF": round(check.noise, 6),
        "PHOTFAC1": round(float(factors[0]), 6),
        "PHOTFAC2": round(float(factors[1]), 6),
    }


def sentences(rows: Catalogue, stars: Stars, names: Sequence[str]) -> Iterator[str]:
    """Warnings about some rows of a catalogue: cameras that are hardly used, rows of other stars."""
    yield from about_cameras(rows.counts, names)
    if number := int(((extents(rows) > APART) & (stars.flag & Quality.DISAGREES > 0)).sum()):
        yield f"{number} of the stars that disagree have rows at different places: is their ID that of one star?"


def about_cameras(counts: Float[np.ndarray, "r k"], names: Sequence[str]) -> Iterator[str]:
    """Warnings about cameras that are hardly used."""
    used = np.isfinite(counts)
    if not used.any():
        yield "no row has a camera that is used: N is negative, flagged, saturated or NaN"
    for name, of_camera in zip(names, used.T, strict=True):
        if used.any() and of_camera.mean() < FEW:
            what = "N is negative, flagged, saturated or NaN in the others"
            yield f"{name} is used in {int(of_camera.sum())} of {len(counts)} rows: {what}"


def counted_flags(rows: Catalogue, instrument: Instrument) -> dict[Quality, str]:
    """The bits of FLAG that are counted, with their warnings."""
    alone = len(np.unique(rows.star)) == len(rows.star) and len(instrument.arms) == 1
    settings = ": with one arm a star needs rows at several settings, of one ID" if alone else ""
    quiet = (Quality.HIGH_CROSSTALK, Quality.CAMERA_MISSING, Quality.SATURATED, Quality.VALIDITY_FORCED)
    return dict.fromkeys((*quiet, Quality.UNKNOWN_COLOUR), "") | {
        Quality.NO_STOKES: f"star(s) without a result (FLAG 16384){settings}",
        Quality.BEYOND_FIELD: "star(s) beyond the calibrated field: extrapolated, or NaN (FLAG 32)",
        Quality.BEYOND_SETTINGS: "star(s) with a filter, temperature or TEFF beyond the calibration",
        Quality.DISAGREES: "star(s) whose intensities disagree with the calibration (FLAG 131072, CHI2): is "
        "the background subtracted, are the cameras in order?",
        Quality.PLACE: "star(s) at a place of the field where stars disagree with the calibration together "
        "(FLAG 1048576): their errors are enlarged",
        Quality.OTHER_FRAME: "star(s) without ROTATOR, in the frame of the instrument (FLAG 2097152)",
        Quality.REPEATED: "star(s) with the place and counts of another star or setting (FLAG 4194304)",
    }


def errors_in_words(columns: Mapping[str, tuple[Any, ...]]) -> str:
    """The median error of p, and how much of it is noise of photons."""
    error, q, u, *photons = (columns[name][0] for name in ("P_ERR", "Q_ERR", "U_ERR", "Q_PHOTON", "U_PHOTON"))
    measured = error > 0
    if not measured.any():
        return "not known: no star has a result"
    share = sum(values[measured] ** 2 for values in photons) / (q[measured] ** 2 + u[measured] ** 2)
    typical, part = (100 * float(np.median(values)) for values in (error[measured], share))
    return f"error {typical:.2g} % (median), photons make {part:.0f} % of its variance"
