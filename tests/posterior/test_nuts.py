"""emcee on the surrogate against NUTS on the exact posterior of all coefficients, on a real set.

python -m pytest tests/posterior/test_nuts.py --long -s
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from emcee.autocorr import integrated_time
from south_sets import SouthSet

from walop_jax.data.calset import read_calibration_set
from walop_jax.fit.base_model import base_model
from walop_jax.fit.refit import fit
from walop_jax.likelihood.likelihood import Likelihood
from walop_jax.posterior.result import Options
from walop_jax.posterior.sampling import sample
from walop_jax.posterior.target import Target

DRAWS = 4000


def effective(x: np.ndarray) -> float:
    return len(x) / float(integrated_time(x[:, None, None], quiet=True, tol=0)[0])


@pytest.mark.long
def test_emcee_agrees_with_nuts(either_south_set: Callable[[str], SouthSet]) -> None:
    """Means to 0.1 σ, widths to 5 % beyond twice the sampling error of NUTS (ours is far smaller)."""
    pytest.importorskip("blackjax")
    calset = read_calibration_set(either_south_set("a").path)
    result = fit(Likelihood.of(calset, base_model(calset))).with_verdict()
    ours = sample(result, Options(seed=1, interval=2000))
    assert ours.trusted, ours.warnings
    nuts = sample(result, Options(sampler="nuts", interval=DRAWS // 2, maximum_steps=DRAWS, draws=DRAWS))
    assert nuts.counts["divergences"] == 0
    free = result.model.free
    for name, draws in zip(Target(result).names, np.moveaxis(nuts.draws[..., free], 2, 0), strict=True):
        mean, sigma = ours.value(name)
        x = draws.ravel()
        shift, ratio = (mean - x.mean()) / sigma, sigma / x.std()
        error = 1.0 / np.sqrt(2.0 * sum(effective((chain - x.mean()) ** 2) for chain in draws))
        fit_value, fit_sigma = result.value(name)
        print(
            f"{name:30s} shift {shift:+.3f} σ, width ratio {ratio:.3f} ± {error:.3f}; "
            f"Laplace {(fit_value - x.mean()) / sigma:+.3f} σ, {fit_sigma / x.std():.3f}"
        )
        assert abs(shift) < 0.1, name
        assert abs(ratio - 1.0) < 0.05 + 2.0 * error, name
