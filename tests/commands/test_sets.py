"""`simulate`, `inspect`, `model` from Python: calibration sets and models, made and looked at."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

import walop_jax as walop
from walop_jax.io.errors import DataError

from .conftest import FittedSet

SMALL = walop.ObservingPlan(
    grid=3, standard_grid=1, polariser_angles=(0.0, 45.0, 90.0, 135.0), moon_patches=2, standards=3
)
PLAN = """
grid = 3
standard_grid = 1
polariser_angles = 4
moon_patches = 2
standards = 3
"""


def test_an_effect_may_be_a_dict_a_text_or_an_object_and_a_plan_a_file(tmp_path: Path):
    (tmp_path / "plan.toml").write_text(PLAN)
    axis = walop.effect_by_name("hwp1_axis").of(SMALL.context(), angle=0.3)
    sets = [
        walop.simulate(SMALL, seed=3, effect=(axis,)),
        walop.simulate(SMALL, seed=3, effect={"hwp1_axis": 0.3}),
        walop.simulate(tmp_path / "plan.toml", seed=3, effect=["hwp1_axis=0.3"]),
        walop.simulate(SMALL, seed=3, effect="hwp1_axis=0.3"),
    ]
    blocks = [made.calset.intensities.block(0, 10).counts for made in sets]
    for block in blocks[1:]:
        np.testing.assert_array_equal(block, blocks[0])


@pytest.mark.parametrize("name", ["set.fits", "truth.json"])
def test_what_exists_is_not_simulated_over(tmp_path: Path, name: str):
    (tmp_path / name).write_text("mine")
    with pytest.raises(DataError, match="exists already"):
        walop.simulate(SMALL, output=tmp_path / "set.fits", truth=tmp_path / "truth.json")
    assert [entry.read_text() for entry in tmp_path.iterdir()] == ["mine"]


@pytest.mark.parametrize("error", [OSError("No space left on device"), KeyboardInterrupt()])
def test_neither_set_nor_truth_after_an_exception(tmp_path: Path, monkeypatch, error):
    def half(hdus: object, path: Path) -> None:
        path.write_bytes(b"SIMPLE  =")
        raise error

    monkeypatch.setattr("walop_jax.data.write.sign_and_write", half)
    with pytest.raises(type(error) if isinstance(error, KeyboardInterrupt) else DataError):
        walop.simulate(SMALL, output=tmp_path / "set.fits", truth=tmp_path / "truth.json")
    assert list(tmp_path.iterdir()) == []


def test_sets_are_inspected_one_by_one_and_as_one(fitted: FittedSet, tmp_path: Path):
    other = tmp_path / "other.fits"
    walop.simulate(dataclasses.replace(SMALL, standards=0), seed=1, output=other)
    found = walop.inspect([fitted.calset, other])
    assert found.joint is not None
    assert found.joint.rows == sum(walop.read(path).intensities.rows for path in (fitted.calset, other))
    assert found.faults == ()
    assert len(found.inspections) == 3
    broken = walop.inspect([fitted.calset, tmp_path / "none.fits"])
    assert broken.joint is None
    assert "no such file" in broken.faults[0]
    assert "no such file" in broken.document()["sets"][1]["error"]
    in_memory = walop.inspect(walop.read(other))
    assert in_memory.joint is None
    assert in_memory.document()["sets"][0]["points"] == found.document()["sets"][1]["points"]


def test_a_model_in_memory_and_as_a_file(fitted: FittedSet, tmp_path: Path):
    found = walop.model(fitted.calset, effect=["clp_zero"], output=tmp_path / "m.toml")
    assert found.text == (tmp_path / "m.toml").read_text()
    assert found.model.effect_names == ("clp_zero",)
    with pytest.raises(ValueError, match="come from WALOP-SOUTH"):
        walop.model(fitted.calset, instrument="WALOP-NORTH")
