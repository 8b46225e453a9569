"""Making a plan: nodes and bands of exposures or settings, as detailed as the instrument and its effects need them."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterable, Mapping

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from walop_jax.data.records import Exposures, FilterCurve, Sources
from walop_jax.data.settings import Settings
from walop_jax.io.errors import fail
from walop_jax.model.compiled import array
from walop_jax.model.dependence import needs
from walop_jax.model.instrument import Instrument
from walop_jax.model.materials import EXTRAPOLATED, MATERIALS
from walop_jax.model.plan import Plan, blank_exposures, exposure_arrays, hours_of
from walop_jax.model.quadrature import FAINT, WAVES, Rule, band_rule, rounded_up, waves_over
from walop_jax.model.ray import CONDITIONS, Conditions
from walop_jax.model.sources import ExposureArrays

SAMPLES = 9  # wavelengths of a band between which a retardance goes one way
ROOM = 1.03  # by which a thickness may grow in a fit, and a path when the ray is oblique, before nodes are too few


def plan_for(
    instrument: Instrument,
    exposures: Exposures,
    filters: Mapping[str, FilterCurve],
    sources: Sources | None = None,
) -> Plan:
    """Lay out the nodes and bands of `exposures`, as detailed as the instrument and its effects need it.

    Raises KeyError for a filter that `filters` does not hold and ValueError for a KIND without a source.
    """
    own = Settings.of(exposures, instrument.patched().moving())
    stars = 0 if sources is None else len(sources)
    # A row for every exposure; of standards one for every star, as each may have a colour of its own.
    of_stars = exposures.direct("standard") & (stars > 0)
    row = np.repeat(np.arange(len(exposures)), np.where(of_stars, stars, 1))
    settings, seen = own[row], of_stars[row]
    if sources is not None and seen.any():
        colour = np.tile(sources.teff, of_stars.sum())
        teff = settings.teff.copy()
        teff[seen] = np.where(np.isfinite(colour), colour, teff[seen])
        settings = dataclasses.replace(settings, teff=teff)

    def band_of(band: Int[np.ndarray, " n"]) -> Int[np.ndarray, "e s"]:
        table = np.empty((len(exposures), 1 + stars), int)
        table[~of_stars] = band[~seen, None]
        table[of_stars, 1:] = band[seen].reshape(of_stars.sum(), stars)
        table[of_stars, 0] = table[of_stars, -1]  # nothing is used of a standard without its star
        return table

    known = [source.kind for source in instrument.sources if source.facts.flux_known]
    arrays = exposure_arrays(exposures, instrument.kinds, known)
    steady = np.isin(
        exposures.kind, [source.kind for source in instrument.sources if source.facts.flux_shared]
    )
    if instrument.cameras.split or steady.any():
        arrays = _sharing(arrays, own, steady, split=instrument.cameras.split)
    return _plan(
        instrument, settings, exposures.kind[row], hours_of(exposures)[row], filters, arrays, band_of
    )


def _sharing(
    exposures: ExposureArrays, settings: Settings, steady: Bool[np.ndarray, " e"], *, split: bool
) -> ExposureArrays:
    """Exposures that have a flux in common: steady light in each filter, and, `split`, light of known flux.

    Such light is divided between the arms in unknown shares, the same ones in all exposures of a filter with everything
    in the same place.
    """
    known = np.asarray(exposures.flux_known)
    group = np.arange(len(known))
    if split:
        for _, rows in settings.layouts():
            group[rows[known[rows]]] = rows[0]
    _, first, of_filter = np.unique(settings.filter[steady], return_index=True, return_inverse=True)
    group[steady] = np.flatnonzero(steady)[first][of_filter]
    shares = steady.any() or (split and known.any())
    _, number = np.unique(group, return_inverse=True)
    return dataclasses.replace(
        exposures,
        flux_known=array(known & (not split)),
        shared=jax.nn.one_hot(number, number.max() + 1, dtype=float) if shares else None,
    )


def plan_for_settings(instrument: Instrument, settings: Settings, filters: Mapping[str, FilterCurve]) -> Plan:
    """Lay out the nodes and bands of `settings`, without any light: for analysis vectors.

    The band of a row is `band_of[row, 0]`. Raises KeyError for a filter that `filters` does not hold and ValueError
    for a moving element that the instrument does not have.
    """
    settings.check_moving(instrument.patched().moving())
    blank = blank_exposures(instrument, len(settings))
    kinds, hours = np.full(len(settings), ""), np.zeros(len(settings))
    return _plan(instrument, settings, kinds, hours, filters, blank, lambda band: band[:, None])


@functools.lru_cache(maxsize=256)
def _rule(wavelength: tuple[float, ...], throughput: tuple[float, ...], *fringes: float) -> Rule:
    """Nodes of a band and their weights; plans of one set are made for many models, most of which ask for the same."""
    path_difference, waves, faint = fringes
    return band_rule(
        np.array(wavelength), np.array(throughput), path_difference=path_difference, waves=waves, faint=faint
    )


def outgrown(planned: Instrument, instrument: Instrument, curves: Iterable[FilterCurve]) -> bool:
    """True where retarders have become thicker than the nodes of a plan for `planned` follow in any of the bands."""
    old, new = planned.patched(), instrument.patched()
    return any(
        now > followed
        for curve in curves
        for now, followed in zip(_fringes(new, curve, 1.0), _fringes(old, curve), strict=True)
    )


def extrapolations(instrument: Instrument, curves: Iterable[FilterCurve]) -> tuple[str, ...]:
    """Sentences on materials (patched instrument) that bands use beyond the wavelengths at which they were measured.

    Raises `DataError` where that is too far for the formulae.
    """
    behind = (element for arm in instrument.arms for element in arm.train())
    names = dict.fromkeys(name for element in (*instrument.train(), *behind) for name in element.materials)
    sentences = []
    for curve in curves:
        seen = curve.wavelength[curve.throughput > 0]
        for name in names if seen.size else ():
            (low, high), source = (one := MATERIALS[name]).measured, one.source.split(";")[0]
            first, last = float(seen.min()), float(seen.max())
            if low <= first and last <= high:
                continue
            what = f"filter {curve.name}, {first:g} to {last:g} µm: the refractive index of {name} was measured at "
            what += f"{low:g} to {high:g} µm ({source})"
            if first < low / EXTRAPOLATED or last > high * EXTRAPOLATED:
                raise fail(
                    what, advice="give a filter within them, or another material (walop-jax docs model)"
                )
            sentences.append(f"{what}; its formula is used beyond")
    return tuple(sentences)


def _fringes(instrument: Instrument, curve: FilterCurve, room: float = ROOM) -> tuple[float, float]:
    """Waves of the fringes of an instrument (patched) in a band: at full strength, and of all layers of a plate.

    Behind one another retarders interfere at the sum of their retardances. Nodes are made for `room` times as many.
    """
    seen = curve.wavelength[curve.throughput > 0]
    at = np.linspace(seen.min(), seen.max(), SAMPLES) if seen.size else curve.wavelength
    common, bright, faint = list(instrument.train()), 0.0, 0.0
    for arm in instrument.arms:
        each = [found for element in (*common, *arm.train()) if (found := element.retardances(at))]
        whole = sum(waves_over(at, together) for together, _ in each)
        layers = max(
            (waves_over(at, sums) - waves_over(at, together) for together, sums in each), default=0.0
        )
        bright, faint = max(bright, whole), max(faint, whole + layers)
    return rounded_up(room * bright, WAVES), rounded_up(room * faint, FAINT)


def _plan(
    instrument: Instrument,
    settings: Settings,
    kinds: np.ndarray,
    hours: Float[np.ndarray, " n"],
    filters: Mapping[str, FilterCurve],
    exposures: ExposureArrays,
    band_of: Callable[[Int[np.ndarray, " n"]], Int[np.ndarray, "e s"]],
) -> Plan:
    asked, patched = needs(instrument), instrument.patched()
    moving = patched.moving()
    names = sorted(asked.conditions)
    values = {"temperature": settings.temperature, "hour_angle": settings.hour_angle, "hours": hours}
    assert set(values) == set(CONDITIONS)
    # A band is (positions, filter, conditions, colour temperature, KIND); sorting puts equal positions together.
    # NaN (out, flat spectrum) becomes a sortable stand-in. KINDs are apart, so that a set in which the colour of one
    # is another has a plan of the same shape.
    states = _rows(
        [np.nan_to_num(settings.position(prefix), nan=-np.inf) for prefix in moving], len(settings)
    )
    moments = _rows([values[name] for name in names], len(settings))
    teff = np.nan_to_num(settings.teff).tolist()
    keys = list(zip(states, settings.filter.astype(str).tolist(), moments, teff, kinds.tolist(), strict=True))
    bands = sorted(set(keys))
    index = {key: i for i, key in enumerate(bands)}

    groups = sorted({(name, moment) for _, name, moment, *_ in bands})
    curves = {name: filters[name] for name, _ in groups}
    extrapolations(patched, curves.values())
    rules = {
        name: _rule(
            tuple(c.wavelength.tolist()),
            tuple(c.throughput.tolist()),
            asked.path_difference,
            *_fringes(patched, c),
        )
        for name, c in curves.items()
    }
    # Equivalent widths: 0 for a monochromatic band.
    width = {
        n: float(np.trapezoid(c.throughput, c.wavelength) / c.throughput.max()) for n, c in curves.items()
    }
    offset, start = {}, 0
    for group in groups:
        offset[group] = start
        start += len(rules[group[0]][0])
    weight = np.zeros((len(bands), start))
    for i, (_, name, moment, *_) in enumerate(bands):
        first = offset[name, moment]
        weight[i, first : first + len(rules[name][1])] = rules[name][1]

    def per_node(of_group: list[float]) -> Float[Array, " n"]:
        counts = [len(rules[name][0]) for name, _ in groups]
        return array(np.repeat(np.asarray(of_group, float), counts))

    laid = []
    found = [key[0] for key in bands]
    for value in sorted(set(found)):
        state = tuple(None if np.isinf(angle) else float(angle) for angle in value)
        laid.append((state, found.index(value), len(found) - found[::-1].index(value)))
    return Plan(
        wavelength=array(np.concatenate([rules[name][0] for name, _ in groups])),
        conditions=Conditions(
            band_width=per_node([width[name] for name, _ in groups]),
            planned={name: per_node([moment[i] for _, moment in groups]) for i, name in enumerate(names)},
        ),
        node_weight=array(weight),
        teff=array([key[3] for key in bands], float),
        exposures=exposures,
        band_of=band_of(np.array([index[key] for key in keys], int)),
        settings=tuple(laid),
        moving=moving,
    )


def _rows(columns: list[Float[np.ndarray, " n"]], count: int) -> list[tuple[float, ...]]:
    return list(zip(*(column.tolist() for column in columns), strict=True)) if columns else [()] * count
