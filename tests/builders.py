"""Small pieces that tests of the model and the likelihood are built from; none of them computes light."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from oracle import forward

from walop_jax.data.records import Exposures, FilterCurve
from walop_jax.model import light
from walop_jax.model.compiled import compiled
from walop_jax.model.effects.base import Effect
from walop_jax.model.instrument import Instrument, nominal_instrument
from walop_jax.model.parameters import leaves, values_of, with_values
from walop_jax.model.plan import Plan
from walop_jax.model.planning import plan_for
from walop_jax.model.sources import PointIllumination

NAN = float("nan")
_BLANK: dict[str, Any] = {
    "kind": "clp", "mjd": 61043.85, "exptime": 30.0, "filter": "band", "clp_in": False, "clp_angle": NAN,
    "chwp_in": False, "chwp_angle": NAN, "temp": 10.0, "ha": 0.0, "ra": NAN, "dec": NAN, "rotator": NAN,
    "teff": NAN,
}  # fmt: skip

# Names of the oracle for the parameters of the package.
ORACLE_NAMES = {
    "sky.depolarisation": "delta",
    "collimator.diattenuation": "coll",
    "collimator.q": "coll_q",
    "collimator.u": "coll_u",
    "chwp.quartz": "quartz_c",
    "chwp.mgf2": "mgf2_c",
    "pupil.magnification": "magnification",
    "pupil.distortion": "distortion",
    **{
        f"half{half}.{ours}": f"{theirs}_{half}"
        for half in (1, 2)
        for ours, theirs in (
            ("wedge", "wedge"), ("plate.quartz", "quartz"), ("plate.mgf2", "mgf2"), ("efficiency", "eta")
        )
    },
}  # fmt: skip


def exposures(*rows: dict[str, Any]) -> Exposures:
    """Exposures from what differs from a blank one; an angle puts its element into the beam."""
    full = []
    for row in rows:
        inside = {f"{what}_in": f"{what}_angle" in row for what in ("clp", "chwp")}
        full.append(_BLANK | inside | row)
    columns = {key.upper(): np.array([row[key] for row in full]) for key in _BLANK}
    return Exposures.from_columns(columns | {"EXPOSURE": np.arange(len(rows))})


def curve(wavelength: Sequence[float], throughput: Sequence[float]) -> FilterCurve:
    return FilterCurve("band", np.asarray(wavelength, float), np.asarray(throughput, float))


def monochromatic(wavelength: float) -> FilterCurve:
    return curve([wavelength], [1.0])


def broad_band() -> FilterCurve:
    """A super-Gaussian r band tabulated every 0.5 nm, 461 rows."""
    wavelength = np.linspace(0.505, 0.735, 461)
    return curve(wavelength, np.exp(-(((wavelength - 0.62) / 0.062) ** 8)))


def setting_plan(
    filter_curve: FilterCurve, settings: Sequence[float | None] = (None,), teff: float = NAN
) -> Plan:
    """A plan with one band per setting (deg, or None: out) of the calibration plate, in the order given."""
    rows = [{"teff": teff} | ({} if s is None else {"chwp_angle": s}) for s in settings]
    plan = plan_for(nominal_instrument(), exposures(*rows), {"band": filter_curve})
    assert [state[0] for state, _, _ in plan.settings] == list(settings)
    return plan


def as_built(instrument: Instrument, rng: np.random.Generator, sigmas: float = 1.0) -> Instrument:
    """An instrument whose numbers scatter around the given ones by prior widths (or solver scales)."""
    values = np.asarray(values_of(instrument))
    width = [leaf.width or leaf.scale for leaf in leaves(instrument)]
    return with_values(instrument)(
        jnp.asarray(values + sigmas * np.array(width) * rng.standard_normal(values.size))
    )


def south(
    rng: np.random.Generator | None = None, effects: Sequence[Effect] = (), **options: Any
) -> Instrument:
    instrument = nominal_instrument("WALOP-SOUTH", **options)
    built = instrument if rng is None else as_built(instrument, rng)
    return dataclasses.replace(built, effects=tuple(effects))


def without_wedges(instrument: Instrument) -> Instrument:
    """The middle of the field is then at normal incidence in both halves."""
    for half in ("half1", "half2"):
        instrument = instrument.changed(f"{half}.wedge", angle=jnp.asarray(0.0))
    return instrument


def with_plates(
    instrument: Instrument,
    quartz: float,
    mgf2: float,
    places: Sequence[str] = ("chwp", "half1.plate", "half2.plate"),
) -> Instrument:
    """The instrument with crystals of that thickness (µm)."""
    for place in places:
        instrument = instrument.changed(f"{place}.quartz", thickness=jnp.asarray(quartz))
        instrument = instrument.changed(f"{place}.mgf2", thickness=jnp.asarray(mgf2))
    return instrument


def value(instrument: Instrument, name: str) -> float:
    """A parameter by its name, such as "half2.plate.mgf2"."""
    names = [leaf.name for leaf in leaves(instrument)]
    return float(values_of(instrument)[names.index(name)])


def matrix(vectors: Any) -> np.ndarray:
    """Rows (m21, m22, m23), (m31, m32, m33): O1 − E1 and O2 − E2."""
    return np.asarray(light.instrument_matrix(jnp.asarray(vectors), ((0, 1), (2, 3))))


def field(rng: np.random.Generator, count: int, edge: float = 0.29) -> tuple[np.ndarray, np.ndarray]:
    return rng.uniform(-edge, edge, count), rng.uniform(-edge, edge, count)


def oracle_params(instrument: Instrument) -> dict[str, Any]:
    """The same instrument in the words of the oracle."""
    values = dict(
        zip((leaf.name for leaf in leaves(instrument)), np.asarray(values_of(instrument)), strict=True)
    )
    params = {theirs: float(values[ours]) for ours, theirs in ORACLE_NAMES.items()}
    params["throughput"] = np.array(
        [[values[f"throughput.n{k}.p{i}{j}"] for i, j in forward.TERMS] for k in range(4)]
    )
    return params | {"q": np.asarray(instrument.standard.q), "u": np.asarray(instrument.standard.u)}


def _vectors(instrument: Instrument, plan: Plan, x: jax.Array, y: jax.Array) -> jax.Array:
    def one(px: jax.Array, py: jax.Array) -> jax.Array:
        rows = light.band_rows(instrument, plan, px, py)
        return light.camera_vectors(instrument, rows, instrument.throughput.at(px, py), px, py)

    return jax.vmap(one)(x, y)


_compiled_vectors = compiled(_vectors)


def vectors(instrument: Instrument, plan: Plan, x: Any, y: Any) -> np.ndarray:
    """Analysis vectors (point, band, camera, Stokes) of the package."""
    x, y = (np.atleast_1d(np.asarray(v, float)) for v in (x, y))
    return np.asarray(_compiled_vectors(instrument, plan, jnp.asarray(x), jnp.asarray(y)))


def _counts(
    instrument: Instrument,
    plan: Plan,
    x: jax.Array,
    y: jax.Array,
    sky: jax.Array,
    source: jax.Array,
    band: jax.Array,
) -> jax.Array:
    rows = light.band_rows(instrument, plan, x, y)
    illumination = PointIllumination(plan.exposures, sky, source, x, y)
    return light.counts(instrument, rows, instrument.throughput.at(x, y), illumination, band)


_compiled_counts = compiled(_counts)


def counts(
    instrument: Instrument, plan: Plan, x: float, y: float, sky: Any = None, source: Any = None
) -> np.ndarray:
    """Counts (exposure, camera) at a field point, for light of unit flux."""
    e = plan.exposures.clp_in.size
    source = np.full(e, -1) if source is None else np.asarray(source)
    band = np.asarray(plan.band_of)[np.arange(e), np.minimum(source + 1, plan.band_of.shape[1] - 1)]
    return np.asarray(
        _compiled_counts(
            instrument, plan, jnp.asarray(float(x)), jnp.asarray(float(y)),
            jnp.zeros((e, 2)) if sky is None else jnp.asarray(sky), jnp.asarray(source), jnp.asarray(band),
        )
    )  # fmt: skip
