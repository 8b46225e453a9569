"""Calibrations: what a fit has learnt of an instrument, its files, and its matrix anywhere in the field."""
