"""Were the data taken under the conditions that their set states? Its coordinates, filter curves, colours and sky.

A field that is displaced, turned or scaled, a filter curve that is displaced, a lamp of another temperature: each is a
single number, and a fit takes most of it up in its own parameters, which are then wrong by many standard errors while
χ² hardly changes. Patterns over field and exposures, of which there are hundreds, miss a misfit spread over all data.
So each number has its own efficient score (`score`), with the derivative

    C = [r(θ̂; set with c + h) − r(θ̂; set with c)] / h,   of field positions [r(c + h) − r(c − h)] / 2h

of the whitened residuals r with respect to the number c that the set states, fluxes solved for anew. A row knows of the
field only its own place, so that scale and angle are sums of X and Y, row by row.

The coordinates and times of sky exposures, the site and ROTATOR are asked in the same way, and the share of the sky
(SKY) that is left in the counts. A number of the instrument that is thought to be known, and is not, looks much like
these: the prior of each parameter, and those of an element with up to four numbers together, are rivals: their
columns are the derivatives of (mean − value)/width with respect to the mean, in widths. So are effects of the catalogue
(`_asked_effects`), and terms of one camera with one amplitude: a non-linearity (its counts squared), a pedestal,
scattered light (the median counts of an exposure), light of another camera. What cannot be separated is reported
together.

Limits      Mistakes that free parameters absorb whole show in no residual: with a single filter its displacement, the
            thicknesses of the plates look the same. One number at a time, by a linear step: the size is a hint.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import special

from walop_jax.data.records import ERROR_WORDS, CalibrationSet
from walop_jax.data.table_intensities import TableIntensities
from walop_jax.diagnosis import thresholds
from walop_jax.diagnosis.design import Design, Measured
from walop_jax.diagnosis.hypotheses import Probe, all_candidates, applicable, probes
from walop_jax.diagnosis.readings import with_places, with_values
from walop_jax.diagnosis.score import Candidate, Score, ScoreSpace, corrected_p
from walop_jax.fit.refit import NEARLY
from walop_jax.io.text import beside, with_error, with_minus_sign
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects.in_models import effect_context, known_effects
from walop_jax.model.laws import YEAR

# Camera by camera, and as priors.
_ASKED_OTHERWISE = (*thresholds.ASKED_BY_CAMERA, "standard_outlier", "standard_values")
_LEVELS = "exposures at a second light level"
_DARK = "bias and dark frames"
_ONE_STAR = "a bright star in one beam: its light in the other cameras"
_PLACES = {"x", "gap"}  # shapes of which there are so many that an effect is as good as a pattern
_PRECESSION = 46.124 / 3600.0, 20.043 / 3600.0  # deg a year, m, n, J2000: Capitaine et al. 2003, A&A 412, 567
_J2000 = 51544.5  # MJD
STEP = 1e-4  # of the width: it is the error of a one-sided derivative; that of a central one is its square


class Stated(NamedTuple):
    """A number that a set states: what it is, its unit, what to check, what would measure it, the set with it changed.

    `width` is by how much it may be wrong at most, and is searched; `error` is its standard error
    (`records.StatedErrors`), of which a mistake is reckoned with where the data would not show it. `value` is None
    where only a change of it has a meaning.
    `seen_by_stars`: whether stars are observed under the same condition. `along` is how the places of the field points
    (x, y) change with a number that is about them.
    """

    what: str
    unit: str
    remedy: str
    shown_by: str
    width: float
    error: float
    changed: Callable[[float], CalibrationSet]
    value: float | None = None
    seen_by_stars: bool = False
    along: tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]] | None = None

    def changed_by(self, size: float) -> str:
        """The number in words, changed by a size."""
        return f"{self.what} changed by {with_minus_sign(f'{size:.3g}')} {self.unit}".rstrip()


class Single(NamedTuple):
    """One number, or a few of one thing, that may be otherwise: its columns, and its size in words.

    `plausible` is the mistake of each number to reckon with where the data would not show it: its standard error, or
    the width of its prior; 0 where the errors of the fit hold it already. `stated` is the number of the set that it is,
    `probe` the effect, if it is one; `shown_by` the measurement that would show it.
    """

    candidate: Candidate
    worded: Callable[[Score], str]
    plausible: float | Float[np.ndarray, " _"] = 0.0
    unit: str = ""
    shown_by: str = ""
    stated: Stated | None = None
    probe: Probe | None = None


class Scored(NamedTuple):
    """A number, or a few of one thing, with the score of changing it.

    `along` (q, columns) is what the parameters take up of its columns, Qᵀ C; `rest` the square of what they leave:
    information, in errors of the fit, where it is `alive`.
    """

    single: Single
    score: Score
    along: Float[np.ndarray, "q c"]
    rest: Float[np.ndarray, " c"]
    alive: Bool[np.ndarray, " c"]

    @property
    def stated(self) -> Stated:
        """The number of the set that it is."""
        assert self.single.stated is not None
        return self.single.stated


@dataclasses.dataclass(frozen=True, eq=False)
class Singles:
    """All single numbers of a fit with their scores; `noise_scale` is that of the scores.

    `asked` are the effects among them, and those that the set cannot show. `of_noise` are numbers that were not asked,
    since their columns hold the noise of the counts: they were made of N.
    """

    items: tuple[Scored, ...] = ()
    noise_scale: float = 1.0
    asked: tuple[Probe, ...] = ()
    of_noise: tuple[str, ...] = ()

    @classmethod
    def of(cls, design: Design) -> Singles:
        """Conditions that the set states, priors, terms of a camera that have one amplitude, effects with a name."""
        effects = _asked_effects(design)
        stated, noise = _without_noise(design, list(_conditions(design)))
        rivals = *stated, *_priors(design), *_of_cameras(design), *_of_catalogue(design, effects)
        of_noise = tuple(single.candidate.name for single in noise)
        return dataclasses.replace(scored(design, rivals), asked=effects, of_noise=of_noise)

    @property
    def testable(self) -> list[Scored]:
        """Those of which the parameters leave something."""
        return [item for item in self.items if item.score.testable]

    @property
    def clear(self) -> list[Scored]:
        """Those that the residuals ask for, after correction for all testable ones, the clearest first."""
        tried = self.testable
        clear = (item for item in tried if corrected_p(item.score.log_p, len(tried)) < thresholds.ALARM)
        return sorted(clear, key=lambda item: item.score.log_p)

    @property
    def alike(self) -> list[Scored]:
        """Those of the clear ones that explain as much as the clearest, or nearly: it is one of them."""
        clear = self.clear
        gains = [item.score.statistic - item.score.rank for item in clear]
        return [
            item
            for item, gain in zip(clear, gains, strict=True)
            if gain > gains[0] - thresholds.CHI2_IMPROBABLE
        ]


def _without_noise(design: Design, singles: Sequence[Single]) -> tuple[list[Single], list[Single]]:
    """Numbers that may be asked, and those whose column holds the noise of the data itself.

    One number takes up one degree of freedom. If it takes up most of the residuals, and leaves far less than noise, its
    column was made of the data. A level of the sky that was computed from N would explain every residual, and by that
    every other number as well.
    """
    residual, free = design.projector(design.residual), design.projector.free
    square, asked, noise = float(residual @ residual), list[Single](), list[Single]()
    for single in singles:
        column = design.projector(single.candidate.columns[:, 0])
        length = float(column @ column)
        taken = float(column @ residual) ** 2 / length if length > 0.0 else 0.0
        made_of_it = (
            taken > 0.5 * square and special.chdtr(max(free, 1), square - taken) < thresholds.ALARM**2
        )
        (noise if made_of_it else asked).append(single)
    return asked, noise


def scored(design: Design, rivals: Sequence[Single]) -> Singles:
    """Single numbers with their scores in the residuals of a design."""
    if not rivals:
        return Singles()
    matrices = [rival.candidate.columns for rival in rivals]
    along = np.hstack([design.projector.basis.T @ columns for columns in matrices])
    names, widths = zip(*((r.candidate.name, r.candidate.widths) for r in rivals), strict=True)
    space = ScoreSpace.projected(design.projector, names, widths, matrices)
    residual = design.projector(design.residual)
    scores = np.concatenate([columns.T @ residual for columns in matrices])
    table = space.table(scores, float(residual @ residual))
    rest, places = space.gram.diagonal(), space.places().values()
    items = (
        Scored(rival, score, along[:, at], rest[at], space.alive[at])
        for rival, score, at in zip(rivals, table.scores, places, strict=True)
    )
    return Singles(tuple(items), table.noise_scale)


def stated_conditions(design: Design, singles: Singles | None = None) -> Iterator[str]:
    """A sentence on the single numbers that the residuals of a fit speak against: fewest amplitudes, then clearest.

    For a fit that does not explain its data there is a sentence only if one of them alone would explain them.
    """
    singles = singles or Singles.of(design)
    clear = singles.clear
    if not clear:
        return
    best, result = clear[0].score, design.fit
    square = float(np.sum(design.projector(design.residual) ** 2))
    rest = square - best.statistic * singles.noise_scale**2
    if not result.explains_data and rest * result.noise_scale**2 > NEARLY * design.projector.free:
        return
    likely = singles.alike
    # Of an element and one of its numbers alone, the shorter statement if it explains as much.
    likely = [item for item in likely if not any(_holds(item.score, rival.score) for rival in likely)]
    # A mistake of one number comes before one of sixteen.
    likely.sort(key=lambda item: (item.score.rank, item.score.log_p))
    causes = "; or for ".join(item.single.worded(item.score) for item in likely[: thresholds.SHOWN])
    further = f"; or for {len(likely) - thresholds.SHOWN} others" if len(likely) > thresholds.SHOWN else ""
    p = corrected_p(best.log_p, len(singles.testable))
    found, limit = beside(p, thresholds.ALARM, ".{}g")
    yield f"the residuals ask for {causes}{further} (p = {found}, limit {limit})"


def _holds(score: Score, rival: Score) -> bool:
    """True if another statement, shorter or longer about the same element, is the better one."""
    if rival.name.startswith(f"{score.name}."):
        return rival.log_p <= score.log_p
    return score.name.startswith(f"{rival.name}.") and rival.log_p < score.log_p


def _conditions(design: Design, what: str = "") -> Iterator[Single]:
    """The numbers that the set states and that are used, or the one that is `what`."""
    statements = [item for item in stated_numbers(design.fit.calset) if what in ("", item.what)]
    columns = [design.stacked([column[:, None]]) for column in _columns(design, statements)]
    for item, column in zip(statements, columns, strict=True):
        if not column.any():  # a number may be stated and not used
            continue
        candidate = Candidate(item.what, column, np.array([item.width]))
        # What stars see as well is no mistake of the matrix alone.
        plausible = 0.0 if item.seen_by_stars else item.error
        wording = functools.partial(_condition_in_words, item)
        yield Single(candidate, wording, plausible, item.unit, item.shown_by, item)


def _priors(design: Design) -> Iterator[Single]:
    """The prior of every free parameter, and those of all numbers of an element, as what may be wrong."""
    rows, parameters = design.fit.likelihood.priors, design.fit.model.parameters
    constrained = np.flatnonzero(rows.known).tolist()
    names = {parameters[rows.index[i]].name: [i] for i in constrained}
    together: dict[str, list[int]] = {}
    for i in constrained:
        together.setdefault(parameters[rows.index[i]].name.rpartition(".")[0], []).append(i)
    elements = {k: v for k, v in together.items() if k and 1 < len(v) <= thresholds.MOST_TOGETHER} | names

    def wording(score: Score) -> str:
        texts = []
        for number, i in enumerate(elements[score.name]):
            p, mean, width = parameters[rows.index[i]], float(rows.mean[i]), float(rows.width[i])
            text = _worded(p.name, score, number, p.unit, mean, width)
            texts.append(f"{text}, not {mean:g} ± {width:g}")
        return " with ".join(texts) + " (check its value in the model file)"

    for name, members in elements.items():
        columns = np.zeros((len(design.residual), len(members)))
        columns[design.rows + np.array(members), np.arange(len(members))] = 1.0
        yield Single(Candidate(name, columns, np.full(len(members), thresholds.MOST_WIDTHS)), wording)


def _of_cameras(design: Design) -> Iterator[Single]:
    """Mistakes of a single camera in its counts with one amplitude: closed forms of the counts themselves."""
    measured, names = design.measured, design.fit.model.template.cameras.names
    counts = measured.flux[..., None] * measured.model / np.where(measured.weight > 0, measured.weight, 1.0)
    counts = np.where(measured.used[..., None], counts, 0.0)
    median, exposed = np.zeros(counts.shape[1:]), measured.used.any(axis=0)
    median[exposed] = np.nanmedian(np.where(measured.used[..., None], counts, np.nan)[:, exposed], axis=0)
    typical = float(np.median(counts[measured.used])) if measured.used.any() else 0.0

    errors = design.fit.calset.stated_errors

    def single(
        k: int, change: np.ndarray, error: tuple[str, float], words: str, unit: str, by: str
    ) -> Single:
        cube = np.zeros_like(counts)
        cube[..., k] = change
        rows = design.stacked([measured.derivative(cube)[:, None]])
        name, (of, units) = words.format(names[k]), error
        wording = functools.partial(_worded, f"{name} of", unit=unit)
        candidate = Candidate(name, rows, np.array([units * ERROR_WORDS[of].usual]))
        return Single(candidate, wording, units * getattr(errors, of), unit, by)

    if not measured.used.any():
        return
    for k in range(measured.cameras):
        square, level = counts[..., k] ** 2 / 1e6, np.broadcast_to(median[:, k], counts.shape[:2])
        yield single(k, square, ("linearity", 1.0), "a non-linearity of {}", "at 10⁶ electrons", _LEVELS)
        yield single(k, level, ("scattered", 1.0), "scattered light in {}", "of the median counts", _LEVELS)
        pedestal = "pedestal", typical
        yield single(k, np.ones_like(counts[..., k]), pedestal, "a pedestal in {}", "electrons", _DARK)
        for source in range(measured.cameras):
            if source != k:
                words = f"light of {names[source]} in {{}}"
                yield single(k, counts[..., source], ("leakage", 1.0), words, "of its counts", _ONE_STAR)


def _asked_effects(design: Design) -> tuple[Probe, ...]:
    """Probes of effects that the model has not; those with a place or a gap of their own are left to the patterns."""
    fit, template = design.fit, design.fit.model.template
    context = effect_context(template, fit.calset.exposures)
    excluded = {*fit.model.effect_names, *_ASKED_OTHERWISE}
    asked = (kind for kind in known_effects(fit.model) if not set(kind.shape) & _PLACES)
    kinds = [kind for kind in asked if kind.name not in excluded]
    return tuple(probes(applicable(kinds, context, template), context))


def _of_catalogue(design: Design, effects: Sequence[Probe]) -> Iterator[Single]:
    """The effects that are asked, as far as the set can show them."""
    named = all_candidates(design.columns, effects)
    for probe in (probe for probe in effects if probe.name in named):
        candidate = Candidate(probe.name, design.stacked([named[probe.name].columns]), probe.widths)
        wording = functools.partial(_effect_in_words, probe, design.fit.model.template.cameras.names)
        yield Single(candidate, wording, probe.widths, probe=probe)


def _effect_in_words(probe: Probe, cameras: Sequence[str], score: Score) -> str:
    effect, declared = probe.effect.combine(probe.group, score.amplitudes), probe.effect.numbers()
    if len(score.amplitudes) > thresholds.MOST_TOGETHER:
        return f"{effect.name}, {len(score.amplitudes)} numbers"
    choices = effect.choices()
    texts = [f"{n} {cameras[value] if n == 'camera' else value}" for n, value in choices.items()]
    sigmas = dict(zip(probe.parameters, np.sqrt(np.diag(score.covariance)), strict=True))
    for name, sigma in sigmas.items():
        value = with_error(float(getattr(effect, name)), float(sigma))
        texts.append(f"{name} {value} {declared[name].unit}".rstrip())
    return f"{effect.name}, {', '.join(texts)}"


def _worded(
    what: str, score: Score, number: int = 0, unit: str = "", start: float = 0.0, width: float = 1.0
) -> str:
    """An amplitude of a score in words, counted from `start` in units of `width`, with its standard error."""
    sigma = float(np.sqrt(score.covariance[number, number])) * width
    return f"{what} {with_error(start + float(score.amplitudes[number]) * width, sigma)} {unit}".rstrip()


def _condition_in_words(stated: Stated, score: Score) -> str:
    """A number that the set states, with its score, and what to check."""
    if stated.value is None:
        return f"{_worded(f'{stated.what} changed by', score, unit=stated.unit)} ({stated.remedy})"
    text = _worded(stated.what, score, unit=stated.unit, start=stated.value)
    return f"{text}, not {stated.value:g} ({stated.remedy})"


def condition_scores(design: Design, what: str = "") -> Singles:
    """The numbers that a set states, or the one that is `what`, each with the score of changing it."""
    return scored(design, _without_noise(design, list(_conditions(design, what)))[0])


def _columns(design: Design, statements: Sequence[Stated]) -> Iterator[Float[np.ndarray, " _"]]:
    of_field = [item for item in statements if item.along is not None]
    by_place = [_column(design, item) for item in of_field[:2] if len(of_field) > 2]  # X and Y come first
    for item in statements:
        if item.along is None or not by_place:
            yield _column(design, item)
        else:
            (in_x, in_y), (by_x, by_y) = item.along, by_place
            yield in_x[design.point] * by_x + in_y[design.point] * by_y


def _column(design: Design, statement: Stated) -> Float[np.ndarray, " _"]:
    """Derivative of the residuals with respect to a stated number, at the fit whose columns are used."""
    origin = design.origin
    if statement.what not in origin.by_stated_number:
        origin.by_stated_number[statement.what] = _difference(origin, statement)
    return origin.by_stated_number[statement.what]


def _difference(measured: Measured, statement: Stated) -> Float[np.ndarray, " _"]:
    def residual(likelihood: Likelihood) -> np.ndarray:
        return likelihood.residuals(measured.values)[1][measured.used].reshape(-1)

    def moved(step: float) -> np.ndarray:
        return residual(Likelihood.of(statement.changed(step), measured.likelihood.model))

    step = STEP * statement.width
    if statement.along is None:  # smooth: what a one-sided difference leaves out is as small as the step
        # Of one program: the rounding of another one, over a small step, would be a column of noise.
        return (moved(step) - residual(measured.likelihood)) / step
    return (moved(step) - moved(-step)) / (2.0 * step)


def stated_numbers(calset: CalibrationSet) -> Iterator[Stated]:
    """The numbers that a set states of its field, filters, light, sky and site."""
    errors = calset.stated_errors
    if len(calset.points) > 1:
        yield from _of_field(calset)
    for name in calset.filters:
        remedy = "check its curve, and what the polariser exposures were taken through"
        moved = functools.partial(_with_wavelength, calset, name)
        what, shown_by = f"the wavelengths of filter {name}", "a measured curve of the filter"
        yield Stated(what, "um", remedy, shown_by, 0.05, errors.wavelength, moved, seen_by_stars=True)
    e = calset.exposures
    for kind in np.unique(e.kind):
        chosen = (e.kind == kind) & np.isfinite(e.teff)
        if chosen.any():
            typical, remedy = float(np.median(e.teff[chosen])), "check the colour temperature of their light"
            warmer = functools.partial(_moved, calset, chosen, "teff", e.teff / typical)
            stated = typical if np.ptp(e.teff[chosen]) == 0.0 else None
            what = f"TEFF of exposures of kind {kind}"
            shown_by, error = "a measured spectrum of their light", errors.teff * typical
            yield Stated(what, "K", remedy, shown_by, typical, error, warmer, stated)
    yield from _of_sky(calset)
    table = calset.intensities
    if isinstance(table, TableIntensities) and (sky := table.sky) is not None and sky.any():

        def less(share: float) -> CalibrationSet:
            counts = table.counts - share * sky
            return dataclasses.replace(calset, intensities=dataclasses.replace(table, counts=counts))

        what, remedy = "the light of the sky that is left, in units of SKY,", "subtract the sky anew"
        yield Stated(what, "", remedy, "the same stars under another sky", 0.1, errors.sky, less, 0.0)


def _moved(
    calset: CalibrationSet, chosen: np.ndarray, column: str, by: float | np.ndarray, step: float
) -> CalibrationSet:
    """The set with a multiple of something added to a column of some of its exposures."""
    return with_values("exposures", column, lambda old: np.where(chosen, old + step * by, old))(calset)


def _of_sky(calset: CalibrationSet) -> Iterator[Stated]:
    """Mistakes in the place and the time of the sky, as the exposures and the site state them."""
    e, site, errors = calset.exposures, calset.site, calset.stated_errors
    moon = (e.kind == "moon") & np.isfinite(e.ra) & np.isfinite(e.dec)
    if moon.any():
        by_year, across = _PRECESSION
        north = np.tan(np.deg2rad(np.clip(e.dec, -80.0, 80.0)))
        along_ra = by_year + across * np.sin(np.deg2rad(e.ra)) * north
        along_dec = across * np.cos(np.deg2rad(e.ra))

        def of_date(step: float) -> CalibrationSet:
            return _moved(_moved(calset, moon, "ra", -along_ra, step), moon, "dec", -along_dec, step)

        remedy = "they are to be ICRS, not coordinates of date"
        solved = "an astrometric solution of frames of the same fields"
        # Who takes coordinates of date for ICRS is wrong by the years since 2000.
        years = float(np.abs(np.median(e.mjd[moon]) - _J2000) / YEAR)
        yield Stated("the equinox of RA and DEC", "", remedy, solved, 100.0, years, of_date, 2000.0)
        at = "check RA and DEC: ICRS, of the centre of the field (docs: conventions)"
        when = "check the clock and the time zone: UTC at mid-exposure"
        pointing, clock = errors.pointing / 3600.0, errors.time / 86400.0
        in_ra = pointing / max(float(np.cos(np.deg2rad(np.median(e.dec[moon])))), 0.1)
        for name, unit, width, error, remedy, shown_by in (
            ("RA", "deg", 5.0, in_ra, at, solved),
            ("DEC", "deg", 5.0, pointing, at, solved),
            ("MJD", "d", 1.0, clock, when, "a clock that is compared with UTC"),
        ):
            moved = functools.partial(_moved, calset, moon, name.lower(), 1.0)
            yield Stated(f"{name} of sky exposures", unit, remedy, shown_by, width, error, moved)
        for name, width in (("longitude", 180.0), ("latitude", 90.0)):
            elsewhere = functools.partial(_at_site, calset, name)
            remedy, shown_by = "check the site in the header", "the position of the telescope on a map"
            value = float(getattr(site, name))
            what = f"the {name} of the site"
            yield Stated(what, "deg", remedy, shown_by, width, errors.site, elsewhere, value)
    for kind in np.unique(e.kind[np.isfinite(e.rotator)]):
        remedy = "check its zero and its sense (docs: conventions)"
        moved = functools.partial(_moved, calset, e.kind == kind, "rotator", 1.0)
        shown_by = "polarised standards at several ROTATOR angles"
        what = f"ROTATOR of exposures of kind {kind}"
        yield Stated(what, "deg", remedy, shown_by, 45.0, errors.rotator, moved)


def _at_site(calset: CalibrationSet, name: str, step: float) -> CalibrationSet:
    """The set with a site farther in longitude or latitude, up to the pole."""
    limit = 90.0 if name == "latitude" else np.inf
    return with_values("site", name, lambda value: float(np.clip(value + step, -limit, limit)))(calset)


def _of_field(calset: CalibrationSet) -> Iterator[Stated]:
    check = "check X and Y against the frames (docs: conventions)"
    solved = "an independent check of the field positions"
    x, y = calset.points.x, calset.points.y
    radius, ones = float(np.hypot(x, y).max()), np.ones(len(x))
    errors = calset.stated_errors
    offset = errors.position / 3600.0
    for what, unit, width, error, along in (
        ("X of all field points", "deg", radius, offset, (ones, 0.0 * ones)),
        ("Y of all field points", "deg", radius, offset, (0.0 * ones, ones)),
        ("the scale of X and Y", "", 1.0, errors.scale, (x, y)),
        ("the angle of the field", "rad", 1.0, errors.turn, (-y, x)),
    ):
        moved = functools.partial(_displaced, calset, along)
        yield Stated(what, unit, check, solved, width, error, moved, along=along)


def _displaced(calset: CalibrationSet, along: tuple[np.ndarray, np.ndarray], step: float) -> CalibrationSet:
    return with_places(lambda x, y: (x + step * along[0], y + step * along[1]))(calset)


def _with_wavelength(calset: CalibrationSet, name: str, step: float) -> CalibrationSet:
    curve = calset.filters[name]
    moved = dataclasses.replace(curve, wavelength=curve.wavelength + step)
    return dataclasses.replace(calset, filters={**calset.filters, name: moved})
