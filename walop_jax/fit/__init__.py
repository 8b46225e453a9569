"""Finding the best parameters and carrying them to the sky: fit, gates, covariance, instrument matrix."""
