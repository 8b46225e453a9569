"""What is known of the parameters before the data, as rows of a linear least-squares problem.

A free parameter has one row: its prior if it has one, else the weak pull to its start value, if it has that. A frozen
parameter has none, for it does not vary; nor has a tied one, whose value is that of another parameter: what is known of
that one is said there, and once.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int

from walop_jax.model.specification import Model

Vector = Float[np.ndarray, " k"]


@dataclasses.dataclass(frozen=True)
class PriorRows:
    """Rows (θ − mean) / width of the parameters at `index`; those that are not `known` are weak pulls."""

    index: Int[np.ndarray, " k"]
    mean: Vector
    width: Vector
    known: Bool[np.ndarray, " k"]

    def __len__(self) -> int:
        return len(self.index)

    def residuals(self, values: Float[np.ndarray, " n"]) -> Vector:
        """The rows at a full vector of values."""
        return (values[self.index] - self.mean) / self.width

    def jacobian(self, selection: Float[np.ndarray, "n f"]) -> Float[np.ndarray, "k f"]:
        """Derivatives of the rows with respect to the free parameters; `selection` is that of the model."""
        return selection[self.index] / self.width[:, None]


def prior_rows(model: Model) -> PriorRows:
    """All that a model says of its free parameters beforehand."""
    rows = []
    for i in model.free.tolist():
        p = model.parameters[i]
        if p.prior is not None:
            rows.append((i, *p.prior, True))
        elif p.loose is not None:
            rows.append((i, p.start, p.loose, False))
    index, mean, width, known = zip(*rows, strict=True) if rows else ((), (), (), ())
    return PriorRows(
        np.array(index, int), np.array(mean, float), np.array(width, float), np.array(known, bool)
    )
