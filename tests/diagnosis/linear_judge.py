"""The judge of the search that fits nothing, for thousands of scenes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from walop_jax.diagnosis.exact import Trial


class Linear:
    """Judge of trials by their linear steps; nothing is held out and no time runs. `workflow.Refit` fits instead."""

    def time_left(self) -> bool:
        """True if another trial may begin."""
        return True

    def fitted(self, state: Any, trial: Trial) -> Trial | None:
        """A linear trial as the judge finds it; None where nothing comes of it."""
        return trial

    def others(self, state: Any) -> Iterator[Trial]:
        """Trials of what has no linear step."""
        return iter(())

    def decided(self, trials: list[Trial]) -> list[Trial]:
        """Trials, best first, with those of even odds in their order."""
        return trials

    def confirmed(self, state: Any, trial: Trial) -> bool:
        """True, for want of data that took no part in a trial: a score space has no rows."""
        return True

    def adopted(self, state: Any, trial: Trial) -> Any:
        """The evidence of what is left once a trial has joined the model."""
        assert trial.item is not None
        return state.joined(trial.item)
