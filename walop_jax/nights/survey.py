"""A survey: nights of one instrument, stacked under laws of time; the calibration at any moment, and until when.

The calibration of a moment is the instrument with the parameters that the laws give for it and their joint covariance.
It is valid from half a day before the first exposure until walks and drifts have grown the error of p (of stars with p
≤ 5 %, from the calibration alone) to half of the goal, 0.05 %, in 5 % of the field where one exposure measures q and u
(the local inverse has a condition number below 10); at the latest after as long again as the nights span, as nothing
vouches for more, and not before half a day after the last exposure. Validity is half-open, and parted, without gaps,
where something breaks. Between the last exposure before a break that was found and the first after it, it may have
happened at any time: the calibration takes a fraction of it there, and its variance.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from typing import Any

import numpy as np
from jaxtyping import Float

from walop_jax.calibration.accuracy import (
    GOAL,
    NODES,
    SIZE,
    TOLERANCE,
    field_measured,
    measures_u,
    p_errors,
    reached,
)
from walop_jax.calibration.calibration import Calibration
from walop_jax.fit.verdict import NO_STRUCTURE, Doubt, Quality, Verdict
from walop_jax.io.display import Display, Drawn
from walop_jax.io.errors import DataError, fail
from walop_jax.io.plain_tables import astropy_table
from walop_jax.io.shapes import AnyMatrix, AnyVector
from walop_jax.io.text import per_cent, value_and_error
from walop_jax.model.effects import effect_by_name
from walop_jax.model.effects.in_models import effect_context, known_effects, with_effects
from walop_jax.model.laws import Law
from walop_jax.nights.algebra import Solution
from walop_jax.nights.breaks import Break, among_globals
from walop_jax.nights.changes import scan
from walop_jax.nights.together import EffectAmplitude, Together
from walop_jax.sky.nights import night_of

OfMatrix = tuple[Float[np.ndarray, "p 6"], Float[np.ndarray, "p 6 k"], Float[np.ndarray, "p 6 6"], float]

HALF_A_DAY = 0.5
SUSPECT = 5.0  # excess of χ² of a night over its expectation, in its own standard deviations


@dataclasses.dataclass(frozen=True, repr=False)
class Survey(Drawn):
    """Nights under laws: `at(mjd)` is the calibration of a moment, `tracks` every parameter against time.

    `laws` are the laws of every parameter and candidate (None: absent), `breaks` the breaks that were found, which are
    laws now. `like` is a calibration of the same model, from which field, filters, site and fixed parameters are taken
    (None: there is no calibration of a moment). `doubts` are doubts beside χ²; `events` the notes of users (MJD,
    words).
    """

    _first_figure = "tracks"

    data: Together
    laws: tuple[Law | None, ...]
    solution: Solution
    like: Calibration | None = None
    doubts: tuple[Doubt, ...] = ()
    breaks: tuple[Break, ...] = ()
    events: tuple[tuple[float, str], ...] = ()

    # ----------------------------------------------------------------------------------------------- how good

    @functools.cached_property
    def excess(self) -> AnyVector:
        """(χ² − dof)/√(2 dof) of every night: the distance of its data from the laws."""
        dof = np.array([night.dof for night in self.data.nights], float)
        return (self.solution.unit_chi2 - dof) / np.sqrt(2.0 * np.maximum(dof, 1.0))

    @functools.cached_property
    def _counts(self) -> tuple[float, int]:
        """χ² of data and priors, and its degrees of freedom.

        Degrees of freedom are data less fluxes, plus priors, less the unknowns that these determine. Weak pulls only
        keep the search inside and are no knowledge: what they add to χ² is left out, and an unknown that nothing else
        determines is not counted, as in a fit (`likelihood.inverses.determined`).
        """
        solution, system = self.solution, self.solution.system
        unknowns = [(group.mean, group.precision) for group in (system, *system.cells)]
        mean, precision = map(np.concatenate, zip(*unknowns, strict=True))
        parameter = np.concatenate([system.at, *(cell.parameter for cell in system.cells)])
        away = np.concatenate([solution.shared, *solution.local]) - mean
        variance = [np.diag(solution.covariance), *(np.diag(block) for block, _ in solution.smoothed)]
        has_prior = np.array([p.prior is not None for p in self.data.parameters])
        local = np.arange(len(parameter)) >= len(system.at)
        stated = has_prior[parameter] | (local & np.isfinite(system.spread[parameter]))
        priors = np.where(stated, precision, 0.0)
        loose = precision - priors
        chi2 = solution.chi2 + priors @ away**2 + sum(solution.walked)
        # A step of a walk is expected to be about 0: a constraint as well.
        constraints = np.count_nonzero(priors) + len(solution.walked)
        data = sum(night.dof for night in self.data.nights)
        unknowns = len(parameter) - round(float(loose @ np.concatenate(variance)))
        return float(chi2), int(data + constraints - unknowns)

    @functools.cached_property
    def verdict(self) -> Verdict:
        """The verdict on all nights together."""
        nights, (chi2, dof) = self.data.nights, self._counts
        against = list(self.doubts)
        excess = (chi2 - dof) / math.sqrt(2.0 * max(dof, 1))
        if excess > SUSPECT:
            statement = f"χ²/dof = {chi2 / max(dof, 1):.4g} lies {excess:.3g} standard deviations above 1"
            against.append(Doubt(Quality.UNEXPLAINED, f"{statement}: the laws do not explain the nights"))
        if scattered := [str(nights[u].number) for u in np.flatnonzero(self.excess > SUSPECT)]:
            listed = ", ".join(scattered[:5]) + (" …" if len(scattered) > 5 else "")
            what = f"{len(scattered)} of {len(nights)} nights scatter more than their errors: MJD {listed}"
            against.append(Doubt(Quality.DOUBTED, what))
        structure = NO_STRUCTURE if self.like is None else self.like.verdict.structure
        n_data = sum(night.n_data for night in nights)
        stars = ""
        if self._matrix is not None:
            error = per_cent(self.error_of_p(self.last))
            stars = f"{error} % or better in {field_measured(self._matrix[3])}, on the last night"
        return Verdict(
            chi2, dof, n_data, 1.0, True, tuple(against), structure=structure,
            subject=f"Survey of {nights[0].instrument}", stars=stars,
        )  # fmt: skip

    @property
    def trusted(self) -> bool:
        """True if no doubt about it forbids its use."""
        return self.verdict.trusted

    # ---------------------------------------------------------------------------------------------- at a moment

    @property
    def _first(self) -> float:
        """The first exposure (MJD)."""
        return min(night.begin for night in self.data.nights)

    @property
    def last(self) -> float:
        """The last exposure (MJD)."""
        return max(night.end for night in self.data.nights)

    @property
    def span(self) -> tuple[float, float]:
        """Beginning and end of the validity (MJD), half-open."""
        return self._first - HALF_A_DAY, self.until

    @functools.cached_property
    def until(self) -> float:
        """The end of the validity (MJD): see the head of this file."""
        end = self.last
        latest = end + max(end - self._first, HALF_A_DAY)
        if self._matrix is None or self.error_of_p(latest) <= GOAL / 2:
            return latest
        low, high = end, latest
        while high - low > 0.01:
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self.error_of_p(middle) <= GOAL / 2 else (low, middle)
        return max(low, end + HALF_A_DAY)

    def error_of_p(self, mjd: float) -> float:
        """Error of p (a fraction) that 95 % of the field where one exposure measures u stays below at a moment."""
        assert self._matrix is not None
        matrix, slopes, structure, _ = self._matrix
        covariance = slopes @ self._product(mjd).covariance @ slopes.swapaxes(1, 2) + structure
        return reached(p_errors(matrix, covariance))

    @functools.cached_property
    def _matrix(self) -> OfMatrix | None:
        """Matrix, derivatives and covariance of structure where one exposure measures u, and the fraction of the field
        where it does not.

        None where p is not measured.
        """
        if self.like is None or len(self.like.model.template.cameras.pairs) != 2:
            return None
        try:
            product = self._product(self.last)
        except DataError:  # `at` says why there is none
            return None
        settings = product.usual_settings(filter_name=product.usual_filter)
        x, y = product.raster(SIZE)
        matrix, covariance, slopes = product.over_field(x, y, settings, NODES, TOLERANCE)
        structure = covariance - slopes @ product.covariance @ slopes.swapaxes(1, 2)
        good = measures_u(matrix.reshape(-1, 2, 3))
        return (matrix[good], slopes[good], structure[good], float(np.mean(~good))) if good.any() else None

    @property
    def changing(self) -> dict[str, Law]:
        """The laws of parameters that not all nights share."""
        by_name = zip(self.data.names, self.laws, strict=True)
        return {name: law for name, law in by_name if law is not None and law.per != ("shared",)}

    @property
    def edges(self) -> tuple[float, ...]:
        """Moments (MJD) at which a parameter changes at once."""
        dates = ((*law.at, *itertools.chain(*law.bad)) for law in self.changing.values())
        return tuple(sorted(set(itertools.chain(*dates))))

    @property
    def validity(self) -> tuple[tuple[float, float], ...]:
        """Stretches of time (MJD), half-open and without gaps, in which nothing changes at once."""
        start, stop = self.span
        edges = [start, *(edge for edge in self.edges if start < edge < stop), stop]
        return tuple(itertools.pairwise(edges))

    @property
    def reference(self) -> Calibration:
        """The calibration about which nights are linearised, with the laws in its model. `DataError` without one."""
        if self.like is None:
            what = "no calibration is known for the model of these nights"
            raise fail(what, advice="give one: --like RUN (like= in Python)")
        laws = {name: law.document() for name, law in self.changing.items()}
        like = dataclasses.replace(self.like, hidden=None, residuals=None, draws=None)
        return dataclasses.replace(like, model=dataclasses.replace(like.model, laws=laws))

    def night_at(self, mjd: float) -> int | None:
        """The number among the nights of the one that a moment (MJD, UTC) belongs to; None where it is none of them."""
        ends = np.array([(night.begin, night.end) for night in self.data.nights])
        longitude = np.nan if self.like is None else self.like.site.longitude
        *of_nights, evening = night_of(np.append(ends, mjd), longitude)
        same = np.flatnonzero(np.array(of_nights[::2]) == evening)
        return int(self.data.equations.night[same[0]]) if len(same) else None

    def values_at(self, mjd: float) -> tuple[AnyVector, AnyMatrix]:
        """All parameters and candidates (`data.names`) at a moment (MJD, UTC), and their covariance."""
        data, solution, scale = self.data, self.solution, self.data.equations.scale
        moved, scatter = np.zeros(len(solution.shared)), np.zeros(len(scale))
        for case in self.breaks:
            if case.kind == "step" and case.before < mjd < case.after:
                share = (mjd - case.before) / (case.after - case.before)
                moved += (share - (mjd >= case.date)) * among_globals(data, solution, case)
                scatter[data.names.index(case.name)] += (case.size**2 + case.error**2) * share * (1.0 - share)
        value, covariance = solution.predict(mjd, self.night_at(mjd), moved)
        return data.origin + value * scale, covariance * np.outer(scale, scale) + np.diag(scatter)

    def at(self, mjd: float, *, force: bool = False) -> Calibration:
        """The calibration of a moment (MJD, UTC).

        Raises `DataError` outside `span` unless `force` is given, and where there is no calibration to begin with.
        """
        (start, stop), against = self.span, self.verdict.doubts
        if not start <= mjd < stop:
            what = f"MJD {mjd:.3f} is outside the validity of the survey, {start:.3f} to {stop:.3f}"
            if not force:
                advice = "calibrate a night nearer to it, or give --force (force=True in Python)"
                raise fail(what, advice=advice)
            against = (*against, Doubt(Quality.VALIDITY_FORCED, what, blocking=False))
        verdict = dataclasses.replace(self.verdict, doubts=against)
        return dataclasses.replace(self._product(mjd), verdict=verdict)

    def _product(self, mjd: float) -> Calibration:
        """The calibration of a moment, whether it is valid or not."""
        full, (value, covariance) = self._full, self.values_at(mjd)
        model, parameters = full.model, self.data.parameters
        names = [p.in_model if isinstance(p, EffectAmplitude) else p.name for p in parameters]
        present = [k for k, name in enumerate(names) if name in model.names and self.laws[k] is not None]
        select = np.zeros((len(model.names), len(present)))
        select[[model.index(names[k]) for k in present], np.arange(len(present))] = 1.0
        select = select[model.masters]
        inside = select.any(axis=1)
        return dataclasses.replace(
            full,
            values=np.where(inside, select @ value[present], full.values),
            covariance=full.covariance + select @ covariance[np.ix_(present, present)] @ select.T,
            origin=f"{len(self.data.nights)} nights, stacked, at MJD {mjd:.5f}",
            inputs=(),
        )

    @functools.cached_property
    def _full(self) -> Calibration:
        """The calibration with the effects that laws have added to its model, at neutral.

        Its covariance is that of deviations alone, which nights do not show.
        """
        like = self.reference
        model = like.model
        context = effect_context(model.template, like.exposures)
        added = [
            p for p, law in zip(self.data.parameters, self.laws, strict=True)
            if law is not None and isinstance(p, EffectAmplitude) and p.name not in model.names
        ]  # fmt: skip
        shapes: dict[str, tuple[int, int]] = {}
        for p in added:
            if shapes.setdefault(p.part, p.shape) != p.shape or p.part in like.model.effect_names:
                what = f"{p.name} is one shape of its effect, and the model has another"
                raise fail(what, advice="put the effect into the model file and fit the nights again")
            if p.part not in model.effect_names:
                groups, (group, member) = (
                    effect_by_name(p.part, known_effects(model)).probes(context),
                    p.shape,
                )
                model = with_effects(model, [groups[group][member]], context)
        values, old = model.start, [model.index(name) for name in like.model.names]
        values[old] = like.values
        covariance = np.zeros((len(values),) * 2)
        covariance[np.ix_(old, old)] = like.of_deviations
        return dataclasses.replace(like, model=model, values=values, covariance=covariance)

    # --------------------------------------------------------------------------------------------------- tables

    @functools.cached_property
    def tracks(self) -> Any:
        """Every parameter in every night as an astropy table: value and error under its law, and deviation.

        DEVIATION is by how much the parameter would differ in that night, or in the nights that a file joins, if it
        alone were free to differ there, with everything else fitted anew; NaN where its law takes that up.
        """
        data, solution = self.data, self.solution
        shape, scale = (len(data.nights), len(data.names)), data.equations.scale
        cell_of = np.zeros(len(data.nights), int)
        for c, cell in enumerate(solution.system.cells):
            cell_of[cell.units] = c
        score, information = (of_kinds[1, cell_of] for of_kinds in scan(solution))
        information = np.where(information > 0, information, np.nan)
        deviation, alone = score / information, information**-0.5
        laws = ["absent" if law is None else " ".join(law.per) for law in self.laws]
        night, parameter = np.indices(shape).reshape(2, -1)  # of every row
        values, errors = data.origin + solution.values * scale, solution.errors() * scale
        return astropy_table({
            "NAME": (np.array(data.names)[parameter], "", "parameter, or candidate beyond the model"),
            "NIGHT": (np.array([n.number for n in data.nights])[night], "", "MJD of the evening"),
            "MJD": (data.equations.mjd[night], "d", "mean of the exposures, UTC"),
            "VALUE": (values.ravel(), "", "under the law"),
            "ERROR": (errors.ravel(), "", "standard error of VALUE"),
            "DEVIATION": ((deviation * scale).ravel(), "", "departure of the night alone"),
            "DEVIATION_ERR": ((alone * scale).ravel(), "", "its standard error"),
            "LAW": (np.array(laws)[parameter], "", "law of the parameter"),
            "UNIT": (np.array([p.unit for p in data.parameters])[parameter], "", "of the values"),
        })  # fmt: skip

    def to_table(self) -> Any:
        """The nights as an astropy table: time, χ², its expectation, and the distance."""
        names = ("number", "mjd", "dof", "source")
        night, mjd, dof, source = (np.array([getattr(n, name) for n in self.data.nights]) for name in names)
        return astropy_table({
            "NIGHT": (night, "", "MJD of the evening"),
            "MJD": (mjd, "d", "mean of the exposures, UTC"),
            "CHI2": (self.solution.unit_chi2, "", "of the data, under the laws"),
            "DOF": (dof, "", "data less fluxes"),
            "EXCESS": (self.excess, "", "(CHI2 - DOF)/sqrt(2 DOF)"),
            "SOURCE": (source, "", "files"),
        })  # fmt: skip

    def document(self) -> dict[str, Any]:
        """Everything but tracks as plain data."""
        verdict, (start, stop) = self.verdict, self.span
        value, covariance = self.values_at(self.last)
        error = np.sqrt(np.clip(np.diag(covariance), 0.0, None))
        return {
            **verdict.answers(), "trusted": verdict.trusted, "quality": int(verdict.quality), "chi2": verdict.chi2,
            "dof": verdict.dof,
            "n_data": verdict.n_data, "nights": len({night.number for night in self.data.nights}),
            "first": self._first, "last": self.last,
            "valid_from": start, "valid_until": stop, "validity": self.validity,
            "error_of_p": None if self._matrix is None else self.error_of_p(self.last),
            "without_u": None if self._matrix is None else self._matrix[3],
            "breaks": [dataclasses.asdict(case) | {"date": case.date} for case in self.breaks],
            "events": [{"mjd": mjd, "what": what} for mjd, what in self.events],
            "by_night": [
                {"night": n.number, "mjd": n.mjd, "chi2": float(chi2), "dof": n.dof, "excess": float(excess)}
                for n, chi2, excess in zip(self.data.nights, self.solution.unit_chi2, self.excess, strict=True)
            ],
            "advice": self.advice,
            "laws": {name: law.document() for name, law in self.changing.items()},
            "parameters": {
                p.name: {"value": float(value[k]), "sigma": float(error[k]), "unit": p.unit}
                for k, p in enumerate(self.data.parameters) if self.laws[k] is not None
            },
            "warnings": list(verdict.warnings),
        }  # fmt: skip

    @property
    def advice(self) -> tuple[str, ...]:
        """Advice, in sentences, the most urgent first."""
        first = "Look at the nights that scatter too much: walop-jax diagnose NIGHT."
        sentences = [] if self.trusted else [first]
        for case in self.breaks:
            if case.alike:
                needed = (
                    f"{'or ' if case.separated_by else ''}{case.nights_needed:.0f} more nights like these"
                )
                if math.isinf(case.nights_needed):
                    needed = "no more nights like these would separate them"
                names = ", ".join(case.alike[:3]) + (" …" if len(case.alike) > 3 else "")
                how = "; ".join((*case.separated_by, needed))
                what = f"{case.name} cannot be separated from {names}"
                sentences.append(f"MJD {case.night}: {what}. To separate them: {how}.")
        return (*sentences, f"Calibrate again before MJD {self.until:.1f}.")

    def display(self) -> Display:
        """Quality tonight, changes with dates, and advice."""
        verdict, (start, stop), nights = self.verdict, self.span, self.data.nights
        facts = {
            "χ²/dof": f"{verdict.chi2:.1f} / {verdict.dof} = {verdict.chi2 / max(verdict.dof, 1):.4g}",
            "nights": f"{len({night.number for night in nights})}, MJD {start + HALF_A_DAY:.2f} to {self.last:.2f}",
            "valid": f"from MJD {start:.2f} until {stop:.2f}",
        }
        if not self.breaks:
            facts["changes"] = "none found beyond the laws"
        rows = []
        for case in self.breaks:
            size, alike = " ± ".join(value_and_error(case.size, case.error)), ", ".join(case.alike[:3])
            rows.append((case.kind, case.name, size, case.unit, str(case.night), f"{case.z:+.1f}", alike))
        head = ("change", "of", ">size", "unit", ">first night", ">z", "or as well")
        notes = tuple(dict.fromkeys((*verdict.warnings, *self.advice)))
        return verdict.on_top_of(Display("", tuple(facts.items()), head, tuple(rows), notes))
