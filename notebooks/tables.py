"""Calibration sets out of tables of a laboratory: one field point, nothing said but what turns."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from walop_jax.data.records import CalibrationSet, Exposures, FilterCurve, Points, Position, Site, Sources
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.model.effects.described import Described
from walop_jax.model.specification import effect_context, with_effects


def bench_set(
    instrument: str,
    origin: str,
    kind: str,
    filters: list[FilterCurve],
    of_filter: Float[np.ndarray, " e"],
    counts: Float[np.ndarray, "e k"],
    sigma: Float[np.ndarray, "e k"],
    moving: Mapping[str, Float[np.ndarray, " e"]],
    *,
    polariser: Float[np.ndarray, " e"] | None = None,
    mjd: Float[np.ndarray, " e"] | float = 60000.0,
) -> CalibrationSet:
    """A set of exposures of one KIND; `of_filter` numbers their filters, angles are in deg, NaN: out of the beam."""
    n = len(counts)
    no, always = np.full(n, np.nan), np.ones(n, bool)
    exposures = Exposures(
        exposure=np.arange(n),
        kind=np.full(n, kind),
        mjd=np.broadcast_to(np.asarray(mjd, float), n).copy(),
        exptime=np.ones(n),
        filter=np.array([curve.name for curve in filters])[of_filter],
        clp_in=always if polariser is not None else ~always,
        clp_angle=no if polariser is None else np.asarray(polariser, float),
        chwp_in=~always,
        chwp_angle=no,
        temp=no,
        ha=no,
        ra=no,
        dec=no,
        rotator=no,
        teff=no,
        moving={
            prefix: Position(np.isfinite(angle), np.asarray(angle, float)) for prefix, angle in moving.items()
        },
    )
    points, none = Points(np.array([0]), np.zeros(1), np.zeros(1)), np.zeros(0)
    return CalibrationSet(
        instrument=instrument,
        site=Site("", np.nan, np.nan, np.nan),
        origin=origin,
        exposures=exposures,
        points=points,
        sources=Sources(np.zeros(0, int), np.zeros(0, str), none, none, none, none, none),
        filters={curve.name: curve for curve in filters},
        intensities=TableIntensities(
            n,
            points,
            exposure=np.arange(n),
            point=np.zeros(n, int),
            source=np.full(n, -1),
            counts=np.asarray(counts, float),
            sigma=np.asarray(sigma, float),
            flag=np.zeros(n, int),
            used=always,
        ),
    )


def left_over(result, values=None):
    """Measured minus fitted intensities, exposure by camera; `values` are those of another fit of the same model."""
    likelihood = result.likelihood
    _, residual = likelihood.residuals(result.values if values is None else values)
    return residual[0] / likelihood.points.gathered("weight")[0]


def saying(model, calset, sentences):
    """The model with what sentences say of it, for a fit to find the amplitudes of, without their priors."""
    said = Described.of(effect_context(model.template, calset.exposures), sentences=tuple(sentences))
    made = with_effects(model, [said], effect_context(model.template, calset.exposures))
    for name in made.names:
        if name not in model.names:
            made = made.change(name, prior=None, loose=1.0)
    return made
