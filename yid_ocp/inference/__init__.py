"""Statistical inference from residuals: whitening, covariances, verdicts, null tests and smoothing."""
