"""The conventions of the instrument, stated once; `tests/model/test_conventions.py` pins them.

Frame       Instrument frame (ICS): X, Y in degrees on the sky; angles grow from +X toward +Y.
Stokes      q = +1 is an electric vector along +X, u = +1 one at +45°. With fields that go as
            exp(i(kz − ωt)), S = (|Ex|² + |Ey|², |Ex|² − |Ey|², 2 Re Ex Ey*, 2 Im Ex Ey*), so that a retarder
            with its fast axis along +X has the Mueller matrix of Paper II, equation of appendix B.
Cameras     of WALOP: N0 = O1 (0°), N1 = E1 (90°), N2 = O2 (45°), N3 = E2 (135°). The first half of the pupil
            (HWP1, fast axis 0°) feeds N0 and N1, the second (HWP2, fast axis 22.5°) N2 and N3.
Matrix      one row for each arm, the normalised difference of its two cameras, first minus second:
            q_m = (N0 − N1)/(N0 + N1) = m21 + m22 q + m23 u and u_m = (N2 − N3)/(N2 + N3) = m31 + m32 q + m33 u,
            m being ratios of band-integrated linear coefficients.
Oblique     The Stokes parameters of a ray of direction k refer to the ICS axes carried from (0, 0, 1) to k by
            the smallest rotation (`geometry.transport_rotation`).
"""

from typing import NamedTuple

REFERENCE_WAVELENGTH = 0.62  # µm: origin of dispersions, colours and fringes
FIELD_SCALE = 0.3  # degrees: the unit of the field polynomials of WALOP


class Units(NamedTuple):
    """Scales of an instrument, units of changes over its field (deg) and its bands (µm)."""

    field: float = FIELD_SCALE
    wavelength: float = REFERENCE_WAVELENGTH


OF_WALOP = Units()


def matrix_elements(arms: int) -> tuple[str, ...]:
    """Names of the elements of the instrument matrix: m21, m22, m23 of the first arm, m31 … of the second."""
    return tuple(f"m{row}{column}" for row in range(2, 2 + arms) for column in (1, 2, 3))


CAMERAS = ("O1", "E1", "O2", "E2")  # of WALOP, in the order of N
EXTINCTION = 2e-5  # of the calibration polariser of WALOP, unwanted over wanted transmission
