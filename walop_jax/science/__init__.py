"""From counts to Stokes parameters: a calibration at work, and the paper's method beside it."""
