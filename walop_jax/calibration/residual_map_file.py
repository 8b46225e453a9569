"""The residual map of a calibration product: three images over cells of the field.

RESIDUAL       (7, ny, nx): dm21 … dm33 to be added to the instrument matrix, and the relative change of the
               throughput of the second arm (cameras N2, N3); NaN where a cell has too few data. Of an instrument with
               A arms 4 A − 1 planes, PLANE1, … name them.
RESIDUAL_ERR   their standard errors
RESIDUAL_CHI2  (ny, nx): χ² per degree of freedom of the residuals before that correction
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from jaxtyping import Float

from walop_jax.calibration.product_header import position_cards, read_positions
from walop_jax.calibration.records import ResidualMap, residual_names
from walop_jax.data.frames import read_grid
from walop_jax.data.schema import Place
from walop_jax.data.write import grid_cards
from walop_jax.io.errors import fail

_IMAGES = {"RESIDUAL": "values", "RESIDUAL_ERR": "errors", "RESIDUAL_CHI2": "chi2"}


def residual_hdus(residuals: ResidualMap) -> list[Any]:
    """The image extensions of a residual map."""
    hdus = []
    for name, attribute in _IMAGES.items():
        hdu = fits.ImageHDU(getattr(residuals, attribute), name=name)
        hdu.header.update(grid_cards(residuals.grid) | position_cards(residuals.positions))
        hdu.header["FILTER"] = residuals.filter
        if np.isfinite(residuals.chwp_angle):
            hdu.header["CHWPANG"] = (residuals.chwp_angle, "[deg] calibration plate; absent: out")
        if hdu.header["NAXIS"] == 3:
            for number, quantity in enumerate(residuals.names, start=1):
                hdu.header[f"PLANE{number}"] = quantity
        hdus.append(hdu)
    return hdus


def read_residual_map(units: Mapping[str, Any], arms: int, path: Path) -> ResidualMap | None:
    """The residual map among the extensions of a product of an instrument with so many arms, None without one.

    Raises `DataError` for images that are missing or do not belong together.
    """
    present = [name for name in _IMAGES if name in units]
    if not present:
        return None
    if len(present) < len(_IMAGES):
        missing = next(name for name in _IMAGES if name not in present)
        raise fail("the extension is missing", file=path, extension=missing, advice="make the product again")
    grids = {name: read_grid(units[name].header, Place(path, name)) for name in _IMAGES}
    grid = grids["RESIDUAL"]
    images: dict[str, Float[np.ndarray, ...]] = {}
    for name, attribute in _IMAGES.items():
        shape = (grid.height, grid.width)
        expected = shape if attribute == "chi2" else (len(residual_names(arms)), *shape)
        data = units[name].data
        if grids[name] != grid or not isinstance(data, np.ndarray) or data.shape != expected:
            raise fail(
                "is not an image on the grid of RESIDUAL", file=path, extension=name, advice="make it again"
            )
        images[attribute] = np.ascontiguousarray(data, dtype=np.float64)
    header = units["RESIDUAL"].header
    return ResidualMap(
        grid=grid,
        filter=str(header.get("FILTER", "")).strip(),
        chwp_angle=float(header.get("CHWPANG", np.nan)),
        positions=read_positions(header, Place(path, "RESIDUAL")),
        **images,
    )
