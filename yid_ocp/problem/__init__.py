"""The estimation problem: recordings on rollout nodes, predictions, and residuals with derivatives.

Letters in shapes: N steps, n coordinates, nx entries of a state (q, p, z) or of the unknown vector x, nu driven and nc
prescribed coordinates, nk both together, m constraint equations, ntheta parameters, nr residuals, M samples of k sensor
outputs, d directions of derivatives.
"""

from yid_ocp.problem.estimation_problem import EstimationProblem as EstimationProblem
from yid_ocp.problem.evaluation import EquilibriumGuesses as EquilibriumGuesses
from yid_ocp.problem.options import ProblemOptions as ProblemOptions
from yid_ocp.problem.options import SensorOptions as SensorOptions
