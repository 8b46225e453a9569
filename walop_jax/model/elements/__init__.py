"""The elements of a train: one class each, and `ELEMENTS`, the kinds that a description file may name."""

from walop_jax.model.elements.base import Element
from walop_jax.model.elements.geometry import PupilMapping, Wedge
from walop_jax.model.elements.simple import (
    AddedPolarisation,
    Analyser,
    AnalysisVector,
    Collimator,
    Depolariser,
    Diattenuator,
    Polariser,
    RadialRetarder,
    Retarder,
    Rotator,
)
from walop_jax.model.elements.spectral import FieldDiattenuator, Mirror, SpectralElement
from walop_jax.model.elements.wave_plate import AirGap, Layer, WavePlate

ELEMENTS: tuple[type[Element], ...] = (
    Polariser,
    Collimator,
    RadialRetarder,
    PupilMapping,
    Wedge,
    WavePlate,
    Retarder,
    Rotator,
    Diattenuator,
    Depolariser,
    AddedPolarisation,
    SpectralElement,
    FieldDiattenuator,
    Mirror,
    AnalysisVector,
    Analyser,
)


def defined_elements() -> tuple[type[Element], ...]:
    """The kinds of elements that this process has defined beside those of the package, the latest of a kind."""
    found, waiting = {}, [Element]
    while waiting:
        for kind in waiting.pop(0).__subclasses__():
            waiting.append(kind)
            if vars(kind).get("kind") and not kind.__module__.startswith("walop_jax.model."):
                found[kind.kind] = kind
    return tuple(found.values())
