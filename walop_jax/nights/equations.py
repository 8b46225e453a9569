"""Nights from data: normal equations in all free parameters and in candidates, at reference values.

    χ²(θ) = χ² + 2 gᵀ(θ − θ₀) + (θ − θ₀)ᵀ H (θ − θ₀),      g = Jᵀr,   H = JᵀJ

of the data alone: priors are laid on when nights are stacked, once. J holds the derivatives of the normalised residuals
r, fluxes eliminated, with respect to the free parameters and to the amplitudes of effects that the model lacks (at 0):
effects beyond the model can be tested afterwards without the data. So can the throughput that is fixed because the
fluxes take it up: its camera may be the one that changes from night to night, and fixing it hides that.

Nights follow from the exposures (`sky.nights`). A set of several nights is taken apart; each file and night is a unit
of its own.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from jaxtyping import Bool

from walop_jax.data.records import CalibrationSet, Exposures, Site
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.fit.base_model import SKY_AND_STARS, gauges
from walop_jax.fit.model_file import header_of
from walop_jax.fit.search import moved_within
from walop_jax.io.errors import DataError, fail
from walop_jax.io.shapes import AnyMatrix, AnyVector
from walop_jax.likelihood import engine
from walop_jax.likelihood.columns import Columns, SumOfChanges
from walop_jax.likelihood.inverses import pseudo_inverse
from walop_jax.likelihood.likelihood import Likelihood, used_rows
from walop_jax.model.effects import EFFECTS, EffectKind
from walop_jax.model.effects.catalogue import applies
from walop_jax.model.effects.in_models import effect_context, known_effects
from walop_jax.model.parameters import Parameter, leaves
from walop_jax.model.specification import Model
from walop_jax.nights.together import EffectAmplitude, Night, source_of
from walop_jax.sky.moon import local_sidereal_time
from walop_jax.sky.nights import night_of

OF_ONE_SET = ("moon_patch", "standard_outlier", "standard_values")
"""Effects that belong to single exposures, or are parameters of the base model already: no candidates."""
MOST_SHAPES = 4  # of an effect whose shapes are all candidates: cameras, plates, not places, thicknesses
OWN = 3.0  # squared distance of a night from its own minimum, for each parameter, that two nights' noise may make
SIDEREAL = 1.00273791  # sidereal hours in an hour
CLOCK = 0.2, 0.05  # hours by which hour angles disagree with MJD, and their scatter: signs of another clock


# ------------------------------------------------------------------------------------------------ nights of a set


def check_clock(exposures: Exposures, site: Site) -> None:
    """Raise `DataError` where the hour angles of the sky exposures say that MJD is not UTC: clocks in local time."""
    sky = np.isfinite(exposures.mjd + exposures.ha + exposures.ra) & (exposures.kind != "clp")
    if not np.isfinite(site.longitude) or sky.sum() < 2:
        return
    sidereal = local_sidereal_time(exposures.mjd[sky], site.longitude)
    off = (np.mod(sidereal - exposures.ra[sky] - 15.0 * exposures.ha[sky] + 180.0, 360.0) - 180.0) / 15.0
    shift = float(np.median(off)) / SIDEREAL
    if abs(shift) > CLOCK[0] and np.median(np.abs(off / SIDEREAL - shift)) < CLOCK[1]:
        what = f"is {shift:+.2f} h from UTC, as HA and RA of {int(sky.sum())} exposures say"
        raise DataError(f"[EXPOSURES] MJD: {what}: is the clock in local time? Correct MJD")


def of_exposures(calset: CalibrationSet, keep: Bool[np.ndarray, " e"]) -> CalibrationSet:
    """The set with some of its exposures. Raises `DataError` for intensities that are no table."""
    if keep.all():
        return calset
    intensities = calset.intensities
    if not isinstance(intensities, TableIntensities):
        raise DataError(
            "several nights are in one set that is no table; give each night as a file of its own"
        )
    rows, place = keep[intensities.exposure], np.cumsum(keep) - 1
    names = ("point", "source", "counts", "sigma", "flag", "used", *["sky"] * (intensities.sky is not None))
    columns = {name: getattr(intensities, name)[rows] for name in names}
    columns["exposure"] = place[intensities.exposure[rows]]
    table = TableIntensities(int(keep.sum()), intensities.points, **columns)
    return dataclasses.replace(calset, exposures=calset.exposures[keep], intensities=table)


def split(calset: CalibrationSet) -> Iterator[tuple[int, CalibrationSet]]:
    """The nights of a set, each with its number. Raises `DataError` for times that are missing or not UTC."""
    mjd = calset.exposures.mjd
    check_clock(calset.exposures, calset.site)
    if missing := int((~np.isfinite(mjd)).sum()):
        what = f"not given in {missing} of {len(mjd)} exposures, so that they belong to no night"
        raise DataError(f"[EXPOSURES] MJD: {what}; add the times (UTC)")
    numbers = night_of(mjd, calset.site.longitude)
    for number in np.unique(numbers):
        yield int(number), of_exposures(calset, numbers == number)


# ------------------------------------------------------------------------------------------------------ candidates


CandidateTable = dict[str, tuple[Parameter, SumOfChanges]]
"""Amplitudes beyond a model by name, each with the change that it is to first order; a gauge has none."""


def candidates_of(
    model: Model, exposures: Exposures, catalogue: Sequence[EffectKind] = EFFECTS
) -> CandidateTable:
    """Amplitudes of the effects that a model lacks, and its gauges, with the change that each is to first order."""
    context = effect_context(model.template, exposures)
    candidates: CandidateTable = {}
    for kind in catalogue:
        if kind.is_structural() or kind.name in (*OF_ONE_SET, *model.effect_names):
            continue
        groups = kind.probes(context)
        if len(groups) > MOST_SHAPES or not applies(kind.neutral(context), model.template):
            continue
        for g, group in enumerate(groups):
            for m, member in enumerate(group):
                first_order = member.first_order(model.template)
                of = [leaf for leaf in leaves(member) if leaf.name.split(".")[0] in kind.amplitudes()]
                if not first_order or not all(first_order) or len(first_order) != len(of):
                    continue
                for leaf, change in zip(of, first_order, strict=True):
                    amplitude = EffectAmplitude.of(leaf, kind.name, g if len(groups) > 1 else None, m)
                    candidates[amplitude.name] = amplitude, change
    held = (name for name in gauges(model, flux_known=False) if not model[name].free)
    return candidates | {name: (model[name], ()) for name in held}


def with_candidates(
    likelihood: Likelihood, values: AnyVector, candidates: CandidateTable
) -> tuple[float, AnyVector, AnyMatrix]:
    """χ², gradient and matrix of the data of a table in free parameters and candidates (0: cannot be computed)."""
    model = likelihood.model
    changes = [change for _, change in candidates.values()]
    held = [k for k, change in enumerate(changes) if not change]
    instrument = model.instrument(values)
    at = [model.index(list(candidates)[k]) for k in held]
    select = np.hstack([model.selection(), np.eye(len(model.names))[:, at]])
    residuals, slopes = [], []
    for batch in likelihood.points:
        found = engine.linearised_residuals(instrument, likelihood.plan, batch)
        residuals.append(used_rows(found.residual[..., None], batch)[:, 0])
        slopes.append(used_rows(found.slope, batch) @ select)
    r, jacobian = np.concatenate(residuals), np.concatenate(slopes)
    if changes:
        cut = len(model.free)
        columns = Columns(likelihood, values)
        computable = [k for k, change in enumerate(changes) if change and columns.has(change)]
        added = np.zeros((len(r), len(changes)))
        added[:, computable] = columns.of([changes[k] for k in computable])
        added[:, held] = jacobian[:, cut:]
        jacobian = np.hstack([jacobian[:, :cut], added])
    return float(r @ r), jacobian.T @ r, jacobian.T @ jacobian


# ---------------------------------------------------------------------------------------------------------- nights


def model_hash(model: Model) -> str:
    """A hash of what all nights must have in common: instrument, physics, effects, ties, fixed values."""
    header = header_of(model)
    fixed = (p for p in model.parameters if (p.tie or not p.free) and p.part not in SKY_AND_STARS)
    held = [f"{p.name} {p.tie or repr(p.start)}" for p in fixed]
    text = "\n".join([repr(header), model.template.description, *held])
    return hashlib.sha256(text.encode()).hexdigest()


def night_equations(
    calset: CalibrationSet,
    model: Model,
    values: AnyVector | Mapping[str, float],
    changes: CandidateTable | None = None,
    *,
    number: int | None = None,
    own: bool = False,
    sets: int = 1,
) -> list[Night]:
    """The nights of a set, linearised at values of the parameters: a full vector, or by name (others: start values).

    `changes` are the candidates (None: `candidates_of` each night), `number` the only night that is wanted. With `own`,
    nights whose minimum is farther from the values than noise explains are linearised closer to it. `sets` is how many
    such sets come. For sets too large for a table of derivatives no candidates are kept. Raises `DataError` as `split`
    does, and where the model has no finite counts.
    """
    if isinstance(values, Mapping):
        values = np.array([values.get(p.name, p.start) for p in model.parameters])
    source = source_of(calset)
    nights = []
    for evening, subset in split(calset):
        if number not in (None, evening):
            continue
        likelihood, point = Likelihood.of(subset, model, sets=sets), values
        if own:
            point = moved_within(likelihood, values, np.sqrt(OWN * len(model.free)))
        if likelihood.layout.large:
            terms, _ = likelihood.data_terms(point)
            select = model.selection()
            chi2, gradient, matrix = terms.data, select.T @ terms.gradient, select.T @ terms.matrix @ select
            beyond, used_data = {}, terms.used_data
        else:
            beyond = (
                candidates_of(model, subset.exposures, known_effects(model)) if changes is None else changes
            )
            chi2, gradient, matrix = with_candidates(likelihood, point, beyond)
            used_data = likelihood.used_data
        if not (np.isfinite(chi2) and np.isfinite(gradient).all() and np.isfinite(matrix).all()):
            what = "the model has no finite counts or derivatives where the nights meet"
            advice = (
                "some night is far from it: fit each by itself (walop-jax refit), leave out those not trusted"
            )
            raise fail(f"{source}, night of MJD {evening}: {what}", advice=advice)
        e = subset.exposures
        at_zero = [0.0 if change else point[model.index(name)] for name, (_, change) in beyond.items()]
        nights.append(
            Night(
                instrument=model.name,
                model=model_hash(model),
                number=evening,
                begin=float(e.mjd.min()),
                end=float(e.mjd.max()),
                mjd=float(e.mjd.mean()),
                filters=tuple(np.unique(e.filter).tolist()),
                source=source,
                sha256=data_hash(calset),
                n_data=used_data.n_data,
                dof=round(float(used_data.rows @ likelihood.data_per_row)),
                chi2=chi2,
                parameters=(*(model.parameters[i] for i in model.free), *(p for p, _ in beyond.values())),
                candidates=len(beyond),
                reference=np.append(point[model.free], at_zero),
                gradient=gradient,
                matrix=matrix,
            )
        )
    return nights


def with_candidates_of(night: Night, before: Night) -> Night:
    """A night that was linearised anew without candidates, or with some of them, with those it had `before`.

    Another candidate is C = A J + R with R beyond the parameters and candidates of J, Jᵀ R = 0. A, RᵀR and, to first
    order, Rᵀr are the same at both places, so that only A J is to follow J: columns of candidates cost six times as
    much as all others.
    """
    names = before.names
    at = np.array([names.index(name) for name in night.names if name in names], int)
    rest = np.setdiff1d(np.arange(len(names)), at)
    if len(rest) == 0 or len(at) < len(night.names):
        return night
    cross = before.matrix[np.ix_(rest, at)]
    along = cross @ pseudo_inverse(before.matrix[np.ix_(at, at)], 1e-13)
    beyond = before.matrix[np.ix_(rest, rest)] - along @ cross.T
    pull = before.gradient[rest] - along @ before.gradient[at]
    slope, place = along @ night.matrix, np.argsort(np.append(at, rest))
    matrix = np.block([[night.matrix, slope.T], [slope, slope @ along.T + beyond]])
    return dataclasses.replace(
        night,
        parameters=before.parameters,
        candidates=before.candidates,
        reference=np.append(night.reference, before.reference[rest])[place],
        gradient=np.append(night.gradient, along @ night.gradient + pull)[place],
        matrix=matrix[np.ix_(place, place)],
    )


def data_hash(calset: CalibrationSet) -> str:
    """SHA-256 of the files of a set, of its content if it comes from none."""
    if not calset.inputs:
        content = [_bytes(record) for record in (calset.site, calset.exposures, calset.sources)]
        content += [name.encode() + _bytes(curve) for name, curve in sorted(calset.filters.items())]
        content.append(_bytes(calset.intensities.block(0, len(calset.points))))
        return hashlib.sha256(b"".join(content)).hexdigest()
    together = "".join(entry.sha256 for entry in calset.inputs)
    return together if len(calset.inputs) == 1 else hashlib.sha256(together.encode()).hexdigest()


def _bytes(record: object) -> bytes:
    """The content of a dataclass of arrays, texts and numbers."""
    arrays = (np.asarray(getattr(record, field.name)) for field in dataclasses.fields(record))  # type: ignore[arg-type]
    parts = (a.tobytes() if a.dtype.kind not in "OUS" else repr(a.tolist()).encode() for a in arrays)
    return b"".join(parts)
