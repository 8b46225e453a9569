"""The exposures of a plan as a schedule of the survey (format v4: docs, files), with real standard stars."""

from __future__ import annotations

import dataclasses
import os
from typing import Any

import numpy as np

from walop_jax.data.header_words import Words, read_words
from walop_jax.data.records import Exposures
from walop_jax.data.schedule import schedule_of
from walop_jax.data.standards import LOWEST, UNPOLARISED, shipped_standards
from walop_jax.simulation.observing_plan import ObservingPlan
from walop_jax.sky.moon import altitude


def scheduled(
    planned: ObservingPlan, words: str | os.PathLike[str] | None, path: str | os.PathLike[str]
) -> tuple[dict[str, Any], list[str]]:
    """The schedule of a plan, and remarks; filters are numbered in their order unless the file `words` numbers them.

    `path` is where it goes.
    """
    rules = Words({}) if words is None else read_words(words)
    numbers = rules.filters or {name: k for k, name in enumerate(planned.filter_names, start=1)}
    exposures = planned.exposures()
    _, star = planned.layout()
    stars = star.max(axis=0)
    real, remarks = _real_standards(planned, exposures, stars)
    ra, dec = exposures.ra.copy(), exposures.dec.copy()
    for number, (_, *place) in real.items():
        ra[stars == number], dec[stars == number] = place
    exposures = dataclasses.replace(exposures, ra=ra, dec=dec)
    names = []
    for s, kind, *place in zip(stars, exposures.kind, exposures.ra, exposures.dec, strict=True):
        moon = f"Moon at {place[0]:.2f} {place[1]:+.2f}" if kind == "moon" else "calibration"
        names.append(real[s][0] if s in real else planned.star_names[s] if s >= 0 else moon)
    unpolarised = [name for number, (name, *_) in real.items() if number < planned.unpolarised]
    document, further = schedule_of(
        exposures, planned.site, numbers, facts=rules.schedule, names=names, unpolarised=unpolarised
    )
    remarks += further
    if not rules.filters:
        listed = ", ".join(f"{name} {number}" for name, number in numbers.items())
        remarks.append(f"{path}: filters are numbered in their order ({listed}); --words gives other numbers")
    return document, remarks


def _real_standards(
    planned: ObservingPlan, exposures: Exposures, star: Any
) -> tuple[dict[int, tuple[str, float, float]], list[str]]:
    """Name, RA and DEC (deg) of a standard of the package for each of a plan, the highest at its time; and remarks.

    Standards of a plan are stars of some place. Those for which none is up keep it.
    """
    table = shipped_standards()
    table = table[np.unique(table["SOURCE"], return_index=True)[1]]
    ra, dec = (np.asarray(table[name].to_value("deg"), float) for name in ("RA", "DEC"))
    zero, chosen, missing = np.asarray(table["P"]) < UNPOLARISED, dict[int, tuple[str, float, float]](), []
    for number in np.unique(star[star >= 0]).tolist():
        times = exposures.mjd[star == number]
        height = np.min([altitude(np.full(len(ra), mjd), ra, dec, planned.site) for mjd in times], axis=0)
        taken = [name in {name for name, *_ in chosen.values()} for name in table["NAME"]]
        height[taken | (zero != (number < planned.unpolarised))] = -90.0
        best = int(height.argmax())
        if number < planned.standards and height[best] >= LOWEST:
            chosen[number] = (str(table["NAME"][best]), float(ra[best]), float(dec[best]))
        else:
            missing.append(planned.star_names[number])
    of = [f"{planned.star_names[number]} is {name}" for number, (name, *_) in chosen.items()]
    remarks = [f"standards of the package that are up: {', '.join(of)}"] if of else []
    if missing:
        what = f"{', '.join(missing)}: no standard of the package that is up; RA and Dec are of no star"
        remarks.append(f"{what}: put yours in `objects`")
    return chosen, remarks
