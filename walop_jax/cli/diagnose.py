"""`walop-jax diagnose`: find what the model lacks, name it, add it, show the gap shrink."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from walop_jax.cli.common import (
    CalsetFiles,
    EffectsOption,
    InstrumentOption,
    JsonOption,
    ModelOption,
    OverwriteOption,
    QuietOption,
    RunFolder,
    SeedOption,
    print_json,
    progress,
    switch_on_jax,
    warn,
)
from walop_jax.io.rounding import with_error

MinutesOption = Annotated[
    float, typer.Option(min=0.0, help="Minutes after which no further name is looked for.")
]

if TYPE_CHECKING:
    from collections.abc import Iterator

    from walop_jax.diagnosis.findings import Diagnosis, Step

STAGES = ("reading", "fitting the model", "scoring every", "p = ", "mapping the field")


def diagnose(
    calsets: CalsetFiles,
    output: RunFolder,
    model: ModelOption = None,
    instrument: InstrumentOption = None,
    effects: EffectsOption = None,
    overwrite: OverwriteOption = False,
    seed: SeedOption = None,
    minutes: MinutesOption = 20.0,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Say what is missing from the model, add it, and fit again: RUN/diagnosis.json and RUN/calibration.fits.

    The verdict is consistent, effect_found or unexplained. Effects that the data cannot tell apart are listed
    together; effects that the data cannot show at all are listed as such. RUN/calibration.fits and RUN/summary.json
    are of the extended model, and RUN/model.toml is that model, for `refit --model` and `compare --model`;
    `walop-jax report` draws its figures from RUN/diagnosis.fits.
    """
    switch_on_jax()
    from walop_jax.model.effects.own import catalogue_with
    from walop_jax.runs.diagnose import diagnose_sets

    with progress(quiet or json, STAGES) as tell:
        found = diagnose_sets(
            calsets,
            output,
            model=model,
            instrument=instrument,
            seed=seed,
            minutes=minutes,
            overwrite=overwrite,
            catalogue=catalogue_with(effects),
            progress=tell,
        )
    if json:
        print_json(found.document)
    for sentence in found.diagnosis.after.warnings:
        warn(sentence)
    if not (json or quiet):
        _show(found.diagnosis, output)


def _show(found: Diagnosis, output: Path) -> None:
    from rich.console import Console

    from walop_jax.io.rounding import probability

    console = Console(highlight=False, soft_wrap=True)
    before, after = found.before, found.after
    for step in found.steps:
        console.print(f"{step.effect}", style="bold", markup=False)
        for line in _about(step):
            console.print(f"  {line}", markup=False)
    if found.unexplained is not None:
        console.print("without a name", style="bold")
        console.print(f"  {found.unexplained.description}", markup=False)
        if found.unexplained.term:
            console.print(
                f"  added as a free-form term ({', '.join(found.unexplained.term)}): "
                f"χ² {found.unexplained.chi2_before:.1f} → {found.unexplained.chi2_after:.1f}",
                markup=False,
            )
    for line in _about_choices(found):
        console.print(line, markup=False)
    for alike in found.classes:
        console.print(
            f"these data cannot tell {alike.effect} from {', '.join(alike.equivalent)}; to tell them apart: "
            f"{alike.separated_by}",
            markup=False,
        )
    if found.untestable:
        console.print(f"cannot be tested with these data: {', '.join(found.untestable)}")
    now = f"χ²/dof {after.chi2 / max(after.dof, 1):.4f}, chance of such residuals p {probability(found.remaining_p)}"
    if after is before:
        console.print(now)
    else:
        was = f"χ²/dof {before.chi2 / max(before.dof, 1):.4f}, p {probability(found.p_value)}"
        console.print(f"before: {was}\nafter:  {now}")
    if found.caution:
        warn(found.caution)
    console.print(f"verdict: {found.verdict}   ({found.seconds:.0f} s)   {output}", markup=False)


def _about_choices(found: Diagnosis) -> Iterator[str]:
    if not found.choices:
        return
    fitted = [choice for choice in found.choices if math.isfinite(choice.better_by)]
    yield f"{len(found.choices)} other descriptions of the instrument were compared, {len(fitted)} of them fitted"
    for choice in fitted:
        yield f"  {choice.change}: χ² {'smaller' if choice.better_by > 0 else 'larger'} by {abs(choice.better_by):.4g}"


def _about(step: Step) -> Iterator[str]:
    values = [f"{name} = {value}" for name, value in step.choices.items()]
    values += [f"{n} = {with_error(v, s)} {unit}".rstrip() for n, (v, s, unit) in step.parameters.items()]
    if values:
        yield ", ".join(values)
    for other in step.alternatives:
        yield f"or as well {other}"
    yield (
        f"χ² {step.chi2_before:.1f} → {step.chi2_after:.1f}; held out ({step.heldout_before.scheme}) "
        f"{step.heldout_before.mean:.4f} → {step.heldout_after.mean:.4f}; p = {step.p_value:.1g}"
    )
    size = f"{100 * step.change_of_qu:.2g} %"
    yield f"changes calibrated q and u by up to {size}{', which is negligible' if step.negligible else ''}"
    yield "; ".join(f"{key.replace('_', ' ')}: {value}" for key, value in step.where.items())
    if step.equivalent:
        yield f"these data cannot tell it from {', '.join(step.equivalent)}"
        yield f"to tell them apart: {step.separated_by}"
