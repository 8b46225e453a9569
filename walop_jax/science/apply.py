"""A calibration applied to a science catalogue: q, u of every star with errors of photons and calibration.

Rows are taken star by star in blocks that fit into memory. The result of a star does not depend on the rest of
the catalogue, until all of it is looked at together (`star_search`): then errors grow for all stars by what
that has found.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import special

from walop_jax.calibration.analysis_vectors import COLOURS, COOLEST, AnalysisVectors, colour_weights
from walop_jax.calibration.calibration import Calibration
from walop_jax.data.settings import Settings
from walop_jax.fit.verdict import Quality
from walop_jax.io.errors import DataError, rows_text
from walop_jax.io.shapes import ByRowAndCamera, RowIndex
from walop_jax.likelihood.flux import FluxGroups, eliminate_flux, project_flux
from walop_jax.model.parameters import with_values
from walop_jax.science.catalogue import Catalogue
from walop_jax.science.catalogue_readings import CatalogueReadings, readings_of, sample_of
from walop_jax.science.colours import ignored_colour, unsure_colour
from walop_jax.science.detectors import detector_slopes, errors_of, linearised
from walop_jax.science.estimate import Estimate, calibration_shift, estimate
from walop_jax.science.other_readings import CatalogueRows
from walop_jax.science.star_columns import PossibleChange
from walop_jax.science.star_light import OwnLight, unpolarised, with_sky
from walop_jax.science.star_residuals import StarResiduals, by_place
from walop_jax.science.star_search import CatalogueSearch, with_own_light
from walop_jax.science.star_words import NOTHING_TO_SPARE, CatalogueCheck
from walop_jax.sky.position_angles import sky_to_instrument

QuOfStars = Float[np.ndarray, "s 2"]
QuCovariances = Float[np.ndarray, "s 2 2"]
Told = Callable[[int, int], None] | None
ChosenStars = Bool[np.ndarray, " s"]
StarNumbers = Int[np.ndarray, " s"]
STAR_SAMPLE = 16384
"""Rows of a catalogue, spread over it, by which the whole of it is judged: they see a camera that has changed by a
fiftieth of what single stars of 10⁶ electrons would show."""

OWN_SAMPLE = 4096  # rows of which q and u of the stars themselves are asked: more show little more
STAR_ROWS = 16384  # rows of a star catalogue that are worked on together: their matrices take some MB

MOST_SETTINGS = 200
ILL_POSED = 10.0  # ratio of the errors of the two principal directions from which FLAG 16 is set
_EXPANSIONS = 8  # of the counts, about the errors of the calibration that explain the stars best, …
_STRAIGHT = 0.01  # … until second derivatives make less difference than this fraction of the noise, squared
_KNOWN = 0.1  # error of q and u together from which a star says nothing of the arms
IMPROBABLE = 1e-6  # probability of a CHI2 as large below which FLAG 131072 is set, …
ROUGH = 0.005
"""… with so much of the light added to the errors: calibrations and flat fields are less perfect than bright stars."""


@dataclasses.dataclass(frozen=True)
class Stars:
    """Stokes parameters of the stars of a catalogue, in the order of `Catalogue.star`.

    They are on the sky (equatorial frame) where the catalogue has a ROTATOR, in the instrument frame elsewhere.
    `covariance` is the sum of `photon`, `calibration` (parameters of the optics and of the detectors), `spectrum` and
    `changed`: `spectrum` is the error of a TEFF or, for a star without one, the spread of colours of a population
    (`COOL`, `HOT`), and `changed` comes from changes since the calibration that the whole catalogue shows. `colour` is
    the error of (q, u) if TEFF were ignored; without TEFF, half the difference between stars of 3500 K and 10 000 K.
    `hidden` is the largest shift of q and u by a single error that the data of the calibration would not have shown
    (NaN: not computed). `flag` holds bits of `Quality`; `rows` counts the rows of a star. `check` is the check of all
    stars together, `sky_bound` the largest shift by leftover light of the sky that the stars do not exclude (None: the
    level of the sky is not stated).
    """

    qu: QuOfStars
    photon: QuCovariances
    calibration: QuCovariances
    spectrum: QuCovariances
    changed: QuCovariances
    colour: QuOfStars
    hidden: QuOfStars
    chi2: Float[np.ndarray, " s"]
    dof: StarNumbers
    rows: StarNumbers
    flag: StarNumbers
    check: CatalogueCheck = NOTHING_TO_SPARE
    sky_bound: Float[np.ndarray, " s"] | None = None

    @property
    def covariance(self) -> QuCovariances:
        """Covariance of (q, u), all causes together."""
        return self.photon + self.calibration + self.spectrum + self.changed


def apply(
    calibration: Calibration, catalogue: Catalogue, progress: Told = None, *, force: bool = False
) -> Stars:
    """Stokes parameters of all stars of a catalogue.

    `progress` gets how many rows of how many are done. Raises `DataError` for an unknown filter, for a
    catalogue with more optical settings than can be tabulated, and, unless `force` is given, for settings that the
    calibration does not cover (`check_validity`).
    """
    return apply_by(AnalysisVectors(calibration), catalogue, progress, force=force)


def apply_by(
    vectors: AnalysisVectors, catalogue: Catalogue, progress: Told = None, *, force: bool = False
) -> Stars:
    """`apply` by the tables of a calibration, which several catalogues share."""
    work = _Application(vectors, catalogue, force=force)
    chosen, few = work.sample(STAR_SAMPLE), work.sample(OWN_SAMPLE)
    readings = work.readings(chosen)
    # What the stars say of the instrument means nothing where they are not what the catalogue says.
    mended = readings is not None and readings.mended
    blocks, watched, own = [], [], []
    for done, rows in work.blocks():
        block = work.block(rows)
        blocks.append(block.stars)
        if not mended:
            watched += work.residuals(block, chosen)
            own += work.own_light(block, few)
        if progress is not None:
            progress(done, len(catalogue))
    check = dataclasses.replace(work.checked(watched, chosen), readings=readings)
    check = work.balanced(check, own)
    if check.doubtful:
        readings = work.readings(chosen, doubted=True)
        if readings is not None and readings.mended:
            check = dataclasses.replace(NOTHING_TO_SPARE, readings=readings)
    return with_sky(work.together(_joined(blocks), check), catalogue)


def results_of(calibration: Calibration, catalogue: Catalogue) -> Stars:
    """Stokes parameters of all stars, each by itself: nothing that all of them say together is in the errors."""
    work = _Application(AnalysisVectors(calibration), catalogue, force=True)
    return _joined([work.block(rows).stars for _, rows in work.blocks()])


def _joined(parts: list[Stars]) -> Stars:
    columns = [f.name for f in dataclasses.fields(Stars) if f.name not in ("check", "sky_bound")]
    return Stars(*(np.concatenate([getattr(stars, name) for stars in parts]) for name in columns))  # pyright: ignore[reportArgumentType]


def residuals_of(
    vectors: AnalysisVectors, catalogue: Catalogue, rows: int = STAR_SAMPLE, *, force: bool = False
) -> list[StarResiduals]:
    """Residuals of stars, of about `rows` rows at most; none without a camera to spare. `DataError` as in `apply`."""
    work = _Application(vectors, catalogue, force=force)
    chosen, every = work.sample(rows), []
    for _, rows_there in work.blocks():
        every += work.residuals(work.block(rows_there), chosen)
    return every


def readings_in(
    vectors: AnalysisVectors, catalogue: Catalogue, *, force: bool = False, doubted: bool = False
) -> CatalogueReadings | None:
    """Other readings of a catalogue, of which one may mend it (`catalogue_readings.readings_of`)."""
    work = _Application(vectors, catalogue, force=force)
    return work.readings(work.sample(STAR_SAMPLE), doubted=doubted)


class _Block(NamedTuple):
    """Rows of whole stars and all that was computed for them; `rows` are those of the catalogue."""

    rows: RowIndex
    star: RowIndex
    stars: Stars
    found: Estimate
    vectors: Float[np.ndarray, "r k 3"]
    sigma: ByRowAndCamera
    plain: Float[np.ndarray, "r k o"]
    throughput: Float[np.ndarray, "r k k"]
    colour: Float[np.ndarray, "r k 2"]
    derivative: Float[np.ndarray, "s 2 n"]


class _Application:
    """A calibration at work on a catalogue."""

    def __init__(self, vectors: AnalysisVectors, catalogue: Catalogue, *, force: bool) -> None:
        self.catalogue, self.vectors = catalogue, vectors
        calibration = vectors.calibration
        self.settings, self.setting_of = _settings(self.vectors, catalogue)
        if not force:
            check_validity(calibration, catalogue.points.settings)
        # Rows without a place are `outside`.
        at = np.nan_to_num(catalogue.points.x), np.nan_to_num(catalogue.points.y)
        self.counts = linearised(calibration, catalogue.counts, *at)
        self.sigma = errors_of(calibration, self.counts, catalogue.sigma, *at)
        self.offset, self.slope = _rotator_zero(self.vectors)
        self.order = np.argsort(catalogue.star, kind="stable")
        self.split = self.vectors.instrument.cameras.split
        self.on_sky = bool(np.isfinite(catalogue.rotator).any())
        filters, of = np.unique(catalogue.points.settings.filter, return_inverse=True)
        self.filter = filters[np.argmax(np.bincount(of.reshape(-1)))]

    def blocks(self) -> Iterator[tuple[int, RowIndex]]:
        """Rows of whole stars, each with the number of rows done after it."""
        for done, rows in _slices_of_stars(self.catalogue.star[self.order]):
            yield done, self.order[rows]

    def block(self, rows: RowIndex) -> _Block:
        """Stokes parameters of some stars."""
        catalogue, vectors, setting_of = self.catalogue, self.vectors, self.setting_of[rows]
        points, sigma, counts = catalogue.points, self.sigma[rows], self.counts[rows]
        _, star = np.unique(catalogue.star[rows], return_inverse=True)
        first = np.flatnonzero(np.diff(star, prepend=-1))
        outside = self.outside(rows)
        x, y = (np.where(outside, 0.0, values[rows]) for values in (points.x, points.y))
        teff, sky = points.settings.teff[rows], np.isfinite(catalogue.rotator[rows])
        rotator = np.where(sky, catalogue.rotator[rows] + np.rad2deg(self.offset), 0.0)

        spectra = np.empty((len(rows), COLOURS + 1, vectors.cameras, 3))
        for k, same in _rows_by_setting(setting_of):
            spectra[same] = vectors.at(self.settings[k], x[same], y[same])
        mixed = np.einsum("rc,rcks->rks", colour_weights(teff, COLOURS), spectra)
        used = np.where(outside[:, None], np.nan, counts)
        # Of light with (q + iu) exp(−2iR) in the instrument frame: the vectors turn the other way.
        axes = sky_to_instrument(mixed[..., 1], mixed[..., 2], -rotator[:, None])
        on_sky = np.stack([mixed[..., 0], *axes], axis=-1)
        fitted = estimate(on_sky, used, sigma, star, vectors.instrument.cameras)

        towards = sky_to_instrument(fitted.qu[star, 0], fitted.qu[star, 1], rotator)
        s = np.stack([np.ones(len(rows)), *towards], axis=1)
        # Of the model per unit flux, to the plain parameters and to the throughputs.
        plain = np.empty((len(rows), vectors.cameras, vectors.plain))
        throughput = np.empty((len(rows), vectors.cameras, vectors.cameras))
        derivative = np.empty((len(rows), 2, len(vectors.parameters)))
        # Of (q + iu) exp(−2i R), that grows by −2i (q + iu) dR, to ROTATOR; 0 where there is none.
        turned = 2.0 * np.where(sky[:, None], mixed[..., 1] * s[:, 2:] - mixed[..., 2] * s[:, 1:2], 0.0)
        acting = {number: turn * turned for number, turn in vectors.turns.items()}
        for k, same in _rows_by_setting(setting_of):
            for number, added in vectors.added(self.settings[k], x[same], y[same]).items():
                total = acting.setdefault(number, np.zeros_like(turned))
                total[same] += np.einsum("rs,rks->rk", s[same], added)
            local = vectors.derivatives(self.settings[k], x[same], y[same], teff[same])
            plain[same], throughput[same] = (np.einsum("rs,rksf->rkf", s[same], slopes) for slopes in local)
            gain = fitted.gain[same]
            of_plain, of_throughput = gain @ plain[same], gain @ throughput[same]
            derivative[same] = vectors.to_parameters(of_plain, of_throughput, x[same], y[same])
        for p, change in detector_slopes(vectors, counts, x, y):
            change = fitted.relative(change)
            plain[..., p] -= change
            derivative[..., p] -= np.einsum("rik,rk->ri", fitted.gain, change)
        if self.slope.any():
            derivative += (fitted.gain @ turned[..., None]) * self.slope
        derivative = np.add.reduceat(-derivative, first)

        def change_of(weights: Float[np.ndarray, "r c"]) -> ByRowAndCamera:
            return np.einsum("rc,rcks,rs->rk", weights, spectra, s, optimize=True)

        def shift(change: ByRowAndCamera) -> QuOfStars:
            return calibration_shift(fitted.gain, change[..., None], star)[..., 0]

        hidden = _hidden(vectors, derivative, {number: shift(change) for number, change in acting.items()})
        root = derivative @ vectors.root
        calibration = root @ root.swapaxes(1, 2)
        structure = vectors.calibration.verdict.structure
        if structure:
            # A gain of every camera at each place of the star, the same in all rows there.
            lit = np.einsum("rks,rs->rk", mixed, s)
            place, of_place = by_place(star, x, y)
            shifts, square = np.zeros((len(of_place), 2, vectors.cameras)), np.zeros_like(calibration)
            np.add.at(shifts, place, fitted.gain * lit[:, None])
            np.add.at(square, of_place, shifts @ shifts.swapaxes(1, 2))
            variance = structure.gain**2 + structure.response**2 * np.sum(fitted.qu**2, axis=1)
            calibration = calibration + variance[:, None, None] * square
        nothing = np.zeros_like(calibration)
        spectrum, colour = nothing, np.zeros((len(rows), vectors.cameras, 2))
        teff_err = catalogue.teff_err[rows]
        if np.isnan(teff).any() or teff_err.any():
            colour = np.stack([change_of(weights) for weights in unsure_colour(teff, teff_err)], axis=-1)
            mean, width = (shift(colour[..., n]) for n in range(2))
            spectrum = mean[:, :, None] * mean[:, None] + width[:, :, None] * width[:, None]
        flag = self.flags(rows, used, first, fitted)
        other_causes = np.trace(fitted.photon + calibration, axis1=1, axis2=2)
        flag[np.trace(spectrum, axis1=1, axis2=2) > other_causes] |= Quality.UNKNOWN_COLOUR
        stars = Stars(
            qu=fitted.qu,
            photon=fitted.photon,
            calibration=calibration,
            spectrum=spectrum,
            changed=nothing,
            colour=shift(change_of(ignored_colour(teff))),
            hidden=hidden,
            chi2=fitted.chi2,
            dof=fitted.dof,
            rows=np.add.reduceat((~catalogue.copy[rows]).astype(int), first),
            flag=flag,
        )
        return _Block(rows, star, stars, fitted, on_sky, sigma, plain, throughput, colour, derivative)

    def outside(self, rows: RowIndex) -> Bool[np.ndarray, " r"]:
        """Rows beyond the field of the instrument, or too far beyond that of the calibration to mean anything."""
        points = self.catalogue.points
        return points.outside[rows] | (
            np.maximum(np.abs(points.x[rows]), np.abs(points.y[rows])) > self.vectors.half_width
        )

    def flags(
        self, rows: RowIndex, counts: ByRowAndCamera, first: StarNumbers, found: Estimate
    ) -> StarNumbers:
        """Quality bits of every star: those of its rows and of the calibration, and three that need all of its rows."""
        points, sigma = self.catalogue.points, self.sigma[rows]
        settings, calibration = points.settings[rows], self.vectors.calibration
        bits = calibration.flags(points.x[rows], points.y[rows], settings)
        bits[calibration.beyond_settings(settings)] |= Quality.VALIDITY_FORCED
        bits[self.outside(rows)] |= Quality.BEYOND_FIELD
        bits[settings.teff < COOLEST] |= Quality.BEYOND_SETTINGS
        bits[~np.isfinite(counts * sigma).all(axis=1) & ~self.catalogue.copy[rows]] |= Quality.CAMERA_MISSING
        bits[self.catalogue.spoilt[rows]] |= Quality.SATURATED
        bits[self.catalogue.repeated[rows]] |= Quality.REPEATED
        bits[self.on_sky & ~np.isfinite(self.catalogue.rotator[rows])] |= Quality.OTHER_FRAME
        flag = np.bitwise_or.reduceat(bits, first) | calibration.verdict.quality
        flag[~(found.condition < ILL_POSED)] |= Quality.HIGH_CROSSTALK
        flag[~np.isfinite(found.qu).all(axis=1)] |= Quality.NO_STOKES
        # The largest signal-to-noise ratio of a camera.
        good = np.isfinite(counts) & np.isfinite(sigma) & (sigma > 0)
        bright = np.where(good, counts / np.where(good, sigma, 1.0), 0.0).max(axis=1)
        chi2 = found.chi2 / (1.0 + (ROUGH * np.maximum.reduceat(bright, first)) ** 2)
        improbable = special.chdtri(np.arange(1, found.dof.max(initial=1) + 1), IMPROBABLE)
        flag[chi2 > np.append(np.inf, improbable)[np.maximum(found.dof, 0)]] |= Quality.DISAGREES
        return flag

    # ------------------------------------------------------------------------------ the catalogue as a whole

    def sample(self, most: int) -> ChosenStars:
        """A sample of the stars, about `most` rows of them, spread by multiples of the golden section."""
        stars = np.arange(self.catalogue.star.max() + 1)
        return np.mod(stars * 0.6180339887498949, 1.0) < most / len(self.catalogue)

    def residuals(self, block: _Block, chosen: ChosenStars) -> list[StarResiduals]:
        """Residuals of the chosen stars of a block: none, or one list of those that have a result within the field."""
        catalogue, vectors, stars = self.catalogue, self.vectors, block.stars
        number = catalogue.star[block.rows]
        first = np.flatnonzero(np.diff(block.star, prepend=-1))
        beyond = Quality.BEYOND_FIELD | Quality.BEYOND_SETTINGS | Quality.NO_STOKES | Quality.REPEATED
        good = chosen[number[first]] & (stars.flag & beyond == 0) & (stars.dof > 0)
        r = np.flatnonzero(good[block.star])
        if not r.size:
            return []
        rows, shared = block.rows[r], FluxGroups(vectors.instrument.cameras.together)
        sigma, counts = block.sigma[r], self.counts[rows]
        used = np.isfinite(counts) & np.isfinite(sigma) & (sigma > 0)
        root = np.where(used, 1.0 / np.where(used, sigma, 1.0), 0.0)
        a, qu = block.vectors[r], stars.qu[block.star[r]]
        unit = root * np.einsum("rks,rs->rk", a, np.concatenate([np.ones((len(qu), 1)), qu], axis=1))
        weighed = root * np.where(used, counts, 0.0)
        flux, residual = eliminate_flux(weighed, unit, np.zeros(len(r), bool), shared)
        model, scale = flux * unit, (flux * root)[..., None]
        tangent = project_flux(np.moveaxis(scale * a[..., 1:], -1, 0), model, False, shared)
        x, y = catalogue.points.x[rows], catalogue.points.y[rows]
        residuals = StarResiduals(
            star=np.unique(block.star[r], return_inverse=True)[1],
            residual=residual,
            model=model,
            tangent=np.moveaxis(tangent, 0, 1),
            photon=stars.photon[good],
            root=root,
            x=x,
            y=y,
            time=catalogue.time[rows],
            plain=scale * block.plain[r],
            throughput=scale * block.throughput[r],
            basis=vectors.basis(x, y),
            colour=scale * block.colour[r],
            together=vectors.instrument.cameras.together,
            structure=vectors.calibration.verdict.structure.gain,
        )
        return [residuals]

    def readings(self, chosen: ChosenStars, *, doubted: bool = False) -> CatalogueReadings | None:
        """Other readings of the rows of some bright ones of the chosen stars; `None` where nothing can be said."""
        catalogue = self.catalogue
        points, r = catalogue.points, np.flatnonzero(chosen[catalogue.star] & ~catalogue.copy)
        r = r[np.argsort(catalogue.star[r], kind="stable")]
        if not r.size:
            return None
        star = np.unique(catalogue.star[r], return_inverse=True)[1].reshape(-1)
        rotator = catalogue.rotator[r] + np.rad2deg(self.offset)
        place, settings = (points.x[r], points.y[r]), points.settings[r]
        rows = sample_of(CatalogueRows(star, *place, rotator, self.counts[r], self.sigma[r], settings))
        return readings_of(self.vectors, rows, doubted=doubted) if len(rows.x) else None

    @property
    def arms(self) -> list[tuple[int, int]]:
        """The cameras of the arms that have two."""
        return [(arm[0], arm[1]) for arm in self.vectors.instrument.cameras.arms if len(arm) == 2]

    def own_light(self, block: _Block, chosen: ChosenStars) -> list[OwnLight]:
        """q and u of the chosen stars of a block, with what moves them: none, or one list."""
        catalogue, stars = self.catalogue, block.stars
        first = np.flatnonzero(np.diff(block.star, prepend=-1))
        row = block.rows[first]
        beyond = Quality.BEYOND_FIELD | Quality.BEYOND_SETTINGS | Quality.NO_STOKES | Quality.REPEATED
        good = chosen[catalogue.star[row]] & (stars.flag & (beyond | Quality.DISAGREES) == 0)
        good &= catalogue.points.settings.filter[row] == self.filter
        arms = self.arms
        if not good.any() or not arms:
            return []
        light = unpolarised(
            block.vectors, self.counts[block.rows], block.sigma, first, arms, split=self.split
        )
        with np.errstate(invalid="ignore"):
            good &= np.trace(light.noise, axis1=1, axis2=2) < _KNOWN**2
        colour = [
            calibration_shift(block.found.gain, block.colour[..., n, None], block.star) for n in range(2)
        ]
        nuisances = np.concatenate(
            [block.derivative[good] @ self.vectors.root, *(c[good] for c in colour)], axis=-1
        )
        _, group = np.unique(np.nan_to_num(np.round(catalogue.time, 3)), return_inverse=True)
        place = catalogue.points.x[row], catalogue.points.y[row], group.reshape(-1)[row]
        x, y, exposure = (values[good] for values in place)
        seen = (light.qu, light.noise, light.shifts, light.cameras)
        qu, noise, shifts, cameras = (values[good] for values in seen)
        return [OwnLight(qu, noise, x, y, exposure, shifts, nuisances, cameras)]

    def balanced(self, check: CatalogueCheck, parts: list[OwnLight]) -> CatalogueCheck:
        """The check with what q and u of the stars say of the balance of the arms; nothing of few stars."""
        names = self.vectors.instrument.cameras.names
        return with_own_light(check, OwnLight.joined(parts), names, self.arms) if parts else check

    def checked(self, watched: list[StarResiduals], chosen: ChosenStars) -> CatalogueCheck:
        """Check of all stars together; `chosen` are those whose residuals are `watched`.

        Errors of the calibration move the stars in proportion only while they are small beside the scale on which the
        optics change. Behind those that explain bright stars best half of δᵀ H δ is left, H the second derivatives
        of the counts: nothing is said of stars that agree once the counts are computed with these errors.
        """
        if not watched:
            return NOTHING_TO_SPARE
        vectors = self.vectors
        search = CatalogueSearch(StarResiduals.joined(watched), vectors)
        check = search.answer()
        for _ in range(_EXPANSIONS):
            errors = None if check.holds else search.errors_of_calibration()
            if errors is None:
                break
            values = vectors.calibration.values.copy()
            values[vectors.parameters] += vectors.root @ errors
            moved = dataclasses.replace(vectors.calibration, values=values)
            sample = self.catalogue.of_rows(chosen[self.catalogue.star])
            residuals = residuals_of(AnalysisVectors(moved), sample, len(sample), force=True)
            joined = StarResiduals.joined(residuals) if residuals else None
            same = joined is not None and joined.residual.shape == search.stars.residual.shape
            if joined is None or (same and search.bend(errors, joined.residual) < _STRAIGHT):
                break
            search = CatalogueSearch(joined, vectors, errors)
            check = search.answer()
        return check

    def together(self, stars: Stars, check: CatalogueCheck) -> Stars:
        """The stars with the errors, and a bit of FLAG, of the check of all of them."""
        changed, flag = stars.changed, stars.flag
        if check.changes or check.places or check.unbalanced:
            of_blocks = [self._changed(self.block(rows), check) for _, rows in self.blocks()]
            changed = np.concatenate([added for added, _ in of_blocks])
            flag = np.where(np.concatenate([near for _, near in of_blocks]), flag | Quality.PLACE, flag)
        flag = flag | (0 if check.holds_elsewhere else Quality.CATALOGUE)
        photon = stars.photon * np.where(stars.rows > 1, check.scale[1], check.scale[0])[:, None, None]
        return dataclasses.replace(stars, photon=photon, changed=changed, flag=flag, check=check)

    def _changed(self, block: _Block, check: CatalogueCheck) -> tuple[QuCovariances, ChosenStars]:
        """Effect on stars of changes, of those alike the largest in q and in u; True for stars at a place."""
        points, fitted = self.catalogue.points, block.found
        cameras = self.vectors.instrument.cameras.names
        parameters = [name for name, _ in self.vectors.named]
        counts = np.nan_to_num(self.counts[block.rows])
        place = (points.x[block.rows], points.y[block.rows], self.catalogue.time[block.rows])

        def shift(entry: PossibleChange) -> QuOfStars:
            if not entry.camera:
                return block.derivative[:, :, parameters.index(entry.name)]
            grown = np.zeros_like(counts)
            for k in map(cameras.index, entry.members):
                grown[:, k] = check.growth.electrons(entry, *place, counts[:, k])
            return calibration_shift(fitted.gain, fitted.relative(grown)[..., None], block.star)[..., 0]

        total, first = np.zeros_like(block.stars.changed), np.flatnonzero(np.diff(block.star, prepend=-1))
        for change in (*check.changes, *check.places):
            shifts = [np.abs(entry.size * np.nan_to_num(shift(entry))) for entry in change.alike]
            total += np.max(shifts, axis=0)[:, :, None] ** 2 * np.eye(2)
        if check.unbalanced:
            light = unpolarised(
                block.vectors, self.counts[block.rows], block.sigma, first, self.arms, split=self.split
            )
            arms = [tuple(cameras[k] for k in arm) for arm in self.arms]
            shifts = [
                np.abs(c.size * np.nan_to_num(light.shifts[..., arms.index(c.cameras)]))
                for c in check.unbalanced
            ]
            total += np.max(shifts, axis=0)[:, :, None] ** 2 * np.eye(2)
        near = np.zeros(len(total), bool)
        for spot in check.places:
            near |= np.maximum.reduceat(spot.profile(*place[:2]), first) > 0
        return total, near


def _slices_of_stars(star: Int[np.ndarray, " n"]) -> Iterator[tuple[int, slice]]:
    """Slices of about `STAR_ROWS` rows that do not divide stars, each with the number of rows done after it."""
    first = np.flatnonzero(np.diff(star, prepend=-1))
    start = 0
    while start < len(star):
        at = np.searchsorted(first, start + STAR_ROWS, side="right") - 1
        end = len(star) if start + STAR_ROWS >= len(star) else int(first[at])
        if end <= start:  # a single star with more rows than a block
            end = int(first[at + 1]) if at + 1 < len(first) else len(star)
        yield end, slice(start, end)
        start = end


def _rows_by_setting(setting_of: RowIndex) -> Iterator[tuple[int, Int[np.ndarray, " w"]]]:
    for k in np.unique(setting_of):
        yield int(k), np.flatnonzero(setting_of == k)


# ------------------------------------------------------------------------------------- settings and flags


def check_validity(calibration: Calibration, settings: Settings) -> None:
    """Raise `DataError`, with column and rows, for settings that the exposures of a calibration do not cover.

    Settings are filter and temperature. Dates are no bound: every science exposure lies outside those of the
    calibration; later exposures say whether it still holds (`check`).
    """
    beyond = calibration.beyond_settings(settings)
    if not beyond.any():
        return
    filters = np.unique(calibration.exposures.filter)
    uncovered = ~np.isin(settings.filter, filters)
    if uncovered.any():
        column, rows = "FILTER", uncovered
        names = ", ".join(np.unique(settings.filter[uncovered]))
        what = f"{names}; the calibration was made in {', '.join(filters)}"
    else:
        column, rows = "TEMP", beyond
        low, high = np.nanmin(calibration.exposures.temp), np.nanmax(calibration.exposures.temp)
        what = f"the calibration was made between {low:.1f} and {high:.1f} Celsius"
    advice = "apply a calibration that covers them, or --force (force=True): FLAG 2048 marks these stars then"
    raise DataError(f"{column}: {rows_text(np.flatnonzero(rows))}: {what}; {advice}")


def _settings(vectors: AnalysisVectors, catalogue: Catalogue) -> tuple[list[Settings], Int[np.ndarray, " n"]]:
    """The optical settings of a catalogue and which of them every row has."""
    settings = vectors.reduced(catalogue.points.settings)
    layouts = settings.optics()
    if len(layouts) > MOST_SETTINGS:
        columns = ", ".join(["TEMP", "HA", *(f"{prefix}_ANGLE" for prefix in settings.positions)])
        raise DataError(
            f"{columns}: {len(layouts)} different optical settings, at most {MOST_SETTINGS} can be tabulated; round "
            "TEMP to 0.1 Celsius and HA to 0.1 h, or take the catalogue in parts"
        )
    of = np.empty(len(catalogue), int)
    for number, (_, rows) in enumerate(layouts):
        of[rows] = number
    return [setting for setting, _ in layouts], of


# ---------------------------------------------------------------------------------- effects beyond the optics


def _hidden(
    vectors: AnalysisVectors, derivative: Float[np.ndarray, "s 2 n"], acting: Mapping[int, np.ndarray]
) -> QuOfStars:
    """Largest shift of q and u by one of the systematic errors that would not have been found; NaN where not computed.

    `acting` are the shifts by those that act on starlight (`AnalysisVectors.acting`): parameters make up for a part.
    """
    hidden = vectors.calibration.hidden
    if hidden is None or not len(hidden):
        return np.full(derivative.shape[:2], np.nan if hidden is None else 0.0)
    shift = derivative @ hidden.changes[:, vectors.parameters].T
    for number, acting_shift in acting.items():
        shift[..., number] -= acting_shift
    return np.abs(shift).max(axis=2)


def _rotator_zero(vectors: AnalysisVectors) -> tuple[float, Float[np.ndarray, " n"]]:
    """Offset that the model adds to ROTATOR (rad), and its derivatives to `vectors.parameters`."""
    to_instrument = with_values(vectors.calibration.model.template)

    def zero(values: jax.Array) -> jax.Array:
        angle = to_instrument(values).patched().rotator_zero
        return jnp.zeros(()) if angle is None else jnp.deg2rad(angle)

    values = jnp.asarray(vectors.calibration.values)
    return float(zero(values)), np.asarray(jax.grad(zero)(values))[vectors.parameters]
