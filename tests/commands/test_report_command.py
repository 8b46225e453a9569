"""`walop-jax report`, run in this process."""

from __future__ import annotations

import json

import handmade_run
import pytest
from command import one_line


def test_page_appears_in_the_run_and_replaces_nothing_but_itself(call, tmp_path):
    folder = handmade_run.make_refit(tmp_path / "run")
    assert "report.html" in call("report", folder).stdout
    first = (folder / "report.html").read_text()
    assert first.startswith("<!DOCTYPE html>")
    assert call("report", folder, "--quiet").output == ""  # its own page is made anew
    (folder / "report.html").write_text("a letter")
    assert "exists already" in one_line(call("report", folder))
    assert call("report", folder, "--overwrite", "--quiet").output == ""
    assert sorted(entry.name for entry in folder.iterdir()) == [
        "calibration.fits", "report.html", "summary.json",
    ]  # fmt: skip


def test_page_goes_where_it_is_asked_to(call, tmp_path):
    folder = handmade_run.make_refit(tmp_path / "run")
    told = json.loads(call("report", folder, "-o", tmp_path / "page.html", "--json").stdout)
    assert told["page"] == str(tmp_path / "page.html")
    assert told["bytes"] == (tmp_path / "page.html").stat().st_size
    residuals, accuracy = told["missing"]
    assert residuals.startswith("Residuals are not drawn: night.fits")
    assert "copy it into the folder of the run" in residuals
    assert accuracy.startswith("The figure accuracy is not drawn")
    assert not (folder / "report.html").exists()


@pytest.mark.parametrize("name", ["nothing", "empty", "file"])
def test_what_is_no_run_is_refused_with_advice(call, tmp_path, name):
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("")
    assert "give the RUN of walop-jax refit or diagnose" in one_line(call("report", tmp_path / name))
