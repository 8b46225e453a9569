"""What is missing, and which candidate it is: the most probable set of things, by exact evidence of linear steps.

One fit leaves residuals. A *thing* is one cause of what they show; a *candidate* is one way to say it: a shape of an
effect of the catalogue, a description, a part of an effect, a pattern without a name. "A ghost, and a camera that is
not linear" are two things; for the first of them "ghost" and four descriptions of added light may be candidates.

Prior        One thing more is missing with probability 1 − ν. It is of one of K kinds, equally probable: each effect
             is a kind, all descriptions together are one, all parts, all patterns; the candidates of a kind share its
             probability π. Amplitudes are N(0, t²w²) with prior widths w and scales t (`score.SCALES`), all equally
             probable; t = 1 for a single amplitude. An amplitude that physics keeps above 0 has the positive half of
             that normal distribution as its prior, with twice the density.
Evidence     For a set M of candidates, with A their columns once the free parameters are projected out, G = AᵀA and
             s = Aᵀr in units of the scatter that all candidates leave, T = t²w²:

                 ln B(M) = ½ sᵀT^½ (1 + T^½GT^½)⁻¹ T^½s − ½ ln det(1 + T^½GT^½)

             Every other candidate is scored in the model with M by the same formula, once the parts of G and s that
             M explains are subtracted. The posterior of M is proportional to B(M) Π π (1 − ν)/ν.
Search       Asked once the scores have raised the alarm: the first thing need only be more probable than nothing. The
             most probable candidate is added until something more is missing with a probability below λ. After
             each addition every member is taken out in turn, and the most probable candidate beside the others takes
             its place, until nothing changes; a member that is less probable than its absence goes. Searches that begin
             with a part of the candidates (names; effects alone) find sets that no exchange of one member leads to.
Who it is    The *set* of a thing, given the other things, is the shortest list of names that holds it with probability
             λ, by either of two priors: the one above, in which one description has a thousandth of the probability of
             a name, since there are thousands of them; and one in which all names and all descriptions are equally
             probable. Whether something is missing depends on the price of trials; which candidate it is need not.
Limits       Linear steps from one fit: right where the residuals of the fit are small, or where all columns are linear.
             A posterior over a list knows nothing of what is not in the list.
Sources      Dickey 1971, Ann. Math. Stat. 42, 204 (evidence of nested models); Liang et al. 2008, JASA 103, 410
             (mixtures of priors); Mitchell & Beauchamp 1988, JASA 83, 1023 (spike and slab); the set of one thing given
             the others: Wang et al. 2020, JRSS B 82, 1273 (credible sets of SuSiE, whose sum of single effects is
             replaced by exact evidence with exchange).
"""

from __future__ import annotations

import collections
import dataclasses
import functools
from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import linalg, special

from walop_jax.diagnosis import thresholds
from walop_jax.diagnosis.examination import Evidence
from walop_jax.diagnosis.hypotheses import Probe
from walop_jax.diagnosis.score import SCALES
from walop_jax.io.shapes import AnyMatrix, AnyVector
from walop_jax.model.effects import Described

MOST_EXCHANGES = 10  # rounds after one addition; only candidates that are equal would change places for ever

SetMember = tuple[int, float]
"""A candidate by its position, and the scale t of the prior of its amplitudes."""


@dataclasses.dataclass(frozen=True)
class Thing:
    """One missing cause: its most probable candidate, and all names that it may have, given the other things.

    `candidate` is the probe, or the name of the pattern, with the largest posterior probability; `log_evidence` is its
    ln B beside the other things, in units of the scatter behind all candidates. `probabilities` are those of all names
    of effects and of all descriptions, the most probable first; `equal` the same, were all of them equally probable
    beforehand. `shapes` are the shapes (probes) that each name of the set may have: the shortest list that holds
    `thresholds.CERTAIN` of its probability. `patterns` is ln [P(the thing is a pattern without a name) / P(it has one
    of the names)].
    """

    candidate: Probe | str
    log_evidence: float
    probabilities: Mapping[str, float]
    equal: Mapping[str, float]
    shapes: Mapping[str, tuple[Probe, ...]]
    patterns: float = -np.inf

    @property
    def is_pattern(self) -> bool:
        """True if the most probable candidate is a pattern: more probable than every single shape of a name."""
        return isinstance(self.candidate, str)

    @property
    def names(self) -> tuple[str, ...]:
        """The set of the thing: names that hold it with the probability `thresholds.CERTAIN`, by either prior."""
        return tuple(dict.fromkeys([*_shortest(self.probabilities), *_shortest(self.equal)]))


@dataclasses.dataclass(frozen=True)
class MissingThings:
    """The most probable set of things that are missing in one fit, the one with the most evidence first.

    `nothing_more` is the probability that nothing is missing beside them.
    """

    things: tuple[Thing, ...]
    nothing_more: float


def most_probable(evidence: Evidence) -> MissingThings:
    """The most probable set of things that are missing in a fit, whose scores have raised the alarm."""
    return JointScores(evidence).posterior()


# Products of columns of candidates of one size that are worked on at once: 8 MB of each array.
TOGETHER = 1_000_000


class JointScores:
    """All candidates of one fit, ready to be scored beside any few of them.

    Columns are in prior widths, and residuals in units of the scatter behind all candidates. Amplitudes that these data
    cannot show (`ScoreSpace.alive`) are 0.
    """

    def __init__(self, evidence: Evidence) -> None:
        space, smooth, self._evidence = evidence.space, evidence.smooth, evidence
        self.probes: dict[str, Probe] = {probe.name: probe for probe in evidence.asked}
        self._noise = evidence.table.noise_scale
        names, sizes, scores = list(space.names), np.array(space.sizes), np.asarray(evidence.scores)
        self.widths = np.where(space.alive, space.widths, 0.0)
        if smooth is not None:
            # The descriptions of a smooth field, which are 28 or more, are made when it is fitted.
            self.probes |= {name: Probe(name, Described, ()) for name in smooth.names}
            names, sizes = [*names, *smooth.names], np.concatenate([sizes, smooth.sizes])
            self.widths = np.concatenate([self.widths, smooth.widths])
            scores = np.concatenate([scores, smooth.scores])
        self.names = tuple(names)
        self.scores = scores * self.widths / self._noise**2
        stop = np.cumsum(sizes).tolist()
        self._places = [slice(int(b - k), b) for b, k in zip(stop, sizes, strict=True)]
        grams = [space.gram[at, at] for at in space.places().values()] + (
            [] if smooth is None else smooth.grams
        )
        self.one_sided = np.zeros(len(self.widths), bool)
        kinds = collections.defaultdict[str, list[int]](list)
        for number, name in enumerate(self.names):
            probe = self.probes.get(name)
            if probe is not None and probe.group:
                self.one_sided[self._places[number]] = probe.one_sided
            kinds[_kind(probe)].append(number)
        self.log_prior = np.zeros(len(self.names))
        for members in kinds.values():
            self.log_prior[members] = -np.log(len(kinds)) - np.log(len(members))
        self._shown = np.array([np.count_nonzero(self.widths[place]) for place in self._places])
        self._blocks = [
            (chosen, *self._block(chosen, grams))
            for size in np.unique(sizes)
            for alike in [np.flatnonzero(sizes == size)]
            for chosen in np.array_split(
                alike[np.argsort(self._shown[alike], kind="stable")],
                min(len(alike), -(-len(alike) * int(size) ** 2 // TOGETHER)),
            )
        ]
        self.scales_of = np.where(sizes > 1, len(SCALES), 1)
        effects = {name for name, probe in self.probes.items() if probe.effect is not Described}
        self._is_named = np.array([name in self.probes for name in self.names])
        self._is_effect = np.array([name in effects for name in self.names])
        self._products: dict[int, AnyMatrix] = {}
        self._sizes = sizes
        self._known: dict[tuple[frozenset[SetMember], bytes], Float[np.ndarray, "n t"]] = {}

    def _block(
        self, chosen: Int[np.ndarray, " n"], grams: Sequence[AnyMatrix]
    ) -> tuple[Int[np.ndarray, "n k"], Float[np.ndarray, "n k k"]]:
        """Positions of the amplitudes of candidates of one size, and products of the columns of each.

        Amplitudes that the data cannot show have no influence. They are left out, but for as many as it takes to have
        the same number of all these candidates.
        """
        size = max(1, self._shown[chosen].max())
        inside = [np.argsort(self.widths[self._places[n]] == 0.0, kind="stable")[:size] for n in chosen]
        at = np.array([self._places[n].start + own for n, own in zip(chosen, inside, strict=True)])
        gram = np.stack([grams[n][np.ix_(own, own)] for n, own in zip(chosen, inside, strict=True)])
        return at, gram * self.widths[at][:, :, None] * self.widths[at][:, None, :] / self._noise**2

    def _products_with(self, number: int) -> Float[np.ndarray, "a k"]:
        """Products of the columns of all candidates with those of one."""
        if number not in self._products:
            products = self._evidence.products_with(self.names[number])
            own = self.widths[self._places[number]]
            self._products[number] = products * (self.widths[:, None] * own / self._noise**2)
        return self._products[number]

    # --------------------------------------------------------------------------------------------- evidence

    def beside(
        self, members: Sequence[SetMember], allowed: Bool[np.ndarray, " n"] | None = None
    ) -> Float[np.ndarray, "n t"]:
        """ln B of every candidate at each scale of its prior, in a model with `members`; −∞ where it has none.

        Only candidates that are `allowed` are asked (None: all); the others have −∞.

        With the products G and scores s of a candidate in prior widths, beside the members, and the scale t

            ln B = ½ t² sᵀ (1 + t² G)⁻¹ s − ½ ln det(1 + t² G)
        """
        asked = frozenset(members), b"" if allowed is None else allowed.tobytes()
        if asked not in self._known:  # an exchange asks for the same few sets again and again
            self._known[asked] = self._evidence_beside(members, allowed)
        return self._known[asked]

    def _evidence_beside(
        self, members: Sequence[SetMember], allowed: Bool[np.ndarray, " n"] | None
    ) -> Float[np.ndarray, "n t"]:
        along, taken = self._taken_up(members, allowed)
        scores = self.scores - along @ taken
        found = np.full((len(self.names), len(SCALES)), -np.inf)
        for chosen, at, gram in self._blocks:
            if allowed is not None:
                some = allowed[chosen]
                chosen, at, gram = chosen[some], at[some], gram[some]
            size = at.shape[1]
            left, s = gram - along[at] @ along[at].swapaxes(1, 2), scores[at]
            # Below the root of 1 + t² G that of a matrix with t s for its last row has the part of s that is explained.
            whole, inside = (
                np.empty((len(chosen), size + 1, size + 1)),
                (slice(None), slice(size), slice(size)),
            )
            for column, t in enumerate(SCALES[: self.scales_of[chosen].max(initial=0)]):
                whole[inside] = np.eye(size) + t**2 * left
                whole[:, size, :size] = whole[:, :size, size] = t * s
                whole[:, size, size] = 1.0 + t**2 * np.sum(s**2, axis=1)
                below = np.linalg.cholesky(whole)
                root, pull = below[inside], below[:, size, :size]
                log_root = np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
                found[chosen, column] = 0.5 * np.sum(pull**2, axis=1) - log_root
                if (one_sided := self.one_sided[at]).any():
                    inverse = np.linalg.inv(root)
                    covariance = t**2 * inverse.swapaxes(1, 2) @ inverse
                    found[chosen, column] += _on_its_side(one_sided, covariance, s)
        return found

    def _taken_up(
        self, members: Sequence[SetMember], allowed: Bool[np.ndarray, " n"] | None
    ) -> tuple[Float[np.ndarray, "a m"], AnyVector]:
        """The part of all columns, and of the scores, that `members` explain; 0 for candidates that are not allowed."""
        if not members:
            return np.zeros((len(self.widths), 0)), np.zeros(0)
        places = [self._places[number] for number, _ in members]
        at = np.concatenate([np.arange(place.start, place.stop) for place in places])
        scale = np.concatenate(
            [np.full(p.stop - p.start, t) for p, (_, t) in zip(places, members, strict=True)]
        )
        of_members = [self._products_with(number) for number, _ in members]
        own = np.concatenate([products[at] for products in of_members], axis=1) * scale
        root = np.linalg.cholesky(own * scale[:, None] + np.eye(len(at)))
        # ½ a m² multiplications each, where a general solution takes four times as many.
        solve = functools.partial(linalg.solve_triangular, root, lower=True, check_finite=False)
        taken = solve(scale * self.scores[at])
        rows = slice(None) if allowed is None else np.repeat(allowed, self._sizes)
        products = np.concatenate([one[rows].T for one in of_members], axis=0) * scale[:, None]
        along = solve(products, overwrite_b=True).T
        if allowed is None:
            return along, taken
        of_all = np.zeros((len(self.widths), len(at)))
        of_all[rows] = along
        return of_all, taken

    def over_scales(self, found: Float[np.ndarray, "n t"]) -> AnyVector:
        """ln B of every candidate, averaged over the scales."""
        return np.logaddexp.reduce(found, axis=1) - np.log(self.scales_of)

    # ------------------------------------------------------------------------------------------- the search

    def posterior(self) -> MissingThings:
        """The most probable set of things.

        A candidate with many numbers takes in two things at once, and no exchange of one member for another leads from
        there to two names. Where the most probable set has a pattern, or a description, further searches therefore
        begin with effects alone and with names alone; of all sets the most probable counts.
        """
        members = self._grown([])
        for begin in (self._is_named, self._is_effect):
            if not all(begin[number] for number, _ in members):
                members = max(members, self._grown(self._grown([], begin)), key=self._total)
        nothing_more = float(special.expit(-(self._best(members)[2] + _odds())))
        things = sorted(self._things(members), key=lambda thing: -thing.log_evidence)
        return MissingThings(tuple(things), nothing_more)

    def _grown(
        self, members: list[SetMember], allowed: Bool[np.ndarray, " n"] | None = None
    ) -> list[SetMember]:
        """A set to which things are added, with exchanges, until nothing more is missing; of candidates `allowed`."""
        for _ in range(thresholds.MOST_STEPS):  # an exchange may drop a member, which is added again for ever
            best, _, total = self._best(members, allowed)
            something_more = special.expit(total + _odds())
            # That one thing is missing the alarm has said: it need only be more probable than nothing.
            least = thresholds.CERTAIN if members else 0.5
            if something_more < least or len(members) == thresholds.MOST_STEPS:
                break
            members = self._exchanged([*members, best], allowed)
        return members

    def _total(self, members: Sequence[SetMember]) -> float:
        """ln of the posterior of a set, but for a constant of all sets."""
        total = 0.0
        for count, (number, scale) in enumerate(members):
            bayes = self.beside(members[:count])[number, int(np.argmax(scale == SCALES))]
            total += float(bayes + self.log_prior[number] - np.log(self.scales_of[number])) + _odds()
        return total

    def _odds_of_patterns(self, worth: AnyVector) -> float:
        """ln [P(any pattern) / P(any name)]; `worth` is ln B π of every candidate."""
        return _log_sum(worth[~self._is_named]) - _log_sum(worth[self._is_named])

    def _best(
        self, members: Sequence[SetMember], allowed: Bool[np.ndarray, " n"] | None = None
    ) -> tuple[SetMember, float, float]:
        """The most probable candidate for a model that has `members`, ln B π of it, and ln Σ B π over all candidates.

        Candidates are those `allowed`; None: all.
        """
        found = self.beside(members, allowed)
        worth = self.over_scales(found) + self.log_prior
        worth[[number for number, _ in members]] = -np.inf
        number = int(np.argmax(worth))
        scale = float(SCALES[np.argmax(found[number])])
        return (number, scale), float(worth[number]), _log_sum(worth)

    def _exchanged(
        self, members: list[SetMember], allowed: Bool[np.ndarray, " n"] | None = None
    ) -> list[SetMember]:
        """The members, each replaced by the most probable candidate beside the others, until nothing changes."""
        for _ in range(MOST_EXCHANGES):
            before = list(members)
            for member in before:
                others = [one for one in members if one != member]
                best, worth, _ = self._best(others, allowed)
                replaced = [best if one == member else one for one in members]
                members = replaced if worth + _odds() >= 0.0 else others
            if members == before or len(members) < 2:
                break
        return members

    def _things(self, members: Sequence[SetMember]) -> Iterator[Thing]:
        """The things of a set, each with its names."""
        for member in members:
            others = [one for one in members if one != member]
            bayes = self.over_scales(self.beside(others))
            bayes[[number for number, _ in others]] = -np.inf
            worth = bayes + self.log_prior
            number = int(np.argmax(worth))
            name, patterns = self.names[number], self._odds_of_patterns(worth)
            yield Thing(self.probes.get(name, name), float(bayes[number]), *self._named(bayes), patterns)

    def _named(
        self, bayes: AnyVector
    ) -> tuple[dict[str, float], dict[str, float], dict[str, tuple[Probe, ...]]]:
        """Probabilities of all names by their own and by equal priors, and the shapes of names of the set."""
        worth = bayes + self.log_prior
        of_name = collections.defaultdict[str, list[int]](list)
        for number, name in enumerate(self.names):
            for called in _called(self.probes[name]) if name in self.probes else ():
                of_name[called].append(number)
        by_prior = _normalised({called: _log_sum(worth[of]) for called, of in of_name.items()})
        equal = _normalised({called: _log_sum(bayes[of]) - np.log(len(of)) for called, of in of_name.items()})
        shapes = {
            called: tuple(
                self.probes[name]
                for name in _shortest(_normalised({self.names[k]: float(bayes[k]) for k in of_name[called]}))
            )
            for called in {*_shortest(by_prior), *_shortest(equal)}
        }
        return by_prior, equal, shapes


def _odds() -> float:
    """ln of the odds beforehand that one thing more is missing."""
    return float(np.log(1.0 - thresholds.NOTHING_MORE) - np.log(thresholds.NOTHING_MORE))


def _on_its_side(
    one_sided: Bool[np.ndarray, "n k"],
    covariance: Float[np.ndarray, "n k k"],
    scores: Float[np.ndarray, "n k"],
) -> AnyVector:
    """ln of the probability that one-sided amplitudes are above 0, by data and prior against the prior alone.

    Exact for one amplitude; several are independent here. `covariance` is that of the amplitudes by data and prior.
    """
    mean = -np.einsum("nij,nj->ni", covariance, scores)
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    above = np.log(2.0) + special.log_ndtr(mean / sigma)
    return np.sum(np.where(one_sided, above, 0.0), axis=1)


def _log_sum(logs: Iterable[float]) -> float:
    return float(np.logaddexp.reduce([*logs, -np.inf]))


def _normalised(logs: Mapping[str, float]) -> dict[str, float]:
    """Probabilities, the largest first, from their logarithms but for a constant."""
    whole = _log_sum(logs.values())
    return {
        name: float(np.exp(logs[name] - whole)) for name in sorted(logs, key=logs.__getitem__, reverse=True)
    }


def _shortest(probabilities: Mapping[str, float]) -> tuple[str, ...]:
    """The shortest list that holds `thresholds.CERTAIN`; the most probable come first already."""
    held = np.cumsum(list(probabilities.values()))
    return tuple(probabilities)[: int(np.searchsorted(held, thresholds.CERTAIN)) + 1]


def _is_nameless(probe: Probe) -> bool:
    return probe.effect is Described and not probe.holders


def _called(probe: Probe) -> tuple[str, ...]:
    """Names of a candidate: its effect, its descriptions, or the effects of which it is a part."""
    if probe.effect is not Described:
        return (probe.effect.name,)
    return tuple(sorted(effect.name for effect in probe.holders)) or (probe.name,)


def _kind(probe: Probe | None) -> str:
    """The kind of things that a candidate is of; None is a pattern."""
    if probe is None:
        return "a pattern"
    if probe.effect is not Described:
        return f"the effect {probe.effect.name}"
    return "a description" if _is_nameless(probe) else "a part of an effect"
