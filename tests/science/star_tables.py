"""Tables of stars with exact counts, for tests of what a calibration makes of them."""

from __future__ import annotations

import numpy as np
from astropy.table import Table

from walop_jax.data.settings import Settings
from walop_jax.data.user_tables import read_input_table
from walop_jax.model.instrument import nominal_instrument
from walop_jax.science.catalogue import read_catalogue

SOUTH = nominal_instrument("WALOP-SOUTH")


def setting(plate=None) -> Settings:
    """SDSS-r, the calibration plate at an angle (deg) or out."""
    return Settings.default(1).at(CHWP=plate)


def stars(vectors, count, rng=None, plate=(None,), rotator=None, flux=4e6, teff=np.nan):
    """A table of stars with exact vectors, every star once for each setting of the plate; and its truth."""
    draw = np.random.default_rng(8)
    x, y = draw.uniform(-0.28, 0.28, (2, count))
    p, evpa = draw.uniform(0, 0.05, count), draw.uniform(0, np.pi, count)
    qu = np.stack([p * np.cos(2 * evpa), p * np.sin(2 * evpa)], axis=1)
    rows = []
    for k, angle in enumerate(plate):
        turn = 0.0 if rotator is None else 2 * np.deg2rad(rotator[k])
        seen = (qu[:, 0] + 1j * qu[:, 1]) * np.exp(
            -1j * turn
        )  # docs: conventions, EVPA in the ICS = sky − ROTATOR
        a = vectors.exact(setting(angle), x, y, [teff])[:, 0]
        n = flux * np.einsum("pks,ps->pk", a, np.stack([np.ones(count), seen.real, seen.imag], axis=1))
        error = np.sqrt(n + 900.0)
        if rng is not None:
            n = n + error * rng.standard_normal(n.shape)
        row = Table({"ID": np.arange(count), "X": x, "Y": y, "N": n, "N_ERR": error})
        row["CHWP_ANGLE"] = np.nan if angle is None else angle
        row["TEFF"] = teff
        if rotator is not None:
            row["ROTATOR"] = rotator[k]
        rows.append(row)
    table = Table({name: np.concatenate([r[name] for r in rows]) for name in rows[0].colnames})
    return table, qu


def read(table, tmp_path, **options):
    table.write(tmp_path / "c.fits", overwrite=True)
    return read_catalogue(read_input_table(tmp_path / "c.fits"), SOUTH, **options)
