"""`walop-jax simulate`: a synthetic calibration set, with effects if wanted, and its truth beside it."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

import typer

from walop_jax.cli.common import (
    EffectsOption,
    InstrumentOption,
    JsonOption,
    OverwriteOption,
    QuietOption,
    print_json,
    progress,
    switch_on_jax,
)

OutputOption = Annotated[
    Path, typer.Option("--output", "-o", metavar="CALSET", help="Calibration set to write (FITS).")
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
STAGES = ("following", "writing")


def simulate(
    output: OutputOption,
    instrument: InstrumentOption = None,
    effect: EffectOption = None,
    effects: EffectsOption = None,
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
    switch_on_jax()
    from walop_jax.model.build import nominal_instrument
    from walop_jax.model.effects.own import catalogue_with
    from walop_jax.model.instrument import Instrument
    from walop_jax.runs.simulate import simulate_set
    from walop_jax.simulation.effect_text import effect_from_text
    from walop_jax.simulation.observing_plan import NARROW_BANDS, ObservingPlan, polariser_turn

    catalogue = catalogue_with(effects)
    turn = polariser_turn(angles, full_turn=full_turn)
    try:
        design = Instrument.read(instrument) if instrument else nominal_instrument()
        if design.raster[0] == "line":
            plan = dataclasses.replace(
                ObservingPlan.bench(grid), instrument=design, polariser_angles=turn, electrons=electrons
            )
        else:
            plan = ObservingPlan(
                design,
                grid=grid,
                standard_grid=standard_grid,
                polariser_angles=turn,
                moon_patches=moon_patches,
                standards=standards,
                electrons=electrons,
                plate=(None, 0.0, 45.0) if plate else (None,),
                filters=("SDSS-r", *NARROW_BANDS) if narrow_bands else ("SDSS-r",),
            )
        hidden = [effect_from_text(text, plan.context(), catalogue) for text in effect or ()]
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None

    with progress(quiet or json, STAGES) as tell:
        made = simulate_set(
            output, plan, seed=seed, effects=hidden, truth=truth, overwrite=overwrite, progress=tell
        )
    if json:
        print_json(made.document())
    elif not quiet:
        listed = ", ".join(made.effects) or "nothing"
        typer.echo(
            f"{output}: {made.instrument}, {made.exposures} exposures of {made.points} points; "
            f"{listed} beyond the base model"
        )
