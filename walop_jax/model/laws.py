"""Laws of parameters: changes of the numbers of an instrument with time. Data; `algebra` computes with them.

    shared      one value for all nights; the default
    night       a value for every night      } `spread`: standard deviation of the values about their mean;
    file        a value for every file       } without it every value has the prior of the parameter, if there is one
    walk        a random walk: its increments over Δt days have standard deviation `rate` √Δt
    interval    a value up to the first date of `at`, another up to the second, …
    step        another value from every date of `at` on
    bad         another value between the two dates of every entry of `bad`: a night that differs
    linear      a drift, per year of 365.25 days
    annual      a cosine and a sine with that period

In a model file a table [law.NAME] holds the law of a parameter or, with * and ?, of a group of them (docs: nights).

Dates are MJD (UTC); an interval contains its first moment and not its last. Steps, bad nights, drifts and annual terms
are added to the other law. A candidate (an amplitude beyond the model) is absent unless it has a law; one with steps
or bad nights alone is 0 before and after.
"""

from __future__ import annotations

import dataclasses
import fnmatch
import itertools
import math
import typing
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from walop_jax.io.errors import nearest
from walop_jax.io.toml import Reader

YEAR = 365.25  # days
BASES = ("shared", "night", "file", "walk", "interval")
ADDED = ("step", "bad", "linear", "annual")
_NEEDS = {"rate": "walk", "at": "interval or step", "bad": "bad", "spread": "night or file"}


class Form(NamedTuple):
    """A function of time that a value multiplies: constant, 1 from `start` to `stop`, linear, cosine or sine."""

    kind: str
    start: float = -math.inf
    stop: float = math.inf

    def at(self, mjd: Any) -> Any:
        """The function at times (MJD)."""
        mjd = np.asarray(mjd, float)
        if self.kind == "window":
            return ((mjd >= self.start) & (mjd < self.stop)).astype(float)
        years = (mjd - self.start) / YEAR
        if self.kind == "linear":
            return years
        turn = 2.0 * np.pi * mjd / YEAR
        return np.cos(turn) if self.kind == "cosine" else np.sin(turn)


ALWAYS = Form("window")


@dataclasses.dataclass(frozen=True)
class Law:
    """Allowed changes of a parameter. `per` are words of the table above, `rate` per √day, `at` and `bad` MJD.

    Raises ValueError for words that exclude each other and for numbers that are missing or unused.
    """

    per: tuple[str, ...] = ("shared",)
    spread: float | None = None
    rate: float | None = None
    at: tuple[float, ...] = ()
    bad: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        for word in self.per:
            if word not in BASES + ADDED:
                raise ValueError(f"per: there is no law {word!r}; {nearest(word, BASES + ADDED)}")
        if len([word for word in self.per if word in BASES]) > 1:
            raise ValueError(f"per = {list(self.per)}: only one of {', '.join(BASES)} may hold")
        if "interval" in self.per and "step" in self.per:
            raise ValueError("per: interval and step would both use the dates of at; name one")
        for key, required in _NEEDS.items():
            present, used = getattr(self, key) not in (None, ()), set(self.per) & set(required.split(" or "))
            if present and not used:
                raise ValueError(f"{key} is used with per = {required} only")
            if used and not present and key != "spread":
                raise ValueError(f"per = {sorted(used)[0]!r} needs {key}")
        for key in ("spread", "rate"):
            value = getattr(self, key)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise ValueError(f"{key} = {value} must be above 0")
        dates = [*self.at, *itertools.chain(*self.bad)]
        if not all(map(math.isfinite, dates)) or sorted(set(self.at)) != list(self.at):
            raise ValueError("dates must be finite MJD, those of at in ascending order, each once")
        if any(not start < stop for start, stop in self.bad):
            raise ValueError("bad: the first date of a pair must be before the second")

    @property
    def base(self) -> str:
        """The base, one of `BASES`; "" for additions alone."""
        return next((word for word in self.per if word in BASES), "")

    def forms(self, mean: bool, middle: float) -> Iterator[tuple[Form, bool]]:
        """Functions of time with one value each; True for a value with the prior of the parameter.

        `mean`: the parameter has a value when nothing is added; drifts are counted from `middle` (MJD).
        """
        if self.base == "interval":
            edges = (-math.inf, *self.at, math.inf)
            yield from ((Form("window", *pair), True) for pair in itertools.pairwise(edges))
        elif (
            self.base == "shared"
            or (self.base in ("night", "file") and self.spread)
            or (mean and not self.base)
        ):
            yield ALWAYS, True
        if "step" in self.per:
            yield from ((Form("window", date), False) for date in self.at)
        yield from ((Form("window", *pair), False) for pair in self.bad)
        if "linear" in self.per:
            yield Form("linear", middle), False
        if "annual" in self.per:
            yield from ((Form(kind), False) for kind in ("cosine", "sine"))

    def adding(self, word: str, *dates: float) -> Law:
        """The law with a drift, a step or a bad night more; a step is an edge more where intervals hold."""
        word = "interval" if word == "step" and "interval" in self.per else word
        at, bad = self.at, self.bad
        if word in ("step", "interval"):
            at = tuple(sorted({*at, *dates}))
        elif word == "bad":
            bad = tuple(sorted({*bad, (dates[0], dates[1])}))
        return dataclasses.replace(self, per=tuple(dict.fromkeys((*self.per, word))), at=at, bad=bad)

    def seen_at(self, mjd: Any) -> Law:
        """The law without bad nights that contain none of some times (MJD)."""
        bad = tuple((start, stop) for start, stop in self.bad if np.any((mjd >= start) & (mjd < stop)))
        per = self.per if bad or not self.bad else tuple(word for word in self.per if word != "bad")
        return dataclasses.replace(self, per=per, bad=bad)

    def document(self) -> dict[str, Any]:
        """The entry of a model file, as plain data."""
        entries = {key: value for key, value in vars(self).items() if value not in (None, ())}
        return entries | {"per": list(self.per)}


SHARED = Law()
Laws = Mapping[str, Law]


def laws_of(tables: Mapping[str, Any]) -> dict[str, Law]:
    """The laws of the [law] tables of a model file. Raises ValueError, with table and key, for invalid entries."""
    laws, read, hints = {}, Reader(""), typing.get_type_hints(Law)
    for name, entry in tables.items():
        place = f'law."{name}"'
        if not isinstance(entry, Mapping):
            raise read.fault(place, "must be a table; put names with dots in quotes")
        alone = {key: (entry[key],) for key in ("per", "at") if isinstance(entry.get(key), str | int | float)}
        values = read.values(hints, {**entry, **alone}, place)
        try:
            laws[name] = Law(**values)
        except ValueError as error:
            raise read.fault(place, str(error)) from None
    return laws


def resolved(
    laws: Laws, names: Sequence[str], candidates: Sequence[str], alone: Collection[str] = ()
) -> tuple[Law | None, ...]:
    """A law for every parameter, then for every candidate (None: absent); an exact name wins over a group.

    Candidates in `alone` belong to no group.

    Raises ValueError for a name or group without a parameter.
    """
    assigned: dict[str, Law | None] = dict.fromkeys(names, SHARED) | dict.fromkeys(candidates, None)
    for exact in (False, True):
        for key, law in laws.items():
            if (key in assigned) != exact:
                continue
            matches = [key] if exact else [n for n in fnmatch.filter(assigned, key) if n not in alone]
            if not matches:
                raise ValueError(f"[law]: there is no parameter {key!r}; {nearest(key, assigned)}")
            assigned |= dict.fromkeys(matches, law)
    return tuple(assigned.values())
