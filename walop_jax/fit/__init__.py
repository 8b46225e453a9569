"""The best parameters: model files, the search for the minimum, covariance, misfit, outliers, verdict."""
