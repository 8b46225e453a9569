"""What a calibration product is, free of FITS: parameters, covariance, maps, verdict and origin."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Iterable, Mapping

import numpy as np
from jaxtyping import Bool, Float, Shaped

from walop_jax.data.frames import Grid
from walop_jax.data.records import Exposures, FilterCurve, InputFile, Site, Sources
from walop_jax.fit.verdict import Hidden, Verdict
from walop_jax.likelihood.expansion import STATED

SMALLEST_DETERMINANT = 0.1
"""|m22 m33 − m23 m32| below which a single exposure holds hardly any u."""


def matrix_names(arms: int) -> tuple[str, ...]:
    """Names of the matrix elements of an instrument, three for each arm: M21, M22, M23, M31, … (two arms: to M33)."""
    return tuple(f"M{arm + 2}{column}" for arm in range(arms) for column in (1, 2, 3))


def residual_names(arms: int) -> tuple[str, ...]:
    """Quantities of a residual map: the matrix elements, and the throughput of each arm beside the first.

    The latter are RATIO for two arms (cameras N2, N3 of WALOP), RATIO2, RATIO3, … for more.
    """
    ratios = ("RATIO",) if arms == 2 else tuple(f"RATIO{arm}" for arm in range(2, arms + 1))
    return (*matrix_names(arms), *ratios)


_SPELT = {
    "χ²": "chi2", "²": "^2", "⁻": "^-", "×": "x", "·": "*", "°": " deg", "±": "+-", "−": "-", "–": "-",
    "—": "-", "…": "...", "µ": "u", "σ": "sigma", "δ": "delta", "η": "eta", "κ": "kappa", "λ": "lambda",
    "φ": "phi", "ε": "epsilon", "θ": "theta", "α": "alpha", "γ": "gamma", "π": "pi", "Δ": "Delta",
    "√": "sqrt", "½": "1/2", "′": "'", "→": "->", "≥": ">=", "≤": "<=",
}  # fmt: skip


def in_ascii(text: str) -> str:
    """The text on one line in ASCII: signs spelt out where that is usual, escaped (\\u00e9) otherwise."""
    for sign, word in _SPELT.items():
        text = text.replace(sign, word)
    return " ".join(text.encode("ascii", "backslashreplace").decode("ascii").split())


@dataclasses.dataclass(frozen=True)
class ParameterTable:
    """All parameters of the fit: names, values, standard errors, units, priors (NaN: none), free or not."""

    name: Shaped[np.ndarray, " n"]
    value: Float[np.ndarray, " n"]
    sigma: Float[np.ndarray, " n"]
    unit: Shaped[np.ndarray, " n"]
    prior_mean: Float[np.ndarray, " n"]
    prior_width: Float[np.ndarray, " n"]
    free: Bool[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.name)


@dataclasses.dataclass(frozen=True)
class MatrixMaps:
    """The elements of the instrument matrix over the field, for a look: order of `matrix_names`, three per arm.

    For the filter named, a flat photon spectrum, the calibration plate out, and the further moving elements at
    `positions` (deg by column prefix; those not there are out). Raises ValueError for another number of planes.
    """

    grid: Grid
    filter: str
    values: Float[np.ndarray, "m y x"]
    errors: Float[np.ndarray, "m y x"]
    positions: Mapping[str, float] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        if len(self.values) % 3 or not len(self.values):
            raise ValueError(f"{len(self.values)} maps of a matrix that has three elements for each arm")

    @property
    def arms(self) -> int:
        """Number of arms."""
        return len(self.values) // 3

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the elements."""
        return matrix_names(self.arms)


@dataclasses.dataclass(frozen=True)
class ResidualMap:
    """What the smooth model leaves, in cells of the field: planes in the order of `residual_names`.

    To be added to the matrix (throughput of an arm: relative); NaN where a cell has too few data. `chi2` is that of the
    residuals before the correction, per degree of freedom. Through `filter`, with the calibration plate at
    `chwp_angle` (deg, NaN out) and the further moving elements at `positions` (deg by column prefix; those not there
    are out). Raises ValueError for another number of planes.
    """

    grid: Grid
    filter: str
    chwp_angle: float
    values: Float[np.ndarray, "m y x"]
    errors: Float[np.ndarray, "m y x"]
    chi2: Float[np.ndarray, "y x"]
    positions: Mapping[str, float] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        if len(self.values) % 4 != 3:
            raise ValueError(
                f"{len(self.values)} planes, for A arms there are 3 A elements and A − 1 throughputs"
            )

    @property
    def arms(self) -> int:
        """Number of arms."""
        return (len(self.values) + 1) // 4

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the quantities."""
        return residual_names(self.arms)

    def excess(self) -> dict[str, float]:
        """Rms over the field of every quantity beyond its standard errors; negative if below, as chance has it."""
        found = {}
        for name, value, error in zip(self.names, self.values, self.errors, strict=True):
            known = np.isfinite(value)
            variance = float(np.mean(value[known] ** 2 - error[known] ** 2)) if known.any() else np.nan
            found[name] = float(np.sign(variance) * np.sqrt(abs(variance)))
        return found

    def significance(self) -> float:
        """How many standard deviations the scatter of all corrections lies above what their errors make it."""
        squares = (self.values / self.errors)[np.isfinite(self.values)] ** 2
        return float((squares.sum() - squares.size) / np.sqrt(2.0 * max(squares.size, 1)))


@dataclasses.dataclass(frozen=True)
class CalibrationProduct:
    """Everything that `calibration.fits` holds, free of FITS.

    `field` is (smallest x, largest x, smallest y, largest y) of the field points that were used, in degrees; `model`
    are the lines of the model's TOML text, `description` those of the instrument's description file where it does not
    come with the package; `hidden` are mistakes that would not have been found; `versions` name the software; `date` is
    UTC, ISO 8601.
    """

    instrument: str
    site: Site
    origin: str
    date: str
    verdict: Verdict
    parameters: ParameterTable
    covariance: Float[np.ndarray, "n n"]
    maps: MatrixMaps
    field: tuple[float, float, float, float]
    exposures: Exposures
    filters: Mapping[str, FilterCurve]
    sources: Sources
    model: tuple[str, ...]
    inputs: tuple[InputFile, ...] = ()
    versions: Mapping[str, str] = dataclasses.field(default_factory=dict)
    residuals: ResidualMap | None = None
    description: tuple[str, ...] = ()
    hidden: Hidden | None = None

    def __post_init__(self) -> None:
        n = len(self.parameters)
        if self.covariance.shape != (n, n):
            raise ValueError(f"covariance has shape {self.covariance.shape}, there are {n} parameters")
        if self.residuals is not None and self.residuals.arms != self.maps.arms:
            raise ValueError(f"a residual map of {self.residuals.arms} arms, the matrix has {self.maps.arms}")

    def content_hash(self, *, every_column: bool = True) -> str:
        """SHA-256 of what the product says of the instrument: not of dates, paths and versions.

        Nor of structure and hidden mistakes, which versions that do not know them leave aside (the checksums of the
        file hold them).

        Without `every_column` only those columns of the exposures that the hashes of first products covered.
        """
        digest = hashlib.sha256()
        verdict = self.verdict
        # Twelve digits: a number in a FITS header may lose its last bit.
        numbers = (verdict.chi2, verdict.noise_scale, *self.field)
        texts = [
            *(self.instrument, *self.model, *self.description, *verdict.warnings, verdict.covariance_from),
            *(str(value) for value in (verdict.dof, verdict.n_data, verdict.converged, verdict.trusted)),
            *(str(int(verdict.quality)), *(f"{value:.11e}" for value in numbers)),
            *(entry.sha256 for entry in self.inputs),
            *((verdict.errors_from,) if verdict.errors_from != STATED else ()),
            *_texts(self.maps.positions),
            *(_texts(self.residuals.positions) if self.residuals is not None else ()),
        ]
        for text in texts:
            digest.update(text.encode() + b"\n")
        for values in self._arrays(every_column):
            if values.dtype.kind in "US":
                digest.update("\n".join(values.astype(str).ravel().tolist()).encode() + b"\n")
            else:
                digest.update(np.asarray(values, "<f8").tobytes())
        return digest.hexdigest()

    def _arrays(self, every_column: bool) -> Iterable[np.ndarray]:
        for record in (self.parameters, self.sources):
            yield from (getattr(record, entry.name) for entry in dataclasses.fields(record))
        if every_column:
            for name, values in self.exposures.columns().items():
                yield from (np.array([name]), values)
        else:
            yield from (getattr(self.exposures, name) for name in ("exposure", "kind", "mjd", "filter"))
            for prefix, position in self.exposures.moving.items():
                yield from (np.array([prefix]), position.inside, position.angle)
        yield from (self.covariance, self.maps.values, self.maps.errors)
        if self.residuals is not None:
            yield from (self.residuals.values, self.residuals.errors, self.residuals.chi2)
        for name, curve in self.filters.items():
            yield from (np.array([name]), curve.wavelength, curve.throughput)


def _texts(positions: Mapping[str, float]) -> Iterable[str]:
    return (f"{prefix} {angle:.11e}" for prefix, angle in positions.items())
