"""Schedules of the survey: fields and ranges of format v4, typed from its description; read back as written."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.coordinates import AltAz, EarthLocation, SkyCoord
from astropy.time import Time

import walop_jax as walop
from walop_jax.data.kinds import CALIBRATION_PLATE
from walop_jax.data.records import Exposures, Position
from walop_jax.data.schedule import read_schedule, schedule_of
from walop_jax.io.errors import DataError
from walop_jax.io.text import json_text
from walop_jax.plans.schedule import scheduled
from walop_jax.simulation.observing_plan import ObservingPlan, Stop, polariser_turn

FILTERS = {"SDSS-r": 1, "NB-660": 3}
TYPES = [
    "PAS", "SCI", "CAL-UPO", "CAL-POL", "CAL-MOO", "CAL-CAL", "TES-SOF", "TES-HAR", "TES-E2E", "TES-TES", "LAB-OPT",
    "LAB-MEC", "LAB-CCD", "LAB-SOF", "LAB-LAB",
]  # fmt: skip
TIME = r"([01]\d|2[0-3]):[0-5]\d:[0-5]\d"
PLAN = ObservingPlan(
    grid=2, standard_grid=1, polariser_angles=polariser_turn(4), moon_patches=2, standards=3,
    filters=("SDSS-r", "NB-660"), plate=(None, 22.5),
)  # fmt: skip


def validate(schedule: dict[str, Any]) -> None:
    """What the format asks for: required fields, their kinds, ranges and patterns; nothing beyond them."""
    assert set(schedule) == {"name", "date", "pi", "mode", "observer", "objects", "targets"}
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", schedule["date"])
    assert schedule["mode"] in ("manual", "auto")
    assert all(1 <= len(schedule[key]) <= 100 for key in ("name", "pi", "observer"))
    for one in schedule["objects"]:
        assert 1 <= len(one["name"]) <= 100
        assert re.fullmatch(r"[+-]?([01]\d|2[0-3]):[0-5]\d:[0-5]\d(\.\d\d?)?", one["ra"])
        assert re.fullmatch(r"[+-]?[0-8]\d:[0-5]\d:[0-5]\d(\.\d\d?)?", one["dec"])
    assert schedule["targets"]
    for target in schedule["targets"]:
        assert set(target) == {"target", "type", "acquisition"}
        assert target["type"] in TYPES
        assert target["acquisition"]
        for one in target["acquisition"]:
            assert set(one) == {"window", "guider", "filter", "hwp", "polarizer", "exposure"}
            assert all(re.fullmatch(TIME, one["window"][edge]) for edge in ("start", "end"))
            assert type(one["filter"]) is int
            assert 1 <= one["filter"] <= 4
            assert isinstance(one["guider"], bool)
            assert all(
                type(one["exposure"][key]) is int and one["exposure"][key] >= 1 for key in ("multiples", "T")
            )
            for state in (one["hwp"], one["polarizer"]):
                assert isinstance(state["engage"], bool)
                assert isinstance(state["continuous"], bool)
                assert ("angle" in state) == (state["engage"] and not state["continuous"])
                assert ("speed" in state) == state["continuous"]
                assert 0 <= state.get("angle", 0) <= 360
                assert 0 <= state.get("speed", 0) <= 3.0


def same(one: Exposures, columns: dict[str, np.ndarray]) -> None:
    """Everything that a schedule states."""
    two = Exposures.from_columns(columns)
    assert one.kind.tolist() == two.kind.tolist()
    assert one.filter.tolist() == two.filter.tolist()
    np.testing.assert_array_equal(one.exptime, two.exptime)
    sky = np.isfinite(one.ra)
    np.testing.assert_allclose(two.ra[sky], one.ra[sky], atol=1e-4)
    np.testing.assert_allclose(two.dec[sky], one.dec[sky], atol=1e-5)
    for prefix in one.positions:
        a, b = one.positions[prefix], two.positions[prefix]
        np.testing.assert_array_equal(a.inside, b.inside)
        np.testing.assert_array_equal(a.turn, b.turn)
        still = a.inside & (a.turn == 0)
        np.testing.assert_allclose(b.angle[still], np.mod(a.angle[still], 360.0), atol=1e-12)


def written(path: Path, exposures: Exposures, **options) -> dict[str, Any]:
    names = [f"target {e}" for e in range(len(exposures))] if np.isfinite(exposures.ra).any() else None
    schedule, remarks = schedule_of(
        exposures, PLAN.site, FILTERS, names=options.pop("names", names), **options
    )
    assert remarks == []
    path.write_text(json.dumps(schedule))
    return schedule


def test_a_plan_with_filters_plate_and_sky(tmp_path: Path):
    """16 exposures through the polariser in four settings, patches, standards: validated, and read back the same."""
    exposures = PLAN.exposures()
    schedule = written(tmp_path / "s.json", exposures)
    validate(schedule)
    again, remarks = read_schedule(tmp_path / "s.json", FILTERS)
    same(exposures, again)
    assert "their time is not known" in remarks[0]
    assert {target["type"] for target in schedule["targets"]} == {"CAL-CAL", "CAL-MOO", "CAL-POL"}


def test_standards_of_a_schedule_are_stars_that_are_up():
    """Those of the package, zero or not as in the plan, at least 30° high by astropy; others are said to be none."""
    document, said = scheduled(PLAN, None, "s.json")
    remarks, schedule = "; ".join(said), json.loads(json_text(document))
    validate(schedule)
    place = {
        one["name"]: SkyCoord(one["ra"], one["dec"], unit=("hourangle", "deg")) for one in schedule["objects"]
    }
    table = walop.standards()
    rows = {str(name): row for name, row in zip(table["NAME"], table, strict=True)}
    targets = {target["target"]: target["type"] for target in schedule["targets"] if target["target"] in rows}
    assert targets
    site = EarthLocation(lon=PLAN.site.longitude, lat=PLAN.site.latitude, height=PLAN.site.elevation)
    when = Time(PLAN.exposures().mjd[-3:], format="mjd")  # the standards come last
    for name, kind in targets.items():
        assert (kind == "CAL-UPO") == (rows[name]["P"] < 0.005)
        assert place[name].separation(SkyCoord(rows[name]["RA"], rows[name]["DEC"])).arcsec < 0.2
        assert place[name].transform_to(AltAz(obstime=when, location=site)).alt.deg.max() > 30.0
        assert f"is {name}" in remarks
    fictitious = {f"STD{k:02d}" for k in range(3)} & set(place)
    assert len(fictitious) + len(targets) == 3
    assert all(name in remarks.partition("no standard of the package")[0] for name in fictitious)


def test_exposures_that_follow_each_other_are_multiples(tmp_path: Path):
    stops = (Stop(0.0, times=3, seconds=20.0), Stop(45.0, times=2, seconds=20.0), Stop(0.0, seconds=20.0))
    plan = dataclasses.replace(PLAN, stops=stops, patches=(), stars=())
    schedule = written(tmp_path / "s.json", plan.exposures())
    validate(schedule)
    (target,) = schedule["targets"]
    assert [one["exposure"]["multiples"] for one in target["acquisition"]] == [3, 2, 1]
    same(plan.exposures(), read_schedule(tmp_path / "s.json", FILTERS)[0])


def test_a_turning_plate_a_change_of_filter_and_windows(tmp_path: Path):
    """A plate at 3 turns a minute: 540 deg in 30 s; the window is local time, half an hour wider on both sides."""
    exposures = PLAN.exposures()[24:29] if len(PLAN.exposures()) > 29 else PLAN.exposures()[-5:]
    exposures = dataclasses.replace(exposures, exptime=np.full(5, 30.0))
    turning = Position(np.ones(5, bool), np.zeros(5), np.array([540.0, 540.0, 0.0, 180.0, 0.0]))
    exposures = exposures.placed(**{CALIBRATION_PLATE: turning})
    exposures = dataclasses.replace(
        exposures, filter=np.array(["SDSS-r", "SDSS-r", "NB-660", "NB-660", "SDSS-r"])
    )
    schedule = written(tmp_path / "s.json", exposures)
    validate(schedule)
    states = [one["hwp"] for target in schedule["targets"] for one in target["acquisition"]]
    assert states[0] == {"engage": True, "continuous": True, "speed": 3.0}
    same(exposures, read_schedule(tmp_path / "s.json", FILTERS)[0])
    # Site at 20.81 deg east: UTC + 1 h.
    begin = exposures.mjd[0] - 15.0 / 86400.0
    seconds = ((begin + 1.0 / 24.0 - 0.5 / 24.0) % 1.0) * 86400.0
    hours, minutes, rest = schedule["targets"][0]["acquisition"][0]["window"]["start"].split(":")
    assert 3600 * int(hours) + 60 * int(minutes) + int(rest) == pytest.approx(seconds, abs=1.0)


@pytest.mark.parametrize("longitude", [-70.4, 289.6])
def test_the_night_is_that_of_the_site_however_its_longitude_is_counted(longitude):
    """Exposures from 01:37 UTC of New Year's Day on: in Chile, UTC − 5 h, it is still the evening before."""
    plan = dataclasses.replace(PLAN, mjd=Time("2026-01-01T03:00:00").mjd)
    site = dataclasses.replace(PLAN.site, latitude=-24.6, longitude=longitude)
    schedule, _ = schedule_of(plan.exposures(), site, FILTERS)
    assert schedule["date"] == "2025-12-31"
    assert schedule["targets"][1]["acquisition"][0]["window"]["start"] == "21:29:30"


def test_patches_of_the_moon_sky_keep_their_places_without_names(tmp_path: Path):
    exposures = PLAN.exposures()
    exposures = dataclasses.replace(exposures, ra=exposures.ra + 0.1 * np.arange(len(exposures)))
    schedule, _ = schedule_of(exposures, PLAN.site, FILTERS)
    (tmp_path / "s.json").write_text(json.dumps(schedule))
    same(exposures, read_schedule(tmp_path / "s.json", FILTERS)[0])


def test_an_executed_schedule_has_times(tmp_path: Path):
    exposures = PLAN.exposures()
    schedule = written(tmp_path / "s.json", exposures)
    mjd = iter(exposures.mjd - exposures.exptime / 2.0 / 86400.0)
    epoch = np.datetime64("1858-11-17T00:00:00.000000")
    for target in schedule["targets"]:
        for one in target["acquisition"]:
            began = (
                epoch + np.timedelta64(round(next(mjd) * 86400e6), "us")
                for _ in range(one["exposure"]["multiples"])
            )
            one["executed"] = [f"{time}Z" for time in began]
    (tmp_path / "done.json").write_text(json.dumps(schedule))
    again, remarks = read_schedule(tmp_path / "done.json", FILTERS)
    assert remarks == []
    np.testing.assert_allclose(again["MJD"], exposures.mjd, atol=1e-9)
    (tmp_path / "words.toml").write_text('filters = { "SDSS-r" = 1, "NB-660" = 3 }\n')
    table = walop.exposures(tmp_path / "done.json", words=tmp_path / "words.toml")
    np.testing.assert_allclose(table["MJD"], exposures.mjd, atol=1e-9)
    assert table["CHWP_ANGLE"].unit == "deg"


def test_a_file_of_json_is_parsed_once(tmp_path: Path, monkeypatch):
    """To see whether it is a schedule, and for its exposures, as a schedule and as a log."""
    written(tmp_path / "schedule.json", PLAN.exposures())
    (tmp_path / "log.json").write_text('[{"TYPE": "clp", "ANGLE": 30.0}]')
    (tmp_path / "words.toml").write_text(
        'filters = { "SDSS-r" = 1, "NB-660" = 3 }\n[KIND]\nword = "TYPE"\n[CLP_ANGLE]\nword = "ANGLE"\n'
    )
    calls, loads = [], json.loads
    monkeypatch.setattr(json, "loads", lambda text: calls.append(text) or loads(text))
    assert len(walop.exposures(tmp_path / "schedule.json", words=tmp_path / "words.toml")) > 1
    assert len(walop.exposures(tmp_path / "log.json", words=tmp_path / "words.toml")) == 1
    assert len(calls) == 2


def one_turning(turn: float, seconds: float = 30.0) -> Exposures:
    exposures = dataclasses.replace(PLAN.exposures()[:1], exptime=np.array([seconds]))
    return exposures.placed(**{CALIBRATION_PLATE: Position(np.ones(1, bool), np.zeros(1), np.array([turn]))})


@pytest.mark.parametrize(
    ("exposures", "filters", "message"),
    [
        (one_turning(720.0), FILTERS, r"CHWP_TURN: 720 deg in 30 s is 4 turns a minute"),
        (one_turning(100.0), FILTERS, r"CHWP_TURN: a turn of 100 deg is none of half turns.*multiple of 180"),
        (PLAN.exposures(), {"SDSS-r": 1}, r"FILTER: filter NB-660 has no number"),
        (PLAN.exposures(), {"SDSS-r": 5, "NB-660": 1}, "no number from 1 to 4"),
        (PLAN.exposures(), {"SDSS-r": 1, "NB-660": 1}, "two filters have the number 1"),
        (
            PLAN.exposures()[:1].placed(HWP=Position.at([22.5])),
            FILTERS,
            "HWP_ANGLE: a schedule cannot set HWP",
        ),
        (
            dataclasses.replace(PLAN.exposures(), mjd=np.full(len(PLAN.exposures()), np.nan)),
            FILTERS,
            "MJD: no exposure has a time; a schedule needs the date of its night",
        ),
    ],
)
def test_what_a_schedule_cannot_state_is_told(exposures, filters, message):
    with pytest.raises(DataError, match=message):
        schedule_of(exposures, PLAN.site, filters)


def test_times_that_are_no_whole_seconds_are_told():
    exposures = dataclasses.replace(PLAN.exposures()[:2], exptime=np.array([20.4, 30.0]))
    schedule, remarks = schedule_of(exposures, PLAN.site, FILTERS)
    validate(schedule)
    assert remarks == ["1 exposure times are no whole seconds (20.4 s): rounded"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda one: one.pop("exposure"), r"target target 0, acquisition 0.*has no 'exposure'"),
        (lambda one: one.update(filter=2), "filter 2 has no name"),
        (
            lambda one: one.update(hwp={"engage": True, "continuous": True, "speed": 1.1}),
            "none of half turns",
        ),
        (lambda one: one.update(polarizer={"engage": True, "continuous": True, "speed": 1}), "turns during"),
        (lambda one: one.update(executed=["soon"]), r"executed: 'soon' is no time"),
        (lambda one: one.update(executed=[]), None),
        (lambda one: one["exposure"].update(multiples=10**9), "multiples = 1000000000 must be between 1 and"),
        (lambda one: one["exposure"].update(multiples=0), "multiples = 0 must be between 1 and"),
        (lambda one: one["exposure"].update(T="30"), "T = '30' must be a finite number"),
        (lambda one: one["exposure"].update(T=-5), "T = -5 must be above 0"),
        (lambda one: one["polarizer"].update(angle=None), "angle = None must be a finite number"),
        (lambda one: one["polarizer"].update(angle=1e6), "angle = 1e.06 must be between 0 and 360"),
        (lambda one: one.update(hwp=None), "hwp = None must be a table"),
        (lambda one: one.update(filter=[1]), r"filter = \[1\] must be a whole number"),
        (lambda one: one.update(filter=True), "filter = True must be a whole number"),
        (
            lambda one: one.update(hwp={"engage": True, "continuous": True, "speed": 6}),
            "speed = 6 must be at most 3 turns a minute",
        ),
    ],
)
def test_what_cannot_be_read_back_is_told(tmp_path: Path, change, message):
    schedule = written(tmp_path / "s.json", PLAN.exposures())
    change(schedule["targets"][0]["acquisition"][0])
    (tmp_path / "s.json").write_text(json.dumps(schedule))
    if message is None:
        read_schedule(tmp_path / "s.json", FILTERS)
        return
    with pytest.raises(DataError, match=message):
        read_schedule(tmp_path / "s.json", FILTERS)


@pytest.mark.parametrize(
    ("coordinates", "message"),
    [
        ({"ra": "25:00:00"}, "'25:00:00' is no angle"),
        ({"ra": "05:75:00"}, "'05:75:00' is no angle"),
        ({"dec": "+95:00:00"}, r"DEC: exceeds ±90"),
        ({"ra": None}, "target 16, .*: no object with RA and DEC, where these are is not known"),
    ],
)
def test_objects_without_a_place_on_the_sky_are_told(tmp_path: Path, coordinates, message):
    schedule = written(tmp_path / "s.json", PLAN.exposures())
    for entry in schedule["objects"]:
        entry.update(coordinates)
    (tmp_path / "s.json").write_text(json.dumps(schedule))
    if coordinates == {"ra": None}:
        assert re.search(message, "; ".join(read_schedule(tmp_path / "s.json", FILTERS)[1]))
        return
    with pytest.raises(DataError, match=message):
        read_schedule(tmp_path / "s.json", FILTERS)


def test_exposures_of_science_are_left_out_and_other_types_refused(tmp_path: Path):
    schedule = written(tmp_path / "s.json", PLAN.exposures())
    schedule["targets"][-1]["type"] = "PAS"
    (tmp_path / "s.json").write_text(json.dumps(schedule))
    again, remarks = read_schedule(tmp_path / "s.json", FILTERS)
    assert len(again["TARGET"]) == len(PLAN.exposures()) - 1
    assert schedule["targets"][-1]["target"] not in again["TARGET"]
    assert "no calibration (PAS and SCI), left out" in "; ".join(remarks)
    schedule["targets"][-1]["type"] = "CAL-XXX"
    (tmp_path / "s.json").write_text(json.dumps(schedule))
    with pytest.raises(DataError, match="has the type CAL-XXX; give one of format v4"):
        read_schedule(tmp_path / "s.json", FILTERS)


def test_times_that_overlap_are_remarked_on(tmp_path: Path):
    """Ends, or times of another kind, in place of the begin of each exposure."""
    schedule = written(tmp_path / "s.json", PLAN.exposures())
    for target in schedule["targets"]:
        for one in target["acquisition"]:
            one["executed"] = ["2026-11-26T01:00:00Z"] * one["exposure"]["multiples"]
    (tmp_path / "s.json").write_text(json.dumps(schedule))
    _, remarks = read_schedule(tmp_path / "s.json", FILTERS)
    assert f"{len(PLAN.exposures()) - 1} exposures begin before the one ahead of them has ended" in remarks[0]
