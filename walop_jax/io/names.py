"""Names of the files that a folder of results may hold, and of what is in no file."""

from __future__ import annotations

IN_MEMORY = "in memory"  # in place of the path of a file
PRODUCT, MODEL = "calibration.fits", "model.toml"
SUMMARY, FAILED, CLIPPED = "summary.json", "summary.failed.json", "clipped.ecsv"
DIAGNOSIS, FIGURE_DATA = "diagnosis.json", "diagnosis.fits"
POSTERIOR, CORNER, SAMPLE = "posterior.nc", "posterior_corner.png", "sample.json"
COMPARISON, EPOCH = "comparison.json", "epoch.json"
LIMITS, COMMISSIONING = "limits.json", "commissioning.json"
PLANNED, WATCHED, SURVEY, AFFECTED = "plan.json", "watch.json", "survey.json", "affected.json"
NIGHTS, REFERENCE, TRACKS = "nights.fits", "reference.fits", "tracks.fits"

_JSON = (
    SUMMARY, DIAGNOSIS, SAMPLE, COMPARISON, EPOCH, LIMITS, COMMISSIONING, PLANNED, SURVEY, WATCHED, AFFECTED,
)  # fmt: skip
DOCUMENTS = {file.removesuffix(".json"): file for file in _JSON}
"""Files of the documents of commands, by the name of the document."""
