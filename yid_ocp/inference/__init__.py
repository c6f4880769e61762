"""What residuals say: whitening by input noise, covariance and verdicts of parameters, null test, and smoother."""
