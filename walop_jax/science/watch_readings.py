"""Changes that stars can show: cameras, arms, gradients over the field, numbers of the optics.

A reading is a sum of columns of the counts; a gradient has a second one, and any direction φ in the field:

    c = cos φ · x c_k + sin φ · y c_k

φ is that in which z² is largest, which is then χ² of two numbers. It counts as `DIRECTIONS` questions. Arms are asked
as a whole because what lies ahead of an analyser dims both of its beams.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from walop_jax.calibration.analysis_vectors import AnalysisVectors
from walop_jax.science.instrument_changes import FARTHEST, PossibleChange, profile
from walop_jax.science.star_residuals import ROUNDING, StarResiduals

DIRECTIONS = 8
"""u √(π/2), by which χ² of two exceeds u² more often than one number does, at the highest alarm, u = 6.4."""
Sum = dict[int, float]


class Reading(NamedTuple):
    """A possible change: a sum of `Readings.columns` (`across`: along Y, of a gradient), `widest` at most."""

    kind: str
    name: str
    unit: str
    along: Sum
    across: Sum | None = None
    widest: float = np.inf


class Answers(NamedTuple):
    """Of every history and reading, each alone: size, standard error (inf: not seen), and direction of a gradient."""

    size: Float[np.ndarray, "h c"]
    error: Float[np.ndarray, "h c"]
    angle: Float[np.ndarray, "h c"]


class Readings:
    """All that may have changed in the counts of some stars; positions grow to the `edge` of theirs (deg)."""

    def __init__(self, stars: StarResiduals, vectors: AnalysisVectors) -> None:
        cameras = vectors.instrument.cameras
        self.cameras = tuple(cameras.names)
        # Of the parameters those that make any difference to the light of stars.
        self.seen = np.flatnonzero(np.abs(stars.plain).max(axis=(0, 1)) > 0)
        self.edge = max(float(np.abs(np.concatenate([stars.x, stars.y])).max()), 1e-9)
        count = len(self.cameras)
        self.columns_count = 3 * count + len(self.seen)
        # The last arm is no other than all before it: the sum of all is flux.
        arms = [tuple(arm) for arm in cameras.arms if len(arm) > 1][: len(cameras.arms) - 1]
        units = [("gain", (k,)) for k in range(count)] + [("arm", arm) for arm in arms]
        named = [(kind, "+".join(self.cameras[k] for k in unit), unit) for kind, unit in units]
        self.of_cameras = [Reading(kind, name, "", dict.fromkeys(u, 1.0)) for kind, name, u in named]
        self.members = np.array([[r.along.get(k, 0.0) for r in self.of_cameras] for k in range(count)])
        gradients = []
        for reading in self.of_cameras:
            along, across = ({n * count + k: 1.0 for k in reading.along} for n in (1, 2))
            gradients.append(reading._replace(kind="gradient", along=along, across=across))
        optics = []
        for column, p in enumerate(self.seen.tolist(), start=3 * count):
            name, unit = vectors.named[p]
            parameter = vectors.calibration.model[name]
            width = parameter.width or parameter.loose or np.inf
            optics.append(Reading("optics", name, unit, {column: 1.0}, widest=FARTHEST * width))
        self.listed = [*self.of_cameras, *gradients, *optics]

    @property
    def asked(self) -> int:
        """Questions that all of them are."""
        return sum(1 if reading.across is None else DIRECTIONS for reading in self.listed)

    def columns(self, part: StarResiduals) -> Float[np.ndarray, "r k c"]:
        """Gains of the cameras, their growth along X and Y to 1 at the edge, numbers of the optics."""
        gains = part.model[..., None] * np.eye(len(self.cameras))
        x, y = (gains * (place / self.edge)[:, None, None] for place in (part.x, part.y))
        return np.concatenate([gains, x, y, part.plain[..., self.seen]], axis=-1)

    def signature(self, part: StarResiduals, change: PossibleChange) -> Float[np.ndarray, "r k"]:
        """The change of the counts over σ by a change of unit size, where it is largest in time."""
        if change.kind == "spot":
            cameras = np.array([name in change.members for name in self.cameras])
            return part.model * cameras * profile(part.x, part.y, change.place)[:, None]
        reading, weight = self._of(change), np.zeros(self.columns_count)
        angle = np.deg2rad(change.place[0]) if reading.across else 0.0
        for of, factor in ((reading.along, np.cos(angle)), (reading.across or {}, np.sin(angle))):
            for column, value in of.items():
                weight[column] += factor * value
        return self.columns(part) @ weight

    def possible(self, change: PossibleChange) -> bool:
        """True unless a number of the optics would have to change by more than it can."""
        return abs(change.size) <= (1.0 if change.kind == "spot" else self._of(change).widest)

    def _of(self, change: PossibleChange) -> Reading:
        thing = change.kind, change.name
        return next(reading for reading in self.listed if (reading.kind, reading.name) == thing)

    def answers(
        self,
        blocks: Float[np.ndarray, "g k g k"],
        slopes: Float[np.ndarray, "g k"],
        shapes: Float[np.ndarray, "g h"],
    ) -> Answers:
        """Every history (`shapes`) of every reading, each alone, from Q and g by group and column."""
        size = shapes.shape[1], len(self.listed)
        answers = Answers(np.zeros(size), np.full(size, np.inf), np.zeros(size))

        def information(one: Sum, across: Sum) -> Float[np.ndarray, " h"]:
            terms = [v * w * blocks[:, a, :, b] for a, v in one.items() for b, w in across.items()]
            return np.einsum("gh,gf,fh->h", shapes, np.sum(terms, axis=0), shapes, optimize=True)

        def slope(of: Sum) -> Float[np.ndarray, " h"]:
            return shapes.T @ np.sum([weight * slopes[:, a] for a, weight in of.items()], axis=0)

        trace = np.einsum("gkgk->k", blocks)
        for k, reading in enumerate(self.listed):
            info, pull = information(reading.along, reading.along), slope(reading.along)
            if reading.across is not None:
                across, mixed = (information(reading.across, of) for of in (reading.across, reading.along))
                turn = slope(reading.across)
                angle = np.arctan2(info * turn - mixed * pull, across * pull - mixed * turn)
                cosine, sine = np.cos(angle), np.sin(angle)
                info = cosine**2 * info + 2.0 * cosine * sine * mixed + sine**2 * across
                pull = cosine * pull + sine * turn
                answers.angle[:, k] = np.rad2deg(angle)
            # Beyond rounding: `scan` has zeros where stars see nothing of a column.
            informed = info > ROUNDING * sum(trace[a] for a in (*reading.along, *(reading.across or {})))
            answers.size[informed, k] = pull[informed] / info[informed]
            answers.error[informed, k] = info[informed] ** -0.5
        return answers
