"""Responses of the residuals to small changes of an instrument: the columns of the score test, all from one program.

A change is a sum of sentences (`model.effects.change`), with a coefficient each. Its column is the derivative of the
used residuals with respect to its amplitude, at neutral: what it does to the light or to the analysis vectors
(`model.responses`) meets the exposures, is multiplied by what it grows with, and the flux takes up its part.

Equation    ∂r/∂a = −P w F f (∂a_k/∂a · s + a_k · ∂s/∂a)
Symbols     w = 1/σ, F flux, f what the change grows with, P projection off the flux (`flux.project_flux`)
Limits      first order. Where detectors are not linear their derivative stands ahead of w.
"""

# Arrays of numpy and of JAX go through the same algebra here.
# pyright: reportArgumentType=false, reportReturnType=false

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from walop_jax.likelihood import limits
from walop_jax.likelihood.engine import PointData, best_flux, point_prediction, real_counts, sharing
from walop_jax.likelihood.flux import Sharing, project_flux
from walop_jax.likelihood.layout import PointReader, median_over_field
from walop_jax.likelihood.likelihood import Likelihood, Vector, used_rows
from walop_jax.likelihood.pieces import NoColumnError, Piece, Resolver
from walop_jax.model import light, responses
from walop_jax.model.compiled import compiled
from walop_jax.model.effects.base import Effect, with_amplitudes
from walop_jax.model.effects.cameras import REFERENCE_COUNTS
from walop_jax.model.effects.change import Change as Sentence
from walop_jax.model.effects.optics import LARGEST_GAP
from walop_jax.model.elements import WavePlate
from walop_jax.model.elements.wave_plate import AirGap
from walop_jax.model.instrument import Instrument
from walop_jax.model.plan import Plan
from walop_jax.model.planning import plan_for
from walop_jax.model.responses import GENERATORS, LightResponses, Responses
from walop_jax.model.sources import Sight

Change = Sequence[tuple[float, Sentence]]
"""A sum of sentences with their coefficients; a factor of a sentence may be a function of what `Laid` has."""

LEAST_SURVIVING = 1e-3  # a contrast of 1 % that the band reduces by this factor is 0.001 %: of no consequence
GAPS_TOGETHER = 32  # thicknesses of air whose fringes are computed together, in one program for any number
SLOTS = ("inserted", "numbers", "globally", "throughput", "mixed")  # of the analysis vectors
_BEHIND = ("square", "median", "reported", "afterglow")  # what acts on counts as the detectors report them


def columns(likelihood: Likelihood, values: Vector, changes: Sequence[Change]) -> Float[np.ndarray, "d a"]:
    """Derivatives of the used residuals (rows) with respect to the amplitudes of changes, at neutral.

    `values` are all parameters of the model. Raises `NoColumnError` for a sentence that the responses do not hold.
    """
    return Columns(likelihood, values).of(changes)


def own_columns(
    likelihood: Likelihood, values: Vector, effects: Sequence[Effect]
) -> Float[np.ndarray, "d a"]:
    """The same for effects of a user's own, amplitude by amplitude: the light path with each of them, differentiated.

    Effects that differ in nothing but numbers share a program.
    """
    found, plans = [], {}
    for effect in effects:
        structure = jax.tree.structure(effect)
        if structure not in plans:
            plans[structure] = Likelihood.of(likelihood.calset, likelihood.model, (effect,))
        own = plans[structure]
        instrument = own.model.instrument(values)
        parts = [used_rows(_own(instrument, own.plan, (effect,), batch), batch) for batch in own.points]
        found.append(np.concatenate(parts))
    return np.concatenate(found, axis=1)


def _own_at_point(
    instrument: Instrument, plan: Plan, effects: tuple[Effect, ...], point: PointData
) -> Float[Array, "d a"]:
    neutral, put = with_amplitudes(instrument, effects)
    at_neutral = put(neutral)
    unit = point_prediction(at_neutral, plan, point)
    flux = best_flux(at_neutral, plan, unit, point)

    def counts(amplitudes: list[Float[Array, ...]]) -> Float[Array, "e k"]:
        active = put(amplitudes)
        return real_counts(active, plan, point_prediction(active, plan, point), flux)

    _, push = jax.linearize(counts, neutral)
    flat, to_tree = ravel_pytree(neutral)
    some = min(limits.AMPLITUDES_AT_ONCE, max(flat.size, 1))
    change = jax.lax.map(lambda one: push(to_tree(one)), jnp.eye(flat.size), batch_size=some) * point.weight
    _, along = jax.jvp(lambda f: real_counts(at_neutral, plan, unit, f), (flux,), (jnp.ones_like(flux),))
    projected = project_flux(
        change, along * point.weight, plan.exposures.flux_known, sharing(instrument, plan)
    )
    return -projected.reshape(len(change), -1).T


_own = compiled(
    jax.vmap(_own_at_point, (None, None, None, 0)),
    optimised_above=limits.OPTIMISED_ABOVE,
    kept_as="own_columns",
)


# ----------------------------------------------------------------------------------------------- compiled programs


class _AtPoint(NamedTuple):
    """Quantities of a field point; sites are the point itself and, where ghosts are active, the opposite one."""

    vectors: Responses  # leading axis: sites
    light: LightResponses
    share: Float[Array, "m e k"]  # of the counts at a site that a camera sees
    counts: Float[Array, "m e k"]  # for light of unit flux at the sites, ahead of ghosts
    opposite: Float[Array, "e k"]
    flux: Float[Array, "e f"]
    electrons: Float[Array, "e k"]
    reported: Float[Array, "e k"]
    along: Float[Array, "e k"]


def _at_point(instrument: Instrument, plan: Plan, point: PointData) -> _AtPoint:
    assert point.opposite_sky is not None
    x, y = jnp.stack([point.x, -point.x]), jnp.stack([point.y, -point.y])
    sights = Sight(plan.exposures, jnp.stack([point.sky, point.opposite_sky]), point.source, x, y)
    sites = 2 if light.has_ghosts(instrument) else 1
    vectors = jax.vmap(responses.vector_responses, (None, None, 0, 0))(instrument, plan, x[:sites], y[:sites])
    lights = jax.vmap(responses.light_responses, (None, Sight(None, 0, None, 0, 0)))(
        instrument, sights._replace(sky=sights.sky[:sites], x=x[:sites], y=y[:sites])
    )
    counts = jax.vmap(lambda v, taken: jnp.einsum("eks,eks->ek", v[point.band], taken))(
        vectors.vectors, lights.taken
    )
    if sites == 1:
        opposite = light.counts(
            instrument,
            light.band_rows(instrument, plan, x[1], y[1]),
            instrument.throughput.at(x[1], y[1]),
            sights._replace(sky=point.opposite_sky, x=x[1], y=y[1]),
            point.band,
        )
    else:
        opposite = counts[1]
    unit = light.with_ghosts(instrument, counts[0], opposite, point.source)
    one = jnp.ones_like(unit)
    seen = light.with_ghosts(instrument, jnp.zeros_like(unit), one, point.source)
    flux = best_flux(instrument, plan, unit, point)
    reported, along = jax.jvp(
        lambda f: real_counts(instrument, plan, unit, f), (flux,), (jnp.ones_like(flux),)
    )
    return _AtPoint(
        vectors, lights, jnp.stack([one, seen])[:sites], counts, opposite, flux, flux * unit, reported, along
    )


def _fringes(
    instrument: Instrument,
    plan: Plan,
    gaps: Float[Array, " g"],
    x: Float[Array, "p m"],
    y: Float[Array, "p m"],
) -> Float[Array, "p m w g b k 4"]:
    at = jax.vmap(responses.fringe_responses, (None, None, None, 0, 0))
    return jax.vmap(at, (None, None, None, 0, 0))(instrument, plan, gaps, x, y)


def _visibilities(instrument: Instrument, plan: Plan, gaps: Float[Array, " g"]) -> Float[Array, " g"]:
    """Share of the fringes of air that the band leaves of them that blurs them least."""
    phase = 4.0 * jnp.pi * gaps[:, None] / light.node_wavelengths(instrument, plan)
    weight = light.band_weights(instrument, plan)
    real, imaginary = jnp.cos(phase) @ weight.T, jnp.sin(phase) @ weight.T
    return jnp.sqrt(jnp.max(real**2 + imaginary**2, axis=1))


def _pushed(
    instrument: Instrument,
    plan: Plan,
    counts: Float[Array, "p e k"],
    change: Float[Array, "a p e k"],
) -> Float[Array, "a p e k"]:
    """Change of the counts that the detectors report, for counts that change."""

    def at(counts: Float[Array, "e k"], change: Float[Array, "e k"]) -> Float[Array, "e k"]:
        return jax.jvp(lambda n: light.detected(instrument, plan.exposures, n), (counts,), (change,))[1]

    return jax.vmap(jax.vmap(at), (None, 0))(counts, change)


_at_points = compiled(
    jax.vmap(_at_point, (None, None, 0)), optimised_above=limits.SELDOM_OPTIMISED_ABOVE, kept_as="responses"
)
_fringes_at = compiled(_fringes, optimised_above=limits.SELDOM_OPTIMISED_ABOVE, kept_as="fringes")
_visible = compiled(_visibilities, kept_as="visibilities")
_detectors = compiled(_pushed, kept_as="detector_slopes")


# --------------------------------------------------------------------------------------------------- factors


@dataclasses.dataclass(frozen=True)
class Laid:
    """Quantities that factors may ask for: points along the first axis, exposures along the second.

    Of angles those in the list of exposures: NaN where an element is out.
    """

    likelihood: Likelihood
    x: Float[np.ndarray, "p 1"]
    y: Float[np.ndarray, "p 1"]

    def __getattr__(self, name: str) -> Any:
        if name == "number":
            return np.arange(len(self.likelihood.flux_known))[None]
        return np.asarray(getattr(self.likelihood.plan.exposures, name))[None]

    def of_kind(self, name: str) -> Any:
        """True in exposures of a KIND."""
        return np.asarray(self.likelihood.plan.exposures.of_kind(name))[None]

    def angle(self, prefix: str) -> Any:
        """Angle of a moving element, NaN where it is out."""
        position = self.likelihood.calset.exposures.position(prefix)
        return np.deg2rad(np.where(position.inside, position.angle, np.nan))[None]


def generator(name: str) -> Float[np.ndarray, "4 4"]:
    """Generator of a change of the light ahead of the polariser; "q", "u" are added, whatever the light is."""
    if name not in ("q", "u"):
        return GENERATORS[name]
    added = np.zeros((4, 4))
    added["qu".index(name) + 1, 0] = 1.0
    return added


# ----------------------------------------------------------------------------------------------------- columns


class Columns:
    """The columns of any changes at one set of values of the parameters of a likelihood."""

    def __init__(self, likelihood: Likelihood, values: Vector) -> None:
        self.likelihood, self.values = likelihood, values
        self.instrument = likelihood.model.instrument(values)
        self.plan = likelihood.plan
        self.patched = self.instrument.patched()
        planned = "temperature" in self.plan.conditions.planned
        self._resolver = Resolver(self.patched, () if planned else ("kelvin",))
        self._known: dict[Sentence, list[Piece]] = {}
        floor = likelihood.model.template.cameras.floor
        self.reader = PointReader(likelihood.calset, self.plan, mirrored=True, floor=floor)
        groups = self.plan.exposures.shared
        self.shared = Sharing(self.patched.cameras.together, None if groups is None else np.asarray(groups))

    def has(self, change: Change) -> bool:
        """True if the responses hold a change."""
        try:
            self.pieces_of(change)
        except NoColumnError:
            return False
        return True

    def pieces_of(self, change: Change) -> list[Piece]:
        """The pieces of a change. Raises `NoColumnError` for a sentence that the responses do not hold."""
        found = []
        for size, sentence in change:
            if sentence not in self._known:
                self._known[sentence] = list(self._resolver.pieces(sentence))
            found += [piece._replace(size=size * piece.size) for piece in self._known[sentence]]
        return found

    def survives(self, gaps: Sequence[float]) -> dict[float, bool]:
        """True where the bands leave anything of the fringes of air, by its thickness (µm)."""
        every = list(dict.fromkeys(gaps))
        if not every:
            return {}
        padded = np.pad(np.array(every), (0, -len(every) % (8 * GAPS_TOGETHER)), mode="edge")
        left = np.asarray(_visible(self.instrument, self.fringe_plan, padded))
        return {gap: bool(value > LEAST_SURVIVING) for gap, value in zip(every, left, strict=False)}

    @functools.cached_property
    def fringe_plan(self) -> Plan:
        """The exposures with nodes that follow the fringes of air."""
        patched, calset = self.patched, self.likelihood.calset
        gap = AirGap(0.0, 1.0, LARGEST_GAP)  # pyright: ignore[reportArgumentType]
        for place in patched.places(WavePlate):
            patched = patched.changed(place, air_gaps=lambda gaps: (*gaps, gap))
        return plan_for(patched, calset.exposures, calset.filters, calset.sources)

    @functools.cached_property
    def broad(self) -> Float[np.ndarray, " b"]:
        """1 for bands that a shift of the band displaces (`light.BROAD`)."""
        width = np.where(
            np.asarray(self.plan.node_weight) != 0.0, np.asarray(self.plan.conditions.band_width), 0.0
        )
        return np.where(width.max(axis=1) > light.BROAD, 1.0, 0.0)

    @functools.cached_property
    def median(self) -> Float[np.ndarray, "e k"]:
        """Median counts over the field, in every exposure: those that the model has, or else those that it expects.

        A column of the measured counts would hold their noise, and find it in the residuals.
        """
        known = self.plan.exposures.median_counts
        if known is not None:
            return np.asarray(known)
        _, residual = self.likelihood.residuals(self.values)
        counts, weight = map(self.likelihood.points.gathered, ("counts", "weight"))
        used = self.likelihood.used[..., None]
        return median_over_field(np.where(used, counts - residual / np.where(used, weight, 1.0), np.nan))

    def of(self, changes: Sequence[Change]) -> Float[np.ndarray, "d a"]:
        """The columns of changes: rows run over points, then exposures, then cameras, used ones only."""
        return self.rounded(changes, len(changes))[0]

    def rounded(
        self, changes: Sequence[Change], exact: int
    ) -> tuple[Float[np.ndarray, "d a"], Float[np.ndarray, "d b"]]:
        """The columns of the first, `exact` changes, and those of the others in single precision."""
        pieces = [self.pieces_of(change) for change in changes]
        likelihood, size = self.likelihood, limits.RESPONSES_TOGETHER
        used, cameras = likelihood.used, len(self.patched.cameras)
        length = cameras * int(used.sum())
        parts = (
            (pieces[:exact], np.empty((exact, length))),
            (pieces[exact:], np.empty((len(changes) - exact, length), np.float32)),
        )
        every, first = [piece for each in pieces for piece in each], 0
        for start in range(0, len(used), size):
            rows = cameras * int(used[start : start + size].sum())
            block = ResponseBlock(self, start, every)
            for some, found in parts:
                block.fill(some, found[:, first : first + rows])
            first += rows
        return parts[0][1].T, parts[1][1].T


class ResponseBlock:
    """Some field points: responses brought together with their exposures.

    Arrays run over sites (m), cameras (k) and pairs of point and exposure (n): those that are used, or all of them
    where something else than the flux couples them.
    """

    def __init__(self, of: Columns, start: int, pieces: Sequence[Piece]) -> None:
        self.of, size = of, limits.RESPONSES_TOGETHER
        (data,) = of.reader.batches(start, start + size, size)
        found = _at_points(of.instrument, of.plan, data)
        self.found: _AtPoint = jax.tree.map(np.asarray, found)
        self.x, self.y, weight, self.band, self.source = (
            np.asarray(getattr(data, name)) for name in ("x", "y", "weight", "band", "source")
        )
        self.used = weight[..., 0] > 0
        self.linear = light.is_linear(of.patched)
        self.whole = not self.linear or of.shared.exposures is not None
        self.chosen = np.arange(self.used.size) if self.whole else np.flatnonzero(self.used)
        self.sites, self.cameras = self.found.share.shape[1], weight.shape[2]
        self.weight = self._pairs(weight)
        flux = np.broadcast_to(self.found.flux, weight.shape)
        self.flux = self._pairs(flux) * (self.weight if self.linear else 1.0)
        self.share = self._pairs(self.found.share)
        self._patterns: dict[tuple[Any, ...], np.ndarray] = {}
        self._cores: dict[tuple[Any, ...], np.ndarray] = {}
        self._solve(pieces, np.asarray(data.x), np.asarray(data.y))

    def _pairs(self, values: Float[np.ndarray, "p ..."]) -> Float[np.ndarray, ...]:
        """(p e k) → (k n), (p m e k) → (m k n)."""
        last = np.moveaxis(values, (0, -2), (-2, -1))  # (..., k, p, e)
        flat = last.reshape(*last.shape[:-2], -1)
        return flat if self.whole else np.ascontiguousarray(flat[..., self.chosen])

    # -------------------------------------------------------------------------------- what is multiplied by factors

    def _pattern(self, factors: tuple[Any, ...]) -> Float[np.ndarray, "m n"]:
        """Product of factors at every site."""
        if factors not in self._patterns:
            each = []
            for sign in (1.0, -1.0)[: self.sites]:
                at = Laid(self.of.likelihood, sign * self.x[:, None], sign * self.y[:, None])
                texts = tuple(f for f in factors if isinstance(f, str))
                value = Sentence("", "", "", texts, units=self.of.patched.units).factor(at)
                for other in (f for f in factors if not isinstance(f, str)):
                    value = value * other(at)
                whole = np.broadcast_to(np.nan_to_num(np.asarray(value)), self.used.shape)
                each.append(whole.reshape(-1)[self.chosen])
            self._patterns[factors] = np.stack(each)
        return self._patterns[factors]

    def _solve(self, pieces: Sequence[Piece], x: Vector, y: Vector) -> None:
        """All cores: what slots do to the counts, or to weighted counts where detectors are linear."""
        keys = list(dict.fromkeys((p.kind, *p.at) for p in pieces))
        of_vectors = [key for key in keys if key[0] in (*SLOTS, "fringes")]
        fringes = self._fringes([key[2] for key in of_vectors if key[0] == "fringes"], x, y)
        # Points that no exposure measures are in no pair.
        some = max(1, int(limits.RESPONSE_NUMBERS // max(1, self.sites * self.cameras * len(self.chosen))))
        for first in range(0, len(of_vectors), some):
            part = of_vectors[first : first + some]
            change = np.stack([self.change(key, fringes) for key in part])
            self._cores |= dict(zip(part, self._met(change), strict=True))
        for key in keys:
            if key not in self._cores:
                self._cores[key] = self._core(key)

    def _fringes(self, gaps: Sequence[float], x: Vector, y: Vector) -> dict[tuple[int, float], np.ndarray]:
        """Responses (p m b k 4) to fringes, by plate and thickness of the air."""
        every = list(dict.fromkeys(gaps))
        if not every:
            return {}
        sites = [np.stack([one, -one], 1)[:, : self.sites] for one in (x, y)]
        padded = np.pad(np.array(every), (0, -len(every) % GAPS_TOGETHER), mode="edge")
        parts = [
            np.asarray(_fringes_at(self.of.instrument, self.of.fringe_plan, some, *sites))
            for some in np.split(padded, len(padded) // GAPS_TOGETHER)
        ]
        whole = np.concatenate(parts, axis=3)
        return {
            (plate, gap): whole[:, :, plate, i]
            for i, gap in enumerate(every)
            for plate in range(whole.shape[2])
        }

    def change(self, key: tuple[Any, ...], fringes: Mapping[tuple[int, float], np.ndarray]) -> np.ndarray:
        """Change (p m b k 4) of the analysis vectors."""
        kind, *at = key
        vectors = self.found.vectors
        if kind == "fringes":
            return fringes[at[0], at[1]]
        if kind == "mixed":
            target, origin = at
            change = np.zeros_like(vectors.vectors)
            change[:, :, :, target] = vectors.vectors[:, :, :, origin]
            return change
        if kind == "globally":
            change = vectors.globally[:, :, at[0]]
            return change * self.of.broad[:, None, None] if at[1] else change
        return getattr(vectors, kind)[(slice(None), slice(None), *at)]

    def _met(self, change: Float[np.ndarray, "s p m b k 4"]) -> Float[np.ndarray, "s m k n"]:
        """Analysis vectors that change, with the light of the exposures."""
        count = change.shape[0]
        taken = np.transpose(self.found.light.taken, (1, 3, 0, 4, 2))  # m k p 4 e
        whole = np.zeros((count, self.sites, self.cameras, *self.used.shape))
        for band in np.unique(self.band):
            here = self.band == band
            at = np.flatnonzero(here.any(axis=0))
            some = np.transpose(change[:, :, :, band], (2, 3, 1, 0, 4)) @ taken[..., at]  # m k p s e
            if not here[:, at].all():
                some = some * here[:, at][:, None]
            whole[..., at] += np.transpose(some, (3, 0, 1, 2, 4))
        flat = whole.reshape(*whole.shape[:3], -1)
        return (flat if self.whole else flat[..., self.chosen]) * (self.share * self.flux)

    def _core(self, key: tuple[Any, ...]) -> Float[np.ndarray, "m k n"]:
        kind, *at = key
        found = self.found
        if kind == "light":
            vectors = np.take_along_axis(
                found.vectors.vectors, self.band[:, None, :, None, None], axis=2
            )  # p m e k 4
            raw = np.einsum("pmeks,pmes->pmek", vectors, self._light(at)) * found.light.factor
            return self._pairs(raw) * self.share * self.flux
        cameras = np.asarray(at)
        if kind == "counts":
            return self._pairs(found.counts * cameras) * self.share * self.flux
        if kind == "opposite":
            extended = np.where(self.source < 0, 1.0, 0.0)[..., None]
            return self._alone(found.opposite * extended * cameras) * self.flux
        # Behind the detectors: counts as they are reported.
        reported = found.reported
        if kind == "square":
            added = reported**2 / REFERENCE_COUNTS
        elif kind == "median":
            added = np.broadcast_to(self.of.median, reported.shape)
        elif kind == "reported":
            added = reported
        else:
            assert kind == "afterglow"
            order = np.argsort(np.asarray(self.of.plan.exposures.hours), kind="stable")
            added = np.zeros_like(reported)
            added[:, order[1:]] = reported[:, order[:-1]]
        return self._alone(added * cameras) * (self.weight if self.linear else 1.0)

    def _alone(self, values: Float[np.ndarray, "p e k"]) -> Float[np.ndarray, "m k n"]:
        """Values that come in once, whatever sites there are."""
        own = self._pairs(values)[None]
        return np.concatenate([own, *([np.zeros_like(own)] * (self.sites - 1))])

    def _light(self, at: Sequence[Any]) -> Float[np.ndarray, "p m e 4"]:
        """Change of the Stokes vectors behind the polariser."""
        stokes, name = self.found.light.stokes, at[0]
        if not isinstance(name, str):
            change = self.found.light.slopes[:, :, name]
            return change if len(at) == 1 else change * (self.source == at[1])[:, None, :, None]
        if name == "ahead":
            there = self.found.light.from_sky
        else:
            there = np.broadcast_to(np.asarray(self.of.plan.exposures.clp_in) * 1.0, stokes.shape[:-1])
        return stokes @ generator(at[1]).T * there[..., None]

    # --------------------------------------------------------------------------------------------------- columns

    def fill(self, changes: Sequence[Sequence[Piece]], found: Float[np.ndarray, "a d"]) -> None:
        """Write the columns of changes, for these points."""
        size = limits.COLUMNS_TOGETHER // 4
        for first in range(0, len(changes), size):
            some = changes[first : first + size]
            change = np.zeros((len(some), self.cameras, len(self.chosen)))
            behind = None if self.linear else np.zeros_like(change)
            for a, pieces in enumerate(some):
                for piece in pieces:
                    core, pattern = self._cores[(piece.kind, *piece.at)], self._pattern(piece.factors)
                    into = change if behind is None or piece.kind not in _BEHIND else behind
                    for site in range(self.sites):
                        into[a] += core[site] * (piece.size * pattern[site])
            if behind is not None:
                change = (self._reported(change) + behind) * self.weight
            self._write(change, found[first : first + len(some)])

    def _reported(self, change: Float[np.ndarray, "a k n"]) -> Float[np.ndarray, "a k n"]:
        of, size = self.of, limits.COLUMNS_TOGETHER // 4
        cube = np.zeros((size, *self.used.shape, self.cameras))
        cube[: len(change)] = np.moveaxis(change.reshape(len(change), self.cameras, *self.used.shape), 1, -1)
        pushed = np.asarray(_detectors(of.instrument, of.plan, self.found.electrons, cube))[: len(change)]
        return np.moveaxis(pushed, -1, 1).reshape(change.shape)

    def _write(self, change: Float[np.ndarray, "a k n"], found: Float[np.ndarray, "a d"]) -> None:
        """Project the flux out and write rows in the order of the residuals."""
        along = self._pairs(self.found.along) * self.weight
        known = self.of.likelihood.flux_known
        shape = (*self.used.shape, self.cameras)
        if self.of.shared.exposures is not None:

            def cube(pairs: Float[np.ndarray, "... k n"]) -> np.ndarray:
                return np.moveaxis(pairs, -2, -1).reshape(*pairs.shape[:-2], *shape)

            left = project_flux(cube(change), cube(along), known, self.of.shared)
            found[:] = -left[:, self.used].reshape(len(found), -1)
            return
        free = np.where(np.broadcast_to(~known, self.used.shape).reshape(-1)[self.chosen], 1.0, 0.0)
        together = self.of.shared.cameras
        groups = (
            [np.arange(self.cameras)]
            if together is None
            else [np.flatnonzero(g) for g in np.unique(together, axis=0)]
        )
        for group in groups:
            own = along[group]
            power = np.sum(own**2, axis=0)
            unit = own * (free / np.sqrt(np.where(power > 0, power, 1.0)))
            taken = np.einsum("akn,kn->an", change[:, group], unit)
            change[:, group] -= taken[:, None] * unit
        inside = self.used.reshape(-1)[self.chosen]
        rows = found.reshape(len(found), -1, self.cameras)
        for k in range(self.cameras):
            np.negative(change[:, k] if inside.all() else change[:, k][:, inside], out=rows[..., k])
