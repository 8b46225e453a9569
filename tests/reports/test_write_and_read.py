"""Records that commands write: what is read is what was written, whatever the format."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import handmade_run
import pytest
from calibration_in_words import contents
from same_record import assert_same

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.product import read_calibration, write_calibration
from walop_jax.diagnosis.detection_limits import DetectionLimits
from walop_jax.diagnosis.figure_data import read_figure_data, write_figure_data
from walop_jax.io.text import json_text, read_json

RECORDS: Mapping[str, tuple[Any, Callable[[Path, Any], None], Callable[[Path], Any]]] = {
    "calibration.fits": (
        handmade_run.product(),
        write_calibration,
        lambda path: read_calibration(path, any_model=True),
    ),
    "diagnosis.fits": (handmade_run.figure_data(), write_figure_data, read_figure_data),
    "limits.json": (
        handmade_run.limits(),
        lambda path, limits: path.write_text(json_text(limits.document())),
        lambda path: DetectionLimits.from_document(read_json(path)),
    ),
}


@pytest.mark.parametrize("name", RECORDS)
def test_a_run_is_read_as_written(tmp_path: Path, name: str):
    record, write, read = RECORDS[name]
    write(tmp_path / name, record)
    again = read(tmp_path / name)
    if isinstance(record, Calibration):
        assert_same({**contents(record), "path": tmp_path / name}, contents(again), name)
    else:
        assert_same(record, again, name)
    write(tmp_path / f"again_{name}", again)
    assert (tmp_path / f"again_{name}").read_bytes() == (tmp_path / name).read_bytes()
