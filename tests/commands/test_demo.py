"""`demo`: the set that comes with the package, its fit and its page, against the truth that the set was made from."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

import walop_jax as walop

TRUTH = Path(__file__).resolve().parents[2] / "fits_data/walop_south_small_truth.json"


def test_the_demonstration_runs(tmp_path: Path):
    fit = walop.demo(output=tmp_path / "demo")
    assert fit.trusted
    assert "median error for p" in (tmp_path / "demo/RUN/report.html").read_text()
    truth = json.loads(TRUTH.read_text())["parameters"]["pupil.magnification"]["value"]
    found = fit["pupil.magnification"]
    assert abs(found.value - truth) < 4 * found.sigma
    # The stars are those of another hand: the true instrument made them, the fit corrects them.
    stars, true = (
        walop.apply(tmp_path / "demo/RUN", tmp_path / "demo/stars.fits"),
        json.loads((tmp_path / "demo/stars_truth.json").read_text()),
    )
    pull = (np.asarray(stars["U"]) - true["stars"]["u"]) / np.asarray(stars["U_ERR"])
    assert len(pull) == 200
    assert 0.85 < np.sqrt(np.mean(pull**2)) < 1.15
    assert (tmp_path / "demo/stars_corrected.fits").exists()
    again = walop.Run(tmp_path / "demo/RUN")
    assert "p of a star" in repr(again)
    assert len(repr(again).splitlines()) <= 25
    # Runs are found from any folder, and the data beside them.
    assert walop.plot(again, "residuals") is not None
