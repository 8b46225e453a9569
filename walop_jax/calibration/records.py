"""What a calibration product is, free of FITS: parameters, covariance, maps, verdict and origin."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Iterable, Mapping

import numpy as np
from jaxtyping import Bool, Float, Shaped

from walop_jax.data.frames import Grid
from walop_jax.data.records import Exposures, FilterCurve, InputFile, Site, Sources

MATRIX_NAMES = ("M21", "M22", "M23", "M31", "M32", "M33")
RESIDUAL_NAMES = (*MATRIX_NAMES, "RATIO")
"""Quantities of a residual map: corrections of the matrix, and of the throughput of cameras N2, N3."""

SMALLEST_DETERMINANT = 0.1
"""|m22 m33 − m23 m32| below which a single exposure holds hardly any u."""

QUALITY_BITS = {
    1: "not converged",
    2: "ill-conditioned",
    4: "a parameter lies at the edge of its prior",
    8: "excess noise above 0.5 sigma",
    16: "zone of high cross-talk (a local inverse has a condition number above 10)",
    32: "extrapolated in the field",
    64: "extrapolated in wavelength or temperature",
    128: "a camera is missing",
    256: "saturated or non-linear data used",
    512: "unknown free-form term active",
    1024: "only a class of causes was named",
    2048: "validity forced",
    4096: "non-physical Mueller matrix within tolerance",
    8192: "the model does not explain the data",
    16384: "no Stokes parameters: too few cameras, too little light, or no u in the rows there are",
}
"""Bits of QUALITY (of a product) and FLAG (of a row or pixel)."""

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
    """The six elements of the instrument matrix over the field, for a look: order of `MATRIX_NAMES`.

    For the filter named, a flat photon spectrum and the calibration plate out.
    """

    grid: Grid
    filter: str
    values: Float[np.ndarray, "6 y x"]
    errors: Float[np.ndarray, "6 y x"]


@dataclasses.dataclass(frozen=True)
class ResidualMap:
    """What the smooth model leaves, in cells of the field: planes in the order of `RESIDUAL_NAMES`.

    To be added to the matrix (throughput of N2, N3: relative); NaN where a cell has too few data. `chi2` is that of the
    residuals before the correction, per degree of freedom. Through `filter` and with the calibration plate at
    `chwp_angle` (deg, NaN out).
    """

    grid: Grid
    filter: str
    chwp_angle: float
    values: Float[np.ndarray, "7 y x"]
    errors: Float[np.ndarray, "7 y x"]
    chi2: Float[np.ndarray, "y x"]

    def excess(self) -> dict[str, float]:
        """Rms over the field of every quantity beyond its standard errors; negative if below, as chance has it."""
        found = {}
        for name, value, error in zip(RESIDUAL_NAMES, self.values, self.errors, strict=True):
            known = np.isfinite(value)
            variance = float(np.mean(value[known] ** 2 - error[known] ** 2)) if known.any() else np.nan
            found[name] = float(np.sign(variance) * np.sqrt(abs(variance)))
        return found

    def significance(self) -> float:
        """How many standard deviations the scatter of all corrections lies above what their errors make it."""
        squares = (self.values / self.errors)[np.isfinite(self.values)] ** 2
        return float((squares.sum() - squares.size) / np.sqrt(2.0 * max(squares.size, 1)))


@dataclasses.dataclass(frozen=True)
class Verdict:
    """How far a product can be trusted; `quality` are bits of `QUALITY_BITS`.

    `noise_scale` multiplied the errors of the data in the fit (1: as given); `covariance_from` says what the
    covariance is of ("fit" or "posterior").
    """

    chi2: float
    dof: int
    n_data: int
    noise_scale: float
    converged: bool
    trusted: bool
    quality: int
    warnings: tuple[str, ...] = ()
    covariance_from: str = "fit"


@dataclasses.dataclass(frozen=True)
class CalibrationProduct:
    """Everything that `calibration.fits` holds, free of FITS.

    `field` is (smallest x, largest x, smallest y, largest y) of the field points that were used, in degrees;
    `model` are the lines of the model's TOML text; `versions` name the software; `date` is UTC, ISO 8601.
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

    def __post_init__(self) -> None:
        n = len(self.parameters)
        if self.covariance.shape != (n, n):
            raise ValueError(f"covariance has shape {self.covariance.shape}, there are {n} parameters")

    def content_hash(self) -> str:
        """SHA-256 of what the product says of the instrument: not of dates, paths and versions."""
        digest = hashlib.sha256()
        verdict = self.verdict
        # Twelve digits: a number in a FITS header may lose its last bit.
        numbers = (verdict.chi2, verdict.noise_scale, *self.field)
        texts = [
            *(self.instrument, *self.model, *verdict.warnings, verdict.covariance_from),
            *(str(value) for value in (verdict.dof, verdict.n_data, verdict.converged, verdict.trusted)),
            *(str(verdict.quality), *(f"{value:.11e}" for value in numbers)),
            *(entry.sha256 for entry in self.inputs),
        ]
        for text in texts:
            digest.update(text.encode() + b"\n")
        for values in self._arrays():
            if values.dtype.kind in "US":
                digest.update("\n".join(values.astype(str).ravel().tolist()).encode() + b"\n")
            else:
                digest.update(np.asarray(values, "<f8").tobytes())
        return digest.hexdigest()

    def _arrays(self) -> Iterable[np.ndarray]:
        for record in (self.parameters, self.sources):
            yield from (getattr(record, entry.name) for entry in dataclasses.fields(record))
        yield from (getattr(self.exposures, name) for name in ("exposure", "kind", "mjd", "filter"))
        yield from (self.covariance, self.maps.values, self.maps.errors)
        if self.residuals is not None:
            yield from (self.residuals.values, self.residuals.errors, self.residuals.chi2)
        for name, curve in self.filters.items():
            yield from (np.array([name]), curve.wavelength, curve.throughput)
