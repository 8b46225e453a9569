"""What the data of a calibration were, and what its model says of each parameter, in words."""

from __future__ import annotations

import datetime
import tomllib
from collections import Counter
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from walop_jax.calibration.product import CalibrationProduct
from walop_jax.fit.parameter_table import PRIOR_ONLY
from walop_jax.io.rounding import rounded, with_error, with_minus_sign
from walop_jax.reports.posterior_figures import LABELS

_MJD_0 = datetime.datetime(1858, 11, 17)
_MANY = 12


def data_in_words(product: CalibrationProduct) -> list[tuple[str, str]]:
    """Nights, exposures, polariser angles, plate settings, Moon patches, standards, temperatures, filters."""
    e = product.exposures
    kinds = ", ".join(f"{number} {kind}" for kind, number in Counter(e.kind.tolist()).items())
    low_x, high_x, low_y, high_y = product.field
    rows = [
        ("Nights", _nights(e.mjd)),
        ("Exposures", f"{len(e)} ({kinds})"),
        ("Field", with_minus_sign(f"X {low_x:+.2f} to {high_x:+.2f}°, Y {low_y:+.2f} to {high_y:+.2f}°")),
        ("Polariser angles", _angles(e.clp_angle[e.clp_in])),
        ("Calibration plate", _settings(e.chwp_angle[e.chwp_in], bool((~e.chwp_in).any()))),
    ]
    rows += [
        (prefix, _settings(p.angle[p.inside], bool((~p.inside).any()))) for prefix, p in e.moving.items()
    ]
    moon = (e.kind == "moon") & ~e.clp_in
    places = {(round(float(a), 3), round(float(d), 3)) for a, d in zip(e.ra[moon], e.dec[moon], strict=True)}
    names = [str(name) for name in product.sources.name]
    listed = ", ".join(names[:_MANY]) + (f" and {len(names) - _MANY} more" if len(names) > _MANY else "")
    rows += [
        ("Moon patches", str(len(places)) if places else "none"),
        ("Standards", listed or "none"),
        ("Temperature", _range(e.temp, "°C")),
        ("Filters", ", ".join(sorted({str(name) for name in e.filter}))),
    ]
    return rows


def _nights(mjd: Float[np.ndarray, " e"]) -> str:
    # Noon UTC divides nights: right from Chile to South Africa.
    known = np.unique(np.floor(mjd[np.isfinite(mjd)] - 0.5))
    days = [(_MJD_0 + datetime.timedelta(days=float(day))).date().isoformat() for day in known]
    if not days:
        return "not recorded"
    return days[0] if len(days) == 1 else f"{len(days)}, {days[0]} to {days[-1]}"


def _angles(angles: Float[np.ndarray, " a"]) -> str:
    if angles.size == 0:
        return "none"
    turn = np.unique(np.round(np.mod(angles, 180.0), 3))
    gap = np.diff(np.append(turn, turn[0] + 180.0)).max()
    full = ", over a full turn" if np.ptp(np.mod(angles, 360.0)) > 180.0 else ""
    return f"{len(turn)} modulo 180°, widest gap {gap:.3g}°{full}"


def _settings(angles: Float[np.ndarray, " a"], out: bool) -> str:
    found = (["out"] if out else []) + [f"{angle:g}°" for angle in np.unique(np.round(angles, 3))]
    return ", ".join(found[:_MANY]) + (f" and {len(found) - _MANY} more" if len(found) > _MANY else "")


def _range(values: Float[np.ndarray, " e"], unit: str) -> str:
    known = values[np.isfinite(values)]
    if known.size == 0:
        return "not recorded"
    low, high = f"{known.min():.1f}", f"{known.max():.1f}"
    return with_minus_sign(f"{low} {unit}" if low == high else f"{low} to {high} {unit}")


def model_entries(product: CalibrationProduct) -> dict[str, dict[str, str]]:
    """Start, prior, and state (fixed, tied to another, known from its prior only) of every parameter, by name."""
    try:
        written = tomllib.loads("\n".join(product.model)).get("parameters", {})
    except tomllib.TOMLDecodeError:
        written = {}
    table, found = product.parameters, {}
    for i, name in enumerate(table.name.tolist()):
        entry, width, mean = written.get(name, {}), float(table.prior_width[i]), float(table.prior_mean[i])
        state = "" if table.free[i] else "fixed"
        if "tie" in entry:
            state = f"tied to {entry['tie']}"
        elif table.free[i] and np.isfinite(width) and table.sigma[i] > PRIOR_ONLY * width:
            state = "prior only"
        start = entry.get("start")
        found[name] = {
            "start": "" if start is None or start == mean else rounded(float(start), ".6g"),
            "prior": "" if not np.isfinite(width) else with_error(mean + 0.0, width),
            "state": state,
        }
    return found


def symbols_in_words(names: Sequence[str]) -> str:
    """The symbols that figures of a posterior use, with the names they stand for."""
    plain = {
        name: LABELS[name].replace("$", "").replace("{", "").replace("}", "")
        for name in names
        if name in LABELS
    }
    return (
        "Symbols: " + ", ".join(f"{symbol} {name}" for name, symbol in plain.items()) + "." if plain else ""
    )
