"""One fit laid out for linear algebra: residuals, Jacobian, priors as rows, and where every row comes from.

Patterns without a name describe possible disagreements of any instrument of this kind. Each stratum holds patterns of
one sort, in one camera or in all of them, and is one candidate of the score test. A pattern perturbs the counts of a
camera k in one of two ways, which differ most where polarised light leaves the camera dark:

gain            N_k → N_k (1 + a · pattern): the camera answers with a larger share of the counts that it has. Dust, a
                flat field, an amplifier: where the camera is dark, nothing changes.
light           N_k → N_k + a · F · L_k · pattern: light is added, whatever the polarisation of the light through the
                polariser. A ghost, a reflection, a background that follows the flux: a dark camera sees it best.

vector          light, in proportion to q or u: one element of the analysis vector of one camera × field polynomials up
                to degree 4: anything linear in the light (a Mueller effect) that is smooth in the field
harmonic        gain and light: 1θ, 3θ, 4θ, 5θ, 6θ of the angle of the polariser, or of a moving element other than the
                calibration plate, in one camera × field polynomials up to degree 1. Of the polariser these are what no
                Mueller matrix behind it can make
fine structure  gain and light × field polynomials of degree 5 to 8
rings           gain and light × polynomials of the squared field radius, of degree 3 to 8 in it
time, flux, temperature   gain and light of all cameras, linear in that quantity
kind, filter, plate       the response to I, q and u (light), and the gain, of all cameras, between kinds of exposure,
                filters, plate settings; for kinds also gradients over the field, of gain and of light
single exposures          gain, and light, in each exposure, of the cameras `Measured.gained` (all but one of those with
                a flux in common), where exposures have `MANY_POINTS` field points on average
states          gain of each camera in each state, the same in all filters, where there are several: a state is all
                exposures that differ in nothing but the filter

Amplitudes have no unit: they are shares of the counts (gain), or of the mean counts L_k of the camera over the
exposures of the field point, for light of unit flux (light).

Scores of all patterns against a fit (`pattern_scores`) come from one number for each exposure at a point instead of
each intensity.

Equation    A pattern of camera k changes the counts of that camera alone: its column is −v (e_k − m m_k) in every row,
                C_aᵀC_b = Σ v_a v_b (δ_kl − m_k m_l),   QᵀC_a = −Σ v_a (Q_k − m_k (m·Q))
            and behind the base G = CᵀC − (QᵀC)ᵀ(QᵀC).
Symbols     a, b patterns of the cameras k, l; v = change of the counts / error, for a gain expected counts × pattern /
            error, for light F L_k × pattern / error; m = expected counts / errors of all with a flux in common, of
            unit length, 0 where the flux is known; Q orthonormal basis of the derivatives with respect to the free
            parameters
Limits      The difference leaves 10⁻¹⁶ of the square of a column; what has less than `score.ABSORBED` left plays no
            part. Where exposures have a flux in common their rows hang together, and all columns are written out.
"""

from __future__ import annotations

import collections
import dataclasses
import enum
import itertools
from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.polynomial.legendre import legvander

from walop_jax.data.kinds import CALIBRATION_PLATE, POLARISER
from walop_jax.data.records import CalibrationSet, Exposures
from walop_jax.diagnosis import thresholds
from walop_jax.diagnosis.score import Candidate, Projector, ScoreSpace, ScoreTable, gram, joined_in_batches
from walop_jax.fit.refit import FitResult
from walop_jax.fit.robust import cut, states
from walop_jax.io.shapes import AnyMatrix, AnyVector, ResidualCube
from walop_jax.likelihood.columns import Columns
from walop_jax.likelihood.flux import project_flux
from walop_jax.likelihood.inverses import determined, unit_columns, whitening
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model import legendre
from walop_jax.model.effects.free_form import FINE, HARMONICS, SMOOTH, WIDTH
from walop_jax.model.instrument import Instrument

MANY_POINTS = 4
"""Field points of an exposure, on average, above which its cameras may have gains of their own: with fewer there are
nearly as many gains as data."""


class Sort(enum.StrEnum):
    """The two ways in which a pattern changes the counts of a camera: multiplied by a gain, or with light added."""

    GAIN = "gain"
    LIGHT = "light"


GAIN, LIGHT = Sort.GAIN, Sort.LIGHT
SINGLE_EXPOSURES = "single exposures"
STATES = "states"


class Measured:
    """The measurements at a best fit, laid out for building columns of residual derivatives.

    `found` are the fluxes and residuals at the `values`, if they are known (`Likelihood.residuals`).
    """

    def __init__(
        self,
        likelihood: Likelihood,
        values: Float[np.ndarray, " n"],
        found: tuple[Float[np.ndarray, "p e"], ResidualCube] | None = None,
    ) -> None:
        self.likelihood, self.values = likelihood, values
        self.weight: ResidualCube = likelihood.points.gathered("weight")
        self.counts: ResidualCube = likelihood.points.gathered("counts")
        self.used: Bool[np.ndarray, "p e"] = likelihood.used
        self.flux, self.residual = found or likelihood.residuals(values)
        self.shared = likelihood.flux_groups
        # Weighted model at unit flux, from data = flux · model + residual.
        flux = np.where(self.flux == 0, 1.0, self.flux)[..., None]
        residual = self.shared.independent(self.residual, inverse=True)
        self.model: ResidualCube = (self.counts * self.weight - residual) / flux
        self.known = likelihood.flux_known
        self.cameras = likelihood.cameras
        # Of the model, not of the counts: patterns correlated with the noise would match it in the residuals.
        unit = self.model / np.where(self.weight > 0, self.weight, 1.0)
        count = np.maximum(self.used.sum(axis=1), 1)[:, None]
        self.level: Float[np.ndarray, "p k"] = np.where(self.used[..., None], unit, 0.0).sum(axis=1) / count
        # Derivatives of the residuals with respect to numbers that the set states, as far as they were asked.
        self.by_stated_number: dict[str, Float[np.ndarray, " _"]] = {}

    def counts_changed_by(self, sort: Sort) -> ResidualCube:
        """Counts, in standard errors, that a pattern of 1 everywhere adds to every camera as a gain, or as light."""
        unit = self.model if sort == GAIN else self.level[:, None, :] * self.weight
        return self.flux[..., None] * unit

    def column(self, pattern: ResidualCube, sort: Sort) -> Float[np.ndarray, " _"]:
        """Derivative of the residuals with respect to the amplitude of a pattern of gains, or of light."""
        return self._projected(self.counts_changed_by(sort) * pattern)

    def derivative(self, change: ResidualCube) -> Float[np.ndarray, " _"]:
        """Derivative of the residuals with respect to the amplitude of N_k → N_k + change, a change in counts."""
        return self._projected(change * self.weight)

    def _projected(self, change: ResidualCube) -> Float[np.ndarray, " _"]:
        """Derivative with respect to the amplitude of a change of the counts in standard errors: fluxes follow it."""
        projected = project_flux(change, self.model, self.known, self.shared)
        return -projected[self.used].reshape(-1)

    @cached_property
    def columns(self) -> Columns:
        """Columns of changes of the instrument at these values, which need the responses of the whole light path."""
        return Columns(self.likelihood, self.values)

    @property
    def has_gains(self) -> bool:
        """True if exposures have so many field points that gains of single exposures leave degrees of freedom."""
        return bool(self.used.sum() >= MANY_POINTS * self.used.any(axis=0).sum())

    @property
    def gained(self) -> list[int]:
        """Cameras that have a gain beside the flux."""
        return [k for k in range(self.cameras) if self.together[k, k + 1 :].any()]

    @property
    def together(self) -> Float[np.ndarray, "k k"]:
        """1 for two cameras with a flux in common."""
        shared = self.shared.cameras
        return np.ones((self.cameras,) * 2) if shared is None else np.asarray(shared)

    @cached_property
    def unit_model(self) -> Float[np.ndarray, "r k"]:
        """Weighted model of every used row, of unit length over the cameras with a flux in common; 0 if that is known.

        Where exposures have no flux in common, elimination of the flux removes the component of a row along it.
        """
        power = self.shared.summed(self.model**2)
        unit = self.model / np.sqrt(np.where(power > 0, power, 1.0))
        return np.where(self.known[:, None], 0.0, unit)[self.used]

    def changes(self, strata: Sequence[_Stratum]) -> Float[np.ndarray, "r a"]:
        """Change by every pattern in its camera in every used row, in standard errors, the flux held."""
        sizes = {sort: self.counts_changed_by(sort)[self.used] for sort in (GAIN, LIGHT)}
        points, exposures = np.nonzero(self.used)
        changes = np.empty((len(points), sum(len(s.camera) for s in strata)), order="F")
        column = 0
        for stratum in strata:
            for k, pattern in zip(stratum.camera, stratum.patterns, strict=True):
                values = np.broadcast_to(pattern, self.used.shape)[points, exposures]
                np.multiply(sizes[stratum.sort][:, k], values, out=changes[:, column])
                column += 1
        return changes

    def candidate(self, stratum: _Stratum) -> Candidate:
        """The columns of a stratum, intensity by intensity."""
        camera, unit = np.asarray(stratum.camera), np.eye(self.cameras)
        if self.shared.single:
            changes, m = self.changes([stratum]), self.unit_model
            columns = np.empty((len(m), self.cameras, len(camera)))
            for c in range(self.cameras):
                projection = unit[c, camera] - self.together[c, camera] * m[:, c, None] * m[:, camera]
                np.multiply(-changes, projection, out=columns[:, c])
            columns = columns.reshape(-1, len(camera))
        else:
            patterns = zip(camera, stratum.patterns, strict=True)
            columns = np.column_stack(
                [self.column(pattern[..., None] * unit[k], stratum.sort) for k, pattern in patterns]
            )
        return Candidate(stratum.name, columns, stratum.widths, stratum.block)


class _Stratum(NamedTuple):
    """Patterns of single cameras, each of shape (points or 1, exposures or 1), and the camera of each.

    `sort` is that of all patterns: "gain" or "light". `block` is the block of the free-form term that can take them up.
    Example: "fine structure of E1" holds 30 patterns over the field of the gain of camera E1, "fine structure of light
    on E1" the same patterns of light added to the counts of E1.
    """

    name: str
    sort: Sort
    camera: Sequence[int]
    patterns: Sequence[AnyMatrix]
    block: str = ""

    @property
    def widths(self) -> Float[np.ndarray, " _"]:
        """Prior standard deviations of the amplitudes."""
        return np.full(len(self.camera), WIDTH)


def _in_each(
    cameras: Sequence[int], name: str, sort: Sort, patterns: Sequence[AnyMatrix], block: str = ""
) -> _Stratum:
    """Each pattern in each of these cameras."""
    pairs = list(itertools.product(patterns, cameras))
    return _Stratum(name, sort, [k for _, k in pairs], [pattern for pattern, _ in pairs], block)


def pattern_in_words(name: str, cameras: Sequence[str]) -> str:
    """The name of a pattern for a reader: "fine structure of E1" is fine structure of the gain of E1, not of light."""
    what, of, camera = name.rpartition(" of ")
    is_gain = camera in cameras and not what.startswith("vector")
    return f"{what}{of}the gain of {camera}" if is_gain else name


def number_of_columns(calset: CalibrationSet, instrument: Instrument) -> int:
    """Number of columns of all strata together, or a few more."""
    e, cameras = calset.exposures, len(instrument.cameras)
    turning = 1 + len(instrument.patched().moving())
    of_camera = 2 * len(legendre.terms(SMOOTH))
    # Gain and light of each: fine structure, rings, harmonics, then time, temperature and flux.
    of_camera += 2 * (len(legendre.terms(FINE)) + len(thresholds.RINGS) + 6 * len(HARMONICS) * turning + 3)
    of_camera += 8 * (len(np.unique(e.kind)) - 1) + 4 * (len(np.unique(e.filter)) - 1)
    for prefix in instrument.patched().moving():
        of_camera += 4 * (len(np.unique(positions_of(e, prefix))) - 1)
    gains = (2 * len(e) + int(states(calset).max()) + 1) * (cameras - instrument.cameras.fluxes)
    return cameras * of_camera + gains


def positions_of(e: Exposures, prefix: str) -> np.ndarray:
    """Angle (deg) of a moving element in every exposure, or "out", as texts."""
    position = e.position(prefix)
    return np.array([f"{a:g}" if i else "out" for i, a in zip(position.inside, position.angle, strict=True)])


def strata(measured: Measured) -> Iterator[_Stratum]:
    """All strata that the exposures of the set allow."""
    e, points = measured.likelihood.calset.exposures, measured.likelihood.calset.points
    names = measured.likelihood.model.template.cameras.names
    all_cameras = range(len(names))
    # Calibration plates that are put in at one or two angles are compared as groups, below.
    further = [(f" {prefix}", prefix) for prefix in measured.likelihood.plan.moving if prefix in e.further]
    turning = [("θ", POLARISER), *further]

    scale = measured.likelihood.model.template.units.field
    smooth = legendre.basis(points.x, points.y, SMOOTH, scale)
    fine = legendre.basis(points.x, points.y, FINE, scale)[:, smooth.shape[1] :]
    square = points.x**2 + points.y**2
    squared_radius = 2.0 * square / max(float(square.max()), 1e-300) - 1.0
    rings = legvander(squared_radius, thresholds.RINGS[-1])[:, thresholds.RINGS]
    stokes = measured.likelihood.stokes(measured.values)
    for k, camera in enumerate(names):
        for i, element in ((1, "q"), (2, "u")):
            patterns = [term[:, None] * stokes[..., i] for term in smooth.T]
            yield _in_each([k], f"vector {element} of {camera}", LIGHT, patterns, "vectors")
        for symbol, prefix in turning:
            position = e.position(prefix)
            through = position.inside & measured.used.any(axis=0)
            angle = np.deg2rad(np.where(through, position.angle, 0.0))
            for harmonic in HARMONICS:
                if len(np.unique(np.round(np.mod(position.angle[through], 360.0), 3))) < 2 * harmonic + 1:
                    continue
                waves = [np.where(through, wave(harmonic * angle), 0.0) for wave in (np.cos, np.sin)]
                patterns = [term[:, None] * wave for term in smooth.T[:3] for wave in waves]
                # A gain that follows hθ makes light that follows (h − 2)θ, hθ and (h + 2)θ of a polarised beam.
                block = "harmonics" if prefix == POLARISER else "exposures"
                for sort, where in ((GAIN, camera), (LIGHT, f"light on {camera}")):
                    yield _in_each([k], f"{harmonic}{symbol} of {where}", sort, patterns, block)
        for sort, where, block in ((GAIN, camera, "fine_gains"), (LIGHT, f"light on {camera}", "fine")):
            yield _in_each([k], f"fine structure of {where}", sort, [t[:, None] for t in fine.T], block)
            yield _in_each([k], f"rings of {where}", sort, [ring[:, None] for ring in rings.T], block)
    by_exposure, none = {GAIN: "exposure_gains", LIGHT: "exposures"}, {GAIN: "", LIGHT: ""}
    for name, quantity, blocks in (
        ("time", e.mjd[None, :], by_exposure),
        ("temperature", e.temp[None, :], by_exposure),
        ("flux", measured.flux, none),
    ):
        measured_values = quantity[measured.used] if quantity.shape == measured.used.shape else quantity
        if not np.isfinite(measured_values).any():
            continue
        quantity = quantity - np.nanmean(measured_values)
        spread = np.nanstd(quantity)
        if np.isfinite(spread) and spread > 1e-9 * max(1.0, float(np.nanmax(np.abs(quantity)))):
            pattern = np.nan_to_num(quantity / spread)
            for sort in (GAIN, LIGHT):
                yield _in_each(all_cameras, f"{sort} with {name}", sort, [pattern], blocks[sort])
    positions = [(prefix.lower(), positions_of(e, prefix)) for prefix in measured.likelihood.plan.moving]
    for name, label, blocks in (
        ("kind", e.kind, by_exposure),
        ("filter", e.filter, none),
        *((("plate" if prefix == "chwp" else prefix), label, none) for prefix, label in positions),
    ):
        members = [label == group for group in np.unique(label)[1:]]
        if members:
            responses = [np.where(member, stokes[..., i], 0.0) for member in members for i in range(3)]
            yield _in_each(all_cameras, f"response by {name}", LIGHT, responses, blocks[LIGHT])
            gains = [np.where(member, 1.0, 0.0)[None] for member in members]
            yield _in_each(all_cameras, f"gain by {name}", GAIN, gains, blocks[GAIN])
    groups = itertools.product(np.unique(e.kind)[1:], smooth.T[1:3])
    gradients = [np.where(e.kind == group, term[:, None], 0.0) for group, term in groups]
    if gradients:
        for sort in (GAIN, LIGHT):
            yield _in_each(all_cameras, f"{sort} by kind, over the field", sort, gradients)
    if measured.has_gains:
        alone = list(np.eye(len(e))[:, None])
        yield _in_each(measured.gained, SINGLE_EXPOSURES, GAIN, alone, "exposure_gains")
        yield _in_each(measured.gained, f"light in {SINGLE_EXPOSURES}", LIGHT, alone, "exposures")
    state = states(measured.likelihood.calset)
    several = np.unique(state) if len(np.unique(state)) < len(state) else ()
    if len(several) and measured.gained:
        patterns = [np.where(state == number, 1.0, 0.0)[None] for number in several]
        yield _in_each(measured.gained, STATES, GAIN, patterns)


# ----------------------------------------------------------------------------------------------------- one fit laid out


@dataclasses.dataclass(frozen=True)
class Design:
    """Residuals r (data − model, whitened) and J = ∂r/∂θ of the free parameters at a fit; priors are the last rows.

    The rows of the data run over points, then exposures, then cameras, used ones only. `served_by` are the measurements
    at another fit of the same data, which expects nearly the same counts: its columns serve here as well. None: the fit
    has columns of its own.
    """

    fit: FitResult
    measured: Measured
    residual: AnyVector
    jacobian: Float[np.ndarray, "_ _"]
    served_by: Measured | None = None

    @classmethod
    def of(cls, fit: FitResult) -> Design:
        """Lay out a fit."""
        likelihood = fit.likelihood
        *found, slope = likelihood.linearised(fit.values)
        measured = Measured(likelihood, fit.values, (found[0], found[1]))
        scale = fit.noise_scale
        data, slope = measured.residual[measured.used].reshape(-1) / scale, slope / scale
        # Data − model: priors stand in for data, so their rows are mean − value.
        prior = -likelihood.priors.residuals(fit.values)
        prior_slope = -likelihood.priors.jacobian(fit.model.selection())
        return cls(fit, measured, np.concatenate([data, prior]), np.vstack([slope, prior_slope]))

    @property
    def origin(self) -> Measured:
        """The measurements at the fit whose columns are used."""
        return self.served_by or self.measured

    @property
    def columns(self) -> Columns:
        """Columns of changes that the model does not include."""
        return self.origin.columns

    @property
    def rows(self) -> int:
        """Number of rows that are data."""
        return self.measured.cameras * int(self.measured.used.sum())

    @cached_property
    def exposure(self) -> Int[np.ndarray, " d"]:
        """Exposure (position) of every data row."""
        return np.repeat(np.nonzero(self.measured.used)[1], self.measured.cameras)

    @cached_property
    def point(self) -> Int[np.ndarray, " d"]:
        """Field point (position) of every data row."""
        return np.repeat(np.nonzero(self.measured.used)[0], self.measured.cameras)

    @cached_property
    def projector(self) -> Projector:
        """Projection of columns off the space of the free parameters."""
        return Projector(self.jacobian, self.eliminated)

    @property
    def eliminated(self) -> int:
        """Rows without noise: one for each fitted flux and for each ineffective weak constraint."""
        likelihood = self.fit.likelihood
        fluxes = round(float(self.measured.used.sum(axis=0) @ (likelihood.cameras - likelihood.data_per_row)))
        fitted = determined(self.jacobian.T @ self.jacobian, likelihood.weak)
        return fluxes + int((~likelihood.priors.known).sum()) - (len(likelihood.weak) - round(fitted))

    def columns_of(self, positions: Int[np.ndarray, " _"] | Sequence[int]) -> Int[np.ndarray, " a"]:
        """Columns of the Jacobian that belong to parameters at some positions, as far as these are free."""
        place = {i: k for k, i in enumerate(self.fit.model.free.tolist())}
        return np.array([place[i] for i in np.asarray(positions, int).tolist() if i in place], int)

    def without(self, at: Int[np.ndarray, " a"]) -> tuple[Projector, Float[np.ndarray, "_ _"]]:
        """Projector off all parameters but some, and an orthonormal basis of the projected columns of these."""
        if not len(at):
            return self.projector, np.zeros((len(self.residual), 0))
        projector = Projector(np.delete(self.jacobian, at, axis=1), self.eliminated)
        projected = projector(self.jacobian[:, at])
        return projector, projected @ whitening(projected.T @ projected)

    def stacked(self, columns: Sequence[Float[np.ndarray, "_ _"]]) -> Float[np.ndarray, "_ _"]:
        """Columns of data rows side by side, in units of the noise, with zeros for the priors."""
        matrix = np.concatenate(columns, axis=1, dtype=float) / self.fit.noise_scale
        return np.pad(matrix, ((0, len(self.residual) - self.rows), (0, 0)))

    def products(
        self, columns: Sequence[Float[np.ndarray, "_ _"]], rows: Float[np.ndarray, "_ ..."]
    ) -> Float[np.ndarray, "_ ..."]:
        """Cᵀ times rows, of the columns C that `stacked` puts side by side."""
        products = [joined.T @ rows[: self.rows] for _, joined in joined_in_batches(columns)]
        return np.concatenate(products) / self.fit.noise_scale

    def cube(self, rows: AnyVector) -> Float[np.ndarray, "p e k"]:
        """Data rows put back into (point, exposure, camera); 0 where unused."""
        used = self.measured.used
        cube = np.zeros((*used.shape, self.measured.cameras))
        cube[used] = rows[: self.rows].reshape(-1, self.measured.cameras)
        return cube

    def robust_ratio(self, name: str) -> float:
        """Largest ratio of robust to stated errors among the parameters of an effect; NaN when it has none.

        The robust ones let every exposure have a disturbance of its own: the "sandwich" H⁻¹ (Σ g_e g_eᵀ) H⁻¹ with
        H = JᵀJ and g_e the gradient of exposure e (White 1982, Econometrica 50, 1; Liang & Zeger 1986, Biometrika 73,
        13).
        """
        at = self.columns_of(self.fit.model.positions(name))
        if not len(at):
            return float("nan")
        scaled, _ = unit_columns(self.jacobian)
        inverse = np.linalg.pinv(scaled.T @ scaled, hermitian=True)[at]
        pull = (scaled * self.residual[:, None])[: self.rows] @ inverse.T
        by_exposure = np.zeros((self.measured.used.shape[1], len(at)))
        np.add.at(by_exposure, self.exposure, pull)
        return float(np.sqrt(np.max(np.sum(by_exposure**2, axis=0) / np.diag(inverse[:, at]))))


HOLDOUT_FOLDS = 5


def exposure_folds(design: Design) -> Int[np.ndarray, " d"]:
    """Fold of every data row: exposures of each kind and setting dealt out in turn."""
    e = design.fit.calset.exposures
    fold, groups = np.zeros(len(e), int), collections.Counter[tuple[str, ...]]()
    for i, key in enumerate(zip(e.kind, e.filter, positions_of(e, CALIBRATION_PLATE), strict=True)):
        fold[i] = groups[key] % HOLDOUT_FOLDS
        groups[key] += 1
    return fold[design.exposure]


def field_folds(design: Design) -> Int[np.ndarray, " d"]:
    """Fold of every data row: the field cut into 5 × 5 blocks, dealt out so that neighbours differ."""
    points = design.fit.calset.points
    return ((cut(points.x, 5) + 2 * cut(points.y, 5)) % HOLDOUT_FOLDS)[design.point]


def folds(design: Design, scheme: str) -> Int[np.ndarray, " d"]:
    """Fold of every data row in a scheme, "exposures" or "field blocks"."""
    return {"exposures": exposure_folds, "field blocks": field_folds}[scheme](design)


def held_out(design: Design, scheme: str) -> float:
    """Mean squared normalised residual on data that took no part in a fit: each fold is predicted by the others.

    The other folds, and the priors, move the free parameters by one Gauss–Newton step from the joint minimum: a
    fraction of the standard errors, where the model is linear to better than that fraction squared. What they do not
    determine, such as throughputs beyond their last field point, they cannot predict with any model; prediction errors
    d of a fold are therefore in units of what the parameters besides those of effects leave open,

        dᵀ Σ⁻¹ d,   Σ = 1 + A H⁻¹ Aᵀ,   Σ⁻¹ = 1 − A (H + AᵀA)⁻¹ Aᵀ

    Effects gain nothing by being vague: their columns are not in A. Noise alone gives 1 − 1/K with K cameras when the
    flux is free.

    Symbols     A rows of the Jacobian of the fold, H normal matrix of all other rows, both of the parameters besides
                those of effects
    """
    fold = folds(design, scheme)
    squares, (unit, _) = np.zeros(HOLDOUT_FOLDS), unit_columns(design.jacobian)
    ridge, model = 1e-12 * np.eye(unit.shape[1]), design.fit.model
    of_effects = [design.columns_of(model.positions(name)) for name in model.effect_names]
    bare = np.delete(unit, np.concatenate(of_effects), axis=1) if of_effects else unit
    whole = bare.T @ bare + ridge[: bare.shape[1], : bare.shape[1]]
    for k in np.unique(fold):
        rows = np.flatnonzero(fold == k)
        others, r = np.delete(unit, rows, axis=0), np.delete(design.residual, rows)
        step = -np.linalg.solve(others.T @ others + ridge, others.T @ r)
        error = design.residual[rows] + unit[rows] @ step
        pull = bare[rows].T @ error
        squares[k] = error @ error - pull @ np.linalg.solve(whole, pull)
    return float(squares.sum() / len(fold)) * design.fit.noise_scale**2


# ----------------------------------------------------------------------------------------------- the scores of patterns


def pattern_scores(design: Design, seed: int = 0) -> ScoreTable:
    """The scores of all patterns that the exposures allow, against a fit."""
    all_strata = list(strata(design.measured))
    single = design.measured.shared.single
    space, scores, square = (_from_rows if single else _from_columns)(design, all_strata)
    return space.table(scores, square, space.smallest_p(np.random.default_rng(seed)))


def _from_columns(design: Design, all_strata: list[_Stratum]) -> tuple[ScoreSpace, AnyVector, float]:
    """Space, C̃ᵀr and r·r from columns of all intensities."""
    columns = [design.measured.candidate(stratum).columns for stratum in all_strata]
    names, widths = [stratum.name for stratum in all_strata], [stratum.widths for stratum in all_strata]
    space = ScoreSpace.projected(design.projector, names, widths, columns, scale=design.fit.noise_scale)
    residual = design.projector(design.residual)
    return space, design.products(columns, residual), float(residual @ residual)


def _from_rows(design: Design, all_strata: list[_Stratum]) -> tuple[ScoreSpace, AnyVector, float]:
    """The same from the rows of exposures and points."""
    measured, scale = design.measured, design.fit.noise_scale
    camera = np.concatenate([stratum.camera for stratum in all_strata])
    together, along = measured.together, measured.unit_model
    change = measured.changes(all_strata) / scale

    products = -together[np.ix_(camera, camera)] * gram(change * along[:, camera])
    for k in range(measured.cameras):
        at = np.flatnonzero(camera == k)
        products[np.ix_(at, at)] += gram(change[:, at])
    residual = design.projector(design.residual)
    rows = np.column_stack([design.projector.basis, residual])[: design.rows]
    rows = project_flux(rows.T.reshape(-1, *along.shape), along, shared=measured.shared)
    projections = np.empty((len(rows), len(camera)))
    for k in range(measured.cameras):
        at = np.flatnonzero(camera == k)
        projections[:, at] = -rows[..., k] @ change[:, at]
    base, scores = projections[:-1], projections[-1]
    names, widths = tuple(stratum.name for stratum in all_strata), [stratum.widths for stratum in all_strata]
    before, remaining = np.diag(products).copy(), products - base.T @ base
    space = ScoreSpace(
        names, tuple(map(len, widths)), np.concatenate(widths), before, remaining, design.projector.free
    )
    return space, scores, float(residual @ residual)
