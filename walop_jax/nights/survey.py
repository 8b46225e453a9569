"""Nights of one instrument, stacked under laws of time: the calibration at any moment between them.

The calibration of a moment is the instrument with the parameters that the laws give for it, and their joint covariance.
It is given from half a day before the first exposure to half a day after the last; beyond that nothing vouches for it.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from walop_jax.calibration.calibration import Calibration
from walop_jax.data.records import CalibrationSet
from walop_jax.fit.model_file import model_like
from walop_jax.fit.refit import FitResult
from walop_jax.fit.verdict import NO_STRUCTURE, STATED, Doubt, Quality, Verdict
from walop_jax.io.display import Display, Displayed
from walop_jax.io.errors import DataError, fail
from walop_jax.io.plain_tables import astropy_table
from walop_jax.io.rounding import value_and_error
from walop_jax.model.effects import Effect
from walop_jax.model.specification import effect_context, with_effects
from walop_jax.nights.algebra import Solution, System, UndeterminedError, solve
from walop_jax.nights.changes import scan
from walop_jax.nights.equations import Night, Together, night_equations, night_numbers, together
from walop_jax.nights.laws import Law, laws_of, resolved
from walop_jax.nights.night_file import nights_in

Vector = Float[np.ndarray, " _"]
Matrix = Float[np.ndarray, "n n"]
Given = FitResult | CalibrationSet | Night | str | os.PathLike[str]
"""What nights are made of: a fit, a set, a night, or the path of nights that were written."""
Again = Callable[[Mapping[str, float]], Night]
"""Linearises a night at other values."""

HALF_A_DAY = 0.5
SUSPECT = 5.0  # excess of χ² of a night over its expectation, in its own standard deviations
LONG = 60.0  # days without a night that are worth a remark
SETTLED = 1e-3  # standard errors that parameters may still move when nights are linearised again
ROUNDS = 6


@dataclasses.dataclass(frozen=True, repr=False)
class Survey(Displayed):
    """Nights under laws: `at(mjd)` is the calibration of a moment, `tracks` every parameter against time.

    `laws` are those of every parameter and candidate (None: absent); `like` is a calibration of the same model, from
    which field, filters, site and parameters that are held are taken (None: there is no calibration of a moment);
    `doubts` are what speaks against it beside χ².
    """

    data: Together
    laws: tuple[Law | None, ...]
    solution: Solution
    like: Calibration | None = None
    doubts: tuple[Doubt, ...] = ()

    # ----------------------------------------------------------------------------------------------- how good

    @functools.cached_property
    def excess(self) -> Vector:
        """(χ² − dof)/√(2 dof) of every night: how far its data are from what the laws say."""
        dof = np.array([night.dof for night in self.data.nights], float)
        return (self.solution.unit_chi2 - dof) / np.sqrt(2.0 * np.maximum(dof, 1.0))

    @functools.cached_property
    def _counts(self) -> tuple[float, int]:
        """χ² of data and of what is known beforehand, and its degrees of freedom.

        These are data less fluxes, plus what is known, less unknowns. Loose widths only keep the search inside: they
        are no knowledge, and what they add to χ² is left out as in a fit.
        """
        system, chi2 = self.solution.system, self.solution.chi2 + self.solution.penalty
        prior = np.array([p.prior is not None for p in self.data.parameters])
        known, walks = 0, set()
        for entry, value in zip(system.globals, self.solution.shared, strict=True):
            if prior[entry.parameter]:
                known += entry.precision > 0
            else:
                chi2 -= entry.precision * (value - entry.mean) ** 2
        for cell, local in zip(system.cells, self.solution.local, strict=True):
            states = cell.parameter[np.isfinite(cell.mjd)].tolist()
            stated = prior[cell.parameter] | np.isfinite(system.spread[cell.parameter])
            # A step of a walk is known beforehand to be about 0: one for every state but the first.
            known += int(((cell.precision > 0) & stated).sum()) + len(states) - len(set(states) - walks)
            chi2 -= float(np.where(stated, 0.0, cell.precision) @ (local - cell.mean) ** 2)
            walks |= set(states)
        unknown = len(system.globals) + sum(len(cell.parameter) for cell in system.cells)
        return float(chi2), int(sum(night.dof for night in self.data.nights) + known - unknown)

    @functools.cached_property
    def verdict(self) -> Verdict:
        """The verdict on all nights together."""
        nights, (chi2, dof) = self.data.nights, self._counts
        against = list(self.doubts)
        excess = (chi2 - dof) / math.sqrt(2.0 * max(dof, 1))
        if excess > SUSPECT:
            said = f"χ²/dof = {chi2 / max(dof, 1):.4g} lies {excess:.3g} standard deviations above 1"
            against.append(Doubt(Quality.UNEXPLAINED, f"{said}: the laws do not explain the nights"))
        if some := [str(nights[u].number) for u in np.flatnonzero(self.excess > SUSPECT)]:
            listed = ", ".join(some[:5]) + (" …" if len(some) > 5 else "")
            what = f"{len(some)} of {len(nights)} nights scatter more than their errors say: MJD {listed}"
            against.append(Doubt(Quality.DOUBTED, what))
        structure = NO_STRUCTURE if self.like is None else self.like.verdict.structure
        n_data = sum(night.n_data for night in nights)
        return Verdict(chi2, dof, n_data, 1.0, True, tuple(against), structure=structure)

    @property
    def trusted(self) -> bool:
        """True if nothing that speaks against it forbids its use."""
        return self.verdict.trusted

    # ---------------------------------------------------------------------------------------------- at a moment

    @property
    def span(self) -> tuple[float, float]:
        """From and up to, not including, which moment (MJD, UTC) it gives a calibration."""
        nights = self.data.nights
        return min(n.begin for n in nights) - HALF_A_DAY, max(n.end for n in nights) + HALF_A_DAY

    def values_at(self, mjd: float) -> tuple[Vector, Matrix]:
        """All parameters and candidates (`data.names`) at a moment (MJD, UTC), and their covariance."""
        nights, scale = self.data.nights, self.data.equations.scale
        if self.like is not None and np.isfinite(self.like.site.longitude):
            number = int(night_numbers(np.array([mjd], float), self.like.site)[0])
        else:
            number = next((n.number for n in nights if n.begin <= mjd <= n.end), -1)
        known = sorted({n.number for n in nights})
        value, covariance = self.solution.predict(mjd, known.index(number) if number in known else None)
        return self.data.origin + value * scale, covariance * np.outer(scale, scale)

    def at(self, mjd: float, *, force: bool = False) -> Calibration:
        """The calibration of a moment (MJD, UTC).

        Raises `DataError` outside `span` unless `force` is given, and where there is no calibration to begin with.
        """
        (start, stop), against = self.span, self.verdict.against
        if not start <= mjd < stop:
            what = f"MJD {mjd:.3f} is outside the nights of the survey, {start:.3f} to {stop:.3f}"
            if not force:
                raise fail(what, advice="calibrate a night nearer to it, or give force=True")
            against = (*against, Doubt(Quality.VALIDITY_FORCED, what, blocking=False))
        full, (value, covariance), names = self._full, self.values_at(mjd), self.data.names
        model = full.model
        there = [k for k, name in enumerate(names) if name in model.names and self.laws[k] is not None]
        select = np.zeros((len(model.names), len(there)))
        select[[model.index(names[k]) for k in there], np.arange(len(there))] = 1.0
        for i, p in enumerate(model.parameters):
            if p.tie is not None:
                select[i] = select[model.index(p.tie)]
        inside = select.any(axis=1)
        return dataclasses.replace(
            full,
            values=np.where(inside, select @ value[there], full.values),
            covariance=select @ covariance[np.ix_(there, there)] @ select.T,
            verdict=dataclasses.replace(self.verdict, against=against),
            origin=f"{len(self.data.nights)} nights, stacked, at MJD {mjd:.5f}",
            inputs=(),
        )

    @functools.cached_property
    def _full(self) -> Calibration:
        """`like` with the effects that laws have added to its model, at neutral."""
        like = self.like
        if like is None:
            raise fail("no calibration is known for the model of these nights", advice="give one: like=")
        like = dataclasses.replace(like, hidden=None, residuals=None, draws=None)
        model = like.model
        context = effect_context(model.template, like.exposures)
        candidates = [
            p for p, law, has in zip(self.data.parameters, self.laws, self.data.has_value, strict=True)
            if law is not None and not has
        ]  # fmt: skip
        for p in candidates:
            # Names of parts, not `Parameter.part`, which files of nights do not hold.
            part = p.name.split(".")[0]
            kind: type[Effect] | None = next((one for one in model.catalogue if one.name == part), None)
            if kind is not None and part not in model.effect_names:
                model = with_effects(model, [kind.neutral(context)], context)
            if p.name not in model.names:
                raise fail(
                    f"{p.name} is one shape of its effect, which no model has by itself",
                    advice="put the effect into the model file and fit the nights again",
                )
        values, old = model.start, [model.index(name) for name in like.model.names]
        values[old] = like.values
        return dataclasses.replace(like, fitted=model, values=values, covariance=np.zeros((len(values),) * 2))

    # --------------------------------------------------------------------------------------------------- tables

    @functools.cached_property
    def tracks(self) -> Any:
        """Every parameter in every night as an astropy table: value and error under its law, and what a night adds.

        DEVIATION is by how much the parameter would differ in that night, or in nights that a file joins, if it alone
        were free to differ there, with everything else fitted anew; NaN where its law takes that up.
        """
        data, solution = self.data, self.solution
        shape, scale, found = (len(data.nights), len(data.names)), data.equations.scale, scan(self.solution)
        alone = np.full(shape, np.nan)
        deviation = alone.copy()
        for c, cell in enumerate(solution.system.cells):
            seen = found.once_information[c] > 0
            known = found.once_information[c, seen]
            deviation[np.ix_(cell.units, seen)] = found.once_score[c, seen] / known
            alone[np.ix_(cell.units, seen)] = known**-0.5
        laws = ["absent" if law is None else " ".join(law.per) for law in self.laws]

        def by_night(of: Sequence[Any]) -> np.ndarray:
            return np.repeat(np.array(of), shape[1])

        def by_parameter(of: Sequence[Any]) -> np.ndarray:
            return np.tile(np.array(of), shape[0])

        values, errors = data.origin + solution.values * scale, solution.errors() * scale
        return astropy_table({
            "NAME": (by_parameter(data.names), "", "parameter, or candidate beyond the model"),
            "NIGHT": (by_night([n.number for n in data.nights]), "", "MJD of the evening"),
            "MJD": (by_night([n.mjd for n in data.nights]), "d", "mean of the exposures, UTC"),
            "VALUE": (values.ravel(), "", "under the law"),
            "ERROR": (errors.ravel(), "", "standard error of VALUE"),
            "DEVIATION": ((deviation * scale).ravel(), "", "what the night alone would add"),
            "DEVIATION_ERR": ((alone * scale).ravel(), "", "its standard error"),
            "LAW": (by_parameter(laws), "", "law of the parameter"),
            "UNIT": (by_parameter([p.unit for p in data.parameters]), "", "of the values"),
        })  # fmt: skip

    def to_table(self) -> Any:
        """The nights as an astropy table: time, χ², what it should be, and how far off that is."""
        nights = self.data.nights
        return astropy_table({
            "NIGHT": (np.array([n.number for n in nights]), "", "MJD of the evening"),
            "MJD": (np.array([n.mjd for n in nights]), "d", "mean of the exposures, UTC"),
            "CHI2": (self.solution.unit_chi2, "", "of the data, under the laws"),
            "DOF": (np.array([n.dof for n in nights]), "", "data less fluxes"),
            "EXCESS": (self.excess, "", "(CHI2 - DOF)/sqrt(2 DOF)"),
            "SOURCE": (np.array([n.source for n in nights]), "", "files"),
        })  # fmt: skip

    def display(self) -> Display:
        """The verdict, and the parameters in the last night."""
        verdict, (start, stop), data = self.verdict, self.span, self.data
        facts = {
            "χ²/dof": f"{verdict.chi2:.1f} / {verdict.dof} = {verdict.chi2 / max(verdict.dof, 1):.4g}",
            "nights": str(len({night.number for night in data.nights})),
            "from": f"MJD {start:.2f}",
            "until": f"MJD {stop:.2f}",
        }
        scale = data.equations.scale
        last = zip(
            data.origin + self.solution.values[-1] * scale, self.solution.errors()[-1] * scale, strict=True
        )
        rows = tuple(
            (p.name, " ± ".join(value_and_error(value, error)), p.unit, " ".join(law.per))
            for p, law, (value, error) in zip(data.parameters, self.laws, last, strict=True) if law is not None
        )  # fmt: skip
        title = f"Survey of {data.nights[0].instrument}: {verdict.words}"
        return Display(
            title, tuple(facts.items()), ("parameter", "last night", "unit", "law"), rows, verdict.warnings
        )


# ------------------------------------------------------------------------------------------------------- stacking


def stack(
    nights: Sequence[Given],
    laws: Mapping[str, Law | Mapping[str, Any]] | None = None,
    *,
    like: Calibration | FitResult | None = None,
) -> Survey:
    """Fit all nights together under laws of time, from their normal equations.

    Nights are fits, calibration sets (linearised at the values of `like`, no fit is needed), or what was kept of them
    (`nights.night_file`, in memory or by path). `laws` are as the [law] tables of `nights.laws`; a parameter without
    one is shared by all nights. `like` is a calibration of their model, by default that of the first fit. Fits and sets
    are linearised again at the common solution until it stays where it is; kept nights cannot be.

    Raises `DataError` for nights that do not belong together, that do not determine a parameter under its law, and for
    nights without a filter in common; ValueError for laws that are wrong, or of what does not exist.
    """
    like = next((one for one in nights if isinstance(one, FitResult)), None) if like is None else like
    shared = Calibration.from_fit(like) if isinstance(like, FitResult) else like and like.rebuilt()
    made: list[Night] = []
    again: dict[tuple[str, int], Again] = {}
    doubts: list[Doubt] = []
    for one in nights:
        found, anew = _nights_of(one, shared)
        made += found
        again |= anew
        if isinstance(one, FitResult) and one.errors_from != STATED:
            raise fail(
                f"the errors of {one.calset.origin} do not explain its scatter, and nights are weighed by them",
                advice="correct N_ERR, or leave the night out",
            )
        if isinstance(one, FitResult) and not one.trusted:
            what = f"the fit of {one.calset.origin} is not trusted"
            doubts.append(Doubt(one.checked_verdict().quality, what))
    data = together(made)
    doubts += _about_time(data.nights)
    cut = len(data.names) - data.candidates
    tables = {name: law if isinstance(law, Mapping) else law.document() for name, law in (laws or {}).items()}
    chosen = resolved(laws_of(tables), data.names[:cut], data.names[cut:])
    _check_filters(data, chosen)
    try:
        data, solution, settled = _settled(data, chosen, again)
    except UndeterminedError as error:
        raise _undetermined(data, error) from None
    if not settled:
        what = f"the solution has not settled after {ROUNDS} linearisations: the nights are too different"
        doubts.append(Doubt(Quality.NOT_CONVERGED, what))
    if kept := sum((night.sha256, night.number) not in again for night in data.nights):
        what = f"{kept} of {len(data.nights)} nights stay as they were linearised: their data are not at hand"
        doubts.append(Doubt(Quality(0), what, blocking=False))
    return Survey(data, chosen, solution, shared, tuple(doubts))


def _nights_of(one: Given, like: Calibration | None) -> tuple[list[Night], dict[tuple[str, int], Again]]:
    """The nights of what was given, and for each, by data and night, how it is linearised again."""
    if isinstance(one, Night):
        return [one], {}
    if isinstance(one, FitResult):
        calset, model = one.calset, one.model
        found = night_equations(calset, model, one.values)
    elif isinstance(one, CalibrationSet):
        if like is None:
            raise fail(f"{one.origin} is a set, and nothing says at which values", advice="give like=, a fit")
        values = dict(zip(like.model.names, like.values.tolist(), strict=True))
        calset, model = one, model_like(one, like.model)
        found = night_equations(calset, model, values)
    else:
        return nights_in(one), {}

    def anew(number: int) -> Again:
        def run(at: Mapping[str, float]) -> Night:
            return next(night for night in night_equations(calset, model, at) if night.number == number)

        return run

    return found, {(night.sha256, night.number): anew(night.number) for night in found}


def _settled(
    data: Together, laws: Sequence[Law | None], again: Mapping[tuple[str, int], Again]
) -> tuple[Together, Solution, bool]:
    """Linearise nights at the common solution until it stays where it is; whether it does."""
    before: Float[np.ndarray, "u n"] | None = None
    for _ in range(ROUNDS):
        solution = solve(System.of(data.equations, laws, data.mean, data.width, data.has_value))
        scale = data.equations.scale
        values = data.origin + solution.values * scale
        sigma = np.maximum(solution.errors() * scale, 1e-12 * scale)
        if not again or (before is not None and np.max(np.abs(values - before) / sigma) < SETTLED):
            return data, solution, True
        # Candidates have no place in the model: their part stays first-order, at 0.
        data = together([
            again[key](dict(zip(data.names, values[u].tolist(), strict=True)))
            if (key := (night.sha256, night.number)) in again else night
            for u, night in enumerate(data.nights)
        ])  # fmt: skip
        before = values
    return data, solve(System.of(data.equations, laws, data.mean, data.width, data.has_value)), False


def _undetermined(data: Together, error: UndeterminedError) -> DataError:
    name = data.names[error.parameter]
    if error.unit is None:
        return fail(
            f"the nights do not determine {name} under its law", advice="give it a prior, or another law"
        )
    number = data.nights[error.unit].number
    return fail(
        f"the night of MJD {number} says nothing of {name}, which has a value of its own there",
        advice="give its law a spread, or let it be shared",
    )


def _about_time(nights: Sequence[Night]) -> list[Doubt]:
    found, reached = [], math.inf
    for begin, end in sorted((night.begin, night.end) for night in nights):
        if begin - reached > LONG:
            what = f"no night from MJD {reached:.1f} to {begin:.1f}: what holds there rests on the laws alone"
            found.append(Doubt(Quality(0), what, blocking=False))
        reached = end if math.isinf(reached) else max(reached, end)
    return found


def _check_filters(data: Together, laws: Sequence[Law | None]) -> None:
    first = data.nights[0]
    free = {
        law.base
        for law, p in zip(laws, data.parameters, strict=True)
        if law and p.name.startswith("throughput.")
    }
    for night in data.nights[1:]:
        if not set(night.filters) & set(first.filters) and not free & {"night", "file"}:
            raise fail(
                f"nights in other filters with the same throughputs: {', '.join(first.filters)} (MJD {first.number}) "
                f"and {', '.join(night.filters)} (MJD {night.number})",
                advice='stack them apart, or give [law."throughput.*"] per = "night"',
            )
