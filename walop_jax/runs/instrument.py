"""An instrument from its description: what it is made of, and whether light goes through it as it should."""

from __future__ import annotations

import dataclasses
import os
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from walop_jax.fit.model_builder import model_without_data
from walop_jax.io.errors import DataError
from walop_jax.model import light
from walop_jax.model.build import nominal_instrument
from walop_jax.model.dependence import needs, optical_indices
from walop_jax.model.instrument import Instrument
from walop_jax.model.plan import blank_plan
from walop_jax.model.specification import Model

_OFF_AXIS = 0.9  # of the field limit, where the optics are tried
_LARGEST_FIELD = 0.3  # deg: beyond, a description says nothing of the optics


@dataclasses.dataclass(frozen=True)
class CheckedInstrument:
    """An instrument with the model of its parameters; `train` and `arms` name elements in the order light meets them.

    `optical` are the parameters that enter the band integral, `conditions` what the optics ask of an exposure.
    """

    instrument: Instrument
    model: Model
    train: tuple[str, ...]
    arms: dict[str, tuple[str, ...]]
    moving: tuple[str, ...]
    optical: tuple[str, ...]
    conditions: tuple[str, ...]

    def document(self) -> dict[str, Any]:
        """Everything as plain data."""
        return {
            "name": self.instrument.name,
            "cameras": list(self.instrument.cameras.names),
            "train": list(self.train),
            "arms": {name: list(path) for name, path in self.arms.items()},
            "moving": list(self.moving),
            "conditions": list(self.conditions),
            "field_limit": self.instrument.field_limit,
            "parameters": {
                p.name: {
                    "start": p.start,
                    "unit": p.unit,
                    "prior": None if p.prior is None else list(p.prior),
                    "source": p.source,
                    "optical": p.name in self.optical,
                }
                for p in self.model.parameters
            },
        }


def check_instrument(source: str | os.PathLike[str] | None = None) -> CheckedInstrument:
    """Read an instrument (a shipped one by name, or a description file) and send light through it.

    Raises `DataError` for a description that is wrong, and for optics that are not finite or give more light than
    came in.
    """
    instrument = nominal_instrument() if source is None else Instrument.read(source)
    asked = needs(instrument)
    plan = blank_plan(instrument, asked.conditions, asked.median)
    edge = _OFF_AXIS * min(instrument.field_limit, _LARGEST_FIELD)
    for x, y in ((0.0, 0.0), (edge, -edge)):
        vectors = np.asarray(jax.jit(_vectors)(instrument, plan, jnp.asarray(x), jnp.asarray(y)))
        if not np.isfinite(vectors).all():
            raise DataError(f"{instrument.name}: the optics are not finite at ({x:g}, {y:g}) deg")
        # A camera gives no less than nothing for any light, if its vector is longer in I than in (Q, U, V).
        if np.any(np.linalg.norm(vectors[:, :, 1:], axis=2) > vectors[:, :, 0] * (1.0 + 1e-9)):
            raise DataError(
                f"{instrument.name}: a camera would count less than nothing at ({x:g}, {y:g}) deg"
            )
    model = model_without_data(instrument)
    return CheckedInstrument(
        instrument=instrument,
        model=model,
        train=instrument.path,
        arms={arm.name: arm.path for arm in instrument.arms},
        moving=instrument.moving(),
        optical=tuple(model.names[i] for i in optical_indices(model.template)),
        conditions=tuple(sorted(asked.conditions)),
    )


def _vectors(instrument: Instrument, plan: Any, x: jax.Array, y: jax.Array) -> jax.Array:
    rows = light.band_rows(instrument, plan, x, y)
    return light.camera_vectors(instrument, rows, light.throughput_at(instrument, x, y), x, y)
