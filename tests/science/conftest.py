"""The small simulated run and its calibration (`small_run.py`) for the tests of this room."""

from small_run import calibration, calset

__all__ = ["calibration", "calset"]
