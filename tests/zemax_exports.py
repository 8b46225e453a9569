"""Text exports "Polarization Transmission", written by hand after the layout of real ones: small, with round numbers.

The instrument is four ideal analysers at 0°, 90°, 45°, 135° (configurations 1, 3, 2, 4) of 10 % transmission.
"""

from __future__ import annotations

from pathlib import Path

AXES = {1: (1.0, 0.0), 3: (-1.0, 0.0), 2: (0.0, 1.0), 4: (0.0, -1.0)}
"""Analyser of each configuration as (cos 2α, sin 2α)."""

STATES = {
    None: (0.0, 0.0),
    ("1.0000", "0.0000"): (1.0, 0.0),
    ("0.7071", "0.7071"): (0.0, 1.0),
    ("0.0000", "1.0000"): (-1.0, 0.0),
    ("-0.7071", "0.7071"): (0.0, -1.0),
    ("-1.0000", "-0.0000"): (1.0, 0.0),
}
"""X-Field and Y-Field as they are printed (None: unpolarised) and the (q, u) of that light."""

FIELDS = ("-0.1600, 0.0100", "0.2500, 0.0100", "-0.1600, -0.0300")
WAVELENGTHS = ("0.5400", "0.6600")


def transmission(configuration: int, state: tuple[str, str] | None, field: int, wavelength: int) -> str:
    """5 % to 5.9 % of unpolarised light, more or less by field point and wavelength, to nine decimals.

    Extinction is not perfect: 10⁻⁶ gets through.
    """
    (c, s), (q, u) = AXES[configuration], STATES[state]
    level = 0.05 + 0.001 * configuration + 0.002 * field + 0.0005 * wavelength
    return f"{level * (1 + c * q + s * u) + 1e-6:.9f}"


def export_text(
    configuration: int = 1,
    state: tuple[str, str] | None = ("1.0000", "0.0000"),
    fields: tuple[str, ...] = FIELDS,
    title: str = "WALOP-North",
) -> str:
    """The text of one export, lines ended by a line feed."""
    lines = ["Polarization Transmission Data", "", r"File : C:\design\by_hand.zmx", f"Title: {title}"]
    lines += ["Date : 9/12/2023", f"Configuration {configuration} of 4", ""]
    if state is None:
        lines += ["Field is unpolarized."]
    else:
        lines += [f"X-Field     : {state[0]:>7}", f"Y-Field     : {state[1]:>7}"]
        lines += ["X-Phase     :    0.00", "Y-Phase     :    0.00"]
    lines += ["", "Grid Size : 32 x 32", "", "Aperture, Fresnel, coating effects are considered.", ""]
    for n, field in enumerate(fields):
        place = FIELDS.index(field) if field in FIELDS else n
        values = [transmission(configuration, state, place, k) for k in range(len(WAVELENGTHS))]
        lines += [f"Field Pos : {field} (deg)"]
        lines += [f"  Transmission at    {w}:     {v}" for w, v in zip(WAVELENGTHS, values, strict=True)]
        lines += [f"  Total Transmission       :     {sum(map(float, values)) / len(values):.9f}", ""]
    lines += ["", "Chief Ray Transmission Surface By Surface:", ""]
    lines += [f"Field Pos : {fields[0]} (deg)", "Wavelength 1: 0.540 \N{MICRO SIGN}m", ""]
    lines += ["Surf    Tot. Tran    Rel. Tran", " Chief ray does not trace or is vignetted.", ""]
    return "\n".join(lines)


def write_folder(folder: Path) -> Path:
    """All exports of the ideal instrument: the polarised ones in Config_n, the unpolarised in Unpol/Config_n."""
    for configuration in AXES:
        for n, state in enumerate(STATES):
            place = folder / ("Unpol" if state is None else "") / f"Config_{configuration}"
            place.mkdir(parents=True, exist_ok=True)
            text = export_text(configuration, state)
            (place / f"transmission_field1_pol{n}.txt").write_text(text, encoding="latin-1")
    return folder
