"""An observing plan as a TOML file: what `ObservingPlan` has, by the same names, and nothing else.

instrument = "WALOP-SOUTH"        # or a description file, beside the plan
grid = 12
polariser_angles = 15             # so many over half a turn; or a list of angles (deg)
full_turn = true                  # those over a full one
plate = ["out", 0, 45]
filters = ["SDSS-r", "NB-660"]
electrons = 5e5

[[stops]]                         # each exposure through the polariser, in place of all combinations
polariser_angle = 33.75
plate = "out"
times = 4
seconds = 20                      # exposure time; electrons are those of the usual one

[[stops]]
kind = "moon"                     # or "standard", with place = 12 for one place of its raster; "lamp"
number = 3
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomlkit

from walop_jax.io.errors import errors_naming, fail
from walop_jax.io.text import parse_toml, read_text
from walop_jax.model.instrument import Instrument
from walop_jax.model.parameters import unknown_name
from walop_jax.simulation.observing_plan import ObservingPlan, Stop, polariser_turn

OUT = "out"
_ANGLES = len(polariser_turn())
FULL_TURN = "full_turn"
_STOP = tuple(field.name for field in dataclasses.fields(Stop))
_KNOWN = (*(field.name for field in dataclasses.fields(ObservingPlan)), FULL_TURN)


def is_plan(path: str | os.PathLike[str]) -> bool:
    """True for a file that is a plan by its name."""
    return Path(path).suffix.lower() == ".toml"


def read_plan(
    path: str | os.PathLike[str], instrument: str | os.PathLike[str] | None = None
) -> ObservingPlan:
    """The plan of a file; `instrument`, a name or a description file, goes before its own.

    Raises `DataError` for a file that cannot be read, for names and values that a plan does not have.
    """
    with errors_naming(path):
        return plan_of(parse_toml(read_text(path)), Path(path).parent, instrument)


def plan_of(
    content: dict[str, Any], folder: Path, instrument: str | os.PathLike[str] | None = None
) -> ObservingPlan:
    """The plan of the entries of a file in `folder`; the rest as `read_plan`."""
    content = dict(content)
    for name in content:
        if name not in _KNOWN:
            raise unknown_name("entry of a plan", name, _KNOWN)
    own = content.pop("instrument", None)
    if instrument is None and own is not None:
        beside = folder / str(own)
        instrument = beside if beside.suffix == ".toml" else str(own)
    full_turn, angles = content.pop(FULL_TURN, None), content.get("polariser_angles", _ANGLES)
    if isinstance(angles, int):
        content["polariser_angles"] = polariser_turn(angles, full_turn=bool(full_turn))
    elif full_turn is not None:
        raise ValueError(
            f"{FULL_TURN} is of no use beside a list of angles; give their number, or leave it out"
        )
    stops = content.pop("stops", [])
    values = {name: _value(value) for name, value in content.items()}
    for stop in stops:
        for name in stop:
            if name not in _STOP:
                raise unknown_name("entry of a stop", name, _STOP)
    try:
        values["stops"] = tuple(Stop(**_value(stop)) for stop in stops)
        return ObservingPlan(None if instrument is None else Instrument.read(instrument), **values)
    except TypeError as error:  # text where a number belongs
        raise fail(str(error), advice="see `walop-jax docs files` for a plan") from None


def _value(value: Any) -> Any:
    """Lists as tuples, and None for what is out."""
    if isinstance(value, list):
        return tuple(_value(one) for one in value)
    if isinstance(value, dict):
        return {name: _value(one) for name, one in value.items()}
    return None if value == OUT else value


def plan_text(plan: ObservingPlan) -> str:
    """A plan as the text of a file that `read_plan` reads.

    An instrument of one's own goes by its name: set `instrument` to its description file.
    """
    return tomlkit.dumps(
        {name: _written(value) for name, value in plan.document().items() if value is not None}
    )


def _written(value: Any) -> Any:
    """Lists and tables as TOML has them, OUT for what is out."""
    if isinstance(value, Mapping):
        return {name: _written(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [_written(one) for one in value]
    return OUT if value is None else value
