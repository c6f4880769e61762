"""NLP stage driven by recorded torques, under the tracking filter, with torque errors as unknowns.

With the recorded torque ubar_k, its errors w (of a sample) and b (of a recording), the filter's gain K_k and reference
xbar_k, and the errors v_k of the angles that the filter follows, the torque that acts is

    u_k = ubar_k - w_k - b                               where encoders are measurements,
    u_k = ubar_k - w_k - b - K_k (x_k[index] - xbar_k) - K_k v_k        where they are not,

and without the errors where torques are taken as true. These are the two forms of `problem.noise`, with the errors
themselves in the place of their covariance, so that nothing is linearised.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from yid_ocp.integrator.nlp_stage import NlpStage
from yid_ocp.solvers.program_terms import LocalFunction


@dataclass(frozen=True, eq=False)
class FreeParameterSymbols:
    """Symbols of a system's parameters theta, split into free and fixed ones.

    Attributes
    ----------
    free_names : tuple of str
        Free ones.
    free_symbols : casadi.SX, shape (len(names), 1)
    nominal_symbols : casadi.SX, shape (ntheta, 1)
        Nominal values of all parameters; those of free ones are not used.
    theta : casadi.SX, shape (ntheta, 1)
        Free symbols where free, else nominal values.
    """

    free_names: tuple[str, ...]
    free_symbols: ca.SX
    nominal_symbols: ca.SX
    theta: ca.SX


@dataclass(frozen=True, eq=False)
class DrivenStage:
    """One stage as a function of local variables v = (free, x_k, x_{k+1}, lam_k, errors) and data.

    Attributes
    ----------
    stage_function : Local
        The stage's rows.
    v, data : casadi.SX
        Data are (ubar, K row by row, xbar).
    state_before, state_after : casadi.SX, shape (nx, 1)
        x_k and x_{k+1}.
    effort, torque : (casadi.SX, casadi.SX)
        Of prescribed and of driven joints, with their slopes by v.
    """

    stage_function: LocalFunction
    v: ca.SX
    data: ca.SX
    state_before: ca.SX
    state_after: ca.SX
    effort: tuple[ca.SX, ca.SX]
    torque: tuple[ca.SX, ca.SX]


def make_driven_stage(
    stage: NlpStage,
    freed: FreeParameterSymbols,
    followed: NDArray[np.int32] | None,
    momentum: NDArray[np.float64],
    noisy: bool,
    use_compiler: bool,
) -> DrivenStage:
    """Build the stage with its tracking filter and torque errors, where it has them.

    Parameters
    ----------
    stage : Stage
    freed : Freed
    followed : ndarray of int, or None
        Rows of the state that the filter follows, those of the driven joints' angles first; None without a filter.
    momentum : ndarray, shape (nu, nu)
        What torques of the step before add to the momenta that the filter follows.
    noisy : bool
        Whether errors are unknowns: w and b, and v where there is a filter.
    use_compiler : bool
    """
    index = [] if followed is None else followed.tolist()
    nx, nu, m = stage.x0.numel(), stage.u.numel(), stage.lam.numel()
    before, after, lam = ca.SX.sym("x0", nx), ca.SX.sym("x1", nx), ca.SX.sym("lam", m)
    nominal, gain = ca.SX.sym("torque", nu), ca.SX.sym("gain", nu * len(index))
    reference = ca.SX.sym("reference", len(index))
    matrix = ca.reshape(gain, len(index), nu).T
    by_errors = ca.SX(nu, 0)
    if noisy:
        # the momentum that was measured has half the impulse of the step before in it: its w is taken for this step's
        late = ca.mtimes(matrix[:, nu:], momentum) if len(index) > nu else 0.0
        by_errors = ca.horzcat(*([-ca.SX.eye(nu) - late] * 2), *([-matrix[:, :nu]] if index else []))
    errors = ca.SX.sym("errors", by_errors.shape[1])
    by_before = ca.SX(nu, nx)
    torque = nominal + ca.mtimes(by_errors, errors)
    if index:
        torque -= ca.mtimes(matrix, before[index] - reference)
        by_before[:, index] = -matrix
    symbols = [stage.x0, stage.x1, stage.lam, stage.u, stage.theta]
    by_free = stage.parameter_jacobians(freed.free_names)
    made = []
    for value, own, slopes in zip(
        (stage.residual, stage.prescribed_effort),
        by_free,
        (stage.residual_jacobians, stage.effort_jacobians),
        strict=True,
    ):
        parts = [value, own, *(slopes[name] for name in ("x0", "x1", "lam", "u"))]
        value, own, first, second, pull, by_u = ca.substitute(parts, symbols, [before, after, lam, torque, freed.theta])
        driven = ca.mtimes(by_u, by_before), ca.mtimes(by_u, by_errors)
        made.append((value, ca.horzcat(own, first + driven[0], second, pull, driven[1])))
    (rows, by_v), effort = made
    by_torque = ca.horzcat(ca.SX(nu, len(freed.free_names)), by_before, ca.SX(nu, nx + m), by_errors)
    v, data = ca.vertcat(freed.free_symbols, before, after, lam, errors), ca.vertcat(nominal, gain, reference)
    local = LocalFunction("step", [v, data, freed.nominal_symbols], rows, by_v, use_compiler)
    return DrivenStage(local, v, data, before, after, effort, (torque, by_torque))
