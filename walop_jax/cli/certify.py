"""`walop-jax certify`: is this calibration product fit for use?"""

from __future__ import annotations

import typer

from walop_jax.cli.common import (
    CommandError,
    EffectsOption,
    JsonOption,
    Product,
    QuietOption,
    print_json,
    progress,
    switch_on_jax,
)


def certify(
    product: Product,
    effects: EffectsOption = None,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Check a calibration product from its checksums to its physics; exit code 1 if anything does not hold.

    Version, content hash, convergence, covariance, validity (dates, filters, temperatures), hashes of the
    calibration sets it was made from, maps against parameters, and that no camera has a negative transmission.
    """
    switch_on_jax()
    from walop_jax.model.effects.own import catalogue_with
    from walop_jax.runs.certify import certify_product

    with progress(quiet or json) as tell:
        tell("checking")
        found = certify_product(product, catalogue_with(effects))
    if json:
        print_json(found.document())
    elif not quiet:
        for check in found.checks:
            typer.echo(f"{'ok ' if check.passed else 'BAD'} {check.name}: {check.found}")
        if not found.failed:
            typer.echo("fit for use")
    if found.failed:
        raise CommandError(
            f"{found.path}: not valid: "
            + "; ".join(f"{check.name} ({check.found})" for check in found.failed)
        )
