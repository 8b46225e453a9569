"""What is found, told to people: sentences with amplitudes and what would test them, and what has no name."""

from __future__ import annotations

from walop_jax.diagnosis import location
from walop_jax.diagnosis.examination import Examination
from walop_jax.diagnosis.findings import Told, Unexplained
from walop_jax.fit.refit import FitResult
from walop_jax.io.rounding import value_and_error
from walop_jax.model.effects import Described
from walop_jax.model.effects.sentence import FIELD_FACTORS, OPPOSITE, Sentence
from walop_jax.model.parameters import field_declarations

_OF_FACTOR = {
    "hours": "the same exposures in another order, or once more hours later",
    "hour angle": "the same exposures at other hour angles, in another order",
    "kelvin": "the same exposures at another temperature",
    "colour": "narrow bands, or another filter",
    "counts": "the same exposures at another flux",
}
_OF_KIND = {
    "afterglow": "a dark exposure after a bright one",
    "light": "the same field points at another flux, and darks",
    "gain": "a lamp that does not change, seen by all cameras in turn",
    "fringes": "narrow bands a nanometre apart, or the same band at another temperature",
    "shift": "narrow bands beside the broad one",
    "displacement": "the same angles at several hour angles, and a star at known pixels in each",
    "polarisation": "the same patch or star again at another ROTATOR angle",
}


def told(result: FitResult) -> tuple[Told, ...]:
    """The sentences of a fitted model, with their amplitudes."""
    if Described.name not in result.model.effect_names:
        return ()
    effect = result.model.instrument(result.values).effect(Described.name)
    assert isinstance(effect, Described)
    found = []
    for sentence, amplitude in effect.terms():
        sigma = float(result.sigma[result.model.index(f"{Described.name}.{sentence.label}")])
        unit = field_declarations(Described)[sentence.parameter].unit
        value, error = value_and_error(float(amplitude), sigma)
        kind, *dependence = sentence.in_words().split(", ")
        found.append(
            Told(
                sentence=sentence.text,
                kind=sentence.kind,
                place=f"{sentence.where} {sentence.place}",
                dependence=tuple(dependence),
                value=float(amplitude),
                sigma=sigma,
                unit=unit,
                words=f"{kind}: {value} ± {error}{' ' if unit else ''}{unit}{''.join(f', {d}' for d in dependence)}",
                tested_by=tested_by(sentence),
            )
        )
    return tuple(found)


def unexplained(examination: Examination, patterns: tuple[tuple[str, float], ...]) -> Unexplained:
    """What an examination leaves without a name: its patterns, and where the residuals sit."""
    if not examination.alarm:
        ratio = examination.result.chi2 / examination.result.dof
        text = f"residuals scatter more than N_ERR says (χ²/dof = {ratio:.3g}) without any pattern that was looked for"
    elif patterns:
        text = f"patterns without a name: {'; '.join(f'{name} (p = {p:.1g})' for name, p in patterns)}"
    else:
        text = "something is missing, no single pattern is significant by itself"
    where = location.describe(examination.design, examination.design.residual)
    text += f". Residuals sit in: cameras {where['camera']}; kinds {where['kind']}; field {where['field']}"
    return Unexplained(examination.table.p_global, text, patterns)


def too_many_sentences(examination: Examination, said: int) -> Unexplained:
    """What is said where so many sentences were needed that none of them is the thing itself."""
    text = f"{said} sentences were needed: they say where it sits, no single one of them what it is"
    return Unexplained(examination.table.p_global, text, ())


def tested_by(sentence: Sentence) -> str:
    """The observation that would show whether a sentence is true."""
    advice = []
    for factor in sentence.factors:
        if factor in _OF_FACTOR:
            advice.append(_OF_FACTOR[factor])
        elif factor.startswith(("cos", "sin")):
            advice.append(
                "a full turn at more angles in random order, then with the element mounted turned by 90°"
            )
        elif factor.startswith(("hours", "exposure")):
            advice.append("the same exposures once more")
        elif factor in FIELD_FACTORS or factor.startswith("ring"):
            advice.append(
                "more field points along that direction; dither: what is of the optics stays where it is"
            )
    kind = sentence.kind.split()[0]
    if sentence.origin == OPPOSITE:
        advice.append("a star dithered over the field: its ghost moves the other way")
    elif kind in _OF_KIND:
        advice.append(_OF_KIND[kind])
    elif sentence.where == "ahead of" and "." not in sentence.place:
        advice.append("standards at several ROTATOR angles: light through the polariser does not have it")
    elif sentence.where == "of":
        advice.append("the same exposures without that element, or with it mounted turned over")
    else:
        advice.append(
            "the calibration plate at 0° and 45°: it turns what is ahead of it, and not what is behind"
        )
    return "; ".join(dict.fromkeys(advice))
