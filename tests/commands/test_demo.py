"""`demo`: the set that comes with the package, its fit and its page, against the truth that the set was made from."""

from __future__ import annotations

import json
from pathlib import Path

import walop_jax as walop

TRUTH = Path(__file__).resolve().parents[2] / "fits_data/walop_south_small_truth.json"


def test_the_demonstration_runs(tmp_path: Path):
    fit = walop.demo(output=tmp_path / "demo")
    assert fit.trusted
    assert "median error for p" in (tmp_path / "demo/RUN/report.html").read_text()
    truth = json.loads(TRUTH.read_text())["parameters"]["pupil.magnification"]["value"]
    found = fit["pupil.magnification"]
    assert abs(found.value - truth) < 4 * found.sigma
    again = walop.Run(tmp_path / "demo/RUN")
    assert "p of a star" in repr(again)
    assert len(repr(again).splitlines()) <= 25
    # Runs are found from any folder, and the data beside them.
    assert walop.plot(again, "residuals") is not None
