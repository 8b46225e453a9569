"""Whether the light of an instrument can be computed as described: what would be passed over in silence is an error."""

from __future__ import annotations

import itertools
from collections import Counter

from walop_jax.io.errors import DataError
from walop_jax.model.elements import Analyser, Polariser
from walop_jax.model.instrument import Instrument
from walop_jax.model.parameters import leaves

TAKEN = ("throughput", "cameras", "effects")
"""Names of other parts of an instrument."""


def check(instrument: Instrument) -> None:
    """Raise `DataError`, naming the table, for a part that would do nothing where it stands and for a doubled name."""
    for element in instrument.elements:
        if isinstance(element, Analyser):
            raise DataError(f"[elements.{element.name}] an analyser ends an arm: move it to the path of one")
    polarisers = [element.name for element in instrument.train() if isinstance(element, Polariser)]
    if len(polarisers) > 1:
        raise DataError(f"[elements.{polarisers[1]}] is a second polariser; there can be one")
    for arm in instrument.arms:
        for element in arm.train():
            if isinstance(element, Analyser | Polariser):
                where = "ends its arm" if isinstance(element, Analyser) else "stands ahead of the arms"
                raise DataError(f"[arms.{arm.name}.elements.{element.name}] a {element.kind} {where}")
    names = Counter(
        part.name for part in itertools.chain(instrument.sources, instrument.elements, instrument.arms)
    )
    for name, count in (names + Counter(TAKEN)).items():
        if count > 1:
            raise DataError(
                f"[{name}] more than one part of the instrument has this name; give it another one"
            )
    parameters = Counter(leaf.name for leaf in leaves(instrument))
    for name, count in parameters.items():
        if count > 1:
            raise DataError(f"{count} parameters have the name {name!r}; give them different ones")
    try:
        instrument.telescope()
    except ValueError as error:
        raise DataError(f"[elements] {error}") from None
