"""Posteriors around a fit: emcee on a checked surrogate of the exact posterior, NUTS on the posterior itself.

This room samples and says how far to believe it. It draws no figures, and knows no FITS.
"""
