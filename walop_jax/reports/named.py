"""The figures of a run by name: what each shows, and what it is drawn from."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from walop_jax.calibration import PRODUCT, Calibration, MatrixMaps
from walop_jax.diagnosis.limits_found import DetectionLimits
from walop_jax.fit.refit import FitResult
from walop_jax.io.errors import fail, nearest
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.posterior import Run
from walop_jax.posterior.files import LIMITS, POSTERIOR
from walop_jax.reports import diagnosis_figures, figures, paper_figures, posterior_figures
from walop_jax.reports.run import read_limits
from walop_jax.reports.style import PAGE, AnyFigure, Canvas
from walop_jax.science.field_accuracy import field_accuracy


@dataclasses.dataclass(frozen=True, repr=False)
class FigureSource(Run):
    """The run that a figure is drawn from; what it needs and is not there is a `DataError`.

    `parameters` are coefficients by name; `place` (deg) is a field point; `canvas` is where to draw.
    """

    parameters: tuple[str, ...] = ()
    place: tuple[float, float] = (0.0, 0.0)
    canvas: Canvas = PAGE

    @classmethod
    def of(cls, given: FitResult | Calibration | Run, **options: Any) -> FigureSource:
        """What a fit or a calibration in memory holds, or the folder of a run."""
        if isinstance(given, Run):
            return cls(given.folder, given.catalogue, given.data, **options)
        held = Calibration.from_fit(given) if isinstance(given, FitResult) else given
        made = cls(Path("in memory"), **options)
        vars(made).update(product=held, calibration=held, documents={}, posterior=None)
        if isinstance(given, FitResult):
            vars(made).update(calset=given.calset, likelihood=given.likelihood)
        return made

    def wanted(self, name: str, advice: str) -> Path:
        """As for any run; what is held in memory has no file."""
        return (
            self.folder / name
            if name == PRODUCT and "product" in vars(self)
            else super().wanted(name, advice)
        )

    @functools.cached_property
    def likelihood(self) -> Likelihood:
        """The likelihood of the data of the run under its model."""
        return Likelihood.of(self.calset, self.rebuilt.model)

    @property
    def maps(self) -> MatrixMaps:
        """The maps of the file, which need no model."""
        return self.stored.maps

    @property
    def stored(self) -> Calibration:
        """The calibration as its file holds it."""
        self.wanted(PRODUCT, "give the RUN of walop-jax refit or diagnose")
        assert self.product is not None
        return self.product

    @property
    def rebuilt(self) -> Calibration:
        """The calibration with its model."""
        self.wanted(PRODUCT, "give the RUN of walop-jax refit or diagnose")
        assert self.calibration is not None
        return self.calibration

    @property
    def limits(self) -> DetectionLimits:
        """The detection limits of the data."""
        return read_limits(self.wanted(LIMITS, "run walop-jax limits -o RUN first"))


def _accuracy(source: FigureSource) -> AnyFigure:
    found = field_accuracy(source.rebuilt)
    if found is None:
        advice = "plot matrix-errors"
        raise fail("has a single arm: one exposure holds no p", file=source.folder, advice=advice)
    return figures.accuracy_figure(found, source.canvas)


def _residuals(source: FigureSource, whole: bool = False) -> AnyFigure:
    c = source.rebuilt
    if source.likelihood.layout.large:
        raise fail("was fitted to whole frames", file=source.folder, advice="plot residual-map")
    shown = source.likelihood, c.values, c.model.start, source.canvas
    return figures.calibration_figure(source.maps, *shown) if whole else figures.residuals_figure(*shown)


def _residual_map(source: FigureSource) -> AnyFigure:
    if source.stored.residuals is None:
        advice = "it comes with sets of whole frames"
        raise fail("holds no map of residuals", file=source.folder, advice=advice)
    cameras = source.rebuilt.model.template.cameras.names
    return figures.residual_map_figure(source.stored.residuals, cameras, source.canvas)


def _draws(source: FigureSource) -> tuple[dict[str, Any], dict[str, str], tuple[str, ...]]:
    """Draws (chain, draw) and units by name, and the names that are shown."""
    if source.posterior is None:
        raise fail("has no posterior", file=source.folder, advice="run walop-jax sample first")
    data = source.posterior.posterior
    held = {str(name): np.asarray(data[name].values) for name in data.data_vars}
    units = {name: str(data[name].attrs.get("units", "")) for name in held}
    units = {name: "" if unit == "1" else unit for name, unit in units.items()}
    for name in source.parameters:
        if name not in held:
            path = source.folder / POSTERIOR
            raise fail(f"has no coefficient {name!r}", file=path, advice=nearest(name, held))
    sampled = [name for name in held if "sampled_by" in data[name].attrs]
    return held, units, source.parameters or tuple(sampled)


def _corner(source: FigureSource) -> AnyFigure:
    held, units, shown = _draws(source)
    if not source.parameters:
        draws = np.stack([held[name].ravel() for name in shown], axis=1)
        shown = posterior_figures.correlated(draws, shown, source.stored.prior_width)
    if source.canvas.ax is not None:
        raise ValueError("ax: a corner plot needs a figure of its own")
    draws = np.stack([held[name].ravel() for name in shown], axis=1)
    return posterior_figures.corner_figure(draws, shown, [units[name] for name in shown])


def _trace(source: FigureSource) -> AnyFigure:
    held, units, shown = _draws(source)
    chains = np.stack([held[name][:, :, None] for name in shown], axis=-1)
    return posterior_figures.trace_figure(
        chains, shown, [units[name] for name in shown], 1, np.full(len(shown), np.nan)
    )


def _modulation(source: FigureSource) -> AnyFigure:
    exposures, points = source.calset.exposures, source.calset.points
    behind = np.flatnonzero(exposures.clp_in & ~exposures.chwp_in)
    seen = source.calset.intensities.block(0, len(points)).used[:, behind].any(axis=1)
    if not seen.any():
        raise fail("no field point was seen behind the polariser", file=source.folder, advice="plot matrix")
    away = np.hypot(points.x - source.place[0], points.y - source.place[1])
    nearest = int(np.argmin(np.where(seen, away, np.inf)))
    return figures.modulation_figure(source.calset, [nearest], source.canvas)


@dataclasses.dataclass(frozen=True)
class NamedFigure:
    """A figure with what it shows in a few words, and the file of a run that it needs beside the calibration."""

    about: str
    draw: Callable[[FigureSource], AnyFigure]
    needs: str = PRODUCT


FIGURES: Mapping[str, NamedFigure] = {
    "accuracy": NamedFigure("error of p over the field: map and histogram", _accuracy),
    "calibration": NamedFigure(
        "the instrument matrix, and residuals before and after the fit", lambda s: _residuals(s, whole=True)
    ),
    "matrix": NamedFigure(
        "the six elements of the instrument matrix",
        lambda s: figures.matrix_maps_figure(s.maps, on=s.canvas),
    ),
    "matrix-errors": NamedFigure(
        "their standard errors", lambda s: figures.matrix_errors_figure(s.maps, s.canvas)
    ),
    "zero-offset": NamedFigure(
        "maps of m21 and m31", lambda s: figures.matrix_maps_figure(s.maps, 0, s.canvas)
    ),
    "efficiency": NamedFigure(
        "maps of m22 and m33", lambda s: figures.matrix_maps_figure(s.maps, 1, s.canvas)
    ),
    "cross-talk": NamedFigure(
        "maps of m23 and m32", lambda s: figures.matrix_maps_figure(s.maps, 2, s.canvas)
    ),
    "retardance": NamedFigure(
        "maps of the retardance of HWP1 and HWP2",
        lambda s: paper_figures.retardance_figure(s.rebuilt, on=s.canvas),
    ),
    "retardance-wavelength": NamedFigure(
        "their retardance against wavelength",
        lambda s: paper_figures.retardance_wavelength_figure(s.rebuilt, on=s.canvas),
    ),
    "coefficients": NamedFigure(
        "maps of the coefficients of the method of Paper II",
        lambda s: paper_figures.coefficients_figure(s.calset, s.maps.filter, s.canvas),
    ),
    "transmission": NamedFigure(
        "transmission of the cameras against polariser angle, with residuals",
        lambda s: paper_figures.transmission_figure(s.calset, s.maps.filter, s.place, s.canvas),
    ),
    "modulation": NamedFigure("q_m and u_m against polariser angle", _modulation),
    "protection": NamedFigure(
        "largest error of q and u that an effect can make undetected",
        lambda s: diagnosis_figures.protection_figure(s.limits, s.canvas),
        LIMITS,
    ),
    "separation": NamedFigure(
        "which effects look alike",
        lambda s: diagnosis_figures.separation_figure(s.limits, s.canvas),
        LIMITS,
    ),
    "residual-map": NamedFigure("what the smooth model leaves, of whole frames", _residual_map),
    "residuals": NamedFigure(
        "residuals of every field point before and after the fit, and all of them", _residuals
    ),
    "corner": NamedFigure("posterior of coefficients in pairs", _corner, POSTERIOR),
    "trace": NamedFigure("chains of the posterior", _trace, POSTERIOR),
}
"""In the order of the list that is printed."""


def draw(name: str, source: FigureSource) -> AnyFigure:
    """The figure of a name; `DataError` with the nearest names if there is none, or if the run lacks what it needs."""
    if name not in FIGURES:
        raise fail(f"there is no figure {name!r}", advice=nearest(name, FIGURES))
    return FIGURES[name].draw(source)
