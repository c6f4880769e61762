"""Multiple shooting with node states as unknowns, solved by IPOPT or condensed onto the parameters."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar

import casadi as ca
import numpy as np
from annotated_types import Ge, Gt

from yid_ocp.arrays import Array, IntArray
from yid_ocp.errors import SolverError
from yid_ocp.inference import linearized_residual
from yid_ocp.inference.linearized_residual import bounded_levenberg_marquardt_step, max_abs_projected_gradient
from yid_ocp.integrator.step import simulate
from yid_ocp.integrator.step_model import Rollout, SensitivityDirections
from yid_ocp.options import OptionInfo
from yid_ocp.problem.episodes import InitialStateWithSensitivity
from yid_ocp.problem.estimation_problem import EstimationProblem
from yid_ocp.solvers import base, nonlinear_program, symbolic_transcription
from yid_ocp.solvers.initial_guess import guess_unknowns_and_node_states, mean_square_of_non_effort_residuals
from yid_ocp.solvers.nonlinear_program import QUIET_NLPSOL_OPTIONS, HessianKind, NonlinearProgram

log = logging.getLogger(__name__)

_MEMORY_WARNING_BYTES = 2e9
_CONDENSING_NODE_INTERVAL = 20
# Condensing. Largest factor by which one iteration changes an unknown that is positive by nature.
_MAX_CHANGE_FACTOR = 3.0
# Required reduction factor of cost or defects; shortest fraction of a step that is tried.
_IMPROVEMENT_MARGIN = 1.0 - 1e-5
_MIN_STEP_FRACTION = 1e-3
# Damping up to which a step predicts the possible decrease of the cost; damping above which the search stalls.
_MAX_TRUSTED_DAMPING, _STALLED_DAMPING = 0.1, 1e2
# Largest defect that counts as closed [rad, m or N m s].
_CLOSED_DEFECT = 1e-7


@base.SOLVERS.register("multiple_shooting")
@dataclass(frozen=True)
class MultipleShooting(base.SolverWithCheckedSettings):
    """A multiple shooting method that minimises 1/2 |r|^2 over parameters and node states, subject to the dynamics.

    IPOPT solves the program of `transcribe`, whose constraints are the discrete Euler-Lagrange equations of every step.
    Defects (violations of these constraints) are scaled to order one, the cost by its initial value, and IPOPT's own
    scaling is off. In these units IPOPT's initial bound multipliers of one weigh as much as the cost, so that the first
    steps change no parameter by much more than a factor. A much larger barrier parameter than the default pushes poorly
    informed parameters off their bounds.

    With `condensing`, the steps between nodes are rolled out, and Gauss-Newton iterates on node states s_j and
    parameters x with defects d_j = F^n(s_j, x) - s_{j+1}, where F^n are the n steps between two nodes. A linear step
    closes every defect. The recursion S_{j+1} = A_j S_j + B_j, c_{j+1} = A_j c_j + d_j expresses all node steps by the
    parameters' step. An iteration therefore costs one sweep, with one direction more than in single shooting. A step is
    accepted if it improves the cost or the defects.

    References
    ----------
    Bock and Plitt (1984), IFAC Proc. 17(2):1603, doi:10.1016/S1474-6670(17)61205-9.
    Waechter and Biegler (2006), Math. Programming 106:25, doi:10.1007/s10107-004-0559-y.
    Albersmeyer and Diehl (2010), SIAM J. Optim. 20(3):1655, doi:10.1137/080724885 (condensing).
    """

    condensing: Annotated[
        bool,
        OptionInfo("whether node states are condensed onto the parameters, at the cost of single shooting; else IPOPT"),
    ] = False
    node_interval: Annotated[
        int | None,
        Ge(1),
        OptionInfo("steps between nodes; above 1 only with condensing; default: 1, with condensing 20"),
    ] = None
    hessian: Annotated[
        HessianKind, OptionInfo("Hessian of the Lagrangian in IPOPT; exact adds the curvature of equations and sensors")
    ] = "gauss_newton"
    max_iterations: Annotated[int, Ge(1), OptionInfo("limit on iterations")] = 200
    step_tolerance: Annotated[
        float, Gt(0), OptionInfo("condensing: converged if no unknown moves by more than this fraction of its size")
    ] = 1e-5
    cost_tolerance: Annotated[
        float, Gt(0), OptionInfo("condensing: converged if the predicted relative decrease of the cost is below this")
    ] = 1e-5
    ipopt_options: Annotated[dict[str, Any], OptionInfo("IPOPT options that prevail")] = field(default_factory=dict)
    name: ClassVar[str] = "multiple_shooting"
    needs_rollout: ClassVar[bool] = False

    @property
    def estimates_torque_errors(self) -> bool:
        """Whether torque errors are unknowns of the program."""
        return not self.condensing

    def minimize_cost(
        self, problem: EstimationProblem, start: Array, callback: base.IterationCallback | None
    ) -> base.SolverResult:
        """Minimize the problem's cost from `start` by IPOPT, or with `condensing` by Gauss-Newton steps."""
        if self.condensing:
            return self._by_condensing(problem, start, base.AcceptedIterateRecorder(callback))
        told: tuple[str, ...] = ()
        if self.hessian not in ("gauss_newton", "exact"):
            told = f"there is no Hessian '{self.hessian}'", "hessian", "gauss_newton, exact", "use gauss_newton"
        elif str(self.ipopt_options.get("hessian_approximation", "exact")) != "exact":
            what = "a limited-memory Hessian is not supported, because it is too slow for thousands of node states"
            told = what, "ipopt_options.hessian_approximation", "exact", "remove it, and set hessian: gauss_newton"
        elif self.node_interval not in (None, 1):
            what = f"node_interval is {self.node_interval}, but must be 1 without condensing"
            told = what, "node_interval", "1", "set condensing: true, or node_interval: 1"
        if told:
            raise SolverError(told[0], where=f"solver.{told[1]}", allowed=told[2], hint=told[3])
        return self._by_ipopt(problem, start, base.AcceptedIterateRecorder(callback))

    def _by_ipopt(
        self, problem: EstimationProblem, start: Array, recorder: base.AcceptedIterateRecorder
    ) -> base.SolverResult:
        program = symbolic_transcription.transcribe(problem, start)
        assert program.ridge is not None
        ridge = _AdaptiveRidge(program.ridge.scale, program.w.numel())
        program = replace(program, ridge=replace(program.ridge, factor=ridge))
        needed, free = program.estimated_solver_memory(self.hessian), nonlinear_program.available_memory_bytes()
        size = f"{program.w.numel()} unknowns, {program.g.numel()} equations, about {needed / 1e9:.2g} GB of memory"
        log.log(logging.WARNING if needed > _MEMORY_WARNING_BYTES else logging.INFO, "IPOPT on %s", size)
        if needed > free:
            message = f"{size}, but only {free / 1e9:.2g} GB are free; set a longer time_step, a shorter duration, or "
            return recorder.solver_result_with_iterates(base.Status.FAILED, message + "gauss_newton", start)
        functions = ca.Function("point", [program.w, program.p], [program.f, program.grad_f, program.g])
        watch = _Watch(problem, program, functions, ridge, recorder)
        options = self._solver_options(1.0 / watch.unit)
        solver = program.make_solver("ipopt", self.hessian, iteration_callback=watch, **options)
        w = np.array(solver(**program.solver_arguments)["x"]).ravel()
        if watch.stop_request is not None:
            raise watch.stop_request
        w = w if np.all(np.isfinite(w)) else watch.best
        defect, stats = float(ca.norm_inf(functions(w, program.parameter_values)[2])), solver.stats()
        status, message = self._ipopt_status(stats["return_status"], defect)
        n = problem.step.sizes["n"]
        warm = tuple(w[program.variables[f"q[{episode.name}]"].index[:n, 0]] for episode in problem.episodes)
        x = symbolic_transcription.problem_unknowns_from_program(problem, program, w)
        return base.SolverResult(status, message, x, tuple(recorder.history), int(stats["n_call_nlp_g"]), warm)

    def _solver_options(self, cost_factor: float) -> dict[str, Any]:
        acceptable = {"tol": 1e-3, "iter": 4, "constr_viol_tol": 1e-6, "obj_change_tol": 1e-5}
        ipopt = {
            **{"obj_scaling_factor": cost_factor, "nlp_scaling_method": "none", "print_level": 0, "sb": "yes"},
            **{"max_iter": self.max_iterations, "tol": 1e-6, "mu_init": 1e-7},
            # the Hessian is positive definite, but MUMPS misjudges signs of tiny pivots, and IPOPT would regularise
            "neg_curv_test_tol": 1e-11 if self.hessian == "gauss_newton" else 0.0,
            # measured on 50 variables and 500 steps: a sixth of the time of MUMPS's own choice
            **{"mumps_scaling": 8, "mumps_pivot_order": 0, "mumps_permuting_scaling": 0},
            **{"bound_relax_factor": 0.0, "fixed_variable_treatment": "make_parameter"},
            **{f"acceptable_{name}": value for name, value in acceptable.items()},
        }
        return {**QUIET_NLPSOL_OPTIONS, "no_nlp_grad": True, "ipopt": {**ipopt, **self.ipopt_options}}

    def _ipopt_status(self, returned: str, defect: float) -> tuple[base.Status, str]:
        closed = f"The largest jump between time steps (defect) is {defect:.1e}, and should be near 0"
        if returned in ("Solve_Succeeded", "Solved_To_Acceptable_Level"):
            return base.Status.CONVERGED, f"IPOPT found a minimum. {closed}"
        if returned == "Maximum_Iterations_Exceeded":
            limit = base.iteration_limit_message(self.max_iterations, "IPOPT")
            return base.Status.ITERATION_LIMIT, f"{limit}. {closed}"
        return base.Status.STALLED, f"IPOPT found no minimum ({returned}). {closed}. Use gauss_newton"

    def _by_condensing(
        self, problem: EstimationProblem, start: Array, recorder: base.AcceptedIterateRecorder
    ) -> base.SolverResult:
        intervals = _ShootingIntervals(problem, self.node_interval or _CONDENSING_NODE_INTERVAL)
        x, nodes = intervals.initial_guess(start)

        def ended(status: base.Status, message: str) -> base.SolverResult:
            return recorder.solver_result_with_iterates(status, message, x, intervals.equilibrium_guesses)

        recorder.n_evaluations += 1
        now = intervals.linearize(x, nodes)
        if isinstance(now, str):
            return ended(base.Status.FAILED, now)
        mu, filtered = 1e-4, _StepFilter(now)
        for _ in range(self.max_iterations):
            size, gradient = np.maximum(np.abs(x), problem.unknown_scales), now.jacobian.T @ now.residual
            recorder.record_iterate(now.cost, x, max_abs_projected_gradient(x, gradient, *problem.bounds, size))
            closed = now.residual + now.by_defect
            # the linear model holds for changes by a factor, not to a bound
            (low, high), positive = problem.bounds, problem.positive_unknowns_mask
            largest = np.maximum(x, 1e-3 * problem.unknown_scales) * _MAX_CHANGE_FACTOR
            low = (np.where(positive, np.maximum(low, x / _MAX_CHANGE_FACTOR), low) - x) / size
            high = (np.where(positive, np.minimum(high, largest), high) - x) / size
            step = size * bounded_levenberg_marquardt_step(now.jacobian * size, closed, mu, low, high)
            promised = linearized_residual.predicted_cost_reduction_by_step(now.jacobian, closed, step)
            moved = float(np.max(np.abs(step) / size, initial=0.0))
            flat = mu < _MAX_TRUSTED_DAMPING and promised <= self.cost_tolerance * now.cost
            if moved < self.step_tolerance or flat:
                if now.defect < _CLOSED_DEFECT:
                    return ended(base.Status.CONVERGED, f"the largest jump at a node (defect) is {now.defect:.1e}")
                # steps along uninformed directions would only increase the defects
                step = np.zeros_like(step)
            slope, factor = float(now.residual @ (now.by_defect + now.jacobian @ step)), 1.0
            while factor >= _MIN_STEP_FRACTION:
                trial_x = np.clip(x + factor * step, *problem.bounds)
                trial_nodes = intervals.moved(nodes, now, step, factor)
                trial = intervals.linearize(trial_x, trial_nodes)
                recorder.n_evaluations += 1
                if not isinstance(trial, str) and filtered.accepts(now, trial, factor * slope):
                    mu *= 0.2 if factor == 1.0 else 5.0
                    x, nodes, now = trial_x, trial_nodes, trial
                    break
                factor *= 0.5
            else:
                if mu > _STALLED_DAMPING:
                    reason = trial if isinstance(trial, str) else "no step lowers the cost or the defects"
                    return ended(base.Status.STALLED, f"{reason}. Set a shorter node_interval, or use gauss_newton")
                mu = max(mu * 30.0, 1e-4)
        end = base.iteration_limit_message(self.max_iterations)
        return ended(base.Status.ITERATION_LIMIT, f"{end}. Jumps at nodes reach {now.defect:.1e}, and should be near 0")


class _AdaptiveRidge(ca.Callback):
    """Factor of a Hessian ridge. It rises if parameters oscillate between iterates, and falls otherwise."""

    def __init__(self, scale: Array, size: int) -> None:
        ca.Callback.__init__(self)
        self.factor = symbolic_transcription.MIN_RIDGE_FACTOR
        self._scale, self._change, self._size = scale, np.zeros(len(scale)), size
        self.construct("factor", {})

    def get_sparsity_in(self, _: int) -> ca.Sparsity:
        return ca.Sparsity.dense(self._size, 1)

    def eval(self, _: Sequence[ca.DM]) -> list[float]:
        return [self.factor]

    def update(self, before: Array, after: Array) -> None:
        change = (after - before) / np.maximum(np.abs(after), self._scale)
        turned = float(change @ self._change) < 0
        self.factor = 4.0 * self.factor if turned else max(0.5 * self.factor, symbolic_transcription.MIN_RIDGE_FACTOR)
        self._change = change


class _Watch(ca.Callback):
    """Callback of CasADi that records every iterate in the history."""

    def __init__(
        self,
        problem: EstimationProblem,
        program: NonlinearProgram,
        functions: ca.Function,
        ridge: _AdaptiveRidge,
        recorder: base.AcceptedIterateRecorder,
    ) -> None:
        ca.Callback.__init__(self)
        self.recorder, self.best, self._ridge = recorder, program.initial_guess, ridge
        self._problem, self._program, self._functions = problem, program, functions
        self.stop_request: base.StopSearch | None = None
        cost = float(functions(program.initial_guess, program.parameter_values)[0])
        self.unit = max(cost, 0.5 * program.residual.numel() * problem.stated_rms_noise_of_data_residuals**2)
        nw, ng = program.w.numel(), program.g.numel()
        self._sizes = {"x": nw, "f": 1, "g": ng, "lam_x": nw, "lam_g": ng, "lam_p": program.p.numel()}
        self.construct("watch", {})

    def get_n_in(self) -> int:
        return ca.nlpsol_n_out()

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(self._sizes[ca.nlpsol_out(i)], 1)

    def eval(self, arguments: Sequence[ca.DM]) -> list[int]:
        w = np.array(arguments[0]).ravel()
        cost, slope, _ = self._functions(w, self._program.parameter_values)
        assert self._program.ridge is not None
        at = self._program.ridge.index
        self._ridge.update(self.best[at], w[at])
        self.best = w
        x = symbolic_transcription.problem_unknowns_from_program(self._problem, self._program, w)
        self.recorder.n_evaluations += 1
        note = "" if self.recorder.history else "start"
        try:
            self.recorder.record_iterate(float(cost), x, float(ca.norm_inf(slope)) / self.unit, note)
        except base.StopSearch as stop:
            self.stop_request = stop  # IPOPT would replace it by its own error
            return [1]
        return [0]


@dataclass(frozen=True)
class _Linearization:
    """Whitened residual, its derivative by unknowns, its change if all defects are closed, and those of node states."""

    cost: float
    defect: float
    residual: Array
    jacobian: Array
    by_defect: Array
    node_slopes: tuple[tuple[Array, Array], ...]


class _StepFilter:
    """Accepts trial points that improve on every point so far in cost or in defects.

    It replaces a merit function, whose weight between the two, once needed far from the solution, makes steps short
    near it (Waechter and Biegler 2005, SIAM J. Optim. 16(1):1, doi:10.1137/S1052623403426556).
    """

    def __init__(self, start: _Linearization) -> None:
        self._largest = 1e4 * max(start.defect, 1.0)
        self._points: list[tuple[float, float]] = []

    def accepts(self, now: _Linearization, trial: _Linearization, slope: float) -> bool:
        """Return whether `trial` is accepted; `slope` is the change of the cost that the linear model predicts."""
        margin = _IMPROVEMENT_MARGIN
        if not trial.defect <= self._largest or not np.isfinite(trial.cost):
            return False
        if any(trial.defect >= margin * defect and trial.cost >= margin * cost for defect, cost in self._points):
            return False
        # with nearly closed defects, the cost must decrease sufficiently
        if slope < 0 and (-slope / max(now.cost, 1e-300)) ** 2.3 > now.defect**1.1:
            return trial.cost <= now.cost + 1e-4 * slope
        if trial.defect <= margin * now.defect or trial.cost <= margin * now.cost:
            self._points.append((now.defect, now.cost))
            return True
        return False


class _ShootingIntervals:
    """Recordings, divided at nodes into intervals that are rolled out one by one from their node states."""

    def __init__(self, problem: EstimationProblem, node_interval: int) -> None:
        symbolic_transcription.check_no_effect_changes_inputs(problem, "multiple shooting")
        self.problem, self.node_steps = problem, list[IntArray]()
        for episode in problem.episodes:
            steps = episode.grid.steps
            if steps < node_interval:
                what = f"the node interval is {node_interval} steps, but recording '{episode.name}' has only {steps}"
                hint, allowed = f"set solver.node_interval: {steps} or less", f"1 to {steps} time steps"
                raise SolverError(what, where="solver.node_interval", allowed=allowed, hint=hint)
            if any(s.sensor.effort_joints for s in episode.measurements):
                message = "multiple shooting with condensing cannot use measured efforts of prescribed joints"
                where, allowed = f"recording '{episode.name}': joints/effort", "measurements that depend on node states"
                hint = "set solver.condensing: false, solver.name: gauss_newton, or sensors.joints.effort.use: false"
                raise SolverError(message, where=where, allowed=allowed, hint=hint)
            self.node_steps.append(np.unique(np.append(np.arange(0, steps + 1, node_interval), steps)))
        # equilibria are searched near those of the problem's initial values, at any point
        thetas = (problem.theta_of_episode(problem.initial_unknowns, i) for i in range(len(problem.episodes)))
        starts = map(problem.predictor.initial_state_and_derivative, problem.episodes, thetas)
        found = [None if start.failure_message else start.equilibrium for start in starts]
        n = problem.step.sizes["n"]
        self.equilibrium_guesses = tuple(None if rest is None else rest.state[:n] for rest in found)

    def initial_guess(self, start: Array) -> tuple[Array, list[Array]]:
        """Unknowns near `start` and the node states of every recording."""
        shared, x = len(self.problem.shared_parameters), start.copy()
        about = self.problem.initial_unknowns.copy()
        about[:shared] = start[:shared]
        found = guess_unknowns_and_node_states(self.problem, self.node_steps, about, self._misfit)
        x[:shared] = found.x[:shared]
        return x, list(found.node_states)

    def _misfit(self, i: int, nodes: Array, x: Array) -> float:
        theta = self.problem.theta_of_episode(x, i)
        rollouts = [self._rollout(i, j, nodes[j], theta, None) for j in range(len(nodes) - 1)]
        trajectory = np.vstack([*(rollout.state[:-1] for rollout in rollouts), rollouts[-1].state[-1:]])
        return mean_square_of_non_effort_residuals(self.problem, i, trajectory, x)

    def moved(self, nodes: list[Array], now: _Linearization, step: Array, factor: float) -> list[Array]:
        """Node states after a fraction of a step, which also closes that fraction of the defects."""
        columns = map(self.problem.unknowns.unknown_indices_affecting_recording, range(len(nodes)))
        parts = zip(nodes, now.node_slopes, columns, strict=True)
        return [state + factor * (by_x @ step[own] + by_defect) for state, (by_x, by_defect), own in parts]

    def linearize(self, x: Array, nodes: list[Array]) -> _Linearization | str:
        """Residual and derivatives at a point, or the message of a failed rollout."""
        problem, predictor = self.problem, self.problem.predictor
        cost, defect, residuals, jacobians, changes, slopes = 0.0, 0.0, [], [], [], []
        for i, episode in enumerate(problem.episodes):
            theta, offset = problem.unpack_episode_unknowns(x, i)
            theta = predictor.theta_with_episode_values(episode, theta)
            start = predictor.initial_state_and_derivative(episode, theta, offset, guess=self.equilibrium_guesses[i])
            condensed = start.failure_message or self._condensed(i, theta, start, nodes[i])
            if isinstance(condensed, str):
                return condensed
            trajectory, by_unknowns, by_x, by_defect, largest = condensed
            defect = max(defect, largest)
            slopes.append((by_x, by_defect))
            for samples in episode.measurements:
                read = predictor.readings_and_sensitivities(samples, trajectory, by_unknowns, theta)
                part = samples.residual_and_jacobian(*read, problem.options.huber_threshold)
                assert part.jacobian is not None
                cost += part.cost
                residuals.append(part.residual)
                jacobians.append(problem.unknowns.scatter_to_unknown_columns(part.jacobian[:, :-1], i))
                changes.append(part.jacobian[:, -1])
        prior, by_x_prior = problem.priors.residual_and_jacobian(x)
        residual, jacobian = np.concatenate([*residuals, prior]), np.vstack([*jacobians, by_x_prior])
        change = np.concatenate([*changes, np.zeros(len(prior))])
        return _Linearization(cost + 0.5 * float(prior @ prior), defect, residual, jacobian, change, tuple(slopes))

    def _condensed(
        self, i: int, theta: Array, start: InitialStateWithSensitivity, nodes: Array
    ) -> tuple[Array, Array, Array, Array, float] | str:
        """Trajectory (N + 1, nx), derivatives of it and of the nodes by unknowns and defects, largest defect."""
        wanted, by_start = self.problem.unknowns.free_parameter_names, start.state_sensitivity
        nx, width = by_start.shape
        steps = self.problem.episodes[i].grid.steps
        trajectory, slopes = np.zeros((steps + 1, nx)), np.zeros((steps + 1, nx, width + 1))
        by_nodes, gaps = np.zeros((len(nodes), nx, width + 1)), np.zeros((len(nodes), nx))
        gaps[0] = start.state - nodes[0]
        by_nodes[0] = np.column_stack([by_start, gaps[0]])
        for j, (first, last) in enumerate(zip(self.node_steps[i][:-1], self.node_steps[i][1:], strict=True)):
            rollout = self._rollout(i, j, nodes[j], theta, SensitivityDirections(wanted, by_nodes[j]))
            if not rollout.status.is_converged or rollout.state_sensitivity is None:
                return f"in interval {j} of '{self.problem.episodes[i].name}', {rollout.status.message}"
            trajectory[first:last], slopes[first:last] = rollout.state[:-1], rollout.state_sensitivity[:-1]
            gaps[j + 1] = rollout.state[-1] - nodes[j + 1]
            by_nodes[j + 1] = rollout.state_sensitivity[-1]
            by_nodes[j + 1, :, width] += gaps[j + 1]
            trajectory[last], slopes[last] = nodes[j + 1], by_nodes[j + 1]
        return trajectory, slopes, by_nodes[:, :, :width], by_nodes[:, :, width], float(np.max(np.abs(gaps)))

    def _rollout(self, i: int, j: int, start: Array, theta: Array, directions: SensitivityDirections | None) -> Rollout:
        episode, (first, last) = self.problem.episodes[i], self.node_steps[i][j : j + 2].tolist()
        feedback = episode.tracking_feedback
        if feedback is not None:
            feedback = replace(feedback, gain=feedback.gain[first:last], reference=feedback.reference[first:last])
        torque, path = episode.torque[first:last], episode.prescribed_path[first : last + 1]
        return simulate(self.problem.step, theta, start, last - first, torque, path, feedback, directions)
