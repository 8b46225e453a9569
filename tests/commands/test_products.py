"""What a run is good for afterwards: checked, held against new data, reported, traced, cited."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

import walop_jax as walop
from walop_jax.data.settings import Settings, builtin_filter
from walop_jax.io.errors import DataError
from walop_jax.model.trace import Sightline, trace

from .conftest import FittedSet


def test_epochs_of_one_and_the_same_set(fitted: FittedSet, tmp_path: Path):
    answer = walop.check(fitted.run, fitted.calset, output=tmp_path / "EPOCH")
    found = answer["epoch"]
    assert answer.words == "go, with reservations"
    assert answer.reasons[0].what.startswith("these are the data from which the old calibration was made")
    # The same data: the same minimum.
    assert found.fits
    assert max(abs(entry.new - entry.old) / entry.error for entry in found.moved) < 1e-3
    assert found.display().facts == (("old and new", "the same data: nothing can have changed"),)
    document = json.loads((tmp_path / "EPOCH" / "check.json").read_text())["epoch"]
    assert document["fits"] is True
    assert document["new"] == [entry.sha256 for entry in fitted.calibration.inputs]
    assert walop.report(tmp_path / "EPOCH").missing == ()
    assert "go, with reservations" in (tmp_path / "EPOCH" / "report.html").read_text()
    with pytest.raises(DataError, match="no such file"):
        walop.check(fitted.run / "other.fits", fitted.calset)


def test_what_a_new_fit_lacks_is_looked_for_without_trying_other_readings_again(
    call, fitted: FittedSet, monkeypatch
):
    asked: dict[str, object] = {}
    monkeypatch.setattr(
        "walop_jax.diagnosis.trust.examined", lambda result, seed: result.with_verdict(["odd"])
    )
    monkeypatch.setattr("walop_jax.diagnosis.workflow.diagnose", lambda *_, **how: asked.update(how))
    assert call("check", fitted.run, fitted.calset, "--seed", 5).exit_code == 3
    assert asked["as_written"] is True
    assert asked["seed"] == 5


def test_a_report_that_fails_leaves_the_old_one(fitted: FittedSet, tmp_path: Path, monkeypatch):
    (tmp_path / "page.html").write_text("old")

    def half(path: Path, *args: object, **options: object) -> int:
        path.write_bytes(b"<!DOCTYPE")
        raise OSError("No space left on device")

    monkeypatch.setattr("walop_jax.reports.page.render", lambda *args: ("<!DOCTYPE html>", ()))
    monkeypatch.setattr(Path, "write_text", half)
    with pytest.raises(DataError, match="what stood there before is untouched"):
        walop.report(fitted.run, tmp_path / "page.html", overwrite=True)
    assert [(entry.name, entry.read_text()) for entry in tmp_path.iterdir()] == [("page.html", "old")]


def test_light_is_traced_through_what_was_fitted(fitted: FittedSet):
    sun = dataclasses.replace(Settings.default(1), teff=np.array([5772.0]))
    ray = Sightline(x=0.2, y=-0.1, q=0.03, u=0.01, setting=sun)
    curve = builtin_filter("SDSS-r")
    expected = trace(fitted.calibration.model.instrument(fitted.calibration.values), curve, ray)
    star = {"x": 0.2, "y": -0.1, "q": 0.03, "u": 0.01, "teff": 5772.0}
    for found in (walop.trace(fitted.run, **star), walop.trace(calibration=fitted.calibration, **star)):
        np.testing.assert_allclose(found[-1].value, expected[-1].value, rtol=1e-12)
    designed = walop.trace(**star, instrument="walop-south")
    assert np.abs(designed[-1].value - expected[-1].value).max() > 1e-4
    with pytest.raises(ValueError, match="WALOP-SOUTH"):
        walop.trace(instrument="WALOP-SUOTH")
    with pytest.raises(DataError, match="SDSS-rr"):
        walop.trace(fitted.run, filter="SDSS-rr")
