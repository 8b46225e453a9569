"""The 27 non-linear sets of the NIST Statistical Reference Datasets, with their certified values (public domain).

Files as they were published (itl.nist.gov/div898/strd/nls/nls_main.shtml); derivatives by complex steps, exact to the
last digits.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

FOLDER = Path(__file__).resolve().parent / "nist"
Model = Callable[[np.ndarray, np.ndarray], np.ndarray]
exp, pi = np.exp, np.pi


def _gauss(b, x):
    return b[0] * exp(-b[1] * x) + sum(b[k] * exp(-(((x - b[k + 1]) / b[k + 2]) ** 2)) for k in (2, 5))


def _lanczos(b, x):
    return sum(b[k] * exp(-b[k + 1] * x) for k in (0, 2, 4))


def _enso(b, x):
    year = b[0] + b[1] * np.cos(2 * pi * x / 12) + b[2] * np.sin(2 * pi * x / 12)
    return year + sum(
        b[k + 1] * np.cos(2 * pi * x / b[k]) + b[k + 2] * np.sin(2 * pi * x / b[k]) for k in (3, 6)
    )


def _chwirut(b, x):
    return exp(-b[0] * x) / (b[1] + b[2] * x)


def _cubic(b, x):
    return (b[0] + b[1] * x + b[2] * x**2 + b[3] * x**3) / (1 + b[4] * x + b[5] * x**2 + b[6] * x**3)


MODELS: dict[str, Model] = {
    "Bennett5": lambda b, x: b[0] * (b[1] + x) ** (-1 / b[2]),
    "BoxBOD": lambda b, x: b[0] * (1 - exp(-b[1] * x)),
    "Chwirut1": _chwirut,
    "Chwirut2": _chwirut,
    "DanWood": lambda b, x: b[0] * x ** b[1],
    "ENSO": _enso,
    "Eckerle4": lambda b, x: b[0] / b[1] * exp(-0.5 * ((x - b[2]) / b[1]) ** 2),
    "Gauss1": _gauss,
    "Gauss2": _gauss,
    "Gauss3": _gauss,
    "Hahn1": _cubic,
    "Kirby2": lambda b, x: (b[0] + b[1] * x + b[2] * x**2) / (1 + b[3] * x + b[4] * x**2),
    "Lanczos1": _lanczos,
    "Lanczos2": _lanczos,
    "Lanczos3": _lanczos,
    "MGH09": lambda b, x: b[0] * (x**2 + x * b[1]) / (x**2 + x * b[2] + b[3]),
    "MGH10": lambda b, x: b[0] * exp(b[1] / (x + b[2])),
    "MGH17": lambda b, x: b[0] + b[1] * exp(-x * b[3]) + b[2] * exp(-x * b[4]),
    "Misra1a": lambda b, x: b[0] * (1 - exp(-b[1] * x)),
    "Misra1b": lambda b, x: b[0] * (1 - (1 + b[1] * x / 2) ** (-2.0)),
    "Misra1c": lambda b, x: b[0] * (1 - (1 + 2 * b[1] * x) ** (-0.5)),
    "Misra1d": lambda b, x: b[0] * b[1] * x / (1 + b[1] * x),
    "Nelson": lambda b, x: b[0] - b[1] * x[0] * exp(-b[2] * x[1]),
    "Rat42": lambda b, x: b[0] / (1 + exp(b[1] - b[2] * x)),
    "Rat43": lambda b, x: b[0] / (1 + exp(b[1] - b[2] * x)) ** (1 / b[3]),
    "Roszman1": lambda b, x: b[0] - b[1] * x - np.arctan(b[2] / (x - b[3])) / pi,
    "Thurber": _cubic,
}


@dataclasses.dataclass(frozen=True)
class Certified:
    """A set: data, two starts, certified parameters, standard errors and residual sum of squares."""

    name: str
    x: np.ndarray
    y: np.ndarray
    starts: tuple[np.ndarray, np.ndarray]
    parameters: np.ndarray
    errors: np.ndarray
    squares: float

    @classmethod
    def read(cls, name: str) -> Certified:
        """The set of a name."""
        text = (FOLDER / f"{name}.dat").read_text()
        rows = re.findall(r"^\s+b\d+\s*=\s*(\S+)\s+(\S+)\s+(\S+)\s+(\S+)\s*$", text, re.MULTILINE)
        first, second, parameters, errors = np.array(rows, float).T
        squares = re.search(r"Residual Sum of Squares:\s+(\S+)", text)
        assert squares is not None
        lines = text.split("\n")[60:]
        y, *x = np.array([line.split() for line in lines if line.strip()], float).T
        y = np.log(y) if name == "Nelson" else y
        x = np.array(x) if len(x) > 1 else x[0]
        return cls(name, x, y, (first, second), parameters, errors, float(squares[1]))

    def residuals(self, b: np.ndarray) -> np.ndarray:
        """Model less data."""
        with np.errstate(all="ignore"):
            return MODELS[self.name](b, self.x) - self.y

    def jacobian(self, b: np.ndarray) -> np.ndarray:
        """Derivatives of the residuals, by steps of 10⁻²⁰⁰ along the imaginary axis."""
        step = 1e-200
        with np.errstate(all="ignore"):
            columns = [MODELS[self.name](b + 1j * step * unit, self.x).imag / step for unit in np.eye(len(b))]
        return np.stack(columns, axis=1)
