"""Parameters that are a number of the instrument itself, not what is added to it (`absolute`)."""

from __future__ import annotations

import numpy as np
import pytest

from walop_jax.fit.model_file import model_without_data
from walop_jax.model.effects import Described, effect_by_name
from walop_jax.model.effects.base import Context
from walop_jax.model.effects.catalogue import entries
from walop_jax.model.effects.in_models import with_effects

ENTRY = {
    "about": "A plate of another thickness", "equation": "d = thickness", "source": "here", "revealed_by": "x",
    "separated_by": "y",
    "d": {"does": "thickness of half1.plate.mgf2", "absolute": True, "unit": "um", "width": 5.0, "about": "thickness"},
}  # fmt: skip


def test_the_ratio_is_the_extinction_whatever_the_instrument_has():
    for extinction in (2e-5, 1e-3):
        instrument = model_without_data("WALOP-SOUTH").template.changed(
            "polariser", extinction=np.array(extinction)
        )
        effect = effect_by_name("clp_extinction").of(Context(), ratio=4e-4)
        assert float(effect.patch(instrument).polariser.extinction) == pytest.approx(4e-4)


@pytest.mark.parametrize("first", ["clp_extinction", "described"])
def test_beside_a_change_of_the_same_number_it_would_be_another_number(first):
    context = Context()
    both = [effect_by_name("clp_extinction"), Described.of(context, sentences=("extinction of polariser",))]
    with pytest.raises(
        ValueError, match="'clp_extinction' and 'extinction of polariser' change the same number"
    ):
        with_effects(
            model_without_data("WALOP-SOUTH"), both if first == "clp_extinction" else both[::-1], context
        )


def test_no_other_number_can_be_stated():
    """Its value without the effect would be that of the polariser."""
    with pytest.raises(ValueError, match="d: absolute = true is for the extinction of the polariser only"):
        entries({"other_plate": ENTRY})
