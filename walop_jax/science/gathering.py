"""Catalogues of single cameras made into one: a row a star, matched on the sky.

Positions of each camera are registered against those of the first: a shift or a rotation that a camera has and most
others have not is an error of its WCS, is taken out, and is remarked on. Then stars are matched that are nearest to
each other in both lists, within a tolerance; one with two candidates is ambiguous, marked as a blend in that camera.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from walop_jax.data.camera_catalogues import CameraCatalogue, time_of
from walop_jax.data.camera_headers import APART, centre_of, differ, letters, pointing_in
from walop_jax.data.units import Place
from walop_jax.data.user_tables import OF_STARS
from walop_jax.instruments.description import shipped
from walop_jax.io.errors import fail
from walop_jax.sky import directions
from walop_jax.sky.directions import FEWEST_REGISTERED, Pointing, Registration

BLEND = 8  # bit of N_FLAG
FEWEST = 0.2  # of the stars of a camera must be those of the others
MISSING = 0.2  # of the stars that all others see, from which on a camera is remarked on
SAME_FLUXES = 0.5  # of the stars of two cameras: one is a copy of the other
DIGITS = 1e-3  # to which cameras agree on a number of a star
BESIDE_WCS = (5.0 / 3600.0, 0.1)
"""Distance and angle (deg) from which on a pointing contradicts the WCS of an image."""
FARTHEST = 1.0  # deg: the median star of the field is nearer to its centre
CatalogueColumns = dict[str, tuple[np.ndarray, str, str]]  # values, unit and description of columns by name
Catalogues = Sequence[CameraCatalogue]
SkyPositions = Sequence[Float[np.ndarray, "_ 2"]]
Chosen = Bool[np.ndarray, "s k"]
MatchedRows = Int[np.ndarray, "s k"]
OnSky = Float[np.ndarray, "s 2"]


@dataclasses.dataclass(frozen=True)
class Gathered:
    """Columns of a catalogue with a row a star (files: catalogues), and remarks on how it came about.

    `registrations` are the shift and rotation of each camera against most others; `matched` counts cameras of each
    star.
    """

    columns: CatalogueColumns
    pointing: Pointing
    registrations: tuple[Registration, ...]
    matched: Int[np.ndarray, " n"]
    remarks: tuple[str, ...]


def pointing_of(catalogues: Catalogues, given: dict[str, float | None]) -> tuple[Pointing, list[str]]:
    """The pointing, as given, or from the headers, or from the WCS of an image; with remarks.

    A pointing that contradicts the WCS beside it is remarked on. Raises `DataError` where there is none, for headers
    that contradict each other, and for angles (deg) that cannot be meant.
    """
    first, remarks = catalogues[0], []
    needed = [name for name, value in given.items() if value is None]
    stated = dict[str, list[tuple[Any, float]]]()
    for camera in catalogues:
        mjd = time_of(camera.of_exposure)
        values, about = pointing_in(camera.headers, camera.worded, needed, mjd)
        for name, value in values.items():
            stated.setdefault(name, []).append((camera.path, value))
        remarks += [f"{camera.path}: {text}" for text in about if camera is first]
    for name, of_cameras in stated.items():
        if differ(name, [value for _, value in of_cameras]):
            listed = _listed([(path, f"{value:.6g}") for path, value in of_cameras])
            advice = f"give --{name.lower()} (deg), or correct the word that is wrong"
            raise fail(f"{name} is {listed} in the headers of one exposure", advice=advice)
    numbers = given | {name: of_cameras[0][1] for name, of_cameras in stated.items()}
    missing = [name for name, value in numbers.items() if value is None]
    centres = ((c.path, c.headers.wcs, time_of(c.of_exposure)) for c in catalogues)
    from_wcs = ((path, centre_of(wcs, Place(path, "header"), mjd)) for path, wcs, mjd in centres)
    path, centre = next(((path, found) for path, found in from_wcs if found), (first.path, None))
    if missing and centre is None:
        what = f"has no {' and no '.join(missing)} in its headers, and no WCS of an image"
        advice = f"give {' '.join(f'--{name.lower()} …' for name in missing)} (deg) to walop-jax gather"
        raise fail(what, file=first.path, advice=advice)
    if missing and centre is not None:
        numbers |= {name: centre[name] for name in missing}
        listed = ", ".join(f"{name} {centre[name]:.6g}" for name in missing)
        remarks.append(f"{path}: {listed} deg from the WCS: centre of the image, and its axis x as +X")
    values = {name: float(value) for name, value in numbers.items() if value is not None}
    for name, value in values.items():
        limit = 90.0 if name == "DEC" else 360.0
        if not abs(value) <= limit:
            what = f"{name} of the field centre is {value:g} deg"
            raise fail(what, file=first.path, advice=f"at most {limit:g} deg")
    if centre is not None:
        remarks += [f"{path}: {text}" for text in _beside_wcs(values, centre)]
    return Pointing(*values.values()), remarks


def _beside_wcs(values: dict[str, float], centre: dict[str, float]) -> list[str]:
    """Sentences on a pointing that is not that of the WCS of the image."""
    sentences = []
    away = float(directions.separation(values["RA"], values["DEC"], centre["RA"], centre["DEC"]))
    if away > BESIDE_WCS[0]:
        size = f"{60.0 * away:.3g} arcmin" if away > 1.0 / 60.0 else f"{3600.0 * away:.2g} arcsec"
        both = (f"RA {at['RA']:.6g}, DEC {at['DEC']:.6g}" for at in (values, centre))
        what = "{} deg as stated, {} deg in the centre of the image by its WCS".format(*both)
        sentences.append(
            f"{what}: {size} apart; which one is wrong? --ra and --dec give the centre of the field"
        )
    turned = (values["ROTATOR"] - centre["ROTATOR"] + 180.0) % 360.0 - 180.0
    if abs(turned) > BESIDE_WCS[1]:
        what = f"ROTATOR {values['ROTATOR']:.6g} deg as stated, axis x of the image at {centre['ROTATOR']:.6g} deg"
        advice = "right where x is not the direction of +X; else check the zero and the sign of ROTATOR (--rotator)"
        sentences.append(f"{what} by its WCS: {abs(turned):.3g} deg apart; {advice}")
    return sentences


def _listed(stated: Sequence[tuple[Any, str]]) -> str:
    """Values that differ, each with the first file that states it."""
    files = dict[str, Any]()
    for path, value in stated:
        files.setdefault(value, path)
    return " and ".join(f"{value} ({path})" for value, path in files.items())


def instrument_of(catalogues: Catalogues, asked: str) -> tuple[str, list[str]]:
    """The instrument that the catalogues state ("": none), and a remark where it is none that is known.

    `asked` is the name of the instrument that is asked for ("": none). Raises `DataError` for cameras of different
    instruments, and for another one than that asked for.
    """
    stated = [(camera.path, camera.instrument) for camera in catalogues if camera.instrument]
    if differ("INSTRUME", [name for _, name in stated]):
        advice = "give the catalogues of one instrument, or correct the word"
        raise fail(f"INSTRUME is {_listed(stated)} in catalogues of one exposure", advice=advice)
    if not stated:
        return "", []
    path, name = stated[0]
    known = next((shipped_name for shipped_name in shipped() if letters(shipped_name) == letters(name)), "")
    if not asked or letters(name) == letters(asked):
        return known or name, []
    if known:
        advice = f"give --instrument {known} to walop-jax gather (to apply: a calibration of it), or correct INSTRUME"
        raise fail(f"is {name}, {asked} is asked for", file=path, column="INSTRUME", advice=advice)
    return asked, [f"{path}: INSTRUME is {name!r}, which is no instrument that is known: taken as {asked}"]


def gather(
    catalogues: Catalogues, names: Sequence[str], pointing: Pointing, tolerance: float = 1.0
) -> Gathered:
    """One catalogue of the stars of all cameras; `names` are the names of the cameras, `tolerance` is in arcsec.

    Raises `DataError` for catalogues of different fields, and for catalogues with too few stars in common.
    """
    if len(fluxes := {camera.flux_name: camera for camera in catalogues}) > 1:
        what = " and ".join(f"{name} ({camera.path})" for name, camera in fluxes.items())
        advice = "one kind of flux, in one aperture, is needed of all cameras: name it with --columns"
        raise fail(f"cameras have different fluxes: {what}", advice=advice)
    places = [_place(camera, pointing) for camera in catalogues]
    moves = _registrations(catalogues, places, tolerance)
    texts = dict.fromkeys(text for camera in catalogues for text in camera.remarks)
    having = {text: [str(camera.path) for camera in catalogues if text in camera.remarks] for text in texts}
    remarks = [f"{', '.join(paths)}: {text}" for text, paths in having.items()]
    remarks += _about_moves(moves, names, tolerance)
    places = [move.apply(place) for move, place in zip(moves, places, strict=True)]
    index, ambiguous, place = _matched(places, tolerance)
    detected = index >= 0
    _check_common(catalogues, detected, tolerance)
    _check_distinct(catalogues, index)
    keep = detected.sum(axis=1) >= max(len(catalogues) - 1, min(len(catalogues), 2))
    if dropped := int(np.sum(~keep)):
        remarks.append(f"{dropped} stars that too few cameras see are left out of {len(keep)}")
    index, ambiguous, place, detected = index[keep], ambiguous[keep], place[keep], detected[keep]
    for k, name in enumerate(names):
        in_all_others = np.delete(detected, k, axis=1).all(axis=1)
        lost = int(np.sum(in_all_others & ~detected[:, k]))
        if lost > MISSING * max(int(in_all_others.sum()), 1):
            remarks.append(
                f"{name} lacks {lost} of the {int(in_all_others.sum())} stars that all other cameras see: is its "
                "detection threshold that of the others? Their q and u come from the others alone (FLAG 128)"
            )
    if doubtful := int(ambiguous.any(axis=1).sum()):
        what = f"have two candidates within {tolerance:g} arcsec: not used in that camera"
        remarks.append(f"{doubtful} stars {what}")
    columns, about = _columns(catalogues, pointing, index, ambiguous, place)
    return Gathered(columns, pointing, moves, detected.sum(axis=1), (*remarks, *about))


def _place(catalogue: CameraCatalogue, pointing: Pointing) -> Float[np.ndarray, "n 2"]:
    """Positions on the tangent plane (deg). Refuses a catalogue of another field."""
    away = directions.separation(pointing.ra, pointing.dec, catalogue.ra, catalogue.dec)
    if (typical := float(np.median(away))) > FARTHEST:
        centre = f"RA {pointing.ra:.5g}, DEC {pointing.dec:.5g} deg"
        what = f"its stars lie {typical:.3g} deg from the field centre {centre}"
        raise fail(what, file=catalogue.path, advice=_another_centre(catalogue, pointing))
    near = away < 60.0
    place = np.full((len(catalogue), 2), np.inf)
    place[near] = np.stack(pointing.field_of(catalogue.ra[near], catalogue.dec[near]), axis=1)
    return place


def _another_centre(catalogue: CameraCatalogue, pointing: Pointing) -> str:
    """What may be wrong with a centre that is far from all stars: the mistake that would put it among them."""
    ra, dec = pointing.ra, pointing.dec
    mistakes = {
        "is RA in hours?": (15.0 * ra, dec),
        "has DEC lost its sign?": (ra, -dec),
        "is RA in hours, and has DEC lost its sign?": (15.0 * ra, -dec),
    }
    for words, (there, up) in mistakes.items():
        away = directions.separation(there % 360.0, up, catalogue.ra, catalogue.dec)
        if float(np.median(away)) <= FARTHEST:
            return f"{words} Its stars would lie there; give degrees (--ra, --dec)"
    return "is it of another field? Is the centre in degrees (--ra, --dec)?"


def _registrations(
    catalogues: Catalogues, places: SkyPositions, tolerance: float
) -> tuple[Registration, ...]:
    """Shift and rotation of each camera, against the median of all."""
    first, moves = catalogues[0], [directions.NOT_MOVED]
    for camera, place in zip(catalogues[1:], places[1:], strict=True):
        move = directions.registered(place, places[0], _brightness(camera), _brightness(first), tolerance)
        if not move.pairs and min(len(place), len(places[0])) >= FEWEST_REGISTERED:
            apart = 60.0 * np.hypot(*(np.median(place, axis=0) - np.median(places[0], axis=0)))
            what = f"has no stars in common with {first.path} within {directions.REACH / 60.0:g} arcmin"
            where = f" (their centres are {apart:.2g} arcmin apart)" if apart > 1.0 else ""
            advice = "is it of the same field, and is its WCS right?"
            raise fail(what + where, file=camera.path, advice=advice)
        moves.append(move)
    shift = np.median([move.shift for move in moves], axis=0)
    rotation = float(np.median([move.rotation for move in moves]))
    return tuple(Registration(move.shift - shift, move.rotation - rotation, move.pairs) for move in moves)


def _brightness(catalogue: CameraCatalogue) -> Float[np.ndarray, " n"]:
    return np.nan_to_num(catalogue.flux, nan=-np.inf)


def _about_moves(moves: Sequence[Registration], names: Sequence[str], tolerance: float) -> list[str]:
    """Sentences on cameras that are shifted, or rotated by what moves the edge of the field."""
    edge = np.deg2rad([move.rotation for move in moves]) * 0.25 * 3600.0
    return [
        f"{name} is shifted by {move.shift[0]:+.1f} and {move.shift[1]:+.1f} arcsec along X and Y and rotated by "
        f"{60.0 * move.rotation:+.2g} arcmin against the others: taken out; its WCS is off"
        for name, move, turned in zip(names, moves, edge, strict=True)
        if np.hypot(*move.shift) > 0.5 * tolerance or abs(turned) > 0.5 * tolerance
    ]


def _matched(places: SkyPositions, tolerance: float) -> tuple[MatchedRows, Chosen, OnSky]:
    """The row of each star in every camera (-1: none), where that is ambiguous, and the mean position.

    The camera with the most stars begins; stars that only others see are added.
    """
    cameras = len(places)
    index = np.full((0, cameras), -1)
    ambiguous, place = np.zeros((0, cameras), bool), np.zeros((0, 2))
    for k in sorted(range(cameras), key=lambda k: -len(places[k])):
        doubtful, rows, stars = directions.mutual(places[k], place, tolerance)
        # Stars with another one of the same camera.
        doubtful |= directions.mutual(places[k], places[k], tolerance)[0]
        new = np.setdiff1d(np.arange(len(places[k])), rows)
        count = (index[stars] >= 0).sum(axis=1, keepdims=True)
        place[stars] = (count * place[stars] + places[k][rows]) / (count + 1)
        index[stars, k], ambiguous[stars, k] = rows, doubtful[rows]
        start = len(index)
        index = np.pad(index, ((0, len(new)), (0, 0)), constant_values=-1)
        ambiguous = np.pad(ambiguous, ((0, len(new)), (0, 0)))
        index[start:, k], ambiguous[start:, k] = new, doubtful[new]
        place = np.concatenate([place, places[k][new]])
    return index, ambiguous, place


def _check_common(catalogues: Catalogues, seen: Chosen, tolerance: float) -> None:
    """Refuse a camera that hardly shares stars with the others."""
    shared = seen & (seen.sum(axis=1, keepdims=True) > 1)
    for catalogue, count, common in zip(catalogues, seen.sum(axis=0), shared.sum(axis=0), strict=True):
        if common < FEWEST * count:
            what = f"{common} of its {count} stars are matched with those of other cameras"
            advice = "is it of the same field and WCS? --tolerance is in arcsec"
            raise fail(f"{what} within {tolerance:g} arcsec", file=catalogue.path, advice=advice)


def _check_distinct(catalogues: Catalogues, index: MatchedRows) -> None:
    """Refuse a camera with the fluxes of another one: noise does not repeat."""
    for first, second in itertools.combinations(range(len(catalogues)), 2):
        both = index[(index[:, [first, second]] >= 0).all(axis=1)]
        one, other = (catalogues[k].flux[both[:, k]] for k in (first, second))
        measured = np.isfinite(one) & np.isfinite(other) & (one != 0)
        if np.sum(one[measured] == other[measured]) > max(SAME_FLUXES * measured.sum(), 1):
            what = f"has the fluxes of {catalogues[first].path}: it is the same catalogue"
            raise fail(what, file=catalogues[second].path, advice="give that of each camera once")


def _columns(
    catalogues: Catalogues, pointing: Pointing, index: MatchedRows, ambiguous: Chosen, place: OnSky
) -> tuple[CatalogueColumns, list[str]]:
    def of_cameras(values: Sequence[np.ndarray], missing: Any) -> np.ndarray:
        of_each = zip(index.T, values, strict=True)
        return np.stack([np.where(row >= 0, column[row], missing) for row, column in of_each], axis=1)

    ra, dec = pointing.sky_of(*place.T)
    flag = of_cameras([camera.flag for camera in catalogues], 0) | np.where(ambiguous, BLEND, 0)
    columns: CatalogueColumns = {
        "RA": (ra, "deg", "right ascension, ICRS"),
        "DEC": (dec, "deg", "declination, ICRS"),
        "X": (place[:, 0], "deg", "field coordinate"),
        "Y": (place[:, 1], "deg", "field coordinate"),
        "ROTATOR": (pointing.rotator_at(ra, dec), "deg", "position angle of +X at the star"),
        "N": (of_cameras([camera.flux for camera in catalogues], np.nan), "", "electrons in each camera"),
        "N_ERR": (of_cameras([camera.error for camera in catalogues], np.nan), "", "standard errors of N"),
        "N_FLAG": (flag.astype(np.int32), "", "bits of each camera, 0 is good"),
    }
    if any(camera.blended.any() for camera in catalogues):
        near = of_cameras([camera.blended for camera in catalogues], False).any(axis=1)
        columns["BLENDED"] = (np.asarray(near), "", "another star is near, by the flags of a camera")
    if levels := [camera.sky for camera in catalogues if camera.sky is not None]:
        if len(levels) < len(catalogues):
            what = "only some cameras have a level of the sky"
            raise fail(what, column="SKY", advice="give it for all, or none")
        columns["SKY"] = (of_cameras(levels, np.nan), "", "level of the sky that was subtracted, electrons")
    remarks = []
    for name, (unit, about) in OF_STARS.items():
        if not any(name in camera.of_stars for camera in catalogues):
            continue
        texts = name == "SOURCE_ID"
        empty = "" if texts else np.nan
        columns_of = [camera.of_stars.get(name, np.full(len(camera), empty)) for camera in catalogues]
        values, apart = _agreed(of_cameras(columns_of, empty), texts)
        if count := int(apart.sum()):
            remarks.append(f"{name} is not the same in all cameras for {count} stars: taken as unknown")
        columns[name] = (whole(values) if texts else values, unit, about)
    for name in sorted({name for camera in catalogues for name in camera.of_exposure}):
        stated = [(camera.path, camera.of_exposure.get(name, "not stated")) for camera in catalogues]
        apart = differ(name, [value for _, value in stated if name not in APART or value != "not stated"])
        if apart:
            listed = _listed([(path, str(value)) for path, value in stated])
            raise fail(f"{name} is {listed} in catalogues of one exposure", advice="correct it")
        value = next(camera.of_exposure[name] for camera in catalogues if name in camera.of_exposure)
        columns[name] = (np.full(len(ra), value), "", "of the exposure")
    return columns, remarks


def _agreed(values: np.ndarray, texts: bool) -> tuple[np.ndarray, Bool[np.ndarray, " s"]]:
    """The value that all cameras that have one agree on, and where they do not."""
    stated = values != "" if texts else np.isfinite(values.astype(float))
    first = np.where(stated.any(axis=1), stated.argmax(axis=1), 0)
    value = values[np.arange(len(values)), first]
    if texts:
        same = values == value[:, None]
    else:
        same = np.isclose(values.astype(float), value.astype(float)[:, None], rtol=DIGITS, atol=DIGITS)
    differ = np.asarray(np.any(stated & ~same, axis=1))
    return np.where(differ, "" if texts else np.nan, value), differ


def whole(values: np.ndarray) -> np.ndarray:
    """Identifiers as integers where all are such, -1 for unknown ones."""
    texts = np.where(values == "", "-1", values.astype(str))
    integers = all(text.lstrip("-").isdigit() for text in texts.tolist())
    return texts.astype(np.int64) if integers else values.astype(str)
