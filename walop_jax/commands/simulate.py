"""`walop-jax simulate`: a synthetic calibration set, with effects if wanted, and its truth beside it."""

from __future__ import annotations

import os
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
    given,
    typed,
    write_text,
)
from walop_jax.commands.products import (
    CalibrationLike,
    Effects,
    InstrumentLike,
    calibration_of,
    catalogue_of,
    design_of,
    left_out_sentences,
)
from walop_jax.io.atomic import check_output
from walop_jax.io.text import date_of, json_text, parse_toml, read_text

if TYPE_CHECKING:
    from walop_jax import Effect, ObservingPlan
    from walop_jax.model.effects import EffectKind
    from walop_jax.simulation.simulate import Simulated
    from walop_jax.simulation.truth import Template


OPTIONS = {
    "plan": Option(
        "Observing plan (TOML); default: the usual one of the instrument.",
        metavar="[PLAN.toml]",
        kind=Path,
        placed=True,
    ),
    "output": Option(
        "Calibration set to write (FITS).", metavar="SET.fits", kind=Path, short="-o", required=True
    ),
    "effect": Option(
        "Effect to hide in the data; NAME=par:value,par:value for several parameters (a/b/c/d for one "
        "value per element), NAME alone where there is none to give. May be repeated.",
        metavar="NAME=VALUE",
        kind=list[str],
    ),
    "like": Option(
        "Another night of the same instrument: a run as fitted, or the truth of a simulated set. "
        "Instrument and catalogue are those; --effect changes the instrument, --seed draws weather and "
        "noise.",
        metavar="RUN|TRUTH.json",
        kind=Path,
    ),
    "night": Option("Number of the night: days after the date of the plan.", metavar="N", kind=int, least=0),
    "truth": Option("Write the true parameters here.", metavar="FILE.json", kind=Path),
    "stars": Option(
        "Make a catalogue of so many stars in place of the set: of the same instrument.",
        metavar="N",
        kind=int,
        least=1,
    ),
    "cameras": Option(
        "With --stars: catalogues of the cameras as well, as SExtractor writes them (STARS_O1.fits, …), for gather."
    ),
}


@command(
    stages=("following", "writing"), writes=(), random=True, outputs=("output", "truth"), options=OPTIONS
)
def simulate(
    job: Job,
    plan: ObservingPlan | PathLike | None = None,
    *,
    output: PathLike | None = None,
    instrument: InstrumentLike = None,
    effect: str | Sequence[str | Effect] | Mapping[str, Any] | None = None,
    effects: Effects = None,
    like: Simulated | CalibrationLike | None = None,
    night: int | None = None,
    truth: PathLike | None = None,
    stars: int | None = None,
    cameras: bool = False,
    noiseless: bool = False,
    catalogue_seed: int | None = None,
) -> Outcome[Simulated]:
    """Make a calibration set of an instrument whose as-built values are drawn from their priors.

    The light path is the one that a fit uses; noise is that of photons and of the detectors (30 electrons). The
    exposures are those of a plan file (see walop-jax docs files): field points, angles, Moon patches, standards,
    filters.

    Nights of one instrument, to rehearse check and stack on: --like TRUTH.json --night 10. Each night has noise and
    weather of its own, also with the same seed.

    With `stars` it is a catalogue of the sky for `apply` and `check` (RA, DEC, BP_RP and all): the same plan, seed and
    effects give the stars of the instrument that the set calibrates. With `cameras` there are those of the cameras as
    well, beside it, for `gather`.

    In Python: the set and the true instrument; with `stars` the catalogue, an astropy table. `effect` may be a dict,
    {"hwp1_axis": 0.3}, or `Effect` objects; with a plan, an `Instrument` as `instrument` is the true one, not drawn.
    `noiseless`: expected counts, with the errors that they would have. The same plan, seed and effects give the same
    set, bit for bit. `like` may also be what `simulate` has returned, or a fit. `catalogue_seed` draws the standards
    apart from the rest.

    >>> first = walop.simulate(walop.ObservingPlan(grid=4))  # doctest: +SKIP
    >>> calset, truth = walop.simulate(like=first, night=10, effect={"hwp1_axis": 0.3})  # doctest: +SKIP
    """
    import numpy as np

    from walop_jax import Instrument, ObservingPlan
    from walop_jax.data.write import write_calibration_set
    from walop_jax.io.plain_tables import astropy_table, table_format, write_table
    from walop_jax.model.instrument import nominal_instrument
    from walop_jax.science.simulated_stars import simulated_stars
    from walop_jax.simulation.observing_plan import instrument_named, read_plan
    from walop_jax.simulation.simulate import effect_in_words, effects_given, true_instrument
    from walop_jax.simulation.simulate import simulate as simulated
    from walop_jax.simulation.truth import truth_document

    true = instrument if isinstance(instrument, Instrument) and plan is not None else None
    file = instrument
    if isinstance(plan, str | os.PathLike):
        file = file or instrument_named(parse_toml(read_text(plan)), Path(plan).parent)
        plan = read_plan(plan, None if true else instrument)  # pyright: ignore[reportArgumentType]
    try:
        template, catalogue = None, catalogue_of(effects)
        if like is not None:
            if instrument is not None or catalogue_seed is not None:
                what = "like gives instrument and catalogue"
                raise ValueError(f"{what}: leave out instrument and catalogue_seed")
            template = _template(like, catalogue)
            plan = template.planned(plan)
        plan = plan or ObservingPlan.usual(design_of(instrument) or nominal_instrument())
        hidden, lost = effects_given(effect, plan, catalogue), ()
        if template is not None:
            true, lost = template.instrument_of(plan, hidden)
    except ValueError as error:
        raise UsageError(str(error)) from None
    if cameras and (stars is None or output is None):
        raise UsageError("catalogues of the cameras are those of --stars N, beside its --output", "cameras")
    if stars is not None and "standard" not in plan.design.kinds:
        raise UsageError(f"{plan.name} sees no stars", "stars")
    beside = _beside(Path(str(output)), plan.design.cameras.names) if cameras else []
    for path in (output, truth, *beside):
        if path is not None:
            check_output(path, overwrite=job.overwrite)
    if stars is not None and output is not None:
        table_format(output)
    drawn: dict[str, Any] = {"instrument": true, "effects": hidden, "catalogue_seed": catalogue_seed}
    drawn["catalogue"] = None if template is None else template.catalogue
    about: dict[str, Any] = {"output": output, "instrument": plan.name, "seed": job.seed, "truth": truth}
    about["effects"] = [hidden_effect.name for hidden_effect in hidden]
    job.tell("following the light", "following")
    data: Any
    if stars is not None:
        sources, true = true_instrument(plan, job.seed, **drawn)
        field = simulated_stars(plan, true, stars, job.seed, night=night or 0, noiseless=noiseless)
        data = astropy_table(field.columns, {"INSTRUME": plan.name})
        tables = {path: astropy_table(*field.of_camera(k, job.seed)) for k, path in enumerate(beside)}
        content, times = (
            truth_document(plan, job.seed, sources, true) | {"stars": field.document()},
            data["MJD"],
        )
        about["stars"] = stars
        which = f"seed {job.seed}" if like is None or isinstance(like, tuple) else str(like)
        text = f"{output}: {plan.name}, {stars} stars of the instrument of {which}"
        step = typed("apply", "RUN", output, "-o", "OUT.fits")
        if beside:
            about["cameras"] = [str(path) for path in beside]
            text += f"; of the cameras: {', '.join(about['cameras'])}"
            step = typed("gather", *beside, "-o", "GATHERED.fits")
        job.begin("writing")
        for path, table in ({} if output is None else {output: data, **tables}).items():
            write_table(path, table, overwrite=job.overwrite)
    else:
        data = simulated(plan, job.seed, noiseless=noiseless, night=night, **drawn)
        calset, true = data
        content, times = truth_document(plan, job.seed, calset.sources, true), calset.exposures.mjd
        about |= {"exposures": len(calset.exposures), "points": len(calset.points)}
        about["rows"] = calset.intensities.rows
        text = f"{output}: {plan.name}, {about['exposures']} exposures of {about['points']} points"
        options = given(instrument=file) if plan.design.description else ()
        step = typed("refit", output, *options, "-o", "RUN")
        job.begin("writing")
        if output is not None:
            write_calibration_set(output, calset, overwrite=job.overwrite)
    if truth is not None:
        write_text(truth, json_text(content), overwrite=job.overwrite)
    text += f"; {'; '.join(map(effect_in_words, true.effects)) or 'nothing'} beyond the base model"
    if template is not None:
        mjd = float(np.nanmin(times))
        text += f"; the night of {date_of(mjd)}"
        about |= {"like": None if isinstance(like, tuple) else str(like), "night": night, "mjd": mjd}
    warnings = left_out_sentences(lost, like if isinstance(like, str | os.PathLike) else None)
    return Outcome(data, about, text, warnings=warnings, next=(step,))


def _beside(output: Path, names: Sequence[str]) -> list[Path]:
    """The files of the catalogues of cameras, beside that of the stars: STARS_O1.fits, …"""
    end = ".fits.gz" if output.name.lower().endswith(".fits.gz") else output.suffix
    return [output.with_name(f"{output.name[: len(output.name) - len(end)]}_{name}{end}") for name in names]


def _template(like: Any, catalogue: Sequence[EffectKind]) -> Template:
    """The instrument and the catalogue of another night. Raises `DataError` for a file that has none."""
    from walop_jax.simulation.simulate import Simulated
    from walop_jax.simulation.truth import Template, read_truth

    if isinstance(like, Simulated):
        return Template.of(like)
    if isinstance(like, str | os.PathLike) and Path(like).suffix == ".json":
        return read_truth(like, catalogue)
    held = calibration_of(like, catalogue)
    return Template(held.model.instrument(held.values), held.sources)
