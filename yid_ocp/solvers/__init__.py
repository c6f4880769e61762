"""Solvers of estimation problems: one file for each method, registered by name."""

from yid_ocp.solvers.base import SOLVERS as SOLVERS
from yid_ocp.solvers.base import Iterate as Iterate
from yid_ocp.solvers.base import Solution as Solution
from yid_ocp.solvers.base import Status as Status
from yid_ocp.solvers.base import solve as solve
from yid_ocp.solvers.gauss_newton import GaussNewton as GaussNewton
from yid_ocp.solvers.multiple_shooting import MultipleShooting as MultipleShooting
from yid_ocp.solvers.single_shooting import SingleShooting as SingleShooting
from yid_ocp.solvers.steepest_descent import SteepestDescent as SteepestDescent
