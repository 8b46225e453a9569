"""How probable data are: one noise object that scores and draws, the flux eliminated, priors, points in memory or read anew."""
