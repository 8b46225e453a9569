"""A table of field points with their instrument matrix, which prints a few of them as elements with errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from astropy.table import Table

from walop_jax.io.text import per_cent, with_error, with_minus_sign


class MatrixTable(Table):
    """Field points with the instrument matrix; a few rows are printed as elements with their errors.

    `meanings` are the meanings of the bits of FLAG; `reading` writes a reading of a moving element, given by the prefix
    of its columns, with its unit.
    """

    FEW = 4
    meanings: Mapping[int, str] = {}
    reading: Callable[[str, float], str] = staticmethod(lambda prefix, reading: f"{reading:g}°")

    def __str__(self) -> str:
        complete = {"X", "Y"} <= set(self.colnames) and self._elements()
        if not complete or len(self) > self.FEW:
            return super().__str__()
        return "\n".join(map(self._block, range(len(self))))

    __repr__ = __str__

    def _elements(self) -> list[str]:
        return [name for name in self.colnames if f"{name}_ERR" in self.colnames and name.startswith("M")]

    def _block(self, row: int) -> str:
        def number(name: str) -> float:
            column: Any = self[name]
            has_unit = name in ("X", "Y") and column.unit is not None  # in a unit of the user's
            return float((column.quantity.to_value("deg") if has_unit else np.asarray(column))[row])

        x, y = (with_minus_sign(f"{number(name):+.3f}°") for name in ("X", "Y"))
        elements = ((name, number(name), number(f"{name}_ERR")) for name in self._elements())
        cells = [f"{name.lower()} {with_error(value, error)}" for name, value, error in elements]
        width = max(map(len, cells)) + 3
        # `matrix` itself writes both columns; those of a user's table may be texts, or masked.
        inside = [name[:-3] for name in self.colnames if name.endswith("_IN") and self[name][row] is np.True_]
        stand = "".join(
            f", {prefix} at {self.reading(prefix, number(f'{prefix}_ANGLE'))}" for prefix in inside
        )
        lines = [f"field point X {x}, Y {y}{stand}"]
        rows = (cells[k : k + 3] for k in range(0, len(cells), 3))
        lines += ["  " + "".join(f"{cell:<{width}}" for cell in row) for row in rows]
        if "P_ERR" in self.colnames:
            error_of_p, flag = f"{per_cent(number('P_ERR'))} %", int(number("FLAG"))
            lines.append(f"  error of p of a star with p ≤ 5 %, calibration alone: {error_of_p}; FLAG {flag}")
            lines += [f"  FLAG {bit}: {meaning}" for bit, meaning in self.meanings.items() if flag & bit]
        return "\n".join(line.rstrip() for line in lines)
