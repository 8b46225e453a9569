"""Is a calibration product fit for use? Checks that fail closed: one that does not hold makes the product invalid.

A product is read with its checksums, version and content hash before it comes here (`read_calibration`, without its
model); it remains to check whether it agrees with its own parameters, and whether that is physics.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from walop_jax.calibration.analysis_vectors import AnalysisVectors
from walop_jax.calibration.calibration import UNCHECKED, Calibration
from walop_jax.calibration.could_hide import could_hide, off_by, shown_by_the_sky_alone, unmeasured
from walop_jax.calibration.product import validity
from walop_jax.data.inspection import Finding, about_exposures, sees_the_sky
from walop_jax.data.records import Exposures
from walop_jax.data.settings import BUILTIN_FILTERS
from walop_jax.fit.verdict import Quality
from walop_jax.io.text import rounded
from walop_jax.model.effects import EffectKind
from walop_jax.model.effects.base import Context
from walop_jax.model.instrument import Instrument

MAP_TOLERANCE = 1e-7  # between maps in the file and maps of its parameters, on another machine
DARKEST = 1e-4  # of the response to unpolarised light: what "less than no light" may be
SINGULAR = 1e-12  # eigenvalue of a correlation that is 0 but for rounding
UNMEASURED = 5e-4
"""Error of q and u (median over the field) allowed to an error on which there are no data at all."""
_POINTS = 64
OF_THE_SKY = "observe an unpolarised and a polarised standard, or the moonlit sky"


class Check(NamedTuple):
    """One property of a product: whether it holds, and the evidence in words."""

    name: str
    passed: bool
    found: str


def certify(calibration: Calibration) -> list[Check]:
    """All checks of a calibration in a fixed order, up to a model that cannot be built here."""
    # The content of all other calibrations was checked when they were read.
    earlier = UNCHECKED in calibration.verdict.warnings
    checks = [Check("content", False, UNCHECKED)] if earlier else []
    checks += [
        *_verdict(calibration),
        _covariance(calibration),
        _validity(calibration),
        _parents(calibration),
    ]
    if calibration.unavailable is not None:
        return [*checks, Check("model", False, f"cannot be rebuilt: {calibration.unavailable}")]
    checks.append(Check("model", True, f"{len(calibration.model.names)} parameters rebuilt by name"))
    return [*checks, _maps(calibration), _physics(calibration), *_protection(calibration)]


def lacks(
    instrument: Instrument, catalogue: Iterable[EffectKind], context: Context, *taken: Exposures
) -> Iterator[Finding]:
    """What lists of exposures, taken or planned, lack together for a go, whatever they count.

    The faults that `inspect` would find, and the systematic errors that `check` would not call measured.
    """
    yield from (finding for finding in about_exposures(*taken) if finding.severity == "fault")
    if not sees_the_sky(*taken):
        ahead = shown_by_the_sky_alone(instrument, catalogue, context)
        unseen = {name: error for name, error in ahead.items() if error > UNMEASURED}
        if unseen:
            worst = off_by(max(unseen.values()), float("nan"))
            yield Finding("fault", f"{', '.join(unseen)} not measured, {worst} at the usual size", OF_THE_SKY)


def _verdict(calibration: Calibration) -> list[Check]:
    v, bits = calibration.verdict, calibration.verdict.quality
    unexplained, ill = bool(bits & Quality.UNEXPLAINED), bool(bits & Quality.ILL_CONDITIONED)
    reached = "the minimum was reached" if v.converged else "no"
    why = [doubt.sentence for doubt in v.doubts if doubt.blocking and doubt.sentence]
    evidence = (f"χ²/dof = {v.chi2 / max(v.dof, 1):.4g}", *(() if unexplained else why[:1]))
    return [
        Check("converged", v.converged and not bits & Quality.NOT_CONVERGED, reached),
        Check("explains the data", v.trusted and not unexplained, "; ".join(evidence)),
        Check("conditioned", not ill, "ill-conditioned" if ill else "yes"),
    ]


def _covariance(calibration: Calibration) -> Check:
    """Of the free parameters: those that are held, or tied to others, have no errors of their own."""
    free = [i for i, p in enumerate(calibration.parameters) if p.free and p.tie is None]
    c, sigma = calibration.covariance[np.ix_(free, free)], calibration.sigma[free]
    from_what = f"made from {calibration.verdict.errors_from}"
    if not np.all(sigma > 0):
        name = calibration.names[free[int(np.argmin(sigma))]]
        return Check("covariance", False, f"the error of the free parameter {name} is 0; {from_what}")
    correlation = c / np.outer(sigma, sigma)
    lowest = float(np.linalg.eigvalsh(0.5 * (correlation + correlation.T)).min(initial=1.0))
    lopsided = float(np.abs(correlation - correlation.T).max(initial=0.0))
    good = lowest > SINGULAR and lopsided < 1e-10
    shown = rounded(lowest if abs(lowest) > SINGULAR else 0.0, ".2g")
    what = f"smallest eigenvalue of the correlation of {len(free)} free parameters {shown}"
    return Check("covariance", good, f"{what}{' (singular)' if lowest <= SINGULAR else ''}; {from_what}")


def _validity(calibration: Calibration) -> Check:
    span = validity(calibration)
    unknown = [
        name for name in span.filters if name not in calibration.filters and name not in BUILTIN_FILTERS
    ]
    good = bool(np.isfinite(span.mjd[0])) and not unknown
    text = f"MJD {span.mjd[0]:.2f} to {span.mjd[1]:.2f}, {', '.join(span.filters)}"
    if np.isfinite(span.temperature[0]):
        text += f", {span.temperature[0]:.1f} to {span.temperature[1]:.1f} Celsius"
    return Check("validity", good, text + (f"; no curve of {', '.join(unknown)}" if unknown else ""))


def _parents(calibration: Calibration) -> Check:
    bad = [entry for entry in calibration.inputs if not re.fullmatch(r"[0-9a-f]{64}", entry.sha256)]
    good = bool(calibration.inputs) and not bad
    text = f"{len(calibration.inputs)} calibration set(s), hashes recorded" if good else "not known"
    return Check("parents", good, text)


def _maps(calibration: Calibration) -> Check:
    again = calibration.new_maps(calibration.maps.values.shape[1])
    if again.grid != calibration.maps.grid or again.positions != calibration.maps.positions:
        return Check("maps", False, "are not of the grid and setting that this program makes")
    off = float(np.abs(again.values - calibration.maps.values).max())
    # Some elements have no error.
    errors = np.allclose(again.errors, calibration.maps.errors, rtol=1e-4, atol=1e-15)
    text = f"differ from those of the parameters by {rounded(off, '.2g')}"
    return Check("maps", off < MAP_TOLERANCE and errors, text)


def _physics(calibration: Calibration) -> Check:
    """In no arm does a camera see less than no light, whatever the polarisation: a₀ ≥ √(a₁² + a₂²)."""
    limit = min(calibration.model.template.field_limit, float(np.abs(calibration.field).max()))
    x, y = np.random.default_rng(0).uniform(-limit, limit, (2, _POINTS))
    setting = calibration.usual_settings(filter_name=str(np.unique(calibration.exposures.filter)[0]))
    analysis = AnalysisVectors(calibration)
    vectors = analysis.exact(setting, x, y)[:, 0]
    least = np.min(1.0 - np.hypot(vectors[..., 1], vectors[..., 2]) / vectors[..., 0], axis=0)
    cameras = analysis.instrument.cameras
    arms = (("/".join(cameras.names[k] for k in arm), least[list(arm)].min()) for arm in cameras.arms)
    transmissions = ", ".join(f"{names} {rounded(value, '.2g')}" for names, value in arms)
    good = bool(np.all(vectors[..., 0] > 0)) and bool(np.all(least > -DARKEST))
    what = "least transmission for any polarisation, over that of unpolarised light"
    return Check("physics", good, f"{what}: {transmissions}")


def _protection(calibration: Calibration) -> Iterator[Check]:
    """Checks of the systematic errors that could hide, at the limits of the data; unmeasured ones fail beyond
    `UNMEASURED`.
    """
    if calibration.hidden is None:
        yield Check("protection", True, "undetectable errors were not computed")
        return
    undetected = could_hide(calibration)
    stated = "no single undetected error would move q and u by more than their errors"
    if undetected:
        stated = f"{off_by(*undetected[0].error)} from {undetected[0].in_words}"
    yield Check("protection", True, stated)
    unseen = unmeasured(undetected).items()
    measured = not any(each.error[0] > UNMEASURED for _, each in unseen)
    text = "; ".join(f"not {name}: {off_by(*each.error)} at the usual size" for name, each in unseen)
    text = text or "; ".join(f"not {name}" for name in calibration.hidden.not_measured())
    yield Check("measured", measured, text or "all that acts on starlight")
