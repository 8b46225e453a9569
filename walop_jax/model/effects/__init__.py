"""Physical effects beyond the base model: one file each, and the one list `EFFECTS`."""

from walop_jax.model.effects.base import Effect

EFFECTS: tuple[type[Effect], ...] = ()

__all__ = ["EFFECTS", "Effect"]
