"""Tables of stars in memory, and as catalogues of WALOP-South."""

from __future__ import annotations

import numpy as np
from astropy.table import Table

from walop_jax.data.user_tables import in_memory
from walop_jax.model.instrument import nominal_instrument
from walop_jax.science.catalogue import read_catalogue

SOUTH = nominal_instrument("WALOP-SOUTH")
ROWS = 5


def table(**columns):
    rng = np.random.default_rng(2)
    made = Table({"X": np.linspace(-0.2, 0.2, ROWS), "Y": np.linspace(0.1, -0.1, ROWS)})
    made["N"] = rng.normal(1e6, 1e3, (ROWS, 4))
    made["N_ERR"] = np.full((ROWS, 4), 1e3)
    for name, values in columns.items():
        made[name] = values
    return made


def read(given, **options):
    return read_catalogue(in_memory(given), SOUTH, **options)


def remarks(catalogue):
    return "\n".join(catalogue.remarks)
