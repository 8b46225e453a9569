"""A blind suite at the level of scores: thousands of hidden effects through the search of `diagnose`, no refits.

One design (a simulated calibration set, its Jacobian, the columns of every effect and pattern) spans a space of a
thousand dimensions; what lies outside is pure noise. Scenes are drawn there: Gaussian noise plus an effect of known
signal-to-noise ratio behind the projection. They go through the search that `diagnose` runs (`diagnosis.search`), with
its judge by linear steps in the place of the one that fits.
Verdicts are written before the truths are opened. In some scenes the effect that is hidden is taken out of the
catalogue: then the sentences that it is are asked for (`EFFECTS`, `as_descriptions`), and no other name.

    PYTHONPATH=tests python tests/diagnosis/blind.py [scenes per effect and ratio] [OUT.json] [processes]
"""

from __future__ import annotations

import collections
import dataclasses
import functools
import hashlib
import itertools
import json
import math
import multiprocessing
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from linear_judge import Linear, joined

from walop_jax.data.records import CalibrationSet
from walop_jax.diagnosis import grammar, thresholds
from walop_jax.diagnosis.design import LIGHT, SINGLE_EXPOSURES, Measured
from walop_jax.diagnosis.exact import Trial
from walop_jax.diagnosis.examination import Evidence, Examination, common_mode, examine
from walop_jax.diagnosis.hypotheses import Hypotheses, Probe, Ranked, probes, texts_of
from walop_jax.diagnosis.score import ScoreSpace, separations
from walop_jax.diagnosis.search import State, search
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import FitResult, fit
from walop_jax.likelihood.flux import project_flux
from walop_jax.likelihood.inverses import whitening
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.model.effects import EFFECTS, Described
from walop_jax.model.effects.in_models import effect_context

Examined = Callable[..., Examination]
Spaces = dict[tuple[tuple[str, ...], tuple[str, ...]], ScoreSpace]
"""Spaces of searches, by what was taken out of the catalogue and what was added."""

SEPARABLE = 5.0  # σ between the truth and its nearest rival above which a name is asked for
CONFOUNDED = 2.0  # below which a class is asked for
PLAUSIBLE = 5.0  # prior widths that a hidden amplitude may have
DRAWS = 3000
KEPT = 20  # spaces of scenes alike; each takes some 40 MB
TOGETHER = 20  # scenes
WITHOUT_ENTRY = 6  # scenes of one kind and ratio


@dataclasses.dataclass(frozen=True)
class Scene:
    """What is hidden (effect names, or the label of an outside shape), and how it looks.

    `coordinates` are the residuals in the space of all columns, `rest` the squared length of what lies outside.
    `separation` is that of the truth from its nearest rival, by design.
    """

    kind: str
    truth: tuple[str, ...]
    ratio: float
    coordinates: np.ndarray
    rest: float
    separation: float = np.inf
    amplitudes: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0))
    probe: str = ""
    removed: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What the rules say of a scene; `said` are the sentences that were added, `classes` hold names and sentences."""

    kind: str
    named: tuple[str, ...]
    classes: tuple[frozenset[str], ...]
    said: tuple[str, ...] = ()
    first_probe: str = ""
    amplitudes: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0))
    covariance: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 0)))
    added: tuple[str, ...] = ()  # probes
    probability: float = 1.0  # of the names together, each among all names of its thing


# What each shape outside the catalogue is in sentences, with a blank at the end: from or to any time; none: no sentence
# holds it.
OUTSIDE: dict[str, tuple[str, ...]] = {
    "film that turns with X": ("turn of polariser * x",),
    "encoder twice per turn": ("turn of polariser * sin 2 CLP",),
    "encoder four times per turn": ("turn of polariser * sin 4 CLP",),
    "encoder wrong in a run of exposures": ("turn of polariser * hours ",),
    "retarder of half2 with a polishing error": (),
    "vignetting of half1": ("gain of half1 * ring 3",),
    "cross-talk of read-outs": ("light of O2 in O1",),
    "persistence": ("afterglow in E1",),
    "quadratic non-linearity": ("gain of O2 * counts", "nonlinearity"),
    "one camera in two exposures": ("gain of E1 * exposure 4", "gain of E1 * exposure 9"),
    "background that varies": (),
    "image shift by the polariser": tuple(
        f"gain of {camera} * cos 1 CLP * {along}"
        for camera, along in (("O1", "x"), ("O2", "x"), ("E1", "y"), ("E2", "y"))
    ),
    "ring": (),
    "step": (),
    "six times the angle": ("gain of O1 * cos 6 CLP",),
    "hysteresis": (),
    "sky gradient": ("gain of O1 * kind moon * x", "gain of E1 * kind moon * x"),
    "extinction that depends on the filter": (),
    "slip of the polariser in one exposure": ("turn of polariser * exposure 6",),
    "background that drifts": ("light in O1 * hours",),
    "camera that warms up": ("gain of E2 * kelvin",),
    "polariser that creeps": ("turn of polariser * hours",),
    "beam that wanders over the film": ("turn of polariser * cos 1 CLP * x",),
    "field that drifts": ("displacement x ahead of pupil * hours",),
    "encoder three times per turn": ("turn of polariser * sin 3 CLP",),
    "glue ahead of the Wollaston prism": ("retardance radial behind half1.plate",),
    "elliptical film": ("diattenuation v of polariser * x",),
    "dead columns": (),
    "flat field of the Moon sky": ("gain of E1 * kind moon * x",),
    "focus that drifts": ("gain of O1 * hours * r2",),
    "field point on a polarised star": (),
}


def truth_of(name: str, sentences: Iterable[str]) -> set[str]:
    """The sentences that a shape outside the catalogue is, of all that there are."""
    begun = tuple(text for text in OUTSIDE[name] if text.endswith(" "))
    return {*OUTSIDE[name]} - {*begun} | {text for text in sentences if text.startswith(begun)}


def outside(measured: Measured, said: dict[str, np.ndarray]) -> Iterator[tuple[str, np.ndarray]]:
    """Shapes that are in no catalogue, with their columns; `said` are those of single sentences."""
    e, points = measured.likelihood.calset.exposures, measured.likelihood.calset.points
    point, exposure = (np.repeat(at, measured.cameras) for at in np.nonzero(measured.used))
    shape = (len(points), len(e), measured.cameras)
    x, y = points.x / 0.3, points.y / 0.3
    r, camera = np.hypot(points.x, points.y), np.eye(measured.cameras)[:, None, None]
    through = e.clp_in
    angle = np.deg2rad(np.where(through, e.clp_angle, 0.0))
    sky = (e.kind == "moon") & ~through
    narrow = np.where(e.filter == e.filter[0], 0.3, 1.0)
    drawn = np.random.default_rng(5).standard_normal(len(e))
    gains = {
        "vignetting of half1": np.maximum(r - 0.22, 0.0)[:, None, None] * (camera[0] + camera[1]),
        "image shift by the polariser": (
            x[:, None, None] * (camera[0] - camera[2]) + y[:, None, None] * (camera[1] + 0.5 * camera[3])
        )
        * np.where(through, np.cos(angle), 0.0)[None, :, None],
        "ring": np.exp(-((r - 0.2) ** 2) / (2 * 0.03**2))[:, None, None] * camera[2],
        "step": np.where(points.x > 0.05, 1.0, 0.0)[:, None, None] * camera[1],
        "hysteresis": np.where(through & (np.arange(len(e)) % 2 == 0), 1.0, 0.0)[None, :, None] * camera[3],
        "sky gradient": x[:, None, None] * sky[None, :, None] * (camera[0] - camera[1]),
        "dead columns": (np.abs(points.x - points.x[0]) < 1e-6)[:, None, None] * camera[1],
        "flat field of the Moon sky": x[:, None, None] * sky[None, :, None] * camera[1],
        "focus that drifts": (r**2 / 0.09 - 0.5)[:, None, None]
        * (e.mjd - e.mjd.mean())[None, :, None]
        * camera[0],
    }
    shares = {  # of the unpolarised light
        "background that varies": drawn[None, :, None] * np.ones(shape),
        "field point on a polarised star": (np.arange(len(points)) == len(points) // 3)[:, None, None]
        * sky[None, :, None]
        * (camera[0] - camera[1]),
    }
    counts = measured.flux[..., None] * measured.model  # in standard errors
    electrons = np.divide(counts, measured.weight, out=np.zeros_like(counts), where=measured.weight > 0)
    gains["quadratic non-linearity"] = electrons * camera[2]
    for name, gain in gains.items():
        projected = project_flux(gain * counts, measured.model, measured.known, measured.shared)
        yield name, -projected[measured.used].reshape(-1)
    for name, share in shares.items():
        yield name, measured.column(np.broadcast_to(share, shape), LIGHT)
    turn, narrowed = said["turn of polariser"], said["depolarisation of polariser"] * narrow[exposure]
    polish = (x**3 - 1.5 * x * y + 0.7 * y**2)[point]
    made = {
        "encoder wrong in a run of exposures": turn * np.isin(exposure, np.arange(4, 9)),
        "slip of the polariser in one exposure": turn * (exposure == 6),
        "extinction that depends on the filter": narrowed,
        "retarder of half2 with a polishing error": said["retardance u behind half2.plate"] * polish,
    }
    yield from made.items()
    for name, texts in OUTSIDE.items():
        if texts and name not in {*gains, *shares, *made} and set(texts) <= set(said):
            yield name, np.sum([said[text] for text in texts], axis=0)


def with_all_names(result: FitResult, hypotheses: Hypotheses, rng: np.random.Generator) -> Examination:
    """The examination in which synonyms are candidates of their own: each is hidden, and asked for, by its own name."""
    return examine(result, hypotheses, rng, synonyms_apart=True)


class Blind:
    """A design made ready for drawing and judging scenes."""

    def __init__(self, calset: CalibrationSet, seed: int = 1, examined: Examined = with_all_names) -> None:
        model = base_model(calset)
        result = fit(Likelihood.of(calset, model))
        self.rng = np.random.default_rng(seed)
        wanted = list(probes(EFFECTS, effect_context(model.template, calset.exposures)))
        self.context, self.template = effect_context(model.template, calset.exposures), model.template
        every = grammar.descriptions(model.template, calset.exposures, len(calset.points))
        examination = examined(result, Hypotheses(wanted, every), self.rng)
        self.descriptions = examination.descriptions
        self.probes = list(examination.probes)
        self.as_descriptions = {p.name: set(p.group[0].as_descriptions(model.template)) for p in self.probes}
        texts = [text for probe in self.descriptions for text in texts_of(probe)]
        self.as_descriptions |= {name: truth_of(name, texts) for name in OUTSIDE}
        self.effect_of = {p.name: p.effect.name for p in self.probes}
        self.space = examination.bare
        self.places = self.space.places()
        gram = np.asarray(self.space.gram)
        self._whitening = whitening(gram)
        self._root = gram @ self._whitening
        self.dimension = self._root.shape[1]
        self.outside = {}
        self.said = {
            text: column
            for probe in self.descriptions
            for text, column in zip(
                texts_of(probe), examination.candidates[probe.name].columns.T, strict=True
            )
        }
        for name, shape in outside(examination.design.measured, self.said):
            column = examination.design.projector(examination.design.stacked([shape[:, None]])[:, 0])
            products = examination.design.products(examination.columns, column)
            along = self._whitening.T @ products
            self.outside[name] = along, max(float(column @ column - along @ along), 0.0)
        explained = {*self.effect_of, *(probe.name for probe in self.descriptions)}
        self.patterns = [name for name in self.space.names if name not in explained]
        widths = common_mode(self.space, examination.design)
        self._behind_nuisance, self._reduce = self.space.with_base([SINGLE_EXPOSURES], widths)
        self.evidence = examination
        self._spaces: Spaces = {}
        self.free = examination.space.free
        self.visible = sorted({p.effect.name for p in self.probes if examination.table[p.name].testable})
        self._testable = {p.name for p in self.probes if examination.table[p.name].testable}

    # ------------------------------------------------------------------------------------------ drawing scenes

    def noise(self) -> tuple[np.ndarray, float]:
        """Residuals of a set in which nothing is missing."""
        return self.rng.standard_normal(self.dimension), float(self.rng.chisquare(self.free - self.dimension))

    def null(self) -> Scene:
        """Nothing missing."""
        return Scene("null", (), 0.0, *self.noise())

    def hidden(
        self, name: str, ratio: float, removed: tuple[str, ...] = (), kind: str = "named"
    ) -> Scene | None:
        """A named effect at a random shape and direction; None when no plausible amplitude reaches the ratio."""
        shapes = [p for p in self.probes if p.effect.name == name and p.name in self._testable]
        for _ in range(100):
            probe = shapes[self.rng.integers(len(shapes))]
            at, alive = self.places[probe.name], self.space.alive[self.places[probe.name]]
            gram = self.space.gram[at, at]
            step = self.rng.standard_normal(len(alive)) * self.space.widths[at] * alive
            step *= ratio / np.sqrt(step @ gram @ step)
            step = np.where(probe.one_sided, np.abs(step), step)
            if np.isclose(step @ gram @ step, ratio**2) and np.all(
                np.abs(step) <= PLAUSIBLE * self.space.widths[at]
            ):
                break
        else:
            return None
        change = -self.space.gram[:, at] @ step
        rivals = [p for p in self.probes if p.effect.name not in (name, *removed)]
        distance = separations(self.space.subset([p.name for p in rivals]), *self._of(change, rivals, ratio))
        z, rest = self.noise()
        return Scene(
            kind, (name,), ratio, z + self._whitening.T @ change, rest, min(distance.values()), step, probe.name,
            removed,
        )  # fmt: skip

    def _of(self, change: np.ndarray, rivals: Sequence[Probe], ratio: float) -> tuple[np.ndarray, float]:
        return change[self.space.chosen([p.name for p in rivals])], ratio**2

    def pair(self, ratio: float) -> Scene:
        """Two effects, each with the signal-to-noise ratio that is asked for by itself."""
        a = b = None
        while a is None or b is None:
            first, second = self.rng.choice(len(self.visible), 2, replace=False)
            a = self.hidden(self.visible[first], ratio)
            b = self.hidden(self.visible[second], ratio)
        z, rest = self.noise()
        signal = [
            -self._whitening.T @ self.space.gram[:, self.places[s.probe]] @ s.amplitudes for s in (a, b)
        ]
        truth = (*a.truth, *b.truth)
        return Scene("pair", truth, ratio, z + signal[0] + signal[1], rest, min(a.separation, b.separation))

    def strange(self, name: str, ratio: float) -> Scene:
        """A shape that is in no catalogue."""
        along, beyond = self.outside[name]
        length = np.sqrt(along @ along + beyond)
        sign = self.rng.choice([-1.0, 1.0])
        z, rest = self.noise()
        beyond = beyond * (ratio / length) ** 2
        rest += beyond + 2 * np.sqrt(beyond) * self.rng.standard_normal()
        return Scene("outside", (name,), ratio, z + sign * along * ratio / length, float(max(rest, 0.0)))

    # --------------------------------------------------------------------------------------------------- judging

    @functools.lru_cache(32)  # noqa: B019
    def _asked(self, removed: tuple[str, ...]) -> Evidence:
        """What is asked of a scene, without what is not in the catalogue; the residuals are those of the design."""
        catalogue = [effect for effect in EFFECTS if effect.name not in removed]
        names = [p for p in self.probes if p.effect.name not in removed]
        said, parts = grammar.beside_names(self.descriptions, catalogue, self.context, self.template)
        asked = [*(p.name for p in (*names, *said, *parts)), *self.patterns]
        space = self._behind_nuisance.subset(asked)
        if not removed:
            self._smallest = space.smallest_p(np.random.default_rng(7), DRAWS)
        return dataclasses.replace(
            self.evidence, space=space, probes=names, descriptions=said, parts=parts, patterns=self.patterns
        )

    def start(self, scene: Scene) -> Evidence:
        """The scores of a scene; noise and number of trials are those of the whole catalogue, which is dear to draw."""
        scores, square = self._reduce(
            self._root @ scene.coordinates, float(scene.coordinates @ scene.coordinates) + scene.rest
        )
        whole, start = self._asked(()), self._asked(scene.removed)
        table = whole.space.table(
            scores[self._behind_nuisance.chosen(whole.space.names)], square, self._smallest
        )
        scores = scores[self._behind_nuisance.chosen(start.space.names)]
        if scene.removed:
            table = start.space.table_after(table, scores)
        return dataclasses.replace(
            start, scores=scores, square=square, table=table, chi2=square, dof=start.space.free
        )

    def judge(self, scene: Scene) -> Verdict:
        """What the search finds."""
        return self.judged(scene, self.start(scene))[0]

    def judged(self, scene: Scene, last: Evidence) -> tuple[Verdict, Evidence]:
        """What the search finds from the scores of a scene, and what it leaves."""
        named: list[str] = []
        said: list[str] = []
        added: list[str] = []
        classes: list[frozenset[str]] = []
        first: Ranked | None = None
        judge = Cached(self._spaces, scene.removed)
        last = search(State(last), judge).evidence
        for trial, before in judge.adoptions:
            item = trial.item
            assert item is not None
            first, name = first or item, item.effect.name
            named.append(name)
            added.append(item.probe.name)
            if item.effect is Described:
                said.append(item.probe.name)
            told = {*trial.rivals, *trial.nameless, *before.close(item)}
            classes.append(frozenset(told - {name, item.probe.name}))
        missing = last.alarm or len(said) > thresholds.MOST_SENTENCES
        kind = "unexplained" if missing else "effect_found" if named else "consistent"
        likely = math.prod(trial.probability for trial, _ in judge.adoptions)
        verdict = Verdict(
            kind, tuple(named), tuple(classes), tuple(said), added=tuple(added), probability=likely
        )
        if first is None:
            return verdict, last
        score = first.score
        return dataclasses.replace(
            verdict, first_probe=first.probe.name, amplitudes=score.amplitudes, covariance=score.covariance
        ), last


class Cached(Linear):
    """Steps of scenes are alike: their spaces are kept."""

    def __init__(self, spaces: Spaces, removed: tuple[str, ...]) -> None:
        self.spaces, self.removed = spaces, removed
        self.adoptions: list[tuple[Trial, Evidence]] = []

    def adopted(self, state: State, trial: Trial) -> State:
        """As `Linear`, with the space of another scene where it went the same way."""
        item = trial.item
        assert item is not None
        self.adoptions.append((trial, state.evidence))
        steps = (*state.steps, trial)
        way = self.removed, tuple(step.item.probe.name for step in steps if step.item is not None)
        after = joined(state.evidence, item, self.spaces.get(way))
        if len(self.spaces) > KEPT:
            self.spaces.clear()
        self.spaces[way] = after.space
        return dataclasses.replace(state, evidence=after, steps=steps)


def verdicts(blind: Blind, scenes: Sequence[Scene], processes: int = 1) -> list[Verdict]:
    """What the search finds in every scene; those alike are judged together, since they share spaces."""
    blind.judge(blind.null())  # trials of the whole catalogue are drawn once
    order = sorted(range(len(scenes)), key=lambda i: (scenes[i].removed, scenes[i].kind, scenes[i].truth))
    parts = [order[i : i + TOGETHER] for i in range(0, len(order), TOGETHER)]
    if processes == 1:
        judged = [[blind.judge(scenes[i]) for i in part] for part in parts]
    else:
        with multiprocessing.get_context("fork").Pool(
            processes, _worker.update, ({"blind": blind, "scenes": scenes},)
        ) as pool:
            judged = pool.map(_part, parts, chunksize=1)
    at = dict(zip(itertools.chain(*parts), itertools.chain(*judged), strict=True))
    return [at[i] for i in range(len(scenes))]


_worker: dict[str, Any] = {}


def _part(part: Sequence[int]) -> list[Verdict]:
    return [_worker["blind"].judge(_worker["scenes"][i]) for i in part]


def study(
    blind: Blind,
    each: int,
    ratios: Sequence[float] = (6.0, 10.0, 30.0),
    nulls: int = 200,
    processes: int = 1,
) -> dict[str, object]:
    """Draw scenes, judge them, then open the truths: the numbers of the acceptance list.

    Of effects that are not in the catalogue, and of shapes that never were, there are at most `WITHOUT_ENTRY` each.
    """
    without_entry = min(each, WITHOUT_ENTRY)
    scenes = [blind.null() for _ in range(nulls)]
    for name in blind.visible:
        drawn = [blind.hidden(name, ratio) for ratio in ratios for _ in range(each)]
        drawn += [
            blind.hidden(name, ratio, (name,), "removed")
            for ratio in ratios[-2:]
            for _ in range(without_entry)
        ]
        scenes += [scene for scene in drawn if scene is not None]
    scenes += [blind.pair(10.0) for _ in range(each * len(blind.visible) // 2)]
    for shape in blind.outside:
        for ratio in (10.0, 30.0):
            scenes += [blind.strange(shape, ratio) for _ in range(without_entry)]
    order = blind.rng.permutation(len(scenes))
    sealed = _seal([scenes[i] for i in order])
    opened = [scenes[i] for i in order]
    judged = verdicts(blind, opened, processes)
    if _seal(opened) != sealed:
        raise RuntimeError("the truths changed while the verdicts were made")
    return summarise(list(zip(opened, judged, strict=True)), blind.as_descriptions)


def _seal(scenes: Sequence[Scene]) -> bytes:
    return hashlib.sha256(json.dumps([(s.kind, s.truth) for s in scenes]).encode()).digest()


OUTCOMES = ("right", "in its class", "wrong name", "wrong sentence", "unexplained", "not detected")


def _outcome(verdict: Verdict, truth: set[str]) -> str:
    """What is said of something that the catalogue does not hold; `truth` are the sentences that it is."""
    if verdict.kind == "consistent":
        return "not detected"
    told = {*verdict.named, *(text for group in verdict.said for text in group.split("; "))}
    if told & truth:
        return "right"
    if truth & {text for one in verdict.classes for group in one for text in group.split("; ")}:
        return "in its class"
    if any(name != "described" for name in verdict.named):
        return "wrong name"
    # Beside `unexplained` a sentence says where it sits, not what it is.
    return "wrong sentence" if verdict.said and verdict.kind == "effect_found" else "unexplained"


def summarise(judged: Sequence[tuple[Scene, Verdict]], known: dict[str, set[str]]) -> dict[str, object]:
    """Rates over judged scenes, and the confusion of names; `known` are the sentences of probes and of shapes."""
    rates: dict[str, list[bool]] = collections.defaultdict(list)
    pulls: list[float] = []
    mistakes: list[str] = []
    confusion: collections.Counter[tuple[str, str]] = collections.Counter()
    for scene, verdict in judged:
        said = (
            "+".join([n for n in verdict.named if n != "described"] + list(verdict.said))
            + f" [{verdict.kind}]"
        )
        ratio = f"{scene.ratio:g}"
        found = verdict.kind == "effect_found"
        if scene.kind == "null":
            rates["false alarm"].append(verdict.kind != "consistent")
        elif scene.kind == "outside":
            outcome = _outcome(verdict, known[scene.truth[0]])
            for one in OUTCOMES:
                rates[f"outside: {one}, SNR {ratio}"].append(outcome == one)
            rates[f"outside: {outcome}, SNR {ratio}, {scene.truth[0]}"].append(True)
            confusion[f"outside: {scene.truth[0]}, SNR {ratio}", f"{outcome}: {said}"] += 1
        elif scene.kind == "removed":
            truth = known[scene.probe]
            outcome = _outcome(verdict, truth)
            for one in OUTCOMES:
                what = "removed" if truth else "removed, no sentence holds it"
                rates[f"{what}: {one}, SNR {ratio}"].append(outcome == one)
            if truth and outcome != "right":
                confusion[f"removed: {scene.truth[0]}, SNR {ratio}", f"{outcome}: {said}"] += 1
            if scene.separation >= SEPARABLE:
                other = found and set(verdict.named) != {"described"}
                rates[f"removed: given another name, SNR {ratio}, separable"].append(other)
                if found:
                    confusion[f"removed: {scene.truth[0]}", said] += 1
        elif scene.kind == "pair":
            if scene.separation >= SEPARABLE:
                rates["pair: both named, SNR 10 each, separable"].append(
                    set(scene.truth) == set(verdict.named)
                )
                told = set(verdict.named).union(*verdict.classes)
                rates["pair: both named or in a class"].append(set(scene.truth) <= told)
                if set(scene.truth) != set(verdict.named):
                    confusion["pair: " + " and ".join(scene.truth), said] += 1
        else:
            truth = scene.truth[0]
            first = verdict.named[0] if verdict.named else verdict.kind
            told = frozenset(verdict.named[:1]).union(*verdict.classes[:1])
            rates[f"detected, SNR {ratio}"].append(verdict.kind != "consistent")
            wrong = found and truth not in told
            rates[f"confident and wrong, SNR {ratio}"].append(wrong)
            if wrong:
                mistakes.append(f"{scene.probe}, SNR {ratio}: {said}, class {', '.join(sorted(told))}")
            if scene.separation >= SEPARABLE:
                rates[f"top-1 right, SNR {ratio}, separable"].append(first == truth)
                rates[f"exactly the truth, SNR {ratio}, separable"].append(
                    verdict.named == (truth,) and found
                )
            elif scene.separation < CONFOUNDED:
                rates[f"a class with the truth in it, SNR {ratio}, confounded"].append(
                    truth in told and len(told) > 1
                )
            if first != truth:
                confusion[
                    f"{truth}, SNR {ratio}", f"{first} [{verdict.kind}]" + (" CLASS" if truth in told else "")
                ] += 1
            elif verdict.first_probe == scene.probe:
                sigma = np.sqrt(np.diag(verdict.covariance))
                alive = sigma > 0
                pulls += ((verdict.amplitudes - scene.amplitudes)[alive] / sigma[alive]).tolist()
    return {
        "rates": {name: (float(np.mean(v)), len(v)) for name, v in sorted(rates.items())},
        "amplitude pulls": {"rms": float(np.sqrt(np.mean(np.square(pulls)))), "count": len(pulls)},
        "mistakes": mistakes,
        "confusion": [(t, n, c) for (t, n), c in confusion.most_common(120)],
    }


def main(each: int = 10, output: str = "", processes: int = 1) -> None:
    """Run the study on a simulated set and print its numbers."""
    from walop_jax.simulation.observing_plan import ObservingPlan
    from walop_jax.simulation.simulate import simulate

    simulated, _ = simulate(ObservingPlan(), seed=20260)
    text = json.dumps(
        study(Blind(simulated), each, nulls=1000, processes=processes), indent=1, ensure_ascii=False
    )
    print(text)
    if output:
        Path(output).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    import jax

    jax.config.update("jax_enable_x64", True)
    arguments = sys.argv[1:]
    main(*(int(a) if a.isdecimal() else a for a in arguments))
