"""`refit` from Python: a fit of whole frames, its progress, and an end before its time."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import pytest
from frame_run import raster
from frames_file import write_frames

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.product import read_calibration
from walop_jax.calibration.residual_map import residual_map
from walop_jax.commands.refit import next_steps, refit
from walop_jax.fit import search
from walop_jax.likelihood import limits, runner
from walop_jax.simulation.observing_plan import ObservingPlan, polariser_turn
from walop_jax.simulation.simulate import simulate

from .conftest import FittedSet

SIDE = 40
PLAN = ObservingPlan(
    grid=SIDE, standard_grid=1, standards=0, unpolarised=0, moon_patches=2, polariser_angles=polariser_turn(6)
)  # fmt: skip


class StopError(Exception):
    pass


@pytest.fixture(scope="module")
def frames(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("frames") / "frames.fits"
    write_frames(path, simulate(PLAN, seed=6).calset, raster(PLAN, SIDE), dtype="f8")
    return path


@pytest.fixture
def large(monkeypatch):
    """Every set is handled like one of many points, 64 of them at a time, and all of these are told of."""
    for name, value in (("INTERPOLATE_ABOVE", 512), ("LARGE_ABOVE", 0), ("LARGE_BATCH", 64), ("SAMPLE", 256)):
        monkeypatch.setattr(limits, name, value)
    monkeypatch.setattr(runner, "TOLD_EVERY", -1.0)


@pytest.mark.long
def test_an_interrupted_run_leaves_nothing(frames, large, tmp_path):
    """Stopped in the middle of the first pass over all points."""
    told: list[str] = []

    def stop(text: str) -> None:
        told.append(text)
        if f" of {SIDE**2:,} points" in text:
            raise StopError

    with pytest.raises(StopError):
        refit(frames, output=tmp_path / "RUN", progress=stop)
    assert told[0] == "reading"
    assert told[1].startswith("preparing the fit")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.long
def test_the_map_of_a_caller_is_that_of_the_run(frames, large, tmp_path):
    run = refit(frames, output=tmp_path / "run")
    assert run.converged
    product = Calibration.from_fit(run, residual_map(run))
    assert (
        product.content_hash()
        == read_calibration(tmp_path / "run" / "calibration.fits", any_model=True).content_hash()
    )


def test_what_a_small_fit_tells(fitted: FittedSet, tmp_path):
    told: list[str] = []
    refit(fitted.calset, output=tmp_path / "RUN", seed=5, progress=told.append)
    assert told[0] == "reading"
    assert told[-2].startswith("looking for patterns in the residuals")
    assert told[-1] == "mapping the field"
    assert any(line.startswith("fit: step") for line in told)
    assert json.loads((tmp_path / "RUN" / "summary.json").read_text())["seed"] == 5


def test_a_fit_that_does_not_converge_leaves_no_calibration(fitted: FittedSet, call, tmp_path, monkeypatch):
    def short(*arguments, **options):
        return search_on(*arguments, **(options | {"maximum_steps": 1}))

    search_on = search.minimise
    monkeypatch.setattr(search, "minimise", short)
    asked = call("refit", fitted.calset, "-o", tmp_path / "RUN", "--json")
    assert asked.exit_code == 1
    assert "did not converge" in asked.stderr
    assert json.loads(asked.stdout)["converged"] is False
    assert [entry.name for entry in (tmp_path / "RUN").iterdir()] == ["summary.failed.json"]
    assert json.loads((tmp_path / "RUN" / "summary.failed.json").read_text())["misfit"] is not None
    monkeypatch.undo()
    # What the residuals say takes most of the time of a fit, and is of no concern here.
    monkeypatch.setattr(
        "walop_jax.diagnosis.trust.examined", lambda result, *arguments: result.with_verdict()
    )
    refit(fitted.calset, output=tmp_path / "RUN")
    assert sorted(entry.name for entry in (tmp_path / "RUN").iterdir()) == [
        "calibration.fits",
        "summary.json",
    ]


def test_lines_to_type_can_be_typed_whatever_a_folder_is_called(tmp_path):
    """A shell takes paths with blanks as one word each."""
    sets, run = [str(tmp_path / "first night.fits"), str(tmp_path / "b.fits")], tmp_path / "my run"
    report, diagnose = map(shlex.split, next_steps(False, run, sets, model=Path("a model.toml")))
    assert report == ["walop-jax", "report", str(run)]
    asked = [*sets, "--model", "a model.toml", "-o", f"{run}_diagnosis"]
    assert diagnose == ["walop-jax", "diagnose", *asked]
    assert shlex.split(next_steps(True, run, sets)[1])[:3] == ["walop-jax", "apply", str(run)]
