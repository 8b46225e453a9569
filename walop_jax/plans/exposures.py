"""The information that calibration exposures would bring, and the known parameters that a plan is judged by.

Information  of an exposure e: J_eᵀ J_e, J_e the derivatives of its whitened residuals, fluxes eliminated, to the free
             parameters of the base model, from expected counts and the errors that they would have. No noise enters.
Polariser    Light is linear, so that counts and their derivatives are series of low degree in 2θ: they are computed
             at `NODES` angles and known at all. The information, which divides by the variance of the counts, is a
             series of high degree, cut where `ANGLES` angles end it; `Candidates.truncation` is what is lost.
Draws        of the instrument as built, from the priors or around a calibration: the best plan depends on it.
Limits       Detectors are linear. Exposures know of each other only by the parameters. Changes between exposures
             (slews, filters) cost time when the plan is put in order; the bound without them stays a bound.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from walop_jax.calibration.calibration import Calibration
from walop_jax.data.records import CalibrationSet
from walop_jax.fit.model_file import base_model
from walop_jax.likelihood import engine
from walop_jax.likelihood.flux import Sharing, project_flux, sharing
from walop_jax.likelihood.likelihood import Likelihood, prior_rows
from walop_jax.model import light
from walop_jax.model.compiled import compiled
from walop_jax.model.effects import Effect, effect_by_name
from walop_jax.model.instrument import Instrument
from walop_jax.model.plan import Plan
from walop_jax.model.specification import Model, effect_context, with_effects
from walop_jax.plans.could import CandidateExposure, Could
from walop_jax.plans.families import Circle, Family, Listed, harmonics
from walop_jax.simulation.observing_plan import ObservingPlan
from walop_jax.simulation.simulate import (
    PhotonNoise,
    draw_instrument,
    effect_from_text,
    fluxes,
    simulate,
    truth_values,
)

NODES, NODES_OF_EFFECTS = 7, 13
"""Angles of the polariser at which counts are computed: a series of degree 3 in 2θ, one more than it needs.
Effects that are to be told apart may depend on θ itself, which takes a whole turn."""
ANGLES = 361
"""Angles over half a turn through which the information is a Fourier series in 2θ.

So many since errors vary quickly where a camera is dark: over some √(σ²/N) rad, N its counts in full light."""
GRID, STAR_GRID = 6, 3
"""Field points along each axis at which the information is computed, scaled to those of the plan."""
DRAWS = 20
_TOGETHER = 60  # angles, so that their derivatives stay small


@dataclasses.dataclass(frozen=True)
class Candidates:
    """Everything that could be observed, with the information that each exposure would bring.

    `families` go with `choices`, their information scaled to the field points of the plan. `values` (draw, parameter)
    are all parameters of the instruments that were drawn, `prior` what is known of the free ones beforehand, `names`
    of these. `truncation` is the largest error of the information between the angles that were computed, in units of
    the mean diagonal of each parameter; `notes` say what had to be left out. `effects` are those that are to be told
    apart, parameters of the model as well, with whether their size is known.
    """

    could: Could
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
    could: Could,
    *,
    draws: int = DRAWS,
    seed: int = 0,
    around: Calibration | None = None,
    angles: int = ANGLES,
    effects: Sequence[str | Effect] = (),
    progress: Callable[[str], None] | None = None,
) -> Candidates:
    """The exposures that could be taken, each with its information in `draws` draws of the instrument.

    Instruments are drawn from the priors, or from the posterior of the calibration `around`; `angles`, an odd number,
    are those of the polariser. `effects` may be there as well, at their values; those given by name alone at the size
    of their scale. Raises ValueError where nothing is left to be observed, and for effects that do not act on light.
    """
    tell = progress or (lambda text: None)
    choices, notes = could.choices()
    if not choices:
        raise ValueError("; ".join(("nothing could be observed", *notes)))
    few, stops, nodes = fewer_points(could.plan), [], NODES_OF_EFFECTS if effects else NODES
    choices = tuple(choice._replace(turn=360.0 if effects else 180.0) for choice in choices)
    turn = choices[0].turn / nodes * np.arange(nodes)
    first = np.cumsum([0, *(nodes if c.kind == "clp" else len(c.stops) for c in choices)])
    for choice in choices:
        own = choice.stops * nodes if choice.kind == "clp" else choice.stops
        stops += [
            dataclasses.replace(s, polariser_angle=a) if choice.kind == "clp" else s
            for s, a in zip(own, turn if choice.kind == "clp" else own, strict=True)
        ]
    plan = dataclasses.replace(few, stops=tuple(stops), patches=(), stars=())
    tell("expected counts")
    calset = simulate(plan, seed=seed, noiseless=True, steady=True).calset
    model = base_model(calset, plan.design, throughput_degree=plan.throughput_degree)
    model, stated = _with(model, calset, effects)
    values = drawn(model, draws, seed, around)
    for i in (model.index(name) for name in model.names if _effect_of(name, stated)):
        values[:, i] = model.parameters[i].start
    likelihood = Likelihood.of(calset, model)
    source, factor = _Light(plan, likelihood), _factor(could.plan, few)
    responses = []
    for number, one in enumerate(values):
        tell(f"expected counts of instrument {number + 1} of {draws}")
        responses.append(_responses(likelihood, one))
    families, lost, turn = [], 0.0, np.arange(angles) / angles
    for choice, start, stop in zip(choices, first[:-1], first[1:], strict=True):
        tell(f"information of {choice.text()}")
        rows = np.arange(start, stop)
        polarised = choice.kind == "clp"
        where = turn if polarised else None
        information = np.stack(
            [source.information(rows, unit, slopes, choice.seconds, where) for unit, slopes in responses]
        )
        information *= 1.0 if choice.kind == "standard" else factor
        cost = choice.seconds + could.costs.of(choice.kind)
        families.append(Circle.sampled(information, cost) if polarised else Listed.of(information, cost))
        if polarised:
            unit, slopes = responses[0]
            between = (np.arange(0, angles, 6) + 0.5) / angles
            exact = factor * source.information(rows, unit, slopes, choice.seconds, between)
            lost = max(lost, _overtone(unit[:, rows]), _apart(information[0], between, exact))
    rows = prior_rows(model).jacobian(model.selection())
    names = tuple(model.names[i] for i in model.free)
    base = np.array([not _effect_of(name, stated) for name in names])
    known = (rows.T @ rows) * np.outer(base, base)
    return Candidates(could, model, choices, tuple(families), values, names, known, lost, notes, stated)


def _with(
    model: Model, calset: CalibrationSet, given: Sequence[str | Effect]
) -> tuple[Model, dict[str, bool]]:
    """The model with effects at their values, and which of them have one."""
    context, stated, whole = effect_context(model.template, calset.exposures), {}, model
    for one in given:
        effect = effect_from_text(one, context) if isinstance(one, str) and "=" in one else one
        alone = isinstance(effect, str)
        name = effect.strip() if isinstance(effect, str) else effect.name
        whole = with_effects(whole, (name if alone else effect,), context)
        if effect_by_name(name).is_structural():
            raise ValueError(
                f"{name} is there or it is not, and has no size that could be planned for; leave it out"
            )
        stated[name] = not alone
        for p in whole.parameters if alone else ():
            if _effect_of(p.name, (name,)) and p.name.split(".")[1] not in effect_by_name(name).shape:
                whole = whole.change(p.name, start=p.start + p.scale)
    if given and not light.is_linear(whole.template):
        raise ValueError("effects of the detectors cannot be planned for: only those that act on light")
    return whole, stated


def _effect_of(name: str, effects: Iterable[str]) -> str:
    """The effect that a parameter belongs to, of some."""
    return next((effect for effect in effects if name.startswith(f"{effect}.")), "")


def fewer_points(plan: ObservingPlan) -> ObservingPlan:
    """The same over fewer field points, which are spread alike."""
    return dataclasses.replace(
        plan, grid=min(plan.grid, GRID), standard_grid=min(plan.standard_grid, STAR_GRID)
        if not any(s.place for s in plan.stops) else plan.standard_grid
    )  # fmt: skip


def _factor(plan: ObservingPlan, few: ObservingPlan) -> float:
    def count(one: ObservingPlan) -> int:
        return len(one.points()) - (one.standard_grid**2 if one.standards else 0)

    return count(plan) / count(few)


def drawn(model: Model, draws: int, seed: int, around: Calibration | None) -> Float[np.ndarray, "r n"]:
    """Values of all parameters: from the priors, or from the posterior of a calibration as far as it has them."""
    found = []
    for draw in range(draws):
        rng = np.random.default_rng([seed, draw])
        there = truth_values(draw_instrument(model, rng))
        values = np.array([there[name] for name in model.names])
        if around is not None:
            of = around.model
            own = of.selection() @ rng.multivariate_normal(
                np.zeros(len(of.free)), around.covariance[np.ix_(of.free, of.free)], method="eigh"
            )
            for i, name in enumerate(model.names):
                if name in of.names:
                    values[i] = around.values[of.index(name)] + own[of.index(name)]
        found.append(values)
    return np.stack(found)


def _unit(instrument: Instrument, plan: Plan, point: engine.PointData) -> tuple[Array, Array]:
    return engine.point_prediction(instrument, plan, point), engine.unit_slopes(instrument, plan, point)


_unit_at = compiled(jax.vmap(_unit, (None, None, 0)), kept_as="unit_counts")


def _responses(
    likelihood: Likelihood, values: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "p e k"], Float[np.ndarray, "p e k f"]]:
    """Counts for light of unit flux, and their derivatives to the free parameters."""
    instrument, select = likelihood.model.instrument(values), likelihood.model.selection()
    parts = [_unit_at(instrument, likelihood.plan, chunk) for chunk in likelihood.points]
    unit, slopes = (np.concatenate([np.asarray(part[i]) for part in parts]) for i in (0, 1))
    count = likelihood.layout.points
    return unit[:count], slopes[:count] @ select


class _Light:
    """How much light there is: from counts of unit flux to information."""

    def __init__(self, plan: ObservingPlan, likelihood: Likelihood) -> None:
        self.flux, self.used, self.exptime = fluxes(plan, None), likelihood.used, plan.exposures().exptime
        self.noise = PhotonNoise(plan.read_noise)
        self.shared = Sharing(sharing(likelihood.model.template, likelihood.plan).cameras)

    def information(
        self,
        rows: Int[np.ndarray, " _"],
        unit: Float[np.ndarray, "p e k"],
        slopes: Float[np.ndarray, "p e k f"],
        seconds: float,
        turn: Float[np.ndarray, " _"] | None = None,
    ) -> Float[np.ndarray, "s f f"]:
        """JᵀJ of the exposures `rows`; or, of those evenly through a turn of the polariser, at other shares of it."""
        if turn is None:
            return np.concatenate(
                [self._gram(r, unit[:, [r]], slopes[:, [r]], seconds) for r in rows.tolist()]
            )
        order, nodes = len(rows) // 2, 2 * np.pi * np.arange(len(rows)) / len(rows)
        weights = harmonics(2 * np.pi * turn, order) @ np.linalg.inv(harmonics(nodes, order))
        parts = np.array_split(weights, max(len(weights) // _TOGETHER, 1))
        u, du = unit[:, rows], slopes[:, rows]
        return np.concatenate([self._gram(int(rows[0]), _mixed(w, u), _mixed(w, du), seconds) for w in parts])

    def _gram(
        self, row: int, unit: Float[np.ndarray, "p s k"], slopes: Float[np.ndarray, "p s k f"], seconds: float
    ) -> Float[np.ndarray, "s f f"]:
        at = self.used[:, row]
        unit, slopes = unit[at], slopes[at]
        flux = (self.flux[at, row] * seconds / self.exptime[row])[:, None, None]
        weight = 1.0 / self.noise.sigma(flux * unit)
        columns = np.moveaxis(slopes * (flux * weight)[..., None], -1, 0)
        projected = project_flux(columns, unit * weight, False, self.shared)
        flat = projected.transpose(2, 0, 1, 3).reshape(unit.shape[1], len(projected), -1)
        return flat @ flat.swapaxes(1, 2)


def _mixed(
    weights: Float[np.ndarray, "s e"], values: Float[np.ndarray, "p e *k"]
) -> Float[np.ndarray, "p s *k"]:
    return np.tensordot(weights, values, (1, 1)).swapaxes(0, 1)


def _overtone(unit: Float[np.ndarray, "p e k"]) -> float:
    """The highest harmonic of the counts beside their mean: none where the series holds them."""
    count = unit.shape[1]
    nodes = 2 * np.pi * np.arange(count) / count
    series = np.linalg.solve(harmonics(nodes, count // 2), unit.swapaxes(0, 1).reshape(count, -1))
    return float(np.abs(series[-2:]).max() / np.abs(series[0]).max())


def _apart(
    information: Float[np.ndarray, "a f f"],
    between: Float[np.ndarray, " b"],
    exact: Float[np.ndarray, "b f f"],
) -> float:
    """Largest error of the series at shares of a turn, in units of the mean diagonal of each parameter."""
    count = len(information)
    series = np.linalg.solve(
        harmonics(2 * np.pi * np.arange(count) / count, count // 2), information.reshape(count, -1)
    )
    made = (harmonics(2 * np.pi * between, count // 2) @ series).reshape(exact.shape)
    size = np.sqrt(np.einsum("saa->a", exact) / len(exact))
    size = np.where(size > 0, size, 1.0)
    return float(np.max(np.abs(made - exact) / (size[:, None] * size)))


def information_of(
    known: Calibration, names: Sequence[str], effects: Iterable[str] = ()
) -> Float[np.ndarray, "f f"]:
    """What a calibration says of parameters by name; nothing of those that it has not, nor of those of `effects`."""
    both = [i for i, name in enumerate(names) if name in known.model.names and not _effect_of(name, effects)]
    there = [known.model.index(names[i]) for i in both]
    covariance = known.covariance[np.ix_(there, there)]
    size = np.sqrt(np.clip(np.diag(covariance), 0.0, None))
    varied = size > 0
    scaled = covariance[np.ix_(varied, varied)] / np.outer(size[varied], size[varied])
    inverse = np.linalg.pinv(scaled, rcond=1e-12, hermitian=True) / np.outer(size[varied], size[varied])
    at = np.array(both)[varied]
    whole = np.zeros((len(names), len(names)))
    whole[np.ix_(at, at)] = inverse
    return whole
