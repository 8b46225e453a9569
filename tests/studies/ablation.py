"""What each rule of the search is worth: every one switched off, on sets that are fitted.

    python tests/studies/ablation.py [--seed 2] [--first 0] [--budget MINUTES] [--save FILE]
    python tests/studies/ablation.py --join FILE...

Sets come from the grammar of `sealed.py`. A rule is asked only of sets in which it decides something; the others cannot
change. The table has, for each rule, the sets in which it decides, those whose verdict or matrix changes without it,
and how many of these are better and worse *with* it: right or in its class before open before wrong; those whose matrix
between the points is nearer to the truth, or farther off, by 1.2 ×; and those that are trusted and wrong.
"""

from __future__ import annotations

import contextlib
import dataclasses
import pickle
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple
from unittest.mock import patch

import jax
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), *(str(ROOT / "tests" / p) for p in (".", "diagnosis", "studies/benchmark"))]

from studies.sealed import WORSE, Sealed, is_trusted, refusal_of, sealed, verdict_of  # noqa: E402
from studies.sealed_judging import judged, right_of  # noqa: E402
from study_options import options_of  # noqa: E402

from walop_jax.data.records import CalibrationSet  # noqa: E402
from walop_jax.diagnosis import exact, refits, remainder, search, thresholds, workflow  # noqa: E402
from walop_jax.diagnosis.design import Design  # noqa: E402
from walop_jax.diagnosis.examination import Evidence  # noqa: E402
from walop_jax.diagnosis.findings import FitComparison  # noqa: E402
from walop_jax.diagnosis.hypotheses import Ranked  # noqa: E402
from walop_jax.diagnosis.refits import Refits  # noqa: E402
from walop_jax.fit.refit import FitResult  # noqa: E402
from walop_jax.io.errors import DataError  # noqa: E402
from walop_jax.likelihood.likelihood import Likelihood  # noqa: E402
from walop_jax.model.effects import Effect  # noqa: E402

Place = tuple[Any, str]


class Rule(NamedTuple):
    """A rule: what is replaced, by what, and where it shows that it decides (default: there), by which answers."""

    text: str
    places: tuple[Place, ...]
    off: Callable[[Any], Any]
    decides: Callable[[tuple[Any, ...], Any], bool]
    watched: tuple[Place, ...] = ()


def always(answer: Any) -> Callable[[Any], Any]:
    """A replacement that has one answer."""
    return lambda _: lambda *args: answer


def number(value: float) -> Callable[[Any], Any]:
    """Another value of a threshold."""
    return lambda _: value


def answers(args: tuple[Any, ...], answer: Any) -> bool:
    """True where there is an answer."""
    return bool(answer)


def _of(text: str) -> Callable[[tuple[Any, ...], Any], bool]:
    """Refusals with a reason that begins so."""
    return lambda args, answer: answer.startswith(text)


REFUSED: tuple[Place, ...] = ((search, "against"),)
RULES = (
    Rule("data that were left out agree better with an addition",
         REFUSED,
         lambda real: lambda trial: real(dataclasses.replace(trial, compared=FitComparison())),
         _of("data that were left out")),
    Rule("no KIND contradicts an addition, nor all of them (`contradicting`)",
         ((refits, "contradicting"), (remainder, "contradicting")), always(""), answers),
    Rule("structural effects and other descriptions of the instrument (`others`)",
         ((Refits, "others"),), lambda _: lambda self, state: ([], state.choices),
         lambda args, answer: bool(answer[0])),
    Rule("the effect with the most evidence is fitted beside a description of a gross misfit (`effect_instead`)",
         ((search._RoundInProgress, "effect_instead"),), always([]), answers),
    Rule("a search ends with its third description (`too_many_descriptions`)",
         ((search, "too_many_descriptions"),), always(False), answers),
    Rule("a time at which a description starts or stops is fitted (`_with_best_times`)",
         ((Refits, "_with_best_times"),), lambda _: lambda self, evidence, description: description,
         lambda args, answer: answer is not args[2]),
    Rule("priors of additions that the data refute are widened",
         ((refits, "with_refuted_priors_widened"),), lambda _: lambda model, values, name: model,
         lambda args, answer: answer is not args[0]),
    Rule("additions that the final model does not need go (`_needed`)",
         ((remainder, "_needed"),), lambda _: lambda result, steps, judge: (result, steps),
         lambda args, answer: answer[0] is not args[0]),
    Rule("names that leave a poor fit poor are parts (`PART`)", ((remainder, "_parts"),), always({}), answers),
    Rule("a free-form term for the remainder, where it predicts unseen settings",
         ((remainder, "_with_free_form"),), lambda real: lambda *args: (real(*args)[0], None),
         lambda args, answer: answer[1] is not None),
    Rule("a model that predicts worse than the first is not adopted (`_worse`)",
         ((remainder, "_worse"),), always(""), answers),
    Rule("more than two descriptions are one thing that none holds (`MOST_SENTENCES`)",
         ((remainder, "thresholds"),), lambda real: SimpleNamespace(**(vars(real) | {"MOST_SENTENCES": 99})),
         lambda args, answer: sum(len(step.groups) for step in args[1].steps) > thresholds.MOST_SENTENCES,
         ((remainder, "concluded"), (workflow, "concluded"))),
    Rule("one number that the set states, instead of names (`instead_of_names`)",
         ((remainder, "instead_of_names"),), always(("", False)), answers),
    Rule("another reading of the data is asked (`causes_of`)", ((workflow, "causes_of"),), always(()), answers),
)  # fmt: skip
INSTEAD = remainder.instead_of_names
WORTH = {"right": 2, "in its class": 2, "class": 2, "open": 1, "not detected": 1, "": 1, "wrong": 0}


@contextlib.contextmanager
def without(rule: Rule) -> Iterator[None]:
    """The search without a rule."""
    with contextlib.ExitStack() as stack:
        for owner, name in rule.places:
            stack.enter_context(patch.object(owner, name, rule.off(getattr(owner, name))))
        yield


@contextlib.contextmanager
def watched(rules: tuple[Rule, ...]) -> Iterator[set[str]]:
    """The search, and the rules that decide something in it."""
    decided = set[str]()

    def noting(real: Any, rule: Rule) -> Any:
        def noted(*args: Any, **names: Any) -> Any:
            answer = real(*args, **names)
            if rule.decides(args, answer):
                decided.add(rule.text)
            return answer

        return noted

    with contextlib.ExitStack() as stack:
        for rule in rules:
            for owner, name in rule.watched or rule.places:
                stack.enter_context(patch.object(owner, name, noting(getattr(owner, name), rule)))
        yield decided


# -------------------------------------------------------------------------------------------------------------- fits


MOST_KEPT = 3  # examinations beside the first: each has the columns of all candidates
SLOW: tuple[Place, ...] = (
    (workflow, "fit"), (workflow, "causes_of"), (refits, "examine"), (refits, "fit"), (refits, "try_effect"),
    (exact, "try_effect"), (refits, "other_descriptions"), (refits, "refit_without"), (refits, "before_and_after"),
    (remainder, "try_effect"), (remainder, "evidence_of_presence"), (refits, "held_out"),
)  # fmt: skip
"""Work that no rule is in: searches of one set do it once, up to where they part."""


@contextlib.contextmanager
def remembered() -> Iterator[None]:
    """Results of `SLOW` functions by the content of their arguments; the random numbers go on as if all were run."""
    answers: dict[Any, tuple[Any, Any]] = {}
    kept: list[Any] = []  # what has an identity in a key, so that none is given away again

    def once(real: Any, name: str) -> Any:
        def remembering(*args: Any, **names: Any) -> Any:
            key = name, tuple(map(_key, args)), tuple((k, _key(v)) for k, v in sorted(names.items()))
            generator = next((a for a in args if isinstance(a, np.random.Generator)), None)
            if key not in answers:
                answer = real(*args, **names)
                answers[key] = answer, None if generator is None else generator.bit_generator.state
                kept.extend(map(_identified, args))
                examined = [k for k in answers if k[0] == "examine"]
                for superseded in examined[1:-MOST_KEPT]:
                    del answers[superseded]
            answer, state = answers[key]
            if generator is not None:
                generator.bit_generator.state = state
            # What is cached of an examination may follow from a rule.
            return dataclasses.replace(answer) if isinstance(answer, Evidence) else answer

        return remembering

    with contextlib.ExitStack() as stack:
        for owner, name in SLOW:
            stack.enter_context(patch.object(owner, name, once(getattr(owner, name), name)))
        yield


def _identified(value: Any) -> Any:
    """The fit that an examination or a design is about; anything else as it is."""
    return value.fit if isinstance(value, Design) else value.result if isinstance(value, Evidence) else value


def _key(value: Any) -> Any:
    """What two equal arguments have in common."""
    value = _identified(value)
    if isinstance(value, np.random.Generator):
        return str(value.bit_generator.state)
    if isinstance(value, Effect):
        return str(jax.tree.structure(value)), *(
            np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(value)
        )
    if isinstance(value, Ranked):
        return value.name, value.score.amplitudes.tobytes()
    if isinstance(value, np.ndarray):
        return value.tobytes()
    if isinstance(value, Likelihood):  # of one set, as a whole or thinned
        parameters = ((p.name, p.free, p.prior, p.start) for p in value.model.parameters)
        return len(value.calset.points), *map(str, parameters), *_key_of_tree(value.model.template)
    if isinstance(value, FitResult | CalibrationSet):
        return id(value)
    if isinstance(value, Mapping):
        return tuple(value)
    return value if isinstance(value, str | int | float) or value is None else type(value).__name__


def _key_of_tree(tree: Any) -> tuple[Any, ...]:
    leaves, structure = jax.tree.flatten(tree)
    return str(structure), *(np.asarray(leaf).tobytes() for leaf in leaves)


class Same(Exception):
    """The search without a rule ends as with it."""


class Fitted(NamedTuple):
    """The answer to a sealed set: verdict and names, are these right, error of the matrix, trusted and wrong."""

    verdict: str
    right: str
    error: float
    wrong: bool


def fitted(one: Sealed, before: list[Any]) -> Fitted:
    """Diagnose a sealed set; `before` has the end of its search with all rules, and then what came of it."""

    def concluded(*args: Any) -> Any:
        state, rest = real(*args)
        end = state.evidence.result, rest and rest.description, *(step.name for step in state.steps)
        if not before:
            before.append(end)
        elif (
            before[0]
            and end[0] is before[0][0]
            and end[1:] == before[0][1:]
            and remainder.instead_of_names is instead
        ):
            raise Same
        return state, rest

    real, instead = workflow.concluded, INSTEAD
    try:
        with patch.object(workflow, "concluded", concluded):
            diagnosis = workflow.diagnose(one.calset)
    except Same:
        return before[1]
    except (DataError, ValueError) as error:
        before += [] if before else [None]
        return Fitted(refusal_of(error), "", np.nan, False)
    trusted = is_trusted(diagnosis)
    product = judged(diagnosis.calibration(), trusted, one)
    verdict = f"{verdict_of(diagnosis)}{'' if trusted else ', not trusted'}"
    return Fitted(verdict, right_of(one, diagnosis), product.error, trusted and product.wrong)


def fits(seed: int, first: int, budget: float, save: Path | None) -> list[dict[str, Any]]:
    """Sets with all rules, and without each that decides something there, until `budget` minutes are over."""
    rows, end, count = list[dict[str, Any]](), time.monotonic() + 60.0 * budget, first
    while time.monotonic() < end:
        one = sealed(count, seed, 8)
        with remembered():
            before: list[Any] = []
            with watched(RULES) as decided:
                row: dict[str, Any] = {
                    "number": count,
                    "hidden": one.text,
                    "all": fitted(one, before),
                    "rules": {},
                }
            before.append(row["all"])
            for rule in (rule for rule in RULES if rule.text in decided):
                with without(rule):
                    row["rules"][rule.text] = fitted(one, before)
        rows.append(row)
        changed = [text for text, now in row["rules"].items() if now.verdict != row["all"].verdict]
        print(
            f"{count}: {one.text} | {row['all']} | {len(decided)} rules decide; changed without: {changed}",
            flush=True,
        )
        if save:
            save.write_bytes(pickle.dumps(rows))
        jax.clear_caches()  # the programs of every set are others
        count += 1
    return rows


def table_of_fits(rows: list[dict[str, Any]]) -> str:
    """Markdown: for each rule the sets in which it decides, changed, and better and worse in each way with it."""
    head = f"of {len(rows)} sets: decides; changed | answer better; worse | matrix better; worse | wrong without; with"
    lines = [f"| rule | {head} |", "| --- | --- | --- | --- | --- |"]
    for rule in RULES:
        pairs = [(row["all"], row["rules"][rule.text]) for row in rows if rule.text in row["rules"]]
        changed = [
            (a, b)
            for a, b in pairs
            if a.verdict != b.verdict or not np.isclose(a.error, b.error, 1e-3, equal_nan=True)
        ]
        gains = [WORTH[a.right] - WORTH[b.right] for a, b in changed]
        ratios = [b.error / a.error for a, b in changed]
        better, worse = (sum(ratio > WORSE for ratio in some) for some in (ratios, [1.0 / r for r in ratios]))
        answer = f"{sum(g > 0 for g in gains)}; {sum(g < 0 for g in gains)}"
        only = [
            sum(x.wrong and not y.wrong for x, y in some) for some in ([(b, a) for a, b in changed], changed)
        ]
        wrong = "; ".join(map(str, only))
        lines.append(
            f"| {rule.text} | {len(pairs)}; {len(changed)} | {answer} | {better}; {worse} | {wrong} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Print the table."""
    parser = options_of(__doc__, seed=2, first=0, budget=60.0)
    parser.add_argument("--save", type=Path, help="file of the sets so far, written after each")
    parser.add_argument("--join", type=Path, nargs="+", help="such files: print their table")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if options.join:
        print(table_of_fits([row for file in options.join for row in pickle.loads(file.read_bytes())]))
        return
    print(table_of_fits(fits(options.seed, options.first, options.budget, options.save)))


if __name__ == "__main__":
    main()
