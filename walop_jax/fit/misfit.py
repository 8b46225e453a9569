"""Disagreement of model and data: χ² per intensity by camera, exposure kind, filter and wavelength, and its
equivalent in the elements of the instrument matrix.

A residual of the light through the polariser is, at each field point and setting, expanded as
Δq_m = Δm21 + Δm22 q + Δm23 u (and Δu_m likewise) by least squares over the polariser angles; the rms over the
field is in the unit of the matrix, so it can be compared with the 0.1 % goal.
"""  # fmt: skip

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from walop_jax.data.kinds import CALIBRATION_PLATE, POLARISER
from walop_jax.data.records import Position
from walop_jax.fit.outliers import BEYOND, outlying
from walop_jax.fit.refit import FitResult
from walop_jax.io.errors import PathLike
from walop_jax.likelihood.layout import thinned
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.conventions import matrix_elements

MOST_REASONS = 3  # that are printed
MISFIT_POINTS = 65536
"""Field points whose residuals are grouped to describe a misfit: their cube then takes 50 MB at 25 exposures."""


@dataclasses.dataclass(frozen=True)
class Misfit:
    """Mean squared normalised residual per intensity in each group, and rms disagreement of matrix elements.

    With the flux eliminated, noise alone gives 1 − 1/K per intensity of K cameras (1 where the flux is known).
    `positions` are the angles of the moving elements by the prefix of their columns; `outliers` is the fraction of
    (exposure, point) pairs that lie off by themselves (`outliers.outlying`).
    """

    camera: Mapping[str, float]
    kind: Mapping[str, float]
    filter: Mapping[str, float]
    positions: Mapping[str, Mapping[str, float]]
    matrix_element: Mapping[str, float]
    worst_exposure: tuple[int, float]
    worst_point: tuple[int, float, float, float]
    outliers: float = 0.0

    def document(self) -> dict[str, object]:
        """The entry of `summary.json` (docs: files)."""
        entries = dataclasses.asdict(self)
        elements = entries.pop("positions")
        plate = elements.pop(CALIBRATION_PLATE)
        return entries | {"calibration_plate": plate, "elements": elements, "sentences": self.sentences()}

    def reasons(self, warnings: Sequence[str], folder: PathLike | None) -> tuple[str, ...]:
        """The first reasons against a fit, its `warnings` before all, and the command that shows all of them."""
        reasons = tuple(dict.fromkeys((*warnings, *self.sentences())))
        omitted = len(reasons) - MOST_REASONS
        more = f"{omitted} more, with the misfit by camera and exposure: walop-jax report {folder}"
        return (*reasons[:MOST_REASONS], more)

    def sentences(self) -> tuple[str, ...]:
        """The disagreement in words, the largest of each kind first."""

        def ranked(groups: Mapping[str, float]) -> str:
            order = sorted(groups.items(), key=lambda item: -item[1])
            return ", ".join(f"{name} {value:.3g}" for name, value in order)

        point, x, y, value = self.worst_point
        groups = {"kind": self.kind, "filter": self.filter}
        for prefix, angles in self.positions.items():
            if set(angles) != {"out"}:
                groups["calibration plate" if prefix == CALIBRATION_PLATE else f"angle of {prefix}"] = angles
        elements = {name: 100 * value for name, value in self.matrix_element.items()}
        share = f"{100 * self.outliers:.2g} % of the rows lie more than {BEYOND:g} standard errors off"
        return (
            f"mean squared residual by camera: {ranked(self.camera)}",
            "; ".join(f"by {name}: {ranked(values)}" for name, values in groups.items()),
            f"disagreement in the matrix, rms over field: {ranked(elements)} (%)",
            f"worst exposure {self.worst_exposure[0]} ({self.worst_exposure[1]:.3g}), "
            f"worst point {point} at ({x:+.3f}, {y:+.3f}) deg ({value:.3g})",
            *([share] if self.outliers > 0.0 else []),
        )


def describe(result: FitResult) -> Misfit:
    """Group the residuals of a fit; of a very large set those of `MISFIT_POINTS` points, the worst among them."""
    return misfit_at(result.likelihood, result.values)


def misfit_at(likelihood: Likelihood, values: Float[np.ndarray, " n"]) -> Misfit:
    """The groups of `describe` at any full vector of parameter values (n)."""
    if likelihood.layout.points > MISFIT_POINTS:
        likelihood = Likelihood.of(thinned(likelihood.calset, MISFIT_POINTS), likelihood.model)
    e, used, k = likelihood.calset.exposures, likelihood.used, likelihood.cameras
    names = likelihood.model.template.cameras.names
    _, residual = likelihood.residuals(values)
    square = residual**2
    per_exposure, rows = square.sum(axis=(0, 2)), used.sum(axis=0)

    def grouped(labels: np.ndarray) -> dict[str, float]:
        return {
            str(label): float(per_exposure[labels == label].sum() / max(k * rows[labels == label].sum(), 1))
            for label in np.unique(labels)
        }

    def angles(at: Position) -> dict[str, float]:
        labels = [f"{a:g} deg" if i else "out" for i, a in zip(at.inside, np.round(at.angle, 3), strict=True)]
        return grouped(np.array(labels))

    per_point = square.sum(axis=(1, 2)) / np.maximum(k * used.sum(axis=1), 1)
    worst = int(per_point.argmax())
    points = likelihood.calset.points
    x, y, value = (float(values[worst]) for values in (points.x, points.y, per_point))
    exposure = per_exposure / np.maximum(k * rows, 1)
    return Misfit(
        camera=dict(zip(names, (square.sum(axis=(0, 1)) / used.sum()).tolist(), strict=True)),
        kind=grouped(e.kind),
        filter=grouped(e.filter),
        positions={prefix: angles(at) for prefix, at in e.positions.items() if prefix != POLARISER},
        matrix_element=_matrix_elements(likelihood, residual),
        worst_exposure=(int(e.exposure[exposure.argmax()]), float(exposure.max())),
        worst_point=(int(points.point[worst]), x, y, value),
        outliers=float(outlying(likelihood, residual).sum() / max(used.sum(), 1)),
    )


def _matrix_elements(likelihood: Likelihood, residual: Float[np.ndarray, "p e k"]) -> dict[str, float]:
    e, used = likelihood.calset.exposures, likelihood.used
    weight, counts = likelihood.points.gathered("weight"), likelihood.points.gathered("counts")
    delta = residual / np.where(weight > 0, weight, np.inf)  # electrons, data − model
    pairs = likelihood.model.template.cameras.pairs
    elements = matrix_elements(len(pairs))
    squares: dict[str, list[float]] = {name: [] for name in elements}
    plate = e.position(CALIBRATION_PLATE)
    states = zip(e.filter, plate.inside, plate.angle, strict=True)
    setting = np.array([f"{f}/{a if i else 'out'}" for f, i, a in states])
    for label in np.unique(setting[e.clp_in]):
        use = np.flatnonzero(e.clp_in & (setting == label) & used.any(axis=0))
        if len(use) < 3:
            continue
        angle = 2.0 * np.deg2rad(e.clp_angle[use])
        design = np.column_stack([np.ones(len(use)), np.cos(angle), np.sin(angle)])
        # Over a full turn of angles the sum of a pair averages to the unpolarised sum of the definition of m.
        for n, (first, second) in enumerate(pairs):
            names = elements[3 * n : 3 * n + 3]
            total = counts[:, use, first] + counts[:, use, second]
            ok = used[:, use].all(axis=1) & (total > 0).all(axis=1)
            if not ok.any():
                continue
            difference = delta[ok][:, use, first] - delta[ok][:, use, second]
            difference = difference / total[ok].mean(axis=1, keepdims=True)
            coefficients, *_ = np.linalg.lstsq(design, difference.T, rcond=None)
            for name, row in zip(names, coefficients, strict=True):
                squares[name].extend((row**2).tolist())
    return {name: float(np.sqrt(np.mean(v))) if v else float("nan") for name, v in squares.items()}
