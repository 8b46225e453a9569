"""Names of before."""

from walop_jax.reports.diagnosis_figures import protection_figure as protection_figure
from walop_jax.reports.diagnosis_figures import separation_figure as separation_figure
