"""The model of a calibration set: the base model changed by a model file, or a model like that of another set."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from walop_jax.data.records import CalibrationSet
from walop_jax.fit.base_model import SKY_AND_STARS, base_model
from walop_jax.fit.model_file import EffectCatalogue, ModelTable, header_of, known_to, parse, with_effects_of
from walop_jax.io.display import Display, Displayed
from walop_jax.io.text import with_error, with_minus_sign
from walop_jax.model.effects import EFFECTS, Deviations
from walop_jax.model.effects.in_models import effect_context, known_effects, model_without
from walop_jax.model.instrument import Instrument
from walop_jax.model.specification import GAUGE, THROUGHPUT, Model


def model_for(
    calset: CalibrationSet,
    text: str = "",
    instrument: Instrument | None = None,
    catalogue: EffectCatalogue = EFFECTS,
) -> Model:
    """The base model of a calibration set, changed by a model file (TOML text); `instrument` as for `base_model`.

    `catalogue` are the effects that the file may name.
    Raises ValueError for anything in the text that does not exist or does not fit the data.
    """

    def build(header: ModelTable) -> Model:
        model = base_model(calset, instrument, **header.of_instrument())
        model = dataclasses.replace(model, catalogue=known_to(header, catalogue))
        return with_effects_of(model, header, effect_context(model.template, calset.exposures))

    return parse(text, build)


def model_like(calset: CalibrationSet, old: Model) -> Model:
    """The model `old` for another calibration set: its plates, effects, priors, ties and fixed parameters.

    Sky and standards are those of the new set. Deviations from descriptions, whose hundreds of parameters no fit of
    one set constrains, are left out. Raises ValueError for a set of another instrument.
    """
    if Deviations.name in old.effect_names:
        old = model_without(old, Deviations.name)
    header = header_of(old)
    model = base_model(calset, old.template, **header.of_instrument())
    own_kinds = dict.fromkeys((*(effect.kind for effect in old.template.effects), *known_effects(old)))
    model = dataclasses.replace(model, catalogue=tuple(own_kinds))
    model = with_effects_of(model, header, effect_context(model.template, calset.exposures))
    unchanged = {p.name: p for p in old.parameters if p.name != GAUGE and p.part not in SKY_AND_STARS}
    parameters = []
    for p in model.parameters:
        if (like := unchanged.get(p.name)) is not None:
            start = p.start if like.free else like.start
            p = dataclasses.replace(p, start=start, free=like.free, prior=like.prior, tie=like.tie)
        parameters.append(p)
    return dataclasses.replace(model, parameters=tuple(parameters), laws=old.laws)


@dataclasses.dataclass(frozen=True, repr=False)
class ModelFile(Displayed):
    """A model, its TOML text, and the file that it was written to (None: to no file)."""

    model: Model
    text: str
    path: Path | None

    def document(self) -> dict[str, Any]:
        """The model file as plain data, for `--json`."""
        keys, model = ("start", "unit", "prior", "free", "tie", "about"), self.model
        document = {"instrument": model.name, "effects": list(model.effect_names)}
        document |= {"output": None if self.path is None else str(self.path)}
        return document | {"parameters": {p.name: {k: getattr(p, k) for k in keys} for p in model.parameters}}

    def display(self) -> Display:
        """Its file and its size, and all its parameters but the terms of the throughput, those of standards last."""
        where = self.model.name if self.path is None else self.path
        parameters, free = self.model.parameters, len(self.model.free)
        rows = tuple(
            (p.name, with_minus_sign(f"{p.start + 0.0:.6g}"), p.unit, prior, p.freedom, p.about)
            for p in sorted(parameters, key=lambda p: p.name.startswith("standard."))
            for prior in ("" if p.prior is None else with_error(p.prior[0] + 0.0, p.prior[1]),)
            if p.part != THROUGHPUT
        )
        hidden = len(self.model.positions(THROUGHPUT))
        note = (f"{hidden} throughput terms not shown; model.to_table() has them",) if hidden else ()
        head = ("parameter", ">start", "unit", "prior", "", "meaning")
        return Display(f"{where}: {len(parameters)} parameters, {free} of them free", (), head, rows, note)
