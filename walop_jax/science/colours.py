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

DWARFS, GIANTS = (0.4929, 0.5092, -0.0353), (0.5323, 0.4775, -0.0344)
LIMITS = (0.39, 1.50)
SCATTER = 83.0  # K
COLOUR_ERROR = 0.02  # mag, where a catalogue says nothing of it
SOURCE = "Mucciarelli et al. 2021"


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
