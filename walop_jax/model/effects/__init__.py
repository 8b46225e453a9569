"""Physical effects beyond the base model: one file each, and `EFFECTS`, in the order light meets them."""

from collections.abc import Iterable, Sequence

from walop_jax.model.effects.base import Context, Effect
from walop_jax.model.effects.blemish import Blemish
from walop_jax.model.effects.camera_gain_drift import CameraGainDrift
from walop_jax.model.effects.camera_leakage import CameraLeakage
from walop_jax.model.effects.chwp_in_beam import ChwpInBeam
from walop_jax.model.effects.chwp_thickness import ChwpThickness
from walop_jax.model.effects.clp_ellipticity import ClpEllipticity
from walop_jax.model.effects.clp_extinction import ClpExtinction
from walop_jax.model.effects.clp_wobble import ClpWobble
from walop_jax.model.effects.clp_zero import ClpZero
from walop_jax.model.effects.described import Described
from walop_jax.model.effects.etalon import Etalon
from walop_jax.model.effects.filter_shift import FilterShift
from walop_jax.model.effects.flexure import Flexure
from walop_jax.model.effects.free_form import FreeForm
from walop_jax.model.effects.ghost import Ghost
from walop_jax.model.effects.hwp_temperature import HwpTemperature
from walop_jax.model.effects.lens_birefringence import LensBirefringence
from walop_jax.model.effects.moon_multiple_scattering import MoonMultipleScattering
from walop_jax.model.effects.moon_patch import MoonPatch
from walop_jax.model.effects.nonlinearity import Nonlinearity
from walop_jax.model.effects.other_description import OtherDescription
from walop_jax.model.effects.pedestal import Pedestal
from walop_jax.model.effects.plate_axis import ChwpAxis, Hwp1Axis, Hwp2Axis
from walop_jax.model.effects.plate_crossing import Hwp1Crossing, Hwp2Crossing
from walop_jax.model.effects.plate_cut import Hwp1AxisCut, Hwp2AxisCut
from walop_jax.model.effects.rotator_zero import RotatorZero
from walop_jax.model.effects.standard_outlier import StandardOutlier
from walop_jax.model.effects.telescope_polarisation import TelescopePolarisation
from walop_jax.model.effects.upstream_retarder import UpstreamRetarder
from walop_jax.model.effects.wollaston_axis import WollastonAxis
from walop_jax.model.parameters import unknown_name

EFFECTS: tuple[type[Effect], ...] = (
    MoonMultipleScattering,
    MoonPatch,
    RotatorZero,
    StandardOutlier,
    TelescopePolarisation,
    ClpZero,
    ClpWobble,
    ClpExtinction,
    ClpEllipticity,
    LensBirefringence,
    UpstreamRetarder,
    ChwpInBeam,
    ChwpAxis,
    ChwpThickness,
    Flexure,
    FilterShift,
    Etalon,
    HwpTemperature,
    Hwp1Axis,
    Hwp2Axis,
    Hwp1Crossing,
    Hwp2Crossing,
    Hwp1AxisCut,
    Hwp2AxisCut,
    WollastonAxis,
    Blemish,
    CameraLeakage,
    Ghost,
    Pedestal,
    Nonlinearity,
    CameraGainDrift,
)


def effect_by_name(name: str, catalogue: Sequence[type[Effect]] = EFFECTS) -> type[Effect]:
    """The effect of a catalogue by its name; ValueError with the nearest names when there is none."""
    for effect in (*catalogue, Described, FreeForm, OtherDescription):
        if effect.name == name:
            return effect
    error = unknown_name("effect", name, [effect.name for effect in catalogue])
    raise ValueError(f"{error}; one of your own needs --effects FILE.py, or catalogue= in Python")


def in_order(effects: Iterable[Effect]) -> tuple[Effect, ...]:
    """Effects in the order in which light meets them; what is not in the catalogue comes last.

    How the instrument is described comes first: the others act on that.
    """
    order = {effect.name: place for place, effect in enumerate((OtherDescription, *EFFECTS))}
    return tuple(sorted(effects, key=lambda effect: order.get(effect.name, len(order))))


__all__ = [
    "EFFECTS",
    "Context",
    "Described",
    "Effect",
    "FreeForm",
    "OtherDescription",
    "effect_by_name",
    "in_order",
]
