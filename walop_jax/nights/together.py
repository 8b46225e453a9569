"""Nights as normal equations, and nights in the parameters of all of them: the input of a stack.

    χ²(θ) = χ² + 2 gᵀ(θ − θ₀) + (θ − θ₀)ᵀ H (θ − θ₀)

of the data alone: priors are laid on when nights are stacked, once. How they are made of data: `nights.equations`.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from walop_jax.calibration.calibration import Calibration
from walop_jax.data.records import CalibrationSet
from walop_jax.io.errors import fail
from walop_jax.io.shapes import AnyVector
from walop_jax.model.parameters import Parameter
from walop_jax.nights.algebra import Equations


@dataclasses.dataclass(frozen=True, eq=False)
class Night:
    """The normal equations of one file in one night.

    `number` is the MJD of the evening, `begin`, `end` and `mjd` (UTC) the first, last and mean exposure; `source` and
    `sha256` the data, `model` a hash of the fixed part of the model. `dof` counts data less fluxes. The last parameters
    are `candidates`, amplitudes beyond the model with reference 0; `gradient` and `matrix` are halves of the
    derivatives of `chi2`.
    """

    instrument: str
    model: str
    number: int
    begin: float
    end: float
    mjd: float
    filters: tuple[str, ...]
    source: str
    sha256: str
    n_data: int
    dof: int
    chi2: float
    parameters: tuple[Parameter, ...]
    candidates: int
    reference: Float[np.ndarray, " n"]
    gradient: Float[np.ndarray, " n"]
    matrix: Float[np.ndarray, "n n"]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, candidates last."""
        return tuple(p.name for p in self.parameters)

    @property
    def key(self) -> tuple[str, int]:
        """Hash of the data, and the night."""
        return self.sha256, self.number


@dataclasses.dataclass(frozen=True)
class EffectAmplitude(Parameter):
    """An amplitude of an effect (`part`) that a model lacks, at one `shape`: the number of its group of probes and of
    the member.

    `in_model` is its name in a model that has the effect. In files the name says it all: EFFECT#GROUP.LEAF#MEMBER,
    zeros left out.
    """

    shape: tuple[int, int] = (0, 0)
    in_model: str = ""

    @classmethod
    def of(cls, leaf: Parameter, effect: str, group: int | None, member: int) -> EffectAmplitude:
        """The amplitude of a leaf of a probe; `group` is None where the effect has a single one."""
        of_group, of_member = f"#{group}" * (group is not None), f"#{member}" * bool(member)
        name = f"{effect}{of_group}.{leaf.name}{of_member}"
        return cls.read(dataclasses.replace(leaf, name=name, start=0.0))

    @classmethod
    def read(cls, parameter: Parameter) -> EffectAmplitude:
        """The amplitude that a parameter of a file stands for."""
        head, _, leaf = parameter.name.partition(".")
        (part, _, group), (leaf, _, member) = head.partition("#"), leaf.partition("#")
        fields: dict[str, Any] = vars(parameter) | {"part": part}
        return cls(**fields, shape=(int(group or 0), int(member or 0)), in_model=f"{part}.{leaf}")


def source_of(data: CalibrationSet | Calibration) -> str:
    """The files of a set, or of the data of a calibration; its origin if it comes from none."""
    return ", ".join(str(entry.path) for entry in data.inputs) or data.origin


@dataclasses.dataclass(frozen=True, eq=False)
class Together:
    """Nights in the order of time, with equations in the parameters of all: the input of a stack.

    `origin` are the values that equations count from; `mean` and `width` (inf: none) the priors in the same way.
    """

    nights: tuple[Night, ...]
    parameters: tuple[Parameter, ...]
    candidates: int
    origin: AnyVector
    mean: AnyVector
    width: AnyVector
    equations: Equations

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, candidates last."""
        return tuple(p.name for p in self.parameters)

    def aligned(self) -> list[Night]:
        """The nights in the parameters of all, about the common origin, as a file of nights holds them."""
        e, up = self.equations, 1.0 / self.equations.scale
        return [
            dataclasses.replace(
                night, chi2=float(e.chi2[u]), parameters=self.parameters, candidates=self.candidates,
                reference=self.origin, gradient=e.gradient[u] * up, matrix=e.matrix[u] * np.outer(up, up),
            )
            for u, night in enumerate(self.nights)
        ]  # fmt: skip

    @property
    def reference(self) -> Float[np.ndarray, "u n"]:
        """The values that every night was linearised at, NaN for parameters that it lacks."""
        place = {name: k for k, name in enumerate(self.names)}
        values = np.full((len(self.nights), len(place)), np.nan)
        for u, night in enumerate(self.nights):
            values[u, [place[name] for name in night.names]] = night.reference
        return values

    @property
    def has_value(self) -> Bool[np.ndarray, " n"]:
        """True for parameters of the model, False for candidates."""
        return np.arange(len(self.parameters)) < len(self.parameters) - self.candidates

    @property
    def gauge(self) -> Bool[np.ndarray, " n"]:
        """True for candidates that are fixed in the model at a value, so that only changes of them can be seen."""
        return ~self.has_value & np.array([p.start != 0.0 for p in self.parameters], bool)


def together(nights: Sequence[Night]) -> Together:
    """Nights in the order of time, in the parameters of all. Raises `DataError` as `check_together` does."""
    if not nights:
        raise fail("no night was given", advice="give fits, sets or files of nights")
    ordered = tuple(sorted(nights, key=lambda night: (night.mjd, night.sha256)))
    check_together(ordered)
    of_model: dict[str, Parameter] = {}
    beyond: dict[str, Parameter] = {}
    for night in ordered:
        for k, p in enumerate(night.parameters):
            is_candidate = k >= len(night.parameters) - night.candidates
            (beyond if is_candidate else of_model).setdefault(p.name, p)
    union = of_model | {name: p for name, p in beyond.items() if name not in of_model}
    place, n = {name: k for k, name in enumerate(union)}, len(union)
    origin, chi2 = np.full(n, np.nan), np.zeros(len(ordered))
    gradient, matrix = np.zeros((len(ordered), n)), np.zeros((len(ordered), n, n))
    for u, night in enumerate(ordered):
        at = np.array([place[name] for name in night.names])
        origin[at] = np.where(np.isnan(origin[at]), night.reference, origin[at])
        moved = origin[at] - night.reference
        slope = night.matrix @ moved
        chi2[u] = night.chi2 + 2.0 * night.gradient @ moved + moved @ slope
        gradient[u, at] = night.gradient + slope
        matrix[u][np.ix_(at, at)] = night.matrix
    mean, width = np.zeros(n), np.full(n, np.inf)
    for k, p in enumerate(of_model.values()):
        if p.prior is not None or p.loose is not None:
            centre, width[k] = p.prior if p.prior is not None else (p.start, p.loose)
            mean[k] = centre - origin[k]
    total = np.einsum("uii->i", matrix) + width**-2.0
    scale = 1.0 / np.sqrt(np.where(total > 0, total, 1.0))
    gradient *= scale
    matrix *= scale
    matrix *= scale[:, None]
    keys = [night.number for night in ordered], [night.sha256 for night in ordered]
    number, file = (np.unique(key, return_inverse=True)[1].astype(int) for key in keys)
    mjd = np.array([night.mjd for night in ordered])
    equations = Equations(mjd, number, file, chi2, gradient, matrix, scale)
    return Together(ordered, tuple(union.values()), n - len(of_model), origin, mean, width, equations)


_NO_SITE = (
    "give all files the longitude of the site (SITELONG), which says where a night ends, and correct MJD"
)


def check_together(nights: Sequence[Night]) -> None:
    """Raise `DataError` for nights of other instruments or models, and for data that are there twice."""
    first = nights[0]
    remedies = "stack the instruments apart", "linearise all nights with one model (like=)"
    for name, remedy in zip(("instrument", "model"), remedies, strict=True):
        for night in nights:
            if getattr(night, name) != getattr(first, name):
                mine, theirs = (f"{getattr(entry, name)[:12]} ({entry.source})" for entry in (first, night))
                raise fail(f"the nights are of two {name}s, {mine} and {theirs}", advice=remedy)
    stars: dict[str, tuple[Parameter, Night]] = {}
    for night in nights:
        for p in night.parameters:
            mine, theirs = stars.setdefault(p.name, (p, night))
            if p.name.startswith("standard.") and p.prior != mine.prior:
                star = p.name.split(".")[1]
                what = f"the catalogue has other values of {star} in {night.source} than in {theirs.source}"
                advice = "correct one of them, or give it another NAME"
                raise fail(what, extension="SOURCES", advice=advice)
    by_number = sorted(nights, key=lambda night: (night.number, night.end))
    for before, after in itertools.pairwise(by_number):
        if after.begin < before.end and after.number != before.number:
            what = f"the nights of MJD {before.number} and {after.number} overlap"
            where = f"{before.source} until {before.end:.3f}, {after.source} from {after.begin:.3f}"
            raise fail(f"{what}: {where}", advice=_NO_SITE)
    earlier: dict[Any, Night] = {}
    for night in nights:
        for key in (night.key, (night.begin, night.end)):
            if key in earlier:
                what = "the same data" if key == night.key else "exposures of the same times"
                where = f"{what} are in {earlier[key].source} and {night.source}"
                raise fail(f"the night of MJD {night.number} is there twice: {where}", advice="leave one out")
            earlier[key] = night
