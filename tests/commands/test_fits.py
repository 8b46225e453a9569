"""`refit`, `diagnose`, `compare` with an output: calibration sets in, the folder of a run out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import walop_jax as walop
from walop_jax.calibration.product import read_calibration
from walop_jax.commands import diagnose
from walop_jax.io.errors import DataError
from walop_jax.reports.run import read_run

from .conftest import FittedSet

OUTPUTS = {
    "refit": ("calibration.fits", "summary.json"),
    "diagnose": walop.diagnose.command.writes,
    "compare": walop.compare.command.writes,
    "limits": ("limits.json", "limits_separation.png"),
}


def fail(*args: object, **more: object) -> None:
    raise OSError("No space left on device")


@pytest.mark.long
def test_a_diagnosis(call, spoilt_file: Path, tmp_path: Path, monkeypatch):
    told: list[str] = []
    found = walop.diagnose(spoilt_file, output=tmp_path / "caller", seed=3, progress=told.append)
    assert told[0] == "reading"
    assert told[-1] == "mapping the field"
    stages = [line.stage for line in told if hasattr(line, "stage")]
    assert list(dict.fromkeys(stages)) == list(walop.diagnose.command.stages)
    assert [step.effect for step in found.steps] == ["clp_wobble"]
    written = read_run(tmp_path / "caller")
    assert written.missing == ()
    again = walop.refit(spoilt_file, tmp_path / "caller" / diagnose.MODEL)
    assert again.model.effect_names == ("clp_wobble",)
    np.testing.assert_allclose(again.chi2, found.after.chi2, rtol=1e-6)
    assert written.summary["seed"] == 3
    assert read_calibration(tmp_path / "caller" / "calibration.fits", any_model=True).verdict.trusted

    monkeypatch.setattr("walop_jax.diagnosis.workflow.diagnose", lambda *args, **more: found)
    monkeypatch.setattr("walop_jax.diagnosis.figure_data.write_figure_data", fail)
    with pytest.raises(DataError, match="the old content is untouched"):
        walop.diagnose(spoilt_file, output=tmp_path / "other")
    assert not (tmp_path / "other").exists()


@pytest.mark.parametrize("name", OUTPUTS)
def test_results_are_left_alone(fitted: FittedSet, tmp_path: Path, name: str):
    output, function = OUTPUTS[name][-1], getattr(walop, name)
    (tmp_path / output).write_text("mine")
    with pytest.raises(DataError, match=f"holds {output} already"):
        function(fitted.calset, output=tmp_path)
    assert [entry.read_text() for entry in tmp_path.iterdir()] == ["mine"]


@pytest.mark.parametrize("name", OUTPUTS)
def test_errors_name_the_file(fitted: FittedSet, tmp_path: Path, name: str):
    function = getattr(walop, name)
    (tmp_path / "m.toml").write_text('[model]\neffects = ["clp_woble"]\n')
    with pytest.raises(ValueError, match=r"m\.toml: .*clp_wobble"):
        function(fitted.calset, output=tmp_path / "RUN", model=tmp_path / "m.toml")
    with pytest.raises(DataError, match=r"n\.toml: there is no such file"):
        function(fitted.calset, output=tmp_path / "RUN", model=tmp_path / "n.toml")
    with pytest.raises(DataError, match="no such file"):
        function(tmp_path / "none.fits", output=tmp_path / "RUN")
    assert [entry.name for entry in tmp_path.iterdir()] == ["m.toml"]


def test_a_run_is_made_from_files(fitted: FittedSet, tmp_path: Path):
    calset = walop.read(fitted.calset)
    with pytest.raises(ValueError, match="give model and instrument as files"):
        walop.refit(calset, walop.base_model(calset), output=tmp_path / "RUN")
