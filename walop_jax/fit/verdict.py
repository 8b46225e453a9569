"""The verdict on a fit, a calibration, or stars: go, go with reservations, or no go, and why.

All doubts, each with what it does to q and u of stars and with one remedy. They are computed once; bits, words, first
lines, exit codes and trust are read off them.
"""

from __future__ import annotations

import dataclasses
import enum
import functools
import operator
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from jaxtyping import Float

from walop_jax.io.display import Display, Displayed
from walop_jax.io.text import per_cent, rounded, some

STATED = "N_ERR"
"""Origin of the errors of a fit that explains the data: the stated errors."""

SUSPECT_SIGMA = 5.0
"""Excess of χ² over its expectation, in its own standard deviations, from which a model does not explain the data."""


def excess(chi2: float, dof: float) -> float:
    """(χ² − dof) / √(2 dof): how many standard deviations χ² lies above its expectation."""
    return float((chi2 - dof) / np.sqrt(2.0 * max(dof, 1)))


def explains(chi2: float, dof: float) -> bool:
    """True if χ² is what noise alone would give."""
    return bool(dof > 0 and excess(chi2, dof) < SUSPECT_SIGMA)


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


REMEDIES: Mapping[Quality, str] = {
    Quality.NOT_CONVERGED: "walop-jax inspect looks for faults of the data",
    Quality.UNEXPLAINED: "walop-jax diagnose looks for missing effects",
    Quality.DOUBTED: "walop-jax diagnose looks for the cause",
    Quality.ERRORS_TOO_LARGE: "check the gain, and whether N_ERR holds variances or other units",
    Quality.AT_PRIOR_EDGE: "walop-jax diagnose looks for what pulls at it",
    Quality.CLASS_ONLY: "walop-jax plan --separate RUN plans the exposures that decide between its members",
    Quality.FREE_FORM: "walop-jax report RUN shows the pattern; describe its cause in an --effects file",
    Quality.ILL_CONDITIONED: "walop-jax plan names the exposures that separate the parameters",
}
"""What to do about a doubt that brings no remedy of its own, by its bit."""


@dataclasses.dataclass(frozen=True)
class Doubt:
    """One thing that a verdict holds against a result: a sentence, whether it forbids trust, its size, its remedy.

    `bit` is its bit in QUALITY. A doubt that is not `blocking` is a reservation; without a bit it is a remark. `off` is
    by how much it makes q or u of stars wrong, or uncertain, as a fraction (0.001 is 0.1 %; None: not known). Example:
    "the model does not explain the data: χ²/dof = 3, where 1 is expected".
    """

    bit: Quality
    sentence: str
    blocking: bool = True
    off: float | None = None
    remedy: str = ""

    @property
    def what(self) -> str:
        """The sentence, or the meanings of its bits where it has none."""
        return self.sentence or "; ".join(self.bit.meanings) or "it was not trusted when it was written"

    @property
    def cure(self) -> str:
        """The one remedy: its own, or that of its bit."""
        if self.remedy:
            return self.remedy
        return next((remedy for bit, remedy in REMEDIES.items() if bit & self.bit), "")

    @property
    def words(self) -> str:
        """Sentence, effect on stars and remedy, each said once."""
        number = per_cent(self.off) if self.off else ""
        size = f" (q, u off by {number} %)" if number and f"{number} %" not in self.what else ""
        told = not self.cure or self.cure in self.what or ("walop-jax " in self.what and not self.remedy)
        return f"{self.what}{size}" if told else f"{self.what}{size}; {self.cure}"

    def document(self) -> dict[str, Any]:
        """As plain data, an entry of `reasons`."""
        return {"what": self.what, "off": self.off, "remedy": self.cure, "blocking": self.blocking}

    @property
    def _rank(self) -> tuple[bool, float]:
        """Before others: what forbids trust, then what does most to stars; what may do anything is the largest."""
        unknown = np.inf if self.blocking else 0.0
        return not self.blocking, -(unknown if self.off is None else self.off)


@dataclasses.dataclass(frozen=True)
class Structure:
    """Differences between field points that are finer than the model, rms over points and cameras.

    `gain` is the rms of the gain of a camera, as a fraction of its counts; `response` the rms of its response to fully
    polarised light, as a fraction of the counts as well; both are 0 where the residuals show none. Standard errors of
    everything that is seen at one place of the field hold them: no average over exposures makes them smaller.
    """

    gain: float = 0.0
    response: float = 0.0

    def __bool__(self) -> bool:
        return self.gain > 0.0 or self.response > 0.0


NO_STRUCTURE = Structure()
NOT_MEASURED = (
    "the calibration data hold no information on {}; Q_HIDDEN, U_HIDDEN of stars have it, Q_ERR, U_ERR do not"
)
"""Remark on errors on which the data hold no information, at their usual sizes."""
EFFECT, DATA = "effect", "data"
"""Kinds of undetected errors: of the model of the instrument, of numbers that the set states."""


class UndetectedError(NamedTuple):
    """A systematic error that the data would not show: of the model of the instrument, or of a number that the set
    states.

    At `size`, in `unit`, it would just have been found, or it is the largest that is plausible. `kind` is `EFFECT` or
    `DATA`, `remedy` a measurement that would show it. An effect that acts on starlight itself and that the model has
    not is held by `acts` at its size, as JSON of name and values; `acts` is "" for all others. `measured` is False
    where the data hold no information on it at all.

    Example: an error of the angles of the standards (size 0.3, unit deg, kind DATA).
    """

    name: str
    size: float
    unit: str
    kind: str = DATA
    remedy: str = ""
    acts: str = ""
    measured: bool = True


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Hidden:
    """The systematic errors that the data would not show, each one by itself.

    `changes` (s, n) are what each of them does to the parameters of the model, in tree order. The largest effect of any
    of them on a star is the protection level of its Stokes parameters (RAIM: National Academies 4920, 2023).
    """

    errors: tuple[UndetectedError, ...]
    changes: Float[np.ndarray, "s n"]

    def __repr__(self) -> str:
        return f"{len(self)} errors that the data would not show: {some([error.name for error in self.errors], 3)}"

    def __len__(self) -> int:
        return len(self.errors)

    def not_measured(self) -> tuple[str, ...]:
        """Names of the errors on which the data hold no information, each with the measurement to take."""
        together: dict[str, list[str]] = {}
        for error in self.errors:
            if not error.measured:
                together.setdefault(error.remedy, []).append(error.name)
        joined = {", ".join(names): remedy for remedy, names in together.items()}
        return tuple(f"{names} (to measure it: {cure})" if cure else names for names, cure in joined.items())

    def in_words(self, most: int = 1) -> str:
        """A sentence on the worst of them, `most` by name."""
        sizes = [f"{m.name} of {rounded(m.size, '.2g')} {m.unit}".rstrip() for m in self.errors]
        return f"too small to be detected, yet larger than the errors: {some(sizes, most)}"


GO, RESERVED, NO_GO = "go", "go, with reservations", "no go"
"""The three answers."""


class VerdictPart(NamedTuple):
    """What one question found behind a verdict: the result, its document, and how it is shown."""

    value: Any
    document: Mapping[str, Any]
    shown: Display


@dataclasses.dataclass(frozen=True, repr=False)
class Verdict(Displayed):
    """The verdict on `subject`: all doubts about it, and statistics where it is a fit.

    The one rule of trust: a result is trusted, and a go, if none of its `doubts` is blocking. `stars` says
    how well p of a star is known with it. `parts` are the results that the doubts were read off, by name.

    Of a fit: `noise_scale` multiplied the errors of the data (1: as given); `structure` is what field points differ by;
    `covariance_from` names the origin of the covariance ("fit" or "posterior"), `errors_from` what that was made from:
    the stated errors of the data, or the residuals (`fit.robust`).
    """

    _working = ("recorded", "with_doubts", "on_top_of", "answers", "first_facts")

    chi2: float = float("nan")
    dof: int = 0
    n_data: int = 0
    noise_scale: float = 1.0
    converged: bool = True
    doubts: tuple[Doubt, ...] = ()
    covariance_from: str = "fit"
    errors_from: str = STATED
    structure: Structure = NO_STRUCTURE
    subject: str = dataclasses.field(default="", compare=False)
    stars: str = dataclasses.field(default="", compare=False)
    parts: Mapping[str, VerdictPart] = dataclasses.field(default_factory=dict, compare=False)

    @classmethod
    def recorded(cls, *, trusted: bool, quality: int, warnings: Sequence[str] = (), **others: Any) -> Verdict:
        """The verdict that a file states.

        A file does not say which sentence belongs to which bit: all bits go to the first doubt. If the fit is not
        trusted, the first sentence is the reason.
        """
        said = [*warnings]
        bits = Quality(quality)
        first = (Doubt(bits, said.pop(0) if said and not trusted else "", blocking=not trusted),)
        remarks = tuple(Doubt(Quality(0), text, blocking=False) for text in said)
        return cls(**others, doubts=(*(first if quality or not trusted else ()), *remarks))

    def with_doubts(
        self,
        doubts: Iterable[Doubt],
        *,
        subject: str = "",
        stars: str = "",
        parts: Mapping[str, VerdictPart] | None = None,
    ) -> Verdict:
        """The verdict with further doubts, each sentence once."""
        kept, said = [*self.doubts], {doubt.sentence for doubt in self.doubts}
        for doubt in doubts:
            if doubt.sentence not in said or not doubt.sentence:
                kept.append(doubt)
            said.add(doubt.sentence)
        return dataclasses.replace(
            self, doubts=tuple(kept), subject=subject or self.subject, stars=stars or self.stars,
            parts={**self.parts, **(parts or {})},
        )  # fmt: skip

    def __getitem__(self, name: str) -> Any:
        """The result of one of its `parts`."""
        if name not in self.parts:
            raise KeyError(f"{name!r} was not asked; there are {', '.join(self.parts) or 'no parts'}")
        return self.parts[name].value

    @property
    def trusted(self) -> bool:
        """True if no doubt forbids the use."""
        return not any(doubt.blocking for doubt in self.doubts)

    @property
    def go(self) -> bool:
        """True if the result can be used for stars: the same as `trusted`."""
        return self.trusted

    @property
    def quality(self) -> Quality:
        """The bits of all doubts."""
        return functools.reduce(operator.or_, (doubt.bit for doubt in self.doubts), Quality(0))

    @property
    def reasons(self) -> tuple[Doubt, ...]:
        """All doubts that say something, the one that does most to q and u of stars first."""
        told = [doubt for doubt in self.doubts if doubt.blocking or doubt.sentence]
        return tuple(sorted(told, key=lambda doubt: doubt._rank))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Doubts and remarks in sentences."""
        return tuple(doubt.sentence for doubt in self.doubts if doubt.sentence)

    @property
    def residual_doubts(self) -> tuple[str, ...]:
        """The sentences about the residuals alone (`Quality.DOUBTED`)."""
        return tuple(d.sentence for d in self.doubts if d.bit & Quality.DOUBTED and d.sentence)

    @property
    def objections(self) -> tuple[str, ...]:
        """The sentences that forbid the use, the first reason first."""
        return tuple(doubt.what for doubt in self.reasons if doubt.blocking)

    @property
    def reservations(self) -> tuple[str, ...]:
        """The sentences that forbid nothing, the first reason first."""
        return tuple(doubt.what for doubt in self.reasons if not doubt.blocking)

    @property
    def words(self) -> str:
        """The answer: go, go with reservations, or no go."""
        if not self.trusted:
            return NO_GO
        return RESERVED if self.reasons else GO

    @property
    def first_line(self) -> str:
        """Subject, answer, and the first reason with its remedy: the title of everything that shows a verdict."""
        return ": ".join(filter(None, (self.subject, self.words, *(d.words for d in self.reasons[:1]))))

    @property
    def first_facts(self) -> tuple[tuple[str, str], ...]:
        """The lines below the first: what the verdict means for p of a star, and all further reasons."""
        others = [f"{doubt.words}" for doubt in self.reasons[1:]] or ["nothing else"]
        unknown = "not known" if self.trusted else "not known: it is not to be used"
        return ("p of a star", self.stars or unknown), *zip(
            ["also", *[""] * (len(others) - 1)], others, strict=True
        )

    def on_top_of(self, shown: Display) -> Display:
        """A display with the first lines of the verdict as its own; sentences that these hold are not said again."""
        shown = shown.without([name for name, _ in self.first_facts if name])
        told = {doubt.sentence for doubt in self.reasons}
        notes = tuple(note for note in shown.notes if note not in told)
        facts = (*self.first_facts, *shown.facts)
        return dataclasses.replace(shown, title=self.first_line, facts=facts, notes=notes)

    def answers(self) -> dict[str, Any]:
        """The keys that every document with a verdict has."""
        return {
            "go": self.go, "answer": self.words, "p_of_a_star": self.stars or None,
            "reasons": [doubt.document() for doubt in self.reasons],
        }  # fmt: skip

    def document(self) -> dict[str, Any]:
        """The answer, and the documents of its parts by their names."""
        parts = {name: {**part.document, "shown": part.shown.document()} for name, part in self.parts.items()}
        return self.answers() | {"warnings": list(self.warnings)} | parts

    def display(self) -> Display:
        """The first lines, with the numbers and tables behind them."""
        shown = [part.shown for part in self.parts.values()]
        first = shown[0] if len(shown) == 1 else Display("")
        return self.on_top_of(first)
