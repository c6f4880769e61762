"""Statistical inference from residuals, with whitening, covariances, verdicts, null tests and smoothing."""
