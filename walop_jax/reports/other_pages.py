"""Names of before."""

from walop_jax.reports.page import kind_of_run as kind_of_run
from walop_jax.reports.page import render_other as render_other
