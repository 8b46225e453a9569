"""The reader of docs: files, without this package and without JAX, against what the model computes."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib.resources import files

import numpy as np
from small_run import small_fit

from walop_jax.calibration.calibration import Calibration
from walop_jax.calibration.product import write_calibration

CALL = """
import sys
sys.modules["jax"] = sys.modules["walop_jax"] = None
found = matrix_at(sys.argv[1], np.array([0.1, -0.03]), np.array([-0.2, 0.05]))
for name, values in found.items():
    print(name, *(repr(float(value)) for value in values))
"""


def test_maps_are_read_by_the_code_of_the_page(tmp_path):
    text = (files("walop_jax") / "docs" / "files.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(import numpy.*?)```", text, re.DOTALL)
    calibration = Calibration.from_fit(small_fit())
    write_calibration(tmp_path / "calibration.fits", calibration)
    (tmp_path / "reader.py").write_text(code + CALL)
    words = [sys.executable, str(tmp_path / "reader.py"), str(tmp_path / "calibration.fits")]
    lines = subprocess.run(words, capture_output=True, text=True, check=True).stdout.splitlines()
    read = {name: np.array(values, float) for name, *values in map(str.split, lines)}
    matrix, covariance = calibration.matrix(np.array([0.1, -0.03]), np.array([-0.2, 0.05]))
    errors = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    for k, name in enumerate(("M21", "M22", "M23", "M31", "M32", "M33")):
        # The first point is a pixel of the maps, the second lies between pixels.
        np.testing.assert_allclose(read[name][0], matrix[0, k], atol=1e-12)
        np.testing.assert_allclose(read[name][1], matrix[1, k], atol=3e-5)
        np.testing.assert_allclose(read[f"{name}_ERR"][0], errors[0, k], rtol=1e-6)
