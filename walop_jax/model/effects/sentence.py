"""Other names of `change`, `factors` and the kinds, for what still asks for them here."""

from walop_jax.model.effects.change import BAND, KINDS, OPPOSITE, SKY
from walop_jax.model.effects.change import Change as Sentence
from walop_jax.model.effects.factors import FIELD, PLAIN, REFERENCE_TEMPERATURE
from walop_jax.model.effects.numbers import NUMBERS
from walop_jax.model.effects.optics import OPTICAL, Displacement
from walop_jax.model.effects.sources import Polarisation

DISPLACEMENTS = Displacement.names
POLARISATION = Polarisation.names
FIELD_FACTORS = tuple(name for name, one in PLAIN.items() if one.depends_on == FIELD)

__all__ = [
    "BAND", "DISPLACEMENTS", "FIELD_FACTORS", "KINDS", "NUMBERS", "OPPOSITE", "OPTICAL", "POLARISATION",
    "REFERENCE_TEMPERATURE", "SKY", "Sentence",
]  # fmt: skip
