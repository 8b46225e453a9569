"""Thresholds by which calibrations and calibrated stars are judged."""

from __future__ import annotations

GOAL = 0.001
"""Error of p that instruments are built for."""

SMALLEST_DETERMINANT = 0.1
"""|m22 m33 − m23 m32| below which a single exposure carries almost no information on u."""
