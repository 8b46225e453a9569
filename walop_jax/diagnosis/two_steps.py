"""What two steps explain: a sentence may hold a part of two effects at once, and alone be more probable than either.

Compared are therefore ln B(first) + ln B(second behind first) − ln(names), the second step of a name being a name, that
of a sentence anything, by linear steps. Where two names are the more probable, the sentence does not come before them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from walop_jax.diagnosis import naming


class Behind(NamedTuple):
    """Names and sentences in order of evidence, and the global p of what is left, once one of them is in the model."""

    names: Sequence[naming.Ranked]
    sentences: Sequence[naming.Ranked]
    p_global: float


def _worth(first: naming.Ranked, second: Sequence[naming.Ranked], names: int) -> float:
    gain = max((item.log_bayes for item in second), default=0.0) - float(np.log(max(names, 1)))
    return first.log_bayes + max(gain, 0.0)


def name_first(
    names: Sequence[naming.Ranked],
    sentence: naming.Ranked,
    behind: Callable[[naming.Ranked], Behind],
    alarm: float,
) -> bool:
    """Whether significant `names` come before a more probable sentence.

    They do where the best of them leaves nothing significant (p < `alarm`) and the sentence does, or where two of them
    are more probable than the sentence with whatever is best behind it.
    """
    if not names:
        return False
    said = behind(sentence)
    least = _worth(sentence, [*said.names[:1], *said.sentences[:1]], len(said.names))
    for name in naming.leaders(names):
        left = behind(name)
        if name is names[0] and said.p_global < alarm <= left.p_global:
            return True
        if _worth(name, left.names[:1], len(left.names)) > least:
            return True
    return False
