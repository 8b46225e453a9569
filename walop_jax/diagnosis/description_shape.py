"""Uncertainty of the shape of descriptions: other patterns, laws and kinds of polarisation at the same place.

A description without a name is the simplest one that explains the data: a polynomial over the field, one law over the
exposures, one kind of polarisation. Its cause has no reason to be so simple. Deviations from it are a Gaussian
process,

Equation    δ(x, t) = Σ_j c_j f_j(x, t),   c_j ~ N(0, s²/(n ⟨f_j²⟩))
Symbols     f_j products of a pattern over the field (all polynomials to the third degree), a law over the exposures
            (none, those of the descriptions, other slow ones) for each kind of polarisation (`GENERATORS`; of cameras
            and other numbers the kind itself); s rms size of the descriptions of that place in the data, n patterns ×
            laws: every kind may be as large as what was described, in any shape
Source      model discrepancy as a Gaussian process: Kennedy & O'Hagan 2001, J. R. Stat. Soc. B 63, 425
Limits      To first order, about the fit. Patterns over the field beyond the third degree are in no f_j. In a product,
            stars have those without a dependence and with those described; others change the parameters alone.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from jaxtyping import Float

from walop_jax.diagnosis.dependences import FEWEST_POINTS, Dependences
from walop_jax.fit.refit import FitResult
from walop_jax.likelihood.columns import Columns
from walop_jax.model.effects import Described
from walop_jax.model.effects.change import SINGLE, SLOW, Change, InExposures
from walop_jax.model.effects.deviations import CUBIC
from walop_jax.model.effects.optics import GENERATORS, generators_of
from walop_jax.model.light import mean_wavelengths

Vector = Float[np.ndarray, " _"]
_OPTICS = {name.partition(" ")[0] for name in GENERATORS} | {"turn"}


class _Place(NamedTuple):
    """Changes of one kind of quantity at one place."""

    kinds: tuple[str, ...]
    where: str
    place: str
    origin: str


def shape_changes(fit: FitResult, columns: Columns) -> tuple[list[Change], Vector]:
    """Deviations from the shapes of the descriptions in a model, and their prior widths."""
    instrument = fit.model.instrument(fit.values)
    if not any(isinstance(effect, Described) for effect in instrument.effects):
        return [], np.zeros(0)
    described = instrument.effect(Described.name)
    assert isinstance(described, Described)
    data, squares = _AtData.of(columns), dict[_Place, float]()
    laws: dict[_Place, dict[tuple[str, ...], None]] = {}
    for change, amplitude in described.terms():
        optical = change.kind.partition(" ")[0] in _OPTICS
        place = _Place(GENERATORS if optical else (change.kind,), change.where, change.place, change.origin)
        parts = generators_of(change.kind) if optical else ((change.kind, 1.0, ()),)
        for _, coefficient, factors in parts:
            size = float(amplitude) * coefficient * data.rms(change.times(*factors))
            squares[place] = squares.get(place, 0.0) + size**2
        laws.setdefault(place, {(): None}).setdefault(change.beside_field)
    listed = set(described.sentences)
    changes, widths = list[Change](), list[float]()
    for place, square in squares.items():
        shapes = list(_shapes(place, tuple(laws[place]), fit, columns))
        count = len(shapes) / len(place.kinds)
        for change in shapes:
            rms = data.rms(change)
            if change.text not in listed and square * rms > 0.0:
                changes.append(change)
                widths.append(np.sqrt(square / max(count, 1.0)) / rms)
    return changes, np.array(widths)


def _shapes(
    place: _Place, laws: Sequence[tuple[str, ...]], fit: FitResult, columns: Columns
) -> Iterator[Change]:
    """All changes of a place with some laws, and other slow ones, that the model can include.

    Steady gains are those of the throughput; other steady numbers have the first four patterns.
    """
    exposures, template = fit.calset.exposures, fit.model.template
    over_field = len(fit.calset.points) >= FEWEST_POINTS
    dependences = Dependences(exposures, over_field, (), np.ones(len(exposures), bool))
    slow = [law for form in (*SLOW, *SINGLE) for law in dependences.of(form)] if len(laws) > 1 else []
    for law in dict.fromkeys((*laws, *slow)):
        patterns = CUBIC if law or place.kinds == GENERATORS else CUBIC[:4]
        for pattern, kind in itertools.product(patterns if over_field else CUBIC[:1], place.kinds):
            change = Change(kind, place.where, place.place, (*pattern, *law), place.origin)
            try:
                change.check_factors(template)
            except ValueError:
                continue
            if columns.has(((1.0, change),)) and (law or kind != "gain"):
                yield change


@dataclasses.dataclass(frozen=True)
class _AtData(InExposures):
    """The (point, exposure) of a set; `wavelength` (µm) is the mean of the band of each exposure."""

    wavelength: Any = 0.0
    used: Any = None

    @classmethod
    def of(cls, columns: Columns) -> Self:
        """Those of a likelihood."""
        points, plan = columns.likelihood.calset.points, columns.plan
        of_bands = np.asarray(mean_wavelengths(columns.patched, plan))
        wavelength = of_bands[np.asarray(plan.band_of)[:, 0]]
        return cls(
            columns.exposures, points.x[:, None], points.y[:, None], wavelength, columns.likelihood.used
        )

    def rms(self, change: Change) -> float:
        """Root mean square of the factors of a change."""
        sizes = np.nan_to_num(np.asarray(change.factor(self), float))
        return float(np.sqrt(np.mean(np.broadcast_to(sizes, self.used.shape)[self.used] ** 2)))
