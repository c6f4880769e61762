"""Solvers of estimation problems, registered by name."""

from yid_ocp.solvers.base import SOLVERS as SOLVERS
from yid_ocp.solvers.base import Iterate as Iterate
from yid_ocp.solvers.base import Solution as Solution
from yid_ocp.solvers.base import Status as Status
from yid_ocp.solvers.base import fit_problem as fit_problem
from yid_ocp.solvers.gradient_methods import GaussNewton as GaussNewton
from yid_ocp.solvers.gradient_methods import SingleShooting as SingleShooting
from yid_ocp.solvers.gradient_methods import SteepestDescent as SteepestDescent
from yid_ocp.solvers.multiple_shooting import MultipleShooting as MultipleShooting
