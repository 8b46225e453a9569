"""A sentence that holds a part of two effects at once does not come before them; one that holds the truth does.

Columns are unit vectors and prior widths large, so that the evidence of a direction is half the square of what it
holds, less a constant: the numbers are those of plain geometry.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from walop_jax.diagnosis.examination import name_first
from walop_jax.diagnosis.hypotheses import Probe, Ranked
from walop_jax.diagnosis.score import Score
from walop_jax.model.effects import Described, effect_by_name

A, B, ELSEWHERE = np.eye(3)
PRICE = 3.0  # of one amplitude
LEAST = 9.0  # square that is significant
KINDS = {"a": effect_by_name("clp_zero"), "b": effect_by_name("ghost"), "sentence": Described}


class Geometry:
    """Two names and a sentence, each a direction, before residuals."""

    def __init__(self, said: np.ndarray, residual: np.ndarray) -> None:
        self.directions = {"a": A, "b": B, "sentence": said / np.linalg.norm(said)}
        self.residual = residual

    def ranked(self, names: tuple[str, ...], taken: np.ndarray | None = None) -> list[Ranked]:
        found = []
        for name in names:
            d, r = self.directions[name], self.residual
            if taken is not None:
                d = d - taken * (taken @ d)
                r = r - taken * (taken @ r)
                if np.linalg.norm(d) < 1e-9:
                    continue
                d = d / np.linalg.norm(d)
            square, one = float(d @ r) ** 2, np.ones(1)
            score = Score(name, square, 1, 0.0, 0.0, one, np.eye(1), 0.0, True)
            found.append(Ranked(KINDS[name], Probe(name, KINDS[name], ()), score, 0.5 * square - PRICE))
        return sorted(found, key=lambda item: -item.log_bayes)

    def joined(self, item: Ranked) -> SimpleNamespace:
        d = self.directions[item.probe.name]
        left = self.residual - d * (d @ self.residual)
        names, told = self.ranked(("a", "b"), d), self.ranked(("sentence",), d)
        return SimpleNamespace(ranked=names, told=told, alarm=left @ left >= LEAST)

    def name_first(self) -> bool:
        names, sentence = self.ranked(("a", "b")), self.ranked(("sentence",))[0]
        assert sentence.log_bayes > names[0].log_bayes
        return name_first(names, sentence, self.joined)


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_two_effects_come_before_a_sentence_that_holds_a_part_of_each(share):
    assert Geometry(A + B + share * ELSEWHERE, 10.0 * (A + B)).name_first()


def test_a_sentence_that_holds_all_comes_before_two_names():
    assert not Geometry(A + B, 10.0 * (A + B)).name_first()
    assert not Geometry(A + B + ELSEWHERE, 10.0 * (A + B + ELSEWHERE)).name_first()


def test_a_name_that_suffices_comes_before_a_sentence_that_does_not():
    geometry = Geometry(A + B, 10.0 * A)
    names, sentence = geometry.ranked(("a", "b")), geometry.ranked(("sentence",))[0]
    assert name_first(names, sentence, geometry.joined)
    assert not name_first([], sentence, geometry.joined)
