"""Products of matrices with hundreds of columns and 10⁴ to 10⁶ rows, piece by piece on all cores.

The command line keeps numpy to one thread, as its matrices are small everywhere else. The pieces do not depend on the
number of cores, and so neither do the results.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Float

from walop_jax.likelihood import limits
from walop_jax.likelihood.runner import cores

Matrix = Float[np.ndarray, "_ _"]


def gram(columns: Float[np.ndarray, "d n"]) -> Float[np.ndarray, "n n"]:
    """CᵀC."""
    count = columns.shape[1]
    found = np.empty((count, count))
    pieces = [
        slice(first, first + limits.COLUMNS_TOGETHER) for first in range(0, count, limits.COLUMNS_TOGETHER)
    ]

    def product(pair: tuple[slice, slice]) -> None:
        one, other = pair
        found[one, other] = columns[:, one].T @ columns[:, other]
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
