"""The turn of Stokes parameters from the sky to the instrument frame."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def sky_to_instrument(
    q: Float[np.ndarray, ...], u: Float[np.ndarray, ...], rotator: Float[np.ndarray, ...]
) -> tuple[Float[np.ndarray, ...], Float[np.ndarray, ...]]:
    """Turn equatorial Stokes parameters (position angle north through east) into the instrument frame.

    EVPA in the instrument frame = position angle on the sky − R, hence q = Q cos 2R + U sin 2R and
    u = U cos 2R − Q sin 2R. `rotator`, R, in degrees, broadcast against q and u. The inverse is the same with −R.
    """
    angle = np.deg2rad(2.0 * np.asarray(rotator, dtype=np.float64))
    cos_2r, sin_2r = np.cos(angle), np.sin(angle)
    return q * cos_2r + u * sin_2r, u * cos_2r - q * sin_2r
