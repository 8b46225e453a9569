"""Do residuals agree where no smooth pattern looks? One variance component for each way of grouping the data.

A gain of every field point, a response of every exposure, a light of its own in every night: numbers by the hundred,
each below its noise, alike only in size. Let r = P(A a + ε) with noise ε of unit variance and a of variance τ² in the
columns A of a grouping. Against τ = 0 the score test is

    T = |Aᵀr|² − c |r|²,   c = tr G / f,   G = AᵀPA,   f = tr P,

with mean 0, whatever the size of the noise, and, in units of its variance,

    κ₂ = 2 (tr G² − c tr G),   κ₃ = 8 (tr G³ − 3c tr G² + 2c² tr G),   τ² = T / (tr G² − c tr G);

its p is that of the shifted χ² with these moments. P = 1 − Σwwᵀ − QQᵀ couples places through the parameters alone, so
that with B = QᵀA and D what the fluxes leave of AᵀA, block by block,

    tr G = tr D − tr M,   tr G² = |D|² − 2 tr BDBᵀ + |M|²,   tr G³ = tr D³ − 3 tr BD²Bᵀ + 3 tr BDBᵀM − tr M³,  M = BBᵀ.

Groupings   the gain of each camera, and its response to q and u, at each field point (structure finer than any
            polynomial: flat fields, dust); its gain and gradients over the field in each exposure; its response to q
            and u in each state of the moving elements; its gain and gradients for each night and kind of exposure; its
            gain and response to q and u for each standard. A gain multiplies the counts of an exposure; a response
            adds light, as a change of an analysis vector does
Symbols     r whitened residuals; w expected counts / errors of what has a flux in common, of unit length; Q orthonormal
            basis of the derivatives with respect to the free parameters; τ a share of the counts
Sources     score test of a variance component: Rao 1948; Lin 1997, Biometrika 84, 309. Three moments: Imhof 1961,
            Biometrika 48, 419 (after Pearson 1959). Many questions: Šidák 1967
Limits      Which place is off is not reported, only how much places differ. The mean square of the noise is taken from
            the residuals themselves, so that structure in all of them counts a little less.

Is the noise of two exposures the same? The test for data that are there twice, whatever was done to them:

Equation    ρ = Σ r₁·r₂ / √(Σ r₁² Σ r₂²) over the field points that two exposures share, r the residuals of each.
            Independent noise gives Σ r₁·r₂ the variance Σ tr(P₁P₂), at most (K − f) for each point, P = 1 − ŵŵᵀ being
            the rest of the noise of K cameras when f fluxes have been fitted
Symbols     ŵ expected counts / errors, of unit length; p that of a normal deviate, for all pairs at once (Šidák)
Source      correlation of independent residuals: Fisher 1915, Biometrika 10, 507
Limits      Missing effects correlate as well, and are added to the noise: a pair is named only where ρ is more
            than its squared residuals let a common pattern make. Below ρ = 0.25 nothing is named. Parameters take a
            little of the noise of all exposures together, which makes ρ smaller. Exposures that share a flux are not
            looked at. Unlike `data.repeats`, which looks for counts that agree, it needs a fit, but not many exposures,
            and sees copies that were rescaled, interpolated or averaged.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import special

from walop_jax.diagnosis import thresholds
from walop_jax.diagnosis.design import GAIN, LIGHT, Design
from walop_jax.diagnosis.score import local_p
from walop_jax.fit.refit import FitResult
from walop_jax.fit.verdict import STATED, Structure
from walop_jax.io.text import some
from walop_jax.sky.nights import night_of

MOST_PLACES = 1000  # field points that are asked, spread over the set
WITH_STRUCTURE = "N_ERR with structure of field points"


class _Grouping(NamedTuple):
    """A way of grouping the data, and the quantities that may differ from place to place.

    `place` is the number of the place of every (point, exposure), −1 for none. There a camera has a gain for each of
    the `gains`, which multiplies its counts, and sees more light for each of the `responses`, in proportion to its mean
    counts: q and u as responses are changes of the analysis vector. `words` say what agrees; `structure` names the
    field of `Structure` that its size is, where a place is one field point.
    """

    name: str
    words: str
    place: Int[np.ndarray, "p e"]
    gains: Float[np.ndarray, "p e g"]
    responses: Float[np.ndarray, "p e j"]
    structure: str = ""


class VarianceComponent(NamedTuple):
    """Content of one grouping: T in standard deviations of noise, its p, and the size τ with its standard error."""

    grouping: _Grouping
    deviate: float
    p_value: float
    size: float
    error: float


def variance_components(design: Design, *, structure_alone: bool = False) -> list[VarianceComponent]:
    """Every grouping that the data have, asked by itself; those of single field points alone where that is said."""
    residual = design.projector(design.residual)
    square = float(residual @ residual)
    grouped = groupings(design) if square > 0 else ()
    grouped = (grouping for grouping in grouped if grouping.structure or not structure_alone)
    ready = (asked(design, grouping, residual[:, None]) for grouping in grouped)
    return [question.answered(pull[:, 0], square) for question, pull in filter(None, ready)]


def found_components(components: list[VarianceComponent]) -> list[VarianceComponent]:
    """Those that noise does not make, the clearest first, after one correction for all that were asked."""
    limit = local_p(thresholds.UNLIKELY, len(components))
    return sorted((c for c in components if c.p_value < limit), key=lambda c: c.p_value)


def in_words(components: list[VarianceComponent]) -> Iterator[str]:
    """One sentence on the result; a grouping that is asked as well often answers to the same structure."""
    if not components:
        return
    first = components[0]
    further = ", ".join(f"{c.grouping.name} {c.deviate:.2g} σ" for c in components[1 : 1 + thresholds.SHOWN])
    text = f"residuals {first.grouping.words}, {first.deviate:.2g} σ: structure of {first.size:.2g} that the model does"
    yield f"{text} not have" + (f" (also {further})" if further else "")


def structure_of(components: list[VarianceComponent]) -> Structure:
    """Differences between field points, of the components that were found."""

    def size(name: str) -> float:
        return float(np.sqrt(sum(c.size**2 for c in components if c.grouping.structure == name)))

    return Structure(size("gain"), size("response"))


def with_structure(
    result: FitResult, design: Design, components: list[VarianceComponent], points: int
) -> FitResult:
    """The fit with the effect of the structure of field points on its parameters in their covariance.

    With J = QR the parameters take up R⁻¹QᵀA of the amplitudes, so that τ² R⁻¹BBᵀR⁻ᵀ is added. `design` may be of a
    sample of the field points, of which the set has `points`: structure then counts by their share, as noise does.
    """
    rows, size = design.jacobian.shape
    added, places = np.zeros((size, size)), 1
    for component in components:
        blocks = _blocks(design, component.grouping, np.zeros((rows, 0)))
        if not component.grouping.structure or blocks is None:
            continue
        places, basis = len(blocks[0]), design.projector.basis
        response = design.projector.taken_up(blocks[1].reshape(-1, basis.shape[1]).T)
        added += component.size**2 * response @ response.T
    share = len(design.fit.calset.points) ** 2 / (places * points)
    select = result.model.selection()
    return dataclasses.replace(
        result,
        covariance=result.covariance + share * select @ added @ select.T,
        errors_from=result.errors_from if result.errors_from != STATED else WITH_STRUCTURE,
        verdict=None,
    )


def groupings(design: Design) -> Iterator[_Grouping]:
    """The groupings that the data have; of two that cut them alike, the first."""
    measured, calset = design.measured, design.fit.calset
    e, points, used = calset.exposures, calset.points, measured.used
    constant, nothing = np.ones((*used.shape, 1)), np.zeros((*used.shape, 0))
    stokes = measured.likelihood.stokes(measured.values)[..., 1:3]
    reach = max(float(np.hypot(points.x, points.y).max(initial=0.0)), 1e-12)
    plane = np.stack([np.ones(len(points)), points.x / reach, points.y / reach], axis=-1)
    plane = np.broadcast_to(plane[:, None], (*used.shape, 3))
    agree = "of the same field point agree between exposures"
    stride = -(-used.shape[0] // MOST_PLACES)
    number = np.arange(used.shape[0])
    at_points = np.where(number % stride == 0, number // stride, -1)[:, None]
    at_points = np.broadcast_to(at_points, used.shape)
    if used.shape[0] > 1:
        yield _Grouping("field points", agree, at_points, constant, nothing, "gain")
        agree_in_qu = f"{agree} in q and u"
        yield _Grouping("field points in q and u", agree_in_qu, at_points, nothing, stokes, "response")
    moving = map(e.position, design.fit.likelihood.plan.moving)
    positions = [np.where(at.inside, at.angle, np.nan) for at in moving]
    night = night_of(e.mjd, calset.site.longitude)
    source = calset.intensities.block(0, len(points)).source
    cuts = [np.zeros(used.shape, int)]
    state = _numbered(e.filter, *positions)
    for name, words, place, gains, responses in (
        (
            "exposures",
            "of the same exposure agree between field points",
            _numbered(e.exposure),
            plane,
            nothing,
        ),
        ("states", "of the same filter and moving elements agree", state, nothing, stokes),
        ("sources", "of the same standard agree", source, constant, stokes),
        ("nights", "of the same night agree", _numbered(night), plane, nothing),
        ("kinds", "of the same kind of exposure agree", _numbered(e.kind), plane, nothing),
    ):
        place = np.broadcast_to(place, used.shape)
        if len(np.unique(place[used])) > 1 and not any(np.array_equal(place, earlier) for earlier in cuts):
            cuts.append(place)
            yield _Grouping(name, words, place, gains, responses)


def _numbered(*labels: np.ndarray) -> Int[np.ndarray, " e"]:
    """Numbers of the different rows, in the order in which they come."""
    rows = ["/".join(map(str, row)) for row in zip(*labels, strict=True)]
    first: dict[str, int] = {}
    return np.array([first.setdefault(row, len(first)) for row in rows])


class _Question(NamedTuple):
    """One grouping made ready: c, the standard error of τ² for noise of unit variance, and the skewness of T."""

    grouping: _Grouping
    free: int
    share: float
    error: float
    skew: float

    def answered(self, pull: Float[np.ndarray, " a"], square: float) -> VarianceComponent:
        """The component, from Aᵀr and r·r."""
        noise = square / self.free
        deviate = 0.5 * self.error * (float(np.sum(pull**2)) / noise - self.share * self.free)
        error = noise * self.error  # of τ²
        size = float(np.sqrt(max(deviate * error, 0.0)))
        of_size = 0.5 * error / max(size, np.sqrt(error))
        return VarianceComponent(self.grouping, deviate, _tail(deviate, self.skew), size, of_size)


def asked(
    design: Design, grouping: _Grouping, residuals: Float[np.ndarray, "d n"]
) -> tuple[_Question, Float[np.ndarray, "a n"]] | None:
    """One grouping made ready, and Aᵀr of residuals behind the projection; None where the fit takes up all of it."""
    blocks = _blocks(design, grouping, residuals)
    if blocks is None:
        return None
    d, b, pull = blocks
    free = design.projector.free
    db, dd = d @ b, d @ d
    flat, along = b.reshape(-1, b.shape[-1]), db.reshape(-1, b.shape[-1])
    m, m2, m3 = flat.T @ flat, flat.T @ along, along.T @ along
    trace = float(np.einsum("laa->", d))
    first = trace - np.trace(m)
    second = np.sum(d**2) - 2.0 * np.trace(m2) + np.sum(m**2)
    third = np.sum(dd * d) - 3.0 * np.trace(m3) + 3.0 * np.sum(m2 * m) - np.sum(m @ m * m)
    share = first / max(free, 1)
    variance = second - share * first
    if not (free > 0 and first > 1e-6 * trace and variance > 1e-6 * second):
        return None
    skew = 8.0 * (third - 3.0 * share * second + 2.0 * share**2 * first) / (2.0 * variance) ** 1.5
    question = _Question(grouping, free, float(share), float(np.sqrt(2.0 / variance)), float(skew))
    return question, pull.reshape(-1, pull.shape[-1])


def _tail(deviate: float, skew: float) -> float:
    """The p of a standardised sum of squares with that skewness: a shifted χ²."""
    if skew < 1e-6:
        return float(special.ndtr(-deviate))
    degrees = 8.0 / skew**2
    return float(special.chdtrc(degrees, degrees + deviate * np.sqrt(2.0 * degrees)))


def _blocks(
    design: Design, grouping: _Grouping, residuals: Float[np.ndarray, "d n"]
) -> tuple[Float[np.ndarray, "l a a"], Float[np.ndarray, "l a q"], Float[np.ndarray, "l a n"]] | None:
    """D, QᵀA and Aᵀr, place by place; columns are camera × feature. None where a flux belongs to several places."""
    measured = design.measured
    used, shared, cameras = measured.used, measured.shared, measured.cameras
    place, scale = grouping.place[used], design.fit.noise_scale
    changes = (
        (measured.counts_changed_by(sort)[used] / scale)[..., None] * features[used][:, None, :]
        for sort, features in ((GAIN, grouping.gains), (LIGHT, grouping.responses))
    )
    change = np.concatenate(list(changes), axis=-1)
    along = (change * measured.unit_model[..., None]).reshape(len(change), -1)
    group = None
    if shared.exposures is not None:
        of_exposure = np.asarray(shared.exposures).argmax(axis=1)
        points, exposures = np.nonzero(used)
        group = points * (of_exposure.max() + 1) + of_exposure[exposures]
        pairs = np.unique(np.stack([group, place]), axis=1)
        if len(np.unique(pairs[0])) < pairs.shape[1]:
            return None
    width = change.shape[-1]
    together = np.kron(measured.together, np.ones((width, width)))
    basis = design.projector.basis
    rows = np.column_stack([basis, residuals])[: design.rows].reshape(len(change), cameras, -1)
    order = np.argsort(place, kind="stable")
    labels, starts = np.unique(place[order], return_index=True)
    found_d, found_b = [], []
    for label, start, stop in zip(labels, starts, [*starts[1:], len(order)], strict=True):
        if label < 0:
            continue
        members = order[start:stop]
        if members[-1] - members[0] == len(members) - 1:
            members = slice(members[0], members[-1] + 1)  # rows of a field point lie together: no copy
        c, a = change[members].transpose(1, 2, 0), along[members]
        if group is not None:
            a = np.equal.outer(np.unique(group[members]), group[members]).astype(float) @ a
        block = -(a.T @ a) * together
        squares = c @ c.transpose(0, 2, 1)
        for k in range(cameras):
            at = slice(k * width, (k + 1) * width)
            block[at, at] += squares[k]
        found_d.append(block)
        found_b.append((c @ rows[members].transpose(1, 0, 2)).reshape(cameras * width, -1))
    if len(found_d) < 2:
        return None
    stacked = np.stack(found_b)
    return np.stack(found_d), stacked[..., : basis.shape[1]], stacked[..., basis.shape[1] :]


def repeated_noise(design: Design) -> Iterator[str]:
    """Sentences on exposures that hold the same noise, by their number."""
    if pairs := pairs_alike(design):
        number = design.fit.calset.exposures.exposure
        listed = [f"{number[a]} and {number[b]} (correlation {alike:.2f})" for a, b, alike in pairs]
        listed = some(listed, thresholds.SHOWN, "; ")
        yield (
            f"exposures hold the same noise, as independent ones never do: {listed}: remove one of each pair, "
            "repeated data shrink the errors"
        )


def pairs_alike(design: Design) -> list[tuple[int, int, float]]:
    """Pairs of exposures whose residuals hang together as only those of the same measurement do, closest first.

    Their positions, and the correlation.
    """
    measured = design.measured
    if measured.shared.exposures is not None:
        return []
    residual, used = design.cube(design.projector(design.residual)), measured.used.astype(float)
    cameras, flux_known = residual.shape[-1], np.broadcast_to(measured.known, used.shape)[0]
    fluxes = 1 if measured.shared.cameras is None else np.linalg.matrix_rank(measured.shared.cameras)
    free = np.where(flux_known, cameras, cameras - fluxes)
    product = np.einsum("pek,pfk->ef", residual, residual, optimize=True)
    # Of two exposures the sums run over the points that both have.
    square = np.einsum("pek,pf->ef", residual**2, used, optimize=True)
    shared = used.T @ used
    expected = shared * np.minimum.outer(free, free)
    first, second = np.triu_indices(len(free), 1)
    keep = (expected[first, second] > 0) & (square[first, second] > 0) & (square[second, first] > 0)
    first, second = first[keep], second[keep]
    if not len(first):
        return []
    first_square, second_square = square[first, second], square[second, first]
    correlation = product[first, second] / np.sqrt(first_square * second_square)
    # The fit takes something of every exposure: the noise is measured by the residuals.
    deviate = correlation * np.sqrt(expected[first, second])
    limit = -special.ndtri(local_p(thresholds.ALARM, len(first)))
    excess = 0.5 * (first_square / free[first] + second_square / free[second]) / shared[first, second] - 1.0
    pattern = correlation / np.maximum(1.0 - correlation, 1e-12)
    alike = (deviate > limit) & (correlation > thresholds.UNEVEN) & (excess < 0.5 * pattern)
    pairs = zip(first[alike].tolist(), second[alike].tolist(), correlation[alike].tolist(), strict=True)
    return sorted(pairs, key=lambda pair: -pair[2])
