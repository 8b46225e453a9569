"""An instrument as described, checked: every element made, and light sent through it."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from walop_jax.calibration.matrix import point_vectors
from walop_jax.fit.model_file import model_without_data
from walop_jax.io.display import Display, Displayed
from walop_jax.io.errors import DataError, PathLike
from walop_jax.model.dependence import needs, optical_indices
from walop_jax.model.elements.registry import defined_elements
from walop_jax.model.elements.simple import Retarder
from walop_jax.model.elements.spectral import SpectralElement
from walop_jax.model.elements.wave_plate import WavePlate
from walop_jax.model.instrument import Instrument
from walop_jax.model.plan import Plan, blank_plan
from walop_jax.model.ray import Ray
from walop_jax.model.specification import THROUGHPUT, Model

OFF_AXIS = 0.9  # of the field limit, where the optics are tried
LARGEST_FIELD = 0.3  # deg: beyond, a description does not cover the optics


@dataclasses.dataclass(frozen=True, repr=False)
class CheckedInstrument(Displayed):
    """An instrument with the model of its parameters; `train` and `arms` name elements in the order light meets them.

    `optical` are the parameters that enter the band integral, `conditions` the conditions of an exposure that the
    optics need, `retardance` the retardance of every plate by its place (waves, folded to 0 … ½), for 0.62 µm along the
    normal.
    """

    instrument: Instrument
    model: Model
    train: tuple[str, ...]
    arms: dict[str, tuple[str, ...]]
    moving: tuple[str, ...]
    optical: tuple[str, ...]
    conditions: tuple[str, ...]
    retardance: dict[str, float]

    def document(self) -> dict[str, Any]:
        """The instrument as plain data, for `--json`."""
        return {
            "name": self.instrument.name,
            "cameras": list(self.instrument.cameras.names),
            "train": list(self.train),
            "arms": {name: list(path) for name, path in self.arms.items()},
            "moving": list(self.moving),
            "conditions": list(self.conditions),
            "retardance": self.retardance,
            "field_limit": self.instrument.field_limit,
            "parameters": {
                p.name: {key: getattr(p, key) for key in ("start", "unit", "prior", "source")}
                | {"optical": p.name in self.optical}
                for p in self.model.parameters
            },
        }

    def display(self) -> Display:
        """The light path and the parameters, but for the coefficients of the throughput."""
        design = self.instrument
        shown = [p for p in self.model.parameters if p.part != THROUGHPUT]
        path = [("light path", " > ".join((*self.train, *(("arms",) if len(self.arms) > 1 else ()))))]
        path += [(f"  {name}", " > ".join(elements)) for name, elements in self.arms.items()]
        moving = ", ".join(f"{prefix}_IN, {prefix}_ANGLE" for prefix in self.moving)
        path.append(("moves", moving or "nothing"))
        path += [(place, f"retards by {w:.3f} waves at 0.62 um") for place, w in self.retardance.items()]
        return Display(
            title=f"{design.name}: {len(design.cameras)} cameras ({', '.join(design.cameras.names)})",
            facts=(*path, ("field", f"to {design.field_limit:g} deg")),
            head=("parameter", ">start", "prior", "unit", "about"),
            rows=tuple(
                (p.name, f"{p.start:g}", "free" if p.prior is None else f"± {p.prior[1]:g}", p.unit, p.about)
                for p in shown
            ),
            notes=(f"and {len(self.model.parameters) - len(shown)} coefficients of the throughput",),
        )


def checked(source: PathLike) -> CheckedInstrument:
    """Read an instrument and send light through it; see `walop_jax.instrument` for errors."""
    design = Instrument.read(source, elements=defined_elements())
    requirements = needs(design)
    plan = blank_plan(design, requirements.conditions, requirements.median)
    edge = OFF_AXIS * min(design.field_limit, LARGEST_FIELD)
    for x, y in ((0.0, 0.0), (edge, -edge)):
        vectors = np.asarray(jax.jit(point_vectors)(design, plan, jnp.asarray(x), jnp.asarray(y)))
        if not np.isfinite(vectors).all():
            raise DataError(f"{design.name}: the optics are not finite at ({x:g}, {y:g}) deg")
        # A camera gives no less than nothing for any light, if its vector is longer in I than in (Q, U, V).
        if np.any(np.linalg.norm(vectors[:, :, 1:], axis=2) > vectors[:, :, 0] * (1.0 + 1e-9)):
            raise DataError(f"{design.name}: a camera would count less than nothing at ({x:g}, {y:g}) deg")
    model = model_without_data(design)
    return CheckedInstrument(
        instrument=design,
        model=model,
        train=design.path,
        arms={arm.name: arm.path for arm in design.arms},
        moving=design.moving(),
        optical=tuple(model.names[i] for i in optical_indices(model.template)),
        conditions=tuple(sorted(requirements.conditions)),
        retardance=_retardance(design, plan),
    )


def _retardance(design: Instrument, plan: Plan) -> dict[str, float]:
    """Retardances of all plates (waves) from the circular part of their Mueller matrix, free of rotation and losses."""
    axis, retardances = jnp.zeros(()), {}
    ray = Ray.entering(axis, axis, (plan.wavelength, plan.conditions))
    for kind in (Retarder, SpectralElement, WavePlate):
        for place in design.places(kind):
            if (matrix := design.element(place).mueller(ray)) is not None:
                row = np.reshape(matrix, (-1, 4, 4))[0, 3]
                retardances[place] = float(np.arctan2(np.hypot(row[1], row[2]), row[3]) / (2.0 * np.pi))
    return retardances
