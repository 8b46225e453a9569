"""The figures of a run by name: what each shows, and what it is drawn from."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.from_file import read_calibration
from walop_jax.calibration.product import CalibrationProduct, read_product
from walop_jax.calibration.summary import PRODUCT
from walop_jax.data import CalibrationSet, read_calibration_set
from walop_jax.diagnosis.limits_found import DetectionLimits
from walop_jax.io.errors import fail, nearest
from walop_jax.model.effects import EFFECTS, Effect
from walop_jax.posterior import locate, read_inference_data
from walop_jax.reports import (
    accuracy_figures,
    figures,
    limits_figures,
    paper_figures,
    posterior_figures,
    product_figures,
)
from walop_jax.reports.run import LIMITS, POSTERIOR, read_limits
from walop_jax.science.field_accuracy import field_accuracy


@dataclasses.dataclass(frozen=True)
class Source:
    """What figures are drawn from: the folder of a run, read as far as a figure asks for it.

    `parameters` are coefficients that were asked for by name; `place` (deg) is a field point.
    """

    folder: Path
    parameters: tuple[str, ...] = ()
    place: tuple[float, float] = (0.0, 0.0)
    catalogue: Sequence[type[Effect]] = EFFECTS

    @cached_property
    def product(self) -> CalibrationProduct:
        """The calibration product."""
        return read_product(self.folder / PRODUCT)

    @cached_property
    def calibration(self) -> Calibration:
        """The calibration."""
        return read_calibration(self.folder, self.catalogue).calibration

    @cached_property
    def calset(self) -> CalibrationSet:
        """The data that it was fitted to."""
        paths = [locate(Path(entry.path), self.folder) for entry in self.product.inputs]
        if not paths:
            raise fail("does not say what it was fitted to", file=self.folder, advice="refit from files")
        return read_calibration_set(*paths)

    @property
    def limits(self) -> DetectionLimits:
        """What the data can show."""
        if not (self.folder / LIMITS).exists():
            raise fail(f"holds no {LIMITS}", file=self.folder, advice="run walop-jax limits -o RUN first")
        return read_limits(self.folder / LIMITS)

    @property
    def filter(self) -> str:
        """The filter of the maps."""
        return self.product.maps.filter


def _accuracy(source: Source) -> Figure:
    found = field_accuracy(source.calibration)
    if found is None:
        raise fail(
            "has a single arm: one exposure holds no p", file=source.folder, advice="plot matrix-errors"
        )
    return accuracy_figures.accuracy_figure(found)


def _residual_map(source: Source) -> Figure:
    if source.product.residuals is None:
        raise fail(
            "holds no map of residuals", file=source.folder, advice="it comes with sets of whole frames"
        )
    return product_figures.residual_map_figure(source.product.residuals)


def _draws(source: Source) -> tuple[dict[str, Any], dict[str, str], tuple[str, ...]]:
    """Draws (chain, draw) and units by name, and the names that are shown."""
    path = source.folder / POSTERIOR
    if not path.exists():
        raise fail("has no posterior", file=source.folder, advice="run walop-jax sample first")
    data = read_inference_data(path).posterior
    held = {str(name): np.asarray(data[name].values) for name in data.data_vars}
    units = {name: str(data[name].attrs.get("units", "")) for name in held}
    units = {name: "" if unit == "1" else unit for name, unit in units.items()}
    for name in source.parameters:
        if name not in held:
            raise fail(f"has no coefficient {name!r}", file=path, advice=nearest(name, held))
    sampled = [name for name in held if "sampled_by" in data[name].attrs]
    return held, units, source.parameters or tuple(sampled)


def _corner(source: Source) -> Figure:
    held, units, shown = _draws(source)
    if not source.parameters:
        table = source.product.parameters
        prior = dict(zip(table.name.tolist(), table.prior_width.tolist(), strict=True))
        spread = {name: float(held[name].std()) for name in shown}
        shown = posterior_figures.informed(shown, spread, prior)[: posterior_figures.MOST_IN_CORNER]
    draws = np.stack([held[name].ravel() for name in shown], axis=1)
    return posterior_figures.corner_figure(draws, shown, [units[name] for name in shown])


def _trace(source: Source) -> Figure:
    held, units, shown = _draws(source)
    chains = np.stack([held[name][:, :, None] for name in shown], axis=-1)
    return posterior_figures.trace_figure(
        chains, shown, [units[name] for name in shown], 1, np.full(len(shown), np.nan)
    )


def _modulation(source: Source) -> Figure:
    exposures, points = source.calset.exposures, source.calset.points
    behind = np.flatnonzero(exposures.clp_in & ~exposures.chwp_in)
    seen = source.calset.intensities.block(0, len(points)).used[:, behind].any(axis=1)
    if not seen.any():
        raise fail("no field point was seen behind the polariser", file=source.folder, advice="plot matrix")
    away = np.hypot(points.x - source.place[0], points.y - source.place[1])
    return figures.modulation_figure(source.calset, [int(np.argmin(np.where(seen, away, np.inf)))])


@dataclasses.dataclass(frozen=True)
class NamedFigure:
    """A figure with what it shows in a few words."""

    about: str
    draw: Callable[[Source], Figure]


FIGURES: Mapping[str, NamedFigure] = {
    "accuracy": NamedFigure("error of p over the field: map and histogram", _accuracy),
    "matrix": NamedFigure(
        "the six elements of the instrument matrix",
        lambda s: product_figures.matrix_maps_figure(s.product.maps),
    ),
    "matrix-errors": NamedFigure(
        "their standard errors", lambda s: product_figures.matrix_errors_figure(s.product.maps)
    ),
    "zero-offset": NamedFigure(
        "maps of m21 and m31", lambda s: product_figures.element_maps_figure(s.product.maps, 0)
    ),
    "efficiency": NamedFigure(
        "maps of m22 and m33", lambda s: product_figures.element_maps_figure(s.product.maps, 1)
    ),
    "cross-talk": NamedFigure(
        "maps of m23 and m32", lambda s: product_figures.element_maps_figure(s.product.maps, 2)
    ),
    "retardance": NamedFigure(
        "maps of the retardance of HWP1 and HWP2", lambda s: paper_figures.retardance_figure(s.calibration)
    ),
    "retardance-wavelength": NamedFigure(
        "their retardance against wavelength",
        lambda s: paper_figures.retardance_wavelength_figure(s.calibration),
    ),
    "coefficients": NamedFigure(
        "maps of the coefficients of the method of Paper II",
        lambda s: paper_figures.coefficients_figure(s.calset, s.filter),
    ),
    "transmission": NamedFigure(
        "transmission of the cameras against polariser angle, with residuals",
        lambda s: paper_figures.transmission_figure(s.calset, s.filter, s.place),
    ),
    "modulation": NamedFigure("q_m and u_m against polariser angle", _modulation),
    "protection": NamedFigure(
        "largest error of q and u that an effect can make undetected",
        lambda s: limits_figures.protection_figure(s.limits),
    ),
    "separation": NamedFigure(
        "which effects look alike", lambda s: limits_figures.separation_figure(s.limits)
    ),
    "residual-map": NamedFigure("what the smooth model leaves, of whole frames", _residual_map),
    "corner": NamedFigure("posterior of coefficients in pairs", _corner),
    "trace": NamedFigure("chains of the posterior", _trace),
}
"""In the order of the list that is printed."""


def draw(name: str, source: Source) -> Figure:
    """The figure of a name; `DataError` with the nearest names if there is none, or if the run lacks what it needs."""
    if name not in FIGURES:
        raise fail(f"there is no figure {name!r}", advice=nearest(name, FIGURES))
    return FIGURES[name].draw(source)
