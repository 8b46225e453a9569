"""χ² of data with its gradient and matrix: fluxes eliminated, priors, tables, threads."""
