"""The figures of a run by name: a line about each, and the data that it is drawn from."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from walop_jax.calibration.residual_map import POINTS_PER_CELL
from walop_jax.data.kinds import CALIBRATION_PLATE
from walop_jax.io.errors import fail, nearest
from walop_jax.io.names import FIGURE_DATA, LIMITS, POSTERIOR, PRODUCT
from walop_jax.likelihood import limits
from walop_jax.model.cameras import Cameras
from walop_jax.paper.polynomial import TERMS
from walop_jax.paper.wavelength import plate_names
from walop_jax.reports import diagnosis_figures as diagnosis
from walop_jax.reports import figures, posterior_figures, survey_figures
from walop_jax.reports import paper_figures as paper
from walop_jax.reports.run import COMPARISON, DATA, SURVEY, FigureSource
from walop_jax.reports.style import NARROW, PAGE, PLATES, AnyFigure, texts
from walop_jax.reports.wording import listed as in_words


def _accuracy(source: FigureSource) -> AnyFigure:
    accuracy = source.accuracy
    if accuracy is None:
        what = f"the error of p is that of one exposure of two arms, and there are {source.maps.arms}"
        raise fail(what, file=source.folder, advice="plot matrix-errors")
    return figures.accuracy_figure(accuracy, source.canvas)


def _residuals(source: FigureSource, whole: bool = False) -> AnyFigure:
    c = source.required_calibration
    if source.likelihood.layout.large:
        raise fail(
            "has too many field points to be drawn one by one", file=source.folder, advice="plot residual-map"
        )
    shown = source.likelihood, c.values, c.model.start, source.canvas
    return figures.calibration_figure(source.maps, *shown) if whole else figures.residuals_figure(*shown)


def _residual_map(source: FigureSource) -> AnyFigure:
    calibration = source.required_calibration
    if calibration.residuals is None:
        advice = "it comes with whole frames, and with sets of many field points"
        raise fail("holds no map of residuals", file=source.folder, advice=advice)
    return figures.residual_map_figure(calibration.residuals, calibration.design.cameras, source.canvas)


def _draws(source: FigureSource) -> tuple[Float[np.ndarray, "c d k"], tuple[str, ...], list[str]]:
    """Draws of the coefficients that are shown, their names and units."""
    if source.posterior is None:
        raise fail("has no posterior", file=source.folder, advice="run walop-jax sample first")
    data = source.posterior["posterior"]
    for name in source.parameters:
        if name not in data.data_vars:
            path, held = source.folder / POSTERIOR, [*map(str, data.data_vars)]
            raise fail(f"has no coefficient {name!r}", file=path, advice=nearest(name, held))
    sampled = tuple(str(name) for name in data.data_vars if "sampled_by" in data[name].attrs)
    sampled = sampled if source.sample is None else source.sample.sampled
    shown = source.parameters or sampled
    units = [str(data[name].attrs.get("units", "1")) for name in shown]
    draws = np.stack([data[name].values for name in shown], axis=-1)
    return draws, shown, ["" if unit == "1" else unit for unit in units]


def _corner(source: FigureSource) -> AnyFigure:
    if source.canvas.ax is not None:
        raise ValueError("ax: a corner plot needs a figure of its own")
    draws, shown, units = _draws(source)
    draws, width = draws.reshape(-1, len(shown)), source.canvas.width
    if not source.parameters:
        most = posterior_figures.MOST_IN_CORNER if width is None or width >= NARROW else 3
        chosen = posterior_figures.correlated(draws, shown, source.prior_width, most)
        column = [shown.index(name) for name in chosen]
        draws, shown, units = draws[:, column], chosen, [units[k] for k in column]
    size = width or (source.canvas.figsize or (posterior_figures.CORNER,))[0]
    return posterior_figures.corner_figure(draws, shown, units, source.reference, size)


def _trace(source: FigureSource) -> AnyFigure:
    draws, shown, units = _draws(source)
    chains, steps, tau, sample = draws[:, :, None], None, np.full(len(shown), np.nan), source.sample
    if sample is not None and set(shown) <= set(sample.sampled):  # the walkers, not the draws
        column = [sample.sampled.index(name) for name in shown]
        chains, steps, tau = sample.chains[..., column], sample.thin, sample.convergence.tau[column]
    return posterior_figures.trace_figure(chains, shown, units, steps, tau, source.canvas)


def _signature(source: FigureSource) -> AnyFigure:
    data = source.figure_data
    shown = data.comparisons[source.examined], data.exposures, data.cameras
    return diagnosis.signature_figure(*shown, source.canvas)


def _cameras(source: FigureSource) -> Cameras | None:
    """The cameras of the instrument, which the product knows; None without a product."""
    return None if source.calibration is None else source.calibration.design.cameras


def _modulation(source: FigureSource) -> AnyFigure:
    exposures, points = source.calset.exposures, source.calset.points
    behind = np.flatnonzero(exposures.clp_in & ~exposures.position(CALIBRATION_PLATE).inside)
    measured = source.calset.intensities.block(0, len(points)).used[:, behind].any(axis=1)
    if not measured.any():
        raise fail("no field point was seen behind the polariser", file=source.folder, advice="plot matrix")
    x, y = np.broadcast_arrays(*map(np.atleast_1d, source.place))
    away = np.hypot(points.x - x[:, None], points.y - y[:, None])
    nearest = np.argmin(np.where(measured, away, np.inf), axis=1).tolist()
    return figures.modulation_figure(source.calset, nearest, source.canvas, _cameras(source))


class NamedFigure(NamedTuple):
    """A figure, the file of a run that it needs, and whether a run can give it; lines about them: `figures.toml`."""

    draw: Callable[[FigureSource], AnyFigure]
    needs: str = PRODUCT
    possible: Callable[[FigureSource], object] = lambda source: True


def _small(source: FigureSource) -> bool:
    """True where there are the data of the fit, of so few field points that each of them can be drawn."""
    residuals = None if source.calibration is None else source.calibration.residuals
    few = residuals is None or residuals.grid.pixels * POINTS_PER_CELL < limits.LARGE_ABOVE
    return DATA in source and few


def _plates(source: FigureSource) -> list[str]:
    """Plates in the arms as figures call them."""
    return [PLATES.get(name, name) for name in plate_names(source.required_calibration.design)]


def _angles(fewest: int) -> Callable[[FigureSource], bool]:
    """True where a filter was seen at so many polariser angles, the calibration plate out."""

    def enough(source: FigureSource) -> bool:
        calibration = source.calibration
        e = source.calset.exposures if calibration is None else calibration.exposures
        rows = e.clp_in & ~e.position(CALIBRATION_PLATE).inside
        if calibration is not None:
            rows = rows & (e.filter == calibration.maps.filter)
        return _small(source) and len(np.unique(np.round(e.clp_angle[rows] % 180.0, 6))) >= fewest

    return enough


FIGURES: Mapping[str, NamedFigure] = {
    "accuracy": NamedFigure(_accuracy, possible=lambda s: s.maps.arms == 2),
    "calibration": NamedFigure(lambda s: _residuals(s, whole=True), possible=_small),
    "matrix": NamedFigure(lambda s: figures.matrix_maps_figure(s.maps, on=s.canvas)),
    "matrix-errors": NamedFigure(lambda s: figures.matrix_errors_figure(s.maps, s.canvas)),
    "zero-offset": NamedFigure(lambda s: figures.matrix_maps_figure(s.maps, 0, s.canvas)),
    "efficiency": NamedFigure(lambda s: figures.matrix_maps_figure(s.maps, 1, s.canvas)),
    "cross-talk": NamedFigure(
        lambda s: figures.matrix_maps_figure(s.maps, 2, s.canvas), possible=lambda s: s.maps.arms == 2
    ),
    "retardance": NamedFigure(
        lambda s: paper.retardance_figure(s.required_calibration, s.canvas), possible=_plates
    ),
    "retardance-wavelength": NamedFigure(
        lambda s: paper.retardance_wavelength_figure(s.required_calibration, s.canvas), possible=_plates
    ),
    "coefficients": NamedFigure(
        lambda s: paper.coefficients_figure(s.calset, s.maps.filter, s.canvas), possible=_angles(len(TERMS))
    ),
    "transmission": NamedFigure(
        lambda s: paper.transmission_figure(s.calset, s.maps.filter, s.place, s.canvas, _cameras(s)),
        possible=_angles(3),
    ),
    "modulation": NamedFigure(_modulation, DATA, _angles(1)),
    "protection": NamedFigure(lambda s: diagnosis.protection_figure(s.limits, s.canvas), LIMITS),
    "separation": NamedFigure(lambda s: diagnosis.separation_figure(s.limits, s.canvas), LIMITS),
    "ladder": NamedFigure(lambda s: diagnosis.ladder_figure(s.figure_data.ladder, s.canvas), FIGURE_DATA),
    "effect": NamedFigure(
        lambda s: diagnosis.effect_figure(s.figure_data, s.examined, s.canvas), FIGURE_DATA
    ),
    "signature": NamedFigure(_signature, FIGURE_DATA),
    "rms": NamedFigure(lambda s: diagnosis.rms_figure(s.figure_data, s.canvas), FIGURE_DATA),
    "shares": NamedFigure(lambda s: diagnosis.shares_figure(s.figure_data.shares, s.canvas), FIGURE_DATA),
    "residual-map": NamedFigure(
        _residual_map, possible=lambda s: s.required_calibration.residuals is not None
    ),
    "residuals": NamedFigure(_residuals, possible=_small),
    "corner": NamedFigure(_corner, POSTERIOR),
    "trace": NamedFigure(_trace, POSTERIOR),
}
"""In the order of the list that is printed."""


def _tracks(source: FigureSource) -> AnyFigure:
    survey = source.held[SURVEY]
    document = survey.document()
    if not survey_figures.tracked(document):
        raise fail("no law of this survey lets a parameter change", file=source.folder, advice="plot nights")
    return survey_figures.tracks_figure(survey.tracks, document)


OF_RESULTS: Mapping[str, NamedFigure] = {
    "histogram": NamedFigure(lambda s: paper.histogram_figure(s.held[COMPARISON]), COMPARISON),
    "map": NamedFigure(lambda s: paper.map_figure(s.held[COMPARISON]), COMPARISON),
    "offset": NamedFigure(lambda s: paper.offset_figure(s.held[COMPARISON]), COMPARISON),
    "spectral": NamedFigure(lambda s: paper.spectral_figure(s.held[COMPARISON]), COMPARISON),
    "plate": NamedFigure(
        lambda s: paper.plate_figure(s.required_calibration),
        possible=lambda s: CALIBRATION_PLATE in s.required_calibration.model.template.patched().moving(),
    ),
    "tracks": NamedFigure(_tracks, SURVEY),
    "nights": NamedFigure(lambda s: survey_figures.nights_figure(s.held[SURVEY].document()), SURVEY),
}
"""Figures of results in memory; those that runs do not have are of one size."""


def possible(source: FigureSource) -> dict[str, str]:
    """The figures that a run, or a result in memory, can give, with a line about each; its plates by their names."""
    every = FIGURES if source.run is not None else {**FIGURES, **OF_RESULTS}
    listed = {n: texts("figures")[n] for n, f in every.items() if f.needs in source and f.possible(source)}
    if "retardance" in listed:
        listed["retardance"] = f"maps of the retardance of {in_words(_plates(source))}"
    return listed


def draw(name: str, source: FigureSource) -> AnyFigure:
    """The figure of a name; `DataError` with the nearest names if there is none, or if the run lacks its data."""
    if name in FIGURES:
        return FIGURES[name].draw(source)
    if name not in OF_RESULTS or OF_RESULTS[name].needs not in source:
        advice = f"{nearest(name, FIGURES)} (walop-jax plot RUN lists all)"
        raise fail(f"there is no figure {name!r}", advice=advice)
    if source.canvas != PAGE:
        raise ValueError(f"the figure {name!r} has a size of its own: leave ax, figsize and width out")
    return OF_RESULTS[name].draw(source)
