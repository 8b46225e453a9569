"""Models from data, from a model file, or from neither: the one place where the three come together."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from walop_jax.data.records import CalibrationSet
from walop_jax.fit.model_file import Header, parse
from walop_jax.likelihood.problem import base_model
from walop_jax.model.build import nominal_instrument
from walop_jax.model.effects import Context, effect_by_name
from walop_jax.model.parameters import unknown_name
from walop_jax.model.specification import Model, effect_context, make_model, with_effects

DEFAULT_PLATES = "waves"
DEFAULT_DEGREE = 4
GAUGE = "throughput.n0.p00"


def model_for(calset: CalibrationSet, text: str = "") -> Model:
    """The base model of a calibration set, changed as a model file (TOML text) says.

    Raises ValueError for anything in the text that does not exist or does not fit the data.
    """

    def build(header: Header) -> Model:
        model = base_model(calset, plates=_plates(header), throughput_degree=_degree(header))
        context = effect_context(model.template, calset.exposures)
        return _with_effects(model, header, context)

    return parse(text, build)


def model_without_data(
    instrument: str,
    text: str = "",
    *,
    standards: Sequence[tuple[str, float, float]] = (),
    context: Context | None = None,
) -> Model:
    """The model of an instrument as designed, for no data in particular.

    `standards` are (name, q, u); `context` says what effects that grow with the data need to know of them.
    Raises ValueError for an unknown instrument and as `model_for` does.
    """
    if instrument not in shipped():
        raise unknown_name("instrument", instrument, shipped())

    def build(header: Header) -> Model:
        nominal = nominal_instrument(
            instrument, standards=standards, plates=_plates(header), throughput_degree=_degree(header)
        )
        model = make_model(instrument, nominal, frozen=(GAUGE,))
        return _with_effects(model, header, context or Context(sources=nominal.standard.names))

    return parse(text, build)


def _plates(header: Header) -> str:
    return DEFAULT_PLATES if header.plates is None else header.plates


def _degree(header: Header) -> int:
    return DEFAULT_DEGREE if header.throughput_degree is None else header.throughput_degree


def _with_effects(model: Model, header: Header, context: Context) -> Model:
    effects: list[Any] = []
    for name in header.effects:
        choices: Mapping[str, Any] = header.choices.get(name, {})
        kind = effect_by_name(name)
        effects.append(kind.of(context, **choices) if choices else name)
    return with_effects(model, effects, context) if effects else model


def effects_text(names: Sequence[str]) -> str:
    """The model file that adds effects by name and changes nothing else."""
    return f"[model]\neffects = {json.dumps(list(names))}\n" if names else ""
