"""Judging the result of a diagnosis against the truth of a sealed set: the matrix, stars and the place of the cause."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from studies.chance import relative

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.matrix import matrix_slopes
from walop_jax.data.settings import Settings
from walop_jax.diagnosis.findings import Diagnosis
from walop_jax.model.effects import EFFECTS, Described, FreeForm, OtherDescription
from walop_jax.model.effects.change import Change
from walop_jax.model.effects.in_models import effect_context
from walop_jax.model.instrument import Instrument

if TYPE_CHECKING:
    from studies.sealed import Sealed

WRONG, FEW = 3.0, 0.01
TEFF, STAR_P, DRAWS = 5772.0, 0.02, 400


class Judged(NamedTuple):
    """A product held against the truth: error of stars, pulls of stars (place, q or u) and of elements.

    `stated` is the error that the covariance gives, rms over the stars; `chance` is the probability that a product with
    this covariance is `wrong` though the covariance is exact.
    """

    trusted: bool
    error: float
    stars: np.ndarray
    elements: np.ndarray
    chance: float = np.nan
    stated: float = np.nan

    @property
    def beyond(self) -> float:
        """Share of the stars beyond three stated errors."""
        return float(np.mean(np.abs(self.stars).max(axis=1) > WRONG))

    @property
    def wrong(self) -> bool:
        """True if more than 1 % of the stars, or the median pull of an element, lie beyond three stated errors."""
        return _wrong(self.stars, self.elements)


def _wrong(stars: np.ndarray, elements: np.ndarray) -> bool:
    beyond = np.mean(np.abs(stars).max(axis=-1) > WRONG)
    return bool(beyond > FEW or np.median(np.abs(elements), axis=0).max() > WRONG)


def _chance(
    calibration: Calibration, one: Sealed, setting: Settings, seen: np.ndarray, slope: np.ndarray
) -> float:
    """Share of draws from the covariance of a calibration that are `wrong`; `slope` gives q, u of the stars."""
    instrument = calibration.model.instrument(calibration.values)
    _, slopes = matrix_slopes(instrument, setting, calibration.filters, one.x, one.y)
    of_elements = np.asarray(slopes).reshape(len(one.x), 6, -1)[seen]
    of_stars = np.einsum("pia,paf->pif", slope, of_elements)
    elements, stars = (relative(a, calibration.covariance) for a in (of_elements, of_stars))
    draws = np.random.default_rng(6).standard_normal((DRAWS, elements.shape[2]))
    return float(np.mean([_wrong(stars @ draw, elements @ draw) for draw in draws]))


def judged(calibration: Calibration, trusted: bool, one: Sealed) -> Judged:
    """Hold a calibration against the true matrix."""
    setting = calibration.usual_settings(len(one.x), calibration.usual_filter)
    setting = dataclasses.replace(setting, teff=np.full(len(one.x), TEFF))
    m, covariance = calibration.matrix(one.x, one.y, setting)
    known = np.isfinite(m).all(axis=1)
    true, found = (v.reshape(-1, 2, 3) for v in (one.matrix, m))
    known &= np.abs(np.linalg.det(true[:, :, 1:])) >= 0.1
    true, found, covariance = true[known], found[known], covariance[known]
    pulls = (found - true).reshape(len(true), 6) / np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    angle = np.random.default_rng(5).uniform(0.0, 2.0 * np.pi, len(true))
    star = np.stack([np.ones(len(true)), STAR_P * np.cos(angle), STAR_P * np.sin(angle)], axis=1)
    inverse = np.linalg.inv(found[:, :, 1:])
    error = np.einsum("pij,pjk,pk->pi", inverse, true - found, star)
    slope = np.einsum("pij,pk->pijk", inverse, star).reshape(len(star), 2, 6)
    stated = np.sqrt(np.einsum("pia,pab,pib->pi", slope, covariance, slope))
    chance = _chance(calibration, one, setting, known, slope) if trusted else np.nan
    rms = (float(np.sqrt(np.mean(errors**2))) for errors in (error, stated))
    return Judged(trusted, next(rms), error / stated, pulls, chance, next(rms))


def homes_of(where: str, law: str) -> set[str]:
    """The places at which what is hidden may be said to be: those that its law over the exposures cannot tell apart."""
    if where.startswith("tables"):
        places = {
            "standards": "standards",
            "band": "band",
            "angle": "polariser",
            "rotator": "ahead of polariser",
            "pair": "polariser",
            "sky": "moon",
        }
        return {"tables"} | {home for word, home in places.items() if word in where}
    if where.startswith("half"):
        return {where}
    if where in ("gain", "power of counts", "leak"):
        return {"cameras"}
    if where in ("moon", "standards"):
        return {where, "ahead of polariser"}
    of_polariser = law in ("angle", "side") or law in ("kinds clp", "kinds clp and stars")
    of_sky = law.startswith("kinds") and "clp" not in law
    home = "common train" if where.startswith("behind") else where
    return (
        {home}
        | ({"polariser", "common train"} if of_polariser else set())
        | ({"ahead of polariser"} if of_sky else set())
    )


def home_of(sentence: str, instrument: Instrument) -> str:
    """The place that a description of a diagnosis names."""
    change = Change.parsed(
        sentence.replace(" * smooth", "")
    )  # any pattern over the field is at the same home
    polariser, arms = instrument.polariser, [arm.name for arm in instrument.arms]
    arm = change.place.split(".")[0]
    if change.kind.split()[0] in ("gain", "light", "afterglow"):
        return "cameras"
    if arm in arms:
        return f"half {arms.index(arm) + 1}"
    if change.place == "sky":
        return "moon"
    if change.place == "standard" or change.kind.startswith("polarisation"):
        return "standards"
    if change.place == "band":
        return "band"
    if polariser is not None and change.place == polariser.name:
        return {"ahead of": "ahead of polariser", "of": "polariser"}.get(change.relation, "common train")
    return "common train"


def right_of(one: Sealed, diagnosis: Diagnosis) -> str:
    """`right`, `class` or `wrong`, by the places of all additions and of those not told from them; empty: none."""
    if not diagnosis.steps:
        return ""
    instrument = diagnosis.after.model.instrument(diagnosis.after.values)
    bare = dataclasses.replace(instrument, effects=())
    context = effect_context(bare, diagnosis.after.calset.exposures)

    def homes(names: Iterable[str]) -> set[str]:
        texts = []
        for name in names:
            effect = next((kind for kind in EFFECTS if kind.name == name), None)
            if effect is not None:
                texts += effect.neutral(context).as_descriptions(bare)
            elif name not in (Described.name, FreeForm.name, OtherDescription.name):
                texts += name.split("; ")
        return {home_of(text, bare) for text in texts}

    told, classes = [], []
    for step in diagnosis.steps:
        told += [change.text for change, *_ in step.descriptions] if step.descriptions else [step.effect]
        classes += [*step.equivalent, *step.nameless, *itertools.chain(*step.also_called.values())]
    if homes(told) <= one.homes:
        return "right"
    return "class" if homes([*told, *classes]) & one.homes else "wrong"
