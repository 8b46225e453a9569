"""Thresholds of a diagnosis, each with the study that measured it; `diagnosis.json` lists them (key `policy`).

Evidence is ln B, a logarithm of a ratio of probabilities; separations are in standard deviations. Studies: *blind*
(`tests/diagnosis/blind.py`), *ablation* (`tests/studies/ablation.py`), *limits* (`tests/studies/limits_hold.py`). A
rule of the search needs its line in the table of the ablation, on scenes that did not make it.
"""

from __future__ import annotations

# -------------------------------------------------------------------------------------------- is anything missing?

ALARM = 0.0027
"""Global p below which something is missing, and corrected p below which a candidate is significant: 3 σ. Blind."""
COMMON_MODE = 0.05
"""rms (σ of one intensity) of disturbances that one camera in one exposure may have. Not measured."""

# ------------------------------------------------------------------------------------- which candidates are tried?

MOST_STEPS = 6
"""Additions of one diagnosis. Not measured."""
MOST_LEADERS = 5
"""Names that are tried at one step. Not measured."""
MOST_SENTENCES = 2
"""Descriptions that one step tries. More descriptions, or names, in the final model can be one thing that none of them
holds. Blind."""
MOST_TOGETHER = 4
"""Numbers of one thing that are tried together: members of a longer group of descriptions, priors of an element. Not
measured."""
MOST_FITTED = 4
"""Shapes of one effect from which it is fitted; other descriptions of the instrument that are fitted. Not measured."""
WITHIN = 8.0
"""Evidence below the best within which a rival is tried. Not measured."""
LINEAR_GOOD = 1.0
"""Evidence by which a fit may differ from its linear trial before rivals are fitted as well. Not measured."""
SAME_COUNTS = 0.01
"""Relative change of the counts up to which columns of an earlier model serve again. Not measured."""
POOR_FIT = 1.5
"""χ²/dof above which structural effects and other descriptions are tried. Not measured: no scene is so poor."""
GOOD_SHARE = 0.5
"""Share of the misfit that a name must explain for these not to be tried. Not measured."""

LINEAR_BELOW = 150.0
"""Evidence of the best above which rivals are tried down to `LINEAR_SHARE` of it less. Not measured."""
LINEAR_SHARE = 0.6
"""By which a fit may be better than its linear step there. Not measured."""
FLOOR = 1.25
"""Standard deviations of the residuals behind all candidates above which evidence counts in that unit. Not measured:
errors of all scenes are as stated."""

# ------------------------------------------------------------------------------------------------------- additions

LEAST_SHARE = 0.1
"""Share of the misfit that an addition must explain. Ablation: no gain where the fit is not poor."""
LEAST_SHARE_OF_NAME = 0.25
"""Of what is surely missing (2 σ of χ²) a name, where the fit is not poor: else it stands in for what has none.
Ablation."""
PART = 10.0
"""Factor by which names must bring down χ²/dof − 1 of a poor fit, else they are reported as parts, and not added; and
by which another reading of the data must, to be reported. Not measured."""
HOPEFUL = 1.0
"""Standard errors by which a sentence must predict unseen settings better, by its linear step, to be fitted. Not
measured."""

EVEN_ODDS = 3.0
"""Difference in evidence that is no preference; a description needs that much more than a name. More loss in ln p of
the exposures of one KIND, as those of others predict them, contradicts an addition. Not measured."""
IMPROBABLE = 6.9
"""Difference in evidence at which the other has a probability of 10⁻³: rivals are listed down to it, and members of a
class are averaged. Blind."""
SEPARATION = 3.0
"""Below it the data cannot distinguish two candidates. No plausible member of a class may lie farther from an element
of a trusted product, in its errors. Blind, limits."""
LEAST_EVIDENCE = 1.0
"""Evidence that an effect must be worth to the final model to stay in it. Not measured."""
USEFUL = 2.0
"""Standard errors by which a term without a name must predict unseen settings better to be kept. Not measured."""
HELD_OUT_WORSE = 0.01
"""Share by which exposures that were left out may be predicted worse after a diagnosis than before. Not measured."""
MOST_PATTERNS = 8
"""Patterns without a name beside which a candidate is asked. Not measured."""
MOST_CLASSES = 8
"""Rivals of one name, and names with rivals, that are listed. Not measured."""

# --------------------------------------------------------------------------------------------------------- reports

NEGLIGIBLE = 1e-4
"""Change of calibrated q and u that does not matter for an instrument good to 10⁻³."""
LARGEST_ROBUST_RATIO = 1.5
"""Of errors that allow for common disturbances of an exposure, to errors that do not. Not measured."""
SHOWN = 4
"""Alternatives that a sentence lists; files have all. Nothing depends on it."""
ROUNDING = 1e-9
"""Share below which a number is rounding. Nothing depends on it."""
LIMIT = 0.95
"""Probability with which an effect that was not found stays below its limit. Limits."""
PROBABILITY = 0.99
"""Probability with which an effect at its detection limit is detected. Limits."""

# --------------------------------------------------- other descriptions of the instrument, other readings of the data

LEAST_GAIN = 12.0
"""Gain in χ² behind one linear step above which a description is worth a fit. Not measured."""
READING_COARSE = 0.01
"""Share of the light that a fit of mixed-up data misses at least. Not measured."""
READING_ALIKE = 1.5
"""Factor in χ² within which two readings are both reported. Not measured."""
READING_SURE = 1.2
"""χ²/dof up to which another reading explains the data to the noise, before anything is looked for. Not measured."""

# ------------------------------------------------------------------------------------------------ candidates and time

MOST_FITS = 40
"""Exact fits of additions in one diagnosis, after which nothing further is tried. Not measured."""
MOST_FITS_FAR_OFF = 12
"""The same where the model is so far from the data that errors were scaled (`fit.search.FAR_OFF`). Not measured."""

RINGS = (3, 4, 5, 6, 7, 8)
"""Degrees of patterns of rings about the centre of the field; the throughput absorbs smoother ones."""
ASKED_BY_CAMERA = ("pedestal", "nonlinearity")
"""Effects that are asked camera by camera, under their names there."""


def in_use() -> dict[str, float]:
    """The thresholds by name."""
    return {
        name.lower(): value
        for name, value in globals().items()
        if name.isupper() and isinstance(value, int | float)
    }
