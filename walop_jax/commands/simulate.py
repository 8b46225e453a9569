"""`walop-jax simulate`: a synthetic calibration set, with effects if wanted, and its truth beside it."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from walop_jax.commands.command import Argument, Job, Option, Outcome, UsageError, command
from walop_jax.commands.inputs import Effects, InstrumentLike, PathLike, SetFile, catalogue_of, design_of
from walop_jax.io.text import json_text, parse_toml, read_text, rounded

if TYPE_CHECKING:
    from walop_jax import Effect, Instrument, ObservingPlan
    from walop_jax.model.effects import EffectKind

PLAN = Argument("Observing plan (TOML); default: the usual one of the instrument.", "[PLAN.toml]", Path)
STARS = Option(
    "Make a catalogue of so many stars in place of the set: of the same instrument.", "N", int, least=1
)
EFFECT = Option(
    "Effect to hide in the data; NAME=par:value,par:value for several parameters (a/b/c/d for one "
    "value per element), NAME alone where there is none to give. May be repeated.",
    "NAME=VALUE",
    list[str],
)


@command(stages=("following", "writing"), writes="file", random=True)
def simulate(
    job: Job,
    plan: Annotated[ObservingPlan | PathLike | None, PLAN] = None,
    *,
    output: SetFile = None,
    instrument: InstrumentLike = None,
    effect: Annotated[str | Sequence[str | Effect] | Mapping[str, Any] | None, EFFECT] = None,
    effects: Effects = None,
    truth: Annotated[PathLike | None, Option("Write the true parameters here.", "FILE.json", Path)] = None,
    stars: Annotated[int | None, STARS] = None,
    noiseless: bool = False,
    catalogue_seed: int | None = None,
) -> Outcome[Any]:
    """Make a calibration set of an instrument whose as-built values are drawn from their priors.

    The light path is the one that a fit uses; noise is that of photons and of the detectors (30 electrons). What is
    observed is said by a plan file (see walop-jax docs files): field points, angles, Moon patches, standards, filters.

    With `stars` it is a catalogue of the sky for `apply`, `gather` and `watch` (RA, DEC, BP_RP and all): the same plan,
    seed and effects give the stars of the instrument that the set calibrates.

    In Python: the set and the true instrument; with `stars` the catalogue, an astropy table. `effect` may be a dict,
    {"hwp1_axis": 0.3}, or `Effect` objects; with a plan, an `Instrument` as `instrument` is the true one, not drawn.
    `noiseless`: expected counts, with the errors that they would have. The same plan, seed and effects give the same
    set, bit for bit. `catalogue_seed` draws the standards apart from the rest: nights of one survey have theirs in
    common.

    >>> calset, truth = walop.simulate(walop.ObservingPlan(grid=4), effect={"hwp1_axis": 0.3})  # doctest: +SKIP
    """
    from walop_jax import Instrument, ObservingPlan
    from walop_jax.data.write import write_calibration_set
    from walop_jax.io.atomic import atomic_path, check_output
    from walop_jax.io.plain_tables import astropy_table, write_table
    from walop_jax.model.instrument import nominal_instrument
    from walop_jax.science.simulated_stars import simulated_stars
    from walop_jax.simulation.observing_plan import instrument_named, read_plan
    from walop_jax.simulation.simulate import Simulated, true_instrument
    from walop_jax.simulation.simulate import simulate as simulated

    true = instrument if isinstance(instrument, Instrument) and plan is not None else None
    file = instrument
    if isinstance(plan, str | os.PathLike):
        file = file or instrument_named(parse_toml(read_text(plan)), Path(plan).parent)
        plan = read_plan(plan, None if true else instrument)  # pyright: ignore[reportArgumentType]
    try:
        plan = plan or ObservingPlan.usual(design_of(instrument) or nominal_instrument())
        hidden = _hidden(effect, plan, catalogue_of(effects))
    except ValueError as error:
        raise UsageError(str(error)) from None
    if truth is not None:
        check_output(truth, overwrite=job.overwrite)
    drawn: dict[str, Any] = {"instrument": true, "effects": hidden, "catalogue_seed": catalogue_seed}
    about: dict[str, Any] = {"output": output, "instrument": plan.name, "seed": job.seed, "truth": truth}
    about["effects"] = [one.name for one in hidden]
    job.tell("following the light", "following")
    made: Any
    if stars is not None:
        if "standard" not in plan.design.kinds:
            raise UsageError(f"{plan.name} sees no stars", "stars")
        instrument_there = true_instrument(plan, job.seed, **drawn)[1]
        seen = simulated_stars(plan, instrument_there, stars, job.seed, noiseless=noiseless)
        made = astropy_table(seen.columns, {"INSTRUME": plan.name})
        known = truth_document(plan, job.seed, instrument_there) | {"stars": seen.document()}
        about["stars"] = stars
        text = f"{output}: {plan.name}, {stars} stars of the instrument of seed {job.seed}"
        suggested = (f"walop-jax apply RUN {output} -o OUT.fits",)
    else:
        made = simulated(plan, job.seed, noiseless=noiseless, **drawn)
        known = truth_document(plan, job.seed, made.truth)
        about["exposures"], about["points"] = len(made.calset.exposures), len(made.calset.points)
        about["rows"] = made.calset.intensities.rows
        text = f"{output}: {plan.name}, {about['exposures']} exposures of {about['points']} points"
        fit = f"walop-jax refit {output} --instrument {file} -o RUN"
        suggested = (fit,) if plan.design.description else ()
    job.begin("writing")
    with contextlib.ExitStack() as stack:
        if truth is not None:
            temporary = stack.enter_context(atomic_path(truth, overwrite=job.overwrite))
            temporary.write_text(json_text(known), encoding="utf-8")
        if output is not None and isinstance(made, Simulated):
            write_calibration_set(output, made.calset, overwrite=job.overwrite)
        elif output is not None:
            write_table(output, made, overwrite=job.overwrite)
    text += f"; {'; '.join(map(_sized, hidden)) or 'nothing'} beyond the base model"
    return Outcome(made, about, text, next=suggested)


def _hidden(given: Any, plan: ObservingPlan, catalogue: Sequence[EffectKind]) -> list[Effect]:
    """The effects that a set holds. Raises ValueError for one that the instrument has no place for."""
    from walop_jax.model.instrument import NoSuchPlaceError
    from walop_jax.simulation.simulate import effect_from_text

    context, hidden = plan.context(), []
    for one in _texts(given):
        hidden.append(effect_from_text(one, context, catalogue) if isinstance(one, str) else one)
        try:
            hidden[-1].patch(plan.design)
        except NoSuchPlaceError as error:
            raise ValueError(f"effect {hidden[-1].name!r}: {error}") from None
    return hidden


def _texts(effect: str | Sequence[str | Effect] | Mapping[str, Any] | None) -> Sequence[str | Effect]:
    """Effects as the command line writes them, of a dict: {"clp_wobble": {"amplitude": 0.06, "phase": 1.0}}."""
    if not isinstance(effect, Mapping):
        return (effect,) if isinstance(effect, str) else effect or ()
    return [
        f"{name}={','.join(f'{key}:{value}' for key, value in given.items())}"
        if isinstance(given, Mapping)
        else f"{name}={given}"
        for name, given in effect.items()
    ]


def _sized(effect: Effect) -> str:
    """An effect as `--effect` writes it, with its units: wollaston_axis=angle:0.3 deg."""
    import numpy as np

    numbers = [
        f"{name}:{'/'.join(rounded(float(v)) for v in np.ravel(getattr(effect, name)))} {declared.unit}".rstrip()
        for name, declared in effect.declarations().items()
    ]
    return f"{effect.name}={', '.join(numbers)}" if numbers else effect.name


def truth_document(plan: ObservingPlan, seed: int, instrument: Instrument) -> dict[str, Any]:
    """Truth of a simulated set as plain data: the plan, the effects, the true value of every parameter."""
    from walop_jax.model.parameters import leaves
    from walop_jax.simulation.simulate import truth_values

    units = {leaf.name: leaf.unit for leaf in leaves(instrument)}
    return {
        "instrument": plan.name,
        "seed": seed,
        "plan": plan.document(),
        "effects": {effect.name: effect.choices() for effect in instrument.effects},
        "parameters": {
            name: {"value": value, "unit": units[name]} for name, value in truth_values(instrument).items()
        },
    }
