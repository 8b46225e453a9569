"""Calibrations: an instrument as fitted, its files, and its matrix anywhere in the field."""
