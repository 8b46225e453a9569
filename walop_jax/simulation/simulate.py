"""Synthetic calibration sets that carry their truth: an as-built instrument, its light path, and noise.

The counts come from the light path of the package (`engine.prediction`), so a set tests everything behind the
physics; the physics itself is held against outside data and the oracle of the tests.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from walop_jax.data.records import Block, CalibrationSet, Sources, StatedErrors
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.io.text import rounded
from walop_jax.likelihood import engine
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model import legendre, light
from walop_jax.model.cameras import with_noise_floor
from walop_jax.model.compiled import array
from walop_jax.model.dependence import needs
from walop_jax.model.effects import EFFECTS, EffectKind, effect_by_name, in_order
from walop_jax.model.effects.base import Context, Effect
from walop_jax.model.elements.simple import Analyser
from walop_jax.model.instrument import Instrument, adapted
from walop_jax.model.light_path import NoSuchPlaceError
from walop_jax.model.parameters import Component, leaves, unknown_name, values_of, with_values
from walop_jax.model.plan import with_median
from walop_jax.model.sources import Standards
from walop_jax.model.specification import Model, make_model, series_indices
from walop_jax.model.standards import standards_of
from walop_jax.simulation.observing_plan import EXPOSED, ObservingPlan

ByPointExposureCamera = Float[np.ndarray, "p e k"]

LEVEL = 0.5
LEVEL_SCATTER = 0.03  # of the cameras' throughput around 0.5
STRUCTURE = 0.02  # rms over the field, relative
TRANSPARENCY = (0.7, 1.0)
_MEDIAN_ROUNDS = 6  # the median that a pedestal refers to has the pedestal in it: each round gains its level
_POLARISED = (0.01, 0.06)
_PROBE = 0.01  # of q and u
_STAR_TEFF = (5000.0, 9500.0)
_LISTED = 12  # numbers of a parameter that are listed


class Simulated(NamedTuple):
    """A synthetic calibration set and the true instrument that made it."""

    calset: CalibrationSet
    truth: Instrument

    @property
    def values(self) -> dict[str, float]:
        """The true value of every parameter by name; the names are those of a fit."""
        return truth_values(self.truth)

    def __repr__(self) -> str:
        return f"{self.calset!r}\ntruth: {self.truth!r}"


def truth_values(truth: Component) -> dict[str, float]:
    """The true value of every parameter by name; the names are those of a fit."""
    names = (leaf.name for leaf in leaves(truth))
    return {name: float(value) for name, value in zip(names, np.asarray(values_of(truth)), strict=True)}


def draw_instrument(model: Model, rng: np.random.Generator) -> Instrument:
    """An instrument as it might have been built.

    Every parameter with a prior is drawn from it (efficiencies of analysers stop at 1), tied ones follow; throughputs
    are drawn as smooth maps: levels 0.5 ± 0.03, structure over the field of 2 % rms. The scale that all cameras share
    is a gauge, so the constant of camera N0 is 0.5; of arms whose fraction of the light is unknown the first camera is
    0.5 all over. Other parameters without a prior stay at their start values.
    """
    values = model.start
    for i, p in enumerate(model.parameters):
        if p.prior is not None:
            values[i] = rng.normal(*p.prior)
    values[series_indices(model.template)] = _throughput(model.template, rng).ravel()
    instrument = model.instrument(values[model.masters])
    for place in instrument.places(Analyser):
        instrument = instrument.changed(place, efficiency=lambda drawn: jnp.minimum(drawn, 1.0))
    return instrument


def _throughput(template: Instrument, rng: np.random.Generator) -> Float[np.ndarray, "k t"]:
    terms = np.array(legendre.terms(template.throughput.degree))
    degree = terms.sum(axis=1)
    cameras = len(template.throughput.coefficients)
    level = 0.5 + LEVEL_SCATTER * rng.standard_normal(cameras)
    shape = rng.standard_normal((cameras, len(terms)))
    size = np.where(degree > 0, 1.0 / np.maximum(degree, 1), 0.0)
    size /= max(float(np.linalg.norm(size)), 1.0)
    # The mean square of P_i P_j over the field is 1 / ((2i + 1)(2j + 1)).
    relative = STRUCTURE * shape * size * np.sqrt(np.prod(2 * terms + 1, axis=1))
    relative[:, 0] = 1.0
    references = list(template.cameras.ratio_references)
    level[references], relative[references, 1:] = level[0], 0.0
    return 0.5 * level[:, None] / level[0] * relative


def _catalogue(plan: ObservingPlan, rng: np.random.Generator) -> tuple[Sources, Standards]:
    """A catalogue of standards, and the true stars."""
    n = plan.standards
    degree = np.where(np.arange(n) < plan.unpolarised, 0.0, rng.uniform(*_POLARISED, n))
    angle = rng.uniform(0.0, 2.0 * np.pi, n)
    catalogue = np.stack([degree * np.cos(angle), degree * np.sin(angle)])
    true = catalogue + plan.catalogue_error * rng.standard_normal((2, n))
    error, teff = np.full(n, plan.catalogue_error), rng.uniform(*_STAR_TEFF, n)
    if plan.zero_stars:
        field = plan.zero_error * rng.standard_normal((2, 1))
        catalogue, true = np.append(catalogue, [[0.0], [0.0]], 1), np.append(true, field, 1)
        error, teff = np.append(error, plan.zero_error), np.append(teff, rng.uniform(*_STAR_TEFF))
    names = plan.star_names
    sources = Sources(
        source=np.arange(len(names)),
        name=np.array(names, dtype="U"),
        q=catalogue[0],
        u=catalogue[1],
        q_err=error,
        u_err=error,
        teff=teff,
        filter=np.full(len(names), plan.filter_names[0] if plan.star_lmax else ""),
        scatter=np.where(np.arange(len(names)) < n, 0.0, plan.zero_scatter),
    )
    standards = standards_of(sources, plan.exposures(), plan.curves())
    lmax = np.asarray(standards.lmax).copy()
    if plan.star_lmax:
        polarised = np.append(np.arange(n) - plan.unpolarised, np.full(len(names) - n, -1))
        in_turn = np.array(plan.star_lmax)[polarised % len(plan.star_lmax)]
        lmax = np.where(polarised < 0, lmax, in_turn)
    return sources, dataclasses.replace(standards, q=array(true[0]), u=array(true[1]), lmax=array(lmax))


def _stars_of(plan: ObservingPlan, catalogue: Sources, true: Standards) -> tuple[Sources, Standards]:
    """The first stars of a catalogue, with a value each, and the true ones: as in `true`, by name."""
    rows = np.unique(catalogue.stars)[: len(plan.star_names)]
    sources = Sources(**{f.name: getattr(catalogue, f.name)[rows] for f in dataclasses.fields(catalogue)})
    standards = standards_of(sources, plan.exposures(), plan.curves())
    true_values, values = truth_values(true), truth_values(standards)
    return sources, with_values(standards)(np.array([true_values.get(*pair) for pair in values.items()]))


def _scattered(
    plan: ObservingPlan,
    truth: Instrument,
    expected: ByPointExposureCamera,
    counts: Callable[[Instrument], ByPointExposureCamera],
    rng: np.random.Generator,
) -> ByPointExposureCamera:
    """Counts that the stars of a field have beyond those of their mean q, u: light is linear in them."""
    _, source = plan.layout()
    measured, scatter = source[:, :, None] == plan.standards, np.zeros_like(expected)
    for axis in "qu":
        moved = truth.changed("standard", **{axis: lambda value: value.at[plan.standards].add(_PROBE)})
        deviation = plan.zero_scatter * rng.standard_normal(len(expected))
        scatter += np.where(measured, deviation[:, None, None] * (counts(moved) - expected) / _PROBE, 0.0)
    return scatter


@dataclasses.dataclass(frozen=True)
class PhotonNoise:
    """Photon noise and read noise (electron rms per measurement): N = Poisson(μ) + Normal(0, read_noise²).

    The N_ERR of an observer comes from the measured counts, σ(N): counts that came out low are given more
    weight, which biases a mean by −1 electron. Source: Howell 2006, Handbook of CCD Astronomy, 4.4.
    """

    read_noise: float = 30.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.read_noise) and self.read_noise > 0):
            raise ValueError(f"read noise {self.read_noise} must be a positive number of electrons")

    def sigma(self, counts: Float[np.ndarray, ...]) -> Float[np.ndarray, ...]:
        """Standard deviation of a measurement that expects `counts` (electron), or that found them."""
        return np.sqrt(np.maximum(counts, 0.0) + self.read_noise**2)

    def draw(
        self, rng: np.random.Generator, expected: Float[np.ndarray, ...]
    ) -> tuple[Float[np.ndarray, ...], Float[np.ndarray, ...]]:
        """Return measured counts and the N_ERR that an observer would state for them.

        Raises ValueError for expected counts that are negative or not finite.
        """
        if not (np.isfinite(expected).all() and np.all(expected >= 0.0)):
            raise ValueError(
                "expected counts must be finite and non-negative: an effect, or a prior, leaves no possible light"
            )
        # Read noise first: how many random numbers a Poisson draw takes depends on the expected counts.
        read = self.read_noise * rng.standard_normal(expected.shape)
        counts = rng.poisson(expected) + read
        return counts, self.sigma(counts)


def simulate(
    plan: ObservingPlan,
    seed: int = 0,
    *,
    instrument: Instrument | None = None,
    effects: Sequence[Effect] = (),
    noiseless: bool = False,
    steady: bool = False,
    catalogue_seed: int | None = None,
    catalogue: Sources | None = None,
    night: int | None = None,
) -> Simulated:
    """Simulate a calibration run: the same plan, seed and effects give the same set, bit for bit.

    `instrument` is the true one (default: drawn from the priors of the base model); its standards are
    replaced by those of the simulated catalogue, `effects` are added to it. `noiseless` leaves the expected
    counts as they are and states the errors that they would have; `steady` gives every exposure the mean transparency
    and every star the mean brightness. Effects that depend on the run are made
    with `plan.context()`. `catalogue_seed` draws the standards apart from the rest (default: from `seed`): nights of
    one survey share their stars. With a `catalogue` nothing is drawn: the standards of `instrument` are what its stars
    really are, and the plan takes the first of them. `night` is the number of days after the start of the plan; each
    has noise and weather of its own, also with the same seed.
    """
    plan = plan if not night else dataclasses.replace(plan, mjd=plan.start + night)
    sources, truth = true_instrument(
        plan, seed, instrument=instrument, effects=effects, catalogue_seed=catalogue_seed, catalogue=catalogue
    )
    streams = np.random.SeedSequence(seed).spawn(4)[2:]
    if night:
        streams = np.random.SeedSequence((seed, night)).spawn(2)
    sky, noise = map(np.random.default_rng, streams)
    blank = _without_light(plan, sources, seed, len(truth.cameras))
    flux = fluxes(plan, None if steady else sky)
    expected = _expected(blank, truth, flux)
    if plan.zero_stars and plan.zero_scatter > 0 and not noiseless:
        seeds = np.random.SeedSequence(seed if catalogue_seed is None else catalogue_seed).spawn(5)[4]
        stars = np.random.default_rng(seeds)
        expected += _scattered(plan, truth, expected, lambda other: _expected(blank, other, flux), stars)
    detector = PhotonNoise(plan.read_noise)
    if noiseless:
        counts, sigma = expected, detector.sigma(expected)
    else:
        # A generator for each point: a last digit that another machine computes differently stays where it is.
        drawn = [detector.draw(*pair) for pair in zip(noise.spawn(len(expected)), expected, strict=True)]
        counts, sigma = (np.stack(arrays) for arrays in zip(*drawn, strict=True))
        stated = detector.sigma(expected)
        true_error = np.hypot(plan.noise_scale * stated, plan.noise_fraction * expected)
        if (plan.noise_scale, plan.noise_fraction) != (1.0, 0.0):
            counts = expected + (counts - expected) * true_error / stated
        if floor := truth.cameras.noise_floor:
            # Noise up to the errors that fits take the cameras to have; N_ERR has it not.
            beyond = np.sqrt(with_noise_floor(stated, expected, floor) ** 2 - stated**2)
            counts += beyond * noise.standard_normal(expected.shape)
    table = TableIntensities.of(blank.intensities, blank.points)
    at = table.point, table.exposure
    measured = dataclasses.replace(table, counts=counts[at], sigma=sigma[at])
    return Simulated(dataclasses.replace(blank, intensities=measured), truth)


def true_instrument(
    plan: ObservingPlan,
    seed: int = 0,
    *,
    instrument: Instrument | None = None,
    effects: Sequence[Effect] = (),
    catalogue_seed: int | None = None,
    catalogue: Sources | None = None,
) -> tuple[Sources, Instrument]:
    """The catalogue of standards and the true instrument that `simulate` uses for the same arguments."""
    build, stars = (np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(4)[:2])
    if catalogue_seed is not None:
        stars = np.random.default_rng(np.random.SeedSequence(catalogue_seed).spawn(4)[1])
    if catalogue is None or instrument is None:
        sources, standards = _catalogue(plan, stars)
    else:
        sources, standards = _stars_of(plan, catalogue, instrument.standard)
    if instrument is None:
        nominal = adapted(plan.design, throughput_degree=plan.throughput_degree, throughput=LEVEL)
        instrument = draw_instrument(make_model(plan.name, nominal), build)
    active = in_order((*instrument.effects, *effects))
    return sources, jax.tree.map(
        array, dataclasses.replace(instrument.with_source(standards), effects=active)
    )


def as_planned(plan: ObservingPlan) -> CalibrationSet:
    """The set that the instrument as designed would give in steady weather, without noise: the layout of a plan.

    What a plan will show depends on the instrument as built, and on the weather: `diagnosis.planned_limits`.
    """
    return simulate(plan, instrument=plan.design, noiseless=True, steady=True).calset


def _without_light(plan: ObservingPlan, sources: Sources, seed: int, cameras: int) -> CalibrationSet:
    """The calibration set that the plan announces, before any light: counts and errors are 1."""
    points = plan.points()
    used, source = plan.layout()
    ones = np.ones((*used.shape, cameras))
    block = Block(x=points.x, y=points.y, counts=ones, sigma=ones, used=used, source=source)
    return CalibrationSet(
        instrument=plan.name,
        site=plan.site,
        origin=f"walop-jax simulate, seed {seed}",
        exposures=plan.exposures(),
        points=points,
        sources=sources,
        filters=plan.curves(),
        intensities=TableIntensities.dense(points, block),
        stated_errors=StatedErrors.of(plan.stated_errors),
    )


def fluxes(plan: ObservingPlan, rng: np.random.Generator | None) -> Float[np.ndarray, "p e"]:
    """Flux (p, e) of every point and exposure: transparency, illumination of the field, brightness of the stars.

    A camera of throughput 0.5 sees a quarter of unpolarised light. Without `rng` all factors are at their means.
    """
    used, source = plan.layout()
    exposures = plan.exposures()
    # A kind of a user's own has no usual time: each of its exposures sees the electrons of the plan.
    usual = [EXPOSED.get(str(kind), t) for kind, t in zip(exposures.kind, exposures.exptime, strict=True)]
    electrons = plan.electrons * exposures.exptime / np.array(usual)
    if rng is None:
        brightness = np.append(np.full(len(plan.star_names), np.mean(TRANSPARENCY)), 1.0)
        return 4.0 * electrons * np.mean(TRANSPARENCY) * np.broadcast_to(brightness[source], used.shape)
    transparency = rng.uniform(*TRANSPARENCY, used.shape[1])
    illumination = rng.uniform(0.9, 1.1, used.shape[0])
    field = [np.mean(TRANSPARENCY)] * (len(plan.star_names) - plan.standards)
    stars = rng.uniform(*TRANSPARENCY, plan.standards)
    brightness = np.concatenate([stars, field, [1.0]])  # the last: no star
    return 4.0 * electrons * illumination[:, None] * transparency * brightness[source]


def _expected(
    blank: CalibrationSet, truth: Instrument, flux: Float[np.ndarray, "p e"]
) -> ByPointExposureCamera:
    """Expected counts (electron) of every (point, exposure), the response of the detectors included."""
    likelihood = Likelihood.of(blank, make_model(blank.instrument, truth))
    unit = np.concatenate(
        [np.asarray(engine.prediction(truth, likelihood.plan, c)) for c in likelihood.points]
    )
    light_counts = flux[:, :, None] * unit[: len(flux)]
    if light.is_linear(truth):
        return light_counts
    counts = light_counts
    for _ in range(_MEDIAN_ROUNDS if needs(truth).median else 1):
        used_counts = np.where(likelihood.used[:, :, None], counts, np.nan)
        plan = with_median(likelihood.plan, np.nanmedian(used_counts, axis=0))
        at = array(light_counts), array(blank.points.x), array(blank.points.y)
        counts = np.asarray(engine.detected(truth, plan.exposures, *at))
    return counts


def effects_given(effect: Any, plan: ObservingPlan, catalogue: Sequence[EffectKind]) -> list[Effect]:
    """The effects that a set is to hold: texts, objects, or a dict, {"clp_wobble": {"amplitude": 0.06, "phase": 1.0}}.

    Raises ValueError for one that the instrument has no place for.
    """
    if isinstance(effect, Mapping):
        pairs = {
            name: ",".join(f"{k}:{v}" for k, v in size.items()) if isinstance(size, Mapping) else size
            for name, size in effect.items()
        }
        effect = [f"{name}={size}" for name, size in pairs.items()]
    context, hidden = plan.context(), []
    for entry in [effect] if isinstance(effect, str) else effect or ():
        hidden.append(effect_from_text(entry, context, catalogue) if isinstance(entry, str) else entry)
        try:
            hidden[-1].patch(plan.design)
        except NoSuchPlaceError as error:
            raise ValueError(f"effect {hidden[-1].name!r}: {error}") from None
    return hidden


def effect_from_text(text: str, context: Context, catalogue: Sequence[EffectKind] = EFFECTS) -> Effect:
    """The effect of `catalogue` that a text stands for.

    A value is a number, numbers between slashes (one for each element of the parameter), or a word for a discrete
    choice. Raises ValueError, with the nearest names, for names that do not exist, and for values that are missing.
    """
    name, _, assignments = (item.strip() for item in text.partition("="))
    kind = effect_by_name(name, catalogue)
    parameters = tuple(kind.numbers())
    values: dict[str, Any] = {}
    if assignments and ":" not in assignments:
        if len(parameters) != 1:
            listed = f"{name}={','.join(f'{n}:…' for n in parameters)}" if parameters else f"{name} alone"
            raise ValueError(f"effect {name!r} has {len(parameters)} parameters, not one: give {listed}")
        values[parameters[0]] = _value(assignments, name)
    elif assignments:
        values = _named_values(assignments, name)
    accepted = [*parameters, *kind.neutral(context).choices()]
    for parameter in values:
        if parameter not in accepted:
            error = unknown_name(f"parameter of {name}", parameter, accepted)
            raise ValueError(f"{error}; {name} takes {', '.join(accepted)}")
    if parameters and not any(parameter in values for parameter in kind.amplitudes()):
        alternatives = " or ".join(kind.amplitudes())
        raise ValueError(f"{name} needs a value of {alternatives}, e.g. {name}={kind.amplitudes()[0]}:…")
    try:
        return kind.of(context, **values)
    except (TypeError, ValueError) as error:
        raise ValueError(f"effect {name!r}: {assignments!r} does not fit its parameters ({error})") from None


def _named_values(text: str, name: str) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for item in text.split(","):
        parameter, colon, value = (piece.strip() for piece in item.partition(":"))
        if not colon or not value or parameter in values:
            raise ValueError(f"effect {name!r}: {item!r} is not par:value (each once)")
        values[parameter] = _value(value, name)
    return values


def _value(text: str, name: str) -> Any:
    try:
        if "/" in text:
            return [float(item) for item in text.split("/")]
        return int(text) if text.lstrip("+-").isdigit() else float(text)
    except ValueError:
        if text.isidentifier():
            return text
        raise ValueError(f"effect {name!r}: {text!r} is not a number") from None


def effect_in_words(effect: Effect) -> str:
    """An effect as `--effect` writes it, with its units: wollaston_axis=angle:0.3 deg."""
    numbers = []
    for name, declared in effect.declarations().items():
        values = np.ravel(getattr(effect, name))
        text = "/".join(rounded(float(v)) for v in values)
        if values.size > _LISTED:
            text = f"{values.size} numbers of {rounded(float(np.sqrt(np.mean(values**2))))} rms"
        if values.size:
            numbers.append(f"{name}:{text} {declared.unit}".rstrip())
    return f"{effect.name}={', '.join(numbers)}" if numbers else effect.name
