"""Synthetic calibration sets that carry their truth: plans, an as-built instrument, noise."""
