"""`walop-jax certify`: is this calibration product fit for use?"""

from __future__ import annotations

import typer

from walop_jax.cli.common import (
    CommandError,
    JsonOption,
    Product,
    QuietOption,
    SeedOption,
    named,
    print_json,
    product_path,
    switch_on_jax,
)


def certify(
    product: Product, json: JsonOption = False, quiet: QuietOption = False, seed: SeedOption = None
) -> None:
    """Check a calibration product from its checksums to its physics; exit code 1 if anything does not hold.

    Version, content hash, convergence, covariance, validity (dates, filters, temperatures), hashes of the
    calibration sets it was made from, maps against parameters, and that no camera sees less than no light.
    """
    del seed  # nothing is random
    from walop_jax.calibration.product import PRODVERS, read_product

    path = product_path(product)
    held = read_product(path)
    switch_on_jax()
    from walop_jax.calibration.certify import certify as examine
    from walop_jax.calibration.certify import validity

    with named(path):
        checks = examine(held)
    failed = [check for check in checks if not check.passed]
    if json:
        print_json(
            {
                "product": str(path),
                "valid": not failed,
                "schema": PRODVERS,
                "content": held.content_hash(),
                "parents": [entry.sha256 for entry in held.inputs],
                "validity": validity(held)._asdict(),
                "checks": [check._asdict() for check in checks],
            }
        )
    elif not quiet:
        for check in checks:
            typer.echo(f"{'ok ' if check.passed else 'BAD'} {check.name}: {check.found}")
    if failed:
        raise CommandError(
            f"{path}: not valid: " + "; ".join(f"{check.name} ({check.found})" for check in failed)
        )
