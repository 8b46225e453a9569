"""Bad sets of other instruments: what is done to a good one, and what the error must name."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.io import fits
from test_bad_inputs import column, header, put

from walop_jax.data.calset import read_calibration_set
from walop_jax.io.errors import DataError

NAN = float("nan")
E, I = "EXPOSURES", "INTENSITIES"  # noqa: E741 - as in the tables


def both(*changes):
    def change(made):
        for one in changes:
            one(made)

    return change


def narrow(*names):
    """One camera less."""

    def change(made):
        for name in names:
            made[I][name] = ["D", "electron", made.values(I, name)[:, 0]]

    return change


def three(name):
    return column(I, name, "3D", "electron", np.ones((24, 3)))


TRUE = ["L", None, np.ones(8, bool)]
ANGLE = ["D", "deg", np.zeros(8)]
BAD = {
    "no name": (header("INSTRUME", ""), "[PRIMARY] INSTRUME: is '', not a name", "1 to 32 printable ASCII"),
    "number": (header("INSTRUME", 3), "[PRIMARY] INSTRUME: is 3, not a name"),
    "leading blank": (header("INSTRUME", " A"), "[PRIMARY] INSTRUME: is ' A'", "no blank at either end"),
    "long name": (header("INSTRUME", 33 * "A"), "[PRIMARY] INSTRUME", "1 to 32"),
    "another separator": (header("INSTRUME", "walop_south"), "[PRIMARY] INSTRUME", "did you mean 'WALOP-SOUTH'"),
    "of four cameras": (header("INSTRUME", "WALOP-SOUTH"), "[INTENSITIES] N: has 2 camera(s), WALOP-SOUTH has 4"),
    "one camera": (narrow("N", "N_ERR"), "[INTENSITIES] N: has 1 value in a row", "two at least"),
    "fewer errors": (narrow("N_ERR"), "[INTENSITIES] N_ERR: has 1 value(s) in a row, N has 2"),
    "more errors": (three("N_ERR"), "[INTENSITIES] N_ERR: has 3 value(s) in a row, N has 2"),
    "more counts": (three("N"), "[INTENSITIES] N_ERR: has 2 value(s) in a row, N has 3"),
    "IN without ANGLE": (
        column(E, "RET_1_ANGLE"),
        "[EXPOSURES] RET_1_ANGLE: the column is missing, RET_1_IN is there",
        "did you mean 'HWP_ANGLE'",
    ),
    "misspelt ANGLE": (
        both(column(E, "RET_1_ANGLE"), column(E, "RET1_ANGLE", *ANGLE)),
        "[EXPOSURES] RET_1_ANGLE: the column is missing",
        "did you mean 'RET1_ANGLE'",
    ),
    "in without angle": (put(E, "RET_1_ANGLE", 2, NAN), "[EXPOSURES] RET_1_ANGLE: is not finite in row 2"),
    "always in": (put(E, "HWP_ANGLE", 5, NAN), "[EXPOSURES] HWP_ANGLE: is not finite in row 5", "HWP_IN false"),
    "infinite": (put(E, "HWP_ANGLE", 5, np.inf), "[EXPOSURES] HWP_ANGLE: is not finite in row 5"),
    "steps": (put(E, "HWP_ANGLE", 5, 1e6), "[EXPOSURES] HWP_ANGLE: exceeds ±36000 in row 5", "steps?"),
    "digit first": (column(E, "2ND_ANGLE", *ANGLE), "[EXPOSURES] 2ND_ANGLE: '2ND' is no name", "a letter first"),
    "no prefix": (column(E, "_ANGLE", *ANGLE), "[EXPOSURES] _ANGLE: '' is no name"),
    "dash": (column(E, "K-M_IN", *TRUE), "[EXPOSURES] K-M_IN: 'K-M' is no name of a moving element"),
    "IN is a number": (
        column(E, "RET_1_IN", "J", None, np.arange(8)),
        "[EXPOSURES] RET_1_IN: is neither true nor false in rows 2",
    ),
    "angle is text": (column(E, "HWP_ANGLE", "3A", None, np.array(["out"] * 8)), "HWP_ANGLE: holds strings"),
    "angle unit": (column(E, "HWP_ANGLE", "D", "mm", np.zeros(8)), "HWP_ANGLE: the unit 'mm' cannot be"),
    "angle twice a row": (column(E, "HWP_ANGLE", "2D", "deg", np.zeros((8, 2))), "HWP_ANGLE: has shape (2,)"),
    "CLP_ANGLE alone": (column(E, "CLP_ANGLE", *ANGLE), "[EXPOSURES] CLP_IN: the column is missing; add it"),
    "CHWP_ANGLE alone": (column(E, "CHWP_ANGLE", *ANGLE), "[EXPOSURES] CHWP_IN: the column is missing"),
    "CHWP in without angle": (column(E, "CHWP_IN", *TRUE), "[EXPOSURES] CHWP_ANGLE: is not finite in rows 0"),
    "clp without CLP": (put(E, "KIND", 3, "clp"), "[EXPOSURES] CLP_IN: is false in row 3"),
    "unknown kind": (put(E, "KIND", 3, "lamb"), "[EXPOSURES] KIND: 'lamb' is not a kind", "did you mean 'lamp'"),
    "lamp with a source": (put(I, "SOURCE", 4, 3), "[INTENSITIES] SOURCE: a lamp is no source of the sky, in row 4"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_set_is_refused_by_name(two_cameras, name):
    change, *fragments = BAD[name]
    change(two_cameras)
    two_cameras.refused(*fragments)


def test_rows_with_different_numbers_of_cameras(two_cameras):
    hdus = two_cameras.hdus()
    table = hdus[3]
    ragged = np.empty(24, dtype=object)
    ragged[:] = [np.ones(2 + (row == 7)) for row in range(24)]
    kept = [entry for entry in table.columns if entry.name != "N"]
    hdus[3] = fits.BinTableHDU.from_columns([*kept, fits.Column("N", "PD()", array=ragged)], name=I)
    path = two_cameras.folder / "set.fits"
    fits.HDUList(hdus).writeto(path)
    with pytest.raises(
        DataError, match=r"\[INTENSITIES\] N: is an array of variable length; .*all cameras, the same"
    ):
        read_calibration_set(path)
