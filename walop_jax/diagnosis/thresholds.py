"""Thresholds of a diagnosis; `diagnosis.json` lists them (key `policy`), docs/validation.md the studies of them.

Evidence is ln B, a logarithm of a ratio of probabilities; separations are in standard deviations. A rule of the search
needs its line in the table of the ablation (`tests/studies/ablation.py`), on scenes that did not make it.
"""

from __future__ import annotations

import math

from walop_jax.calibration.accuracy import GOAL

# Is anything missing?

SEPARATION = (
    3.0  # standard errors: the distance below which data cannot distinguish two candidates, and of an alarm
)
# Global p below which something is missing, and corrected p below which a candidate is significant: 0.0027, of 3 σ.
ALARM = math.erfc(SEPARATION / math.sqrt(2.0))
COMMON_MODE = 0.05  # rms (σ of one intensity) of disturbances that one camera in one exposure may have

# What is missing, and which candidate it is (`selection`)?

NOTHING_MORE = 0.5  # ν, probability beforehand that nothing more is missing
EXPECTED = (1.0 - NOTHING_MORE) / NOTHING_MORE  # things that are missing beforehand, in the mean
# λ, probability that something is missing from which on it is called, and with which a set of names holds its thing.
CERTAIN = 0.95
MOST_STEPS = 6  # things that are missing at once; additions of one diagnosis
# Descriptions of the final model above which they can be one thing that none of them holds.
MOST_SENTENCES = 2
MOST_TOGETHER = 4  # numbers of one thing that are tried together: members of a group of descriptions, priors
MOST_FITTED = 4  # shapes of one effect from which it is fitted; other descriptions that are fitted
# ln B by which the linear step of a candidate that is reported as indistinguishable may be too small.
LINEAR_GOOD = 1.0
# Relative change of the counts up to which linear steps are right: columns of an earlier model serve again, of
# discrete causes only readings of some exposures are asked, and the evidence of a linear step is known to this share.
LINEAR = 0.01
SAME = 0.999  # correlation of two columns from which on they are the same to the data
POOR_FIT = 1.5  # χ²/dof above which structural effects and other descriptions are tried
FLOOR = math.sqrt(POOR_FIT)  # σ of residuals behind all candidates above which evidence counts in that unit

# Additions

# Factor by which names must bring down χ²/dof − 1 of a poor fit, else they are reported as parts, and not added, and
# what has no linear step is tried beside them; and by which another reading of the data must, to be reported.
PART = 10.0
# Difference in evidence below which the better of two is not certain: odds of 19 to 1. More loss in ln p of the
# exposures of one KIND, as those of others predict them, and in −χ²/2 of that, contradicts an addition.
CERTAIN_ODDS = math.log(CERTAIN / (1.0 - CERTAIN))
# Probability of what is not to be expected: with it noise raises a doubt about how residuals are grouped. Rivals are
# listed, and members of a class averaged, down to the difference in evidence at which the other one is so probable.
UNLIKELY = 1e-3
IMPROBABLE = -math.log(UNLIKELY)
CHI2_IMPROBABLE = 2.0 * IMPROBABLE  # the same as a difference in χ²
MOST_WIDTHS = PART  # prior widths by which an amplitude of an optical description, or a prior, may be off
MOST_PATTERNS = 8  # patterns without a name that describe a remainder
MOST_CLASSES = 8  # rivals of one name, and names with rivals, that are listed

# Reports

NEGLIGIBLE = GOAL / PART  # change of calibrated q and u that does not matter for an instrument good to `GOAL`
# Share of the variance of the noise below which it is a matter of the stated errors: by which residuals of one part of
# the data may be larger or smaller than those of the rest, or that two exposures may have in common.
UNEVEN = 0.25
LARGEST_ROBUST_RATIO = 1.5  # of errors that allow for common disturbances of an exposure to those that do not
SHOWN = 4  # alternatives that a sentence lists; files have all
ROUNDING = 1e-9  # share below which a number is rounding
LIMIT = 0.95  # probability with which an effect that was not found stays below its limit
PROBABILITY = 0.99  # probability with which an effect at its detection limit is detected

# Other descriptions of the instrument, other readings of the data

LIKELY_SHARE = 0.5  # share of a misfit that a linear step of a number must explain for it to be fitted
LEAST_GAIN = 12.0  # gain in χ² behind one linear step above which a description is worth a fit

# Candidates and time

MOST_FITS = 40  # exact fits of additions in one diagnosis, after which nothing further is tried
# The same where the model is so far off that errors were scaled (`fit.search.FAR_OFF`).
MOST_FITS_FAR_OFF = 12
# Degrees of patterns of rings about the centre; the throughput absorbs smoother ones.
RINGS = (3, 4, 5, 6, 7, 8)
# Effects that are asked camera by camera, under their names there.
ASKED_BY_CAMERA = ("pedestal", "nonlinearity")


def in_use() -> dict[str, float]:
    """The thresholds by name."""
    numbers = ((name, value) for name, value in globals().items() if name.isupper())
    return {name.lower(): value for name, value in numbers if isinstance(value, int | float)}
