"""Gross mistakes of a first night: is the first sentence of a diagnosis the right one, and what does it cost?

    python tests/studies/first_night.py [--only TEXT] [--further] [--seed 61] [--seconds 150] [--number POOR_FIT=2]

Plates in, out, turned or exchanged; beams and cables exchanged; signs, zeros, orders and units of angles; in all
exposures, in half of them or in one KIND only; two at once: forty, on WALOP-SOUTH, WALOP-NORTH, WALOP-LAB and CHARIS. A
set of few field points is simulated for each, changed as the mistake changes it, and diagnosed. The first sentence is
the reason with which the data are refused, or what the headline of the diagnosis says was found. Printed are, for each,
whether that is right, CPU seconds, χ²/dof of the set as it stands and with the cause, and the sentence. All run in one
process: the first mistakes of an instrument hold the compilation of the programs that later ones share. With `--number`
a number of `diagnosis.thresholds` has another value; it may be given several times.
"""

from __future__ import annotations

import argparse
import dataclasses
import re
import resource
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from changed_sets import block_of, with_block  # noqa: E402

from walop_jax.data.records import CalibrationSet, FilterCurve, Position  # noqa: E402
from walop_jax.diagnosis import thresholds  # noqa: E402
from walop_jax.diagnosis.workflow import diagnose  # noqa: E402
from walop_jax.fit.base_model import base_model  # noqa: E402
from walop_jax.io.errors import DataError  # noqa: E402
from walop_jax.model.compiled import switch_on  # noqa: E402
from walop_jax.model.effects import OtherDescription, effect_by_name  # noqa: E402
from walop_jax.model.instrument import Instrument, nominal_instrument  # noqa: E402
from walop_jax.simulation.observing_plan import NO_SKY, ObservingPlan, polariser_turn  # noqa: E402
from walop_jax.simulation.simulate import simulate  # noqa: E402

MANY = 10  # mistakes after which the programs so far are forgotten
WITH_PLATE = ObservingPlan(
    grid=4,
    standard_grid=2,
    polariser_angles=polariser_turn(8, full_turn=True),
    moon_patches=4,
    standards=4,
    plate=(None, 22.5),
)
NO_PLATE = dataclasses.replace(WITH_PLATE, plate=(None,))
CROSSED = dataclasses.replace(
    WITH_PLATE,
    instrument=nominal_instrument("WALOP-SOUTH")
    .changed("half1.plate", axis=lambda axis: axis + 22.5)
    .changed("half2.plate", axis=lambda axis: axis - 22.5),
)
CHARIS = Instrument.read(ROOT / "notebooks" / "charis.toml")
NORTH = dataclasses.replace(WITH_PLATE, instrument="WALOP-NORTH", plate=(0.0, 22.5))
LAB = ObservingPlan(
    "WALOP-LAB",
    grid=6,
    polariser_angles=polariser_turn(12, full_turn=True),
    plate=(None, 0.0, 22.5),
    **NO_SKY,
)


def band(name: str, centre: float) -> FilterCurve:
    """A bin of a spectrograph of resolution 19 (FWHM)."""
    sigma = centre / 19.0 / 2.3548
    wavelength = centre + sigma * np.linspace(-3.0, 3.0, 13)
    return FilterCurve(name, wavelength, np.exp(-0.5 * ((wavelength - centre) / sigma) ** 2))


BENCH = ObservingPlan(
    CHARIS,
    grid=1,
    polariser_angles=(0.0,),
    filters=tuple(band(f"BIN{number}", at) for number, at in enumerate((1.25, 1.6, 2.1))),
    moving={"HWP": tuple(np.arange(0.0, 90.0, 11.25)), "DEROT": (10.0, 45.0, 80.0, 115.0)},
    **NO_SKY,
)
AS_BUILT = (
    CHARIS.changed("derotator", delta=lambda delta: delta + 0.05)
    .changed("relay", rotation=lambda turn: turn + 1.0)
    .changed("main.analyser", loss=lambda loss: loss + 0.01)
)
"""Its priors hold anything, light below zero as well: an instrument a little beside its description."""
Made = Callable[[int], CalibrationSet]
Change = Callable[[CalibrationSet], CalibrationSet]


class Case(NamedTuple):
    """A mistake: how its set is made of a seed, and what the first sentence must say (a regular expression)."""

    made: Made
    said: str


def sound(plan: ObservingPlan = WITH_PLATE, effects: tuple[Any, ...] = ()) -> Made:
    built_as = AS_BUILT if plan is BENCH else None
    return lambda seed: simulate(plan, seed, instrument=built_as, effects=list(effects)).calset


def told(change: Change, plan: ObservingPlan = WITH_PLATE, effects: tuple[Any, ...] = ()) -> Made:
    """A set that is written down wrongly."""
    return lambda seed: change(sound(plan, effects)(seed))


def built(change: str, plan: ObservingPlan = WITH_PLATE) -> Made:
    """A set of an instrument that was put together otherwise."""
    return sound(plan, (OtherDescription(change=change),))


def half(change: Change) -> Change:
    """The mistake in the second half of the exposures: polariser, Moon and standards come in this order."""

    def changed(calset: CalibrationSet) -> CalibrationSet:
        return mixed(calset, change(calset), second_half(calset))

    return changed


def second_half(calset: CalibrationSet) -> np.ndarray:
    """True for the exposures taken after half of all."""
    return np.arange(len(calset.exposures)) >= len(calset.exposures) // 2


def mixed(first: CalibrationSet, second: CalibrationSet, chosen: np.ndarray) -> CalibrationSet:
    """A set with some exposures and their intensities of a second one."""
    e, f = first.exposures, second.exposures
    columns = {
        field.name: np.where(chosen, getattr(f, field.name), getattr(e, field.name))
        for field in dataclasses.fields(e)
        if isinstance(getattr(e, field.name), np.ndarray) and len(getattr(e, field.name)) == len(e)
    }
    places = {
        prefix: Position.at(
            np.where(
                chosen,
                np.where(f.position(prefix).inside, f.position(prefix).angle, np.nan),
                np.where(at.inside, at.angle, np.nan),
            )
        )
        for prefix, at in e.positions.items()
    }
    a, b = block_of(first), block_of(second)
    at = chosen[None, :, None]
    calset = with_block(first, counts=np.where(at, b.counts, a.counts), sigma=np.where(at, b.sigma, a.sigma))
    return dataclasses.replace(calset, exposures=dataclasses.replace(e, **columns).placed(**places))


def of_kind(kind: str, change: Change) -> Change:
    """The mistake in the exposures of one KIND alone."""
    return lambda calset: mixed(calset, change(calset), calset.exposures.kind == kind)


def order(*at: int) -> Change:
    """Columns of N in another order."""

    def changed(calset: CalibrationSet) -> CalibrationSet:
        block = block_of(calset)
        return with_block(calset, counts=block.counts[..., list(at)], sigma=block.sigma[..., list(at)])

    return changed


def placed(prefix: str, turn: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Another reading of a moving element."""
    return lambda c: dataclasses.replace(
        c, exposures=c.exposures.placed(**{prefix: Position.at(turn(c.exposures.position(prefix).angle))})
    )


def column(name: str, turn: Callable[[np.ndarray], np.ndarray]) -> Change:
    return lambda c: dataclasses.replace(
        c, exposures=dataclasses.replace(c.exposures, **{name: turn(getattr(c.exposures, name))})
    )


def field(turn: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]) -> Change:
    def changed(calset: CalibrationSet) -> CalibrationSet:
        x, y = turn(calset.points.x, calset.points.y)
        points = dataclasses.replace(calset.points, x=x, y=y)
        return with_block(dataclasses.replace(calset, points=points), x=x, y=y)

    return changed


def stars(turn: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]) -> Change:
    def changed(calset: CalibrationSet) -> CalibrationSet:
        q, u = turn(calset.sources.q, calset.sources.u)
        return dataclasses.replace(calset, sources=dataclasses.replace(calset.sources, q=q, u=u))

    return changed


def gain(camera: int, factor: float) -> Change:
    def changed(calset: CalibrationSet) -> CalibrationSet:
        block = block_of(calset)
        factors = np.where(np.arange(block.counts.shape[-1]) == camera, factor, 1.0)
        return with_block(calset, counts=block.counts * factors, sigma=block.sigma * np.sqrt(factors))

    return changed


def exchanged(kind: str) -> Change:
    """Intensities of the first two exposures of a KIND that differ exchanged."""

    def changed(calset: CalibrationSet) -> CalibrationSet:
        block, here = block_of(calset), np.arange(len(calset.exposures))
        one, other = np.flatnonzero(calset.exposures.kind == kind)[[1, 2]]
        here[[one, other]] = other, one
        return with_block(
            calset, counts=block.counts[:, here], sigma=block.sigma[:, here], used=block.used[:, here]
        )

    return changed


def both(first: Change, second: Change) -> Change:
    return lambda calset: second(first(calset))


def plate_in(plan: ObservingPlan, some: Callable[[CalibrationSet], np.ndarray] | None = None) -> Made:
    """The calibration plate in the beam where the exposures say that it is out."""

    def made(seed: int) -> CalibrationSet:
        there = sound(plan, (effect_by_name("chwp_in_beam").of(plan.context()),))(seed)
        return there if some is None else mixed(sound(plan)(seed), there, some(there))

    return made


def plate_out(seed: int) -> CalibrationSet:
    """The plate out of the beam in all exposures, half of which say that it is in."""
    said = sound(WITH_PLATE)(seed)
    out = dataclasses.replace(WITH_PLATE, polariser_angles=2 * WITH_PLATE.polariser_angles, plate=(None,))
    block = block_of(sound(out)(seed))
    return with_block(said, counts=block.counts, sigma=block.sigma)


def no_polariser(seed: int) -> CalibrationSet:
    """Light that never saw the polariser, which the exposures say was in."""
    said = sound(NO_PLATE)(seed)
    block = block_of(said)
    through = said.exposures.clp_in
    mean = block.counts[:, through].mean(axis=1, keepdims=True)
    rng = np.random.default_rng(seed)
    counts, sigma = block.counts.copy(), block.sigma.copy()
    counts[:, through] = rng.poisson(np.broadcast_to(mean, counts[:, through].shape))
    sigma[:, through] = np.sqrt(counts[:, through] + 900.0)
    return with_block(said, counts=counts, sigma=sigma)


def other_name(calset: CalibrationSet) -> CalibrationSet:
    name = "WALOP-NORTH" if calset.instrument == "WALOP-SOUTH" else "WALOP-SOUTH"
    return dataclasses.replace(calset, instrument=name)


def site(name: str, turn: Callable[[float], float]) -> Change:
    return lambda c: dataclasses.replace(
        c, site=dataclasses.replace(c.site, **{name: turn(getattr(c.site, name))})
    )


def angles_exchanged(one: str, other: str) -> Change:
    """Columns of two moving elements exchanged."""
    return lambda c: dataclasses.replace(
        c,
        exposures=c.exposures.placed(**{one: c.exposures.position(other), other: c.exposures.position(one)}),
    )


def bins_reversed(calset: CalibrationSet) -> CalibrationSet:
    """The name of the first filter given to exposures through the last one, and so on."""
    names = list(calset.filters)
    other = dict(zip(names, names[::-1], strict=True))
    filters = np.array([other[name] for name in calset.exposures.filter], dtype=calset.exposures.filter.dtype)
    return dataclasses.replace(calset, exposures=dataclasses.replace(calset.exposures, filter=filters))


PLATE = "chwp.in.beam|chwp in the beam|CHWP was in the beam"
BACKWARDS = "CLP_ANGLE runs the other way"
MIRRORED = "(HWP|DEROT)_ANGLE runs the other way"  # of light that is polarised along an axis, mirror images
OPPOSITE = (
    "order right, left|exchanged beams|HWP_ANGLE is (45|135)|DEROT_ANGLE is 90"  # q and u of the other sign
)


def in_either_order(first: str, second: str) -> str:
    """Two things said in one sentence."""
    return f"({first}).*({second})|({second}).*({first})"


FORTY: dict[str, dict[str, Case]] = {
    "WALOP-SOUTH": {
        "plate in the beam, whole set": Case(plate_in(NO_PLATE), PLATE),
        "plate in the beam, standards alone": Case(plate_in(NO_PLATE, lambda c: c.exposures.kind == "standard"), PLATE),
        "half2.plate left out": Case(built("half2.plate left out"), "half2.plate left out"),
        "plates of the arms exchanged": Case(sound(CROSSED), "half1.plate and half2.plate exchanged"),
        "half2.wedge turned by 90": Case(built("half2.wedge turned by 90 deg"), "half2.wedge turned by 90"),
        "beams of arm 1 exchanged": Case(told(order(1, 0, 2, 3)), "order E1, O1, O2, E2|half1.*exchanged beams"),
        "cables exchanged in the second half": Case(told(half(order(0, 2, 1, 3))), "O1, O2, E1, E2"),
        "polariser backwards": Case(told(placed("CLP", np.negative)), BACKWARDS),
        "polariser angles halved": Case(told(placed("CLP", lambda a: a / 2.0)), "CLP_ANGLE.*half"),
        "polariser slips by 3 deg in mid-run": Case(
            told(half(placed("CLP", lambda a: a + 3.0))), "turn of polariser|CLP_ANGLE"
        ),
        "points shifted by 0.03 deg": Case(told(field(lambda x, y: (x + 0.03, y))), "X of all field points"),
        "U of SOURCES of the other sign": Case(told(stars(lambda q, u: (q, -u))), "^U of SOURCES"),
        "standards in per cent": Case(told(stars(lambda q, u: (100.0 * q, 100.0 * u))), "in per cent"),
        "ROTATOR of the other sense, Moon alone": Case(
            told(of_kind("moon", column("rotator", np.negative))), "ROTATOR.*(moon|other way)"
        ),
        "clock two hours off": Case(told(column("mjd", lambda t: t + 2.0 / 24.0)), "MJD"),
        "camera O2 gains a half in mid-run": Case(told(half(gain(2, 1.5))), "gain of O2"),
        "beams of arm 1 exchanged; X mirrored": Case(
            told(both(order(1, 0, 2, 3), field(lambda x, y: (-x, y)))), in_either_order("E1, O1, O2, E2", "X runs")
        ),
        "polariser + 45; U of SOURCES": Case(
            told(both(placed("CLP", lambda a: a + 45.0), stars(lambda q, u: (q, -u)))),
            in_either_order("CLP_ANGLE is 135", "U of"),
        ),
    },
    "WALOP-NORTH": {
        "plate + 45": Case(told(placed("CHWP", lambda a: a + 45.0), NORTH), "CHWP_ANGLE is (45|135)"),
        "Y mirrored": Case(told(field(lambda x, y: (x, -y)), NORTH), "Y runs the other way"),
        "cables of E1 and O2 exchanged": Case(told(order(0, 2, 1, 3), NORTH), "order O1, O2, E1, E2"),
        # At these angles that is an exchange of two exposures, number for number.
        "polariser backwards, second half": Case(
            told(half(placed("CLP", np.negative)), NORTH), f"{BACKWARDS}|exposures 13 and 15 were exchanged"
        ),
        "RA in hours": Case(told(column("ra", lambda a: a / 15.0), NORTH), "RA is in hours"),
        "west longitude": Case(told(site("longitude", lambda v: -v), NORTH), "SITELONG|longitude of the site"),
        "North labelled South": Case(told(other_name, NORTH), "they came from WALOP-NORTH"),
        "polariser backwards; Y mirrored": Case(
            told(both(placed("CLP", np.negative), field(lambda x, y: (x, -y))), NORTH),
            in_either_order(BACKWARDS, "Y runs the other way"),
        ),
    },
    "WALOP-LAB": {
        "tilts in radians": Case(told(field(lambda x, y: (np.deg2rad(x), y)), LAB), "X and Y are in radians"),
        "polariser + 45": Case(told(placed("CLP", lambda a: a + 45.0), LAB), "CLP_ANGLE is 135"),
        "beams of arm 2 exchanged": Case(told(order(0, 1, 3, 2), LAB), "order O1, E1, E2, O2|half2.*exchanged beams"),
        "plate backwards": Case(told(placed("CHWP", np.negative), LAB), "CHWP_ANGLE (runs the other way|is)"),
        "camera E2 loses a half in mid-run": Case(told(half(gain(3, 0.5)), LAB), "gain of E2"),
        "polariser in radians; cables exchanged": Case(
            told(both(placed("CLP", np.deg2rad), order(0, 2, 1, 3)), LAB),
            in_either_order("CLP_ANGLE is in radians", "O1, O2, E1, E2"),
        ),
    },
    "CHARIS": {
        "beams exchanged": Case(told(order(1, 0), BENCH), OPPOSITE),
        "plate backwards": Case(told(placed("HWP", np.negative), BENCH), MIRRORED),
        "derotator backwards": Case(told(placed("DEROT", np.negative), BENCH), MIRRORED),
        "angles of plate and derotator exchanged": Case(
            told(angles_exchanged("HWP", "DEROT"), BENCH), "HWP.*DEROT.*exchanged"
        ),
        "derotator angles doubled": Case(told(placed("DEROT", lambda a: 2.0 * a), BENCH), "DEROT_ANGLE is twice"),
        "plate slips by 5 deg in mid-run": Case(
            told(half(placed("HWP", lambda a: a + 5.0)), BENCH), "HWP_ANGLE|turn of"
        ),
        "bins counted from the other end": Case(told(bins_reversed, BENCH), "FILTER|filters"),
        "beams exchanged; derotator backwards": Case(
            told(both(order(1, 0), placed("DEROT", np.negative)), BENCH), in_either_order(OPPOSITE, MIRRORED)
        ),
    },
}  # fmt: skip
"""The forty of the issue: written down before any rule for them was."""

FURTHER: dict[str, Case] = {
    "plate in the beam, second half": Case(plate_in(NO_PLATE, second_half), f"{PLATE}|CHWP.*in the beam"),
    "plate never went in": Case(plate_out, "CHWP was not in the beam|chwp left out"),
    "both wedges turned by 180": Case(
        built("half1.wedge and half2.wedge turned by 180 deg"), "half1.wedge and half2.wedge turned by 180"
    ),
    "half2.plate turned the other way": Case(
        built("half2.plate turned the other way"), "half2.plate turned the other way"
    ),
    "plate + 45": Case(told(placed("CHWP", lambda a: a + 45.0)), "CHWP_ANGLE is 135"),
    "half2.wedge turned by 180": Case(built("half2.wedge turned by 180 deg"), "half2.wedge turned by 180"),
    "arms exchanged": Case(told(order(2, 3, 0, 1)), "order O2, E2, O1, E1|exchanged cameras"),
    "cables of E1 and O2 exchanged": Case(told(order(0, 2, 1, 3)), "order O1, O2, E1, E2"),
    "beams exchanged, standards alone": Case(
        told(of_kind("standard", order(1, 0, 2, 3))), "E1, O1, O2, E2"
    ),
    "polariser backwards, second half": Case(told(half(placed("CLP", np.negative))), BACKWARDS),
    "polariser + 45": Case(told(placed("CLP", lambda a: a + 45.0)), "CLP_ANGLE is 135"),
    "polariser + 90": Case(told(placed("CLP", lambda a: a + 90.0)), "CLP_ANGLE is 90"),
    "polariser in radians": Case(told(placed("CLP", np.deg2rad)), "CLP_ANGLE is in radians"),
    "polariser angles doubled": Case(told(placed("CLP", lambda a: 2.0 * a)), "CLP_ANGLE.*(twice|doubl)"),
    "polariser not in the beam": Case(no_polariser, "polariser was not in the beam"),
    "plate backwards": Case(told(placed("CHWP", np.negative)), "CHWP_ANGLE"),
    "X mirrored": Case(told(field(lambda x, y: (-x, y))), "X runs the other way"),
    "field turned by 90": Case(told(field(lambda x, y: (y, -x))), "the field is turned by"),
    "X and Y in arcmin": Case(told(field(lambda x, y: (60.0 * x, 60.0 * y))), "arcmin"),
    "ROTATOR of the other sense": Case(told(column("rotator", np.negative)), "ROTATOR runs the other way"),
    "ROTATOR + 90": Case(told(column("rotator", lambda a: a - 90.0)), "^ROTATOR is 90°"),
    "RA in hours": Case(told(column("ra", lambda a: a / 15.0)), "RA is in hours"),
    "clock half a day off": Case(told(column("mjd", lambda t: t + 0.5)), "MJD is 0.5 d"),
    "west longitude": Case(told(site("longitude", lambda v: -v)), "SITELONG"),
    "two exposures exchanged": Case(told(exchanged("clp")), "intensities of exposures . and . were exchanged"),
    "South labelled North": Case(told(other_name), "they came from WALOP-SOUTH"),
    "plate in the beam; polariser backwards": Case(
        lambda seed: placed("CLP", np.negative)(plate_in(NO_PLATE)(seed)), f"({PLATE}).*|{BACKWARDS}"
    ),
    "cables exchanged; ROTATOR of the other sense": Case(
        told(both(order(0, 2, 1, 3), column("rotator", np.negative))), "O1, O2, E1, E2.*ROTATOR|ROTATOR.*O1, O2, E1, E2"
    ),
}  # fmt: skip
"""Others of South, of the list before."""


class Told(NamedTuple):
    """What a user reads first, and χ²/dof of the fit of the set as it stands and with the cause; NaN: not told."""

    sentence: str
    before: float
    after: float


def first_sentence(calset: CalibrationSet) -> Told:
    """The reason of a refusal, or the headline of the diagnosis."""
    model = base_model(calset, CHARIS) if calset.instrument == CHARIS.name else None
    try:
        found = diagnose(calset, model)
    except (DataError, ValueError) as refused:
        text, _, reasons = str(refused).partition("it would if ")
        sentence = (reasons or text).partition("; or if ")[0]
        return Told(sentence, misfit_in(text), misfit_in(sentence))
    shown = found.display()
    sentence = f"{dict(shown.facts)['found']} [{shown.title}]"
    before, after = (fit.chi2 / max(fit.dof, 1) for fit in (found.before, found.after))
    return Told(sentence, before, misfit_in(sentence) if found.verdict == "wrong_number" else after)


def misfit_in(text: str) -> float:
    """The χ²/dof that a sentence says."""
    said = re.search(r"χ²/dof = ([0-9.e+]+)", text)
    return float(said[1]) if said else float("nan")


class OverError(BaseException):
    """The CPU seconds are spent; no `except Exception` on the way takes it for an error of its own."""


def used() -> float:
    """CPU seconds of this process."""
    spent = resource.getrusage(resource.RUSAGE_SELF)
    return spent.ru_utime + spent.ru_stime


def chosen(options: argparse.Namespace) -> Iterator[tuple[str, str, Case]]:
    """Instrument, name and case of the mistakes that are asked for."""
    listed = {"WALOP-SOUTH": FURTHER} if options.further else FORTY
    for instrument, cases in listed.items():
        for name, case in cases.items():
            if re.search(options.only, f"{instrument}: {name}"):
                yield instrument, name, case


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", default="", help="mistakes whose INSTRUMENT: NAME holds this expression")
    parser.add_argument("--further", action="store_true", help="others of South in place of the forty")
    parser.add_argument("--seed", type=int, default=61)
    parser.add_argument("--seconds", type=float, default=150, help="CPU s after which one is given up")
    parser.add_argument("--number", action="append", default=[], help="NAME=VALUE of a threshold")
    options = parser.parse_args()
    switch_on()
    for given in options.number:
        number, _, value = given.partition("=")
        assert hasattr(thresholds, number), number
        setattr(thresholds, number, float(value))

    def over(*_: object) -> None:
        raise OverError

    signal.signal(signal.SIGPROF, over)
    right, spent = 0, []
    for count, (instrument, name, case) in enumerate(chosen(options)):
        if count and count % MANY == 0:
            jax.clear_caches()  # the programs of all forty do not fit into the memory maps of one process
        calset = case.made(options.seed)
        began = used()
        signal.setitimer(signal.ITIMER_PROF, options.seconds)
        try:
            said = first_sentence(calset)
        except OverError:
            said = Told(f"nothing within {options.seconds:g} CPU s", float("nan"), float("nan"))
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        good = bool(re.search(case.said, said.sentence))
        right += good
        spent.append(used() - began)
        print(
            f"{'right' if good else 'WRONG'} {spent[-1]:6.1f} CPU s  χ²/dof {said.before:.3g} → {said.after:.3g}  "
            f"{instrument}: {name}: {said.sentence[:230]}",
            flush=True,
        )
    if spent:
        print(
            f"{right} of {len(spent)} right; CPU s: median {np.median(spent):.1f}, largest {np.max(spent):.1f}"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
