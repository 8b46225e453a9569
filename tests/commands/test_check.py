"""`walop-jax check`: is this calibration good for my stars? Its five uses, one verdict, and what is refused."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.table import Table
from command import one_line
from small_run import SEED, SMALL, small_fit

import walop_jax as walop
from walop_jax.calibration.analysis_vectors import AnalysisVectors
from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.product import write_calibration
from walop_jax.data.calset import read_calibration_set
from walop_jax.data.settings import Settings
from walop_jax.data.write import write_calibration_set
from walop_jax.fit.refit import FitResult, refit
from walop_jax.fit.verdict import GO, NO_GO, RESERVED, Doubt, Quality, Verdict
from walop_jax.posterior.result import Convergence, PosteriorSample
from walop_jax.simulation.simulate import simulate

from .conftest import FittedSet
from .test_diagnosis_words import comes_out, found

__all__ = ["found"]

ANSWERS = {"go", "answer", "p_of_a_star", "reasons"}
FIRST = rf".+: ({GO}|{RESERVED}: .+|{NO_GO}: .+)"


@pytest.fixture(scope="module")
def catalogue(fitted: FittedSet, tmp_path_factory) -> Path:
    """Sixty stars in each of two nights, as the calibration has them, with the noise of photons."""
    vectors, rng = AnalysisVectors(fitted.calibration), np.random.default_rng(5)
    x, y = rng.uniform(-0.25, 0.25, (2, 120))
    expected = 4e6 * vectors.exact(Settings.default(1), x, y, [5000.0])[:, 0, :, 0]
    table = Table({"ID": np.arange(120), "X": x, "Y": y, "TEFF": np.full(120, 5000.0)})
    table["N"], table["N_ERR"] = rng.normal(expected, np.sqrt(expected)), np.sqrt(expected)
    table["MJD"] = np.repeat([61221.9, 61222.9], 60)
    path = tmp_path_factory.mktemp("stars") / "stars.fits"
    table.write(path)
    return path


def brighter(catalogue: Path, path: Path, share: float, rows: slice = slice(None)) -> Path:
    """The same with camera O1 brighter by a share in some rows."""
    table = Table.read(catalogue)
    table["N"][rows, 0] *= 1.0 + share
    table.write(path)
    return path


# ------------------------------------------------------------------------------------------------------ one verdict


def doubt(what: str, **changes: Any) -> Doubt:
    return Doubt(Quality(0), what, **changes)


def test_reasons_are_ranked_by_what_they_do_to_stars():
    """What forbids the use first; then by size; what may do anything is the largest of its kind, or says least."""
    against = (
        doubt("small", blocking=False, off=1e-4),
        doubt("a remark", blocking=False),
        doubt("large", blocking=False, off=1e-2, remedy="look"),
        doubt("bad", off=2e-3),
        doubt("worse", off=5e-3, remedy="again"),
        doubt("anything"),
    )
    verdict = Verdict(doubts=against, subject="RUN")
    assert [one.what for one in verdict.reasons] == ["anything", "worse", "bad", "large", "small", "a remark"]
    assert verdict.words == NO_GO
    assert verdict.document()["reasons"][1] == {
        "what": "worse", "off": 5e-3, "remedy": "again", "blocking": True,
    }  # fmt: skip
    lines = verdict.display().text().splitlines()
    assert lines[0] == "RUN: no go: anything"
    assert lines[2] == "  also         worse (q, u off by 0.50 %); again"
    assert lines[4] == "               large (q, u off by 1.0 %); look"
    reserved = Verdict(doubts=against[:3], subject="RUN")
    assert reserved.first_line == "RUN: go, with reservations: large (q, u off by 1.0 %); look"
    assert reserved.go
    assert Verdict(subject="RUN").display().text().splitlines() == [
        "RUN: go", "  p of a star  not known", "  also         nothing else",
    ]  # fmt: skip


def test_a_doubt_says_its_number_and_its_remedy_once():
    assert doubt("q or u off by 0.20 % (median)", off=2e-3).words == "q or u off by 0.20 % (median)"
    own = Doubt(Quality.UNEXPLAINED, "χ²/dof = 7 (walop-jax diagnose looks for missing effects)")
    assert own.words == own.sentence
    assert own.cure == "walop-jax diagnose looks for missing effects"  # a key of its own in a document
    assert Doubt(Quality.DOUBTED, "odd").words == "odd; walop-jax diagnose looks for the cause"


def test_a_verdict_from_a_file_tells_the_first_reason():
    """A file relates no sentence to a bit: the first one of a fit that is not trusted is the reason."""
    kept = Verdict.recorded(trusted=False, quality=32768, warnings=("odd", "a remark"))
    assert kept.first_line == "no go: odd; walop-jax diagnose looks for the cause"
    assert kept.reservations == ("a remark",)
    assert (kept.warnings, int(kept.quality)) == (("odd", "a remark"), 32768)
    sound = Verdict.recorded(trusted=True, quality=2, warnings=("a remark",))
    assert sound.words == RESERVED
    assert (sound.warnings, int(sound.quality)) == (("a remark",), 2)


def posterior(*, trusted: bool) -> PosteriorSample:
    """A posterior of one coefficient, typed by hand, around a fit that is trusted or not."""
    one, draws = np.ones(1), np.random.default_rng(0).standard_normal((1, 200, 1))
    return PosteriorSample(
        sampler="emcee", names=("a",), units=("",), draws=draws, log_posterior=draws[..., 0],
        mean=np.zeros(1), covariance=np.eye(1), chains=np.zeros((1, 1, 1, 1)), sampled=("a",), thin=1,
        convergence=Convergence(("a",), 10000, one, (1.0, 1.0, 1.0), 1e4 * one, one, 0, ()), accuracy=None,
        acceptance=0.5, counts={}, seconds=0.0, fingerprint={}, of_trusted_fit=trusted,
    )  # fmt: skip


def shown_by(value: Any, document: Any = None) -> tuple[str, dict[str, Any]]:
    return value.display().text(), value.document() if document is None else document


Made = Callable[..., tuple[str, dict[str, Any]]]


@pytest.fixture(scope="module")
def of_file(fitted: FittedSet) -> FitResult:
    """The fit of the small set on disk, whose hash it records."""
    return refit(read_calibration_set(fitted.calset))


@pytest.fixture
def made(call, fitted: FittedSet, of_file, catalogue, tmp_path, monkeypatch, found) -> Made:
    """What a command prints first and its document, of a sound or a doubted fit; nothing is fitted."""

    def printed(command: str, doubts: list[str]) -> tuple[str, dict[str, Any]]:
        fit = of_file.with_verdict(doubts)
        monkeypatch.setattr("walop_jax.fit.refit.refit", lambda *args, **more: fit)
        monkeypatch.setattr("walop_jax.diagnosis.trust.examined", lambda result, *args, **more: fit)
        comes_out(dataclasses.replace(found, after=fit, unexplained=None), monkeypatch)
        run = tmp_path / f"RUN{len(doubts)}"
        if not run.exists():
            fit.save(run)
        words: dict[str, tuple[object, ...]] = {
            "refit": (fitted.calset, "-o", tmp_path / "FIT"),
            "diagnose": (fitted.calset, "-o", tmp_path / "DIAG"),
            "check": (run,),
            "apply": (run, catalogue, "-o", tmp_path / "out.fits"),
            "stack": (run, "-o", tmp_path / "SURVEY", "--no-breaks"),
        }
        if command == "sample":
            return shown_by(posterior(trusted=not doubts))
        texts = (
            call(command, *words[command], "--overwrite"),
            call(command, *words[command], "--json", "--overwrite"),
        )
        for done in texts:
            assert done.exit_code == (3 if doubts else 0), done.output
        return texts[0].stdout, json.loads(texts[1].stdout)

    return printed


@pytest.mark.parametrize("doubts", [[], ["the residuals are odd"]])
@pytest.mark.parametrize("command", ["check", "refit", "diagnose", "sample", "stack", "apply"])
def test_every_command_begins_with_the_same_lines_keys_and_exit_codes(made: Made, command: str, doubts):
    text, document = made(command, doubts)
    first, second, third = text.splitlines()[:3]
    assert re.fullmatch(FIRST, first), first
    assert second.startswith("  p of a star  ")
    assert third.startswith("  also  ")
    assert set(document) >= ANSWERS
    assert document["answer"] in ([NO_GO] if doubts else [GO, RESERVED])
    assert document["go"] is not bool(doubts)
    assert f": {document['answer']}" in first
    assert [set(one) for one in document["reasons"]] == [{"what", "off", "remedy", "blocking"}] * len(
        document["reasons"]
    )
    if doubts:
        reason = document["reasons"][0]
        assert reason["blocking"]
        assert reason["remedy"]
        assert reason["what"] in first
        assert "walop-jax" in first  # what to do


def test_refit_and_check_say_the_same_of_one_run(made: Made):
    (fit, of_fit), (checked, of_check) = made("refit", []), made("check", [])
    assert fit.splitlines()[0].partition(": ")[2] == checked.splitlines()[0].partition(": ")[2]
    assert fit.splitlines()[1:3] == checked.splitlines()[1:3]
    assert {key: of_fit[key] for key in ANSWERS} == {key: of_check[key] for key in ANSWERS}


# --------------------------------------------------------------------------------------------------- its five uses


def test_a_calibration_by_itself(call, run: Path, tmp_path: Path):
    done = call("check", run, "-o", tmp_path / "OUT")
    assert done.exit_code == 0
    answer = walop.check(run)
    assert done.stdout == f"{answer.display().text()}\n"
    assert answer.go
    document = json.loads((tmp_path / "OUT" / "check.json").read_text())
    assert document["commissioning"]["valid"] is True
    assert document["product"] == document["commissioning"]["content"]
    # Half of the goal that 95 % of the field has is met, or that it is not is a reason: of a goal that cannot be, both.
    strict = walop.check(run, goal=1e-3)
    assert strict.words == NO_GO
    assert strict.reasons[0].blocking
    assert "0.00050 % allowed" in strict.reasons[0].what
    assert call("check", run, "--goal", 1e-3).exit_code == 3
    with pytest.raises(KeyError, match="'watch' was not asked; there are commissioning"):
        answer["watch"]


def test_what_damages_a_file_is_an_error_and_what_was_changed_is_a_no_go(call, run: Path, tmp_path: Path):
    product = Calibration.read(run / "calibration.fits")
    hot = product.values.copy()
    hot[product.names.index("half1.efficiency")] = 1.2  # analyses more light than there is
    write_calibration(tmp_path / "hot.fits", dataclasses.replace(product, values=hot))
    done = call("check", tmp_path / "hot.fits")
    assert done.exit_code == 3
    assert "walop-jax inspect looks for counts that no camera can have" in done.stdout
    assert "FAILED  physics" in done.stdout
    content = bytearray((run / "calibration.fits").read_bytes())
    content[-4000] ^= 1
    (tmp_path / "damaged.fits").write_bytes(content)
    assert "damaged.fits" in one_line(call("check", tmp_path / "damaged.fits"))


def test_stars_of_a_calibration_that_holds_are_quiet(call, run: Path, catalogue: Path):
    done = call("check", run, catalogue)
    assert done.exit_code == 0, done.output
    first, second, third = done.stdout.splitlines()[:3]
    assert first == f"{run} for {catalogue}: go"
    assert re.search(r"a step of ([\d.]+) % in one camera would be seen, q or u off by ([\d.]+) %", second)
    assert third.split(maxsplit=1) == ["also", "nothing else"]
    assert "warning" not in done.stderr


def test_stars_tell_since_when_a_calibration_does_not_hold(call, run: Path, catalogue: Path, tmp_path: Path):
    """O1 brighter by 4 % from the second night on: q is off by half of it, (1 + β − 1)/(2 + β)."""
    odd = brighter(catalogue, tmp_path / "odd.fits", 0.04, slice(60, None))
    done = call("check", run, odd, "-o", tmp_path / "OUT")
    assert done.exit_code == 3
    first = done.stdout.splitlines()[0]
    assert f"{odd}: no go: from MJD 61222.9000 on" in first
    assert "walop-jax check RUN NEW.fits" in first
    answer = walop.check(run, odd)
    assert not answer["watch"].holds
    assert answer.document()["watch"]["changes"][0]["time"] == pytest.approx(61222.9)
    (change,) = answer["watch"].changes
    assert change.off == pytest.approx(0.02, rel=0.2)
    assert {entry.name for entry in (tmp_path / "OUT").iterdir()} == {"check.json", "watch.fits", "watch.png"}


@pytest.mark.parametrize(
    ("errors", "counts", "said"),
    [
        (3.0, (1.0, 1.0, 1.0, 1.0), r"no go: N_ERR is (2\.[5-9]|3)\S* times too large"),
        (0.5, (1.0, 1.0, 1.0, 1.0), r"no go: N_ERR is (1\.[6-9]|2)\S* times too small"),
        (1.0, (1.02, 0.98, 1.0, 1.0), r"no go: q and u of \d+ stars follow .*O1 brighter by (3\.[5-9]|4)"),
    ],
)
def test_what_apply_holds_against_a_catalogue_check_holds_as_well(
    call, run: Path, catalogue: Path, tmp_path: Path, errors: float, counts: tuple[float, ...], said: str
):
    """Errors that are not those of the counts; light exchanged inside an arm, of which no sum of its cameras knows."""
    table = Table.read(catalogue)
    table["N_ERR"] *= errors
    table["N"] *= counts
    table.write(tmp_path / "odd.fits")
    inputs = (run, tmp_path / "odd.fits")
    for command in (("check", *inputs), ("apply", *inputs, "-o", tmp_path / "OUT.fits")):
        done = call(*command)
        assert done.exit_code == 3, done.output
        assert re.search(said, done.stdout.splitlines()[0]), done.output


def test_a_new_set_that_agrees_and_one_that_does_not(call, run: Path, fitted: FittedSet, tmp_path: Path):
    """Another night of the same instrument; one with a camera that has become fainter by 1 %."""
    truth = simulate(SMALL, seed=SEED).truth
    throughput = truth.throughput
    fainter = throughput.coefficients.at[1, 0].add(-0.01)
    dim = dataclasses.replace(truth, throughput=dataclasses.replace(throughput, coefficients=fainter))
    for name, instrument in (("same", truth), ("dim", dim)):
        write_calibration_set(
            tmp_path / f"{name}.fits", simulate(SMALL, seed=77, instrument=instrument).calset
        )
    same = walop.check(run, tmp_path / "same.fits")
    assert same["epoch"].holds
    assert same.words == GO
    done = call("check", run, tmp_path / "dim.fits", "-o", tmp_path / "NEW")
    assert done.exit_code == 3
    first, second = done.stdout.splitlines()[:2]
    assert f"{run} after {tmp_path / 'dim.fits'}: no go: the instrument has changed: " in first
    assert "walop-jax stack RUN NEW.fits -o SURVEY" in first
    assert re.match(r"  p of a star .* off by [\d.]+ % \(median; [\d.]+ % at most\)", second)
    document = json.loads((tmp_path / "NEW" / "check.json").read_text())
    off = document["reasons"][0]["off"]
    errors = document["epoch"]["star_errors"]
    assert off == pytest.approx(max(errors["q"]["median"], errors["u"]["median"]) / 100.0)
    assert walop.read(tmp_path / "NEW" / "calibration.fits")["throughput.n1.p00"].value < 1.0
    assert "no go" in walop.report(tmp_path / "NEW").path.read_text()


def test_a_new_calibration_against_the_old_one(call, run: Path, catalogue: Path, tmp_path: Path):
    quiet = call("check", run, "--against", run, catalogue)
    assert quiet.exit_code == 0
    assert quiet.stdout.startswith(f"{catalogue} by {run}: go\n")
    old = Calibration.read(run / "calibration.fits")
    values = old.values.copy()
    values[old.model.index("collimator.u")] += 0.01  # adds to u of all light ahead of the plates
    new = dataclasses.replace(old, values=values)
    answer = walop.check(new, catalogue, against=run)
    assert answer["affected"].again == (str(catalogue),)
    assert answer.reasons[0].off == pytest.approx(0.01, rel=0.05)
    assert f"make it again: walop-jax apply NEW {catalogue}" in answer.first_line
    assert "u by −1" in answer.first_line  # per cent


def test_a_row_of_quality_numbers(call, run: Path, tmp_path: Path):
    table = tmp_path / "quality.ecsv"
    (tmp_path / "wide.toml").write_text(
        "".join(f"{n} = [-1e3, 1e3]\n" for n in ("ANGLE", "CHI2DOF", "ACCURACY"))
    )
    done = call("check", run, "--append", table, "--limits", tmp_path / "wide.toml", "--json")
    assert done.exit_code == 0, done.output
    document = json.loads(done.stdout)
    (night,) = document["quality"]["nights"]
    assert night["CALHASH"] == document["product"]
    assert document["commissioning"]["valid"] is True
    assert len(Table.read(table)) == 1
    (tmp_path / "narrow.toml").write_text("CHI2DOF = [2.0, 3.0]\n")
    done = call("check", run, "--append", table, "--limits", tmp_path / "narrow.toml")
    assert done.exit_code == 3
    assert re.match(r".*: no go: night 61220: CHI2DOF = .*, allowed 2 to 3; walop-jax diagnose", done.stdout)
    assert len(Table.read(table)) == 1


# --------------------------------------------------------------------------------------------- kinds of the inputs


def test_files_are_known_by_their_content(
    call, run: Path, fitted: FittedSet, catalogue: Path, tmp_path: Path
):
    """A set that is called a catalogue, a catalogue that is called a set: each is asked as what it is."""
    shutil.copy(fitted.calset, tmp_path / "stars.cat")
    shutil.copy(catalogue, tmp_path / "calibration_set.dat")
    answer = walop.check(run, tmp_path / "stars.cat", tmp_path / "calibration_set.dat")
    assert set(answer.parts) == {"epoch", "watch"}
    assert answer["epoch"].same
    assert answer["watch"].holds
    assert answer.subject == f"{run} after {tmp_path / 'stars.cat'} for {tmp_path / 'calibration_set.dat'}"
    text = call("check", run, tmp_path / "stars.cat", tmp_path / "calibration_set.dat").stdout
    assert text.count("The calibration is still valid") == 1
    assert text.splitlines()[0].startswith(f"{answer.subject}: go, with reservations: these are the data")


def test_what_is_in_memory_is_known_as_well(run: Path, fitted: FittedSet, catalogue: Path):
    calset = walop.read(fitted.calset)
    table = Table.read(catalogue)
    answer = walop.check(walop.read(run), calset, table, dict(table[:60].columns))
    assert set(answer.parts) == {"epoch", "watch"}
    assert "catalogue 2" in answer.subject


def test_all_that_is_neither_is_refused_at_once_with_advice(call, run: Path, tmp_path: Path):
    """In one line: a folder, a product, a plan, results without counts, one camera, a file that is not there."""
    (tmp_path / "plan.toml").write_text("grid = 5\n")
    (tmp_path / "truth.json").write_text('{"values": {}}')
    Table({"Q": [0.0], "U": [0.0], "ID": [1]}).write(tmp_path / "results.csv")
    Table({"RA": [0.0], "DEC": [0.0], "FLUX_AUTO": [1.0]}).write(tmp_path / "O1.fits")
    refused = call(
        "check", run, run, run / "calibration.fits", tmp_path / "plan.toml", tmp_path / "results.csv",
        tmp_path / "truth.json",
        tmp_path / "O1.fits", tmp_path / "lost.fits",
    )  # fmt: skip
    line = one_line(refused)
    for words in (
        "is a folder, neither a calibration set nor a catalogue of stars; give a RUN first",
        "calibration.fits: is a calibration, neither",
        "plan.toml: is a TOML file, such as a plan or a model, neither",
        "truth.json: is a JSON document",
        "results without the counts that they were made of: give the table that apply has read",
        "O1.fits: holds the columns RA, DEC, FLUX_AUTO, and no counts of the cameras (N): it is neither",
        "walop-jax gather O1 E1 O2 E2 -o STARS.fits makes one catalogue",
        "lost.fits: there is no such file",
    ):
        assert words in line, words


def test_an_untrusted_calibration_is_no_go_for_whatever_is_asked(call, catalogue: Path, tmp_path: Path):
    small_fit().with_verdict(["the residuals are odd"]).save(tmp_path / "BAD")
    done = call("check", tmp_path / "BAD", catalogue)
    assert done.exit_code == 3
    assert (
        "no go: the residuals are odd; walop-jax diagnose looks for the cause" in done.stdout.splitlines()[0]
    )
