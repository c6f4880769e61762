"""The estimation problem: recordings on rollout nodes, predictions, and residuals with derivatives."""

from yid_ocp.problem.estimation_problem import EstimationProblem as EstimationProblem
from yid_ocp.problem.evaluation import EquilibriumGuesses as EquilibriumGuesses
from yid_ocp.problem.evaluation import Evaluation as Evaluation
from yid_ocp.problem.options import ProblemOptions as ProblemOptions
from yid_ocp.problem.options import SensorOptions as SensorOptions
