"""Calibration exposures as candidates of a plan: the information of each, and what the plan is to know well.

The exposures that could be taken are said by an observing plan (`ObservingPlan`): filters, settings of the calibration
plate, Moon patches of a night, standard stars. The polariser may stand at any angle: its angles in the observing plan
are ignored.

Information  of an exposure e: J_eᵀ J_e, J_e the derivatives of its whitened residuals, fluxes eliminated, to the free
             parameters of the base model, from expected counts and the errors that they would have. No noise enters.
Polariser    counts depend on the angle θ by cos 2θ and sin 2θ, their errors smoothly on the counts: a Fourier series in
             2θ through `ANGLES` angles, whose truncation is measured at angles between them (`Candidates.truncation`).
Target       error of p of stars with p ≤ 5 % behind the calibration alone, mean square over the stars, at a field point
             and colour: δ(q, u) = −M⁻¹ (δm₁ + δM (q, u)) (`science.field_accuracy`), linear in the parameters. Where
             |det M| < `LEAST_DETERMINANT` one exposure holds no u, and no plan of calibrations brings it back.
Draws        of the instrument as built, from the priors of the model: the best plan depends on it.
Limits       Exposures know of each other only by the parameters. Changes between exposures (slews, filters) cost time
             when the plan is put in order, not here; the bound without them stays a bound.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int

from walop_jax.calibration.matrix import matrix_slopes
from walop_jax.data.records import CALIBRATION_PLATE, CalibrationSet
from walop_jax.data.settings import Settings
from walop_jax.fit.model_file import base_model
from walop_jax.likelihood.likelihood import Likelihood, prior_rows
from walop_jax.model.specification import Model
from walop_jax.plans.families import Circle, Family, Listed
from walop_jax.plans.optimal import Experiment
from walop_jax.science.star_errors import sample_stars
from walop_jax.simulation.observing_plan import ObservingPlan
from walop_jax.simulation.simulate import simulate, truth_values

ANGLES = 361
"""Polariser angles, over half a turn, of which the information is computed; between them it is a Fourier series in 2θ.

So many since errors vary quickly where a camera is dark: over some √(σ²/N) rad, N its counts in full light."""
DRAWS = 20
LEAST_DETERMINANT = 0.1
COLOURS = (float("nan"), 4000.0, 8000.0)
"""Colour temperatures (K; NaN: flat photon spectrum) at which p is to be known."""
TARGET_GRID = 9  # field points along each axis at which the error of p is asked
OVERHEAD: Mapping[str, float] = {"clp": 20.0, "moon": 60.0, "standard": 90.0, "lamp": 15.0}
"""Time (s) that an exposure of a KIND takes beside its EXPTIME: read-out, turning or pointing, settling."""


@dataclasses.dataclass(frozen=True)
class Candidates:
    """Everything that could be observed, with the information that each exposure would bring.

    `families` go by `labels`: a continuum of polariser angles (as 2θ, rad) for each setting, then the exposures of each
    other KIND in the order of `plan`; `settings` are filter and positions of moving elements of the former. `slopes`
    (draw, point, element, parameter) are the derivatives of the matrix at the target points, `forms`
    (draw, point, 6, 6) the quadratic form that makes the mean square error of p of them, 0 where one exposure holds no
    u. `truncation` is the largest error of the information between the angles that were computed, in units of the mean
    diagonal of each parameter.
    """

    plan: ObservingPlan
    model: Model
    families: tuple[Family, ...]
    labels: tuple[str, ...]
    settings: tuple[tuple[str, Mapping[str, float | None]], ...]
    x: Float[np.ndarray, " p"]
    y: Float[np.ndarray, " p"]
    slopes: Float[np.ndarray, "r p 6 f"]
    forms: Float[np.ndarray, "r p 6 6"]
    prior: Float[np.ndarray, "f f"]
    truncation: float

    def experiment(
        self,
        minutes: float,
        known: Float[np.ndarray, "f f"] | None = None,
        targets: Float[np.ndarray, "r k f q"] | None = None,
    ) -> Experiment:
        """The problem of a budget in minutes; `known` is the information of what was measured before.

        Default target: the mean square error of p (in %²) at every point and colour.
        """
        before = self.prior if known is None else known
        draws = len(self.slopes)
        return Experiment(
            np.broadcast_to(before, (draws, *before.shape)).copy(),
            self.p_targets() if targets is None else targets,
            self.families,
            60.0 * minutes,
        )

    def p_targets(self) -> Float[np.ndarray, "r k f 6"]:
        """Linear functions of the parameters whose summed variance is the mean square error of p, in %²."""
        value, vector = np.linalg.eigh(self.forms)
        root = vector * np.sqrt(np.clip(value, 0.0, None))[..., None, :]
        seen = self.forms.any(axis=(2, 3)).all(axis=0)
        return 100.0 * np.einsum("rpif,rpij->rpfj", self.slopes, root)[:, seen]

    def p_error(self, covariance: Float[np.ndarray, "r f f"]) -> Float[np.ndarray, "r p"]:
        """Error of p (fraction) at the target points for covariances of the parameters; NaN where there is no u."""
        c = np.einsum("rpif,rfg,rpjg->rpij", self.slopes, covariance, self.slopes, optimize=True)
        square = np.einsum("rpij,rpij->rp", self.forms, c)
        return np.sqrt(np.where(self.forms.any(axis=(2, 3)), square, np.nan))


def candidates(
    plan: ObservingPlan,
    *,
    draws: int = DRAWS,
    seed: int = 0,
    overhead: Mapping[str, float] = OVERHEAD,
    colours: Sequence[float] = COLOURS,
    angles: int = ANGLES,
    progress: Callable[[str], None] | None = None,
) -> Candidates:
    """The exposures that an observing plan allows, each with its information in `draws` draws of the instrument.

    `overhead` (s) by KIND is added to EXPTIME; `angles`, an odd number, are those of the polariser.
    """
    tell = progress or (lambda text: None)
    sky = dataclasses.replace(plan, polariser_angles=(0.0,), plate=plan.plate[:1])
    # The model of all exposures: no family by itself would free all parameters.
    blank = simulate(sky, noiseless=True, steady=True).calset
    model = base_model(blank, plan.design, throughput_degree=plan.throughput_degree)
    families: list[Family] = []
    labels, truncation = [], float("nan")
    settings = []
    for setting, there in _through_the_polariser(plan, angles):
        label = ", ".join(
            ["clp", setting[0], *(f"{p} {'out' if a is None else f'{a:g}°'}" for p, a in setting[1].items())]
        )
        settings.append(setting)
        tell(f"information of {label}")
        rows = np.flatnonzero(there.exposures().kind == "clp")
        information = np.stack([_information(there, model, seed + draw, rows) for draw in range(draws)])
        family = Circle.sampled(information, _cost(there, rows, overhead)[0])
        families.append(family)
        labels.append(label)
        if len(families) == 1:
            # Held against what it stands for, at angles between those of the series.
            turned = tuple(np.array(there.polariser_angles) + 90.0 / angles)
            between = dataclasses.replace(there, polariser_angles=turned)
            truncation = _between(family, between, _information(between, model, seed, rows))
    exposures = sky.exposures()
    for kind in dict.fromkeys(k for k in exposures.kind.tolist() if k != "clp"):
        tell(f"information of {kind} exposures")
        rows = np.flatnonzero(exposures.kind == kind)
        information = np.stack([_information(sky, model, seed + draw, rows) for draw in range(draws)])
        families.append(Listed.of(information, _cost(sky, rows, overhead)))
        labels.append(kind)
    tell("what is wanted")
    wanted = [_wanted(sky, model, _drawn(sky, model, seed + draw)[1], colours) for draw in range(draws)]
    slopes, forms = (np.stack(part) for part in zip(*wanted, strict=True))
    known = prior_rows(model).jacobian(model.selection())
    x, y = _target_points(plan)
    repeated = len(colours) * len(plan.filters)
    return Candidates(
        plan=sky,
        model=model,
        families=tuple(families),
        labels=tuple(labels),
        settings=tuple(settings),
        x=np.tile(x, repeated),
        y=np.tile(y, repeated),
        slopes=slopes,
        forms=forms,
        prior=known.T @ known,
        truncation=truncation,
    )


def _through_the_polariser(
    plan: ObservingPlan, angles: int
) -> Iterator[tuple[tuple[str, dict[str, float | None]], ObservingPlan]]:
    """One plan for every filter and position of the moving elements, the polariser going through half a turn."""
    turn = tuple((180.0 / angles * np.arange(angles)).tolist())
    positions = {CALIBRATION_PLATE: plan.plate, **plan.moving}
    for name in plan.filters:
        for stops in itertools.product(*positions.values()):
            yield (
                (name, dict(zip(positions, stops, strict=True))),
                dataclasses.replace(
                    plan,
                    polariser_angles=turn,
                    filters=(name,),
                    plate=stops[:1],
                    moving={prefix: (a,) for prefix, a in zip(plan.moving, stops[1:], strict=True)},
                    moon_patches=0,
                    lamps=0,
                ),
            )


def _cost(
    plan: ObservingPlan, rows: Int[np.ndarray, " e"], overhead: Mapping[str, float]
) -> Float[np.ndarray, " e"]:
    """Time (s) of exposures, with what each takes beside."""
    exposures = plan.exposures()
    return exposures.exptime[rows] + np.array([overhead.get(str(k), 0.0) for k in exposures.kind[rows]])


def _drawn(plan: ObservingPlan, model: Model, seed: int) -> tuple[CalibrationSet, Float[np.ndarray, " n"]]:
    """The set that a plan gives without noise, and the true values of the model's parameters."""
    calset, truth = simulate(plan, seed=seed, noiseless=True, steady=True)
    there = truth_values(truth)
    return calset, np.array([there[name] for name in model.names])


def _information(
    plan: ObservingPlan, model: Model, seed: int, chosen: Int[np.ndarray, " e"]
) -> Float[np.ndarray, "e f f"]:
    """J_eᵀ J_e of chosen exposures, in the instrument that a seed draws."""
    calset, values = _drawn(plan, model, seed)
    likelihood = Likelihood.of(calset, model)
    jacobian = likelihood.jacobian(values)
    exposure = np.repeat(np.nonzero(likelihood.used)[1], likelihood.cameras)
    parts = (jacobian[exposure == e] for e in chosen)
    return np.stack([rows.T @ rows for rows in parts])


def _target_points(plan: ObservingPlan) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]]:
    edge = np.linspace(-plan.field, plan.field, TARGET_GRID)
    y, x = (a.ravel() for a in np.meshgrid(edge, edge, indexing="ij"))
    return x, y


def _wanted(
    plan: ObservingPlan, model: Model, values: Float[np.ndarray, " n"], colours: Sequence[float]
) -> tuple[Float[np.ndarray, "p 6 f"], Float[np.ndarray, "p 6 6"]]:
    """Derivatives of the matrix, and the form of the error of p, at the target points in all filters and colours."""
    instrument, select = model.instrument(values), model.selection()
    x, y = _target_points(plan)
    stars = sample_stars()
    along = stars / np.hypot(*stars.T)[:, None]
    light = np.concatenate([np.ones((len(stars), 1)), stars], axis=1)
    slopes, forms = [], []
    for name in plan.filters:
        for teff in colours:
            setting = dataclasses.replace(Settings.default(1, name), teff=np.array([teff]))
            m, slope = matrix_slopes(instrument, setting, plan.curves(), x, y)
            local = m[:, :, 1:]
            determinant = np.linalg.det(local)
            blind = np.abs(determinant) < LEAST_DETERMINANT
            inverse = np.linalg.inv(np.where(blind[:, None, None], np.eye(2), local))
            # δp of a star = −e · M⁻¹ δm s, linear in the six elements of δm.
            form = np.einsum("nc,pcr,ns->pnrs", along, inverse, light).reshape(len(x), len(stars), 6)
            square = np.einsum("pni,pnj->pij", form, form) / len(stars)
            forms.append(np.where(blind[:, None, None], 0.0, square))
            slopes.append(slope.reshape(len(x), 6, -1) @ select)
    return np.concatenate(slopes), np.concatenate(forms)


def _between(family: Circle, plan: ObservingPlan, information: Float[np.ndarray, "s f f"]) -> float:
    """Largest error of a family's series at the angles of a plan, in units of the mean diagonal of each parameter."""
    rows = family.coefficients(np.deg2rad(2.0 * np.array(plan.polariser_angles))[:, None])
    made = np.einsum("sj,jab->sab", rows, family.basis[0], optimize=True)
    size = np.sqrt(np.einsum("saa->a", information) / len(information))
    size = np.where(size > 0, size, 1.0)
    return float(np.max(np.abs(made - information) / (size[:, None] * size)))
