"""`walop-jax trace`: the light of one source, stage by stage, as a table."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from walop_jax.cli.common import EffectsOption, InstrumentOption, JsonOption, print_json, switch_on_jax, warn

if TYPE_CHECKING:
    from walop_jax.model.trace import Stage

ProductArgument = Annotated[
    Path | None,
    typer.Argument(
        metavar="[RUN/calibration.fits]",
        help="An instrument as fitted; without it, as designed.",
        show_default=False,
    ),
]
AngleOption = Annotated[
    float | None, typer.Option("--angle", help="Polariser in, with its axis here (deg).", show_default=False)
]
AtOption = Annotated[
    list[str] | None,
    typer.Option(
        "--at",
        metavar="P=ANGLE",
        help="Angle (deg) of a moving element in the beam, named like its columns: CHWP=45. May be repeated.",
        show_default=False,
    ),
]
TeffOption = Annotated[
    float | None,
    typer.Option("--teff", help="Colour temperature (K); without it, a flat spectrum.", show_default=False),
]


def trace(
    product: ProductArgument = None,
    instrument: InstrumentOption = None,
    effects: EffectsOption = None,
    x: Annotated[float, typer.Option("--x", help="Field position X (deg).")] = 0.0,
    y: Annotated[float, typer.Option("--y", help="Field position Y (deg).")] = 0.0,
    q: Annotated[float, typer.Option("--q", help="Stokes q of the source, a fraction.")] = 0.0,
    u: Annotated[float, typer.Option("--u", help="Stokes u of the source, a fraction.")] = 0.0,
    angle: AngleOption = None,
    at: AtOption = None,
    teff: TeffOption = None,
    filter: Annotated[str, typer.Option("--filter", help="Filter of the calibration, or SDSS-r.")] = "SDSS-r",
    json: JsonOption = False,
) -> None:
    """Follow the light of one source through the instrument.

    Every line is the light at one place: Stokes vectors averaged over the band, then the cameras. The
    last line is what a fit works with.
    """
    nan = float("nan")
    switch_on_jax()
    from walop_jax.data.settings import Settings
    from walop_jax.model.effects.own import catalogue_with
    from walop_jax.model.trace import Sightline
    from walop_jax.runs.trace import trace_source

    setting = Settings.default(1, filter).at(**positions(at or []))
    if teff is not None:
        setting.teff[0] = teff
    try:
        ray = Sightline(x=x, y=y, q=q, u=u, clp_angle=nan if angle is None else angle, setting=setting)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None
    try:
        found = trace_source(ray, product, instrument=instrument, catalogue=catalogue_with(effects))
    except ValueError as error:
        if product is not None:
            raise
        raise typer.BadParameter(str(error)) from None  # the options say all there is
    for sentence in found.warnings:
        warn(sentence)
    if json:
        print_json(found.document())
        return
    for line in table(found.stages):
        typer.echo(line)


def positions(texts: list[str]) -> dict[str, float]:
    """Angles (deg) by column prefix from texts such as CHWP=45; typer.BadParameter for what is none."""
    found = {}
    for text in texts:
        prefix, _, angle = text.partition("=")
        try:
            found[prefix.strip().upper()] = float(angle)
        except ValueError:
            raise typer.BadParameter(f"{text!r} is no P=ANGLE, such as CHWP=45", param_hint="--at") from None
    return found


def table(stages: tuple[Stage, ...]) -> list[str]:
    """The stages as lines of text; column names appear where they change."""
    width = max(len(f"{stage.name} {row}") for stage in stages for row in stage.rows)
    lines: list[str] = []
    columns: tuple[str, ...] = ()
    for stage in stages:
        if stage.columns != columns:
            columns = stage.columns
            lines.append(" " * width + "".join(f"{column:>13}" for column in columns))
        for i, (row, values) in enumerate(zip(stage.rows, stage.value, strict=True)):
            name = f"{stage.name} {row}".strip()
            about = f"   {stage.about}" if i == 0 else ""
            lines.append(f"{name:<{width}}" + "".join(f"{value:13.6f}" for value in values) + about)
    return lines
