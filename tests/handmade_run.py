"""The folder of a run, typed by hand: every number that a page may show is known here and computed nowhere."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from builders import exposures, monochromatic
from calibration_in_words import in_words

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.matrix import MatrixMaps
from walop_jax.calibration.product import write_calibration
from walop_jax.data.grid import Grid
from walop_jax.data.records import InputFile, Points, Site, Sources
from walop_jax.diagnosis.detection_limits import DetectionLimit, DetectionLimits
from walop_jax.diagnosis.figure_data import DiagnosisFigureData, ResidualComparison, write_figure_data
from walop_jax.fit.verdict import Verdict
from walop_jax.io.display import Display
from walop_jax.io.text import json_text
from walop_jax.model.parameters import Parameter

INPUT = "night <b>one</b> & two.fits"
X, Y = (grid.ravel() for grid in np.meshgrid(np.linspace(-0.2, 0.2, 3), np.linspace(-0.2, 0.2, 3)))

FIT = Display(
    "Fit of WALOP-SOUTH: trusted",
    (("p of a star", "0.070 % (median error for p ≤ 5 %)"), ("χ²/dof", "1234.5 / 1200 = 1.029")),
    ("parameter", ">value", ">error", "unit", ">start", "prior", ""),
    (
        ("pupil.magnification", "15.751", "0.021", "", "", "15.630 ± 0.050", ""),
        ("half1.wedge", "-0.23012", "0.00045", "rad", "", "-0.2300 ± 0.0010", ""),
        ("clp_wobble.amplitude", "0.0613", "0.0012", "deg", "", "0.00 ± 0.10", ""),
    ),
    ("1 throughput term not shown",),
)
"""What `refit` displays."""
FOUND = Display(
    "Diagnosis: effect found; fit trusted",
    (("found", "clp_wobble"), ("χ²/dof", "1.625 → 1.029")),
    ("effect", "parameter", ">value", ">error", "unit", ">p"),
    (("clp_wobble", "amplitude", "0.0613", "0.0012", "deg", "2.1 × 10⁻⁷"),),
    ("clp_wobble: χ² 1950.2 → 1234.5", "what would: polariser angles <over> a full turn"),
)
"""What `diagnose` displays."""

SUMMARY: dict[str, Any] = {
    "chi2": 1234.5, "dof": 1200, "n_data": 1608,
    "parameters": {
        "pupil.magnification": {"value": 15.7512, "sigma": 0.0213, "unit": ""},
        "half1.wedge": {"value": -0.23012, "sigma": 0.00045, "unit": "rad"},
        "throughput.n0.p00": {"value": 0.5, "sigma": 0.001, "unit": ""},
        "clp_wobble.amplitude": {"value": 0.0613, "sigma": 0.0012, "unit": "deg"},
        "half1.efficiency": {"value": 0.999, "sigma": 0.0, "unit": ""},
    },
    "converged": True, "message": "converged", "seconds": 3.0,
    "versions": {"python": "3.11.7", "walop-jax": "0.1.0"},
    "inputs": [{"path": INPUT, "sha256": "ab" * 32}],
    "trusted": True, "quality": 0, "warnings": ["half1.wedge lies <far> out"], "instrument": "WALOP-SOUTH",
    "free_parameters": 4, "misfit": None, "remarks": [], "shown": FIT.document(),
}  # fmt: skip

DIAGNOSIS: dict[str, Any] = {
    "verdict": "effect_found",
    "steps": [
        {
            "effect": "clp_wobble",
            "parameters": {"amplitude": {"value": 0.0613, "sigma": 0.0012, "unit": "deg"}},
            "score": 321.5, "p_value": 2.1e-7, "chi2_before": 1950.25, "chi2_after": 1234.5,
            "heldout_before": 1.25, "heldout_after": 0.752,
            "equivalent": ["camera_gain_drift"], "separated_by": "polariser angles over a full turn",
            "where": {"camera": "E1 60%, O1 40%", "clp_harmonic": "3θ 53%, 1θ 46%", "kind": "clp 100%"},
        }
    ],
    "candidates": [
        {"effect": "clp_wobble", "score": 321.5, "p_value": 2.1e-7},
        {"effect": "ghost", "score": 4.75, "p_value": 0.64},
    ],
    "unexplained": None,
    "p_value": 2.1e-7, "cannot_be_tested": ["chwp_axis"],
    "chi2_per_dof_before": 1.625208, "chi2_per_dof_after": 1234.5 / 1200, "shown": FOUND.document(),
}  # fmt: skip


def parameters(*rows: tuple[str, str, float, tuple[float, float] | None, bool]) -> tuple[Parameter, ...]:
    """Parameters typed by hand: name, unit, start, prior, free."""
    return tuple(
        Parameter(name, unit, "", "", start, prior, free, 1.0, part=name.partition(".")[0])
        for name, unit, start, prior, free in rows
    )


def product() -> Calibration:
    entries = SUMMARY["parameters"]
    sigma = np.array([entry["sigma"] for entry in entries.values()])
    priors = ((15.63, 0.05), (-0.23, 0.001), None, (0.0, 0.1), None)
    grid = Grid(5, 5, (3.0, 3.0), (0.0, 0.0), ((0.1, 0.0), (0.0, 0.1)))
    ramp = np.linspace(-0.03, 0.02, 25).reshape(5, 5)
    maps = MatrixMaps(grid, "band", np.stack([ramp + k for k in range(6)]), np.full((6, 5, 5), 2e-4))
    rows = [
        (name, entry["unit"], entry["value"] if prior is None else prior[0], prior, entry["sigma"] > 0)
        for (name, entry), prior in zip(entries.items(), priors, strict=True)
    ]
    return in_words(
        instrument="WALOP-SOUTH",
        parameters=parameters(*rows),
        maps=maps,
        values=np.array([entry["value"] for entry in entries.values()]),
        site=Site("SAAO", -32.38, 20.81, 1798.0),
        origin="a hand",
        date="2026-11-21T10:00:00",
        verdict=Verdict(1234.5, 1200, 1608, 1.0, True),
        covariance=np.diag(sigma**2),
        field=(-0.2, 0.2, -0.2, 0.2),
        exposures=exposures({"clp_angle": 0.0}, {"clp_angle": 45.0}),
        filters={"band": monochromatic(0.62)},
        sources=Sources.none(),
        inputs=(InputFile(Path("night.fits"), "ab" * 32),),
        versions={"python": "3.11.7"},
    )


def comparison(effect: str, size: float = 6.0) -> ResidualComparison:
    """Camera k shows `size` · (k + 1) / 4 at one corner before, nothing but ±0.5 after."""
    before = np.zeros((9, 4))
    before[0] = size * np.array([1, 2, 3, -4]) / 4
    after = np.full((9, 4), 0.5) * (-1.0) ** np.arange(9)[:, None]
    angle = np.deg2rad(22.5 * np.arange(8))
    wave = np.sin(3 * angle)[:, None] * np.array([1.0, -1.0, 0.5, 0.25])
    return ResidualComparison(
        effect=effect,
        combination="cos(3 theta - 57 deg), theta the polariser angle",
        harmonic=3,
        field={
            "BEFORE": before,
            "AFTER": after,
            "EXPLAINED": before - after,
            "MEAN_BEFORE": 0.1 * before,
            "MEAN_AFTER": 0.1 * after,
            "RMS_BEFORE": np.abs(before) + 0.9,
            "RMS_AFTER": np.full((9, 4), 0.9),
        },
        curves={"BEFORE": wave, "ERROR": np.full((8, 4), 0.05), "AFTER": np.zeros((8, 4)), "EXPLAINED": wave},
    )


def figure_data(effects: tuple[str, ...] = ("clp_wobble",)) -> DiagnosisFigureData:
    return DiagnosisFigureData(
        points=Points(np.arange(9), X, Y),
        exposures={
            "EXPOSURE": np.arange(8),
            "KIND": np.array(["clp"] * 8),
            "MJD": 61043.0 + 0.01 * np.arange(8),
            "CLP_ANGLE": 22.5 * np.arange(8),
        },
        ladder={
            "MODEL": np.array(["starting model", *effects]),
            "CHI2": np.linspace(1950.25, 1234.5, len(effects) + 1),
            "DOF": np.full(len(effects) + 1, 1200),
        },
        shares={
            "GROUP": np.array(["camera"] * 4 + ["exposure"] * 8),
            "MEMBER": np.array(["O1", "E1", "O2", "E2", *(str(i) for i in range(8))]),
            "EXPECTED": np.full(12, 100.0),
            "BEFORE": np.linspace(100.0, 300.0, 12),
            "AFTER": np.full(12, 100.0),
        },
        comparisons=(comparison(""), *(comparison(effect) for effect in effects)),
    )


def make_refit(folder: Path, **changes: Any) -> Path:
    """A run as `refit` leaves it; `changes` replace entries of its summary."""
    folder.mkdir(exist_ok=True)
    (folder / "summary.json").write_text(json.dumps(SUMMARY | changes))
    write_calibration(folder / "calibration.fits", product(), overwrite=True)
    return folder


def make_diagnosis(folder: Path, **changes: Any) -> Path:
    """A run as `diagnose` leaves it; `changes` replace entries of its diagnosis."""
    make_refit(folder)
    content = DIAGNOSIS | changes
    (folder / "diagnosis.json").write_text(json.dumps(content))
    effects = tuple(step["effect"] for step in content["steps"])
    write_figure_data(folder / "diagnosis.fits", figure_data(effects), overwrite=True)
    return folder


def limits() -> DetectionLimits:
    """What a set can show: two effects, one of them never named, and a point where an exposure gives no u."""
    nothing = float("nan")
    return DetectionLimits(
        limits=(
            DetectionLimit("ghost", "share", "", (0.00041, 0.00041), 0.00052, (), (0.0003, 0.0125)),
            DetectionLimit(
                "clp_zero", "angle", "deg", (0.012, 0.4), np.inf, ("clp_wobble",), (nothing, nothing)
            ),
        ),
        effects=("ghost", "clp_zero"),
        separation=np.array([[nothing, 7.0], [2.5, nothing]]),
        x=np.array([-0.1, 0.2, 0.0]),
        y=np.array([0.0, -0.2, 0.1]),
        protection=np.array([0.001, 0.0125, nothing]),
        caused_by=("clp_zero", "ghost", ""),
        untestable=("chwp_axis",),
    )


def make_limits(folder: Path, sha256: str = "ab" * 32) -> Path:
    """A folder as `limits` leaves it, of data with this checksum."""
    document = limits().document() | {
        "shown": limits().display().document(),
        "instrument": "WALOP-SOUTH",
        "inputs": [{"path": INPUT, "sha256": sha256}],
    }
    (folder / "limits.json").write_text(json_text(document))
    return folder
