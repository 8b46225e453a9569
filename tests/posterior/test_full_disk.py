"""A disk that is full, or a quota that is used up, while a posterior or a chain is written."""

from __future__ import annotations

import subprocess
import sys
import textwrap

import pytest

WRITERS = {
    "posterior": """
        from xarray import DataTree
        from walop_jax.posterior.draws import group_of_draws
        from walop_jax.posterior.files import write_posterior
        class Sample:
            def groups(self):
                return DataTree.from_dict({"posterior": group_of_draws({"a": np.ones((4, 20000))})})
        write = lambda path: write_posterior(path, Sample())
    """,
    "chain": """
        from walop_jax.posterior.files import Chain
        from walop_jax.posterior.samplers import Stretch
        def write(path):
            there, state = Chain(path.parent, {}), {"random": ("MT19937", np.zeros(624), 0, 0, 0.0)}
            there.path = path
            there.save([state], [Stretch(np.zeros((4, 4, 20000)), np.zeros((4, 4)), np.zeros((4, 4)))], 0.0)
    """,
}
LIMITED = """
    import resource, sys
    from pathlib import Path
    import numpy as np
    {writer}
    path = Path(sys.argv[1])
    resource.setrlimit(resource.RLIMIT_FSIZE, (100000, 100000))
    try:
        write(path)
    except ValueError as error:
        print(error)
"""


@pytest.mark.parametrize("writer", WRITERS)
def test_full_disk_is_an_error_and_leaves_nothing_half_written(tmp_path, writer):
    """HDF5 itself ends the process with a segmentation fault when it cannot write."""
    path = tmp_path / "posterior.nc"
    script = textwrap.dedent(LIMITED).format(writer=textwrap.dedent(WRITERS[writer]).strip())
    done = subprocess.run(
        [sys.executable, "-c", script, str(path)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "posterior.nc: writing failed: File too large; free some space" in done.stdout
    assert ".walop" not in done.stdout + done.stderr
    assert list(tmp_path.iterdir()) == []
