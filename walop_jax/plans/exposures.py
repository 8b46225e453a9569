"""The information that calibration exposures would bring, and the known parameters that a plan is judged by.

Information  of an exposure e: J_eᵀ J_e, J_e the derivatives of its whitened residuals, fluxes eliminated, to the free
             parameters of the base model, from expected counts and the errors that they would have. No noise enters.
Polariser    Light is linear, so that counts and their derivatives are series of low degree in 2θ: they are computed at
             a few angles and known at all, those of the grid and, for the bound, of one six times finer.
             `Candidates.truncation` is what the series leaves out.
Draws        of the instrument as built, from the priors or around a calibration: the best plan depends on it.
Limits       Detectors are linear. Exposures know of each other only by the parameters. Changes between exposures
             (slews, filters) cost time when the plan is put in order; the bound without them stays a bound.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Collection, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from walop_jax.calibration.calibration import Calibration
from walop_jax.data.records import CalibrationSet
from walop_jax.fit.base_model import base_model
from walop_jax.likelihood import engine
from walop_jax.likelihood.flux import FluxGroups, project_flux
from walop_jax.likelihood.inverses import of_low_rank, pseudo_inverse
from walop_jax.likelihood.likelihood import Likelihood, prior_rows
from walop_jax.likelihood.noise import NoiseTerms, factors
from walop_jax.model import light
from walop_jax.model.cameras import with_noise_floor
from walop_jax.model.compiled import compiled
from walop_jax.model.dependence import needs
from walop_jax.model.effects import EFFECTS, Effect, EffectKind, effect_by_name
from walop_jax.model.effects.in_models import effect_context, known_effects, with_effects
from walop_jax.model.ray import CONDITIONS
from walop_jax.model.sources import MoonSky
from walop_jax.model.specification import Model
from walop_jax.plans.available import Available, CandidateExposure, with_stops
from walop_jax.plans.optimal import Family, Listed
from walop_jax.simulation import simulate as simulation
from walop_jax.simulation.observing_plan import ObservingPlan, Stop

NODES, NODES_BEHIND_PLATES, NODES_OF_EFFECTS = 7, 3, 13
"""Angles of the polariser at which counts are computed: a series of degree 3 in 2θ, two more than it needs; of degree 1
for plates of the grid, of which there are many. Effects that are to be separated may depend on θ itself, which takes a
whole turn."""
FINER = 6
"""Angles of the finer grid, on which the bound is computed in the end, in a step of the polariser."""
GRID = 7
"""Field points along each axis at which the information is computed, each for some of the plan (`fewer_points`)."""
DRAWS = 20
NOT_CHOSEN = {condition: column for condition, column in CONDITIONS.items() if condition != "exptime"}
"""Conditions of an exposure that are as they come, and their columns."""
CountsAndSlopes = tuple[Float[np.ndarray, "p e k"], Float[np.ndarray, "p e k f"]]
"""Counts of light of unit flux, and their derivatives to the free parameters."""
_AT_ONCE = 36  # field points: arrays stay small
_ROUNDING = 1e-10  # of the largest eigenvalue


@dataclasses.dataclass(frozen=True)
class Candidates:
    """Everything that could be observed, with the information that each exposure would bring.

    `families` go with `choices`, their information scaled to the field points of the plan. `values` (draw, parameter)
    are all parameters of the instruments that were drawn, `prior` is the information on the free parameters beforehand,
    `names` are the names of these. `truncation` is the highest harmonic of the counts in the angle of the polariser
    beside their mean: nothing if the angles at which they were computed are enough. `notes` say what had to be left
    out. `effects` are the effects that are to be separated, which are parameters of the model as well, each with
    whether its size is known.
    """

    available: Available
    model: Model
    choices: tuple[CandidateExposure, ...]
    families: tuple[Family, ...]
    values: Float[np.ndarray, "r n"]
    names: tuple[str, ...]
    prior: Float[np.ndarray, "f f"]
    truncation: float
    notes: tuple[str, ...]
    effects: Mapping[str, bool] = dataclasses.field(default_factory=dict)


def candidates(
    available: Available,
    *,
    draws: int = DRAWS,
    seed: int = 0,
    around: Calibration | None = None,
    effects: Sequence[str | Effect] = (),
    catalogue: Sequence[EffectKind] = EFFECTS,
    progress: Callable[[str], None] | None = None,
) -> Candidates:
    """The exposures that could be taken, each with its information in `draws` draws of the instrument.

    Instruments are drawn from the priors, or from the posterior of the calibration `around`. Errors of the data are as
    its fit has found them, or those of the plan (`noise_scale`, `noise_fraction`). `effects` of the
    `catalogue` may be there as well, at their values; those given by name alone at the size of their scale. Raises
    ValueError where nothing is left to be observed, and for effects that do not act on light, or grow with time, hour
    angle or temperature.
    """
    tell = progress or (lambda text: None)
    choices, notes = available.choices()
    if not choices:
        raise ValueError("; ".join(("nothing could be observed", *notes)))
    few, weight = fewer_points(available.plan)
    turn = 360.0 if effects else 180.0
    choices = tuple(choice.over(turn) for choice in choices)
    stops = [_nodes(choice, available, bool(effects)) for choice in choices]
    first = np.cumsum([0, *map(len, stops)])
    plan = with_stops(few, itertools.chain(*stops))
    tell("expected counts")
    calset = simulation.simulate(plan, seed=seed, noiseless=True, steady=True).calset
    model = base_model(calset, plan.design, throughput_degree=plan.throughput_degree)
    kinds = (*catalogue, *(effect.kind for effect in effects if isinstance(effect, Effect)))
    model, stated = with_members(dataclasses.replace(model, catalogue=kinds), calset, effects)
    values = drawn(model, draws, seed, around)
    for i, p in enumerate(model.parameters):
        if p.part in stated:
            values[:, i] = p.start
    likelihood = Likelihood.of(calset, model)
    flux, exptime = simulation.fluxes(plan, None), plan.exposures().exptime
    noise, floor = simulation.PhotonNoise(plan.read_noise), model.template.cameras.noise_floor
    shared = FluxGroups(model.template.cameras.together)
    of_mean = {f"standard.{plan.star_names[-1]}.{axis}" for axis in "qu"} if plan.zero_stars else set()
    means = [place for place, i in enumerate(model.free) if model.names[i] in of_mean]
    responses = []
    for number, draw in enumerate(values, start=1):
        tell(f"expected counts of instrument {number} of {draws}")
        responses.append(_responses(likelihood, draw))

    def seen(choice: CandidateExposure, rows: slice) -> tuple[Illumination, tuple[CountsAndSlopes, ...]]:
        """The light of some exposures of a choice, and their counts in every draw."""
        at = likelihood.used[:, rows.start]
        electrons = flux[at, rows.start] * choice.seconds / exptime[rows.start]
        of_field = choice.kind == "standard" and plan.stops[rows.start].number == plan.standards
        scatter = plan.zero_scatter if of_field else 0.0
        errors = errors_of(plan, choice.kind, model.template.cameras.names, around)
        lit = Illumination(electrons, noise, floor, shared, weight[at], dict.fromkeys(means, scatter), errors)
        return lit, tuple((unit[at, rows], slopes[at, rows]) for unit, slopes in responses)

    families: list[Family] = []
    for choice, start, stop in zip(choices, first[:-1], first[1:], strict=True):
        tell(f"information of {choice.in_words(plan.design.reading_in_words)}")
        cost = choice.seconds + available.costs.of(choice.kind)
        if choice.kind == "clp":
            lit, counts = seen(choice, slice(start, stop))
            families.append(Polarised.of(choice, lit, counts, cost))
            continue
        matrices = []
        for row in range(start, stop):
            lit, counts = seen(choice, slice(row, row + 1))
            matrices.append(np.stack([lit.information(*draw)[0] for draw in counts]))
        families.append(Listed.of(np.stack(matrices, axis=1), cost))
    lost = max([0.0, *(f.highest_harmonic() for f in families if isinstance(f, Polarised))])
    rows = prior_rows(model).jacobian(model.selection())
    names = tuple(model.names[i] for i in model.free)
    base = np.array([model.parameters[i].part not in stated for i in model.free])
    prior = (rows.T @ rows) * np.outer(base, base)
    return Candidates(available, model, choices, tuple(families), values, names, prior, lost, notes, stated)


def with_members(
    model: Model, calset: CalibrationSet, given: Sequence[str | Effect]
) -> tuple[Model, dict[str, bool]]:
    """The model with effects at their values, and for each effect whether it has a value."""
    context, stated, extended = effect_context(model.template, calset.exposures), {}, model
    for item in given:
        effect = item
        if isinstance(item, str) and "=" in item:
            effect = simulation.effect_from_text(item, context, known_effects(model))
        alone = isinstance(effect, str)
        name = effect.strip() if isinstance(effect, str) else effect.name
        extended = with_effects(extended, (name if alone else effect,), context)
        kind = effect_by_name(name, known_effects(model))
        if kind.is_structural():
            what = f"{name} is there or it is not, and has no size that could be planned for"
            raise ValueError(f"{what}; leave it out")
        # Angles at which light is computed stand at hours and temperatures of their own, exposures of a plan at others.
        asked = needs(extended.template).conditions - needs(model.template).conditions
        if changing := [column for condition, column in NOT_CHOSEN.items() if condition in asked]:
            what = f"{name} grows with {' and '.join(changing)}, which no plan chooses"
            raise ValueError(f"{what}; leave it out")
        stated[name] = not alone
        for p in extended.parameters if alone else ():
            if p.part == name and p.name.split(".")[1] not in kind.shape:
                extended = extended.change(p.name, start=p.start + p.scale)
    if given and not light.is_linear(extended.template):
        raise ValueError("effects of the detectors cannot be planned for: only those that act on light")
    return extended, stated


def fewer_points(plan: ObservingPlan) -> tuple[ObservingPlan, Float[np.ndarray, " p"]]:
    """The plan over fewer field points, and for how many points of the plan each of them stands; points of stars stay.

    Along each axis polynomials of a degree below the number of points have the same sum over both.
    """
    few = dataclasses.replace(plan, grid=min(plan.grid, GRID))
    sides = (np.linspace(-1.0, 1.0, p.grid) if p.grid > 1 else np.zeros(1) for p in (plan, few))
    sums, series = (np.polynomial.legendre.legvander(side, few.grid - 1) for side in sides)
    along = np.linalg.solve(series.T, sums.sum(axis=0))
    points = len(few.points()) - (plan.standard_grid**2 if plan.standards else 0) - plan.zero_stars
    weight = along if points == few.grid else np.outer(along, along).ravel()
    return few, np.append(weight, np.ones(len(few.points()) - points))


def drawn(model: Model, draws: int, seed: int, around: Calibration | None) -> Float[np.ndarray, "r n"]:
    """Values of all parameters: from the priors, or from the posterior of a calibration as far as it has them."""
    samples = []
    for draw in range(draws):
        rng = np.random.default_rng([seed, draw])
        truth = simulation.truth_values(simulation.draw_instrument(model, rng))
        if around is not None:
            of = around.model
            covariance = around.covariance[np.ix_(of.free, of.free)]
            normal = rng.multivariate_normal(np.zeros(len(of.free)), covariance, method="eigh")
            truth |= dict(zip(of.names, around.values + of.selection() @ normal, strict=True))
        samples.append([truth[name] for name in model.names])
    return np.array(samples, float)


_unit_at = compiled(jax.vmap(engine.unit_slopes, (None, None, 0)), kept_as="unit_counts")


def _responses(likelihood: Likelihood, values: Float[np.ndarray, " n"]) -> CountsAndSlopes:
    """Counts for light of unit flux, and their derivatives to the free parameters."""
    instrument, select = likelihood.model.instrument(values), likelihood.model.selection()
    batches = [_unit_at(instrument, likelihood.plan, batch) for batch in likelihood.points]
    unit, slopes = (np.concatenate([np.asarray(result[i]) for result in batches]) for i in (0, 1))
    count = likelihood.layout.points
    return unit[:count], slopes[:count] @ select


def _nodes(choice: CandidateExposure, available: Available, effects: bool) -> tuple[Stop, ...]:
    """The exposures at which counts are computed: evenly through the turn of the polariser."""
    if choice.kind != "clp":
        return choice.stops
    listed = choice.stops[0].plate in available.plan.plate
    count = NODES_OF_EFFECTS if effects else NODES if listed else NODES_BEHIND_PLATES
    angles = (choice.turn / count * np.arange(count)).tolist()
    return tuple(dataclasses.replace(choice.stops[0], polariser_angle=angle) for angle in angles)


def _interpolating(phases: Float[np.ndarray, " s"], nodes: int) -> Float[np.ndarray, "s e"]:
    """Weights of an odd number of equidistant nodes in the series through them, at phases (rad) of their turn."""
    waves = np.arange(-(nodes // 2), nodes // 2 + 1)
    apart = phases[:, None] - 2 * np.pi * np.arange(nodes) / nodes
    return np.cos(apart[..., None] * waves).sum(axis=-1) / nodes


def _even(count: int) -> Float[np.ndarray, " s"]:
    """Phases (rad) evenly through a turn."""
    return 2 * np.pi * np.arange(count) / count


def errors_of(
    plan: ObservingPlan, kind: str, cameras: Sequence[str], around: Calibration | None
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """s² and f² of the cameras in exposures of a KIND: σ² = s² N_ERR² + f² N² (`model.noise`)."""
    found = None if around is None else around.model.instrument(around.values).noise
    if found is None:
        every = np.ones(len(cameras))
        return plan.noise_scale**2 * every, plan.noise_fraction**2 * every
    squared, added = factors(found, NoiseTerms.of(found, [kind], cameras))
    return np.asarray(squared)[0], np.asarray(added)[0]


class Illumination(NamedTuple):
    """Light of an exposure at the points of a plan: `flux` (electron, p), noise, and the cameras that share a flux.

    No error is smaller than the fraction `floor` of the mean counts of all cameras, as in a fit
    (`Cameras.noise_floor`). `weight` (p) is the number of points of the plan that each point stands for. `scatter` is
    the rms of single stars around a parameter, by the position of that parameter; each exposure counts as one of other
    stars. `errors` are s² and f² of the cameras in σ² = s² N_ERR² + f² N².
    """

    flux: Float[np.ndarray, " p"]
    noise: simulation.PhotonNoise
    floor: float
    shared: FluxGroups
    weight: Float[np.ndarray, " p"]
    scatter: Mapping[int, float] = MappingProxyType({})
    errors: tuple[Float[Any, " *k"], Float[Any, " *k"]] = (np.ones(()), np.zeros(()))

    def sigma(self, counts: Float[np.ndarray, ...], axis: int) -> Float[np.ndarray, ...]:
        """Errors of counts (electrons) whose cameras lie along an axis."""
        shape = [1] * counts.ndim
        shape[axis] = -1
        squared, added = (np.reshape(factor, shape) for factor in self.errors)
        stated = with_noise_floor(self.noise.sigma(counts), counts, self.floor, axis)
        return np.sqrt(squared * stated**2 + added * counts**2)

    def information(
        self, unit: Float[np.ndarray, "p s k"], slopes: Float[np.ndarray, "p s k f"]
    ) -> Float[np.ndarray, "s f f"]:
        """JᵀJ of exposures, from counts of unit flux and their derivatives."""
        flux = self.flux[:, None, None]
        counts = flux * unit
        weight = 1.0 / self.sigma(counts, 2)
        columns = np.moveaxis(slopes * (flux * weight)[..., None], -1, 0)
        projected = project_flux(columns, unit * weight, False, self.shared)
        if any(self.scatter.values()):
            stars = np.stack([size * projected[place] for place, size in self.scatter.items()], axis=-1)
            alone = FluxGroups(stars=of_low_rank(stars[:, :, None]))
            projected = alone.independent(projected[..., None, :])[..., 0, :]
        projected = projected * np.sqrt(self.weight)[:, None, None]
        flat = projected.transpose(2, 0, 1, 3).reshape(unit.shape[1], len(projected), -1)
        return flat @ flat.swapaxes(1, 2)

    def gain(
        self, unit: Float[np.ndarray, "p k s"], squares: Float[np.ndarray, "p t s"]
    ) -> Float[np.ndarray, " s"]:
        """tr G JᵀJ of exposures; `squares` are s_k G s_l of each pair k ≤ l, s the derivatives for unit flux.

        Without the flux, with w = flux / σ and along a = unit / σ: Σ w_k² s_k G s_k − Σ (w a)_k (w a)_l s_k G s_l /
        Σ a², the sums over cameras with a flux in common (`likelihood.flux`).
        """
        counts, count = self.flux[:, None, None] * unit, unit.shape[1]
        weight = 1.0 / self.sigma(counts, 1) ** 2
        weighted = unit * weight
        together = np.ones((count, count)) if self.shared.cameras is None else self.shared.cameras
        share = weighted / (together @ (unit * weighted))
        gain = np.zeros((len(unit), unit.shape[2]))
        for pair, (k, m) in enumerate(zip(*np.triu_indices(count), strict=True)):
            if k == m:
                gain += (weight[:, k] - weighted[:, k] * share[:, k]) * squares[:, pair]
            elif together[k, m]:
                gain -= 2.0 * weighted[:, k] * share[:, m] * squares[:, pair]
        return (self.weight * self.flux**2) @ gain


@dataclasses.dataclass(frozen=True)
class Polarised(Family):
    """Exposures through the polariser at the angles of the grid.

    `counts` are those of unit flux and their derivatives at the nodes, for each draw, `angles` the number of candidates
    in a turn; matrices that were asked for are `kept`.
    """

    light: Illumination
    counts: tuple[CountsAndSlopes, ...]
    angles: int
    cost: Float[np.ndarray, " m"]
    kept: dict[int, Float[np.ndarray, "r f f"]] = dataclasses.field(default_factory=dict, compare=False)

    @classmethod
    def of(
        cls, choice: CandidateExposure, light: Illumination, counts: tuple[CountsAndSlopes, ...], cost: float
    ) -> Polarised:
        """The candidates of a choice."""
        return cls(light, counts, len(choice.stops), np.full(len(choice.stops), float(cost)))

    @property
    def _nodes(self) -> int:
        return self.counts[0][0].shape[1]

    def information(self, numbers: Sequence[int]) -> Float[np.ndarray, "r s f f"]:
        """The matrices of these candidates."""
        new = [number for number in dict.fromkeys(numbers) if number not in self.kept]
        if new:
            matrices = self.at(2 * np.pi * np.array(new) / self.angles)
            self.kept.update(zip(new, np.moveaxis(matrices, 1, 0), strict=True))
        return np.stack([self.kept[number] for number in numbers], axis=1)

    def at(self, phases: Float[np.ndarray, " s"]) -> Float[np.ndarray, "r s f f"]:
        """The matrices at any phases (rad) of the turn of the polariser."""
        weights = _interpolating(phases, self._nodes)
        each = (
            self.light.information(_mixed(weights, unit), _mixed(weights, slopes))
            for unit, slopes in self.counts
        )
        return np.stack(list(each))

    def gains(self, g: Float[np.ndarray, "r f f"]) -> Float[np.ndarray, " m"]:
        """Σ_r tr G_r M_r of every candidate."""
        return self._gains(g, self.angles)

    def between(self, g: Float[np.ndarray, "r f f"]) -> float:
        """The largest gain for its cost on the finer grid."""
        return float(self._gains(g, FINER * self.angles).max() / self.cost[0])

    def _gains(self, g: Float[np.ndarray, "r f f"], count: int) -> Float[np.ndarray, " c"]:
        """Σ_r tr G_r M_r at even angles: products of derivatives are series of twice the degree of the counts."""
        low = 2 * self._nodes - 1
        weights, finer = _interpolating(_even(low), self._nodes), _interpolating(_even(count), low)
        total = np.zeros(count)
        for (unit, slopes), matrix in zip(self.counts, g, strict=True):
            root = _root(matrix)
            for i in range(0, len(unit), _AT_ONCE):
                chunk = slice(i, i + _AT_ONCE)
                along = np.tensordot(weights, slopes[chunk] @ root, (1, 1))
                squares = (along @ along.swapaxes(2, 3))[:, :, *np.triu_indices(unit.shape[2])]
                u = np.tensordot(weights, unit[chunk], (1, 1)).transpose(1, 2, 0)
                light = self.light._replace(flux=self.light.flux[chunk], weight=self.light.weight[chunk])
                total += light.gain(u @ finer.T, squares.transpose(1, 2, 0) @ finer.T)
        return total

    def highest_harmonic(self) -> float:
        """The highest harmonic of the counts at the nodes beside their mean; 0 where none is left to be higher."""
        unit = self.counts[0][0]
        series = np.abs(np.fft.fft(unit, axis=1))
        high = series[:, self._nodes // 2].max() if self._nodes > NODES_BEHIND_PLATES else 0.0
        return float(high / series[:, 0].max())


def _root(matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n m"]:
    """B with B Bᵀ the matrix, to rounding in the unit of each parameter."""
    size = np.sqrt(np.clip(np.diag(matrix), 0.0, None))
    size = np.where(size > 0, size, 1.0)
    value, vector = np.linalg.eigh(matrix / np.outer(size, size))
    significant = value > _ROUNDING * value.max(initial=0.0)
    return size[:, None] * vector[:, significant] * np.sqrt(value[significant])


def _mixed(
    weights: Float[np.ndarray, "s e"], values: Float[np.ndarray, "p e *k"]
) -> Float[np.ndarray, "p s *k"]:
    return np.tensordot(weights, values, (1, 1)).swapaxes(0, 1)


def information_of(
    known: Calibration, names: Sequence[str], effects: Collection[str] = ()
) -> Float[np.ndarray, "f f"]:
    """Information of the data of a calibration on parameters by name, beside their priors.

    It is 0 for parameters that the calibration has not, for parameters of `effects`, and for the moonlit sky, which is
    another one next time.
    """
    model, without = known.model, {*effects, MoonSky.name}
    shared = [i for i, n in enumerate(names) if n in model.names and model[n].part not in without]
    columns = [model.index(names[i]) for i in shared]
    jacobian = prior_rows(model).jacobian(np.eye(len(model.names)))[:, columns]
    posterior = pseudo_inverse(known.covariance[np.ix_(columns, columns)], 1e-12)
    root = _root(posterior - jacobian.T @ jacobian)
    information = np.zeros((len(names), len(names)))
    information[np.ix_(shared, shared)] = root @ root.T
    return information
