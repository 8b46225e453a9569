"""Making a plan: the nodes and bands of a set of exposures, as detailed as the instrument and its effects need them."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from walop_jax.data.records import Exposures, FilterCurve, Sources
from walop_jax.model.dependence import needs
from walop_jax.model.instrument import Instrument
from walop_jax.model.materials import REFERENCE_TEMPERATURE
from walop_jax.model.plan import Plan, State, exposure_arrays, hours_of
from walop_jax.model.quadrature import band_rule
from walop_jax.model.ray import CONDITIONS, Conditions


def _state(exposures: Exposures, e: int, moving: Collection[str]) -> State:
    found = []
    for prefix in moving:
        position = exposures.position(prefix)
        found.append(float(position.angle[e]) if position.inside[e] else None)
    return tuple(found)


def _teff(exposures: Exposures, sources: Sources | None, e: int, s: int) -> float:
    if s >= 0 and sources is not None and np.isfinite(sources.teff[s]):
        return float(sources.teff[s])
    return float(exposures.teff[e])


def _conditions(exposures: Exposures) -> dict[str, Float[np.ndarray, " e"]]:
    """Everything that the optics may ask for; a missing temperature is the reference, all else 0."""
    temperature = np.where(np.isfinite(exposures.temp), exposures.temp, REFERENCE_TEMPERATURE)
    values = {
        "temperature": temperature,
        "hour_angle": np.nan_to_num(exposures.ha),
        "hours": hours_of(exposures),
    }
    assert set(values) == set(CONDITIONS)
    return values


def equivalent_width(curve: FilterCurve) -> float:
    """∫ THROUGHPUT dλ / max THROUGHPUT (µm); 0 for a monochromatic band."""
    return float(np.trapezoid(curve.throughput, curve.wavelength) / curve.throughput.max())


def plan_for(
    instrument: Instrument,
    exposures: Exposures,
    filters: Mapping[str, FilterCurve],
    sources: Sources | None = None,
) -> Plan:
    """Lay out the nodes and bands of `exposures`, as detailed as the instrument and its effects need it.

    Raises KeyError for a filter that `filters` does not hold and ValueError for a KIND without a source.
    """
    asked = needs(instrument)
    moving = instrument.patched().moving()
    values = _conditions(exposures)
    names = sorted(asked.conditions)
    n_sources = 0 if sources is None else len(sources)
    # A band is (positions, filter, conditions, colour temperature); sorting puts equal positions together.
    # NaN (flat spectrum) and None (out) become sortable stand-ins.
    states = [_state(exposures, e, moving) for e in range(len(exposures))]
    moments = [tuple(float(values[name][e]) for name in names) for e in range(len(exposures))]
    keys = {}
    for e in range(len(exposures)):
        standard = exposures.kind[e] == "standard" and not exposures.clp_in[e]
        for s in range(-1, n_sources if standard else 0):
            teff = _teff(exposures, sources, e, s)
            keys[e, s] = (
                tuple(-np.inf if angle is None else angle for angle in states[e]),
                str(exposures.filter[e]),
                moments[e],
                teff if np.isfinite(teff) else 0.0,
            )
    bands = sorted(set(keys.values()))
    index = {key: i for i, key in enumerate(bands)}
    band_of = np.zeros((len(exposures), n_sources + 1), int)
    for e in range(len(exposures)):
        band_of[e] = index[keys[e, -1]]
        for s in range(n_sources):
            if (e, s) in keys:
                band_of[e, s + 1] = index[keys[e, s]]

    groups = sorted({(name, moment) for _, name, moment, _ in bands})
    rules = {
        name: band_rule(
            filters[name].wavelength, filters[name].throughput, path_difference=asked.path_difference
        )
        for name, _ in groups
    }
    width = {name: equivalent_width(filters[name]) for name in rules}
    offset, start = {}, 0
    for group in groups:
        offset[group] = start
        start += len(rules[group[0]][0])
    weight = np.zeros((len(bands), start))
    for i, (_, name, moment, _) in enumerate(bands):
        first = offset[name, moment]
        weight[i, first : first + len(rules[name][1])] = rules[name][1]

    def per_node(of_group: list[float]) -> Float[Array, " n"]:
        counts = [len(rules[name][0]) for name, _ in groups]
        return jnp.asarray(np.repeat(np.asarray(of_group, float), counts))

    settings = []
    found = [key[0] for key in bands]
    for value in sorted(set(found)):
        state = tuple(None if np.isinf(angle) else float(angle) for angle in value)
        settings.append((state, found.index(value), len(found) - found[::-1].index(value)))
    known = [source.kind for source in instrument.sources if source.flux_known]
    return Plan(
        wavelength=jnp.asarray(np.concatenate([rules[name][0] for name, _ in groups])),
        conditions=Conditions(
            band_width=per_node([width[name] for name, _ in groups]),
            planned={name: per_node([moment[i] for _, moment in groups]) for i, name in enumerate(names)},
        ),
        node_weight=jnp.asarray(weight),
        teff=jnp.asarray([key[3] for key in bands]),
        exposures=exposure_arrays(exposures, instrument.kinds, known),
        band_of=band_of,
        settings=tuple(settings),
        moving=moving,
    )
