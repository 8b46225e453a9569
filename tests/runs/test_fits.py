"""`refit_sets`, `diagnose_sets`, `compare_methods`: calibration sets in, the folder of a run out."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from walop_jax.calibration.product import read_product
from walop_jax.io.errors import DataError
from walop_jax.reports.run import read_run
from walop_jax.runs import compare, diagnose, refit

from .conftest import FittedSet, assert_same_files

OUTPUTS = {
    refit.refit_sets: refit.OUTPUTS,
    diagnose.diagnose_sets: diagnose.OUTPUTS,
    compare.compare_methods: compare.OUTPUTS,
}


def fail(*args: object, **more: object) -> None:
    raise OSError("No space left on device")


@pytest.mark.long
def test_a_fit(call, fitted: FittedSet, tmp_path: Path, monkeypatch):
    told: list[str] = []
    found = refit.refit_sets([fitted.calset], tmp_path / "caller", progress=told.append)
    assert told[0] == "reading"
    assert told[-1] == "mapping the field"
    assert (found.residuals, found.misfit, found.warnings) == (None, None, ())
    np.testing.assert_allclose(found.result.values, fitted.calibration.values, rtol=1e-12)
    assert call("refit", fitted.calset, "-o", tmp_path / "command", "-q").exit_code == 0
    assert_same_files(tmp_path / "command", tmp_path / "caller")

    monkeypatch.setattr(refit, "refit", lambda *args, **more: found.result)
    monkeypatch.setattr(refit, "write_product", fail)
    with pytest.raises(DataError, match="what was there is untouched"):
        refit.refit_sets([fitted.calset], tmp_path / "other")
    assert not (tmp_path / "other").exists()


@pytest.mark.long
def test_a_diagnosis(spoilt: Path, tmp_path: Path, monkeypatch):
    told: list[str] = []
    found = diagnose.diagnose_sets([spoilt], tmp_path / "caller", seed=3, progress=told.append)
    assert told[0] == "reading"
    assert told[-1] == "mapping the field"
    assert [step.effect for step in found.diagnosis.steps] == ["clp_wobble"]
    written = read_run(tmp_path / "caller")
    assert written.missing == ()
    assert written.diagnosis == json.loads(json.dumps(found.document))
    again = refit.refit_sets([spoilt], tmp_path / "again", model=tmp_path / "caller" / diagnose.MODEL)
    assert again.result.model.effect_names == ("clp_wobble",)
    np.testing.assert_allclose(again.result.chi2, found.diagnosis.after.chi2, rtol=1e-6)
    assert written.summary["seed"] == 3
    assert read_product(tmp_path / "caller" / "calibration.fits").verdict.trusted

    monkeypatch.setattr(diagnose, "diagnose", lambda *args, **more: found.diagnosis)
    monkeypatch.setattr(diagnose, "write_figure_data", fail)
    with pytest.raises(DataError, match="what was there is untouched"):
        diagnose.diagnose_sets([spoilt], tmp_path / "other")
    assert not (tmp_path / "other").exists()


@pytest.mark.long
def test_a_diagnosis_is_that_of_the_command(call, spoilt: Path, tmp_path: Path):
    diagnose.diagnose_sets([spoilt], tmp_path / "caller", seed=3)
    assert call("diagnose", spoilt, "-o", tmp_path / "command", "--seed", 3, "-q").exit_code == 0
    assert_same_files(tmp_path / "command", tmp_path / "caller")


@pytest.mark.long  # tests/paper runs the command as well
def test_a_comparison(call, fitted: FittedSet, tmp_path: Path, monkeypatch):
    told: list[str] = []
    found = compare.compare_methods([fitted.calset], tmp_path / "caller", seed=3, progress=told.append)
    assert told[0] == "reading"
    assert told[-1] == "fitting and judging the polynomials"
    assert found.warnings == ()
    assert (
        json.loads((tmp_path / "caller" / "comparison.json").read_text())["joint_errors_from"] == "covariance"
    )
    assert call("compare", fitted.calset, "-o", tmp_path / "command", "--seed", 3, "-q").exit_code == 0
    assert_same_files(tmp_path / "command", tmp_path / "caller")

    monkeypatch.setattr(compare, "compare", lambda *args, **more: found.comparison)
    monkeypatch.setattr(compare, "write_output_table", fail)
    with pytest.raises(DataError, match="what was there is untouched"):
        compare.compare_methods([fitted.calset], tmp_path / "other")
    assert not (tmp_path / "other").exists()


@pytest.mark.parametrize("function", OUTPUTS)
def test_results_are_left_alone(fitted: FittedSet, tmp_path: Path, function):
    output = OUTPUTS[function][-1]
    (tmp_path / output).write_text("mine")
    with pytest.raises(DataError, match=f"holds {output} already"):
        function([fitted.calset], tmp_path)
    with pytest.raises(DataError, match=r"m\.toml: there is no such file"):
        function([fitted.calset], tmp_path, model=tmp_path / "m.toml")
    assert [entry.read_text() for entry in tmp_path.iterdir()] == ["mine"]


@pytest.mark.parametrize("function", OUTPUTS)
def test_errors_name_the_file(fitted: FittedSet, tmp_path: Path, function):
    (tmp_path / "m.toml").write_text('[model]\neffects = ["clp_woble"]\n')
    with pytest.raises(ValueError, match=r"m\.toml: .*clp_wobble"):
        function([fitted.calset], tmp_path / "RUN", model=tmp_path / "m.toml")
    with pytest.raises(DataError, match="no such file"):
        function([tmp_path / "none.fits"], tmp_path / "RUN")
    assert [entry.name for entry in tmp_path.iterdir()] == ["m.toml"]
