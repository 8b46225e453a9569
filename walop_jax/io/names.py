"""Names of the files that a folder of results may hold, and of what is in no file."""

from __future__ import annotations

IN_MEMORY = "in memory"  # in place of the path of a file
PRODUCT, MODEL = "calibration.fits", "model.toml"
SUMMARY, FAILED, CLIPPED = "summary.json", "summary.failed.json", "clipped.ecsv"
DIAGNOSIS, FIGURE_DATA = "diagnosis.json", "diagnosis.fits"
POSTERIOR, CORNER, SAMPLE = "posterior.nc", "posterior_corner.png", "sample.json"
COMPARISON, LIMITS, CHECK = "comparison.json", "limits.json", "check.json"
PLANNED, SURVEY = "plan.json", "survey.json"
WATCH_TABLE, WATCH_FIGURE, QUALITY_FIGURE = "watch.fits", "watch.png", "quality.png"
NIGHTS, REFERENCE, TRACKS = "nights.fits", "reference.fits", "tracks.fits"

_JSON = (SUMMARY, DIAGNOSIS, SAMPLE, COMPARISON, CHECK, LIMITS, PLANNED, SURVEY)
DOCUMENTS = {file.removesuffix(".json"): file for file in _JSON}
"""Files of the documents of commands, by the name of the document."""
