"""Products of matrices with hundreds of columns and 10⁴ to 10⁶ rows, piece by piece on all cores.

The command line keeps numpy to one thread, as its matrices are small everywhere else. The pieces do not depend on the
number of cores, and so neither do the results.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Float

from walop_jax.likelihood import limits
from walop_jax.likelihood.runner import cores

Matrix = Float[np.ndarray, "_ _"]


def gram(columns: Float[np.ndarray, "d n"], exact: int | None = None) -> Float[np.ndarray, "n n"]:
    """CᵀC; in single precision where a column beyond the first `exact` takes part, if that is said."""
    count = columns.shape[1]
    single = columns if exact is None or exact >= count else columns.astype(np.float32)
    found = np.empty((count, count))
    starts = {*range(0, count, limits.COLUMNS_TOGETHER), count, min(exact or 0, count)}
    pieces = [slice(first, stop) for first, stop in itertools.pairwise(sorted(starts))]

    def product(pair: tuple[slice, slice]) -> None:
        one, other = pair
        source = columns if exact is None or other.stop <= exact else single
        found[one, other] = source[:, one].T @ source[:, other]
        found[other, one] = found[one, other].T

    _on_all_cores(product, [(one, other) for i, one in enumerate(pieces) for other in pieces[i:]])
    return found


def change_in_place(function: Callable[[Matrix], Matrix], columns: Float[np.ndarray, "d n"]) -> None:
    """Replace columns by what a function of some of them gives."""

    def change(first: int) -> None:
        some = columns[:, first : first + limits.PROJECTED_COLUMNS]
        some[:] = function(some)

    _on_all_cores(change, range(0, columns.shape[1], limits.PROJECTED_COLUMNS))


def _on_all_cores(work: Callable[..., None], pieces: Iterable[object]) -> None:
    with ThreadPoolExecutor(cores()) as pool:
        for _ in pool.map(work, pieces):
            pass
