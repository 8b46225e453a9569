"""Figures of a run by name: each is drawn, and shows what it says."""

from __future__ import annotations

import dataclasses
import io
import itertools

import handmade_run
import jax.numpy as jnp
import matplotlib.figure
import numpy as np
import pytest
from matplotlib.text import Text
from own_instrument import OWN
from small_run import SEED, SMALL

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.product import read_calibration, write_calibration
from walop_jax.commands.plot import plot
from walop_jax.data.calset import read_calibration_set
from walop_jax.data.write import write_calibration_set
from walop_jax.diagnosis.figure_data import write_figure_data
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import refit
from walop_jax.io.errors import DataError
from walop_jax.model import mueller
from walop_jax.model.instrument import Instrument
from walop_jax.paper.wavelength import plate_retardances, retardance
from walop_jax.posterior.run import Run
from walop_jax.reports.diagnosis_figures import separation_figure
from walop_jax.reports.figures import matrix_change_figure, planned_figure
from walop_jax.reports.named import FIGURES, draw, possible
from walop_jax.reports.paper_figures import retardance_figure, retardance_wavelength_figure
from walop_jax.reports.posterior_figures import informed
from walop_jax.reports.run import FigureSource
from walop_jax.reports.style import Canvas, element_kind, texts
from walop_jax.simulation.observing_plan import ObservingPlan, polariser_turn
from walop_jax.simulation.simulate import simulate

OF_A_DIAGNOSIS = ("ladder", "effect", "signature", "rms", "shares")
WITHOUT = ("corner", "trace", "residual-map", "protection", "separation", *OF_A_DIAGNOSIS)
"""What this run has not."""


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> FigureSource:
    folder = tmp_path_factory.mktemp("run")
    write_calibration_set(folder / "set.fits", simulate(SMALL, seed=SEED).calset)
    calibration = Calibration.from_fit(refit(read_calibration_set(folder / "set.fits")).with_verdict())
    write_calibration(folder / "calibration.fits", calibration)
    return FigureSource(Run(folder))


@pytest.mark.parametrize("name", [name for name in FIGURES if name not in WITHOUT])
def test_figures_in_a_column_of_print(source, name):
    """89 mm wide as in journals: type of 7 pt, nothing cut off, no titles on each other, maps with one frame."""
    figure = draw(name, dataclasses.replace(source, canvas=Canvas(width=89.0 / 25.4)))
    assert any(axis.has_data() for axis in figure.axes if axis.get_title() or axis.get_xlabel())
    assert_fits_in_print(figure, 89.0)
    frames = {(axis.get_xlim(), axis.get_ylim()) for axis in figure.axes if axis.get_aspect() == 1.0}
    assert len(frames) <= 1


def assert_fits_in_print(figure, millimetres):
    figure.draw_without_rendering()
    assert figure.get_figwidth() * 25.4 == pytest.approx(millimetres)
    written = [text for text in figure.findobj(Text) if text.get_visible() and len(text.get_text()) > 1]
    assert {text.get_fontsize() for text in written} == {7.0}
    canvas = figure.bbox
    for axis in figure.axes:
        box = axis.get_tightbbox()
        assert min(box.x0 - canvas.x0, canvas.x1 - box.x1, box.y0 - canvas.y0, canvas.y1 - box.y1) > -2.0
    maps = [axis for axis in figure.axes if axis.get_aspect() == 1.0]
    numbers = [(axis, label.get_window_extent()) for axis in figure.axes for label in axis.get_yticklabels()]
    for frame in maps:
        inner = frame.get_window_extent().padded(-1.0)
        assert not any(box.overlaps(inner) for axis, box in numbers if axis is not frame), frame.get_title()
    for axis in figure.axes:
        for along, side in enumerate((axis.xaxis, axis.yaxis)):
            low, high = sorted(side.get_view_interval())
            inside = [
                text for text in side.get_majorticklabels() if low <= text.get_position()[along] <= high
            ]
            boxes = [text.get_window_extent().padded(-2.0) for text in inside if text.get_text()]
            assert not any(a.overlaps(b) for a, b in itertools.pairwise(boxes)), [*map(str, inside)]
    titles = [axis.title.get_window_extent() for axis in figure.axes if axis.get_title()]
    assert not any(a.overlaps(b) for i, a in enumerate(titles) for b in titles[:i])


def test_figures_of_other_pages_fit_into_a_column(tmp_path):
    handmade_run.make_refit(tmp_path)
    maps, column = read_calibration(tmp_path, any_model=True).maps, Canvas(width=89.0 / 25.4)
    assert_fits_in_print(matrix_change_figure(maps, maps, column), 89.0)
    x, y = (part.ravel() for part in np.meshgrid(*[np.linspace(-0.3, 0.3, 9)] * 2))
    columns = {"x": x, "y": y, "before": 2e-3 * np.hypot(x, 0.1), "p_error": 1e-3 * np.hypot(x, 0.1)}
    field = {name: values.tolist() for name, values in columns.items()}
    assert_fits_in_print(planned_figure(field, column), 89.0)


def test_twenty_effects_fit_into_a_column():
    """Each of 20 comes within 4 σ of the next, and is shown; two more are not. Names must not lie on each other."""
    names = tuple(f"standard_outlier_{k}" for k in range(22))
    near = (np.arange(22) < 19)[:, None] & (np.eye(22, k=1) > 0)
    separation = np.where(near, 4.0, 7.0) + np.diag(np.full(22, np.nan))
    found = dataclasses.replace(handmade_run.limits(), effects=names, separation=separation)
    figure = separation_figure(found, Canvas(width=89.0 / 25.4))
    assert_fits_in_print(figure, 89.0)
    assert [text.get_text() for text in figure.axes[0].get_yticklabels()][-1] == f"{names[19]}  20"


@pytest.mark.parametrize("name", WITHOUT)
def test_missing_parts_of_a_run_are_named(source, name):
    with pytest.raises(DataError, match=r"has no posterior|holds no (map|limits|diagnosis)"):
        draw(name, source)


def test_figures_that_a_run_can_give_are_listed(source):
    assert [*possible(source)] == [name for name in FIGURES if name not in WITHOUT]
    assert [*plot(source.folder)] == [*possible(source)]


def test_figures_of_a_diagnosis(tmp_path):
    """Of what was found (step 1), or of the whole (0): their titles are those of the arrays typed by hand."""
    write_figure_data(tmp_path / "diagnosis.fits", handmade_run.figure_data())
    run = FigureSource(Run(tmp_path))
    assert [*possible(run)] == [*OF_A_DIAGNOSIS]
    for name in OF_A_DIAGNOSIS:
        assert draw(name, run).axes[0].has_data()
        assert_fits_in_print(draw(name, dataclasses.replace(run, canvas=Canvas(width=89.0 / 25.4))), 89.0)
    rows = [axis.get_ylabel().splitlines()[:-2] for axis in draw("effect", run).axes[:12:4]]
    assert rows == [["without", "clp_wobble"], ["explained by", "clp_wobble"], ["with", "clp_wobble"]]
    whole = draw("effect", dataclasses.replace(run, step=0))
    assert whole.axes[0].get_ylabel().splitlines()[:2] == ["starting", "model"]
    for step in (2, -1):
        with pytest.raises(DataError, match=rf"step {step}: the diagnosis added 1 effect; step 0"):
            plot(tmp_path, "signature", step=step)


def test_names_and_files(source, tmp_path):
    with pytest.raises(DataError, match="did you mean 'efficiency'"):
        draw("eficiency", source)
    with pytest.raises(DataError, match="no picture"):
        plot(source.folder, "matrix", output=tmp_path / "matrix.txt")
    path = tmp_path / "matrix.svg"
    plot(source.folder, "matrix", output=path)
    assert path.read_text().startswith("<?xml")
    with pytest.raises(DataError, match="--overwrite"):
        plot(source.folder, "matrix", output=path)


def test_titles_of_maps_give_their_range(source):
    maps = source.maps
    axis = draw("efficiency", source).axes[0]
    said = axis.get_title().splitlines()[1].removesuffix(" %").split(" to ")
    low, high = (float(part.replace("−", "-")) for part in said)
    percent = 100.0 * maps.values[1]
    np.testing.assert_allclose([low, high], [percent.min(), percent.max()], atol=np.ptp(percent) / 50)
    assert "efficiency" in axis.get_title()


def test_names_of_the_paper():
    # m21 m22 m23 m31 m32 m33
    assert [element_kind(i, 2) for i in range(6)] == [0, 1, 2, 0, 2, 1]


@pytest.mark.parametrize("delta", [10.0, 90.0, 170.0, 190.0, 300.0])
@pytest.mark.parametrize("axis", [0.0, 22.5, 100.0])
def test_retardance_of_a_pure_retarder(delta, axis):
    """The rotation of the Poincaré sphere by δ about the axis, multiplied out from its definition."""
    two, d = 2 * np.deg2rad(axis), np.deg2rad(delta)
    n = np.array([np.cos(two), np.sin(two), 0.0])
    cross = np.array([[0, -n[2], n[1]], [n[2], 0, -n[0]], [-n[1], n[0], 0]])
    rotation = np.eye(3) + np.sin(d) * cross + (1 - np.cos(d)) * cross @ cross
    found = {round(float(retardance(_whole(r), n[:2])), 9) for r in (rotation, rotation.T)}
    assert found == {delta, 360.0 - delta}
    own = np.asarray(mueller.retarder(jnp.asarray(d), jnp.asarray(np.deg2rad(axis))))
    assert round(float(retardance(own, n[:2])), 6) == delta


def _whole(rotation: np.ndarray) -> np.ndarray:
    whole = np.eye(4)
    whole[1:, 1:] = rotation
    return whole


def test_map_and_curves_of_the_retardance_agree(source):
    """At the centre of the field, whose value lies in the first turn."""
    (image,) = draw("retardance", source).axes[0].images
    grid = np.asarray(image.get_array())
    centre = float(grid[len(grid) // 2, len(grid) // 2])
    line = draw("retardance-wavelength", source).axes[0].lines[0]
    assert 0.0 <= centre < 360.0
    assert centre == pytest.approx(np.interp(620.0, *line.get_data()) % 360.0, abs=0.1)


def test_plates_go_by_their_names(source):
    """Of an instrument whose first arm has no plate the other one is still HWP2."""
    assert possible(source)["retardance"] == "maps of the retardance of HWP1 and HWP2"
    assert texts("figures")["retardance"] == "maps of the retardance of the half-wave plates"
    whole, first = source.required_calibration, source.required_calibration.model.template.arms[0]
    bare = dataclasses.replace(
        first,
        elements=tuple(element for element in first.elements if element.name != "plate"),
        path=tuple(name for name in first.path if name != "plate"),
    )
    lacking = dataclasses.replace(whole.model.template, arms=(bare, whole.model.template.arms[1]))
    model = base_model(source.calset, lacking)
    n = len(model.parameters)
    one = dataclasses.replace(whole, model=model, values=model.start, covariance=np.zeros((n, n)))
    assert [axis.get_title() for axis in retardance_wavelength_figure(one).axes] == ["HWP2"]
    assert retardance_figure(one).axes[0].get_title().startswith("HWP2 at")
    assert possible(FigureSource.of(one))["retardance"] == "maps of the retardance of HWP2"


def test_retardance_on_the_axis_is_that_of_the_crystals(source):
    """2π/λ Σ (n_o − n_e) d about the optic axis of the quartz, MgF2 crossed against it; no wedge bends this ray."""
    from walop_jax.model import materials

    instrument = source.required_calibration.model.instrument(source.required_calibration.values)
    lam = 0.62
    quartz, mgf2 = (
        float(crystal.ordinary.refractive_index(lam) - crystal.extraordinary.refractive_index(lam))
        for crystal in (materials.CRYSTALS["quartz"], materials.CRYSTALS["mgf2"])
    )
    thick = dict(
        zip(source.required_calibration.model.names, source.required_calibration.values, strict=True)
    )
    straight = instrument.changed("half1.wedge", angle=0.0)
    found = plate_retardances(straight, np.array([lam]), np.zeros(1), np.zeros(1))[0, 0, 0]
    path = quartz * thick["half1.plate.quartz"] - mgf2 * thick["half1.plate.mgf2"]
    assert abs((found - 360.0 * path / lam + 180.0) % 360.0 - 180.0) < 0.5


def test_coefficients_that_are_only_prior_are_not_shown():
    spread = {"a": 0.1, "b": 0.99, "c": 0.5, "d": 3.0}
    assert informed(tuple(spread), spread, {"a": 1.0, "b": 1.0, "c": 1.0, "d": np.nan}) == ("d", "a", "c")


@pytest.mark.parametrize("name", ["protection", "separation"])
def test_figures_of_limits(tmp_path, name):
    figure = draw(name, FigureSource(Run(handmade_run.make_limits(tmp_path))))
    assert figure.axes[0].has_data()


def test_modulation_shows_a_point_that_was_seen_behind_the_polariser(source):
    """The point at the centre holds a standard star alone."""
    axes = draw("modulation", source).axes
    assert all(
        max(len(line.get_xdata()) for line in axis.lines if line.get_marker() != "None") >= 4 for axis in axes
    )


def test_a_source_on_disk_stays_one(source):
    """Reading its documents made it one that is in memory, with no files."""
    assert source.run.documents == {}
    assert "calibration.fits" in source
    assert source.maps.values.shape[0] == 6


def test_plates_are_found_by_their_class(tmp_path):
    """Names of crystals are those of the description; figures of retardance were hidden where they were others."""
    (tmp_path / "own.toml").write_text(OWN)
    design = Instrument.read(tmp_path / "own.toml")
    plan = ObservingPlan(
        design,
        grid=3,
        polariser_angles=polariser_turn(4),
        moon_patches=0,
        standards=0,
        moving={"WIN": (0.0, 45.0)},
    )
    calset = simulate(plan, seed=SEED).calset
    calibration = Calibration.from_fit(refit(calset, base_model(calset, design)).with_verdict())
    write_calibration(tmp_path / "calibration.fits", calibration)
    listed = possible(FigureSource(Run(tmp_path)))
    assert listed["retardance"] == "maps of the retardance of main.plate"
    assert not {"accuracy", "cross-talk"} & {*listed}  # of a single arm


@pytest.mark.parametrize("dark", [{"axes.facecolor": "black", "text.color": "white", "font.size": 25.0}])
def test_figures_have_the_style_of_the_package(source, dark):
    """Whatever a matplotlibrc says, and without a change of it; axes of the caller keep the caller's."""

    def pixels(figure):
        stream = io.BytesIO()
        figure.savefig(stream, format="rgba", dpi=40)
        return stream.getvalue()

    expected = pixels(draw("matrix", source))
    with matplotlib.rc_context(dark | {"lines.linewidth": 9.0}):
        figure = draw("matrix", source)
        assert pixels(figure) == expected
        assert matplotlib.rcParams["axes.facecolor"] == "black"
        theirs = matplotlib.figure.Figure()
        plot(source.run, "accuracy", ax=theirs.subplots())
        assert theirs.subfigs[0].axes[0].get_facecolor()[:3] == (0.0, 0.0, 0.0)
