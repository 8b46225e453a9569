"""Shapes that made no rule of the search: patterns of gains, and descriptions drawn from the grammar."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from walop_jax.diagnosis.design import Measured
from walop_jax.likelihood.flux import project_flux

DRAWN, SUMS = 14, 7  # single descriptions, and sums of two


def new_shapes(
    measured: Measured, said: Mapping[str, np.ndarray], seed: int
) -> Iterator[tuple[str, tuple[str, ...], np.ndarray]]:
    """Name, the descriptions that it is (none: nothing can say it), and change of the data rows."""
    e, points = measured.likelihood.calset.exposures, measured.likelihood.calset.points
    rng = np.random.default_rng([seed, 77])
    x, y, camera = points.x / 0.3, points.y / 0.3, np.eye(measured.cameras)
    r, angle = np.hypot(x, y), np.deg2rad(np.where(e.clp_in, e.clp_angle, 0.0))
    through, one = e.clp_in.astype(float), np.ones(len(e))
    bumps = [
        a * np.exp(-((x - u) ** 2 + (y - v) ** 2) / 0.08)
        for a, u, v in zip(rng.standard_normal(9), *rng.uniform(-1, 1, (2, 9)), strict=True)
    ]
    walk = np.cumsum(rng.standard_normal(len(e)))
    patterns = {
        "checkerboard": (np.sign(np.sin(4 * x + 0.3) * np.sin(4 * y - 0.2)), one, 0),
        "stripes across the field": (np.sin(9 * x + 4 * y), one, 1),
        "ring off the centre": (np.exp(-((np.hypot(x - 0.4, y + 0.3) - 0.5) ** 2) / 0.02), one, 3),
        "bumps of a flat field": (np.sum(bumps, axis=0), one, 2),
        "one quadrant with the polariser": ((x > 0) * (y > 0), through, 0),
        "edge of the field by eight times the angle": (r**4, through * np.cos(8 * angle), 1),
        "gain that walks": (np.ones_like(x), walk - walk.mean(), 2),
        "gradient that alternates": (x, through * (-1.0) ** np.arange(len(e)), 3),
        "bad third of a detector": (np.abs(y - 0.5) < 0.2, np.where(e.kind == "standard", 0.0, 1.0), 1),
        "late settling": (r**2, through * np.exp(-np.arange(len(e)) / 2.0), 0),
    }
    counts = measured.flux[..., None] * measured.model
    for name, (field, course, k) in patterns.items():
        gain = np.asarray(field, float)[:, None, None] * course[None, :, None] * camera[k]
        projected = project_flux(gain * counts, measured.model, measured.known, measured.shared)
        yield name, (), -projected[measured.used].reshape(-1)
    length = {text: float(np.linalg.norm(column)) for text, column in said.items()}
    texts = [text for text in sorted(said) if length[text] > 0.0]
    for number in range(DRAWN + SUMS):
        some = rng.choice(texts, 1 if number < DRAWN else 2, replace=False).tolist()
        column = np.sum([rng.choice([-1.0, 1.0]) * said[text] / length[text] for text in some], axis=0)
        yield " + ".join(some), tuple(some), column
