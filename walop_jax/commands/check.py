"""`walop-jax check`: is this calibration good, still good, good for these stars? One answer, and why."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from walop_jax.commands.apply import calibration_for, stars_of
from walop_jax.commands.command import (
    Job,
    Option,
    Outcome,
    PathLike,
    UsageError,
    Writers,
    after_fit,
    command,
    figure_file,
    several,
    typed,
)
from walop_jax.commands.inputs import goal_of, set_of
from walop_jax.commands.products import (
    CalibrationLike,
    Effects,
    calibration_of,
    catalogue_of,
    fit_of,
    folder_of,
)
from walop_jax.io.errors import DataError, errors_naming
from walop_jax.io.folder import check_apart, output_folder
from walop_jax.io.names import (
    CHECK,
    CLIPPED,
    IN_MEMORY,
    PRODUCT,
    QUALITY_FIGURE,
    WATCH_FIGURE,
    WATCH_TABLE,
)
from walop_jax.io.text import some

if TYPE_CHECKING:
    from walop_jax import Calibration
    from walop_jax.commands.recognised import Inputs, StarTable
    from walop_jax.fit.verdict import Verdict, VerdictPart


OPTIONS = {
    "run": Option("Calibration product, or the folder of a run.", metavar="RUN", kind=Path, placed=True),
    "inputs": Option(
        "New calibration sets (fitted as one), catalogues of stars as apply reads or writes them, or both.",
        metavar="[NEW.fits|STARS]...",
        kind=list[Path],
        placed=True,
    ),
    "against": Option(
        "Calibration that RUN replaces: what changes in the catalogues?", metavar="OLD_RUN", kind=Path
    ),
    "append": Option(
        "Add a row of quality numbers of RUN to this table (.ecsv, .csv, .fits).", metavar="TABLE", kind=Path
    ),
    "output": Option(
        "Folder for check.json, and what belongs to it.", metavar="FOLDER", kind=Path, short="-o"
    ),
    "limit": Option(
        "With --against: shift (standard errors) from which a result is made again (default: 0.5).",
        metavar="SIGMA",
        kind=float,
    ),
    "limits": Option(
        "With --append: limits in place of those of the package.", metavar="LIMITS.toml", kind=Path
    ),
    "force": Option("Also stars whose filter or temperature the calibration does not cover."),
}


@dataclasses.dataclass(frozen=True)
class Asked:
    """What one question adds to the answer: a part by its name, doubts, words on p of a star, files, warnings.

    `extra` are keys of the document that belong to no part.
    """

    name: str
    part: VerdictPart
    against: Sequence[Any]
    stars: str
    files: Writers = dataclasses.field(default_factory=dict)
    warnings: Sequence[str] = ()
    extra: Mapping[str, Any] = dataclasses.field(default_factory=dict)


@command(
    stages=("reading", "checking", "fitting", "lacking", "tabulating", "watching", "writing"),
    writes=(),
    random=True,
    outputs=("append",),
    options=OPTIONS,
)
def check(
    job: Job,
    run: CalibrationLike,
    *inputs: Any,
    against: CalibrationLike | None = None,
    append: PathLike | None = None,
    output: PathLike | None = None,
    goal: float | None = None,
    limit: float | None = None,
    limits: PathLike | None = None,
    effects: Effects = None,
    force: bool = False,
) -> Outcome[Verdict]:
    """Check whether a calibration is good for stars: go, go with reservations, or no go, and what to do.

    The first line is the answer with the first reason and its remedy, then the error of p of a star, then all other
    reasons, the one that does most to q and u of stars first. refit, diagnose, sample, stack and apply begin alike.

    RUN alone: is it good? Checksums, version, content hash, convergence, covariance, validity (dates, filters,
    temperatures), maps against parameters, no camera with a negative transmission; exposures that are enough for a fit;
    p of stars (p ≤ 5 %) known to half of --goal (0.1 %) in half of the field; all that acts on stars measured; else no
    go. What the data would not show, and p in 95 % of the field, are reservations. To rehearse a night, give the fit
    of a set of walop-jax simulate PLAN.

    RUN NEW.fits...: is it still good after these calibration exposures? They are fitted with the model of RUN and
    compared. Where that model does not explain them, missing effects are looked for as by walop-jax diagnose, and RUN
    is compared with the model found. -o keeps the new calibration.

    RUN STARS...: is it still good for these stars, and since when not? Rows of one MJD are a group; catalogues without
    MJD are a group each, in their order. Steps, drifts and single groups of cameras and arms are looked for, over the
    whole field, growing over it, or in a spot, and changes of the optics that explain the stars as well. Where none is
    found, each catalogue is asked as by apply: what is no go there is no go here.

    NEW_RUN --against OLD_RUN STARS...: what does the new calibration change in these catalogues? A night is to be made
    again where more than 5 % of its stars shift by more than --limit, or gain or lose their result. Both may be surveys
    (walop-jax stack), with stars of one night in a catalogue.

    --append adds a row of quality numbers (standards, χ², gains, accuracy) to a table of nights; numbers outside their
    limits are no go. A night that is there already is replaced; the same calibration is not added twice.

    Files are known by their content: sets and catalogues may be mixed, each is asked. Exit code 0: go, with
    reservations or without; 3: no go; 1: a file that cannot be read, or is none of these.

    In Python: a `Verdict`: `go`, `words`, `reasons`; what was found stands in it by name: `verdict["commissioning"]`,
    `["epoch"]`, `["watch"]`, `["affected"]`, `["quality"]`. Inputs are paths, sets, astropy tables, or columns by name.

    >>> walop.check("RUN", "new.fits", "stars.fits").go  # doctest: +SKIP
    """
    given = [entry for one in inputs for entry in several(one)]
    if limit is not None and (against is None or not limit > 0):
        wrong = "is a shift between two calibrations: see --against" if against is None else "must be above 0"
        raise UsageError(f"{limit:g} standard errors: {wrong}", "limit")
    if goal is not None and given:
        raise UsageError("it is asked of RUN alone, without sets and stars", "goal")
    if force and not given:
        raise UsageError("it is about stars: give their catalogues", "force")
    if against is not None and not given:
        what = "give the catalogues that are compared: check NEW_RUN --against OLD_RUN STARS"
        raise UsageError(what, "against")
    if limits is not None and append is None:
        raise UsageError("they are those of the numbers that --append writes", "limits")
    wanted = goal_of(goal)
    if append is not None:
        _check_table(append)
    job.begin("reading")
    # A calibration by itself is read part by part, and each fault is told: it need not be whole.
    held = calibration_of(run, effects) if given or append is not None else None
    known = _recognised(given, held)
    if against is not None and not known.stars:
        raise UsageError("it compares stars: give their catalogues", "against")
    names = (CHECK, *((PRODUCT,) if known.sets else ()))
    names += (WATCH_TABLE, WATCH_FIGURE) if known.stars and against is None else ()
    names += (QUALITY_FIGURE,) if append is not None else ()

    def asked() -> list[Asked]:
        answers = [] if given else [_commissioned(job, run, effects, wanted)]
        if held is not None and known.sets:
            answers.append(_epoch(job, held, known.sets, effects))
        if held is not None and known.stars:
            stars = known.stars
            of_stars = _watch(job, held, stars, force=force) if against is None else None
            answers.append(of_stars or _affected(job, against, run, stars, limit, effects))
        if held is not None and append is not None:
            answers.append(_quality(job, held, run, append, limits))
        return answers

    if output is None:
        return _outcome(asked(), held, run, known, against, output)
    _keep_inputs(Path(output), names, (run, against, *known.sets, *(star.name for star in known.stars)))
    with output_folder(output, names, overwrite=job.overwrite) as folder:
        return _outcome(asked(), held, run, known, against, output).save(folder)


def _recognised(given: Sequence[Any], held: Calibration | None) -> Inputs:
    """The inputs by their kinds; none where nothing was given."""
    from walop_jax.commands.recognised import Inputs, recognised

    return Inputs((), ()) if held is None else recognised(given, held.design.cameras.names)


def _keep_inputs(folder: Path, names: Sequence[str], read: Sequence[Any]) -> None:
    """Refuse, as `UsageError`, an output folder in which an input would be replaced."""
    written = [folder / name for name in names]
    if PRODUCT in names and (folder / PRODUCT).exists():
        written.append(folder)
    paths = (getattr(entry, "folder", entry) for entry in read)
    try:
        check_apart(written, [path for path in paths if isinstance(path, str | os.PathLike)])
    except DataError as error:
        raise UsageError(str(error), "output") from error


def _check_table(append: PathLike) -> None:
    """Refuse a table of nights that cannot be written, ahead of all work."""
    from walop_jax.io.atomic import check_output
    from walop_jax.io.plain_tables import table_format

    check_output(append, overwrite=True)
    table_format(append)


def _name(given: Any, otherwise: str) -> str:
    """What messages call a calibration or a set."""
    folder = getattr(given, "folder", given)
    return str(folder) if isinstance(folder, str | os.PathLike) else otherwise


def _outcome(
    asked: Sequence[Asked],
    held: Calibration | None,
    run: Any,
    known: Inputs,
    against: Any,
    output: PathLike | None,
) -> Outcome[Verdict]:
    """The answers as one, with everything that is printed and written of them."""
    from walop_jax.fit.verdict import Verdict

    base = () if held is None else tuple(doubt for doubt in held.verdict.doubts if doubt.blocking)
    verdict = Verdict(doubts=base if known.sets or known.stars else ()).with_doubts(
        [doubt for one in asked for doubt in one.against],
        subject=_subject(run, known, against),
        stars="; ".join(filter(None, (one.stars for one in asked))),
        parts={one.name: one.part for one in asked},
    )
    told = {doubt.sentence for doubt in verdict.reasons}
    further = [one.part.shown.text() for one in asked] if len(asked) > 1 else []
    document = verdict.document() | {"calibration": _name(run, IN_MEMORY)}
    for one in asked:
        document |= one.extra
    if held is not None:
        document |= {"product": held.content_hash(), "trusted": held.verdict.trusted}
    by_itself = not (known.sets or known.stars)
    ahead = after_fit(run)[1:] if by_itself and verdict.go else ()
    return Outcome(
        verdict,
        document,
        text="\n".join((verdict.display().text(), *further)),
        files={name: write for one in asked for name, write in one.files.items()},
        saved_as=CHECK,
        drop=(CLIPPED,) if known.sets else (),
        warnings=tuple(dict.fromkeys(text for one in asked for text in one.warnings if text not in told)),
        trusted=verdict.go,
        next=ahead or (() if output is None else (typed("report", output),)),
    )


def _subject(run: Any, known: Inputs, against: Any) -> str:
    """What the answer is about: the calibration, after new sets, for stars."""
    stars = some([star.name for star in known.stars], 3)
    if against is not None:
        return f"{stars} by {_name(against, 'the old calibration')}"
    subject = _name(run, "the calibration")
    if known.sets:
        subject += f" after {some([_name(entry, 'the new set') for entry in known.sets], 3)}"
    return f"{subject} for {stars}" if stars else subject


# ------------------------------------------------------------------------------------------------- is it good?


def _commissioned(job: Job, run: CalibrationLike, effects: Effects, goal: float | None) -> Asked:
    """A calibration by itself: its files, physics, accuracy, and what could hide."""
    from walop_jax import Calibration, FitResult, Run
    from walop_jax.calibration.accuracy import GOAL
    from walop_jax.calibration.certify import certify
    from walop_jax.calibration.product import product_path, read_calibration, validity
    from walop_jax.data.inspection import inspect
    from walop_jax.fit.verdict import VerdictPart
    from walop_jax.science.commissioning import Certificate, requirements
    from walop_jax.science.field_accuracy import field_accuracy, for_stars

    job.tell("looking at the product", "checking")
    source: Any = fit_of(run)
    held: Any = Calibration.from_fit(source) if isinstance(source, FitResult) else source
    if isinstance(held, Calibration):
        path = Path(IN_MEMORY)
    else:
        path = product_path(folder_of(held))
        held = read_calibration(path, catalogue_of(effects), any_model=True)
    with errors_naming(path):
        checks = tuple(certify(held))
    verdict, needs, facts, calset, message = held.verdict, (), (), None, ""
    if any(check.name == "model" and check.passed for check in checks):
        job.tell("working out the accuracy of p")
        if isinstance(source, FitResult):
            verdict, message, calset = source.checked_verdict(), source.minimum.message, source.calset
        else:
            with contextlib.suppress(DataError):  # its exposures are looked at where they can be found
                calset = Run(path.parent).calset if path.name == PRODUCT else None
            goal = goal or _goal_of_the_fit(path)
        accuracy = field_accuracy(held, goal=goal or GOAL)
        facts = () if accuracy is None else (*accuracy.facts(), *accuracy.further_facts)
        needs = requirements(verdict, message, accuracy, calset)
        verdict = for_stars(verdict, accuracy, () if calset is None else inspect(calset).findings)
    found = Certificate(
        path, checks, needs, validity(held), held.content_hash(), tuple(entry.sha256 for entry in held.inputs),
        verdict, facts,
    )  # fmt: skip
    return Asked(
        "commissioning",
        VerdictPart(found, found.document(), found.display()),
        found.against,
        verdict.stars,
        extra={"product": found.content, "trusted": held.verdict.trusted},
    )


def _goal_of_the_fit(path: Path) -> float | None:
    """The goal that the fit beside a product was asked for; None where there is none."""
    from walop_jax.io.run_folder import RunFolder

    documents = RunFolder(path.parent).documents if path.name == PRODUCT else {}
    return (documents.get("summary", {}).get("accuracy_of_p") or {}).get("goal")


# ------------------------------------------------------------------------------------------------ is it still good?


def _epoch(job: Job, held: Calibration, sets: Sequence[Any], effects: Effects) -> Asked:
    """New calibration sets, fitted with the model of a calibration, and compared with it."""
    from walop_jax import Calibration
    from walop_jax.calibration.product import write_calibration
    from walop_jax.diagnosis.findings import document
    from walop_jax.diagnosis.trust import examined
    from walop_jax.diagnosis.workflow import diagnose
    from walop_jax.fit.verdict import VerdictPart
    from walop_jax.science.epoch import epoch as compared
    from walop_jax.science.epoch import fit_like

    calset = set_of(sets[0] if len(sets) == 1 else sets, held.design)
    job.tell("fitting the new set", "fitting")
    with errors_naming(held.path):
        result = examined(fit_like(held, calset), job.seed)
        comparison = compared(held, result)
    lacking = None
    if comparison.fits is None:
        job.tell("looking for effects that the new fit lacks", "lacking")
        # Other readings of the data have been tried when its fit was examined.
        options = {"catalogue": catalogue_of(effects), "seed": job.seed, "progress": job.progress}
        lacking = diagnose(calset, result.model, as_written=True, **options)
        if lacking is not None and lacking.after.trusted:
            result = lacking.after
            comparison = compared(held, result)
    shown = comparison.display()
    if lacking is not None:
        named = ", ".join(step.effect for step in lacking.steps) or "nothing that has a name"
        lacks = f"missing from the old model: {named} ({lacking.verdict.replace('_', ' ')})"
        shown = dataclasses.replace(shown, notes=(*shown.notes, lacks))
    content: Mapping[str, Any] = {
        "old": held.content_hash(),
        "old_file": held.path,
        "old_date": held.date,
        "new": [entry.sha256 for entry in calset.inputs],
        "new_files": [str(entry.path) for entry in calset.inputs],
        **comparison.document(),
        "diagnosis": None if lacking is None else document(lacking),
    }
    return Asked(
        "epoch",
        VerdictPart(comparison, content, shown),
        comparison.against,
        comparison.stars_in_words,
        {PRODUCT: lambda path: write_calibration(path, Calibration.from_fit(result))},
        [f"the new fit: {w}" if w in result.warnings else w for w in comparison.warnings],
    )


def _watch(job: Job, held: Calibration, stars: Sequence[StarTable], *, force: bool) -> Asked:
    """Stars of many nights: since when does a calibration not hold?"""
    from walop_jax.fit.verdict import VerdictPart
    from walop_jax.reports.survey_figures import watch_figure
    from walop_jax.science.watch import watch

    names = [star.name for star in stars]
    rows = [stars_of(star.table, held) for star in stars]
    job.tell("tabulating the analysis vectors", "tabulating")
    with errors_naming(", ".join(names)):
        history = watch(held, rows, names=names, force=force)
    table = history.to_table()
    return Asked(
        "watch",
        VerdictPart(history, history.document(), history.display()),
        history.against,
        history.stars_in_words,
        {
            WATCH_TABLE: lambda path: table.write(path, format="fits"),
            WATCH_FIGURE: figure_file(watch_figure, history),
        },
        held.warnings,
    )


def _affected(
    job: Job, old: Any, new: Any, stars: Sequence[StarTable], limit: float | None, effects: Effects
) -> Asked:
    """Stars by the old and the new calibration: which catalogues must be made again?"""
    from walop_jax.fit.verdict import VerdictPart
    from walop_jax.science.affected import LIMIT, Affected
    from walop_jax.science.affected import affected as nights_of

    limit = LIMIT if limit is None else limit
    nights, warnings, replaced, replacing = [], [], list[str](), list[str]()
    for name, table in stars:
        before, after = (calibration_for(product, table, effects, force=True) for product in (old, new))
        if before.instrument != after.instrument:
            what = f"OLD_RUN is a calibration of {before.instrument}, NEW_RUN one of {after.instrument}"
            raise UsageError(f"{what}: give two of one instrument", "against")
        replaced.append(before.content_hash())
        replacing.append(after.content_hash())
        rows = stars_of(table, before)
        warnings += [f"{name}: {remark}" for remark in rows.remarks if remark.startswith("INSTRUME")]
        warnings += [f"{name}: {doubt}" for doubt in rows.doubts if doubt.startswith("INSTRUME")]
        made_with = str(table.table.meta.get("CALHASH", ""))
        if made_with == replacing[-1] != replaced[-1]:
            warnings.append(f"{name}: was made with the new calibration already")
        elif made_with and made_with != replaced[-1]:
            warnings.append(f"{name}: was made with a calibration that is neither the old nor the new one")
        job.tell(f"{len(rows)} rows of {name}", "tabulating")
        with errors_naming(table.path):
            shifted = list(nights_of(before, after, rows, name, limit))
        nights += shifted
        if beyond := sum(night.beyond for night in shifted):
            what = "stars have a filter or temperature that the new one does not cover"
            warnings.append(f"{name}: {beyond} {what}")
    first, second = (", ".join(dict.fromkeys(hashes)) for hashes in (replaced, replacing))
    found = Affected(first, second, limit, tuple(nights), tuple(warnings))
    part = VerdictPart(found, found.document(), found.display())
    return Asked("affected", part, found.against, found.stars_in_words, warnings=found.warnings)


def _quality(job: Job, held: Calibration, run: Any, append: PathLike, limits: PathLike | None) -> Asked:
    """A row of quality numbers in a table of nights."""
    from walop_jax.fit.verdict import VerdictPart
    from walop_jax.io.run_folder import RunFolder
    from walop_jax.reports.survey_figures import quality_figure
    from walop_jax.science.quality import QualityRow, quality_row, read_limits, table_of_nights
    from walop_jax.science.quality import append as appended

    job.begin("writing")
    allowed = read_limits(limits)
    folder = getattr(run, "folder", run)
    folder = Path(folder) if isinstance(folder, str | os.PathLike) else None
    documents = RunFolder(folder).documents if folder is not None and folder.is_dir() else {}
    row = quality_row(held, str(folder or held.path), documents.get("summary", {}).get("accuracy_of_p"))
    remarks = []
    if row["NIGHTS"] > 1:
        remarks.append(f"{row['RUN']}: holds {row['NIGHTS']} nights, its row is that of the last")
    table, about = appended(append, table_of_nights([row]), allowed)
    remarks += about
    mine = next(entry for entry in table if str(entry["CALHASH"]) == row["CALHASH"])
    found = QualityRow(table, mine, allowed, str(append), tuple(remarks))
    return Asked(
        "quality",
        VerdictPart(found, found.document(), found.display()),
        found.against,
        "",
        {QUALITY_FIGURE: figure_file(quality_figure, table, allowed)},
        remarks,
    )
