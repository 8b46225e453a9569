"""Systematic errors that could hide below the detection limits of a calibration, and what they do to stars.

Each one is looked at by itself. Example: the angles of all standards are off by 0.3°, or a plate ahead of the polariser
that no exposure through the polariser can show. It moves the parameters of the fit by δθ; if it is an effect that acts
on starlight itself, it changes the light of stars as well. Stars are seen through m + δm and calibrated with
m + ∂m/∂θ δθ, so that q and u are wrong by

    M⁻¹ (δm − ∂m/∂θ δθ) (1, q, u),   and by 2 p δR where an error δR turns the sky against the instrument

Every command that reports undetected errors calls `could_hide`.

Symbols     m instrument matrix, M its part that acts on q, u; δm its change by an effect at its size; p = 5 %
Limits      One error at a time; to first order in δθ.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from walop_jax.calibration.accuracy import LARGEST_P, Matrices, change_of_qu
from walop_jax.calibration.matrix import Filters, matrix_slopes, planned_matrices
from walop_jax.data.settings import Settings
from walop_jax.io.shapes import OfPoints
from walop_jax.io.text import per_cent, rounded
from walop_jax.model import light
from walop_jax.model.effects import Change, Effect, EffectKind, effect_by_name, in_order
from walop_jax.model.effects.base import Context
from walop_jax.model.effects.in_models import effect_context, known_effects
from walop_jax.model.effects.numbers import OF_POLARISER
from walop_jax.model.instrument import Instrument
from walop_jax.model.planning import plan_for_settings

if TYPE_CHECKING:
    from walop_jax.calibration.calibration import Calibration

PLACES = 8  # along each axis of the field, where the errors are asked


class CouldHide(NamedTuple):
    """A systematic error that could hide, and what it does to stars.

    At `size` (in `unit`), `error` is the error of q and u of stars with p ≤ 5 %: its median and its largest value over
    the field. `kind` is `EFFECT` or `DATA` (`fit.verdict`), `remedy` the measurement that would show it. It is not
    `measured` where the data hold no information on it; `ahead` is true for an unmeasured one that changes the light
    from the sky before it meets the polariser.
    """

    name: str
    kind: str
    size: float
    unit: str
    remedy: str
    measured: bool
    ahead: bool
    error: tuple[float, float]

    @property
    def in_words(self) -> str:
        """Name and size: the size at which it would just be detected, or its standard error where that is smaller."""
        size, unit = (self.size, self.unit) if self.unit else (100 * self.size, "%")
        what = "an error of" if self.measured else "not measured; usual size"
        return f"{self.name} ({what} {rounded(size, '.2g')} {unit})"


def unmeasured(undetected: Iterable[CouldHide]) -> dict[str, CouldHide]:
    """The errors on which the data hold no information, by name; those that one measurement shows are joined."""
    together: dict[str, list[CouldHide]] = {}
    for each in undetected:
        if not each.measured:
            together.setdefault(each.remedy, []).append(each)
    return {", ".join(each.name for each in group): group[0] for group in together.values()}


def off_by(median: float, largest: float, shown: str = "") -> str:
    """Errors of q and u over the field in words; `largest` may be unknown (NaN), `shown` replaces the median (%)."""
    worst = f", {per_cent(largest)} % at worst" if np.isfinite(largest) else ""
    return f"q or u off by {shown or per_cent(median)} % (median{worst})"


def could_hide(calibration: Calibration) -> tuple[CouldHide, ...]:
    """The systematic errors that could hide in the data of a calibration, the one with the largest median error first.

    They are computed in the usual setting, in which one exposure gives q and u. An empty tuple comes back where they
    were not computed; errors that do nothing to stars there are left out.
    """
    hidden = calibration.hidden
    if hidden is None or not len(hidden):
        return ()
    settings = calibration.usual_settings(filter_name=calibration.usual_filter)
    x, y = calibration.raster(PLACES)
    errors = hidden_errors(calibration, x, y, settings)
    errors = errors[:, np.isfinite(errors).all(axis=0)]
    if not errors.size:
        return ()
    acting, undetected = acting_effects(calibration), list[CouldHide]()
    at_values = calibration.model.instrument(calibration.values)
    for number, (m, of_field) in enumerate(zip(hidden.errors, errors, strict=True)):
        ahead = not m.measured and number in acting and is_ahead(at_values, acting[number])
        error = float(np.median(of_field)), float(of_field.max())
        if error[1] > 0.0:
            undetected.append(CouldHide(m.name, m.kind, m.size, m.unit, m.remedy, m.measured, ahead, error))
    return tuple(sorted(undetected, key=lambda each: (-each.error[0], -each.error[1])))


def hidden_errors(
    calibration: Calibration, x: OfPoints, y: OfPoints, settings: Settings
) -> Float[np.ndarray, "s p"]:
    """Error (s, p) of q and u at field positions (deg) by each error that could hide; NaN where u is not measured."""
    hidden, instrument = calibration.hidden, calibration.model.instrument(calibration.values)
    assert hidden is not None
    filters = calibration.curves(settings)
    matrix, slopes = matrix_slopes(instrument, settings, filters, x, y)
    acting, errors = acting_effects(calibration), np.empty((len(hidden), len(x)))
    for number, moved in enumerate(hidden.changes):
        change, turn = -slopes @ moved, 0.0
        if number in acting:
            effect = acting[number]
            turn = turn_of(instrument, effect)
            if acts_in(effect, instrument, settings):
                change = change + change_by_effect(instrument, effect, settings, filters, x, y, matrix)
        errors[number] = change_of_qu(matrix, matrix + change) + 2.0 * LARGEST_P * abs(turn)
    return errors


# ------------------------------------------------------------------------------------ what acts on starlight itself


def as_text(effect: Effect) -> str:
    """An effect at its values, for `Hidden.acts`."""
    values = {name: np.asarray(getattr(effect, name)).tolist() for name in effect.declarations()}
    return json.dumps({"effect": effect.name, **values, **effect.choices()})


def acting_effects(calibration: Calibration) -> Mapping[int, Effect]:
    """The effects of `Hidden.acts` by number, as far as the catalogue of the calibration has them."""
    hidden, model = calibration.hidden, calibration.model
    context = effect_context(model.template, calibration.exposures)
    names = {kind.name for kind in known_effects(model)}
    effects = {}
    for number, each in enumerate(() if hidden is None else hidden.errors):
        values: dict[str, Any] = json.loads(each.acts) if each.acts else {}
        if (name := values.pop("effect", "")) in names:
            effects[number] = effect_by_name(name, known_effects(model)).of(context, **values)
    return effects


def _changes(effect: Effect, instrument: Instrument) -> list[Change]:
    """The changes that the amplitudes of an effect make, of all amplitudes together."""
    bare = dataclasses.replace(instrument, effects=())
    return [change for terms in effect.first_order(bare) for _, change in terms]


def moves_with(effect: Effect, instrument: Instrument) -> frozenset[str]:
    """Column prefixes of the moving elements that an effect depends on: it vanishes where these are out."""
    bare = dataclasses.replace(instrument, effects=())
    elements = bare.patched().by_place().values()
    moving = {element.name: element.moves for element in elements if element.moves is not None}
    prefixes: set[str] = set()
    for change in _changes(effect, bare):
        moved = {moving[name] for name in change.place.split(".") if name in moving}
        if change.relation in ("ahead of", "behind") or not moved:
            return frozenset()
        prefixes |= moved
    return frozenset(prefixes)


def acts_in(effect: Effect, instrument: Instrument, settings: Settings) -> bool:
    """True if an effect does anything to the light of a star in a setting (one row), that is if it is in the beam
    there.
    """
    changes = _changes(effect, instrument)
    if changes and all(change.kind in (*OF_POLARISER, "rotator") for change in changes):
        return False  # of sources, of the angle of the sky
    needed = moves_with(effect, instrument)
    return not needed or any(np.isfinite(settings.position(prefix)).any() for prefix in needed)


def is_ahead(instrument: Instrument, effect: Effect) -> bool:
    """True if an effect acts on the light from the sky ahead of the polariser, or turns the sky."""
    after, before = (_telescope(model) for model in (with_effect(instrument, effect), instrument))
    return bool(np.any(after != before)) or turn_of(instrument, effect) != 0.0


def _telescope(instrument: Instrument) -> Float[np.ndarray, "4 4"]:
    """Mueller matrix ahead of the polariser, at the centre of the field."""
    return np.asarray(light.telescope(instrument, jnp.zeros(()), jnp.zeros(())))


def shown_by_the_sky_alone(
    instrument: Instrument, catalogue: Iterable[EffectKind], context: Context
) -> dict[str, float]:
    """Amplitudes of effects ahead of the polariser, by name, with their errors of q and u of stars at the usual size.

    No exposure through the polariser shows them, however many there are. The error is the same in all cameras and all
    over the field. An empty dictionary comes back where one exposure does not give q and u, as in `could_hide`.
    """
    if len(instrument.cameras.pairs) != 2:
        return {}
    bare, errors = dataclasses.replace(instrument, effects=()), dict[str, float]()
    before = _telescope(bare)
    for kind in catalogue:
        neutral = kind.neutral(context)
        if kind.is_structural() or neutral.lacks(bare):
            continue
        widths = list(neutral.prior_widths(context).items())
        if not is_ahead(bare, neutral.moved([width for _, width in widths])):
            continue
        for number, (name, width) in enumerate(widths):
            effect = neutral.moved(np.eye(len(widths))[number] * width)
            if is_ahead(bare, effect):
                after, turn = _telescope(with_effect(bare, effect)), turn_of(bare, effect)
                stokes = [matrix[None, 1:3, :3] / matrix[0, 0] for matrix in (before, after)]
                errors[f"{kind.name}.{name}"] = float(change_of_qu(*stokes)[0]) + 2.0 * LARGEST_P * abs(turn)
    return errors


def with_effect(instrument: Instrument, effect: Effect) -> Instrument:
    """The instrument with one effect more, where light meets it."""
    return dataclasses.replace(instrument, effects=in_order((*instrument.effects, effect)))


def turn_of(instrument: Instrument, effect: Effect) -> float:
    """Angle (rad) by which an effect turns the sky against the instrument, beyond ROTATOR."""
    changes = _changes(effect, instrument)
    if changes and all(change.kind != "rotator" for change in changes):
        return 0.0
    zeros = (model.patched().rotator_zero for model in (with_effect(instrument, effect), instrument))
    after, before = (0.0 if zero is None else float(zero) for zero in zeros)
    return float(np.deg2rad(after - before))


def change_by_effect(
    instrument: Instrument,
    effect: Effect,
    setting: Settings,
    filters: Filters,
    x: OfPoints,
    y: OfPoints,
    before: Matrices | None = None,
) -> Matrices:
    """The instrument matrix (point, arm, 3) with an effect at its size, less the matrix without it, in one setting.

    `before` is the matrix without it, where that is known.
    """

    def of(model: Instrument) -> Matrices:
        return planned_matrices(model, plan_for_settings(model, setting, filters), x, y)

    return of(with_effect(instrument, effect)) - (of(instrument) if before is None else before)
