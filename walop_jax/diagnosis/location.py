"""Where a disagreement sits, in words: camera, field, harmonic of the polariser angle, filter, kind of exposure."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from walop_jax.diagnosis.design import Design
from walop_jax.model import legendre

HARMONICS = (0, 1, 2, 3, 4)
FIELD_WORDS = ("uniform", "gradient", "quadratic", "cubic", "fourth order")
SHARE = 0.2  # a group is mentioned when it carries this share of the largest


def _shares(groups: dict[str, float]) -> dict[str, float]:
    total = sum(groups.values()) or 1.0
    return {name: round(value / total, 3) for name, value in sorted(groups.items(), key=lambda g: -g[1])}


def _named(groups: dict[str, float]) -> str:
    shares = _shares(groups)
    top = max(shares.values(), default=0.0)
    return ", ".join(f"{name} {100 * share:.0f}%" for name, share in shares.items() if share >= SHARE * top)


def _harmonics(
    design: Design, pattern: Float[np.ndarray, "p e k"]
) -> tuple[dict[str, float], Float[np.ndarray, " p"]]:
    """Power of each harmonic of the polariser angle, and the field map of the strongest one."""
    e = design.fit.calset.exposures
    use = np.flatnonzero(e.clp_in & design.measured.used.any(axis=0))
    if len(use) < 3:
        return {}, pattern.sum(axis=(1, 2))
    angle = np.deg2rad(e.clp_angle[use])
    power: dict[str, float] = {}
    best, field = -1.0, pattern[:, use].sum(axis=(1, 2))
    for harmonic in HARMONICS:
        waves = (
            [np.ones_like(angle)] if harmonic == 0 else [np.cos(harmonic * angle), np.sin(harmonic * angle)]
        )
        lengths = [float(np.linalg.norm(wave)) or 1.0 for wave in waves]
        amplitudes = [
            np.einsum("pek,e->pk", pattern[:, use], wave / length)
            for wave, length in zip(waves, lengths, strict=True)
        ]
        square = float(sum((a**2).sum() for a in amplitudes))
        power[f"{harmonic}θ"] = square
        if square > best:
            strongest = max(amplitudes, key=lambda a: float((a**2).sum()))
            best, field = square, strongest[:, int((strongest**2).sum(axis=0).argmax())]
    return power, field


def _field_words(design: Design, field: Float[np.ndarray, " p"]) -> str:
    points = design.fit.calset.points
    basis = legendre.basis(points.x, points.y, 4)
    degree = np.array([i + j for i, j in legendre.terms(4)])
    if len(field) <= len(degree):
        return "too few points to tell"
    total = float(field @ field) or 1.0
    explained, words = 0.0, {}
    for d in range(5):
        columns = basis[:, degree <= d]
        fitted = columns @ np.linalg.lstsq(columns, field, rcond=None)[0]
        share = float(fitted @ fitted) / total
        words[FIELD_WORDS[d]] = max(share - explained, 0.0)
        explained = max(share, explained)
    words["fine structure"] = max(1.0 - explained, 0.0)
    return _named(words)


def describe(design: Design, rows: Float[np.ndarray, " _"]) -> dict[str, Any]:
    """Where a change of the residuals (data rows of `design`) sits, as `where` of diagnosis.json (docs: files)."""
    cube = design.cube(rows)
    square = cube**2
    e, names = design.fit.calset.exposures, design.fit.model.template.cameras.names
    by_exposure = square.sum(axis=(0, 2))

    def grouped(labels: np.ndarray) -> dict[str, float]:
        return {str(label): float(by_exposure[labels == label].sum()) for label in np.unique(labels)}

    harmonics, field = _harmonics(design, cube)
    hours = (e.mjd - e.mjd.min()) * 24.0
    order = np.argsort(hours)
    rms = np.sqrt(by_exposure / np.maximum(len(names) * design.measured.used.sum(axis=0), 1))
    trend = float(np.corrcoef(np.arange(len(e)), rms[order])[0, 1]) if len(e) > 2 and rms.std() > 0 else 0.0
    return {
        "camera": _named(dict(zip(names, square.sum(axis=(0, 1)).tolist(), strict=True))),
        "field": _field_words(design, field),
        "clp_harmonic": _named(harmonics) if harmonics else "no polariser exposures",
        "wavelength": _named(grouped(e.filter)),
        "kind": _named(grouped(e.kind)),
        "time": "grows with time" if trend > 0.7 else "shrinks with time" if trend < -0.7 else "no trend",
    }
