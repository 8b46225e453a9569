"""The public names, and where they live: the only list of them, for type checkers and for `__init__.py`."""

from walop_jax.calibration.calibration import Calibration as Calibration
from walop_jax.calibration.residual_map import residual_map as residual_map
from walop_jax.commands.apply import apply as apply
from walop_jax.commands.check import check as check
from walop_jax.commands.cite import cite as cite
from walop_jax.commands.compare import compare as compare
from walop_jax.commands.demo import demo as demo
from walop_jax.commands.diagnose import diagnose as diagnose
from walop_jax.commands.docs import docs as docs
from walop_jax.commands.exposures import exposures as exposures
from walop_jax.commands.gather import gather as gather
from walop_jax.commands.inputs import read as read

# Methods of results in rooms below: not public by themselves.
from walop_jax.commands.inputs import save as _save  # noqa: F401
from walop_jax.commands.inspect import inspect as inspect
from walop_jax.commands.instrument import instrument as instrument
from walop_jax.commands.limits import limits as limits
from walop_jax.commands.matrix import matrix as matrix
from walop_jax.commands.model import model as model
from walop_jax.commands.plan import plan as plan
from walop_jax.commands.plot import plot as plot
from walop_jax.commands.refit import refit as refit
from walop_jax.commands.report import report as report
from walop_jax.commands.sample import sample as sample
from walop_jax.commands.simulate import simulate as simulate
from walop_jax.commands.stack import stack as stack
from walop_jax.commands.standards import standards as standards
from walop_jax.commands.trace import trace as trace
from walop_jax.data.calset import from_arrays as from_arrays
from walop_jax.data.records import CalibrationSet as CalibrationSet
from walop_jax.data.records import FilterCurve as FilterCurve
from walop_jax.data.settings import Settings as Settings
from walop_jax.data.write import write_calibration_set as write_calibration_set
from walop_jax.fit.base_model import base_model as base_model
from walop_jax.fit.forward import forward as forward
from walop_jax.fit.many import ManyFits as ManyFits
from walop_jax.fit.many import refit_many as refit_many
from walop_jax.fit.refit import FitResult as FitResult
from walop_jax.io.errors import DataError as DataError
from walop_jax.likelihood.forward import Forward as Forward
from walop_jax.likelihood.likelihood import Likelihood as Likelihood
from walop_jax.model.effects import EFFECTS as EFFECTS
from walop_jax.model.effects import Effect as Effect
from walop_jax.model.effects import effect_by_name as effect_by_name
from walop_jax.model.effects.in_models import with_effects as with_effects
from walop_jax.model.elements.base import Element as Element
from walop_jax.model.instrument import Instrument as Instrument
from walop_jax.model.noise import with_noise as with_noise
from walop_jax.model.parameters import Scalar as Scalar
from walop_jax.model.parameters import number as number
from walop_jax.model.parameters import param as param
from walop_jax.model.specification import Model as Model
from walop_jax.posterior.result import Options as Options
from walop_jax.posterior.result import arviz_of_fit as _to_arviz  # noqa: F401
from walop_jax.posterior.run import Run as Run
from walop_jax.science.common_table import check_common_table as check_common_table
from walop_jax.simulation.observing_plan import ObservingPlan as ObservingPlan

__version__: str
