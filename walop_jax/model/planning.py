"""Making a plan: nodes and bands of exposures or settings, in the detail required by the instrument and its effects."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Collection, Iterable, Mapping, Sequence

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy import special

from walop_jax.data.kinds import POLARISER
from walop_jax.data.records import Exposures, FilterCurve, Sources
from walop_jax.data.settings import Settings, nearest_hours
from walop_jax.io.errors import fail
from walop_jax.model import chebyshev
from walop_jax.model.compiled import array
from walop_jax.model.dependence import needs
from walop_jax.model.fold import Turning
from walop_jax.model.instrument import Instrument
from walop_jax.model.materials import CRYSTALS, EXTRAPOLATED, MATERIALS
from walop_jax.model.plan import Plan, blank_exposures
from walop_jax.model.quadrature import (
    FAINT,
    WAVES,
    QuadratureRule,
    band_rule,
    moments,
    rounded_up,
    waves_over,
)
from walop_jax.model.ray import CONDITIONS, SMOOTH, Conditions, within
from walop_jax.model.sources import ExposureArrays

SMOOTH_NODES = 8
"""Values of a condition at which the optics are solved where they depend on it smoothly, at least: exact for a
polynomial of seventh degree, and to 2(a/2)⁸/8! for a phase that changes by ±a rad, 10⁻¹⁰ for a = 0.4."""
INTERPOLATED = 1e-10
"""Largest error of a phase factor between these values: thick plates have more of them in temperature."""
SAMPLES = 9  # wavelengths of a band with a monotonic retardance between them
THICKEST = 1e4  # waves at 0.62 µm of all retarders in series: 0.7 m of quartz, 4 cm of calcite
ROOM = 1.03  # growth of a thickness in a fit, and of an oblique path, that the nodes allow


def hours_of(exposures: Exposures) -> Float[np.ndarray, " e"]:
    """Time (h) of every exposure since the first one; 0 where MJD is missing."""
    start = np.nanmin(exposures.mjd) if len(exposures) and np.isfinite(exposures.mjd).any() else 0.0
    return np.nan_to_num((exposures.mjd - start) * 24.0)


def exposure_arrays(
    exposures: Exposures, kinds: Collection[str], flux_known: Collection[str]
) -> ExposureArrays:
    """The exposures as the light path sees them (angles in radians); `flux_known` are the KINDs of unit flux.

    Raises ValueError for a KIND that is none of `kinds`.
    """
    order = tuple(kinds)
    unknown = sorted(set(exposures.kind.tolist()) - set(order))
    if unknown:
        raise ValueError(f"KIND {unknown[0]!r}: the instrument has no such source; it has {', '.join(order)}")
    return ExposureArrays(
        kind=array([order.index(kind) for kind in exposures.kind], int),
        clp_in=array(exposures.clp_in),
        clp_angle=array(np.deg2rad(np.where(exposures.clp_in, exposures.clp_angle, 0.0))),
        flux_known=array(np.isin(exposures.kind, list(flux_known))),
        rotator=array(np.deg2rad(np.nan_to_num(exposures.rotator))),
        hours=array(hours_of(exposures)),
        temperature=array(exposures.temp),
        hour_angle=array(nearest_hours(exposures.ha)),
        exptime=array(exposures.exptime),
        moving={  # NaN where they are out
            prefix: array(np.deg2rad(np.where(at.inside, at.angle, np.nan)))
            for prefix, at in exposures.positions.items()
            if prefix != POLARISER and at.inside.any()
        },
        kinds=order,
    )


def plan_for(
    instrument: Instrument,
    exposures: Exposures,
    filters: Mapping[str, FilterCurve],
    sources: Sources | None = None,
) -> Plan:
    """The plan for `exposures`: nodes and bands in the detail that the instrument requires.

    Standards with a colour have the slopes of the bands as well. Raises KeyError for a filter missing from `filters`
    and ValueError for a KIND without a source.
    """
    exposure_settings = Settings.of(exposures, instrument.patched().moving())
    indices, stars = np.arange(len(exposures)), 0 if sources is None else len(sources)
    # A row for every exposure; of standards one for every star, as each may have a colour of its own.
    of_stars = exposures.direct("standard") & (stars > 0)
    row = np.repeat(indices, np.where(of_stars, stars, 1))
    teff, last, starlight = exposure_settings.teff[row], len(row), of_stars[row]
    if sources is not None and starlight.any():
        colour = np.tile(sources.teff, of_stars.sum())
        teff[starlight] = np.where(np.isfinite(colour), colour, teff[starlight])
    sloping = np.flatnonzero(of_stars) if instrument.standard.bands else indices[:0]
    # The slope term is of second order, so one median temperature serves all stars.
    temperatures = np.zeros(0) if sources is None else sources.teff[np.isfinite(sources.teff)]
    typical = float(np.median(temperatures)) if temperatures.size else np.nan
    row, teff = np.append(row, sloping), np.append(teff, np.full(len(sloping), typical))
    settings = dataclasses.replace(exposure_settings[row], teff=teff)

    def band_of(band: Int[np.ndarray, " n"]) -> Int[np.ndarray, "e s"]:
        table = np.empty((len(indices), 1 + stars), int)
        table[~of_stars] = band[~starlight, None]
        table[of_stars, 1:] = band[starlight].reshape(of_stars.sum(), stars)
        # A standard's row for "no star" is never used: any band will do.
        table[of_stars, 0] = table[of_stars, -1]
        return table

    unit_flux = [source.kind for source in instrument.sources if source.facts.flux_known]
    arrays = exposure_arrays(exposures, instrument.kinds, unit_flux)
    steady = np.isin(
        exposures.kind, [source.kind for source in instrument.sources if source.facts.flux_shared]
    )
    if instrument.cameras.split or steady.any():
        arrays = _sharing(arrays, exposure_settings, steady, split=instrument.cameras.split)
    slope = np.arange(len(row)) >= last
    of_list = {"hours": hours_of(exposures)[row], "exptime": exposures.exptime[row]}
    plan, band = _plan(instrument, settings, of_list, filters, arrays, exposures.kind[row], slope)
    plan = dataclasses.replace(plan, band_of=band_of(band[:last]))
    if sources is None or not sloping.size:
        return plan
    curves = {name: filters[name] for name in np.unique(exposures.filter).tolist()}
    slope_band = np.zeros(len(indices), int)
    slope_band[sloping] = band[last:]
    coloured = dataclasses.replace(
        plan.exposures, colour=array(colours(exposures, curves, sources)), slope_band=array(slope_band, int)
    )
    return dataclasses.replace(plan, exposures=coloured)


def colours(
    exposures: Exposures, curves: Mapping[str, FilterCurve], sources: Sources
) -> Float[np.ndarray, "e s 2"]:
    """Mean wavelength and rms width (µm) of the photons of every star in every exposure."""
    names, number = np.unique(exposures.filter, return_inverse=True)
    by_filter = [
        [moments(curves[n].wavelength, curves[n].throughput, t) for t in sources.teff] for n in names
    ]
    return np.array(by_filter)[number]


def _sharing(
    exposures: ExposureArrays, settings: Settings, steady: Bool[np.ndarray, " e"], *, split: bool
) -> ExposureArrays:
    """The exposures with their flux groups: steady light has one flux in each filter; with `split` so has light of
    known flux.

    The fractions of such light that go into the arms are unknown, and equal in all exposures of a filter with the same
    positions of all elements.
    """
    flux_known = np.asarray(exposures.flux_known)
    group = np.arange(len(flux_known))
    if split:
        for _, rows in settings.layouts():
            group[rows[flux_known[rows]]] = rows[0]
    _, first, of_filter = np.unique(settings.filter[steady], return_index=True, return_inverse=True)
    group[steady] = np.flatnonzero(steady)[first][of_filter]
    shares = steady.any() or (split and flux_known.any())
    _, number = np.unique(group, return_inverse=True)
    return dataclasses.replace(
        exposures,
        flux_known=array(flux_known & (not split)),
        shared=jax.nn.one_hot(number, number.max() + 1, dtype=float) if shares else None,
    )


def plan_for_settings(instrument: Instrument, settings: Settings, filters: Mapping[str, FilterCurve]) -> Plan:
    """Lay out the nodes and bands of `settings`, without any light: for analysis vectors.

    The band of a row is `band_of[row, 0]`. Raises KeyError for a filter missing from `filters` and ValueError for an
    unknown moving element.
    """
    settings.check_moving(instrument.patched().moving())
    count = len(settings)
    of_list = {"hours": np.zeros(count), "exptime": np.zeros(count)}
    blank, kinds, slope = blank_exposures(instrument, count), np.full(count, ""), np.zeros(count, bool)
    plan, band = _plan(instrument, settings, of_list, filters, blank, kinds, slope)
    return dataclasses.replace(plan, band_of=band[:, None])


@functools.lru_cache(maxsize=256)
def _rule(wavelength: tuple[float, ...], throughput: tuple[float, ...], *fringes: float) -> QuadratureRule:
    """Nodes of a band and their weights; cached, since the models of one set mostly share them."""
    path_difference, waves, faint = fringes
    return band_rule(
        np.array(wavelength), np.array(throughput), path_difference=path_difference, waves=waves, faint=faint
    )


def waves_followed(planned: Instrument, curves: Iterable[FilterCurve]) -> tuple[tuple[float, float], ...]:
    """Waves of fringes that the nodes of a plan for `planned` follow in each of the bands: those of full strength, and
    those of all layers of a plate.
    """
    patched = planned.patched()
    return tuple(_fringes(patched, curve) for curve in curves)


def outgrown(
    followed: Iterable[tuple[float, float]], instrument: Instrument, curves: Iterable[FilterCurve]
) -> bool:
    """True where retarders have more fringes in any of the bands than the nodes of a plan follow (`waves_followed`)."""
    patched = instrument.patched()
    return any(
        waves > most
        for curve, limits in zip(curves, followed, strict=True)
        for waves, most in zip(_fringes(patched, curve, 1.0), limits, strict=True)
    )


def extrapolations(instrument: Instrument, curves: Iterable[FilterCurve]) -> tuple[str, ...]:
    """Sentences on materials (patched instrument) in bands beyond their measured wavelengths.

    Raises `DataError` beyond the validity of the formulae.
    """
    names = dict.fromkeys(name for e in instrument.ahead_of_analysers() for name in e.materials)
    sentences = []
    for curve in curves:
        wavelengths = curve.wavelength[curve.throughput > 0]
        for name in names if wavelengths.size else ():
            (low, high), source = (material := MATERIALS[name]).measured, material.source.split(";")[0]
            first, last = float(wavelengths.min()), float(wavelengths.max())
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
    """Waves of the fringes of an instrument (patched) in a band: those of full strength, and those of all layers of a
    plate.

    Retarders in series interfere at the sum of their retardances. Nodes are made for `room` times as many waves.
    Raises `DataError` for more than `THICKEST` waves.
    """
    wavelengths = curve.wavelength[curve.throughput > 0]
    at = np.linspace(wavelengths.min(), wavelengths.max(), SAMPLES) if wavelengths.size else curve.wavelength
    common, bright, faint = list(instrument.train()), 0.0, 0.0
    for arm in instrument.arms:
        retardances = [pair for element in (*common, *arm.train()) if (pair := element.retardances(at))]
        summed = sum(waves_over(at, together) for together, _ in retardances)
        layers = max(
            (waves_over(at, sums) - waves_over(at, together) for together, sums in retardances), default=0.0
        )
        bright, faint = max(bright, summed), max(faint, summed + layers)
    if faint > THICKEST:
        raise fail(
            f"filter {curve.name}: the retarders of the instrument together have {faint:.2g} waves, too many for their "
            "fringes to be followed",
            advice="check the thicknesses of its plates, which are in µm",
        )
    return rounded_up(room * bright, WAVES), rounded_up(room * faint, FAINT)


def _plan(
    instrument: Instrument,
    settings: Settings,
    of_list: Mapping[str, Float[np.ndarray, " n"]],
    filters: Mapping[str, FilterCurve],
    exposures: ExposureArrays,
    kinds: np.ndarray,
    slope: Bool[np.ndarray, " n"],
) -> tuple[Plan, Int[np.ndarray, " n"]]:
    """A plan, but for `Plan.band_of`, and the band of every setting; `slope` is true for those of slopes.

    `of_list` are the conditions of exposures that no setting has, which stars do not see: hours and EXPTIME.
    """
    requirements, patched, count = needs(instrument), instrument.patched(), len(settings)
    moving = patched.moving()
    smooth = sorted(requirements.smooth)
    names = sorted(requirements.conditions - requirements.smooth)
    values = {"temperature": settings.temperature, "hour_angle": settings.hour_angle, **of_list}
    assert set(values) == set(CONDITIONS)
    values |= {f"kind {kind}": (kinds == kind) * 1.0 for kind in instrument.kinds}
    for name in names:
        if name.startswith("hours "):  # an interval, `Conditions.between`
            _, start, _, stop = name.split()
            values[name] = within(values["hours"], start, stop) * 1.0
    # A band is (positions, filter, conditions, smooth ones, colour temperature, slope, KIND); sorting puts equal
    # positions together. NaN (out, flat spectrum) becomes a number that can be sorted. KINDs of one colour are
    # separate, so that a set with another colour for one of them has a plan of the same shape, and the same programs.
    # The angles of all elements, then their turns during the exposure.
    places = [np.nan_to_num(settings.position(prefix), nan=-np.inf) for prefix in moving]
    turns = [settings.turns.get(prefix, np.zeros(count)) for prefix in moving]
    positions = _rows([*places, *turns], count)
    planned = _rows([values[name] for name in names], count)
    followed = _rows([values[name] for name in smooth], count)
    teff = np.nan_to_num(settings.teff).tolist()
    of_filter = settings.filter.astype(str).tolist()
    keys = list(
        zip(positions, of_filter, planned, followed, teff, slope.tolist(), kinds.tolist(), strict=True)
    )
    bands = sorted(set(keys))

    curves = {name: filters[name] for name in sorted({name for _, name, *_ in bands})}
    extrapolations(patched, curves.values())
    # Only temperature changes a plate's phase enough to need extra nodes; growth with hours or the hour angle is small.
    slopes = {"temperature": _phase_per_kelvin(patched, curves.values())} if smooth else {}
    swings = (0.5 * float(np.ptp(values[name])) * slopes.get(name, 0.0) for name in smooth)
    groups, share = _points([band[1:4] for band in bands], [*map(nodes_for, swings)])
    rules = {
        name: _rule(
            tuple(c.wavelength.tolist()),
            tuple(c.throughput.tolist()),
            requirements.path_difference,
            *_fringes(patched, c),
        )
        for name, c in curves.items()
    }
    # Equivalent widths: 0 for a monochromatic band.
    width = {
        n: float(np.trapezoid(c.throughput, c.wavelength) / c.throughput.max()) for n, c in curves.items()
    }
    nodes, weights = (np.concatenate([rules[name][i] for name, *_ in groups]) for i in (0, 1))
    group = np.repeat(np.arange(len(groups)), [len(rules[name][0]) for name, *_ in groups])
    conditions = [*names, *(SMOOTH + name for name in smooth)]

    def per_node(of_group: list[float]) -> Float[Array, " n"]:
        return array(np.asarray(of_group, float)[group])

    laid, last = [], 0
    for value, members in itertools.groupby(bands, key=lambda key: key[0]):
        first, last = last, last + len(list(members))
        pairs = zip(value[: len(moving)], value[len(moving) :], strict=True)
        setting = tuple(None if np.isinf(at) else Turning(at, turn) if turn else at for at, turn in pairs)
        laid.append((setting, first, last))
    plan = Plan(
        wavelength=array(nodes),
        conditions=Conditions(
            band_width=per_node([width[name] for name, *_ in groups]),
            planned={
                name: per_node([(*at, *point)[i] for _, at, point in groups])
                for i, name in enumerate(conditions)
            },
        ),
        node_weight=array(share[:, group] * weights),
        teff=array([key[4] for key in bands], float),
        exposures=exposures,
        band_of=np.zeros((0, 1), int),
        settings=tuple(laid),
        moving=moving,
        slope=array([key[5] for key in bands], float) if slope.any() else None,
    )
    index = {key: i for i, key in enumerate(bands)}
    return plan, np.array([index[key] for key in keys], int)


Moment = tuple[float, ...]
"""Values of some conditions."""


def _points(
    bands: Sequence[tuple[str, Moment, Moment]], most: Sequence[int]
) -> tuple[list[tuple[str, Moment, Moment]], Float[np.ndarray, "b g"]]:
    """Points at which the optics are solved, and the weight of each in each band.

    A point is a filter with values of the conditions; conditions are either followed one by one or, if smooth,
    interpolated between `most` nodes.
    """
    together: dict[tuple[str, Moment], set[Moment]] = {}
    for name, at, followed in bands:
        together.setdefault((name, at), set()).add(followed)
    weights = {case: weights_of_points(moments, most) for case, moments in sorted(together.items())}
    points = [(*case, at) for case, of in weights.items() for at in sorted(set().union(*of.values()))]
    number = {point: i for i, point in enumerate(points)}
    share = np.zeros((len(bands), len(points)))
    for row, (name, at, followed) in zip(share, bands, strict=True):
        for point, part in weights[name, at][followed].items():
            row[number[name, at, point]] = part
    return points, share


def weights_of_points(moments: Collection[Moment], most: Sequence[int]) -> dict[Moment, dict[Moment, float]]:
    """Points at which the optics are solved for some moments (values of conditions), and their weights in each moment.

    The weights are those of Lagrange's interpolation on a grid with at most `most` nodes along each condition; the
    moments themselves are the points where a grid would have no fewer. Source: Trefethen 2013, Approximation Theory,
    chs. 5, 8.
    """
    at = np.array(sorted(moments))
    every = [_along(values, count) for values, count in zip(at.T, most, strict=True)]
    if not np.isfinite(at).all() or np.prod([len(points) for points, _ in every]) >= len(at):
        return {moment: {moment: 1.0} for moment in moments}
    share = np.ones((len(at), 1))
    for _, lagrange in every:
        share = (share[:, :, None] * lagrange[:, None, :]).reshape(len(at), -1)
    grid = list(itertools.product(*(points.tolist() for points, _ in every)))
    rows = zip(at.tolist(), share.tolist(), strict=True)
    return {tuple(moment): dict(zip(grid, row, strict=True)) for moment, row in rows}


def _along(
    values: Float[np.ndarray, " n"], most: int
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "n k"]]:
    """Nodes along one condition, and the values of their Lagrange polynomials at `values`; few values are the nodes
    themselves.
    """
    points, place = np.unique(values, return_inverse=True)
    if len(points) <= most:
        return points, np.eye(len(points))[place]
    middle, half = 0.5 * (points[0] + points[-1]), 0.5 * (points[-1] - points[0])
    lagrange = chebyshev.polynomials((values - middle) / half, most) @ chebyshev.to_coefficients(most)
    return middle + half * chebyshev.nodes(most), lagrange


def nodes_for(swing: float) -> int:
    """Number of values of a condition that serve for a phase that changes by ±`swing` (rad), NaN as 0."""
    count, half, least = SMOOTH_NODES, max(swing, 1e-9) / 2.0, np.log(INTERPOLATED / 2.0)
    while count * np.log(half) - special.gammaln(count + 1.0) > least:
        count += 1
    return count


def _phase_per_kelvin(instrument: Instrument, curves: Iterable[FilterCurve]) -> float:
    """Largest change of a phase (rad) in an instrument (patched): of all layers of a plate, twice the published one."""
    bright = np.concatenate([curve.wavelength[curve.throughput > 0] for curve in curves])
    plates = (element.retardances(bright) for element in instrument.ahead_of_analysers())
    waves = max((of_layers.max(initial=0.0) for _, of_layers in filter(None, plates)), default=0.0)
    return float(4.0 * np.pi * waves * max(crystal.thermal for crystal in CRYSTALS.values()))


def _rows(columns: list[Float[np.ndarray, " n"]], count: int) -> list[tuple[float, ...]]:
    return list(zip(*(column.tolist() for column in columns), strict=True)) if columns else [()] * count
