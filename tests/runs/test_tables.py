"""`tabulate_matrix` and `apply_to_catalogue`: tables in, tables out, as the commands do it."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table

from walop_jax.calibration.product import write_product
from walop_jax.fit.verdict import Quality
from walop_jax.io.errors import DataError
from walop_jax.model.specification import effect_context, with_effects
from walop_jax.model.trace import Sightline
from walop_jax.runs.apply import apply_to_catalogue
from walop_jax.runs.matrix import tabulate_matrix
from walop_jax.runs.trace import trace_source

from .conftest import FittedSet, assert_same_files

POINTS = "X,Y\n0,0\n0.2,-0.1\n0.33,0\n"


@pytest.fixture
def points(tmp_path: Path) -> Path:
    path = tmp_path / "points.csv"
    path.write_text(POINTS)
    return path


@pytest.fixture
def catalogue(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    counts = rng.normal(1e6, 1e3, (6, 4))
    counts[0] = 0.0
    x, y = rng.uniform(-0.2, 0.2, (2, 6))
    table = Table({"ID": np.arange(6), "X": x, "Y": y, "N": counts, "N_ERR": np.full((6, 4), 1e3)})
    table.write(tmp_path / "stars.fits")
    return tmp_path / "stars.fits"


def folders(tmp_path: Path) -> tuple[Path, Path]:
    for name in ("command", "caller"):
        (tmp_path / name).mkdir()
    return tmp_path / "command", tmp_path / "caller"


def test_a_table_of_matrices(call, fitted: FittedSet, points: Path, tmp_path: Path):
    command, caller = folders(tmp_path)
    told: list[str] = []
    assert call("matrix", fitted.run, "--points", points, "-o", command / "o.fits").exit_code == 0
    found = tabulate_matrix(fitted.run, points, caller / "o.fits", progress=told.append)
    assert_same_files(command, caller)
    assert told
    assert (found.rows, found.trusted, found.flags[Quality.BEYOND_FIELD]) == (3, True, 1)
    assert "points.csv: 1 point(s) beyond the calibrated field" in found.warnings[0]
    assert found.product == fitted.calibration.to_product().content_hash()
    values, covariance = fitted.calibration.matrix(np.array([0.0, 0.2, 0.33]), np.array([0.0, -0.1, 0.0]))
    table = Table.read(caller / "o.fits")
    np.testing.assert_allclose(table["M32"], values[:, 4], rtol=0, atol=1e-12)
    np.testing.assert_allclose(table["M32_ERR"], np.sqrt(covariance[:, 4, 4]), rtol=1e-9)


def test_a_catalogue(call, fitted: FittedSet, catalogue: Path, tmp_path: Path):
    command, caller = folders(tmp_path)
    told: list[str] = []
    result = call("apply", fitted.run, catalogue, "-o", command / "o.fits", "--debias", "WK")
    assert result.exit_code == 0
    found = apply_to_catalogue(fitted.run, catalogue, caller / "o.fits", estimator="WK", progress=told.append)
    assert_same_files(command, caller)
    assert "6 of 6 rows" in told
    assert (found.rows, found.stars, found.flags[Quality.NO_STOKES]) == (6, 6, 1)
    assert "1 star(s) without a result" in found.warnings[0]
    assert found.document()["flags"]["16384"] == 1


@pytest.fixture
def drifting(fitted: FittedSet, tmp_path: Path) -> Path:
    """The folder of a run whose model has a drift of single exposures, at the values of the fit."""
    old = fitted.calibration
    context = effect_context(old.model.template, old.exposures)
    model = with_effects(old.model, ["camera_gain_drift"], context)
    place = np.array([model.index(name) for name in old.model.names])
    values, covariance = model.start.copy(), np.zeros((len(model.names),) * 2)
    values[place], covariance[np.ix_(place, place)] = old.values, old.covariance
    changed = dataclasses.replace(old, model=model, values=values, covariance=covariance)
    (tmp_path / "RUN").mkdir()
    write_product(tmp_path / "RUN" / "calibration.fits", changed.to_product())
    return tmp_path / "RUN"


@pytest.mark.long
def test_effects_that_cannot_be_carried_over_are_named(
    call, fitted: FittedSet, drifting: Path, points: Path, catalogue: Path, tmp_path: Path
):
    """In a warning, in the document and in the header; the rest is what it is without them."""
    for function, source in ((tabulate_matrix, points), (apply_to_catalogue, catalogue)):
        found = function(drifting, source, tmp_path / "o.fits", overwrite=True)
        plain = function(fitted.run, source, tmp_path / "plain.fits", overwrite=True)
        assert found.not_carried_over == ("camera_gain_drift",)
        assert found.document()["not_carried_over"] == ["camera_gain_drift"]
        assert any("camera_gain_drift" in sentence and "left out" in sentence for sentence in found.warnings)
        assert plain.document()["not_carried_over"] == []
        one, other = Table.read(tmp_path / "o.fits"), Table.read(tmp_path / "plain.fits")
        assert one.meta["NOTCARR"] == "camera_gain_drift"
        assert "NOTCARR" not in other.meta
        name = "M22" if function is tabulate_matrix else "Q"
        np.testing.assert_allclose(one[name], other[name], rtol=0, atol=1e-12)
    traced = trace_source(Sightline(), drifting)
    assert traced.document()["not_carried_over"] == ["camera_gain_drift"]
    result = call("trace", drifting, "--json")
    assert "camera_gain_drift" in result.stderr
    assert json.loads(result.stdout)["not_carried_over"] == ["camera_gain_drift"]


def test_what_cannot_be_is_said_before_any_work(fitted: FittedSet, catalogue: Path, tmp_path: Path):
    with pytest.raises(ValueError, match="'MLE' is neither MAS nor WK"):
        apply_to_catalogue(tmp_path / "none.fits", catalogue, tmp_path / "o.fits", estimator="MLE")
    with pytest.raises(ValueError, match="above 0"):
        apply_to_catalogue(tmp_path / "none.fits", catalogue, tmp_path / "o.fits", saturation=-1.0)
    with pytest.raises(DataError, match="no such file"):
        apply_to_catalogue(tmp_path / "none.fits", catalogue, tmp_path / "o.fits")
    with pytest.raises(DataError, match="no such file"):
        tabulate_matrix(fitted.run / "other.fits", catalogue, tmp_path / "o.fits")


def test_a_filter_that_the_calibration_does_not_cover_is_refused_unless_forced(
    call, fitted: FittedSet, catalogue: Path, tmp_path: Path
):
    """The curve of a second filter is in the product, but none of its exposures was taken in it."""
    curves = {"r2": fitted.calibration.filter_curve("SDSS-r"), **fitted.calibration.filters}
    wider = dataclasses.replace(fitted.calibration, filters=curves)
    write_product(tmp_path / "calibration.fits", wider.to_product())
    table = Table.read(catalogue)
    table["FILTER"] = np.where(np.arange(6) == 3, "r2", "SDSS-r")
    table.write(other := tmp_path / "other.fits")
    arguments = ("apply", tmp_path, other, "-o", tmp_path / "o.fits")
    refused = call(*arguments)
    assert refused.exit_code == 1
    assert (
        "other.fits: FILTER: row 3 (counted from 0): r2; the calibration was made in SDSS-r" in refused.stderr
    )
    assert not (tmp_path / "o.fits").exists()
    forced = call(*arguments, "--force")
    assert forced.exit_code == 0, forced.stderr
    flag = Table.read(tmp_path / "o.fits")["FLAG"]
    both = int(Quality.VALIDITY_FORCED | Quality.BEYOND_SETTINGS)
    assert (flag & both).tolist() == [0, 0, 0, both, 0, 0]


@pytest.mark.parametrize("command", ["matrix", "apply"])
def test_an_output_stays_as_it_is(fitted: FittedSet, points: Path, catalogue: Path, tmp_path: Path, command):
    function, source = (tabulate_matrix, points) if command == "matrix" else (apply_to_catalogue, catalogue)
    output = tmp_path / "out" / "o.ecsv"
    output.parent.mkdir()
    output.write_text("mine")
    with pytest.raises(DataError, match="exists already"):
        function(fitted.run, source, output)
    assert output.read_text() == "mine"
    function(fitted.run, source, output, overwrite=True)
    assert len(Table.read(output)) > 0


@pytest.mark.parametrize("error", [OSError("No space left on device"), KeyboardInterrupt()])
def test_nothing_is_half_written(
    fitted: FittedSet, points: Path, catalogue: Path, tmp_path: Path, monkeypatch, error
):
    def half(self: Table, path: Path, **options: object) -> None:
        Path(path).write_text("X,Y\n0.0")
        raise error

    monkeypatch.setattr(Table, "write", half)
    before = sorted(tmp_path.iterdir())
    for function, source in ((tabulate_matrix, points), (apply_to_catalogue, catalogue)):
        with pytest.raises(type(error) if isinstance(error, KeyboardInterrupt) else DataError):
            function(fitted.run, source, tmp_path / "o.csv")
        assert sorted(tmp_path.iterdir()) == before
