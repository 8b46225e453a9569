"""Instruments: a light path with its place and its field, and its construction from a description."""

from __future__ import annotations

import dataclasses
import itertools
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from walop_jax.instruments.description import (
    NO_SOURCE,
    Description,
    Reader,
    default_name,
    described,
    read_description,
    shipped,
)
from walop_jax.io.errors import PathLike
from walop_jax.model import fold, legendre
from walop_jax.model.build import parts, with_origins
from walop_jax.model.compiled import array, need_float64
from walop_jax.model.conventions import REFERENCE_WAVELENGTH, Units
from walop_jax.model.elements.base import Element
from walop_jax.model.elements.simple import Analyser, Polariser
from walop_jax.model.elements.wave_plate import MODELS, WavePlate
from walop_jax.model.light_path import Arm, LightPath
from walop_jax.model.noise import Noise
from walop_jax.model.parameters import check_names, leaves
from walop_jax.model.ray import Conditions, Ray
from walop_jax.model.sources import SOURCES, Source, Standards

PLATE_MODELS = tuple(MODELS)
STAR = tuple[str, float, float]
TAKEN = ("throughput", "cameras", "effects", "noise")
"""Names of other parts of an instrument."""

NAN = float("nan")
NO_SITE = ("", NAN, NAN, NAN, NAN)


class Instrument(LightPath):
    """A light path with its place and its field.

    Field coordinates reach to ±`field_limit` (deg); `site` is telescope, latitude and longitude (deg, east positive),
    elevation (m) and MJD of a full Moon, `raster` the arrangement of the points of a simulated run and its half width
    (deg). `description` is the text of its description, empty for a shipped instrument, `source` the origin of its
    numbers; colours and fringes are relative to `wavelength` (µm). `noise` are the terms of the errors of its data that
    a fit finds; None: the errors are as stated.

    >>> walop.Instrument.read("WALOP-NORTH").cameras.names
    ('O1', 'E1', 'O2', 'E2')
    """

    field_limit: float = eqx.field(static=True, default=90.0)
    site: tuple[str, float, float, float, float] = eqx.field(static=True, default=NO_SITE)
    raster: tuple[str, float] = eqx.field(static=True, default=("square", 0.0))
    description: str = eqx.field(static=True, default="", repr=False)
    source: str = eqx.field(static=True, default="", repr=False)
    wavelength: float = eqx.field(static=True, default=REFERENCE_WAVELENGTH)
    noise: Noise | None = None

    def __repr__(self) -> str:
        arms = "; ".join(f"{arm.name}: {' > '.join(arm.path)}" for arm in self.arms)
        effects = f"; effects: {', '.join(effect.name for effect in self.effects)}" if self.effects else ""
        return (
            f"Instrument {self.name}, cameras {', '.join(self.cameras.names)}\n"
            f"  light path  {' > '.join(self.path)}\n  arms        {arms}{effects}"
        )

    @classmethod
    def read(cls, source: PathLike, **options: Any) -> Instrument:
        """The instrument of a description file, or a shipped one by name; options as for `build`.

        Raises `DataError`, with file, table and key, for an invalid file.
        """
        return build(read_description(source), **options)

    @property
    def units(self) -> Units:
        """The scales of this instrument, in which changes over its field (deg) and its bands (µm) are counted."""
        return Units(self.throughput.scale, self.wavelength)

    def mueller(
        self,
        x: ArrayLike,
        y: ArrayLike,
        wavelength: ArrayLike,
        angles: Mapping[str, float] | None = None,
        **conditions: Any,
    ) -> Float[Array, "k *w 4 4"]:
        """Mueller matrices (camera, wavelength, 4, 4) of the light path behind the polariser and ahead of the
        analysers.

        The first call compiles a program, which takes some seconds; further calls take milliseconds. Differentiable in
        field position (deg), wavelength (µm) and the numbers of the instrument. `angles` (deg) are the angles of moving
        elements in the beam, by the prefix of their columns ({"CHWP": 45.0}); the others are out. `conditions` are the
        relevant ones of `ray.CONDITIONS` (temperature in Celsius, hour_angle in h). Raises ValueError for an unknown
        moving element, `NotPlannedError` for a missing condition, and RuntimeError when float64 is switched off.
        """
        need_float64("the Mueller matrix")
        instrument, angles = self.patched(), dict(angles or {})
        moving = instrument.moving()
        check_names("moving element", angles, moving)
        nodes = jnp.atleast_1d(jnp.asarray(wavelength, float))
        planned = {name: jnp.full_like(nodes, value) for name, value in conditions.items()}
        ray = Ray.entering(
            jnp.asarray(x, float), jnp.asarray(y, float), (nodes, Conditions(jnp.zeros_like(nodes), planned))
        )
        setting = tuple(angles.get(prefix) for prefix in moving)
        path = fold.Fold.of(instrument.behind_polariser(), instrument.arms, ray, moving, [setting])
        ahead, *inside = path.in_first_setting()
        of_arm = []
        for behind in inside:
            matrix = fold.product((*ahead, *behind))
            matrix = jnp.eye(4) if matrix is None else matrix
            of_arm.append(jnp.broadcast_to(matrix, (len(nodes), 4, 4)).reshape(*jnp.shape(wavelength), 4, 4))
        place = {camera: i for i, arm in enumerate(instrument.arms) for camera in arm.analyser.cameras}
        return jnp.stack([of_arm[place[camera]] for camera in instrument.cameras.names])


# ------------------------------------------------------------------------------------ from a description


def build(description: Description, *, elements: Sequence[type[Element]] = (), **options: Any) -> Instrument:
    """The instrument of a description, at the values of the description; options as for `adapted`.

    `elements` are further kinds of elements for the description. Raises `DataError`, with table and key, for unknown
    elements and for elements without effect at their places.
    """
    common, arms, throughput, cameras = parts(description, elements)
    all_elements = (*common, *(element for _, inside, _ in arms for element in inside))
    instrument = Instrument(
        name=description.name,
        sources=sources(),
        elements=common,
        arms=tuple(Arm(*arm) for arm in arms),
        throughput=throughput,
        cameras=cameras,
        path=description.path,
        field_limit=description.field_limit,
        site=description.place,
        raster=(description.raster, description.edge),
        description="" if description.name in shipped() else with_origins(description.text, all_elements),
        wavelength=description.wavelength or REFERENCE_WAVELENGTH,
        source=description.source if description.source != NO_SOURCE else "",
    )
    _check(instrument, description.read)
    return adapted(instrument, **options)


def adapted(
    instrument: Instrument,
    *,
    standards: Standards | Sequence[STAR] = (),
    plates: str | None = None,
    throughput_degree: int | None = None,
    throughput: float | None = None,
) -> Instrument:
    """An instrument for the data at hand.

    `standards` are (name, q, u) in the equatorial frame, or the source itself; `plates` is the model of the wave
    plates, `throughput_degree` that of the series, `throughput` the level of all cameras; None keeps those of the
    instrument. Raises ValueError for an unknown plate model.
    """
    instrument = instrument.with_source(_standards(standards))
    if plates is not None:
        if plates not in PLATE_MODELS:
            raise ValueError(f"there is no plate model {plates!r}: choose one of {', '.join(PLATE_MODELS)}")
        for place in instrument.places(WavePlate):
            instrument = instrument.changed(place, model=plates)
    series = instrument.throughput
    degree = series.degree if throughput_degree is None else throughput_degree
    level = np.asarray(series.coefficients)[:, 0] if throughput is None else throughput
    coefficients = np.zeros((len(instrument.cameras), len(legendre.terms(degree))))
    coefficients[:, 0] = level
    return dataclasses.replace(
        instrument, throughput=dataclasses.replace(series, degree=degree, coefficients=array(coefficients))
    )


def as_designed(instrument: Instrument) -> Instrument:
    """The instrument without effects and terms of the errors: models add them."""
    return dataclasses.replace(instrument, effects=(), noise=None)


def nominal_instrument(name: str | None = None, **options: Any) -> Instrument:
    """A shipped instrument as designed (default: the first of the family); options as for `build`."""
    return build(described(name or default_name()), **options)


def sources() -> tuple[Source, ...]:
    """The sources that every instrument has: moonlit sky, standards, light through the polariser, lamps, known flux."""
    return tuple(_standards(()) if kind is Standards else kind() for kind in SOURCES)


def _standards(stars: Standards | Sequence[STAR]) -> Standards:
    if isinstance(stars, Standards):
        return stars
    names, q, u = zip(*stars, strict=True) if stars else ((), (), ())
    return Standards(names=tuple(names), q=array(np.array(q, float)), u=array(np.array(u, float)))


def _check(instrument: Instrument, read: Reader) -> None:
    """Raise `DataError` for a part without effect at its place, and for a duplicate name."""
    for element in instrument.elements:
        if isinstance(element, Analyser):
            raise read.fault(
                f"elements.{element.name}", "an analyser ends an arm: move it to the path of one"
            )
    polarisers = [element.name for element in instrument.train() if isinstance(element, Polariser)]
    if len(polarisers) > 1:
        raise read.fault(f"elements.{polarisers[1]}", "is a second polariser; only one is allowed")
    for arm in instrument.arms:
        for element in arm.train():
            if isinstance(element, Analyser | Polariser):
                where = "ends its arm" if isinstance(element, Analyser) else "must be ahead of the arms"
                raise read.fault(f"arms.{arm.name}.elements.{element.name}", f"a {element.kind} {where}")
    components = itertools.chain(instrument.sources, instrument.elements, instrument.arms)
    for name, count in Counter([*(component.name for component in components), *TAKEN]).items():
        if count > 1:
            raise read.fault(name, "more than one part of the instrument has this name; give it another one")
    for name, count in Counter(parameter.name for parameter in leaves(instrument)).items():
        if count > 1:
            raise read.fault("", f"{count} parameters have the name {name!r}; give them different ones")
    try:
        instrument.telescope()
    except ValueError as error:
        raise read.fault("elements", str(error)) from None
