"""Elements of the train: each maps a ray to the ray behind it, and has a Mueller matrix for that ray.

An element all of whose numbers are left at their defaults changes nothing. An element may move: `moves` is then the
prefix of its columns in EXPOSURES (`CHWP` for CHWP_IN and CHWP_ANGLE), its presence in the beam and its angle.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from walop_jax.io.text import with_minus_sign
from walop_jax.model.parameters import Component, Parameter
from walop_jax.model.ray import Ray

Mueller = Float[Array, "... 4 4"]


class Element(Component):
    """An element of the train; concrete ones are final.

    `declared` holds the parameters of the instrument among its numbers, by field. `path_difference` (µm) is the largest
    optical path between interfering waves: the wavelength nodes must follow its fringes.

    A reading is the number in `<P>_ANGLE` of an element that moves. `reading_unit` is its unit in print: "deg", or "V"
    for a voltage. `period` is the change of a reading after which the element acts as before: 360 for an angle in
    degrees, None for a reading that never repeats itself, such as a voltage. A class that writes `turned` or `position`
    anew and says nothing of unit and period has no unit and the period None, which is right for every reading.

    >>> class Dimmer(walop.Element):
    ...     "A filter that is grey."
    ...     density: walop.Scalar = walop.number("", "optical density")
    ...     kind = "dimmer"
    ...     def mueller(self, ray):
    ...         return 10.0 ** -self.density * np.eye(4)
    >>> Dimmer(density=1.0).mueller(None)[0, 0]
    Array(0.1, dtype=float64)
    """

    name: str = eqx.field(static=True, default="")
    moves: str | None = eqx.field(static=True, default=None)
    declared: tuple[tuple[str, Parameter], ...] = eqx.field(static=True, default=())

    kind: ClassVar[str] = ""
    reference: ClassVar[str] = ""
    period: ClassVar[float | None] = 360.0
    reading_unit: ClassVar[str] = "deg"

    def __init_subclass__(cls, **options: Any) -> None:
        """Nothing is known of unit and period of a class that gives readings a meaning of its own."""
        super().__init_subclass__(**options)
        own = vars(cls)
        if "turned" in own or "position" in own:
            cls.period = own.get("period")
            cls.reading_unit = own.get("reading_unit", "")

    @classmethod
    def reading_in_words(cls, reading: float) -> str:
        """A reading with its unit: 45°, 5 V, or the number alone."""
        text = with_minus_sign(f"{reading:g}")
        return f"{text}°" if cls.reading_unit == "deg" else f"{text} {cls.reading_unit}".rstrip()

    def ray(self, ray: Ray) -> Ray:
        """The ray behind the element."""
        return ray

    def mueller(self, ray: Ray) -> Mueller | None:
        """Mueller matrix for an entering ray, with a leading axis if it depends on wavelength; None: the identity."""
        return None

    @classmethod
    def solved(cls, cases: Sequence[tuple[Any, Ray]]) -> list[Mueller | None]:
        """Mueller matrices of several elements of this class, each for its ray, in the order of `cases`.

        A class overrides it where a joint solution is faster. One element at many angles is traced once: an instrument
        with many settings would take minutes otherwise.
        """
        result: list[Mueller | None] = [None] * len(cases)
        copies: dict[tuple[int, ...], list[int]] = {}  # of one element at different angles in the same ray
        for i, (element, ray) in enumerate(cases):
            values = [getattr(element, f.name) for f in dataclasses.fields(element) if f.name != "axis"]
            copies.setdefault((*map(id, values), id(ray)), []).append(i)
        for members in copies.values():
            element, ray = cases[members[0]]
            if len(members) == 1:
                result[members[0]] = element.mueller(ray)
                continue
            axes = jnp.stack([cases[i][0].axis for i in members])
            turned = jax.vmap(lambda axis, e=element, r=ray: dataclasses.replace(e, axis=axis).mueller(r))
            matrices = turned(axes)
            for place, i in enumerate(members):
                result[i] = None if matrices is None else matrices[place]
        return result

    def turned(self, angle: float) -> Self:
        """The element turned by `angle` (deg) from +X toward +Y. Raises TypeError if it has no `axis`."""
        if not hasattr(self, "axis"):
            raise TypeError(f"element {self.name!r} has no axis that could turn")
        return dataclasses.replace(self, axis=self.axis + jnp.asarray(angle, float))  # pyright: ignore

    def position(self, angle: float | None) -> float | None:
        """The true angle (deg) of the element for a reading `angle`; None when it is out of the beam."""
        return angle

    @property
    def path_difference(self) -> float:
        """Largest optical path (µm) between interfering waves in this element; 0 where none interfere."""
        return 0.0

    @property
    def materials(self) -> tuple[str, ...]:
        """Names of the materials whose refractive index this element uses, such as ("quartz", "mgf2")."""
        return ()

    def retardances(self, wavelength: Float[np.ndarray, " n"]) -> tuple[Float[np.ndarray, " n"], ...]:
        """Net retardance along the fast axis at some wavelengths (µm), in waves, and the sum over all layers of its
        magnitude.

        An empty tuple comes back if the element makes no fringes. The net retardance of crossed layers interferes at
        full strength; single layers interfere for oblique rays alone, hundreds of times more weakly.
        """
        return ()
