"""What is to be estimated from what: inputs and samples on the nodes, residuals, and the `EstimationProblem`.

Solvers see only `evaluate` and `gradient`; change what is compared with what here, never in a solver.
"""

from yid_ocp.problem.evaluation import Evaluation as Evaluation
from yid_ocp.problem.evaluation import WarmStart as WarmStart
from yid_ocp.problem.options import ProblemOptions as ProblemOptions
from yid_ocp.problem.options import SensorOptions as SensorOptions
from yid_ocp.problem.problem import EstimationProblem as EstimationProblem
