"""Synthetic calibration sets that carry their truth: what is observed, an as-built instrument, noise."""
