"""The optics: from Stokes vectors and settings to expected counts. No files, no randomness, no plots."""
