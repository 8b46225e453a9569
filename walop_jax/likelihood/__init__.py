"""Probability of data: noise that scores and draws, the flux eliminated, priors, a set in memory or read anew."""
