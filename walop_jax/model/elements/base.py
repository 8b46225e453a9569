"""Elements of the train: each maps a ray to a ray and has a Mueller matrix for it.

An element is neutral when it is made without numbers. It may move: `moves` is the prefix of its columns in EXPOSURES
(`CHWP` for CHWP_IN and CHWP_ANGLE), which say whether it stands in the beam and at what angle.
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

from walop_jax.model.parameters import Component, Parameter
from walop_jax.model.ray import Ray

Mueller = Float[Array, "... 4 4"]


class Element(Component):
    """An element of the train; concrete ones are final.

    `declared` says which of its numbers are parameters of the instrument, by field. `path_difference` (µm) is the
    largest optical path between waves that meet again in it: the wavelength nodes must follow its fringes.
    """

    name: str = eqx.field(static=True, default="")
    moves: str | None = eqx.field(static=True, default=None)
    declared: tuple[tuple[str, Parameter], ...] = eqx.field(static=True, default=())

    kind: ClassVar[str] = ""
    reference: ClassVar[str] = ""

    def ray(self, ray: Ray) -> Ray:
        """The ray behind the element."""
        return ray

    def mueller(self, ray: Ray) -> Mueller | None:
        """Mueller matrix for a ray that enters; None: the identity.

        It has a leading axis where it depends on wavelength.
        """
        return None

    @classmethod
    def solved(cls, cases: Sequence[tuple[Any, Ray]]) -> list[Mueller | None]:
        """Mueller matrices of several elements of this class; overridden where solving them together pays.

        One element at many angles is traced once: an instrument with many settings would take minutes otherwise.
        """
        result: list[Mueller | None] = [None] * len(cases)
        for members in _turned_copies(cases):
            element, ray = cases[members[0]]
            if len(members) == 1:
                result[members[0]] = element.mueller(ray)
                continue
            axes = jnp.stack([cases[i][0].axis for i in members])
            matrices = jax.vmap(_at_axis, (None, 0, None))(element, axes, ray)
            for place, i in enumerate(members):
                result[i] = None if matrices is None else matrices[place]
        return result

    def turned(self, angle: float) -> Self:
        """The element turned by `angle` (deg) from +X toward +Y. Raises TypeError if it has no `axis`."""
        if not hasattr(self, "axis"):
            raise TypeError(f"element {self.name!r} has no axis that could turn")
        return dataclasses.replace(self, axis=self.axis + jnp.asarray(angle, float))  # pyright: ignore

    def position(self, angle: float | None) -> float | None:
        """Angle (deg) at which it really stands when the exposure says `angle`, None when it is out."""
        return angle

    @property
    def path_difference(self) -> float:
        """See the class."""
        return 0.0

    @property
    def materials(self) -> tuple[str, ...]:
        """Names of the materials whose refractive indices it asks for."""
        return ()

    def retardances(self, wavelength: Float[np.ndarray, " n"]) -> tuple[Float[np.ndarray, " n"], ...]:
        """Retardance along the axis at wavelengths (µm), in waves, and the sum of those of all layers; none: no waves.

        What crossed layers leave of each other interferes at full strength. The layers by themselves do where rays
        are oblique, hundreds of times more weakly.
        """
        return ()


def _at_axis(element: Any, axis: Float[Array, ""], ray: Ray) -> Mueller | None:
    return dataclasses.replace(element, axis=axis).mueller(ray)


def _turned_copies(cases: Sequence[tuple[Any, Ray]]) -> list[list[int]]:
    """Positions of the cases that are one element at different angles, met by the same ray."""
    groups: dict[tuple[int, ...], list[int]] = {}
    for i, (element, ray) in enumerate(cases):
        values = [getattr(element, f.name) for f in dataclasses.fields(element) if f.name != "axis"]
        groups.setdefault((*map(id, values), id(ray)), []).append(i)
    return list(groups.values())
