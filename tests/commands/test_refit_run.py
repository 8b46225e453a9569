"""`refit` from Python: a fit of whole frames, interrupted and taken up again."""

from __future__ import annotations

import dataclasses
import itertools
import json
from pathlib import Path

import numpy as np
import pytest
from frames_file import write_frames

from walop_jax.calibration import read_calibration
from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.residual_map import residual_map
from walop_jax.commands.refit import refit
from walop_jax.data import Grid, read_calibration_set
from walop_jax.data.records import CalibrationSet, Intensities
from walop_jax.fit import search
from walop_jax.likelihood import limits, runner
from walop_jax.likelihood.runner import fingerprint
from walop_jax.simulation.observing_plan import ObservingPlan, polariser_turn
from walop_jax.simulation.simulate import simulate

from .conftest import FittedSet, assert_same_files

SIDE = 40
PLAN = ObservingPlan(
    grid=SIDE, standard_grid=1, standards=0, unpolarised=0, moon_patches=2, polariser_angles=polariser_turn(6)
)  # fmt: skip
MATRIX = "χ², gradient and matrix"


class StopError(Exception):
    pass


@pytest.fixture(scope="module")
def frames(tmp_path_factory) -> Path:
    step = 2 * PLAN.field / (SIDE - 1)
    grid = Grid(SIDE, SIDE, (1.0, 1.0), (-PLAN.field, -PLAN.field), ((step, 0.0), (0.0, step)))
    path = tmp_path_factory.mktemp("frames") / "frames.fits"
    write_frames(path, simulate(PLAN, seed=6).calset, grid, dtype="f8")
    return path


@pytest.fixture
def large(monkeypatch):
    """Every set is handled like whole frames, in slabs of 64 points, and every slab is told of."""
    for name, value in (("INTERPOLATE_ABOVE", 512), ("LARGE_ABOVE", 0), ("LARGE_CHUNK", 64), ("SAMPLE", 256)):
        monkeypatch.setattr(limits, name, value)
    monkeypatch.setattr(runner, "TOLD_EVERY", -1.0)


class Interrupting:
    """Listens, and stops the fit at the line of that number of the passes with the matrix over all points."""

    def __init__(self, at: int) -> None:
        self.at, self.told = at, []

    def __call__(self, text: str) -> None:
        self.told.append(text)
        if sum(line.startswith(MATRIX) and f"of {SIDE**2:,}" in line for line in self.told) == self.at:
            raise StopError


@pytest.mark.long
def test_a_run_that_is_interrupted_goes_on_where_it_was(frames, large, tmp_path):
    whole = refit(frames, output=tmp_path / "whole")
    assert whole.converged
    assert read_calibration(tmp_path / "whole" / "calibration.fits", rebuild=False).residuals is not None
    stop = Interrupting(12)
    with pytest.raises(StopError):
        refit(frames, output=tmp_path / "cut", progress=stop)
    assert stop.told[0] == "reading"
    assert stop.told[1].startswith("preparing the fit")
    assert [entry.name for entry in (tmp_path / "cut").iterdir()] == ["partial"]
    told: list[str] = []
    again = refit(frames, output=tmp_path / "cut", progress=told.append)
    # The sample is not fitted a second time, and the slabs that were done are not done again.
    assert not any(line.startswith("fit: ") for line in told)
    passes = [line for line in told if "points/s" in line]
    first = list(itertools.takewhile(lambda line: line.startswith(MATRIX), passes))
    assert len(first) == SIDE**2 // 64 - 12
    assert first[0].startswith(f"{MATRIX}: 832 of 1,600 points")
    assert told[-1] == "mapping the field"
    np.testing.assert_array_equal(again.values, whole.values)
    assert_same_files(tmp_path / "cut", tmp_path / "whole")
    assert not (tmp_path / "cut" / "partial").exists()


@pytest.mark.long
def test_a_fit_in_python_is_resumed_as_well(frames, large, tmp_path):
    calset = read_calibration_set(frames)
    folder, stop = tmp_path / "kept", Interrupting(3)
    with pytest.raises(StopError):
        refit(calset, folder=folder, progress=stop)
    result = refit(calset, folder=folder)
    told: list[str] = []
    again = refit(calset, folder=folder, progress=told.append)
    assert not any("points/s" in line for line in told)  # nothing is computed a third time
    np.testing.assert_array_equal(again.values, result.values)
    np.testing.assert_array_equal(again.covariance, result.covariance)
    assert again.posterior.census.field == result.posterior.census.field
    # Another model, or other data, are another fit.
    for other in (dataclasses.replace(calset, intensities=Doubled(calset.intensities)), calset):
        model = (
            result.model if other is not calset else result.model.change("pupil.magnification", free=False)
        )
        with pytest.raises(StopError):
            refit(other, model, folder=folder, progress=Interrupting(1))


class Doubled(Intensities):
    """Twice the electrons."""

    def __init__(self, inner: Intensities) -> None:
        self.inner = inner

    def block(self, start: int, stop: int):
        block = self.inner.block(start, stop)
        return dataclasses.replace(block, counts=2.0 * block.counts)


@pytest.mark.long
def test_the_map_of_a_caller_is_that_of_the_run(frames, large, tmp_path):
    run = refit(frames, output=tmp_path / "run")
    product = Calibration.from_fit(run, residual_map(run))
    assert (
        product.content_hash()
        == read_calibration(tmp_path / "run" / "calibration.fits", rebuild=False).content_hash()
    )


def test_what_a_small_fit_tells(fitted: FittedSet, tmp_path):
    told: list[str] = []
    refit(fitted.calset, output=tmp_path / "RUN", progress=told.append)
    assert told[0] == "reading"
    assert told[-2].startswith("looking for patterns in the residuals")
    assert told[-1] == "mapping the field"
    assert any(line.startswith("fit: step") for line in told)
    assert json.loads((tmp_path / "RUN" / "summary.json").read_text())["seed"] == 0


def test_two_folders_are_one_too_many(fitted: FittedSet, tmp_path):
    """`folder` was dropped in silence."""
    with pytest.raises(ValueError, match="leave folder out"):
        refit(fitted.calset, output=tmp_path / "RUN", folder=tmp_path / "kept")


def test_a_fit_that_does_not_converge_leaves_no_calibration(fitted: FittedSet, call, tmp_path, monkeypatch):
    def short(*arguments, **options):
        return search_on(*arguments, **(options | {"maximum_steps": 1}))

    search_on = search.minimise
    monkeypatch.setattr(search, "minimise", short)
    asked = call("refit", fitted.calset, "-o", tmp_path / "RUN", "--json")
    assert "did not converge" in asked.stderr
    assert json.loads(asked.stdout)["converged"] is False
    assert [entry.name for entry in (tmp_path / "RUN").iterdir()] == ["summary.failed.json"]
    assert json.loads((tmp_path / "RUN" / "summary.failed.json").read_text())["misfit"] is not None
    monkeypatch.undo()
    refit(fitted.calset, output=tmp_path / "RUN")
    assert sorted(entry.name for entry in (tmp_path / "RUN").iterdir()) == [
        "calibration.fits",
        "summary.json",
    ]


def changed(calset: CalibrationSet, what: str) -> CalibrationSet:
    """The set with something else in it."""
    if what == "files":
        entry = dataclasses.replace(calset.inputs[0], sha256="0" * 64)
        return dataclasses.replace(calset, inputs=(entry,))
    if what == "measurements":
        return dataclasses.replace(calset, intensities=Doubled(calset.intensities))
    exposures = dataclasses.replace(calset.exposures, clp_angle=calset.exposures.clp_angle + 1e-9)
    return dataclasses.replace(calset, exposures=exposures)


def test_a_set_is_known_by_what_is_in_it(frames):
    calset = read_calibration_set(frames)
    known = fingerprint(calset)
    assert fingerprint(read_calibration_set(frames)) == known
    for what in ("files", "measurements", "exposures"):
        assert fingerprint(changed(calset, what)) != known, what
    # Without files it is known by every measurement: also by one that no sample holds.
    made = dataclasses.replace(calset, inputs=())

    class Last(Intensities):
        def block(self, start, stop):
            block = calset.intensities.block(start, stop)
            counts = block.counts.copy()
            counts[-1, -1, -1] += stop == SIDE**2
            return dataclasses.replace(block, counts=counts)

    assert fingerprint(dataclasses.replace(made, intensities=Last())) != fingerprint(made)
