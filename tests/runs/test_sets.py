"""`simulate_set`, `import_folder`, `inspect_sets`, `write_model`: calibration sets and models, made and looked at."""

from __future__ import annotations

import dataclasses
import json
import tomllib
from pathlib import Path

import pytest
from zemax_exports import write_folder

import walop_jax.data.write
from walop_jax.data import read_calibration_set
from walop_jax.io.errors import DataError
from walop_jax.runs.import_zemax import import_folder
from walop_jax.runs.inspect import inspect_sets
from walop_jax.runs.model import write_model
from walop_jax.runs.simulate import simulate_set
from walop_jax.simulation.effect_text import effect_from_text
from walop_jax.simulation.observing_plan import ObservingPlan, polariser_turn

from .conftest import FittedSet, assert_same_files

SMALL = ("--grid", 3, "--standard-grid", 1, "--angles", 4, "--moon-patches", 2, "--standards", 3)
PLAN = ObservingPlan(grid=3, standard_grid=1, polariser_angles=polariser_turn(4), moon_patches=2, standards=3)
WOBBLE = "clp_wobble=amplitude:0.06,phase:1.1"


def folders(tmp_path: Path) -> tuple[Path, Path]:
    for name in ("command", "caller"):
        (tmp_path / name).mkdir()
    return tmp_path / "command", tmp_path / "caller"


def test_a_simulated_set(call, tmp_path: Path):
    command, caller = folders(tmp_path)
    told: list[str] = []
    options = (*SMALL, "--effect", WOBBLE, "--seed", 3, "--truth", command / "truth.json")
    assert call("simulate", "-o", command / "set.fits", *options).exit_code == 0
    found = simulate_set(
        caller / "set.fits",
        PLAN,
        seed=3,
        effects=[effect_from_text(WOBBLE, PLAN.context())],
        truth=caller / "truth.json",
        progress=told.append,
    )
    assert_same_files(command, caller)
    assert told
    # 4 polariser angles and 2 Moon patches at 9 points, 3 standards at one place.
    assert (found.points, found.exposures, found.rows) == (10, 9, 57)
    assert found.effects == ("clp_wobble",)
    assert json.loads((caller / "truth.json").read_text())["parameters"]["clp_wobble.phase"]["value"] == 1.1


@pytest.mark.parametrize("name", ["set.fits", "truth.json"])
def test_what_exists_is_not_simulated_over(tmp_path: Path, name: str):
    (tmp_path / name).write_text("mine")
    with pytest.raises(DataError, match="exists already"):
        simulate_set(tmp_path / "set.fits", PLAN, truth=tmp_path / "truth.json")
    assert [entry.read_text() for entry in tmp_path.iterdir()] == ["mine"]


@pytest.mark.parametrize("error", [OSError("No space left on device"), KeyboardInterrupt()])
def test_neither_set_nor_truth_after_an_exception(tmp_path: Path, monkeypatch, error):
    def half(hdus: object, path: Path) -> None:
        path.write_bytes(b"SIMPLE  =")
        raise error

    monkeypatch.setattr(walop_jax.data.write, "sign_and_write", half)
    with pytest.raises(type(error) if isinstance(error, KeyboardInterrupt) else DataError):
        simulate_set(tmp_path / "set.fits", PLAN, truth=tmp_path / "truth.json")
    assert list(tmp_path.iterdir()) == []


def test_an_imported_set(call, tmp_path: Path):
    exports = write_folder(tmp_path / "exports")
    (exports / "Config_2" / "transmission_field1_pol3.txt").unlink()
    command, caller = folders(tmp_path)
    told: list[str] = []
    assert call("import-zemax", exports, "-o", command / "design.fits", "--error", 0.01).exit_code == 0
    found = import_folder(exports, caller / "design.fits", error=0.01, progress=told.append)
    assert_same_files(command, caller)
    assert "writing" in told
    assert len(told) > 1
    assert (found.instrument, found.wavelengths, found.rows) == ("WALOP-NORTH", (0.54, 0.66), 30)
    assert found.document() == {
        "output": str(caller / "design.fits"),
        "instrument": "WALOP-NORTH",
        "wavelengths": [0.54, 0.66],
        "exposures": found.exposures,
        "points": 3,
        "rows": 30,
        "remarks": list(found.remarks),
    }
    with pytest.raises(DataError, match="exists already"):
        import_folder(exports, caller / "design.fits")
    with pytest.raises(ValueError, match="not a share"):
        import_folder(exports, caller / "other.fits", error=-1.0)


def test_an_import_that_fails_leaves_nothing(tmp_path: Path, monkeypatch):
    def half(hdus: object, path: Path) -> None:
        path.write_bytes(b"SIMPLE  =")
        raise OSError("No space left on device")

    exports = write_folder(tmp_path / "exports")
    monkeypatch.setattr(walop_jax.data.write, "sign_and_write", half)
    with pytest.raises(DataError, match="free some space"):
        import_folder(exports, tmp_path / "design.fits")
    assert [entry.name for entry in tmp_path.iterdir()] == ["exports"]


def test_sets_are_inspected_one_by_one_and_as_one(fitted: FittedSet, tmp_path: Path):
    other = tmp_path / "other.fits"
    simulate_set(other, dataclasses.replace(PLAN, standards=0), seed=1)
    told = []
    found = inspect_sets([fitted.calset, other], progress=told.append)
    assert found.joint is not None
    assert told == [*(entry for _, entry in found.sets), found.joint]
    assert found.joint.rows == sum(
        read_calibration_set(path).intensities.rows for path in (fitted.calset, other)
    )
    assert found.faults == ()
    broken = inspect_sets([fitted.calset, tmp_path / "none.fits"])
    assert broken.joint is None
    assert "no such file" in broken.faults[0]
    assert "no such file" in broken.document()["sets"][1]["error"]


def test_a_model_file(call, fitted: FittedSet, tmp_path: Path):
    command, caller = folders(tmp_path)
    call("model", fitted.calset, "--effect", "clp_zero", "-o", command / "m.toml")
    found = write_model(caller / "m.toml", [fitted.calset], effects=["clp_zero"])
    assert_same_files(command, caller)
    assert tomllib.loads((caller / "m.toml").read_text())["model"]["effects"] == ["clp_zero"]
    assert found.document()["effects"] == ["clp_zero"]
    assert write_model(calsets=[fitted.calset], effects=["clp_zero"]).text == found.text
    with pytest.raises(DataError, match="exists already"):
        write_model(caller / "m.toml")
    with pytest.raises(ValueError, match="come from WALOP-SOUTH"):
        write_model(calsets=[fitted.calset], instrument="WALOP-NORTH")
