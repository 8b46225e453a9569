"""Discrete choices: which description of the instrument explains the data, where the one given does not.

1. Every change that the instrument has a place for (`model/alternatives.py`) is put into the residuals at two places,
   the fitted values and the start values: a description that is badly wrong has bent the fit. What the free parameters
   could absorb of them, at the slopes of the description given, is projected out, priors included (one Gauss–Newton
   step). Nothing is fitted; a sample of the field points is enough.
2. The few that leave least are fitted, all parameters with them, and other curves of dispersion in any case: plates
   grow to make up for those, by more than one step can tell. Their evidence against the description given is half
   the gain in χ² less the logarithm of the number of changes that were looked at.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import Float

from walop_jax.diagnosis import naming
from walop_jax.diagnosis.design import Design
from walop_jax.diagnosis.findings import Choice
from walop_jax.diagnosis.policy import Policy
from walop_jax.fit.refit import FitResult
from walop_jax.likelihood import limits
from walop_jax.likelihood.layout import thinned
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.alternatives import JOINED, alternatives, other_curves
from walop_jax.model.effects import Context, OtherDescription
from walop_jax.model.specification import Model, with_effects

NO_DIFFERENCE = 1e-6  # change of the residuals, in standard deviations, that is none
Vector = Float[np.ndarray, " n"]


@dataclasses.dataclass(frozen=True)
class _Screened:
    sentence: str
    left: float
    start: Vector


def described_otherwise(model: Model, sentence: str, context: Context) -> Model:
    """The model of the instrument changed as a sentence says, on top of what has been changed before."""
    name = OtherDescription.name
    if name in model.effect_names:
        before = model.template.effect(name)
        assert isinstance(before, OtherDescription)
        sentence, model = f"{before.change}{JOINED}{sentence}", naming.model_without(model, name)
    return with_effects(model, [OtherDescription(change=sentence)], context)


class Choices:
    """All changes of the description of one fit: first screened, then the best of them fitted."""

    def __init__(
        self,
        result: FitResult,
        context: Context,
        policy: Policy,
        going_on: Callable[[], bool],
        tell: Callable[[str], None],
        *,
        all_of_them: bool = True,
    ) -> None:
        self.result, self.context, self.policy = result, context, policy
        self.going_on, self.tell = going_on, tell
        template = dataclasses.replace(result.model.template, effects=())
        if OtherDescription.name in result.model.effect_names:
            described = result.model.template.effect(OtherDescription.name)
            template = described.patch(template)
        self.curves = other_curves(template)
        # What is turned, exchanged or left out changes the light by per cents: nothing of that kind is a small misfit.
        self.sentences = tuple(alternatives(template)) if all_of_them else self.curves
        self.tried: dict[str, Choice] = {}

    def trials(self) -> Iterator[naming.Trial]:
        """The best changes, fitted."""
        for one in self._leaders():
            if not self.going_on():
                return
            self.tell(f"trying another description: {one.sentence}")
            trial = self._fitted(one)
            if trial is None:
                continue
            assert trial.fit is not None
            gain = self.result.posterior.objective - trial.fit.posterior.objective
            scale = self.result.noise_scale**2
            self.tried[one.sentence] = dataclasses.replace(
                self.tried[one.sentence], better_by=float(gain * scale)
            )
            yield trial

    def _fitted(self, one: _Screened) -> naming.Trial | None:
        model = described_otherwise(self.result.model, one.sentence, self.context)
        try:
            return naming.try_model(self.result, OtherDescription, model, one.start, len(self.sentences))
        except ValueError:  # a free parameter of what was left out has no prior: nothing holds it
            return None

    def _leaders(self) -> list[_Screened]:
        self.tell(f"comparing {len(self.sentences)} other descriptions")
        every = max(1, limits.CHOICE_ROWS // max(len(self.result.calset.exposures), 1))
        calset = thinned(self.result.calset, every, neighbours=1)
        places = [self._design(calset, values) for values in (self.result.values, self._from_start())]
        given = float(np.sum(places[0].projector(places[0].residual) ** 2))
        found = []
        for sentence in self.sentences:
            if not self.going_on():
                break
            if (one := self._screened(sentence, places, given)) is not None:
                found.append(one)
                self.tried[sentence] = Choice(sentence, one.left)
        found.sort(key=lambda one: one.left)
        promising = [one for one in found if (1.0 - one.left) * given > self.policy.least_gain]
        promising = promising[: self.policy.descriptions_fitted]
        curves = [one for one in found if one.sentence in self.curves and one not in promising]
        return [*promising, *curves]

    def _from_start(self) -> Vector:
        """Start values, of effects as they have been fitted."""
        model, values = self.result.model, self.result.model.start.copy()
        for name in model.effect_names:
            values[model.positions(name)] = self.result.values[model.positions(name)]
        return values

    def _design(self, calset: object, values: Vector) -> Design:
        likelihood = Likelihood.of(calset, self.result.model)  # pyright: ignore[reportArgumentType]
        return Design.of(dataclasses.replace(self.result, likelihood=likelihood, values=values))

    def _screened(self, sentence: str, places: list[Design], given: float) -> _Screened | None:
        """What a change leaves at the better of the places; None where it changes nothing."""
        calset = places[0].fit.calset
        model = described_otherwise(self.result.model, sentence, self.context)
        likelihood, best = Likelihood.of(calset, model), None
        for design in places:
            rows = design.residual.copy()
            residual = likelihood.residuals(design.fit.values, once=True)[1][design.measured.used].reshape(-1)
            rows[: design.rows] = residual / design.fit.noise_scale
            if np.abs(rows - design.residual).max() < NO_DIFFERENCE:
                return None
            left = float(np.sum(design.projector(rows) ** 2)) / given
            if np.isfinite(left) and (best is None or left < best.left):
                best = _Screened(sentence, left, design.fit.values)
        return best
