"""What a run is good for afterwards: checked, held against new data, reported, traced, cited."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

import walop_jax.runs.epoch
import walop_jax.runs.report
from walop_jax.calibration.product import read_product, write_product
from walop_jax.data import builtin_filter
from walop_jax.data.settings import Settings
from walop_jax.io.errors import DataError
from walop_jax.model.trace import Sightline, trace
from walop_jax.runs.certify import certify_product
from walop_jax.runs.cite import cite_run
from walop_jax.runs.epoch import compare_epochs
from walop_jax.runs.report import write_report
from walop_jax.runs.trace import trace_source

from .conftest import FittedSet


def test_a_certificate_is_that_of_the_command(call, fitted: FittedSet):
    found = certify_product(fitted.run)
    assert found.failed == ()
    assert found.parents == tuple(entry.sha256 for entry in fitted.calibration.inputs)
    assert json.loads(call("certify", fitted.run, "--json").stdout) == json.loads(
        json.dumps(found.document())
    )


def test_a_certificate_fails_closed(fitted: FittedSet, tmp_path: Path):
    product = read_product(fitted.run / "calibration.fits")
    changed = dataclasses.replace(product.maps, values=product.maps.values + 1e-3)
    write_product(tmp_path / "c.fits", dataclasses.replace(product, maps=changed))
    found = certify_product(tmp_path / "c.fits")
    assert [check.name for check in found.failed] == ["maps"]
    assert found.document()["valid"] is False


def test_epochs_of_one_and_the_same_set(call, fitted: FittedSet, tmp_path: Path):
    told: list[str] = []
    found = compare_epochs(fitted.run, [fitted.calset], output=tmp_path / "EPOCH", progress=told.append)
    assert told
    # The same data: the same minimum.
    assert found.found.fits
    assert max(abs(entry.new - entry.old) / entry.error for entry in found.found.moved) < 1e-3
    assert found.new == tuple(entry.sha256 for entry in fitted.calibration.inputs)
    told_by_command = json.loads(call("epoch", fitted.run, fitted.calset, "--json").stdout)
    assert told_by_command == json.loads(json.dumps(found.document()))
    assert json.loads((tmp_path / "EPOCH" / "epoch.json").read_text())["fits"] is True
    assert write_report(tmp_path / "EPOCH").missing == ()
    assert "still fits" in (tmp_path / "EPOCH" / "report.html").read_text()
    with pytest.raises(DataError, match="no such file"):
        compare_epochs(fitted.run / "other.fits", [fitted.calset])


def test_what_a_new_fit_lacks_is_looked_for_without_trying_other_readings_again(
    fitted: FittedSet, monkeypatch
):
    asked: dict[str, object] = {}
    monkeypatch.setattr(walop_jax.runs.epoch, "examined", lambda result: result.judged(["odd"]))
    monkeypatch.setattr(walop_jax.runs.epoch, "diagnose", lambda *_, **how: asked.update(how))
    assert not compare_epochs(fitted.run, [fitted.calset]).found.holds
    assert asked["as_written"] is True


@pytest.mark.long  # tests/cli makes the page as well
def test_a_report(call, fitted: FittedSet, tmp_path: Path):
    told: list[str] = []
    found = write_report(fitted.run, tmp_path / "page.html", progress=told.append)
    assert call("report", fitted.run, "-o", tmp_path / "command.html").exit_code == 0
    assert (tmp_path / "page.html").read_bytes() == (tmp_path / "command.html").read_bytes()
    assert told == ["reading", "working out the accuracy of p", "drawing"]
    assert "Accuracy of p over the field" in (tmp_path / "page.html").read_text()
    assert found.length == (tmp_path / "page.html").stat().st_size
    assert "walop-jax diagnose" in found.missing[0]
    write_report(fitted.run, tmp_path / "page.html")  # its own page is made anew
    (tmp_path / "page.html").write_text("a letter")
    with pytest.raises(DataError, match="exists already"):
        write_report(fitted.run, tmp_path / "page.html")


def test_a_report_that_fails_leaves_the_old_one(fitted: FittedSet, tmp_path: Path, monkeypatch):
    (tmp_path / "page.html").write_text("old")

    def half(path: Path, *args: object, **options: object) -> int:
        path.write_bytes(b"<!DOCTYPE")
        raise OSError("No space left on device")

    monkeypatch.setattr(walop_jax.runs.report, "render", lambda *args: "<!DOCTYPE html>")
    monkeypatch.setattr(Path, "write_text", half)
    with pytest.raises(DataError, match="what stood there before is untouched"):
        write_report(fitted.run, tmp_path / "page.html", overwrite=True)
    assert [(entry.name, entry.read_text()) for entry in tmp_path.iterdir()] == [("page.html", "old")]


def test_light_is_traced_through_what_was_fitted(fitted: FittedSet):
    sun = dataclasses.replace(Settings.default(1), teff=np.array([5772.0]))
    ray = Sightline(x=0.2, y=-0.1, q=0.03, u=0.01, setting=sun)
    curve = builtin_filter("SDSS-r")
    expected = trace(fitted.calibration.model.instrument(fitted.calibration.values), curve, ray)
    np.testing.assert_allclose(trace_source(ray, fitted.run).stages[-1].value, expected[-1].value, rtol=1e-12)
    designed = trace_source(ray, instrument="walop-south").stages
    assert np.abs(designed[-1].value - expected[-1].value).max() > 1e-4
    with pytest.raises(ValueError, match="WALOP-SOUTH"):
        trace_source(ray, instrument="WALOP-SUOTH")
    with pytest.raises(DataError, match="SDSS-rr"):
        trace_source(Sightline(setting=Settings.default(1, "SDSS-rr")), fitted.run)


def test_the_base_model_and_a_run_have_the_same_sources(fitted: FittedSet):
    assert cite_run() == cite_run(fitted.run) == cite_run(fitted.run / "calibration.fits")
    assert any("Yeh 1980" in entry.source for entry in cite_run())
