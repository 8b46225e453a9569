"""How probable data are: a noise object that scores and draws, the flux eliminated, priors, a set in memory or read anew."""
