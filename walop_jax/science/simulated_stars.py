"""A synthetic catalogue of stars that an instrument sees, with its truth: for trying `gather`, `apply` and `check`."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from walop_jax.calibration.analysis_vectors import COLOURS, colour_nodes, colour_weights
from walop_jax.calibration.matrix import sky_vectors
from walop_jax.data.settings import Settings
from walop_jax.model import light
from walop_jax.model.compiled import array
from walop_jax.model.instrument import Instrument
from walop_jax.model.planning import plan_for_settings
from walop_jax.science.colours import DWARFS, GIANTS, LIMITS, temperature
from walop_jax.science.gathering import CatalogueColumns
from walop_jax.simulation.observing_plan import ObservingPlan
from walop_jax.simulation.simulate import PhotonNoise
from walop_jax.sky.directions import Pointing
from walop_jax.sky.position_angles import sky_to_instrument

POINTING = Pointing(ra=97.5, dec=-44.0, rotator=35.0)
ELECTRONS = (2e4, 2e6)  # of a camera, log-uniform
_COLOUR = (0.95, 0.25)  # mean and scatter of BP − RP
_COLOUR_ERROR = 0.01
_SCATTER = 61.0  # K, about the relation of a star's kind
_DEGREE = 0.05  # p is uniform up to it
_POSITION_ERROR = 0.05  # arcsec, of a camera


@dataclasses.dataclass(frozen=True)
class SimulatedStars:
    """Columns of a catalogue (files: catalogues), and the truth: q, u on the sky of each star, and TEFF (K)."""

    columns: CatalogueColumns
    qu: Float[np.ndarray, "n 2"]
    teff: Float[np.ndarray, " n"]

    def document(self) -> dict[str, Any]:
        """The truth as plain data."""
        return {"q": self.qu[:, 0].tolist(), "u": self.qu[:, 1].tolist(), "teff": self.teff.tolist()}

    def of_camera(self, number: int, seed: int) -> tuple[CatalogueColumns, dict[str, Any]]:
        """Columns of one camera, named as by SExtractor, in an order and with positions of its own; its header."""
        columns = {name: values for name, (values, *_) in self.columns.items()}
        draw = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(5, number)))
        rows = draw.permutation(len(self.teff))
        off_ra, off_dec = _POSITION_ERROR / 3600.0 * draw.standard_normal((2, len(rows)))
        header = {"RA": POINTING.ra, "DEC": POINTING.dec, "ROTATOR": POINTING.rotator}
        header |= {name: columns[name][0].item() for name in ("FILTER", "MJD")}
        dec = columns["DEC"][rows]
        made: CatalogueColumns = {
            "ALPHA_J2000": (columns["RA"][rows] + off_ra / np.cos(np.deg2rad(dec)), "deg", "right ascension"),
            "DELTA_J2000": (dec + off_dec, "deg", "declination"),
            "FLUX_AUTO": (columns["N"][rows, number], "count", "flux"),
            "FLUXERR_AUTO": (columns["N_ERR"][rows, number], "count", "standard error of the flux"),
            "FLAGS": (np.zeros(len(rows), np.int16), "", "flags of SExtractor"),
        }
        names = ("SOURCE_ID", "BP_RP", "BP_RP_ERR")
        made |= {name: (columns[name][rows], *self.columns[name][1:]) for name in names}
        return made, header


def simulated_stars(
    plan: ObservingPlan,
    instrument: Instrument,
    count: int,
    seed: int,
    *,
    night: int = 0,
    noiseless: bool = False,
) -> SimulatedStars:
    """Stars over the field of a plan, dwarfs and giants alike, seen once by an instrument in the plan's first filter.

    The random numbers are apart from those of `simulate`, whose instrument the same seed gives. Each `night`, in days
    after the first, sees the same stars with noise of its own.
    """
    field, curve = plan.field, next(iter(plan.curves().values()))
    draw = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(4, 0)))
    photons = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(4, 1 + night)))
    x, y = draw.uniform(-field, field, (2, count))
    ra, dec = POINTING.sky_of(x, y)
    degree, angle = draw.uniform(0.0, _DEGREE, count), draw.uniform(0.0, 2.0 * np.pi, count)
    qu = np.stack([degree * np.cos(angle), degree * np.sin(angle)], axis=1)
    colour = np.clip(draw.normal(*_COLOUR, count), *LIMITS)
    kind = draw.random(count) < 0.5
    teff = np.where(kind, temperature(colour, DWARFS), temperature(colour, GIANTS))
    teff = teff + _SCATTER * draw.standard_normal(count)
    flux = 4.0 * 10.0 ** draw.uniform(np.log10(ELECTRONS[0]), np.log10(ELECTRONS[1]), count)

    rotator = POINTING.rotator_at(ra, dec)
    stokes = np.stack([np.ones(count), *sky_to_instrument(qu[:, 0], qu[:, 1], rotator)], axis=1)
    nodes = np.append(np.nan, colour_nodes(COLOURS))
    settings = dataclasses.replace(Settings.default(len(nodes), curve.name), teff=nodes)
    layout = plan_for_settings(instrument, settings, {curve.name: curve})
    vectors = sky_vectors(instrument, layout, x, y)[:, np.asarray(layout.band_of)[:, 0], :, :3]
    expected = flux[:, None] * np.einsum("pc,pcks,ps->pk", colour_weights(teff, COLOURS), vectors, stokes)
    if not light.is_linear(instrument):
        single = jax.tree.map(lambda leaf: leaf[:1], layout.exposures)
        detected = jax.vmap(lambda n, x, y: light.detected(instrument, single, n[None], x, y)[0])
        expected = np.asarray(detected(*map(array, (expected, x, y))))
    noise = PhotonNoise(plan.read_noise)
    counts, sigma = (expected, noise.sigma(expected)) if noiseless else noise.draw(photons, expected)
    columns: CatalogueColumns = {
        "SOURCE_ID": (np.arange(count) + 1_000_000, "", "identifier of the star"),
        "RA": (ra, "deg", "right ascension, ICRS"),
        "DEC": (dec, "deg", "declination, ICRS"),
        "X": (x, "deg", "field coordinate"),
        "Y": (y, "deg", "field coordinate"),
        "ROTATOR": (rotator, "deg", "position angle of +X at the star"),
        "N": (counts, "", "electrons in each camera"),
        "N_ERR": (sigma, "", "standard errors of N"),
        "BP_RP": (colour + _COLOUR_ERROR * draw.standard_normal(count), "mag", "colour of Gaia"),
        "BP_RP_ERR": (np.full(count, _COLOUR_ERROR), "mag", "standard error of BP_RP"),
        "FILTER": (np.full(count, curve.name), "", "filter"),
        "MJD": (np.full(count, plan.start + night), "d", "mid-exposure, UTC"),
    }
    return SimulatedStars(columns, qu, teff)
