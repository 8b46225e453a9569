"""All thresholds of a diagnosis in one record; `diagnosis.json` says which were used (key `policy`).

The blind study (`tests/diagnosis/blind.py`) measures what they lead to.
"""

from __future__ import annotations

import dataclasses
from typing import Any


@dataclasses.dataclass(frozen=True)
class Policy:
    """When something is missing, what may be named, and what is fitted before it is.

    Evidence is ln B, a logarithm of a ratio of probabilities; separations are in standard deviations.
    """

    # Is anything missing?
    alarm: float = 0.0027
    """Global p below which something is missing, and corrected p below which a candidate is significant: 3 σ."""
    common_mode: float = 0.05
    """rms (σ of one intensity) of disturbances that one camera in one exposure may have."""
    floor: float = 1.25
    """Standard deviations of what is left behind all candidates above which evidence counts in that unit."""

    # Which candidates are tried?
    most_leaders: int = 5
    """Names of one step."""
    most_sentences: int = 2
    """Sentences of one step; more of them in the final model can be one thing that no sentence holds."""
    most_together: int = 4
    """Sentences of a longer group that are tried by themselves."""
    most_shapes: int = 4
    """Shapes of one effect from which it is fitted."""
    within: float = 8.0
    """Evidence below the best within which a rival is tried."""
    linear_below: float = 150.0
    """Evidence of the best above which rivals are tried down to `linear_share` of it less."""
    linear_share: float = 0.6
    linear_good: float = 1.0
    """Evidence by which a fit may differ from its linear trial before rivals are fitted as well."""
    same_counts: float = 0.01
    """Relative change of the counts up to which columns of an earlier model serve again."""
    poor_fit: float = 1.5
    """χ²/dof above which what cannot be differentiated is tried: structural effects, other descriptions."""
    good_share: float = 0.5
    """Share of what is missing that a name must explain for these not to be tried."""

    # What is worth telling?
    even_odds: float = 3.0
    """Difference in evidence that is no preference; a sentence needs that much more than a name."""
    improbable: float = 6.9
    """Difference in evidence at which the other has a probability of 10⁻³: rivals are told down to it."""
    separation: float = 3.0
    """Below it the data cannot tell two candidates apart."""
    least_share: float = 0.1
    """Share of what is missing that an addition must explain."""
    least_share_of_name: float = 0.25
    """Of what is surely missing (2 σ of χ²) a name, where the fit is not poor: else it stands in for what has none."""
    least_evidence: float = 1.0
    """Evidence that an effect must be worth to the final model to stay in it."""
    part: float = 10.0
    """Factor by which names must bring down χ²/dof − 1 of a poor fit; else they are told as parts, and not added."""
    hopeful: float = 1.0
    """Standard errors by which a sentence must predict unseen settings better, by its linear step, to be fitted."""
    useful: float = 2.0
    """Standard errors by which a term without a name must predict unseen settings better to stay in the model."""
    contradicted: float = 3.0
    """Loss in ln p of the exposures of one KIND, as those of others predict them, above which nothing is adopted."""
    held_out_worse: float = 0.01
    """Share by which exposures that were left out may be predicted worse after a diagnosis than before."""
    most_patterns: int = 8
    most_classes: int = 8
    negligible: float = 1e-4
    """Change of calibrated q and u that does not matter for an instrument good to 10⁻³."""
    most_names: int = 2
    """Names above which a single effect that nobody thought of is as likely."""
    largest_robust_ratio: float = 1.5
    """Of errors that allow for common disturbances of an exposure, to errors that do not."""
    limit: float = 0.95
    """Probability with which an effect that was not found stays below its limit."""

    # Other descriptions of the instrument
    descriptions_fitted: int = 4
    least_gain: float = 12.0
    """Gain in χ² behind one linear step above which a description is worth a fit."""

    # Other readings of the data
    reading_coarse: float = 0.01
    """Share of the light that a fit of mixed-up data misses at least."""
    reading_gain: float = 10.0
    """Factor by which a reading must bring down χ²/dof − 1 to be told."""
    reading_alike: float = 1.5
    """Factor in χ² within which two readings are both told."""
    reading_sure: float = 1.2
    """χ²/dof up to which another reading explains the data to the noise, before anything is looked for."""

    # How long?
    most_steps: int = 6
    minutes: float = 20.0
    """Time after which nothing further is tried."""
    minutes_far_off: float = 5.0
    """The same where the model is so far from the data that their errors were scaled (`fit.search.FAR_OFF`)."""

    def document(self) -> dict[str, Any]:
        """The thresholds by name."""
        return dataclasses.asdict(self)


POLICY = Policy()
ALARM = POLICY.alarm

RINGS = (3, 4, 5, 6, 7, 8)
"""Degrees of patterns of rings about the centre of the field; the throughput takes up what is smoother."""

PROBABILITY = 0.99
"""Probability with which an effect at its detection limit is detected."""

ASKED_BY_CAMERA = ("pedestal", "nonlinearity")
"""Effects that are asked camera by camera, under the names of what they are there."""
