"""Colour temperatures of stars from the colour BP − RP of Gaia.

    5040 K / T = b₀ + b₁ C + b₂ C²        C = BP − RP, [Fe/H] = 0

Source      Mucciarelli, Bellazzini & Massari 2021, A&A 653, A90, table 1: dwarfs (0.39 < C < 1.50, scatter 61 K) and
            giants (0.33 < C < 1.81, scatter 83 K), Gaia EDR3.
Here        The mean of both in the range of both: a catalogue of a field says not which a star is. The error holds the
            larger scatter, half their difference, and the error of C.
Reddening   C is taken as observed. T stands for the slope of the spectrum that arrives at the instrument, and dust
            makes a spectrum in a red filter look like that of a cooler star.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from walop_jax.calibration.analysis_vectors import COLOURS, colour_weights

DWARFS, GIANTS = (0.4929, 0.5092, -0.0353), (0.5323, 0.4775, -0.0344)
LIMITS = (0.39, 1.50)
SCATTER = 83.0  # K
COLOUR_ERROR = 0.02  # mag, where a catalogue says nothing of it
SOURCE = "Mucciarelli et al. 2021"
COOL, HOT = 3500.0, 10000.0
"""Colour temperatures (K) between which 95 % of the stars without TEFF are taken to lie, normal in 1/T."""
_MOST_OF_TEFF = 0.5  # error of a TEFF, relative, that is propagated


def temperature(colour: Float[np.ndarray, " n"], kind: tuple[float, float, float]) -> Float[np.ndarray, " n"]:
    """Temperature (K) of stars of one kind, `DWARFS` or `GIANTS`, from BP − RP (mag)."""
    return 5040.0 / np.polynomial.polynomial.polyval(colour, kind)


def temperature_of(
    colour: Float[np.ndarray, " n"], error: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Temperature and standard error (K) from BP − RP and its error (mag; NaN: `COLOUR_ERROR`); NaN beyond `LIMITS`."""
    inside = (colour >= LIMITS[0]) & (colour <= LIMITS[1])
    colour = np.where(inside, colour, np.nan)
    error = np.where(np.isfinite(error), error, COLOUR_ERROR)
    dwarf, giant = temperature(colour, DWARFS), temperature(colour, GIANTS)
    mean = 0.5 * (dwarf + giant)
    slope = (temperature(colour + 0.01, DWARFS) - temperature(colour - 0.01, DWARFS)) / 0.02
    return mean, np.sqrt(SCATTER**2 + (0.5 * (dwarf - giant)) ** 2 + (slope * error) ** 2)


def ignored_colour(teff: Float[np.ndarray, " r"]) -> Float[np.ndarray, "r c"]:
    """Mixture of spectra that is the error of ignoring the colour (see `Stars.colour`)."""
    flat = colour_weights(np.full(len(teff), np.nan), COLOURS)
    half = 0.5 * np.subtract(*colour_weights(np.array([COOL, HOT]), COLOURS))
    return np.where(np.isnan(teff)[:, None], half, flat - colour_weights(teff, COLOURS))


def unsure_colour(
    teff: Float[np.ndarray, " r"], error: Float[np.ndarray, " r"]
) -> tuple[Float[np.ndarray, "r c"], Float[np.ndarray, "r c"]]:
    """Mixtures of spectra: mean of the possible colours of a star less the assumed one, and their deviation.

    The effect of the colour is close to linear in 1/T, in which `COOL` and `HOT` lie two deviations from the mean of
    the stars without TEFF, and in which a TEFF (K) has its `error`, (1/T) · error/T.
    """
    unknown, share = np.isnan(teff)[:, None], np.minimum(error / teff, _MOST_OF_TEFF)
    hot, cool = colour_weights(np.array([HOT, COOL]), COLOURS)
    flat = colour_weights(np.array([np.nan]), COLOURS)[0]
    warmer, cooler = (colour_weights(teff / (1.0 + sign * share), COLOURS) for sign in (-1.0, 1.0))
    deviation = np.where(unknown, 0.25 * (cool - hot), 0.5 * (cooler - warmer))
    return np.where(unknown, 0.5 * (hot + cool) - flat, 0.0), deviation
