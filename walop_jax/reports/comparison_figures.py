"""Names of before."""

from walop_jax.reports.paper_figures import histogram_figure as histogram_figure
from walop_jax.reports.paper_figures import map_figure as map_figure
from walop_jax.reports.paper_figures import offset_figure as offset_figure
from walop_jax.reports.paper_figures import plate_figure as plate_figure
from walop_jax.reports.paper_figures import spectral_figure as spectral_figure
