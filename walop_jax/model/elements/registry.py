"""`ELEMENTS`: the kinds of elements of description files, and those defined by users."""

from __future__ import annotations

import os
from collections.abc import Sequence

from walop_jax.io.code import classes_of
from walop_jax.io.errors import PathLike, fail
from walop_jax.model.elements import geometry, simple, spectral, wave_plate
from walop_jax.model.elements.base import Element

ELEMENTS: tuple[type[Element], ...] = (
    simple.Polariser, simple.Collimator, simple.RadialRetarder, geometry.PupilMapping, geometry.Wedge,
    wave_plate.WavePlate, simple.Retarder, simple.Rotator, simple.Diattenuator, simple.Depolariser,
    simple.AddedPolarisation, spectral.SpectralElement, spectral.FieldDiattenuator, spectral.Mirror,
    simple.AnalysisVector, simple.Analyser,
)  # fmt: skip


def defined_elements() -> tuple[type[Element], ...]:
    """The kinds of elements defined in this process beside those of the package, the latest of each name."""
    kinds, waiting = {}, [Element]
    while waiting:
        for kind in waiting.pop(0).__subclasses__():
            waiting.append(kind)
            if vars(kind).get("kind") and not kind.__module__.startswith("walop_jax.model."):
                kinds[kind.kind] = kind
    return tuple(kinds.values())


def load_elements(given: PathLike | Sequence[type]) -> None:
    """Run a user's file of kinds of elements, which registers them (`defined_elements`).

    Raises `DataError` for a file without such a class, TypeError for another class.
    """
    if isinstance(given, str | os.PathLike):
        advice = "give a Python file with subclasses of Element (walop-jax docs adding-an-instrument)"
        if not any(vars(kind).get("kind") for kind in classes_of(given, Element, advice).values()):
            raise fail("defines no kind of element", file=given, advice=advice)
        return
    for kind in given:
        if not (isinstance(kind, type) and issubclass(kind, Element)):
            raise TypeError(f"elements: {kind!r} is no class of elements, a subclass of Element")
