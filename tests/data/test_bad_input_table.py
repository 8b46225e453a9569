"""Fifty-five bad inputs, one row each, and the class of answer that each must get.

E  refused, with an error that names file, place and remedy;
M  masked, counted and said, the rest used;
F  used and marked: by a remark, a finding of `inspect`, a bit of QUALITY, or a fit that is not to be trusted;
S  no fault at all: the answer is that of the good input.

What needs a fit, a sampler or a process of its own is tested where that is at home: `ELSEWHERE` says where.
"""

from __future__ import annotations

import ast
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from handmade_set import Handmade

from walop_jax.data.calset import read_calibration_set
from walop_jax.data.inspection import inspect
from walop_jax.data.records import CalibrationSet
from walop_jax.fit.base_model import base_model
from walop_jax.fit.model_of_set import model_for
from walop_jax.fit.search import check_identifiable
from walop_jax.io.errors import DataError
from walop_jax.likelihood.likelihood import Likelihood

NAN = float("nan")
TESTS = Path(__file__).parents[1]
E, P, I, F = "EXPOSURES", "POINTS", "INTENSITIES", "FILTERS"  # noqa: E741 - as in the tables
Change = Callable[[Handmade], object]
ROWS: list[tuple[str, str, str, Change, str]] = []


def row(number: str, what: str, asked: str, says: str = "") -> Callable[[Change], Change]:
    """A row of the table: its number, the input, the classes of answer that will do, and what must be said."""

    def add(change: Change) -> Change:
        ROWS.append((number, what, asked, change, says))
        return change

    return add


def put(table: str, column: str, where, value) -> Change:
    def change(made: Handmade) -> None:
        made.values(table, column)[where] = value

    return change


def columns(table: str, **new) -> Change:
    """Other columns, as [FITS format, unit, values]; None takes one away."""

    def change(made: Handmade) -> None:
        for name, entry in new.items():
            if entry is None:
                del made[table][name]
            else:
                made[table][name] = entry

    return change


def angles(*values: float) -> Change:
    return put(E, "CLP_ANGLE", slice(0, 5), np.array(values))


row("1", "NaN in a few data", "M", "not finite or below −5 sigma in row 5")(put(I, "N", (5, 2), NAN))
row("1", "NaN in every fourth row", "E", "25 % of the rows")(put(I, "N", (slice(0, 6), 2), NAN))
row("2", "inf in a few data", "M", "not finite or below −5 sigma in row 5")(put(I, "N", (5, 2), np.inf))
row("2", "inf among the errors", "M", "in row 6")(put(I, "N_ERR", (6, 0), np.inf))
row("3", "an error of zero", "E", "N_ERR: is zero or negative in row 4")(put(I, "N_ERR", (4, 2), 0.0))
row("3", "a negative error", "E", "N_ERR: is zero or negative in row 4")(put(I, "N_ERR", (4, 2), -1.0))
row("5", "saturated rows, flagged", "MF", "2 rows are saturated")(put(I, "FLAG", slice(3, 5), 1))
row("7", "slightly negative counts", "S")(
    lambda made: (put(I, "N", 8, [-30.0, 20, 5, 0])(made), put(I, "N_ERR", 8, 30.0)(made))
)
row("7", "counts far below zero", "M", "not finite or below −5 sigma in row 8")(put(I, "N", (8, 0), -1e4))
row("8", "a camera lacks in an exposure", "MF", "no used row for exposure(s) 11")(
    put(I, "N", (slice(3, 6), 1), NAN)
)
row("9", "a camera lacks everywhere", "E", "no data at all in N[1]")(put(I, "N", (slice(None), 1), NAN))
row("12", "angles in radians", "E", "are these radians?")(
    angles(*np.deg2rad([0.0, 36.0, 72.0, 108.0, 144.0]))
)
row("15", "field in arcminutes", "E", "are these arcmin or pixels?")(
    put(P, "X", slice(None), [-12.0, 0.0, 15.0])
)
row("16", "wavelengths in nm", "E", "are these nm or Angstrom?")(
    put(F, "WAVELENGTH", (0, slice(0, 3)), [570.0, 580, 590])
)
row("16", "wavelengths in Å", "E", "are these nm or Angstrom?")(
    put(F, "WAVELENGTH", (0, slice(0, 3)), [5700.0, 5800, 5900])
)
row("20", "two polariser angles", "E", "at least 3")(angles(0.0, 90.0, 0.0, 90.0, 180.0))
row("21", "angles within 30°", "F", "all polariser angles lie within")(angles(0.0, 6.0, 12.0, 18.0, 24.0))
row("23", "a point outside the field", "E", "[POINTS] Y: lies outside ±0.35°")(put(P, "Y", 1, 0.4))
row("27", "no instrument", "E", "[PRIMARY] INSTRUME")(lambda made: made.header.pop("INSTRUME"))
row("27", "an unknown filter", "E", "[EXPOSURES] FILTER: 'SDSS-i'")(put(E, "FILTER", 2, "SDSS-i"))
row("32", "text in a column of numbers", "E", "holds strings")(
    columns(P, X=["4A", None, np.array(["1", "b", "2"])])
)
row("39", "constant data", "E", "[INTENSITIES] N: all counts are equal (5)")(put(I, "N", slice(None), 5.0))


@row("11", "columns in another order", "S")
def _(made: Handmade) -> None:
    made.tables[I] = dict(reversed(made[I].items()))


@row("11", "a column under another name", "E", "[INTENSITIES] N_ERR: the column is missing")
def _(made: Handmade) -> None:
    made[I]["SIGMA"] = made[I].pop("N_ERR")


@row("17", "an exposure twice", "MF", "exposures 10 and 11 are the same to the last bit")
def _(made: Handmade) -> None:
    twice(made)
    for name in ("N", "N_ERR"):
        made.values(I, name)[3:6] = made.values(I, name)[:3]


@row("18", "one time for two exposures", "E", "exposures 10 and 11")
def twice(made: Handmade) -> None:
    for name, entry in made[E].items():
        if name != "EXPOSURE":
            entry[2][1] = entry[2][0]


@row("19", "exposures out of order", "S")
def _(made: Handmade) -> None:
    order = np.array([3, 0, 7, 5, 1, 6, 2, 4])
    for entry in made[E].values():
        entry[2] = entry[2][order]


@row("19", "no times", "F", "MJD: column missing")
def _(made: Handmade) -> None:
    made.values(E, "KIND")[6] = "flux"
    del made[E]["MJD"]


@row("22", "a single field point", "E", "a single field point")
def _(made: Handmade) -> None:
    for entry in made[P].values():
        entry[2] = entry[2][:1]
    for entry in made[I].values():
        entry[2] = entry[2][::3]


@row("24", "no rows", "E", "[INTENSITIES]: has no rows")
def _(made: Handmade) -> None:
    for entry in made[I].values():
        entry[2] = entry[2][:0]


@row("26", "unsigned 16 bit whose offset was lost", "E", "far below zero")
def _(made: Handmade) -> None:
    unsigned = np.full((24, 4), 40000, np.uint16) + np.arange(96, dtype=np.uint16).reshape(24, 4)
    made[I]["N"] = ["4I", "electron", (unsigned.astype(int) - 65536).astype(np.int16)]


@row("29", "every array big-endian, as FITS has it", "S")
def _(made: Handmade) -> None:
    for name in ("N", "N_ERR"):
        made.values(I, name)[:] = made.values(I, name).astype(">f8")


@row("30", "whole numbers", "S")
def _(made: Handmade) -> None:
    made[I]["N"] = ["4J", "electron", made.values(I, "N").astype(int)]


@row("33", "no units", "S")
def _(made: Handmade) -> None:
    for table in made.tables.values():
        for entry in table.values():
            entry[1] = None


@row("36", "a cloud: less light in one exposure, unevenly", "S")
def _(made: Handmade) -> None:
    factor = np.repeat([0.9, 0.5, 0.2], 1)[:, None]
    for name in ("N", "N_ERR"):
        made.values(I, name)[3:6] *= factor


def answer(path: Path, good: CalibrationSet) -> tuple[str, str]:
    """The classes of answer that a file gets, and all that is said of it."""
    try:
        calset = read_calibration_set(path)
        check_identifiable(Likelihood.of(calset, base_model(calset, throughput_degree=1)))
    except DataError as error:
        return "E", str(error)
    findings = [f.what for f in inspect(calset).findings]
    new = [f for f in findings if f not in [g.what for g in inspect(good).findings]]
    masked = calset.intensities.rows < good.intensities.rows
    marked = bool(new) or len(calset.remarks) > len(good.remarks)
    found = ("M" if masked else "") + ("F" if marked else "")
    if not found:
        assert calset.intensities.rows == good.intensities.rows
    return found or "S", "; ".join([*calset.remarks, *new])


@pytest.mark.parametrize(
    ("asked", "change", "says"), [r[2:] for r in ROWS], ids=[f"{r[0]} {r[1]}" for r in ROWS]
)
def test_the_answer_is_of_the_class_asked_for(tmp_path, asked, change, says):
    good = read_calibration_set(Handmade(tmp_path).write("good.fits"))
    bad = Handmade(tmp_path)
    change(bad)
    found, said = answer(bad.write(), good)
    assert set(asked) <= set(found) if asked != "S" else found == "S", said
    assert says in said
    if found == "E":
        assert "set.fits" in said


ELSEWHERE = {
    "4": "diagnosis/test_mixups.py::test_errors_that_are_far_too_small_are_told_from_a_wrong_model",
    "6": "diagnosis/test_blind.py::test_verdicts_on_hidden_effects",
    "10": "diagnosis/test_mixups.py::test_every_mix_up_is_told_with_its_remedy",
    "13": "diagnosis/test_mixups.py::test_every_mix_up_is_told_with_its_remedy",
    "14": "diagnosis/test_mixups.py::test_every_mix_up_is_told_with_its_remedy",
    "25": "data/test_bad_inputs.py::test_truncated_file",
    "28": "diagnosis/test_mixups.py::test_every_mix_up_is_told_with_its_remedy",
    "34": "diagnosis/test_trust.py::test_a_mistake_in_the_data_is_not_trusted",
    "35": "diagnosis/test_mixups.py::test_every_mix_up_is_told_with_its_remedy",
    "37": "paper/test_full_moon.py::test_a_patch_that_is_not_rayleigh_is_found_and_does_no_harm",
    "31": "test_float32_sessions.py::test_numbers_that_have_lost_their_digits_are_refused",
    "38": "fit/test_outliers.py::test_cosmic_rays_are_flagged_and_nothing_else",
    "42": "model/effects/test_effects_contract.py::test_neutral_and_derivatives",
    "43": "diagnosis/test_detection_limits.py::test_two_effects_that_do_the_same_are_told_as_a_class",
    "44": "commands/test_refit_run.py::test_a_fit_that_does_not_converge_leaves_no_calibration",
    "45": "posterior/test_chains.py::test_a_killed_run_loses_one_block_and_ends_up_the_same",
    "46": "posterior/test_chains.py::test_a_chain_comes_back_and_refuses_what_is_not_its_own",
    "47": "posterior/test_full_disk.py::test_full_disk_is_an_error_and_leaves_nothing_half_written",
    "48": "io/test_folder.py::test_the_second_of_two_writers_is_told_who_the_first_is",
    "49": "io/test_folder.py::test_a_read_only_folder_is_refused",
    "50": "data/test_cells.py::test_pixels_are_read_piece_by_piece",
    "51": "likelihood/test_runner.py::test_an_error_in_one_part_ends_the_pass",
    "52": "calibration/test_product.py::test_what_is_not_as_written_is_refused",
    "53": "commands/test_tables.py::test_a_filter_that_the_calibration_does_not_cover_is_refused_unless_forced",
    "54": "commands/test_program.py::test_a_path_that_is_not_utf_8",
    "55": "data/test_hostile_headers.py::test_impossible_counts_are_refused_by_name",
}

PLATE = "half1.plate.quartz"
MODELS = {
    "40": ("a start value that is not finite", f'[parameters."{PLATE}"]\nstart = nan'),
    "41": ("a prior without width", f'[parameters."{PLATE}"]\nprior = [2400.0, 0.0]'),
    "41b": ("a prior of a parameter that is none", '[parameters."half1.plate.quarz"]\nprior = [1.0, 1.0]'),
}


@pytest.mark.parametrize("number", MODELS)
def test_models_that_cannot_be_are_refused_before_anything_is_compiled(tmp_path, number):
    calset = read_calibration_set(Handmade(tmp_path).write())
    with pytest.raises(ValueError, match=PLATE):
        model_for(calset, MODELS[number][1])


NUMBERS = [*(r[0] for r in ROWS), *(n.rstrip("b") for n in MODELS), *ELSEWHERE]


def test_the_table_is_complete():
    """Every number from 1 to 55, and every test that is named is there."""
    assert sorted(set(NUMBERS), key=int) == [str(n) for n in range(1, 56)]
    for place in ELSEWHERE.values():
        file, name = place.split("::")
        tree = ast.parse((TESTS / file).read_text(encoding="utf-8"))
        assert name in {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}, place
