"""`walop-jax simulate`: a synthetic calibration set, with effects if wanted, and its truth beside it."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Mapping, Sequence
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from walop_jax.commands.command import Argument, Job, Option, Outcome, UsageError, command
from walop_jax.commands.inputs import (
    Effects,
    InstrumentLike,
    PathLike,
    SetFile,
    catalogue_of,
    design_of,
)
from walop_jax.io.text import json_text, parse_toml, read_text, rounded

if TYPE_CHECKING:
    from walop_jax import Effect, Instrument, ObservingPlan
    from walop_jax.simulation.simulate import Simulated

PLAN = Argument("Observing plan (TOML), in place of the options that make one.", "[PLAN.toml]", Path)
EFFECT = Option(
    "Effect to hide in the data; NAME=par:value,par:value for several parameters (a/b/c/d for one "
    "value per element), NAME alone where there is none to give. May be repeated.",
    "NAME=VALUE",
    list[str],
)
OF_A_PLAN = (
    "grid", "standard_grid", "angles", "full_turn", "moon_patches", "standards", "electrons", "plate", "narrow_bands",
)  # fmt: skip


def _older(args: tuple[Any, ...], kwargs: dict[str, Any]) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """The arguments with the seed by its name, and with what is hidden in the data as `effect`."""
    if len(args) > 1:
        args, kwargs = (args[0], *args[2:]), {"seed": args[1]} | kwargs
    given = kwargs.get("effects")
    classes = isinstance(given, Sequence) and given and all(isinstance(one, type) for one in given)
    if (
        given is not None
        and "effect" not in kwargs
        and not isinstance(given, str | os.PathLike)
        and not classes
    ):
        kwargs = kwargs | {"effect": kwargs.pop("effects")}
    return args, kwargs


@command(stages=("following", "writing"), writes="file", random=True, given=_older)
def simulate(
    job: Job,
    plan: Annotated[ObservingPlan | PathLike | None, PLAN] = None,
    *,
    output: SetFile = None,
    instrument: InstrumentLike = None,
    effect: Annotated[str | Sequence[str | Effect] | Mapping[str, Any] | None, EFFECT] = None,
    effects: Effects = None,
    grid: Annotated[int, Option("Field points along each axis.", least=1)] = 12,
    standard_grid: Annotated[int, Option("Places of a standard along each axis.", least=1)] = 5,
    angles: Annotated[int, Option("Polariser angles.", least=1)] = 15,
    full_turn: Annotated[bool, Option("Spread them over 360 degrees, not 180.")] = False,
    moon_patches: Annotated[int, Option("Patches of the full-Moon sky.", least=0)] = 8,
    standards: Annotated[int, Option("Standard stars, the first two unpolarised.", least=0)] = 8,
    electrons: Annotated[float, Option("Level of a camera in unpolarised light.")] = 1e6,
    plate: Annotated[bool, Option("Calibration half-wave plate out, at 0 and at 45 degrees.")] = False,
    narrow_bands: Annotated[bool, Option("Polariser in two narrow bands as well.")] = False,
    truth: Annotated[PathLike | None, Option("Write the true parameters here.", "FILE.json", Path)] = None,
    noiseless: bool = False,
    catalogue_seed: int | None = None,
) -> Outcome[Simulated]:
    """Make a calibration set of an instrument whose as-built values are drawn from their priors.

    The light path is the one that a fit uses; noise is that of photons and of the detectors (30 electrons).

    In Python: the set and the true instrument. `effect` may be a dict, {"hwp1_axis": 0.3}, or `Effect` objects; with a
    plan, an `Instrument` as `instrument` is the true one, not drawn. `noiseless`: expected counts, with the errors that
    they would have. The same plan, seed and effects give the same set, bit for bit. `catalogue_seed` draws the
    standards apart from the rest: nights of one survey have theirs in common.

    >>> calset, truth = walop.simulate(grid=4, effects={"hwp1_axis": 0.3}, seed=1)  # doctest: +SKIP
    """
    from walop_jax import Instrument
    from walop_jax.data.write import write_calibration_set
    from walop_jax.io.atomic import atomic_path, check_output
    from walop_jax.model.instrument import NoSuchPlaceError
    from walop_jax.simulation.observing_plan import instrument_named, read_plan
    from walop_jax.simulation.simulate import effect_from_text
    from walop_jax.simulation.simulate import simulate as simulated

    asked = {name: value for name, value in locals().items() if name in OF_A_PLAN}
    catalogue = catalogue_of(effects)
    true = instrument if isinstance(instrument, Instrument) else None
    file = instrument
    if isinstance(plan, str | os.PathLike):
        file = file or instrument_named(parse_toml(read_text(plan)), Path(plan).parent)
        plan = read_plan(plan, None if true else instrument)  # pyright: ignore[reportArgumentType]
    try:
        if plan is None:
            plan, true = _plan(design_of(instrument), **asked), None
        else:
            defaults = {p.name: p.default for p in signature(simulate).parameters.values()}
            idle = [name for name, value in asked.items() if value != defaults[name]]
            if idle:
                raise UsageError(f"the plan says all of that: leave {', '.join(idle)} out", idle[0])
        context = plan.context()
        hidden = [
            effect_from_text(one, context, catalogue) if isinstance(one, str) else one
            for one in _texts(effect)
        ]
        for one in hidden:
            try:
                one.patch(plan.design)
            except NoSuchPlaceError as error:
                raise ValueError(f"effect {one.name!r}: {error}") from None
    except ValueError as error:
        raise UsageError(str(error)) from None
    if truth is not None:
        check_output(truth, overwrite=job.overwrite)
    job.tell("following the light", "following")
    made = simulated(
        plan,
        job.seed,
        instrument=true,
        effects=hidden,
        noiseless=noiseless,
        catalogue_seed=catalogue_seed,
    )
    job.begin("writing")
    with contextlib.ExitStack() as stack:
        if truth is not None:
            temporary = stack.enter_context(atomic_path(truth, overwrite=job.overwrite))
            temporary.write_text(json_text(truth_document(plan, job.seed, made.truth)), encoding="utf-8")
        if output is not None:
            write_calibration_set(output, made.calset, overwrite=job.overwrite)
    document = {
        "output": output,
        "instrument": plan.name,
        "seed": job.seed,
        "exposures": len(made.calset.exposures),
        "points": len(made.calset.points),
        "rows": made.calset.intensities.rows,
        "effects": [one.name for one in hidden],
        "truth": truth,
    }
    return Outcome(
        made,
        lambda: document,
        lambda: (
            f"{output}: {plan.name}, {document['exposures']} exposures of {document['points']} points; "
            f"{'; '.join(map(_sized, hidden)) or 'nothing'} beyond the base model"
        ),
        next=(f"walop-jax refit {output} --instrument {file} -o RUN",) if plan.design.description else (),
    )


def _plan(
    design: Instrument | None, *, angles: int, full_turn: bool, plate: bool, narrow_bands: bool, **more: Any
) -> ObservingPlan:
    """The plan that the options ask for."""
    from walop_jax import ObservingPlan
    from walop_jax.model.instrument import nominal_instrument
    from walop_jax.simulation.observing_plan import NARROW_BANDS, polariser_turn

    design = design or nominal_instrument()
    turn = polariser_turn(angles, full_turn=full_turn)
    if design.raster[0] == "line":
        bench = ObservingPlan.bench(more["grid"])
        return dataclasses.replace(
            bench, instrument=design, polariser_angles=turn, electrons=more["electrons"]
        )
    return ObservingPlan(
        design,
        polariser_angles=turn,
        plate=(None, 0.0, 45.0) if plate else (None,),
        filters=("SDSS-r", *NARROW_BANDS) if narrow_bands else ("SDSS-r",),
        **more,
    )


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
