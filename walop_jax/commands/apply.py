"""`walop-jax apply`: a science catalogue of intensities in, Stokes parameters with errors out."""

from __future__ import annotations

import dataclasses
import math
import os
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from walop_jax.commands.command import (
    Job,
    Option,
    Outcome,
    PathLike,
    UsageError,
    command,
    command_of,
    several,
    typed,
)
from walop_jax.commands.gather import gather
from walop_jax.commands.products import CalibrationLike, Effects, Posterior, calibration_of, catalogue_of
from walop_jax.commands.tables import table_of, table_outcome
from walop_jax.io.display import Display
from walop_jax.io.errors import errors_naming

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from walop_jax import Calibration
    from walop_jax.data.user_tables import InputTable
    from walop_jax.science.catalogue import Catalogue


OPTIONS = {
    "calibration": Option(
        "Calibration product, or the folder of a run.", metavar="RUN/calibration.fits", kind=Path, placed=True
    ),
    "catalogue": Option(
        "Table with X, Y, N, N_ERR (in CSV N0, … N0_ERR, … or O1, … O1_ERR, …), or those of the cameras, "
        "as for gather.",
        metavar="CATALOGUE...",
        kind=list[Path],
        placed=True,
    ),
    "output": Option(
        "Table to write (.fits, .csv, .ecsv).", metavar="OUT", kind=Path, short="-o", required=True
    ),
    "debias": Option(
        "Estimator of P_DEBIASED: Plaszczynski et al. 2014, or Wardle and Kronberg 1974.", metavar="MAS|WK"
    ),
    "saturation": Option("Counts from here on are not used (FLAG 256).", metavar="ELECTRONS", kind=float),
    "force": Option("Also stars whose filter or temperature it does not cover (FLAG 2048)."),
    "common": Option(
        "Write the common table of stellar polarisation (Panopoulou et al. 2025), also Galactic q, u."
    ),
    "each": Option("Each CATALOGUE by itself: OUT is a folder of tables with their names."),
    "workers": Option(
        "With --each: in so many processes of this machine, by Dask.", metavar="N", kind=int, least=1
    ),
    "scheduler": Option(
        "With --each: on the workers of a Dask cluster that share the files.", metavar="ADDRESS", kind=str
    ),
}


@command(stages=("reading", "tabulating", "writing"), writes=(), options=OPTIONS)
def apply(
    job: Job,
    calibration: CalibrationLike,
    catalogue: Any,
    *,
    output: PathLike | None = None,
    debias: str = "MAS",
    saturation: float | None = None,
    posterior: Posterior = None,
    effects: Effects = None,
    force: bool = False,
    common: bool = False,
    each: bool = False,
    workers: int | None = None,
    scheduler: str | Executor | None = None,
) -> Outcome[Any]:
    """Turn the intensities of stars into Stokes parameters: Q, U, P, EVPA and their errors.

    X and Y in degrees, N and N_ERR (one value per camera) in electrons; optional ID, TEFF and TEFF_ERR (or BP_RP, of
    Gaia), ROTATOR, FILTER, TEMP, HA, N_FLAG (or FLAG, or O1_FLAG, …; any bit: not used), and CHWP_ANGLE, CHWP_IN or the
    same columns of any other moving element. Rows of one ID (and filter) are one star; without ID those of one
    SOURCE_ID, or at one RA and DEC: they are combined, wherever the moving elements stand, and all hold the same
    result. With ROTATOR the results are on the sky. Two cameras see one combination of q and u: a star needs several
    settings.

    Errors hold photon noise and calibration; Q_COLOUR and U_COLOUR are the errors if TEFF were ignored, Q_HIDDEN and
    U_HIDDEN the largest shift by an error that the calibration data could not reveal (beside Q_ERR and U_ERR). FLAG: 16
    a direction of (q, u) is hardly measured, 32 beyond the calibrated field (no result a quarter beyond), 64
    filter, temperature or colour that the calibration has not seen, 128 a camera is missing, 256 flagged or
    saturated counts, 2048 used with --force, 16384 no result, 131072 intensities that disagree with the
    calibration by more than noise and half a per cent, 1048576 a place in the field where stars disagree together,
    2097152 no ROTATOR where others have one, 4194304 the counts of another row; bits of the calibration itself are
    added to all rows. Copies of a row are left out; columns that are not used are named.

    The first line is the verdict on the catalogue: go, go with reservations, or no go, with the first reason and its
    remedy. No go, and exit code 3, where the calibration is not trusted, where it is of another instrument, where the
    stars together contradict it, or where most stars are flagged. Where they
    contradict it by more than an instrument changes, other readings of the catalogue are tried (orders of the cameras,
    signs and turns of ROTATOR, a shifted pointing, mirrored fields, magnitudes, filters, gains), and the one that mends
    it is said first.

    From a SURVEY (walop-jax stack) the calibration at the MJD of the stars is taken: a catalogue holds one night.

    The catalogues of the cameras may be given as they are: they are joined into one as `walop-jax gather` does, which
    has options for what they do not state (pointing, names of columns and words, gain).

    With --each every CATALOGUE is reduced by itself into the folder OUT, in this process or by Dask (--workers,
    --scheduler): a table appears whole or not at all, and one that is there is not made again.

    In Python: an astropy table, whose meta has TRUSTED and the first DOUBT; `catalogue` is a path, an astropy table,
    columns by name, or the paths of all cameras. With `each` the paths of the tables; `scheduler` is an address or any
    `concurrent.futures.Executor`.

    >>> star = {"X": [0.1], "Y": [0.0], "N": [[51e4, 49e4, 50e4, 48e4]], "N_ERR": [[714.0, 700.0, 707.0, 693.0]]}
    >>> walop.apply(result, star)["P", "P_ERR", "EVPA"]  # doctest: +SKIP
    """
    from walop_jax.fit.verdict import Quality
    from walop_jax.io.atomic import check_output
    from walop_jax.io.plain_tables import table_format
    from walop_jax.nights.survey_folder import is_survey
    from walop_jax.posterior.draws import with_moments
    from walop_jax.science import stokes_columns as added
    from walop_jax.science.apply import apply as apply_to_rows
    from walop_jax.science.catalogue_verdict import verdict_on
    from walop_jax.science.common_table import in_common_form
    from walop_jax.science.overlaps import overlap
    from walop_jax.science.polarisation import ESTIMATORS

    if (workers is not None or scheduler is not None) and not each:
        wrong = "scheduler" if workers is None else "workers"
        raise UsageError("a single table is made by one process; see --each", wrong)
    if workers is not None and scheduler is not None:
        raise UsageError("workers and scheduler exclude each other", "scheduler")
    if debias not in ESTIMATORS:
        raise UsageError(f"{debias!r} is neither {' nor '.join(ESTIMATORS)}", "debias")
    if saturation is not None and not saturation > 0:
        raise UsageError(f"{saturation} must be above 0 electrons", "saturation")
    if each:
        options = {
            "calibration": calibration, "debias": debias, "saturation": saturation, "posterior": posterior,
            "effects": effects, "force": force, "common": common,
        }  # fmt: skip
        return _apply_to_each(job, several(catalogue), output, options, workers, scheduler)
    if output is not None:
        check_output(output, overwrite=job.overwrite)
        table_format(output)
    job.begin("reading")
    held = None if is_survey(calibration) else calibration_of(calibration, effects)
    table, gathering_remarks = _table_of(catalogue, held)
    held = held or calibration_for(calibration, table, effects, force=force)
    rows = stars_of(table, held, math.inf if saturation is None else saturation)
    job.tell("tabulating the analysis vectors", "tabulating")
    used = held if posterior is None else with_moments(held, posterior)
    with errors_naming(table.path):
        stars = apply_to_rows(used, rows, lambda n, total: job.tell(f"{n} of {total} rows"), force=force)
        seen_twice = overlap(used, rows, force=force)
    job.begin("writing")
    columns = added.stokes_columns(stars, rows.star, debias)
    where = "Catalogue" if output is None else str(output)
    verdict = dataclasses.replace(
        verdict_on(used, rows, stars, seen_twice), subject=where, stars=added.errors_in_words(columns)
    )
    warnings = [
        *(text for text in verdict.reservations if text not in held.warnings),
        *gathering_remarks,
        *added.sentences(rows, stars, held.design.cameras.names),
    ]
    on_the_sky = sum(map(math.isfinite, rows.rotator)) / max(len(rows.rotator), 1)
    outcome = table_outcome(
        job,
        held,
        table,
        columns,
        added.header(held.content_hash(), debias, on_the_sky, stars.check, verdict),
        output,
        counted=added.counted_flags(rows, used.model.template),
        warnings=warnings,
        remade=in_common_form if common else None,
        extra={
            "trusted": verdict.trusted,
            **verdict.answers(),
            "doubts": list(verdict.objections),
            "reservations": list(verdict.reservations),
            "stars": len(stars.qu),
            "seconds": job.seconds,
            "estimator": debias,
            "catalogue": stars.check.document(),
            "overlap": None if seen_twice is None else dataclasses.asdict(seen_twice),
        },
    )
    crossed = outcome.content["flags"][str(int(Quality.HIGH_CROSSTALK))]
    zones = f"; {crossed} in zones of high cross-talk (FLAG 16)" if crossed else ""
    size = f"{len(outcome.value)} rows, {len(stars.qu)} stars, {job.seconds:.1f} s"
    shown = Display("", (("table", f"{size}{zones}"),))
    step = shlex.join(("topcat", str(output))) if common else typed("check", calibration, output)
    about = [f"{table.path}: {doubt}" for doubt in verdict.objections]
    others = [text for text in outcome.warnings if held.verdict.trusted or text not in held.warnings]
    warnings = (*about, *others)
    return dataclasses.replace(
        outcome,
        text=verdict.on_top_of(shown).text(),
        warnings=warnings,
        trusted=verdict.trusted,
        next=(step,) if verdict.trusted else (),
    )


def stars_of(table: InputTable, held: Calibration, limit: float = math.inf) -> Catalogue:
    """The stars of a table, as a calibration can correct them; counts from `limit` on are not used."""
    from walop_jax.science.catalogue import read_catalogue

    instrument = held.model.template.patched()
    moved = {"always_in": held.always_in, "never_in": held.never_in}
    return read_catalogue(table, instrument, limit, **moved, filters=tuple(held.filters))


def _table_of(catalogue: Any, held: Calibration | None) -> tuple[InputTable, Sequence[str]]:
    """The table of a catalogue, or of the catalogues of the cameras joined into one, and remarks on how."""
    if len(tables := several(catalogue)) == 1:
        return table_of(tables[0], {}), ()
    from walop_jax.data.user_tables import in_memory

    instrument = None if held is None else held.design
    gathered = command_of(gather).run(Job(), {"catalogues": catalogue, "instrument": instrument})
    return in_memory(gathered.value, "stars of the cameras"), gathered.warnings


def calibration_for(
    given: Any, stars: InputTable, effects: Effects = None, *, force: bool = False
) -> Calibration:
    """The calibration for some stars: as `calibration_of` gives it, or of a survey the calibration at their time.

    Stars of a survey must be of one night.
    """
    from walop_jax.nights.survey_folder import calibration_of_stars, is_survey, read_survey

    if is_survey(given):
        return calibration_of_stars(read_survey(given, catalogue_of(effects)), stars, force=force)
    return calibration_of(given, effects)


def _apply_to_each(
    job: Job,
    files: Sequence[Any],
    output: PathLike | None,
    options: Mapping[str, Any],
    workers: int | None,
    scheduler: str | Executor | None,
) -> Outcome[list[Path]]:
    """`apply` with `options` for each file, here or by the workers of an executor: the paths of all tables in a folder.

    A table appears whole or not at all, and one that is there is not made again: the same command goes on with what an
    interrupted one has left. Errors of a file fail the whole, which names them, after all others are made.
    """
    from walop_jax.fit.verdict import Doubt, Quality, Verdict
    from walop_jax.likelihood.workers import executor_of, mapped

    if output is None:
        raise UsageError("a folder for the tables is wanted", "output")
    if not all(isinstance(file, str | os.PathLike) for file in files):
        raise UsageError("tables in memory are reduced one by one; give the paths of files", "each")
    places = [Path(output) / Path(file).name for file in files]
    if len({place.name for place in places}) < len(places):
        raise UsageError("two catalogues have the same name, and so would their tables", "each")
    if any(place.resolve() == Path(file).resolve() for place, file in zip(places, files, strict=True)):
        raise UsageError("the tables would replace the catalogues: give another folder", "output")
    Path(output).mkdir(parents=True, exist_ok=True)
    pairs = [p for p in zip(files, places, strict=True) if job.overwrite or not p[1].exists()]
    calls = [(job.overwrite, {**options, "catalogue": file, "output": place}) for file, place in pairs]
    ended, warnings = [], []
    with executor_of(workers, scheduler) as executor:
        for number, outcome in enumerate(mapped(_applied, calls, executor), start=1):
            job.tell(f"{number} of {len(calls)} catalogues")
            ended.append(outcome)
            warnings += outcome.warnings
    failed = [outcome.failure for outcome in ended if outcome.failure]
    if existing := len(files) - len(calls):
        what = f"{existing} of {len(files)} tables were there already"
        warnings.append(f"{what}, and are left; --overwrite makes them again")
    doubts = {
        str(o.content["output"]): o.content["doubts"][0] for o in ended if not o.failure and not o.trusted
    }
    made = {str(place) for _, place in pairs}
    doubts |= {str(p): text for p in places if str(p) not in made and (text := _doubt_of(p))}
    doubted = [*doubts]
    document = {"outputs": [str(place) for place in places], "made": len(ended) - len(failed)}
    document |= {"left": existing, "failed": failed, "trusted": not doubted, "doubted": doubted}
    document["catalogues"] = [outcome.content for outcome in ended if not outcome.failure]
    told = [outcome.text for outcome in ended if outcome.text] or [f"{output}: nothing was left to do"]
    reasons = [Doubt(Quality.CATALOGUE, f"{name}: {text}") for name, text in doubts.items()]
    subject = f"{len(doubted)} of {len(places)} tables" if doubted else str(output)
    verdict = Verdict(doubts=tuple(reasons), subject=subject, stars="table by table, below")
    document |= verdict.answers()
    text = "\n".join((verdict.display().text(), *told))
    about = list(dict.fromkeys(warnings))
    return Outcome(places, document, text, warnings=about, failure="; ".join(failed), trusted=not doubted)


def _doubt_of(place: Path) -> str:
    """The doubt that a table that was made earlier states of itself; empty for formats without a header."""
    from walop_jax.data.user_tables import read_input_table

    meta = read_input_table(place).table.meta
    doubted = meta.get("TRUSTED", True) in (False, "F", "False")
    return str(meta.get("DOUBT", "it says that it is not to be trusted")) if doubted else ""


def _applied(call: tuple[bool, dict[str, Any]]) -> Outcome[None]:
    """The outcome of one `apply` (overwrite or not, arguments), in any process; without the table."""
    from walop_jax.model.compiled import float64

    overwrite, arguments = call
    try:
        with float64():
            outcome = command_of(apply).run(Job(overwrite=overwrite), arguments)
    except (ValueError, OSError) as error:
        return Outcome(None, {}, "", failure=str(error))
    return dataclasses.replace(outcome, value=None)
