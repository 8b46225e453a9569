"""Optics of the sealed sets: those of `tests/oracle`, with a Mueller matrix near the identity in the train."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from oracle import forward


def full_mueller(jones: np.ndarray) -> np.ndarray:
    """Mueller matrix (…, 4, 4) of a Jones matrix: ½ Tr(σ_i J σ_j J†), V = 2 Im(E_x* E_y)."""
    sigma = np.array([[[1, 0], [0, 1]], [[1, 0], [0, -1]], [[0, 1], [1, 0]], [[0, -1j], [1j, 0]]])
    return 0.5 * np.einsum("iab,...bc,jcd,...ad->...ij", sigma, jones, sigma, jones.conj()).real


def halves(params: dict[str, Any], x: np.ndarray, y: np.ndarray, wavelength: np.ndarray) -> np.ndarray:
    """Mueller matrices (point, wavelength, half, 4, 4) of wedge and plate."""
    k, each = forward.pupil_direction(params, x, y), []
    for half, axis in ((1, 0.0), (2, np.radians(22.5))):
        behind = forward.through_wedge(k, params[f"wedge_{half}"], wavelength)
        thick = params[f"quartz_{half}"], params[f"mgf2_{half}"]
        each.append(full_mueller(forward.plate_jones(behind, wavelength, *thick, axis)))
    return np.stack(each, axis=2)


class Hidden(NamedTuple):
    """One thing that is hidden: where, how large, and its patterns; `text` says it in words."""

    text: str
    where: str
    size: float
    generator: np.ndarray
    field: Callable[[np.ndarray, np.ndarray], np.ndarray]
    colour: Callable[[np.ndarray], np.ndarray]
    law: np.ndarray
    star: float
    cameras: np.ndarray
    gamma: float = 0.0

    @property
    def second(self) -> Hidden:
        """The term ½ h² A² of exp(h A): without it counts behind crossed polarisers would be negative."""
        return self._replace(
            size=0.5 * self.size**2,
            generator=self.generator @ self.generator,
            field=lambda x, y: self.field(x, y) ** 2,
            colour=lambda w: self.colour(w) ** 2,
        )


def vectors(
    params: dict[str, Any],
    x: np.ndarray,
    y: np.ndarray,
    band: tuple[np.ndarray, np.ndarray],
    one: Hidden | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Analysis vectors (point, camera, 4) of the instrument, and what the hidden optics add to them at g = 1."""
    wavelength, weight = band
    arms, coll = halves(params, x, y, wavelength), forward.collimator(params, x, y)
    efficiency = np.array([params["eta_1"], params["eta_2"]])
    rows = np.zeros((4, 4))  # of the four cameras, of what is ahead of their analyser
    rows[:, 0] = 0.5
    rows[:, 1] = 0.5 * np.array([1, -1, 1, -1]) * np.repeat(efficiency, 2)
    half = np.array([0, 0, 1, 1])
    through = forward.camera_throughput(params, x, y)
    plain = np.einsum("w,ki,pwkij,pjl->pkl", weight, rows, arms[:, :, half], coll, optimize=True)
    added = np.zeros_like(plain)
    if one is not None and one.where in ("behind polariser", "behind collimator", "half 1", "half 2"):
        pattern = one.size * one.field(x, y)
        spectral = weight * one.colour(wavelength)
        a = one.generator
        if one.where == "behind polariser":
            chain = np.einsum(
                "w,ki,pwkij,pjl,lm->pkm", spectral, rows, arms[:, :, half], coll, a, optimize=True
            )
        elif one.where == "behind collimator":
            chain = np.einsum(
                "w,ki,pwkij,jl,plm->pkm", spectral, rows, arms[:, :, half], a, coll, optimize=True
            )
        else:
            chain = np.einsum(
                "w,ki,ij,pwkjl,plm->pkm", spectral, rows, a, arms[:, :, half], coll, optimize=True
            )
            chain *= (half == int(one.where[-1]) - 1)[None, :, None]
        added = pattern[:, None, None] * chain
    return through[..., None] * plain, through[..., None] * added
