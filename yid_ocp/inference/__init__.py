"""What residuals say: whitening by input noise, covariance and verdicts of parameters, null test, and smoother."""

from yid_ocp.inference.smoother import SmootherResult as SmootherResult
from yid_ocp.inference.smoother import run_smoother as run_smoother
from yid_ocp.inference.uncertainty import ParameterEstimate as ParameterEstimate
from yid_ocp.inference.whitening import whitened_at as whitened_at
from yid_ocp.inference.whitening import without_input_errors as without_input_errors
