"""Change of the light of a star by small changes of an instrument: to first order, from the slots of the columns.

Equation    δa = Σ f B G F + a G_t      of the optics behind the telescope, of the light ahead of the polariser
Symbols     a analysis vectors (camera; 1, q, u) of one setting; B, G, F as in `model.slots`; G_t generator of what
            acts on the light itself; f factors of the change over the field
Limits      First order. Changes of sources, of the polariser, of detectors and in single exposures do nothing to a
            star; what grows with time, temperature or an angle is 0 in the usual setting.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from walop_jax.likelihood import limits
from walop_jax.likelihood.columns import Columns, ResponseBlock, SumOfChanges
from walop_jax.model.effects.change import InExposures, SlotTerm
from walop_jax.model.effects.factors import FIELD, Units, factor
from walop_jax.model.effects.optics import generator


def added_to_starlight(
    columns: Columns, changes: Sequence[SumOfChanges], exposure: int
) -> tuple[Float[np.ndarray, "p k 3"], Float[np.ndarray, "p k 3 a"]]:
    """Analysis vectors at the field points in the setting of an exposure, and the part added by each change."""
    changed_terms = [columns.terms_of(change) for change in changes]
    points, size, batches = len(columns.likelihood.used), limits.RESPONSES_TOGETHER, []
    for start in range(0, points, size):
        terms = _at_points(ResponseBlock(columns, start, ()), changed_terms, exposure)
        batches.append(tuple(term[: points - start] for term in terms))
    vectors, added = (np.concatenate(terms) for terms in zip(*batches, strict=True))
    return vectors, added


def _at_points(
    block: ResponseBlock,
    changes: Sequence[Sequence[SlotTerm]],
    exposure: int,
) -> tuple[Float[np.ndarray, "p k 3"], Float[np.ndarray, "p k 3 a"]]:
    points, band = np.arange(len(block.x)), block.band[:, exposure]
    vectors = np.asarray(block.found.vectors.vectors)[points, 0, band]  # p k 4
    added = np.zeros((*vectors.shape[:-1], 3, len(changes)))
    at = InExposures(block.of.exposures, block.x[:, None], block.y[:, None])
    for a, terms in enumerate(changes):
        for slot, coefficient, factors in terms:
            if slot in block.of.of_vectors:
                change = block.change(slot)[points, 0, band]
            elif slot[0] == "light" and slot[2] == "ahead of":
                change = vectors @ generator(slot[1])
            elif slot[0] == "counts":
                change = vectors * np.asarray(slot[1])[:, None]
            else:
                continue
            size = _for_stars(factors, at, exposure, block.of.patched.units) * coefficient
            added[..., a] += size[:, None, None] * change[..., :3]
    return vectors[..., :3], added


def _for_stars(
    factors: Sequence[Any], at: InExposures, exposure: int, units: Units
) -> Float[np.ndarray, " p"]:
    """Product of factors for stars in the setting of an exposure: at its time, temperature and angles nothing grows."""
    points, product = len(at.x), np.ones(len(at.x))
    for name in factors:
        if not isinstance(name, str):
            shape = (points, len(at.number))
            product = product * np.broadcast_to(name(at), shape)[:, exposure]
        elif (field_factor := factor(name)).depends_on == FIELD:
            product = product * np.broadcast_to(field_factor.value(at, units), (points, 1))[:, 0]
        else:
            return np.zeros(points)
    return product
