"""Statistical inference from residuals: whitening, covariances and verdicts of parameters, null tests and smoothing."""
