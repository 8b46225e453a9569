"""The optics: from Stokes vectors and settings to expected counts. No randomness, no plots; of files
only its catalogue, its references and its kept programs."""
