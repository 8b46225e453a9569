"""Options of sampling, its progress, and its result: draws, intervals, the evidence that chains have converged.

An ensemble is an independent run of a sampler, of one walker or of many.

Autocorrelation   τ per quantity, averaged over walkers of all ensembles (Goodman & Weare 2010, CAMCoS 5, 65;
                  Sokal's window with c = 5).
Effective samples for the mean of all walkers, by ArviZ (Vehtari et al. 2021, Bayesian Anal. 16, 667).
R-hat             rank-normalised, split and folded, by ArviZ (as above). Walkers of one ensemble are not independent
                  chains, so it is taken between halves of ensembles.
Rules             N > 50 τ; τ the same within 25 % after N/4, N/2 and N steps; R-hat < 1.01.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import json
import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float

from walop_jax.fit.refit import FitResult
from walop_jax.fit.verdict import STATED, Doubt, Quality, Verdict
from walop_jax.io.code import versions_of
from walop_jax.io.display import Display, Drawn
from walop_jax.io.plain_tables import astropy_table
from walop_jax.io.shapes import Vector
from walop_jax.io.text import value_and_error
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.posterior.draws import as_arviz, group_of_draws
from walop_jax.posterior.samplers import Sampler, make_sampler
from walop_jax.posterior.surrogate import Accuracy
from walop_jax.posterior.target import LARGEST_SAMPLED

if TYPE_CHECKING:
    from xarray import Dataset, DataTree

Chains = Float[np.ndarray, "e t w k"]  # ensembles, stored steps, walkers, quantities

LENGTHS = 50.0  # in units of τ
STABLE = 0.25  # allowed relative change of τ over each of two doublings
LARGEST_RHAT = 1.01
LEAST_STORED = 40  # steps, below which nothing is said
RANKED = 100_000  # positions per quantity that R-hat looks at: sorting more takes longer than sampling them


@dataclasses.dataclass(frozen=True)
class Convergence:
    """Whether chains have converged, and the numbers that say so.

    `tau` (k) are the autocorrelation times in steps, `history` the worst of them after N/4, N/2 and N steps. `steps` is
    the number of steps kept after burn-in, `needed` how many more the rules ask for (0 when converged). Draws that are
    `independent` by their making have no chain to judge.
    """

    names: tuple[str, ...]
    steps: int
    tau: Float[np.ndarray, " k"]
    history: tuple[float, float, float]
    ess: Float[np.ndarray, " k"]
    rhat: Float[np.ndarray, " k"]
    needed: int
    reasons: tuple[str, ...]
    independent: bool = False

    @property
    def converged(self) -> bool:
        """True if all rules hold."""
        return not self.reasons

    @property
    def worst(self) -> str:
        """Name of the quantity with the longest autocorrelation time."""
        return self.names[int(np.argmax(self.tau))]

    def message(self, seconds_per_step: float = math.nan) -> str:
        """The result in one sentence."""
        if self.independent:
            drawn = f"{self.ess.min():.0f} independent draws"
            return drawn if self.converged else f"NOT sufficient: {drawn}; {'; '.join(self.reasons)}"
        if self.converged:
            tau = self.tau.max()
            length = f"{self.steps} steps, {self.steps / tau:.0f} τ, τ = {tau:.1f}"
            samples = f"at least {self.ess.min():.0f} effective samples, R-hat {self.rhat.max():.4f}"
            return f"converged: {length}, {samples}"
        time = "" if not np.isfinite(seconds_per_step) else f" (about {self.needed * seconds_per_step:.0f} s)"
        reasons = "; ".join(self.reasons)
        return f"NOT converged: {reasons}. Go on for {self.needed} steps or more{time} with --resume"


def autocorrelation(chains: Chains) -> Float[np.ndarray, " k"]:
    """τ in stored steps, per quantity; NaN for a quantity that never moved."""
    from emcee.autocorr import integrated_time

    e, n, w, k = chains.shape
    tau = np.full(k, np.nan)
    for i in range(k):
        x = np.moveaxis(chains[..., i], 0, 1).reshape(n, e * w)
        if np.all(np.ptp(x, axis=0) > 0):
            tau[i] = float(integrated_time(x[:, :, None], quiet=True, tol=0)[0])
    return tau


def r_hat(chains: Chains) -> Float[np.ndarray, " k"]:
    """R-hat between the halves of all ensembles, per quantity; NaN for a quantity that never moved."""
    from arviz_stats.base.array import array_stats

    e, k = chains.shape[0], chains.shape[-1]
    thinned = chains[:, :: max(1, chains[..., 0].size // RANKED)]
    rhat: Any = array_stats.rhat
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.array([float(rhat(thinned[..., i].reshape(e, -1))) for i in range(k)])


def effective_samples(chains: Chains) -> Float[np.ndarray, " k"]:
    """Number of independent draws that would give means as good, per quantity."""
    from arviz_stats.base.array import array_stats

    e, n, w, k = chains.shape
    walkers = np.moveaxis(chains, 2, 1).reshape(e * w, n, k)
    ess: Any = array_stats.ess
    return np.array([float(ess(walkers[..., i], method="mean")) for i in range(k)])


def _of_rows(likelihood: Likelihood) -> dict[str, Dataset]:
    """ArviZ's groups of the data: the used rows (point, exposure), with the ids of both as coordinates."""
    from xarray import Dataset

    calset, gathered = likelihood.calset, likelihood.points_as_stated.gathered
    used = likelihood.used
    point, exposure = np.nonzero(used)
    names = list(likelihood.model.template.cameras.names)
    number, exposures = calset.points.point[point], calset.exposures.exposure[exposure]
    place = {"point": ("row", number), "exposure": ("row", exposures), "camera": names}
    x, y, errors = calset.points.x[point], calset.points.y[point], 1.0 / gathered("weight")[used]
    dims, counts = ("row", "camera"), gathered("counts")[used]
    constant = {"N_ERR": (dims, errors), "X": ("row", x), "Y": ("row", y)}
    groups = {"observed_data": {"N": (dims, counts)}, "constant_data": constant}
    return {group: Dataset(columns, coords=place) for group, columns in groups.items()}


def arviz_of_fit(result: FitResult, draws: int, seed: int) -> Any:
    """Independent draws, for ArviZ, from the normal distribution of a fit; see `FitResult.to_arviz`."""
    size, parameters = result.sigma, result.model.parameters
    varies = np.flatnonzero(size > 0)
    correlation = result.covariance[np.ix_(varies, varies)] / np.outer(size[varies], size[varies])
    normal = functools.partial(np.random.default_rng(seed).multivariate_normal, method="eigh")
    drawn = result.values[varies] + size[varies] * normal(np.zeros(len(varies)), correlation, (4, draws))
    names = [parameters[i].name for i in varies]
    units = {parameters[i].name: parameters[i].unit for i in varies}
    posterior = group_of_draws({name: drawn[..., k] for k, name in enumerate(names)}, units)
    trusted = result.verdict is not None and result.trusted
    posterior.attrs.update(sampler="none: covariance of the fit", trusted=int(trusted))
    from xarray import DataTree

    rows = {} if result.likelihood.layout.large else _of_rows(result.likelihood)
    return as_arviz(DataTree.from_dict({"posterior": posterior, **rows}))


def assess(chains: Chains, names: tuple[str, ...], thin: int = 1) -> Convergence:
    """Apply the rules to chains stored every `thin` steps, burn-in taken off."""
    n, k = chains.shape[1], chains.shape[-1]
    steps = n * thin
    if n < LEAST_STORED:
        nothing, needed, history = np.full(k, np.nan), LEAST_STORED * thin - steps, (np.nan, np.nan, np.nan)
        reason = f"{steps} steps are too few to judge"
        return Convergence(names, steps, nothing, history, np.zeros(k), nothing, needed, (reason,))
    quarter, half, tau = (autocorrelation(chains[:, :m]) * thin for m in (n // 4, n // 2, n))
    rhat = r_hat(chains)
    history = (float(np.max(quarter)), float(np.max(half)), float(np.max(tau)))
    reasons, needed = [], 0
    if not np.all(np.isfinite(tau)):
        stuck = [name for name, value in zip(names, tau, strict=True) if not np.isfinite(value)]
        return Convergence(names, steps, tau, history, np.zeros(k), rhat, steps, (f"{stuck[0]} never moved",))
    if steps <= LENGTHS * history[2]:
        lengths = f"{steps / history[2]:.0f} τ of {history[2]:.0f}"
        reasons.append(f"{steps} steps are {lengths}, fewer than {LENGTHS:.0f}")
        needed = max(needed, math.ceil(1.1 * LENGTHS * history[2]) - steps)
    changes = [abs(b / a - 1.0) if a > 0 else np.inf for a, b in itertools.pairwise(history)]
    if not max(changes) < STABLE:
        reasons.append("τ still changes: " + " → ".join(f"{value:.0f}" for value in history))
        needed = max(needed, steps)
    if not np.max(rhat) < LARGEST_RHAT:
        worst = int(np.argmax(rhat))
        reasons.append(f"R-hat between ensembles is {rhat[worst]:.3f} for {names[worst]}")
        needed = max(needed, steps)
    ess = effective_samples(chains)
    return Convergence(names, steps, tau, history, ess, rhat, needed, tuple(reasons))


DescribedColumn = tuple[np.ndarray, str, str]  # values, unit, description

BURN_IN = 0.2  # fraction of the steps that is not used
LEVELS = {"68": (0.1587, 0.8413), "95": (0.0228, 0.9772)}
"""Quantiles of the intervals: ± 1 and ± 2 standard deviations of a normal distribution."""


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of `sample`.

    `sampler` is a name (`emcee`, `nuts`, `bootstrap`), `FILE.py:CLASS`, or a `Sampler`; `walkers` and `moves` are
    options of emcee, where `walkers` 0 stands for twice the number of sampled coefficients, at least 64. `interval` is
    the length of a block in steps: a killed run loses at most one block; only whole blocks are done, so that there are
    never more steps than `maximum_steps`. `parameters` are the names of the sampled coefficients (None: the physics
    coefficients); samplers of the exact posterior sample all, and figures show these. Every `thin`-th step is stored
    (0: as is usual for the sampler). `checks` is the number of draws compared with the exact posterior. Raises
    ValueError for values that make no sense.

    >>> walop.Options(walkers=128).sampler
    'emcee'
    """

    sampler: str | Sampler | type[Sampler] = "emcee"
    seed: int = 0
    walkers: int = 0
    interval: int = 500
    maximum_steps: int = 100_000
    thin: int = 0
    moves: str = "laplace"
    order: int = 3
    draws: int = 4000
    checks: int = 256
    ensembles: int = 2
    parameters: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        sampler = self.make_sampler()
        if self.ensembles < 2:
            raise ValueError("at least two independent ensembles are needed to judge convergence")
        if min(self.interval, self.draws, self.checks, self.maximum_steps) < 1 or self.thin < 0:
            raise ValueError("interval, draws, checks and maximum_steps must be 1 or more, thin not negative")
        if self.maximum_steps < self.interval and not sampler.repeats_the_fit:
            what = f"maximum_steps {self.maximum_steps} is less than one block"
            raise ValueError(f"{what}: lower interval ({self.interval}) as well")
        thin = self.thin or sampler.thin
        if self.interval % thin:
            raise ValueError(f"interval {self.interval} must be a multiple of thin {thin}")
        if self.parameters is not None and len(self.parameters) > LARGEST_SAMPLED:
            raise ValueError(f"{len(self.parameters)} parameters to sample: at most {LARGEST_SAMPLED}")

    def make_sampler(self) -> Sampler:
        """Return the sampler that is asked for, with the options that are its own."""
        default = {f.name: f.default for f in dataclasses.fields(self)}
        settings: dict[str, Any] = {name: getattr(self, name) for name in ("walkers", "moves")}
        return make_sampler(self.sampler, {k: value for k, value in settings.items() if value != default[k]})


class Progress(NamedTuple):
    """Contents of a progress bar: the stage, the fraction of it that is done (0 … 1), τ in steps, effective samples."""

    stage: str
    share: float
    tau: float = float("nan")
    ess: float = float("nan")


Report = Callable[[Progress], None]


@dataclasses.dataclass(frozen=True, repr=False)
class PosteriorSample(Drawn):
    """The posterior of all coefficients.

    `draws` holds (ensemble, draw, parameter) of all parameters in tree order, tied and fixed ones included; `mean` and
    `covariance` use every kept step. `chains` are the chains of the coefficients `sampled`, which figures show.
    `accuracy` compares the surrogate with the exact posterior; None where the exact posterior was sampled. `trusted`
    needs convergence, a surrogate that is exact enough, and a fit that is trusted (`of_trusted_fit`). `errors_from`
    says what the spread of the draws was made from: the stated errors of the data or, as for the fit, its residuals
    (`sandwich_adjusted`). `counts` are numbers that the sampler reports, `fit` is the `digest_of_fit` of the fit
    sampled around, `likelihood` the likelihood of its data, whose errors were taken times `noise_scale`.
    """

    _first_figure = "corner"

    sampler: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    draws: Float[np.ndarray, "e d n"]
    log_posterior: Float[np.ndarray, "e d"]
    mean: Vector
    covariance: Float[np.ndarray, "n n"]
    chains: Chains
    sampled: tuple[str, ...]
    thin: int
    convergence: Convergence
    accuracy: Accuracy | None
    acceptance: float
    counts: Mapping[str, int]
    seconds: float
    fingerprint: dict[str, str]
    of_trusted_fit: bool = True
    fit: str = ""
    errors_from: str = STATED
    likelihood: Likelihood | None = None
    noise_scale: float = 1.0

    @property
    def trusted(self) -> bool:
        """True for a posterior that was sampled well, around a fit that is trusted."""
        return self.of_trusted_fit and self.sampled_well

    @property
    def sampled_well(self) -> bool:
        """True where the draws are of the posterior, whatever the fit is worth."""
        return self.convergence.converged and (self.accuracy is None or self.accuracy.exact_enough)

    @property
    def verdict(self) -> Verdict:
        """The verdict: no go if the chains, or the fit that they are around, are not to be trusted."""
        again = "walop-jax sample RUN --resume goes on, or take fewer coefficients"
        of_fit = "walop-jax diagnose looks for what the fit lacks"
        bad = [] if self.trusted else self.warnings
        doubts = [
            Doubt(Quality(0), text, remedy=again if self.of_trusted_fit or number else of_fit)
            for number, text in enumerate(bad)
        ]
        remarks = (Doubt(Quality(0), text, blocking=False) for text in self.warnings if self.trusted)
        stars = "that of the fit, with this covariance: walop-jax check RUN" if self.trusted else ""
        return Verdict(doubts=(*doubts, *remarks), subject="Posterior", stars=stars)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences about everything that does not hold."""
        sentences = [] if self.convergence.converged else [self.convergence.message(self.seconds_per_step)]
        if not self.of_trusted_fit:
            what = "the fit is not trusted, and neither is its posterior: see the warnings of the fit"
            sentences.insert(0, what)
        a = self.accuracy
        if a is not None and not a.exact_enough:
            sentences.append(
                f"the surrogate differs from the exact posterior: {a.shift[0]} by {a.shift[1]:+.2f} ± "
                f"{a.shift[2]:.2f} σ, width of {a.width[0]} by a factor {a.width[1]:.2f} ± {a.width[2]:.2f}, "
                f"weights {a.efficiency:.2f} effective; sample fewer or better determined coefficients, or "
                "take the sampler nuts"
            )
        if lost := self.counts.get("divergences", 0):
            sentences.append(f"{lost} trajectories of the sampler diverged: tails may be missing")
        return tuple(sentences)

    @property
    def comparison(self) -> str:
        """A sentence that compares the sampled density with the exact posterior."""
        a = self.accuracy
        if a is None:
            return f"sampled with {self.sampler} from the exact posterior of all coefficients"
        agreement = f"means within {abs(a.shift[1]):.3f} σ, widths within {100 * abs(a.width[1] - 1):.1f} %"
        return f"against the exact posterior at {a.count} draws: {agreement}"

    @property
    def varying(self) -> list[int]:
        """Positions of the coefficients that vary; tied ones do, fixed ones do not."""
        return [i for i in range(len(self.names)) if np.ptp(self.draws[:, :, i]) > 0]

    @property
    def seconds_per_step(self) -> float:
        """Time per step of all ensembles."""
        return self.seconds / max(self.convergence.steps / (1.0 - BURN_IN), 1.0)

    def value(self, name: str) -> tuple[float, float]:
        """Mean and standard deviation of a coefficient."""
        i = self.names.index(name)
        return float(self.mean[i]), float(np.sqrt(self.covariance[i, i]))

    def intervals(self) -> dict[str, DescribedColumn]:
        """Median, 68 and 95 % intervals of every coefficient that varies, as columns with unit and description.

        τ, effective samples and R-hat are NaN for coefficients that are not sampled but drawn from their conditional
        distribution.
        """
        varies = self.varying
        values = self.draws.reshape(-1, len(self.names))[:, varies]
        names, units = [self.names[i] for i in varies], [self.units[i] for i in varies]
        deviation = np.sqrt(np.diag(self.covariance))[varies]
        columns: dict[str, DescribedColumn] = {
            "NAME": (np.array(names), "", "coefficient"),
            "UNIT": (np.array(units), "", "unit of the numbers in this row"),
            "MEDIAN": (np.median(values, axis=0), "", "posterior median"),
            "SIGMA": (deviation, "", "posterior standard deviation"),
        }
        for label, levels in LEVELS.items():
            for side, level in zip(("LOW", "HIGH"), levels, strict=True):
                about = f"{'lower' if side == 'LOW' else 'upper'} end of the {label} % interval"
                columns[f"{side}{label}"] = np.quantile(values, level, axis=0), "", about
        v = self.convergence
        abouts = "autocorrelation time in steps", "effective samples", "R-hat between ensembles"
        evidence = zip(("TAU", "ESS", "RHAT"), (v.tau, v.ess, v.rhat), abouts, strict=True)
        for key, numbers, about in evidence:
            by_name = dict(zip(v.names, numbers, strict=True))
            columns[key] = np.array([by_name.get(name, np.nan) for name in names]), "", about
        return columns

    def to_table(self) -> Any:
        """The columns of `intervals` as an astropy table."""
        notes = {"TRUSTED": self.trusted, "STEPS": self.convergence.steps}
        return astropy_table(self.intervals(), notes)

    def log_likelihood(self) -> Float[np.ndarray, "e d r"]:
        """ln p of every used row (point, exposure) at every draw, for `arviz.loo`.

        Equation    ln p = −½ (χ²/f² + m ln 2π f² + v) − Σ ln σ
        Symbols     χ² of the intensities of the row, its flux eliminated; σ their errors as stated, f the factor under
                    which the fit was made; m the number of intensities less the fluxes; v what errors with parameters
                    add (`likelihood/noise.py`), 0 without
        Limits      the flux is at its best value, not integrated over. Rows that share a flux are not independent

        Raises ValueError where the data are not at hand, and where rows share a flux, or the q, u of a star.
        """
        likelihood = self.likelihood
        if likelihood is None:
            raise ValueError("the data are not at hand: sample the fit, or the run, again")
        if likelihood.plan.exposures.shared is not None:
            what = "exposures share their flux (KIND steady)"
            raise ValueError(f"{what}: their rows cannot be left out one by one")
        if not likelihood.flux_groups.single:
            what = "exposures share q and u of the stars of a field (SCATTER of SOURCES)"
            raise ValueError(f"{what}: their rows cannot be left out one by one")
        used, per_row = likelihood.used, np.broadcast_to(likelihood.data_per_row, likelihood.used.shape)
        chi2 = np.empty((*self.draws.shape[:2], int(used.sum())))
        v, likelihood = np.zeros_like(chi2), likelihood.with_errors_at(None)
        for at in np.ndindex(chi2.shape[:2]):
            chi2[at] = np.sum(likelihood.residuals(self.draws[at])[1] ** 2, axis=2)[used]
            if likelihood.fits_errors:
                v[at] = likelihood.log_variance(self.draws[at])[used]
        f, m = self.noise_scale, per_row[used]
        ln_weight = np.log(likelihood.points.gathered("weight")[used]).sum(axis=1)
        return -0.5 * (chi2 / f**2 + m * np.log(2 * np.pi * f**2) + v) + ln_weight

    def to_arviz(self, log_likelihood: bool = False) -> Any:
        """For ArviZ, `InferenceData`, or `DataTree` from ArviZ 1 on: a variable per coefficient that varies, with unit.

        A chain is an ensemble. Beside `posterior` and `sample_stats` (`lp`) it has `observed_data`, N of every used row
        (point, exposure), and `constant_data`, its N_ERR, X and Y; with `log_likelihood`, that group as well, which
        takes some milliseconds for each draw.
        """
        return as_arviz(self.groups(log_likelihood))

    def groups(self, log_likelihood: bool = False) -> DataTree:
        """The groups of `to_arviz`, as `posterior.nc` holds them."""
        from xarray import DataTree

        varies = self.varying
        draws = {self.names[i]: self.draws[:, :, i] for i in varies}
        posterior = group_of_draws(draws, {self.names[i]: self.units[i] for i in varies})
        v = self.convergence
        for k, name in enumerate(v.names):
            if name not in posterior:  # it never moved
                continue
            evidence = {"autocorrelation_steps": v.tau[k], "effective_samples": v.ess[k], "r_hat": v.rhat[k]}
            posterior[name].attrs.update({key: float(value) for key, value in evidence.items()})
            posterior[name].attrs["sampled_by"] = self.sampler
        held = {n: float(self.draws[0, 0, i]) for i, n in enumerate(self.names) if i not in varies}
        posterior.attrs.update(
            sampler=self.sampler,
            interval="equal-tailed",
            converged=int(v.converged),
            trusted=int(self.trusted),
            verdict=v.message() if self.of_trusted_fit else "the fit is not trusted",
            steps=v.steps,
            acceptance=self.acceptance,
            fingerprint=json.dumps(self.fingerprint),
            fit=self.fit,
            fixed=json.dumps(held),
        )
        if self.accuracy is not None:
            numbers = {"efficiency": self.accuracy.efficiency, "spread": self.accuracy.spread}
            posterior.attrs.update({f"surrogate_{key}": value for key, value in numbers.items()})
        groups = {"posterior": posterior, "sample_stats": group_of_draws({"lp": self.log_posterior})}
        if self.likelihood is not None:
            groups |= _of_rows(self.likelihood)
        if log_likelihood:
            by_row = {"N": (("chain", "draw", "row"), self.log_likelihood())}
            rows = groups["observed_data"].coords.drop_vars("camera").to_dataset()
            groups["log_likelihood"] = rows.assign(by_row).assign_coords(posterior.coords)
        versions = versions_of(("walop-jax",))
        made_by = {"inference_library": "walop-jax", "inference_library_version": versions["walop-jax"]}
        for group in groups.values():
            group.attrs.update(made_by, sampling_time=self.seconds)
        return DataTree.from_dict(groups)

    def display(self) -> Display:
        """The verdict on the chains and the sampled coefficients."""
        table = self.to_table()
        rows = []
        for row in table[np.isin(np.asarray(table["NAME"]), self.sampled)]:
            half = 0.5 * float(row["HIGH68"] - row["LOW68"])
            low, high = (value_and_error(float(row[f"{end}95"]), half)[0] for end in ("LOW", "HIGH"))
            median = value_and_error(float(row["MEDIAN"]), half)
            ess = f"{float(row['ESS']):.0f}"
            rows.append((str(row["NAME"]), *median, str(row["UNIT"]), f"{low} … {high}", ess))
        shown = Display(
            title="",
            facts=(("sampler", self.sampler), ("chains", self.convergence.message())),
            head=("coefficient", ">median", ">error", "unit", ">95 %", ">effective samples"),
            rows=tuple(rows),
            notes=(self.comparison, *self.warnings),
        )
        return self.verdict.on_top_of(shown)

    def document(self) -> dict[str, Any]:
        """The content of `sample.json`, as plain data."""
        v, a, checked = self.convergence, self.accuracy, None
        if a is not None:
            checked = {"draws_checked": a.count, "spread": a.spread, "efficiency": a.efficiency}
            checked |= {"largest_shift_sigma": list(a.shift), "largest_width_factor": list(a.width)}

        def by_name(numbers: Vector) -> dict[str, float]:
            return dict(zip(v.names, numbers.tolist(), strict=True))

        return {
            "sampler": self.sampler,
            "errors_from": self.errors_from,
            "trusted": self.trusted,
            **self.verdict.answers(),
            "converged": v.converged,
            "message": v.message(self.seconds_per_step),
            "warnings": list(self.warnings),
            "steps": v.steps,
            "walkers": int(self.chains.shape[2]),
            "ensembles": int(self.chains.shape[0]),
            "acceptance": self.acceptance,
            "autocorrelation_steps": by_name(v.tau),
            "autocorrelation_history": list(v.history),
            "effective_samples": by_name(v.ess),
            "r_hat": by_name(v.rhat),
            "sampler_counts": dict(self.counts),
            "surrogate": checked,
            "seconds": self.seconds,
            "fingerprint": self.fingerprint,
        }
