"""The truth of a simulated set: its file (TRUTH.json), and further nights of the same instrument."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from walop_jax.data.records import Sources
from walop_jax.instruments.description import parsed
from walop_jax.io.errors import PathLike, errors_naming, fail
from walop_jax.io.text import read_text
from walop_jax.model.dependence import left_behind
from walop_jax.model.effects import EFFECTS, EffectKind, effect_by_name
from walop_jax.model.effects.base import Effect
from walop_jax.model.elements.registry import defined_elements
from walop_jax.model.instrument import Instrument, adapted, build
from walop_jax.model.parameters import leaves, with_values
from walop_jax.model.standards import standards_of
from walop_jax.simulation.observing_plan import ObservingPlan, plan_of_document
from walop_jax.simulation.simulate import LEVEL, Simulated, truth_values

_CATALOGUE = {field.name for field in dataclasses.fields(Sources)}


@dataclasses.dataclass(frozen=True)
class Template:
    """What all nights of one simulated instrument have in common: the instrument, and the catalogue of its standards.

    `plan` is the plan that it was simulated with, if there was one.
    """

    instrument: Instrument
    catalogue: Sources
    plan: ObservingPlan | None = None

    def planned(self, plan: ObservingPlan | None) -> ObservingPlan:
        """A plan for a night (None: that of the template, or the usual one), checked."""
        stars = len(np.unique(self.catalogue.stars))
        if plan is None:
            return self.plan or dataclasses.replace(ObservingPlan.usual(self.instrument), standards=stars)
        if plan.name != self.instrument.name:
            raise ValueError(
                f"the plan is for {plan.name}, the instrument to simulate is {self.instrument.name}"
            )
        if plan.standards > stars:
            raise ValueError(
                f"the plan has {plan.standards} standards, the catalogue {stars}: give fewer standards"
            )
        return plan

    def instrument_of(
        self, plan: ObservingPlan, effects: Sequence[Effect] = ()
    ) -> tuple[Instrument, tuple[str, ...]]:
        """The instrument on another night, and the names of the effects that belong to the exposures of the first.

        An effect of the same name replaces that of the template.
        """
        replaced = {effect.name for effect in effects}
        lost = () if plan == self.plan else left_behind(self.instrument)
        applicable = tuple(e for e in self.instrument.effects if e.name not in {*replaced, *lost})
        return dataclasses.replace(self.instrument, effects=applicable), tuple(
            n for n in lost if n not in replaced
        )

    @classmethod
    def of(cls, simulated: Simulated) -> Template:
        """The template of a simulated night."""
        return cls(simulated.truth, simulated.calset.sources)


def truth_document(plan: ObservingPlan, seed: int, sources: Sources, truth: Instrument) -> dict[str, Any]:
    """Truth of a simulated set as plain data: plan, effects, catalogue, the true value of every parameter."""
    units = {leaf.name: leaf.unit for leaf in leaves(truth)}
    description = plan.design.description
    return {
        "instrument": plan.name,
        **({"description": description} if description else {}),
        "seed": seed,
        "plan": plan.document(),
        "effects": {effect.name: effect.choices() for effect in truth.effects},
        "catalogue": {name: getattr(sources, name).tolist() for name in sorted(_CATALOGUE)},
        "parameters": {
            name: {"value": value, "unit": units[name]} for name, value in truth_values(truth).items()
        },
    }


def read_truth(path: PathLike, effects: Sequence[EffectKind] = EFFECTS) -> Template:
    """The template that a file of `truth_document` describes; `DataError` for any other file."""
    text = read_text(path)
    try:
        content = json.loads(text)
        plan, names, values = content["plan"], content["effects"], content["parameters"]
        catalogue = content["catalogue"]
    except (ValueError, KeyError, TypeError):
        advice = (
            "give the file that walop-jax simulate --truth wrote (with its catalogue, which older ones lack)"
        )
        raise fail("is not the truth of a simulated set", file=path, advice=advice) from None
    with errors_naming(path):
        if description := content.get("description"):
            where = f"the description of {content['instrument']}"
            design = build(parsed(description, where), elements=defined_elements())
        else:
            design = Instrument.read(content["instrument"])
        observing_plan = plan_of_document(plan, design)
        sources = Sources(**{name: np.asarray(catalogue[name]) for name in _CATALOGUE})
        standards = standards_of(sources, observing_plan.exposures(), observing_plan.curves())
        bare = adapted(
            design, throughput_degree=observing_plan.throughput_degree, throughput=LEVEL
        ).with_source(standards)
        context = observing_plan.context()._replace(sources=standards.star_names)
        active = []  # with their discrete choices; numbers are put in later
        for name, choices in names.items():
            stated = {k: tuple(value) if isinstance(value, list) else value for k, value in choices.items()}
            active.append(effect_by_name(name, tuple(effects)).of(context, **stated))
        template = dataclasses.replace(bare, effects=tuple(active))
        order = [leaf.name for leaf in leaves(template)]
        if set(order) != set(values):
            raise ValueError(
                "its parameters are not those of its instrument and effects (give the --effects of it)"
            )
        numbers = np.array([values[name]["value"] for name in order], float)
        return Template(with_values(template)(numbers), sources, observing_plan)
