"""Mistakes that could hide: single ones below the detection limits of a calibration, and their errors of stars.

A mistake moves the parameters of the fit by δθ; of what acts on starlight itself the light of stars changes as well.
Stars are seen through m + δm and calibrated with m + ∂m/∂θ δθ, so that q and u are wrong by

    M⁻¹ (δm − ∂m/∂θ δθ) (1, q, u),   and by 2 p δR where a mistake δR turns the sky against the instrument

Every command that reports undetected mistakes calls `could_hide`.

Symbols     m instrument matrix, M its part that acts on q, u; δm its change by an effect at its size; p = 5 %
Limits      One mistake at a time; to first order in δθ.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from walop_jax.calibration.accuracy import LARGEST_P, change_of_qu
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
    """One mistake that could hide: `error` of q and u (stars with p ≤ 5 %) at `size`, median, largest over the field.

    `kind` is `EFFECT` or `DATA` (`fit.verdict`); it is not `measured` where the data hold no information on it. One
    that is not, and is `ahead`, is of the light from the sky before it meets the polariser.
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
        """Name and size: that at which it would just be detected, or its standard error where that is smaller."""
        size, unit = (self.size, self.unit) if self.unit else (100 * self.size, "%")
        what = "an error of" if self.measured else "not measured; usual size"
        return f"{self.name} ({what} {rounded(size, '.2g')} {unit})"


def unmeasured(mistakes: Iterable[CouldHide]) -> dict[str, CouldHide]:
    """Mistakes that the data do not measure, by their names: those together that one measurement would show."""
    together: dict[str, list[CouldHide]] = {}
    for mistake in mistakes:
        if not mistake.measured:
            together.setdefault(mistake.remedy, []).append(mistake)
    return {", ".join(mistake.name for mistake in group): group[0] for group in together.values()}


def off_by(median: float, largest: float, shown: str = "") -> str:
    """Errors of q and u over the field in words; `largest` may be unknown (NaN), `shown` replaces the median (%)."""
    worst = f", {per_cent(largest)} % at worst" if np.isfinite(largest) else ""
    return f"q or u off by {shown or per_cent(median)} % (median{worst})"


def could_hide(calibration: Calibration) -> tuple[CouldHide, ...]:
    """The mistakes that could hide in the data of a calibration, the largest error in the median of the field first.

    In the usual setting, where one exposure gives q and u. None where they were not computed;
    those without an error there are left out.
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
    acting, mistakes = acting_effects(calibration), list[CouldHide]()
    at_values = calibration.model.instrument(calibration.values)
    for number, (m, of_field) in enumerate(zip(hidden.errors, errors, strict=True)):
        ahead = not m.measured and number in acting and is_ahead(at_values, acting[number])
        error = float(np.median(of_field)), float(of_field.max())
        if error[1] > 0.0:
            mistakes.append(CouldHide(m.name, m.kind, m.size, m.unit, m.remedy, m.measured, ahead, error))
    return tuple(sorted(mistakes, key=lambda mistake: (-mistake.error[0], -mistake.error[1])))


def hidden_errors(
    calibration: Calibration, x: OfPoints, y: OfPoints, settings: Settings
) -> Float[np.ndarray, "s p"]:
    """Error of q and u at field positions (deg) by each mistake that could hide; NaN where u is hardly measured."""
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
                change = change + change_by_effect(instrument, effect, settings, filters, x, y)
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
    for number, mistake in enumerate(() if hidden is None else hidden.errors):
        values: dict[str, Any] = json.loads(mistake.acts) if mistake.acts else {}
        if (name := values.pop("effect", "")) in names:
            effects[number] = effect_by_name(name, known_effects(model)).of(context, **values)
    return effects


def _changes(effect: Effect, instrument: Instrument) -> list[Change]:
    """The changes of an effect, of any of its amplitudes."""
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
    """True if an effect does anything to the light of a star in a setting (one row): it is in the beam there."""
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
    """Amplitudes of effects that act ahead of the polariser, and their errors of q and u of stars at the usual size.

    No exposure through the polariser shows them, whatever it counts. The error is the same in all cameras, all over the
    field. None where one exposure does not give q and u, as in `could_hide`.
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
    instrument: Instrument, effect: Effect, setting: Settings, filters: Filters, x: OfPoints, y: OfPoints
) -> Float[np.ndarray, "p a 3"]:
    """Instrument matrix with an effect at its size, less the one without, in one setting."""
    models = with_effect(instrument, effect), instrument
    after, before = (planned_matrices(m, plan_for_settings(m, setting, filters), x, y) for m in models)
    return after - before
