"""The verdict on a fit: all doubts about it, computed once; bits, words, exit codes and trust are read off it."""

from __future__ import annotations

import dataclasses
import enum
import functools
import operator
from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from jaxtyping import Float

from walop_jax.io.text import rounded, some

STATED = "N_ERR"
"""Origin of the errors of a fit that explains the data: the stated errors."""

SUSPECT_SIGMA = 5.0
"""Excess of χ² over its expectation, in its own standard deviations, from which a model does not explain the data."""


class Quality(enum.IntFlag):
    """Bits of QUALITY (of a product) and FLAG (of a row, star or pixel), each with its meaning."""

    def __new__(cls, value: int, meaning: str = "") -> Self:
        """A bit with its meaning in words."""
        bit = int.__new__(cls, value)
        bit._value_, bit.meaning = value, meaning
        return bit

    meaning: str

    NOT_CONVERGED = 1, "not converged"
    ILL_CONDITIONED = 2, "ill-conditioned"
    AT_PRIOR_EDGE = 4, "a parameter lies at the edge of its prior"
    EXCESS_NOISE = 8, "excess noise above 0.5 sigma"
    HIGH_CROSSTALK = 16, "zone of high cross-talk (a local inverse has a condition number above 10)"
    BEYOND_FIELD = 32, "extrapolated in the field"
    BEYOND_SETTINGS = 64, "extrapolated in wavelength or temperature"
    CAMERA_MISSING = 128, "a camera is missing"
    SATURATED = 256, "saturated or non-linear data used"
    FREE_FORM = 512, "unknown free-form term active"
    CLASS_ONLY = 1024, "only a class of causes was named"
    VALIDITY_FORCED = 2048, "validity forced"
    NON_PHYSICAL = 4096, "non-physical Mueller matrix within tolerance"
    UNEXPLAINED = 8192, "the model does not explain the data"
    DOUBTED = 32768, "the residuals hold more than noise, or differ between parts of the data"
    ERRORS_TOO_LARGE = 65536, "the stated errors are far larger than the scatter of the data"
    DISAGREES = 131072, "the intensities disagree with the calibration by more than noise"
    UNKNOWN_COLOUR = 262144, "no TEFF, and the colour is most of the error"
    PLACE = 1048576, "stars of one place in the field disagree with the calibration together"
    OTHER_FRAME = 2097152, "in the frame of the instrument, where other rows have a ROTATOR"
    REPEATED = 4194304, "a row has the place and counts of another star or setting"
    CATALOGUE = 524288, "the stars of the catalogue together contradict the calibration or the errors"
    NO_STOKES = (
        16384,
        "no Stokes parameters: too few cameras, too little light, or no u in the rows there are",
    )

    @property
    def meanings(self) -> tuple[str, ...]:
        """Meanings of the bits that are set, in words."""
        return tuple(bit.meaning for bit in Quality if bit & self)


@dataclasses.dataclass(frozen=True)
class Doubt:
    """A doubt about a fit: a bit of `Quality`, a sentence for the user, and whether it forbids trust.

    A remark has no bit and forbids nothing.
    """

    bit: Quality
    sentence: str
    blocking: bool = True


@dataclasses.dataclass(frozen=True)
class Structure:
    """Differences between field points that are finer than the model, rms over points and cameras.

    `gain` is that of the gain of a camera (a share of its counts), `response` that of its response to fully polarised
    light (a share of the counts as well); 0 where residuals show none. Standard errors of everything that is seen at
    one place of the field hold them: no average over exposures makes them smaller.
    """

    gain: float = 0.0
    response: float = 0.0

    def __bool__(self) -> bool:
        return self.gain > 0.0 or self.response > 0.0


NO_STRUCTURE = Structure()
NOT_MEASURED = (
    "the calibration data hold no information on {}; Q_HIDDEN, U_HIDDEN of stars have it, Q_ERR, U_ERR do not"
)
"""Remark on mistakes without information in the data, at their usual sizes."""
EFFECT, DATA = "effect", "data"
"""Kinds of mistakes that could hide: of the model of the instrument, of numbers that the set states."""


class Mistake(NamedTuple):
    """A mistake that the data would not show.

    Its `size` in `unit` would just have been found, or is the largest plausible one. `kind` is `EFFECT` or `DATA`,
    `remedy` a measurement that would show it. What acts on starlight itself is an effect that the model has not: `acts`
    holds it at its size, as JSON of name and values, "" for all others. It is not `measured` where the data hold no
    information on it at all.
    """

    name: str
    size: float
    unit: str
    kind: str = DATA
    remedy: str = ""
    acts: str = ""
    measured: bool = True


@dataclasses.dataclass(frozen=True, eq=False)
class Hidden:
    """Single mistakes that the data would not show.

    `changes` are what each does to the parameters of the model, all of them in tree order. The largest effect of any of
    them on a star is the protection level of its Stokes parameters (RAIM: National Academies 4920, 2023).
    """

    mistakes: tuple[Mistake, ...]
    changes: Float[np.ndarray, "s n"]

    def __len__(self) -> int:
        return len(self.mistakes)

    def not_measured(self) -> tuple[str, ...]:
        """Names of all unmeasured mistakes, each with the measurement to take."""
        together: dict[str, list[str]] = {}
        for mistake in self.mistakes:
            if not mistake.measured:
                together.setdefault(mistake.remedy, []).append(mistake.name)
        joined = {", ".join(names): remedy for remedy, names in together.items()}
        return tuple(f"{names} (to measure it: {cure})" if cure else names for names, cure in joined.items())

    def in_words(self, most: int = 1) -> str:
        """The worst of them in a sentence."""
        sizes = [f"{m.name} of {rounded(m.size, '.2g')} {m.unit}".rstrip() for m in self.mistakes]
        return f"too small to be detected, yet larger than the errors: {some(sizes, most)}"


@dataclasses.dataclass(frozen=True)
class Verdict:
    """Statistics of a fit and all doubts about it.

    The one rule of trust: a result is trusted if none of the doubts `against` it is blocking. `noise_scale` multiplied
    the errors of the data in the fit (1: as given); `structure` is what field points differ by; `covariance_from` names
    the origin of the covariance ("fit" or "posterior"), `errors_from` what that was made from: the stated errors of the
    data, or the residuals (`fit.robust`).
    """

    chi2: float
    dof: int
    n_data: int
    noise_scale: float
    converged: bool
    against: tuple[Doubt, ...] = ()
    covariance_from: str = "fit"
    errors_from: str = STATED
    structure: Structure = NO_STRUCTURE

    @classmethod
    def recorded(cls, *, trusted: bool, quality: int, warnings: Sequence[str] = (), **others: Any) -> Verdict:
        """The verdict that a file states; it does not relate sentences to bits."""
        remarks = tuple(Doubt(Quality(0), text, blocking=False) for text in warnings)
        bits = (Doubt(Quality(quality), "", blocking=not trusted),) if quality or not trusted else ()
        return cls(**others, against=(*bits, *remarks))

    @property
    def trusted(self) -> bool:
        """True if no doubt about the fit forbids its use."""
        return not any(doubt.blocking for doubt in self.against)

    @property
    def quality(self) -> Quality:
        """The bits of all doubts."""
        return functools.reduce(operator.or_, (doubt.bit for doubt in self.against), Quality(0))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Doubts and remarks in sentences."""
        return tuple(doubt.sentence for doubt in self.against if doubt.sentence)

    @property
    def doubts(self) -> tuple[str, ...]:
        """The sentences about the residuals alone (`Quality.DOUBTED`)."""
        return tuple(d.sentence for d in self.against if d.bit & Quality.DOUBTED and d.sentence)

    @property
    def words(self) -> str:
        """The verdict as it is printed everywhere."""
        return "trusted" if self.trusted else "not trusted"
