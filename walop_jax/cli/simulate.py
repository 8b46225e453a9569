"""`walop-jax simulate`: a synthetic calibration set, with effects if wanted, and its truth beside it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from walop_jax.cli.common import (
    JsonOption,
    OverwriteOption,
    QuietOption,
    json_text,
    print_json,
    progress,
    switch_on_jax,
)

if TYPE_CHECKING:
    from walop_jax.model.effects.base import Context, Effect
    from walop_jax.simulation.observing_plan import ObservingPlan

OutputOption = Annotated[
    Path, typer.Option("--output", "-o", metavar="CALSET", help="Calibration set to write (FITS).")
]
InstrumentOption = Annotated[
    str, typer.Option("--instrument", help="WALOP-SOUTH, WALOP-NORTH, or WALOP-LAB (the bench).")
]
EffectOption = Annotated[
    list[str] | None,
    typer.Option(
        "--effect",
        metavar="NAME=VALUE",
        help="Effect to hide in the data; NAME=par:value,par:value for several parameters (a/b/c/d for one "
        "value per element), NAME alone where there is none to give. May be repeated.",
    ),
]
TruthOption = Annotated[
    Path | None, typer.Option("--truth", metavar="FILE.json", help="Write the true parameters here.")
]
SeedOption = Annotated[int, typer.Option("--seed", min=0, help="The same seed gives the same set.")]


def simulate(
    output: OutputOption,
    instrument: InstrumentOption = "WALOP-SOUTH",
    effect: EffectOption = None,
    seed: SeedOption = 0,
    grid: Annotated[int, typer.Option(min=1, help="Field points along each axis.")] = 12,
    standard_grid: Annotated[int, typer.Option(min=1, help="Places of a standard along each axis.")] = 5,
    angles: Annotated[int, typer.Option(min=1, help="Polariser angles.")] = 15,
    full_turn: Annotated[
        bool, typer.Option("--full-turn", help="Spread them over 360 degrees, not 180.")
    ] = False,
    moon_patches: Annotated[int, typer.Option(min=0, help="Patches of the full-Moon sky.")] = 8,
    standards: Annotated[int, typer.Option(min=0, help="Standard stars, the first two unpolarised.")] = 8,
    electrons: Annotated[float, typer.Option(help="Level of a camera in unpolarised light.")] = 1e6,
    plate: Annotated[
        bool, typer.Option("--plate", help="Calibration half-wave plate out, at 0 and at 45 degrees.")
    ] = False,
    narrow_bands: Annotated[
        bool, typer.Option("--narrow-bands", help="Polariser in two narrow bands as well.")
    ] = False,
    truth: TruthOption = None,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Make a calibration set of an instrument whose as-built values are drawn from their priors.

    The light path is the one that a fit uses; noise is that of photons and of the detectors (30 electrons).
    """
    from walop_jax.data.write import write_calibration_set
    from walop_jax.io.atomic import atomic_path, check_output

    check_output(output, overwrite=overwrite)
    if truth is not None:
        check_output(truth, overwrite=overwrite)
    switch_on_jax()
    from walop_jax.simulation import simulate as simulation
    from walop_jax.simulation.observing_plan import NARROW_BANDS, ObservingPlan, polariser_turn

    turn = polariser_turn(angles, full_turn=full_turn)
    try:
        if instrument.upper() == "WALOP-LAB":
            plan = dataclasses.replace(ObservingPlan.bench(grid), polariser_angles=turn, electrons=electrons)
        else:
            plan = ObservingPlan(
                instrument.upper(),
                grid=grid,
                standard_grid=standard_grid,
                polariser_angles=turn,
                moon_patches=moon_patches,
                standards=standards,
                electrons=electrons,
                plate=(None, 0.0, 45.0) if plate else (None,),
                filters=("SDSS-r", *NARROW_BANDS) if narrow_bands else ("SDSS-r",),
            )
        effects = [parsed_effect(text, plan.context()) for text in effect or ()]
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None

    with progress(quiet or json) as tell:
        tell("following the light")
        calset, true = simulation.simulate(plan, seed, effects=effects)
        tell("writing")
        write_calibration_set(output, calset, overwrite=overwrite)
        if truth is not None:
            with atomic_path(truth, overwrite=overwrite) as temporary:
                temporary.write_text(json_text(_truth(plan, seed, true)), encoding="utf-8")
    summary = {
        "output": str(output),
        "instrument": plan.instrument,
        "seed": seed,
        "exposures": len(calset.exposures),
        "points": len(calset.points),
        "rows": calset.intensities.rows,
        "effects": [one.name for one in effects],
        "truth": None if truth is None else str(truth),
    }
    if json:
        print_json(summary)
    elif not quiet:
        hidden = ", ".join(one.name for one in effects) or "nothing"
        typer.echo(
            f"{output}: {plan.instrument}, {summary['exposures']} exposures of {summary['points']} points; "
            f"{hidden} beyond the base model"
        )


def parsed_effect(text: str, context: Context) -> Effect:
    """The effect that `name`, `name=value` or `name=par:value,par:value` stands for.

    Raises ValueError, with the nearest names, for what does not exist, and for values that are missing.
    """
    from walop_jax.model.effects import effect_by_name
    from walop_jax.model.parameters import field_declarations

    name, _, rest = (part.strip() for part in text.partition("="))
    kind = effect_by_name(name)
    names = tuple(field_declarations(kind))
    values: dict[str, Any] = {}
    if rest and ":" not in rest:
        if len(names) != 1:
            listed = f"give {name}={','.join(f'{n}:…' for n in names)}" if names else f"give {name} alone"
            raise ValueError(f"effect {name!r} has {len(names)} parameters, not one: {listed}")
        values[names[0]] = _value(rest, name)
    elif rest:
        for part in rest.split(","):
            parameter, colon, value = (piece.strip() for piece in part.partition(":"))
            if not colon or not value or parameter in values:
                raise ValueError(f"effect {name!r}: {part!r} is not par:value (each once)")
            values[parameter] = _value(value, name)
    if names and not any(parameter in values for parameter in kind.amplitudes()):
        wanted = " or ".join(kind.amplitudes())
        raise ValueError(f"effect {name!r} changes nothing without a value of {wanted}")
    try:
        return kind.of(context, **values)
    except (TypeError, ValueError) as error:
        if str(error).startswith("unknown"):
            raise
        raise ValueError(f"effect {name!r}: {rest!r} does not fit its parameters ({error})") from None


def _value(text: str, name: str) -> Any:
    """A number, several of them between slashes, or (for discrete choices) a word."""
    try:
        if "/" in text:
            return [float(part) for part in text.split("/")]
        return int(text) if text.lstrip("+-").isdigit() else float(text)
    except ValueError:
        if text.isidentifier():
            return text
        raise ValueError(f"effect {name!r}: {text!r} is not a number") from None


def _truth(plan: ObservingPlan, seed: int, true: Any) -> Mapping[str, Any]:
    from walop_jax.model.parameters import leaves
    from walop_jax.simulation.simulate import truth_values

    units = {leaf.name: leaf.declaration.unit for leaf in leaves(true)}
    return {
        "instrument": plan.instrument,
        "seed": seed,
        "plan": dataclasses.asdict(plan),
        "effects": {one.name: one.choices() for one in true.effects},
        "parameters": {
            name: {"value": value, "unit": units[name]} for name, value in truth_values(true).items()
        },
    }
