"""`walop-jax gather`: the catalogues of single cameras, as programs of photometry write them, made into one."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from walop_jax.commands.command import Job, Option, Outcome, PathLike, UsageError, command, several, typed
from walop_jax.commands.products import InstrumentLike, design_of

if TYPE_CHECKING:
    from walop_jax import Instrument


OPTIONS = {
    "catalogues": Option(
        "Catalogues of the cameras, in their order: O1 E1 O2 E2.",
        metavar="CATALOGUE...",
        kind=list[Path],
        placed=True,
    ),
    "output": Option(
        "Table to write (.fits, .csv, .ecsv).", metavar="OUT", kind=Path, short="-o", required=True
    ),
    "columns": Option(
        "Names of the columns of another program than SExtractor and photutils.",
        metavar="FILE.toml",
        kind=Path,
    ),
    "ra": Option(
        "Right ascension of the field centre (deg); without it that of the header, or of the WCS.", kind=float
    ),
    "dec": Option(
        "Declination of the field centre (deg); without it that of the header, or of the WCS.", kind=float
    ),
    "rotator": Option(
        "Position angle of +X (deg); without it that of the header, or of the axis x of the WCS.", kind=float
    ),
    "tolerance": Option("Stars farther apart than that are not one (arcsec).", metavar="ARCSEC", least=0.01),
    "gain": Option("Electrons per count, where fluxes are in counts.", kind=float),
    "gaia": Option(
        "Table with RA, DEC, SOURCE_ID, BP_RP, PHOT_G_MEAN_MAG, PMRA, PMDEC, REF_EPOCH: who the stars are.",
        metavar="TABLE",
        kind=Path,
    ),
    "words": Option(
        "Words of the header that are FILTER, MJD, CHWP_ANGLE, RA, …, as for exposures.",
        metavar="WORDS.toml",
        kind=Path,
    ),
    "drop_blends": Option(
        "Leave out, in each camera, stars that are flagged as having a neighbour or as deblended."
    ),
}


@command(stages=("reading", "matching", "writing"), writes="table", jax=False, options=OPTIONS)
def gather(
    job: Job,
    catalogues: Sequence[PathLike],
    *,
    output: PathLike | None = None,
    columns: PathLike | None = None,
    ra: float | None = None,
    dec: float | None = None,
    rotator: float | None = None,
    tolerance: float = 1.0,
    gain: float | None = None,
    gaia: Any = None,
    words: PathLike | None = None,
    drop_blends: bool = False,
    instrument: InstrumentLike = None,
) -> Outcome[Any]:
    """Make one catalogue, with a row for each star, of the catalogues of the cameras.

    Catalogues of SExtractor (FITS_LDAC, FITS, ASCII_HEAD) or photutils (ECSV) are read as they are, of other programs
    with a small file that names their columns. Positions of the cameras are registered, stars matched on the sky; a
    camera whose positions are shifted or rotated, or that lacks stars, is named. X and Y are made of right ascension,
    declination and the pointing; ROTATOR is the position angle at the star. SOURCE_ID, BP_RP, TEFF and parallaxes go
    with the stars. Words of the exposure are read from the header of the image, of the table, and the primary header; a
    contradiction is an error. Directions of another equinox are made ICRS.

    Stars flagged only as having a neighbour or as deblended are used, with a remark, unless --drop-blends is given.
    A table of Gaia is moved to the time of the exposure by its proper motions; of several candidates position and
    magnitude decide, and where they cannot none is taken (ID_FLAG).

    In Python: an astropy table with a row for each star.

    >>> stars = walop.gather(["O1.fits", "E1.fits", "O2.fits", "E2.fits"], rotator=0.0)  # doctest: +SKIP
    """
    from walop_jax.data.camera_catalogues import read_camera_catalogue
    from walop_jax.data.header_words import read_words
    from walop_jax.instruments.description import shipped
    from walop_jax.io.errors import fail
    from walop_jax.io.plain_tables import astropy_table, not_in, write_table
    from walop_jax.model.instrument import nominal_instrument
    from walop_jax.science.gathering import gather as gathered
    from walop_jax.science.gathering import instrument_of, pointing_of
    from walop_jax.science.identification import identified

    catalogues = several(catalogues)
    asked = design_of(instrument)
    design = asked or nominal_instrument()
    _check_cameras(catalogues, design)
    for option, value in (("tolerance", tolerance), ("gain", gain)):
        if value is not None and not (math.isfinite(value) and value > 0):
            raise UsageError(f"{option} = {value} must be a number above 0", option)
    job.begin("reading")
    rules = None if words is None else read_words(words)
    cameras = [
        read_camera_catalogue(path, columns, gain, rules, drop_blends=drop_blends) for path in catalogues
    ]
    stated, remarks = instrument_of(cameras, "" if asked is None else asked.name)
    if asked is None and stated:
        if stated not in shipped():
            advice = "give the description of the instrument (--instrument), or correct INSTRUME"
            raise fail(
                f"is {stated!r}, which is not known", file=cameras[0].path, column="INSTRUME", advice=advice
            )
        design = nominal_instrument(stated)
        _check_cameras(catalogues, design)
    names = design.cameras.names
    pointing, pointing_remarks = pointing_of(cameras, {"RA": ra, "DEC": dec, "ROTATOR": rotator})
    job.begin("matching")
    gathered_stars = gathered(cameras, names, pointing, tolerance)
    if gaia is not None:
        gathered_stars = identified(gathered_stars, gaia, tolerance)
    remarks += [*pointing_remarks, *gathered_stars.remarks]
    job.begin("writing")
    cards = {"INSTRUME": design.name, "RA": pointing.ra, "DEC": pointing.dec, "ROTATOR": pointing.rotator}
    table = astropy_table(gathered_stars.columns, {**cards, "RADESYS": "ICRS"})
    if output is not None:
        write_table(output, table, overwrite=job.overwrite)
        remarks += not_in(output, table)
    by_cameras = [int((gathered_stars.matched == count).sum()) for count in range(len(names) + 1)]
    moved = [
        {"camera": name, "shift_arcsec": move.shift.tolist(), "rotation_deg": move.rotation}
        for name, move in zip(names, gathered_stars.registrations, strict=True)
    ]
    document = {"output": output, "stars": len(table), "in_all_cameras": by_cameras[-1], "pointing": cards}
    document |= {"registrations": moved, "remarks": remarks}
    text = f"{output}: {len(table)} stars, {by_cameras[-1]} of them in all {len(names)} cameras"
    apply = typed("apply", "RUN", output, "-o", "OUT.fits")
    return Outcome(table, document, text, warnings=remarks, next=(apply,))


def _check_cameras(catalogues: Sequence[PathLike], design: Instrument) -> None:
    """Refuse another number of catalogues than of cameras, and a file with the name of another camera, such as O1.

    Names such as A and 1 may mean anything.
    """
    names = design.cameras.names
    if len(catalogues) != len(names):
        what = f"{len(catalogues)} catalogues for the {len(names)} cameras of {design.name}"
        raise UsageError(f"{what}: give those of {', '.join(names)}, in this order", "catalogues")
    telling = {name.upper() for name in names if len(name) > 1 and not name.isdigit()}
    for path, name in zip(catalogues, names, strict=True):
        stated = telling & set(re.split(r"[^A-Z0-9]+", Path(path).name.upper()))
        if len(stated) == 1 and name.upper() not in stated:
            order = f"the order is {', '.join(names)}; rename it if it is of {name}"
            raise UsageError(f"{path} is given in the place of camera {name}: {order}", "catalogues")
