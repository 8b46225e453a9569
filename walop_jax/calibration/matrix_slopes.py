"""Names of before."""

from walop_jax.calibration.matrix import LARGEST_P, change_of_qu, effect_slopes, matrix_slopes

__all__ = ["LARGEST_P", "change_of_qu", "effect_slopes", "matrix_slopes"]
