"""Fifty mistakes of an observer in a catalogue of stars: what does the program say first, and does it stop?

    python tests/studies/observer_errors.py [--folder FOLDER] [--only WORD] [--json FILE]

A calibration is fitted to a simulated set, and 400 stars are simulated that the same instrument sees (both are kept in
the folder). Each mistake is made in these files, as an observer makes it, and the files go through `walop-jax gather`
(where they are those of the cameras), `apply` and `check`. Printed are the first sentence of apply, or of the command
that refuses; the exit codes of apply and check; and whether the sentence names the cause, by a pattern that was written
down with the mistake. `TABLE` are those of a review of the program, `FURTHER` were written from what observers do,
ahead of any word for them in the program. What is `mended` is no mistake any more once it was read, and said; what is
`hidden` leaves no trace in any number of the catalogue: ROTATOR beside right X and Y, and a FILTER by which χ² of 300
stars changes from 148.7 to 148.2 and the scatter of their q and u from 2.44 to 2.46 %.
"""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from astropy.io import fits
from astropy.table import Table

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from command import run_program  # noqa: E402
from study_options import options_of  # noqa: E402

PLAN = """\
filters = ["SDSS-r"]
grid = 9
standard_grid = 3
polariser_angles = 8
full_turn = true
moon_patches = 4
standards = 4
"""
CAMERAS = ("O1", "E1", "O2", "E2")
POINTING = {"RA": 97.5, "DEC": -44.0, "ROTATOR": 35.0}
RUN = "RN"


def prepare(folder: Path) -> None:
    """The calibration and the stars, made once; everything else happens in this folder."""
    folder.mkdir(parents=True, exist_ok=True)
    os.chdir(folder)
    Path("plan.toml").write_text(PLAN)
    Path("other.toml").write_text(PLAN.replace("SDSS-r", "NB-580"))
    Path("both.toml").write_text(PLAN.replace('"SDSS-r"', '"SDSS-r", "NB-580"'))
    stars = ("--stars", 400, "--seed", 9)
    steps: dict[str, Sequence[object]] = {
        "n1.fits": ("simulate", "both.toml", "--seed", 11, "-o", "n1.fits", "--truth", "T1.json"),
        RUN: ("refit", "n1.fits", "-o", RUN),
        "base.fits": ("simulate", "plan.toml", "--like", "T1.json", *stars, "-o", "base.fits"),
        "other.fits": ("simulate", "other.toml", "--like", "T1.json", *stars, "-o", "other.fits"),
    }
    for made, command in steps.items():
        if not Path(made).exists():
            done = run_program(*command)
            if done.exit_code:
                raise SystemExit(done.output)


def base() -> Table:
    """The stars as they should be."""
    return Table.read("base.fits")


Commands = list[list[Any]]
Turn = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


def reduced(files: Sequence[str], *options: object) -> Commands:
    """The commands that reduce files: gather first where they are those of the cameras."""
    if len(files) == 1:
        return [["apply", RUN, *files, "-o", "out.fits"]]
    gathered = ["gather", *files, *options, "-o", "gathered.fits", "--overwrite"]
    return [gathered, ["apply", RUN, "gathered.fits", "-o", "out.fits"]]


def one(change: Callable[[Table], Any]) -> Callable[[], Commands]:
    """A mistake in a table of all cameras: `change` alters it in place, or gives another one."""

    def made() -> Commands:
        table = base()
        changed = change(table)
        (table if changed is None else changed).write("stars.fits", overwrite=True)
        return reduced(["stars.fits"])

    return made


def of_cameras(
    table: Table | None = None,
    order: Sequence[int] = (0, 1, 2, 3),
    names: Sequence[str] = ("a", "b", "c", "d"),
    change: Callable[[Table, int], Any] = lambda columns, camera: None,
    primary: dict[str, Any] | None = None,
    header: dict[str, Any] | None = None,
    **unlike: dict[int, Any],
) -> list[str]:
    """Files of the cameras, with positions on the sky; `order` says which camera each file holds."""
    table = base() if table is None else table
    words = POINTING | {"FILTER": "SDSS-r", "MJD": 61345.2} if header is None else header
    files = []
    for name, k in zip(names, order, strict=True):
        columns = Table({"ALPHA_J2000": table["RA"], "DELTA_J2000": table["DEC"]})
        columns["FLUX_AUTO"], columns["FLUXERR_AUTO"] = table["N"][:, k], table["N_ERR"][:, k]
        columns["BP_RP"] = table["BP_RP"]
        changed = change(columns, k)
        columns = columns if changed is None else changed
        columns.meta.update(words | {key: values[k] for key, values in unlike.items() if k in values})
        hdu = fits.PrimaryHDU()
        hdu.header.update(primary or {})
        files.append(f"{name}.fits")
        fits.HDUList([hdu, fits.table_to_hdu(columns)]).writeto(files[-1], overwrite=True)
    return files


def cameras(*options: object, **made: Any) -> Callable[[], Commands]:
    """A mistake in the files of the cameras."""
    return lambda: reduced(of_cameras(**made), *options)


class Mistake(NamedTuple):
    """A mistake: in words, how it is made, and what a first sentence must hold that names it."""

    what: str
    made: Callable[[], Commands]
    named: str
    mended: bool = False
    hidden: bool = False


# ------------------------------------------------------------------------------------------------ what is changed


def ordered(order: Sequence[int]) -> Callable[[Table], None]:
    def change(t: Table) -> None:
        t["N"], t["N_ERR"] = t["N"][:, list(order)], t["N_ERR"][:, list(order)]

    return change


def scaled(camera: int | list[int], factor: float) -> Callable[[Table], None]:
    def change(t: Table) -> None:
        t["N"][:, camera] *= factor
        t["N_ERR"][:, camera] *= factor

    return change


def errors(change: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Callable[[Table], None]:
    def made(t: Table) -> None:
        t["N_ERR"] = change(np.array(t["N"]), np.array(t["N_ERR"]))

    return made


def placed(turn: Turn, *, on_sky: bool = False) -> Callable[[Table], None]:
    """X and Y otherwise; without RA and DEC, of which the program could make them, unless they stay (`on_sky`)."""

    def change(t: Table) -> None:
        t["X"], t["Y"] = turn(np.array(t["X"]), np.array(t["Y"]))
        if not on_sky:
            t.remove_columns(["RA", "DEC"])

    return change


def rotated(rotator: Callable[[np.ndarray], np.ndarray]) -> Callable[[Table], None]:
    """Another ROTATOR, with which X and Y were made from right ascension and declination."""

    def change(t: Table) -> None:
        off = np.deg2rad(rotator(np.array([POINTING["ROTATOR"]]))[0] - POINTING["ROTATOR"])
        x, y = np.array(t["X"]), np.array(t["Y"])
        t["X"], t["Y"] = np.cos(off) * x + np.sin(off) * y, np.cos(off) * y - np.sin(off) * x
        t["ROTATOR"] = rotator(np.array(t["ROTATOR"]))
        t.remove_columns(["RA", "DEC"])

    return change


def magnitudes(t: Table) -> None:
    n, sigma = np.array(t["N"]), np.array(t["N_ERR"])
    t["N"], t["N_ERR"] = 25.0 - 2.5 * np.log10(n), 2.5 / np.log(10.0) * sigma / n


def columns_in_magnitudes(t: Table, camera: int) -> None:
    n = np.array(t["FLUX_AUTO"])
    t["MAG_AUTO"], t["MAGERR_AUTO"] = 25.0 - 2.5 * np.log10(n), 1.0857 * np.array(t["FLUXERR_AUTO"]) / n
    t["MAG_AUTO"].unit = t["MAGERR_AUTO"].unit = "mag"
    t.remove_columns(["FLUX_AUTO", "FLUXERR_AUTO"])


def without(*names: str) -> Callable[[Table], None]:
    return lambda t: t.remove_columns(list(names))


def two_filters(t: Table) -> None:
    t["FILTER"] = np.where(np.arange(len(t)) % 3 == 0, "SDSS-i", "SDSS-r")


def in_header(**words: Any) -> Callable[[Table], None]:
    return lambda t: t.meta.update(words)


def no_place(t: Table) -> None:
    t["X"][17] = np.nan


def twice(t: Table) -> Table:
    return t[np.r_[np.arange(len(t)), np.arange(0, len(t), 7)]]


def semicolons() -> Commands:
    """A CSV as a spreadsheet writes it where the comma is decimal."""
    t = base()
    for k in range(4):
        t[f"N{k}"], t[f"N{k}_ERR"] = t["N"][:, k], t["N_ERR"][:, k]
    t.remove_columns(["N", "N_ERR"])
    rows = [";".join(t.colnames)] + [";".join(str(v).replace(".", ",") for v in row) for row in t.iterrows()]
    Path("stars.csv").write_text("\n".join(rows) + "\n")
    return reduced(["stars.csv"])


TABLE = (
    Mistake("magnitudes, no fluxes (cameras)", cameras(change=columns_in_magnitudes), "magnitudes"),
    Mistake("magnitudes in N (one table)", one(magnitudes), "magnitudes"),
    Mistake("RA of the pointing in hours", cameras(header=POINTING | {"RA": 6.5}), "hours"),
    Mistake("errors are variances", one(errors(lambda n, s: s**2)), "variance"),
    Mistake("no ROTATOR", cameras(header={"RA": 97.5, "DEC": -44.0}), "ROTATOR"),
    Mistake("two filters in one table", one(two_filters), "FILTER.*SDSS-i"),
    Mistake("two filters in one exposure", cameras(FILTER={2: "SDSS-i"}), "FILTER.*SDSS-i|SDSS-i.*FILTER"),
    Mistake(
        "another filter in the primary header",
        cameras(primary=POINTING | {"FILTER": "SDSS-i"}, header={}),
        "FILTER.*SDSS-i|SDSS-i.*calibration",
    ),
    Mistake(
        "another instrument, cameras", cameras(header=POINTING | {"INSTRUME": "WALOP-NORTH"}), "WALOP-NORTH"
    ),
    Mistake("another instrument, one table", one(in_header(INSTRUME="WALOP-NORTH")), "WALOP-NORTH"),
    Mistake("MJD of one camera a day off", cameras(MJD={1: 61346.2}), "MJD"),
    Mistake(
        "O2 and E1 exchanged, by their names",
        cameras(names=("O1", "O2", "E1", "E2")),
        "O2.*in the place of.*E1",
    ),
    Mistake("O2 and E1 exchanged, other names", cameras(order=(0, 2, 1, 3)), "order O1, O2, E1, E2"),
    Mistake("O1 and E1 exchanged", one(ordered((1, 0, 2, 3))), "order E1, O1, O2, E2"),
    Mistake("arms exchanged", one(ordered((2, 3, 0, 1))), "order O2, E2, O1, E1"),
    Mistake(
        "ROTATOR of the wrong sign",
        cameras(header=POINTING | {"ROTATOR": -35.0}),
        "ROTATOR had the wrong sign",
    ),
    Mistake("RA of the pointing 0.1° off", cameras(header=POINTING | {"RA": 97.6}), "field centre lies 0.07"),
    Mistake("X and Y exchanged", one(placed(lambda x, y: (y, x))), "X and Y were exchanged"),
    Mistake("X mirrored", one(placed(lambda x, y: (-x, y))), "X ran the other way"),
    Mistake("X and Y in arcmin", one(placed(lambda x, y: (60 * x, 60 * y))), "arcmin"),
    Mistake("ROTATOR in radians", one(rotated(np.deg2rad)), "radian"),
    Mistake("fluxes per second", one(scaled([0, 1, 2, 3], 1 / 60.0)), "rate|per second|gain"),
    Mistake("NaN in a position", one(no_place), "left out|no place|X", mended=True),
    Mistake("rows that are there twice", one(twice), "copies of another row", mended=True),
    Mistake("CSV with ; and decimal commas", semicolons, "decimals? (by )?comma", mended=True),
    Mistake("errors three times too large", one(errors(lambda n, s: 3.0 * s)), "N_ERR is .*too large"),
)


# ------------------------------------------------------------------------------ further ones, from what is done


def shifted_rows(t: Table) -> None:
    """The catalogue of E1 lacks its first star, and was joined by the number of the row."""
    for name in ("N", "N_ERR"):
        t[name][:, 1] = np.roll(np.array(t[name][:, 1]), -1)


def mismatched(t: Table) -> None:
    """Every third star of O2 is a neighbour of the right one."""
    rows = np.arange(0, len(t), 3)
    for name in ("N", "N_ERR"):
        t[name][rows, 2] = np.array(t[name][:, 2])[(rows + 5) % len(t)]


def with_light(camera: int | list[int], electrons: float) -> Callable[[Table], None]:
    def change(t: Table) -> None:
        t["N"][:, camera] += electrons

    return change


def not_flat(t: Table) -> None:
    t["N"][:, 1] *= 1.0 + 0.06 * t["X"] / np.abs(np.array(t["X"])).max()


def bent(t: Table) -> None:
    t["N"][:, 3] *= 1.0 - 0.03 * t["N"][:, 3] / 1e6


def clipped(t: Table) -> None:
    t["N"] = np.minimum(np.array(t["N"]), 65535.0 * 6)


def centre_of_date() -> Commands:
    """The pointing of the equinox of date (2026.9) with stars of J2000: Lieske's precession, first order."""
    ra, dec, years = np.deg2rad(POINTING["RA"]), np.deg2rad(POINTING["DEC"]), 26.9
    moved = {
        "RA": POINTING["RA"] + years * (46.124 + 20.043 * np.sin(ra) * np.tan(dec)) / 3600.0,
        "DEC": POINTING["DEC"] + years * 20.043 * np.cos(ra) / 3600.0,
    }
    return reduced(of_cameras(header=POINTING | moved))


def without_cosine(t: Table) -> None:
    """X and Y from differences of right ascension, not on the sky."""
    r = np.deg2rad(POINTING["ROTATOR"])
    east, north = np.array(t["RA"]) - POINTING["RA"], np.array(t["DEC"]) - POINTING["DEC"]
    t["X"], t["Y"] = east * np.sin(r) + north * np.cos(r), east * np.cos(r) - north * np.sin(r)
    t.remove_columns(["RA", "DEC"])


def julian(t: Table) -> None:
    t["MJD"] = np.array(t["MJD"]) + 2_400_000.5


def kilokelvin(t: Table) -> None:
    t["TEFF"] = np.full(len(t), 5.6)
    t.remove_columns(["BP_RP", "BP_RP_ERR"])


def another_filter() -> Commands:
    t = Table.read("other.fits")
    t["FILTER"] = np.full(len(t), "SDSS-r")
    t.write("stars.fits", overwrite=True)
    return reduced(["stars.fits"])


def numbers_begin_anew(t: Table) -> None:
    """ID counts the stars of each half of the field: every number is there twice, of two stars."""
    t["ID"] = np.arange(len(t)) % (len(t) // 2)
    t.remove_columns(["SOURCE_ID", "RA", "DEC"])


def not_seen(t: Table) -> None:
    """Stars that E2 has not seen have −999 there."""
    t["N"][::9, 3], t["N_ERR"][::9, 3] = -999.0, -999.0


def exchanged_on_sky(columns: Table, camera: int) -> None:
    columns["ALPHA_J2000"], columns["DELTA_J2000"] = columns["DELTA_J2000"], columns["ALPHA_J2000"]


def same_file() -> Commands:
    return reduced(of_cameras(order=(0, 0, 2, 3)))


def exchanged_errors(t: Table) -> None:
    t["N"], t["N_ERR"] = np.array(t["N_ERR"]), np.array(t["N"])


def beside(t: Table) -> None:
    """ROTATOR is the position angle of +Y; X and Y are right, and nothing else is in the table."""
    t["ROTATOR"] = np.array(t["ROTATOR"]) + 90.0
    t.remove_columns(["RA", "DEC"])


ROTATED = Mistake(
    "ROTATOR of the pointing before", one(rotated(lambda r: r + 47.5)), "turned by −47.[0-9]*°|47.[0-9]* *°"
)
FURTHER = (
    Mistake(
        "E2 by a smaller aperture, 5 % fainter", one(scaled(3, 0.95)), r"E2 (fainter by [45]|were 1\.05)"
    ),
    Mistake("E1 exposed for 20 s, all others for 30 s", one(scaled(1, 2 / 3)), r"E1 were 1\.[45]"),
    Mistake(
        "O2 and E2 in data numbers of 1.6 electrons", one(scaled([2, 3], 1 / 1.6)), r"O2 and E2 were 1\.[56]"
    ),
    Mistake(
        "E1 joined by the number of the row, one off", one(shifted_rows), "E1.*(other stars|another star|row)"
    ),
    Mistake("a third of O2 matched with neighbours", one(mismatched), "O2.*(other stars|another star|match)"),
    Mistake(
        "sky not subtracted in any camera",
        one(with_light([0, 1, 2, 3], 2e4)),
        "electrons too many in every row of (O1 and E1 and O2 and E2|all)|[Ss]ky (is|was) ",
    ),
    Mistake("500 electrons of sky left in O2", one(with_light(2, 500.0)), "electrons too many in .*O2"),
    Mistake(
        "E1 without its flat field, 6 % along X", one(not_flat), "E1 (brighter|fainter) by [5-6].* edge .*X"
    ),
    Mistake("E2 not linear: −3 % at 10⁶ electrons", one(bent), "E2 fainter by [23].* 10⁶"),
    Mistake(
        "bright stars saturated, all at one number",
        one(clipped),
        "393210|393 210|3.93e|saturat|ceiling|full well",
    ),
    ROTATED,
    Mistake(
        "ROTATOR of +Y in place of +X",
        one(rotated(lambda r: r + 90.0)),
        "ROTATOR were .*90°.*3[45][.0-9]*° in place of 125°",
    ),
    Mistake("the pointing of date, stars of J2000", centre_of_date, "field centre lies 0.1[34]"),
    Mistake(
        "X and Y from the corner of the frame",
        one(placed(lambda x, y: (x + 0.25, y + 0.25))),
        "lay at X|field centre|corner",
    ),
    Mistake("X and Y without the cosine of DEC", one(without_cosine), "cos|stretch|right ascension"),
    Mistake(
        "scale of the pixels 10 % too large",
        one(placed(lambda x, y: (1.1 * x, 1.1 * y))),
        "(larger|smaller|scale).*1.1|0.9|10 %",
    ),
    Mistake("X and Y in radians", one(placed(lambda x, y: (np.deg2rad(x), np.deg2rad(y)))), "radian"),
    Mistake("MJD is the Julian Date", one(julian), "JD|Julian"),
    Mistake("N_ERR relative to N", one(errors(lambda n, s: s / n)), "N_ERR.*(relative|fraction|magnitude)"),
    Mistake(
        "N_ERR without read noise and sky, half as large",
        one(errors(lambda n, s: 0.5 * s)),
        "N_ERR is .*(too small|smaller)",
    ),
    Mistake("N_ERR per second of 30 s", one(errors(lambda n, s: s / 30)), "N_ERR is .*(too small|smaller)"),
    Mistake("TEFF in 1000 K", one(kilokelvin), "TEFF"),
    Mistake("FILTER of the exposure before: seen in NB-580", another_filter, "seen in NB-580", hidden=True),
    Mistake("ID begins anew: two stars of one ID", one(numbers_begin_anew), "ID"),
    Mistake("−999 where a star was not seen", one(not_seen), "-999|−999|E2", mended=True),
    Mistake(
        "right ascension and declination exchanged",
        cameras(change=exchanged_on_sky),
        "exchange|DEC|declination",
    ),
    Mistake(
        "DEC of the pointing without its sign",
        cameras(header=POINTING | {"DEC": 44.0}),
        "DEC|pointing|field centre|degrees? (away|from)",
    ),
    Mistake(
        "the file of O1 given twice, also as E1",
        same_file,
        "O1.*E1.*(same|equal|cop|repeat)|has the fluxes of a.fits: it is the same",
    ),
    Mistake(
        "N and N_ERR exchanged", one(exchanged_errors), "N_ERR.*exchange|exchange.*N_ERR|N_ERR.*in the place"
    ),
    Mistake("ROTATOR of +Y beside right X and Y, no RA, DEC", one(beside), "ROTATOR", hidden=True),
)


def answers(mistake: Mistake) -> dict[str, Any]:
    """What is said of a mistake, by the first command that stops or by apply; then by check."""
    for old in ("out.fits", "gathered.fits"):
        Path(old).unlink(missing_ok=True)
    commands = mistake.made()
    for command in commands:
        done = run_program(*command)
        if done.exit_code not in (0, 3):
            break
    lines = done.stdout.strip().splitlines() if done.exit_code in (0, 3) else []
    first = lines[0] if lines else done.stderr.strip().splitlines()[-1]
    said = {"what": mistake.what, "first": first, "apply": done.exit_code, "check": None, "check_first": ""}
    said["hidden"] = mistake.hidden
    whole = done.output
    if done.exit_code in (0, 3):
        table = commands[-1][2]
        again = run_program("check", RUN, table)
        text = again.stdout.strip() or again.stderr.strip()
        said |= {"check": again.exit_code, "check_first": text.splitlines()[0] if text else ""}
    named = re.search(mistake.named, whole if mistake.mended else first) is not None
    stops = said["apply"] != 0 or mistake.mended
    return said | {
        "named": named,
        "stops": stops,
        "of_check": re.search(mistake.named, said["check_first"]) is not None,
    }


def study(mistakes: Sequence[Mistake]) -> Iterator[dict[str, Any]]:
    """The answers to all mistakes, one after the other."""
    for mistake in mistakes:
        yield answers(mistake)


def main() -> None:
    """Print the study."""
    parser = options_of(__doc__)
    parser.add_argument("--folder", type=Path, default=Path("mistakes"))
    parser.add_argument("--only", default="")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    written = None if given.json is None else given.json.resolve()
    prepare(given.folder)
    every = {"table": TABLE, "further": FURTHER}
    told: dict[str, list[dict[str, Any]]] = {}
    for part, mistakes in every.items():
        told[part] = []
        for said in study([m for m in mistakes if given.only in m.what]):
            told[part].append(said)
            marks = (
                f"{'named' if said['named'] else 'NOT NAMED'}, exit {said['apply']}, check {said['check']}"
            )
            print(
                f"{said['what']}: {marks}\n    {said['first']}\n    check: {said['check_first']}", flush=True
            )
    for part, said in told.items():
        shown = [one for one in said if not one["hidden"]]
        named, stops = sum(one["named"] for one in shown), sum(one["stops"] for one in shown)
        hidden = f"; {len(said) - len(shown)} hidden" if len(said) > len(shown) else ""
        print(f"{part}: {named} of {len(shown)} named first, {len(shown) - stops} with exit code 0{hidden}")
    if written is not None:
        written.write_text(json.dumps(told, indent=1, ensure_ascii=False))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
