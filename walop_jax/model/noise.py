"""Errors of the data as a part of the model: terms that a fit finds together with the instrument.

Equation    σ² = (s N_ERR)² + (f N)²
Symbols     σ standard error of an intensity N (electrons); N_ERR the error that the set states; s a scale, the product
            of all scales that concern the intensity; f a fraction of the counts (scintillation, a flat field that is
            left, gains that differ from exposure to exposure), f² the sum over all fractions that concern it
Groups      a term concerns all intensities, those of one KIND of exposures, or those of one camera: `noise.scale`,
            `noise.scale_moon`, `noise.fraction_E1`
Limits      s = 1 and f = 0, or no terms: the errors as stated. Only s² and f² enter, so signs mean nothing. f N is of
            the measured counts: weights then hang on the noise of N, which shifts all cameras of an exposure alike, by
            f² of the counts at most.

An instrument has no terms unless a model asks for them; the likelihood that they enter is `likelihood/noise.py`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from walop_jax.data.kinds import KINDS
from walop_jax.io.errors import nearest
from walop_jax.model.compiled import array
from walop_jax.model.parameters import Component, param

if TYPE_CHECKING:
    from walop_jax.model.instrument import Instrument
    from walop_jax.model.specification import Model

NOISE = "noise"
"""The part of an instrument that holds the terms."""
TERMS = ("scale", "fraction")
"""The terms of the errors, by the names of their parameters and of the keys of [noise] in a model file. Parameters are
in this order."""
COMMON = "noise.scale"
"""Name of the scale of all errors."""
ALL = "all"
"""Name of the group of all intensities."""
FRACTION_START = 0.003
"""Start value of a fraction: at 0 the likelihood has no slope in it."""


class Noise(Component):
    """Terms of the errors of the data; `scales` and `fractions` name the groups of intensities that each concerns.

    Example: `scales = ("all",)` and `fractions = ("O1", "E1")` have the parameters `noise.scale`, `noise.fraction_O1`
    and `noise.fraction_E1`.
    """

    scale: Float[Array, " s"] = param(
        unit="", about="factor on the stated errors N_ERR", source="a fit of the errors", scale=0.1
    )
    fraction: Float[Array, " f"] = param(
        unit="",
        about="fraction of the counts, added to the errors in quadrature",
        source="a fit of the errors",
        width=0.01,
    )
    scales: tuple[str, ...] = eqx.field(static=True, default=())
    fractions: tuple[str, ...] = eqx.field(static=True, default=())

    @classmethod
    def of(cls, scales: Sequence[str] = (), fractions: Sequence[str] = ()) -> Noise:
        """Terms for some groups of intensities, at their start values."""
        return cls(
            scale=array(np.ones(len(scales))),
            fraction=array(np.full(len(fractions), FRACTION_START)),
            scales=tuple(scales),
            fractions=tuple(fractions),
        )

    def labels(self, field: str) -> Sequence[str]:
        """Names of the terms: `scale` for all intensities, `scale_moon` for those of a group."""
        groups = self.scales if field == "scale" else self.fractions
        return tuple(field if group == ALL else f"{field}_{group}" for group in groups)


def with_noise(model: Model, *, scale: str | Sequence[str] = (), fraction: str | Sequence[str] = ()) -> Model:
    """The model whose errors of the data are fitted: σ² = (scale · N_ERR)² + (fraction · N)².

    `scale` and `fraction` are names of groups of intensities: "all", KINDs of exposures ("clp", "moon"), or cameras
    ("O1"); "camera" stands for each camera by itself. The parameters are free, a scale without a prior, a fraction with
    the prior 0 ± 0.01; `Model.change` sets others. Noise terms that the model had are replaced.

    Raises ValueError for a group that is neither.

    >>> model = walop.with_noise(walop.base_model(calset), scale="all", fraction=["O1", "E1"])
    >>> [name for name in model.names if name.startswith("noise")]
    ['noise.scale', 'noise.fraction_O1', 'noise.fraction_E1']
    """
    from walop_jax.model.specification import make_model

    noise = Noise.of(_groups("scale", scale, model.template), _groups("fraction", fraction, model.template))
    template = dataclasses.replace(model.template, noise=noise if noise.scales or noise.fractions else None)
    kept = {p.name: p for p in model.parameters if p.part != NOISE}
    made = make_model(model.name, template)
    parameters = [kept.get(p.name, p) for p in made.parameters]
    for i in made.positions(NOISE)[len(noise.scales) :]:
        # A fraction starts above 0, where the likelihood has a slope; its prior is centred on none.
        parameters[i] = dataclasses.replace(parameters[i], prior=(0.0, parameters[i].width))
    return dataclasses.replace(model, template=template, parameters=tuple(parameters))


def _groups(what: str, given: str | Sequence[str], instrument: Instrument) -> tuple[str, ...]:
    """The groups that are meant, each once."""
    cameras = instrument.cameras.names
    known = dict.fromkeys((ALL, "camera", *KINDS, *instrument.kinds, *cameras))
    names: list[str] = []
    for name in [given] if isinstance(given, str) else list(given):
        if name not in known:
            raise ValueError(f"[noise] {what} = {name!r} is no group of intensities; {nearest(name, known)}")
        names += cameras if name == "camera" else [name]
    return tuple(dict.fromkeys(names))


def noise_choices(instrument: Instrument) -> dict[str, list[str]]:
    """The groups of the noise terms of an instrument, as a model file states them; empty without terms."""
    noise = instrument.noise
    if noise is None:
        return {}
    stated = {"scale": list(noise.scales), "fraction": list(noise.fractions)}
    return {name: groups for name, groups in stated.items() if groups}
