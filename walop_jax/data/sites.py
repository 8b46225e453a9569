"""Where the instruments stand."""

from __future__ import annotations

from collections.abc import Mapping

from walop_jax.data.records import Site

SITES: Mapping[str, Site] = {
    "WALOP-SOUTH": Site("SAAO 1-m", -32.3795, 20.8107, 1798.0),
    "WALOP-NORTH": Site("Skinakas 1.3-m", 35.2120, 24.8982, 1750.0),
    "WALOP-LAB": Site("bench", 18.5590, 73.8250, 560.0),
}
"""Telescope, latitude and longitude (degrees, east positive) and elevation (m) of each instrument."""
