"""Responses of the residuals to small changes of an instrument: the columns of the score test, all from one program.

A change is a sum of descriptions (`model.effects.change`), with a coefficient each. Its column is the derivative of the
used residuals with respect to its amplitude, at neutral: its change of the light or of the analysis vectors
(`model.slots`) meets the exposures, is multiplied by its factors, and the flux takes up its part.

Equation    ∂r/∂a = −P w F f (∂a_k/∂a · s + a_k · ∂s/∂a)
Symbols     w = 1/σ, F flux, f factors of the change, P projection off the flux (`flux.project_flux`)
Limits      first order. Where detectors are not linear their derivative stands ahead of w.
"""

# Arrays of numpy and of JAX go through the same algebra here.
# pyright: reportArgumentType=false, reportReturnType=false

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from walop_jax.io.shapes import Vector
from walop_jax.likelihood import limits
from walop_jax.likelihood.engine import (
    PointData,
    best_flux,
    counts_and_slope,
    detected_counts,
    flux_groups,
    point_prediction,
)
from walop_jax.likelihood.flux import project_flux
from walop_jax.likelihood.layout import median_over_field
from walop_jax.likelihood.likelihood import Likelihood, used_rows
from walop_jax.model import light, slots
from walop_jax.model.compiled import compiled
from walop_jax.model.effects.base import Effect, with_amplitudes
from walop_jax.model.effects.cameras import ADDED, Ghost
from walop_jax.model.effects.change import KINDS, Change, InExposures, NoSlotError, SlotTerm, product
from walop_jax.model.effects.optics import LARGEST_GAP
from walop_jax.model.elements.wave_plate import AirGap, WavePlate
from walop_jax.model.instrument import Instrument
from walop_jax.model.light_path import NoSuchPlaceError
from walop_jax.model.plan import Plan
from walop_jax.model.planning import plan_for
from walop_jax.model.slots import LightSlopes, Slot, VectorSlopes
from walop_jax.model.sources import ExposureArrays, PointIllumination

SumOfChanges = Sequence[tuple[float, Change]]
"""A sum of descriptions with their coefficients."""

LEAST_SURVIVING = 1e-3  # a contrast of 1 % that the band reduces by this factor is 0.001 %: of no consequence
CAMERAS = ("counts", "opposite", *ADDED)
"""Stages of slots in some cameras: counts ahead of the detectors, of the opposite point, what detectors add to them."""
GAPS_TOGETHER = 10  # thicknesses of air whose fringes are computed together, in one program for any number


def columns(
    likelihood: Likelihood, values: Vector, changes: Sequence[SumOfChanges]
) -> Float[np.ndarray, "d a"]:
    """Derivatives of the used residuals (rows) with respect to the amplitudes of changes, at neutral.

    `values` are all parameters of the model. Raises `NoSlotError` for a description that has no slots.
    """
    return Columns(likelihood, values).of(changes)


def own_columns(
    likelihood: Likelihood, values: Vector, effects: Sequence[Effect]
) -> Float[np.ndarray, "d a"]:
    """The same derivatives for effects of a user's own, by differentiation of their `patch`.

    Effects that differ in their numbers alone use one program.
    """
    columns, plans = [], {}
    for effect in effects:
        structure = jax.tree.structure(effect)
        if structure not in plans:
            plans[structure] = Likelihood.of(likelihood.calset, likelihood.model, (effect,))
        probe = plans[structure]
        instrument = probe.model.instrument(values)
        rows = [used_rows(_own(instrument, probe.plan, (effect,), batch), batch) for batch in probe.points]
        columns.append(np.concatenate(rows))
    return np.concatenate(columns, axis=1)


def _own_at_point(
    instrument: Instrument, plan: Plan, effects: tuple[Effect, ...], point: PointData
) -> Float[Array, "d a"]:
    neutral, put = with_amplitudes(instrument, effects)
    at_neutral = put(neutral)
    unit = point_prediction(at_neutral, plan, point)
    flux = best_flux(at_neutral, plan, unit, point)

    def counts(amplitudes: list[Float[Array, ...]]) -> Float[Array, "e k"]:
        active = put(amplitudes)
        return detected_counts(active, plan, point_prediction(active, plan, point), flux, point)

    _, push = jax.linearize(counts, neutral)
    flat, to_tree = ravel_pytree(neutral)
    size = min(limits.AMPLITUDES_AT_ONCE, max(flat.size, 1))
    change = jax.lax.map(lambda row: push(to_tree(row)), jnp.eye(flat.size), batch_size=size) * point.weight
    along = counts_and_slope(at_neutral, plan, unit, flux, point)[1] * point.weight
    projected = project_flux(change, along, plan.exposures.flux_known, flux_groups(instrument, plan, point))
    return -projected.reshape(len(change), -1).T


_own = compiled(
    jax.vmap(_own_at_point, (None, None, None, 0)),
    optimised_above=limits.OPTIMISED_ABOVE,
    kept_as="own_columns",
)


# ----------------------------------------------------------------------------------------------- compiled programs


class _AtPoint(NamedTuple):
    """Quantities of a field point; sites are the point itself and, where ghosts are active, the opposite one."""

    vectors: VectorSlopes  # leading axis: sites
    light: LightSlopes
    share: Float[Array, "m e k"]  # fraction of the counts at a site that a camera sees
    counts: Float[Array, "m e k"]  # for light of unit flux at the sites, ahead of ghosts
    opposite: Float[Array, "e k"]  # of extended sources
    flux: Float[Array, "e f"]
    electrons: Float[Array, "e k"]
    added: dict[str, Float[Array, "e k"]]  # `ADDED` to the counts as they are reported
    along: Float[Array, "e k"]


def _at_point(instrument: Instrument, plan: Plan, point: PointData) -> _AtPoint:
    assert point.opposite_sky is not None
    x, y = jnp.stack([point.x, -point.x]), jnp.stack([point.y, -point.y])
    illuminations = PointIllumination(
        plan.exposures, jnp.stack([point.sky, point.opposite_sky]), point.source, x, y
    )
    sites = 2 if light.has_ghosts(instrument) else 1
    vectors = jax.vmap(slots.vector_slopes, (None, None, 0, 0))(instrument, plan, x[:sites], y[:sites])
    lights = jax.vmap(slots.light_slopes, (None, PointIllumination(None, 0, None, 0, 0)))(
        instrument, illuminations._replace(sky=illuminations.sky[:sites], x=x[:sites], y=y[:sites])
    )
    counts = jnp.einsum("meks,meks->mek", vectors.vectors[:, point.band], lights.taken)
    if sites == 1:
        rows, throughput = light.band_rows(instrument, plan, x[1], y[1]), instrument.throughput.at(x[1], y[1])
        illumination = illuminations._replace(sky=point.opposite_sky, x=x[1], y=y[1])
        opposite = light.counts(instrument, rows, throughput, illumination, point.band)
    else:
        opposite = counts[1]
    unit = light.with_ghosts(instrument, counts[0], opposite, point.source)
    direct = jnp.ones_like(unit)
    ghost_share = light.with_ghosts(instrument, jnp.zeros_like(unit), direct, point.source)
    flux = best_flux(instrument, plan, unit, point)
    reported, along = counts_and_slope(instrument, plan, unit, flux, point)
    share, ghost = jnp.stack([direct, ghost_share])[:sites], Ghost(jnp.ones(unit.shape[1]))
    opposite = ghost.seen(point.source < 0, opposite)
    added = {stage: add(reported, plan.exposures) for stage, add in ADDED.items() if stage != "median"}
    return _AtPoint(vectors, lights, share, counts, opposite, flux, flux * unit, added, along)


def _visibilities(instrument: Instrument, plan: Plan, gaps: Float[Array, " g"]) -> Float[Array, " g"]:
    """Contrast of the fringes of air gaps in the band that blurs them least, 0 to 1."""
    phase = 4.0 * jnp.pi * gaps[:, None] / light.node_wavelengths(instrument, plan)
    weight = light.band_weights(instrument, plan)
    real, imaginary = jnp.cos(phase) @ weight.T, jnp.sin(phase) @ weight.T
    return jnp.sqrt(jnp.max(real**2 + imaginary**2, axis=1))


def _pushed(
    instrument: Instrument,
    plan: Plan,
    counts: Float[Array, "p e k"],
    change: Float[Array, "a p e k"],
    x: Float[Array, " p"],
    y: Float[Array, " p"],
) -> Float[Array, "a p e k"]:
    """Change of the counts that the detectors report, for changes (a, p, e, k) of the counts that arrive."""

    def at(
        counts: Float[Array, "e k"], change: Float[Array, "e k"], x: Float[Array, ""], y: Float[Array, ""]
    ) -> Float[Array, "e k"]:
        return jax.jvp(lambda n: light.detected(instrument, plan.exposures, n, x, y), (counts,), (change,))[1]

    return jax.vmap(jax.vmap(at), (None, 0, None, None))(counts, change, x, y)


def _at_each(instrument: Instrument, plan: Plan, points: PointData) -> _AtPoint:
    return jax.lax.map(lambda p: _at_point(instrument, plan, p), points, batch_size=limits.RESPONSES_AT_ONCE)


_at_points = compiled(_at_each, optimised_above=limits.SELDOM_OPTIMISED_ABOVE, kept_as="responses")
_at_sites = jax.vmap(slots.fringe_slopes, (None, None, None, 0, 0))
_fringes_at = compiled(
    jax.vmap(_at_sites, (None, None, None, 0, 0)),
    optimised_above=limits.OPTIMISED_ABOVE,
    kept_as="fringes",
)
_mean_wavelengths = compiled(
    light.mean_wavelengths, optimised_above=limits.OPTIMISED_ABOVE, kept_as="wavelengths"
)
_visible = compiled(_visibilities, optimised_above=limits.SELDOM_OPTIMISED_ABOVE, kept_as="visibilities")
_detectors = compiled(_pushed, kept_as="detector_slopes")


# ----------------------------------------------------------------------------------------------------- columns


class Columns:
    """The columns of any changes at one set of values of the parameters of a likelihood."""

    def __init__(self, likelihood: Likelihood, values: Vector) -> None:
        self.likelihood, self.values = likelihood, values
        self.instrument = likelihood.model.instrument(values)
        self.plan = likelihood.plan
        self.patched = self.instrument.patched()
        self.of_vectors, self.of_light = slots.vector_slots(self.patched), slots.light_slots(self.patched)
        self.exposures: ExposureArrays = jax.tree.map(np.asarray, self.plan.exposures)
        self.fringed = slots.fringe_places(self.patched)
        self._known: dict[Change, list[SlotTerm]] = {}
        self.reader = dataclasses.replace(likelihood.points.reader, mirrored=True)
        self._responses: _AtPoint | None = None
        self._data: dict[int, PointData] = {}
        self._fringes: dict[tuple[int, tuple[float, ...]], Float[np.ndarray, "p m w g b k 4"]] = {}

    def has(self, change: SumOfChanges) -> bool:
        """True if a change is a sum of slots to first order."""
        try:
            self.terms_of(change)
        except NoSlotError:
            return False
        return True

    def terms_of(self, change: SumOfChanges) -> list[SlotTerm]:
        """Slots of a change, coefficients and factors. Raises `NoSlotError` for a description that has no slots."""
        terms = []
        for size, description in change:
            if description not in self._known:
                self._known[description] = self._terms(description)
            terms += [term._replace(size=size * term.size) for term in self._known[description]]
        return terms

    def _terms(self, description: Change) -> list[SlotTerm]:
        try:
            terms = list(KINDS[description.kind].slots(self.patched, description))
        except NoSuchPlaceError as error:
            raise NoSlotError(str(error)) from None
        # Of the wavelengths in a band the light of an exposure has the mean.
        inside = (term.slot[0] != "light" and "colour" in term.factors for term in terms)
        if any(inside) or not all(self._holds(term.slot) for term in terms):
            raise NoSlotError(description.text)
        if description.kind != "thermal" or self.plan.conditions.holds("temperature"):
            return terms
        return [term._replace(factors=(*term.factors, "kelvin")) for term in terms]

    def _holds(self, slot: Slot) -> bool:
        if slot[0] == "light":
            return slot[:4] in self.of_light
        if slot[0] == "fringes":
            return slot[1] in self.fringed
        return slot[0] in CAMERAS or slot in self.of_vectors

    def survives(self, gaps: Sequence[float]) -> dict[float, bool]:
        """True where the bands leave anything of the fringes of air, by its thickness (µm)."""
        distinct = list(dict.fromkeys(gaps))
        if not distinct:
            return {}
        padded = np.pad(np.array(distinct), (0, -len(distinct) % 256), mode="edge")
        visibility = np.asarray(_visible(self.instrument, self.fringe_plan, padded))
        return {gap: bool(value > LEAST_SURVIVING) for gap, value in zip(distinct, visibility, strict=False)}

    @functools.cached_property
    def fringe_plan(self) -> Plan:
        """The exposures with nodes that follow the fringes of air."""
        patched, calset = self.patched, self.likelihood.calset
        gap = AirGap(0.0, 1.0, LARGEST_GAP)  # pyright: ignore[reportArgumentType]
        for place in patched.places(WavePlate):
            patched = patched.changed(place, air_gaps=lambda gaps: (*gaps, gap))
        plan = plan_for(patched, calset.exposures, calset.filters, calset.sources)
        return dataclasses.replace(plan, work=self.plan.work)

    @functools.cached_property
    def wavelength(self) -> Float[np.ndarray, " b"]:
        """Mean wavelengths (µm) of the bands."""
        return np.asarray(_mean_wavelengths(self.patched, self.plan))

    @functools.cached_property
    def median(self) -> Float[np.ndarray, "e k"]:
        """Median counts over the field, in every exposure: those that the model has, or else those that it expects.

        A column of the measured counts would hold their noise, and find it in the residuals.
        """
        planned = self.plan.exposures.median_counts
        if planned is not None:
            return np.asarray(planned)
        _, residual = self.likelihood.residuals(self.values)
        residual = self.likelihood.flux_groups.independent(residual, inverse=True)
        counts, weight = map(self.likelihood.points.gathered, ("counts", "weight"))
        used = self.likelihood.used[..., None]
        return median_over_field(np.where(used, counts - residual / np.where(used, weight, 1.0), np.nan))

    def responses(self, start: int) -> tuple[PointData, _AtPoint]:
        """Data and responses of `limits.RESPONSES_TOGETHER` points from `start` on, kept if the set is small.

        Those that are kept lie in one array for all points, whose memory goes back to the system as a whole.
        """
        if start in self._data:
            return self._data[start], self._kept_at(start)
        size = limits.RESPONSES_TOGETHER
        (data,) = self.reader.batches(start, start + size, size)
        response = jax.tree.map(np.asarray, _at_points(self.instrument, self.plan, data))
        points = len(self.likelihood.used)
        if points > limits.RESPONSES_KEPT:
            return data, response
        if self._responses is None:
            rows = -(-points // size) * size
            self._responses = jax.tree.map(lambda leaf: np.empty((rows, *leaf.shape[1:])), response)
        self._data[start] = data
        for kept, leaf in zip(*map(jax.tree.leaves, (self._kept_at(start), response)), strict=True):
            kept[...] = leaf
        return data, self._kept_at(start)

    def _kept_at(self, start: int) -> _AtPoint:
        """The responses that are kept of the points from `start` on."""
        rows = slice(start, start + limits.RESPONSES_TOGETHER)
        return jax.tree.map(lambda leaf: leaf[rows], self._responses)

    def forget(self) -> None:
        """Give back the memory of all responses; they are computed anew where they are asked for again."""
        self._responses = None
        self._data.clear()
        self._fringes.clear()

    def fringes(
        self, start: int, gaps: tuple[float, ...], x: Vector, y: Vector, sites: int
    ) -> Float[np.ndarray, "p m w g b k 4"]:
        """Slopes in the fringes of `gaps` (µm) at every place of `fringed`, for the points of `responses`."""
        if (start, gaps) in self._fringes:
            return self._fringes[start, gaps]
        at = [np.stack([c, -c], 1)[:, :sites] for c in (x, y)]
        padded = np.pad(np.array(gaps), (0, -len(gaps) % GAPS_TOGETHER), mode="edge")
        batches = padded.reshape(-1, GAPS_TOGETHER)
        slopes = [_fringes_at(self.instrument, self.fringe_plan, batch, *at) for batch in batches]
        joined = np.concatenate(slopes, axis=3)[:, :, :, : len(gaps)]
        if len(self.likelihood.used) <= limits.FRINGES_KEPT:
            self._fringes[start, gaps] = joined
        return joined

    def of(self, changes: Sequence[SumOfChanges]) -> Float[np.ndarray, "d a"]:
        """The columns of changes: rows run over points, then exposures, then cameras, used ones only."""
        return self.rounded(changes, len(changes))[0]

    def rounded(
        self, changes: Sequence[SumOfChanges], exact: int
    ) -> tuple[Float[np.ndarray, "d a"], Float[np.ndarray, "d b"]]:
        """The columns of the first, `exact` changes, and those of the others in single precision."""
        return next(self.in_pieces(changes, exact, max(1, len(self.likelihood.used))))

    def in_pieces(
        self, changes: Sequence[SumOfChanges], exact: int, points: int
    ) -> Iterator[tuple[Float[np.ndarray, "d a"], Float[np.ndarray, "d b"]]]:
        """The same for so many points at a time (whole blocks of `limits.RESPONSES_TOGETHER`), one after the other."""
        changed_terms = [self.terms_of(change) for change in changes]
        used, size = self.likelihood.used, limits.RESPONSES_TOGETHER
        distinct_slots = list(dict.fromkeys(term.slot for terms in changed_terms for term in terms))
        for piece in range(0, max(1, len(used)), points):
            starts = range(piece, min(piece + points, len(used)), size)
            rows = [len(self.patched.cameras) * int(used[start : start + size].sum()) for start in starts]
            precisions = (
                (changed_terms[:exact], np.empty((exact, sum(rows)))),
                (changed_terms[exact:], np.empty((len(changes) - exact, sum(rows)), np.float32)),
            )
            first = 0
            for start, count in zip(starts, rows, strict=True):
                block = ResponseBlock(self, start, distinct_slots)
                for terms, columns in precisions:
                    block.fill(terms, columns[:, first : first + count])
                first += count
            yield precisions[0][1].T, precisions[1][1].T


class ResponseBlock:
    """Some field points: responses brought together with their exposures.

    Arrays run over sites (m), cameras (k) and pairs of point and exposure (n): those that are used, or all of them
    where something else than the flux couples them.
    """

    def __init__(self, of: Columns, start: int, every: Sequence[Slot]) -> None:
        self.of, self.start = of, start
        data, self.found = of.responses(start)
        arrays = (data.x, data.y, data.weight, data.band, data.source)
        self.x, self.y, weight, self.band, source = map(np.asarray, arrays)
        self.value = np.asarray(of.patched.standard.values(source, of.exposures.colour))
        self.used = weight[..., 0] > 0
        self.linear = light.is_linear(of.patched)
        self.shared = flux_groups(of.patched, of.plan, data)
        self.whole = not self.linear or not self.shared.single
        self.chosen = np.arange(self.used.size) if self.whole else np.flatnonzero(self.used)
        self.sites, self.cameras = self.found.share.shape[1], weight.shape[2]
        self.weight = self._pairs(weight)
        flux = np.broadcast_to(self.found.flux, weight.shape)
        self.flux = self._pairs(flux) * (self.weight if self.linear else 1.0)
        self.share = self._pairs(self.found.share)
        self._patterns: dict[tuple[Any, ...], np.ndarray] = {}
        self._cores: dict[tuple[Any, ...], np.ndarray] = {}
        self._solve(every)

    def _pairs(self, values: Float[np.ndarray, "p ..."]) -> Float[np.ndarray, ...]:
        """(p e k) → (k n), (p m e k) → (m k n)."""
        last = np.moveaxis(values, (0, -2), (-2, -1))  # (..., k, p, e)
        flat = last.reshape(*last.shape[:-2], -1)
        return flat if self.whole else np.ascontiguousarray(flat[..., self.chosen])

    # -------------------------------------------------------------------------------- cores, ahead of their factors

    def _pattern(self, factors: tuple[Any, ...]) -> Float[np.ndarray, "m n"]:
        """Product of factors at every site."""
        if factors not in self._patterns:
            patterns = []
            for sign in (1.0, -1.0)[: self.sites]:
                at = InExposures(self.of.exposures, sign * self.x[:, None], sign * self.y[:, None])
                value = product(factors, at, self.of.patched.units)
                over_field = np.broadcast_to(np.nan_to_num(np.asarray(value)), self.used.shape)
                patterns.append(over_field.reshape(-1)[self.chosen])
            self._patterns[factors] = np.stack(patterns)
        return self._patterns[factors]

    def _solve(self, every: Sequence[Slot]) -> None:
        """All cores: what slots do to the counts, or to weighted counts where detectors are linear."""
        of_vectors = [slot for slot in every if slot[0] == "fringes" or slot in self.of.of_vectors]
        fringes = self._fringes([slot[2] for slot in of_vectors if slot[0] == "fringes"])
        # Points that no exposure measures are in no pair.
        batch = max(1, int(limits.RESPONSE_NUMBERS // max(1, self.sites * self.cameras * len(self.chosen))))
        for first in range(0, len(of_vectors), batch):
            group = of_vectors[first : first + batch]
            change = np.stack([fringes[slot] if slot in fringes else self.change(slot) for slot in group])
            self._cores |= dict(zip(group, self._met(change), strict=True))
        for slot in every:
            if slot not in self._cores:
                self._cores[slot] = self._core(slot)

    def _fringes(self, gaps: Sequence[float]) -> dict[Slot, np.ndarray]:
        """Slopes (p m b k 4) in fringes."""
        distinct = list(dict.fromkeys(gaps))
        if not distinct:
            return {}
        joined = self.of.fringes(self.start, tuple(distinct), self.x, self.y, self.sites)
        return {
            ("fringes", place, gap): joined[:, :, plate, i]
            for i, gap in enumerate(distinct)
            for plate, place in enumerate(self.of.fringed)
        }

    def change(self, slot: Slot) -> Float[np.ndarray, "p m b k 4"]:
        """Slope of the analysis vectors."""
        return self.found.vectors.slopes[:, :, self.of.of_vectors[slot]]

    def _met(self, change: Float[np.ndarray, "s p m b k 4"]) -> Float[np.ndarray, "s m k n"]:
        """Analysis vectors that change, with the light of the exposures."""
        count = change.shape[0]
        beam = np.transpose(self.found.light.taken, (1, 3, 0, 4, 2))  # m k p 4 e
        counts = np.zeros((count, self.sites, self.cameras, *self.used.shape))
        for band in np.unique(self.band):
            in_band = self.band == band
            at = np.flatnonzero(in_band.any(axis=0))
            sums = np.transpose(change[:, :, :, band], (2, 3, 1, 0, 4)) @ beam[..., at]  # m k p s e
            if not in_band[:, at].all():
                sums = sums * in_band[:, at][:, None]
            counts[..., at] += np.transpose(sums, (3, 0, 1, 2, 4))
        flat = counts.reshape(*counts.shape[:3], -1)
        return (flat if self.whole else flat[..., self.chosen]) * (self.share * self.flux)

    def _core(self, slot: Slot) -> Float[np.ndarray, "m k n"]:
        responses = self.found
        if slot[0] == "light":
            # P m e k 4.
            vectors = np.take_along_axis(responses.vectors.vectors, self.band[:, None, :, None, None], axis=2)
            change = responses.light.slopes[:, :, self.of.of_light[slot[:4]]]
            for star in slot[4:]:
                change = change * (self.value == star)[:, None, :, None]
            raw = np.einsum("pmeks,pmes->pmek", vectors, change) * responses.light.factor
            return self._pairs(raw) * self.share * self.flux
        stage, cameras, *origin = slot
        if stage == "counts":
            return self._pairs(responses.counts * cameras) * self.share * self.flux
        if stage == "opposite":
            return self._alone(responses.opposite * cameras) * self.flux
        shape = responses.electrons.shape
        added = np.broadcast_to(self.of.median, shape) if stage == "median" else responses.added[stage]
        if origin:  # counts of one camera in others
            added = added[..., origin]
        return self._alone(added * cameras) * (self.weight if self.linear else 1.0)

    def _alone(self, values: Float[np.ndarray, "p e k"]) -> Float[np.ndarray, "m k n"]:
        """Values that enter once, for any number of sites."""
        pairs = self._pairs(values)[None]
        return np.concatenate([pairs, *([np.zeros_like(pairs)] * (self.sites - 1))])

    # --------------------------------------------------------------------------------------------------- columns

    def fill(self, changes: Sequence[Sequence[SlotTerm]], columns: Float[np.ndarray, "a d"]) -> None:
        """Write the columns of changes, for these points."""
        size = limits.COLUMNS_TOGETHER // 4
        for first in range(0, len(changes), size):
            batch = changes[first : first + size]
            change = np.zeros((len(batch), self.cameras, len(self.chosen)))
            behind = None if self.linear else np.zeros_like(change)
            for a, terms in enumerate(batch):
                for slot, coefficient, factors in terms:
                    core, pattern = self._cores[slot], self._pattern(factors)
                    into = change if behind is None or slot[0] not in ADDED else behind
                    for site in range(self.sites):
                        into[a] += core[site] * (coefficient * pattern[site])
            if behind is not None:
                change = (self._reported(change) + behind) * self.weight
            self._write(change, columns[first : first + len(batch)])

    def _reported(self, change: Float[np.ndarray, "a k n"]) -> Float[np.ndarray, "a k n"]:
        of, size = self.of, limits.COLUMNS_TOGETHER // 4
        cube = np.zeros((size, *self.used.shape, self.cameras))
        cube[: len(change)] = np.moveaxis(change.reshape(len(change), self.cameras, *self.used.shape), 1, -1)
        pushed = np.asarray(_detectors(of.instrument, of.plan, self.found.electrons, cube, self.x, self.y))
        return np.moveaxis(pushed[: len(change)], -1, 1).reshape(change.shape)

    def _write(self, change: Float[np.ndarray, "a k n"], columns: Float[np.ndarray, "a d"]) -> None:
        """Project the flux out and write rows in the order of the residuals."""
        along, flux_known = self._pairs(self.found.along) * self.weight, self.of.likelihood.flux_known
        if not self.shared.single:

            def cube(pairs: Float[np.ndarray, "... k n"]) -> np.ndarray:
                return np.moveaxis(pairs, -2, -1).reshape(*pairs.shape[:-2], *self.used.shape, self.cameras)

            projected = project_flux(cube(change), cube(along), flux_known, self.shared)
            columns[:] = -projected[:, self.used].reshape(len(columns), -1)
            return
        free = np.where(np.broadcast_to(~flux_known, self.used.shape).reshape(-1)[self.chosen], 1.0, 0.0)
        together = np.ones((1, self.cameras)) if self.shared.cameras is None else self.shared.cameras
        for group in map(np.flatnonzero, np.unique(together, axis=0)):
            slopes = along[group]
            power = np.sum(slopes**2, axis=0)
            unit = slopes * (free / np.sqrt(np.where(power > 0, power, 1.0)))
            amplitude = np.einsum("akn,kn->an", change[:, group], unit)
            change[:, group] -= amplitude[:, None] * unit
        inside = self.used.reshape(-1)[self.chosen]
        rows = columns.reshape(len(columns), -1, self.cameras)
        for k in range(self.cameras):
            np.negative(change[:, k] if inside.all() else change[:, k][:, inside], out=rows[..., k])
