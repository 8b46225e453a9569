"""Words of pages beside those that results display of themselves: captions, effects, the data of a run, symbols."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence

import numpy as np
from jaxtyping import Float

from walop_jax.calibration.calibration import Calibration
from walop_jax.data.kinds import CALIBRATION_PLATE, POLARISER
from walop_jax.io.errors import DataError
from walop_jax.io.text import date_of, some, with_minus_sign
from walop_jax.model.effects import EFFECTS, EffectKind, in_a_sentence
from walop_jax.model.effects.free_form import FreeForm
from walop_jax.reports.style import texts
from walop_jax.sky.nights import night_of


def effect_in_words(name: str, catalogue: Iterable[EffectKind] = EFFECTS) -> str:
    """A few words on an effect that may stand inside a sentence; empty for a name that is not in the catalogue."""
    if name == FreeForm.name:
        return "unidentified patterns"
    kind = next((entry for entry in catalogue if entry.name == name), None)
    return "" if kind is None else in_a_sentence(kind)


def listed(items: Sequence[str]) -> str:
    """`a`, `a and b`, `a, b and c`."""
    return " and ".join([", ".join(items[:-1]), items[-1]] if len(items) > 1 else items)


_MANY = 12
_KINDS = {"clp": "through the polariser", "moon": "of the moonlit sky", "standard": "of standard stars"}


def data_in_words(calibration: Calibration) -> tuple[tuple[str, str], ...]:
    """Nights, exposures, polariser angles, plate settings, Moon patches, standards, temperatures, filters."""
    e, in_words = calibration.exposures, _reading_in_words(calibration)
    counts = Counter(e.kind.tolist()).items()
    kinds = ", ".join(f"{number} {_KINDS.get(kind, kind)}" for kind, number in counts)
    low_x, high_x, low_y, high_y = calibration.field
    rows = [
        ("Nights", _nights(e.mjd, calibration.site.longitude)),
        ("Exposures", f"{len(e)} ({kinds})"),
        ("Field", with_minus_sign(f"X {low_x:+.2f} to {high_x:+.2f}°, Y {low_y:+.2f} to {high_y:+.2f}°")),
        ("Polariser angles", _angles(e.clp_angle[e.clp_in])),
    ]
    for prefix, p in e.positions.items():
        if prefix != POLARISER:
            name = "Calibration plate" if prefix == CALIBRATION_PLATE else prefix
            said = {
                in_words(prefix, float(reading)): None
                for reading in np.unique(np.round(p.angle[p.inside], 3))
            }
            rows.append((name, some([*(["out"] if (~p.inside).any() else []), *said], _MANY)))
    moon = e.direct("moon")
    places = {(round(float(a), 3), round(float(d), 3)) for a, d in zip(e.ra[moon], e.dec[moon], strict=True)}
    standards = some([str(name) for name in calibration.sources.name], _MANY)
    rows += [
        ("Moon patches", str(len(places)) if places else "none"),
        ("Standards", standards or "none"),
        ("Temperature", _range(e.temp, "°C")),
        ("Filters", ", ".join(sorted({str(name) for name in e.filter}))),
    ]
    return tuple(rows)


def _reading_in_words(calibration: Calibration) -> Callable[[str, float], str]:
    """`Instrument.reading_in_words`; the number alone where a class of the instrument is missing in this process."""
    try:
        return calibration.design.reading_in_words
    except DataError:
        return lambda _, reading: with_minus_sign(f"{reading:g}")


def _nights(mjd: Float[np.ndarray, " e"], longitude: float) -> str:
    evenings = np.unique(night_of(mjd[np.isfinite(mjd)], longitude))
    days = [date_of(day) for day in evenings]
    if not days:
        return "not recorded"
    return days[0] if len(days) == 1 else f"{len(days)}, {days[0]} to {days[-1]}"


def _angles(angles: Float[np.ndarray, " a"]) -> str:
    if angles.size == 0:
        return "none"
    turn = np.unique(np.mod(np.round(angles, 3), 180.0))
    gap = np.diff(np.append(turn, turn[0] + 180.0)).max()
    full = ", over a full turn" if np.ptp(np.mod(angles, 360.0)) > 180.0 else ""
    return f"{len(turn)} modulo 180°, widest gap {gap:.3g}°{full}"


def _range(values: Float[np.ndarray, " e"], unit: str) -> str:
    finite = values[np.isfinite(values)]
    if finite.size == 0:
        return "not recorded"
    low, high = f"{finite.min():.1f}", f"{finite.max():.1f}"
    return with_minus_sign(f"{low} {unit}" if low == high else f"{low} to {high} {unit}")


PLACES = {
    "half1": "half1, the half of the pupil with HWP1",
    "half2": "half2, the half with HWP2",
    "chwp": "chwp, the calibration half-wave plate",
    "throughput": "n0, n1, …, the cameras in their order (O1, E1, O2, E2 of WALOP)",
}


def names_in_words(names: Iterable[str]) -> str:
    """Meanings of the first parts of names of parameters, where that is no word of its own."""
    used = {name.partition(".")[0] for name in names}
    meanings = [words for prefix, words in PLACES.items() if prefix in used]
    return f"Parts of parameter names: {'; '.join(meanings)}." if meanings else ""


def symbols_in_words(names: Sequence[str]) -> str:
    """The symbols that figures of a posterior use, and their names."""
    symbols = [f"{texts('symbols')[name][1]} {name}" for name in names if name in texts("symbols")]
    return f" Symbols: {', '.join(symbols)}." if symbols else ""
