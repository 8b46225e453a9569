"""Names of before."""

from walop_jax.calibration.calibration import Calibration

matrix_columns = Calibration.matrix_columns


def provenance(content, calibration, *, drawn=False):  # type: ignore[no-untyped-def]
    """Return the cards of a table."""
    return calibration.provenance(content)
