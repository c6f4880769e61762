"""The symbolic conversion of an estimation problem to a CasADi program with the equations of every step.

The unknowns are, in this order,

    (shared parameters | recording 1: local parameters, its rest, x_0, lam_0, x_1, lam_1, ... x_N | recording 2: ... )

with x = (q, p, z). `rest` is the equilibrium at the first posture (free coordinates, internal coordinates, grasp
forces), and x_0 is a function of it; a given initial state has no `rest`. The constraints are the equations of the
equilibrium and those of every step (`OneStepNlpEqualities`). The objective contains the whitened samples, interpolated
between nodes, and the priors. Recorded inputs and measurements are parameters. With process noise, the errors of
torques and angles are unknowns too, after the states of their recording, with Gaussian priors. At the optimum the
objective then corresponds to the likelihood of `inference.whitening`, up to the linearisation there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import casadi as ca
import numpy as np
import scipy.sparse
from numpy.typing import ArrayLike

from yid_ocp.arrays import Array, IntArray
from yid_ocp.errors import SolverError
from yid_ocp.integrator.discrete import one_step_nlp_constraints
from yid_ocp.integrator.statics import joint_hold_spring_stiffness
from yid_ocp.parallel import CASADI_LOCK
from yid_ocp.problem.episode_prediction import sensor_not_predictable_at_nodes_error
from yid_ocp.problem.episodes import Episode
from yid_ocp.problem.estimation_problem import EstimationProblem
from yid_ocp.problem.evaluation import LOG_PRIOR_PARABOLA_RATIO
from yid_ocp.problem.measurements import SensorMeasurements
from yid_ocp.sensors import Sensor, sensor_function_with_jacobians
from yid_ocp.solvers.initial_guess import (
    UnknownsAndNodeStateGuess,
    guess_unknowns_and_node_states,
    mean_square_of_non_effort_residuals,
)
from yid_ocp.solvers.nonlinear_program import (
    GaussNewtonHessianRidge,
    LocalVariableFunction,
    MappedFunctionTerm,
    NonlinearProgram,
    ProgramVectorLayout,
    ResidualTerm,
)

# Smallest factor of the Hessian ridge (`GaussNewtonHessianRidge`).
MIN_RIDGE_FACTOR = 0.1


def transcribe(problem: EstimationProblem, initial_unknowns: ArrayLike | None = None) -> NonlinearProgram:
    """Convert an estimation problem to a nonlinear program with a node at every step.

    Equations: Johnson and Murphey (2009), IEEE Trans. Robotics 25(6):1249, doi:10.1109/TRO.2009.2032955. Raises
    `SolverError` if an effect changes recorded inputs or times.

    Parameters
    ----------
    initial_unknowns : array_like, optional, shape (nx,)
        Unknown vector from which the program's initial guess is made. Default: the problem's initial unknowns.

    Returns
    -------
    NonlinearProgram
        Variables: `theta` and, per recording, `local[NAME]`, `rest[NAME]`, `q[NAME]`, `p[NAME]`, `z[NAME]` and
        `lam[NAME]`. Parameters: `theta[NAME]`, `torque[NAME]`, `gain[NAME]`, `reference[NAME]`, `value.GROUP[NAME]`,
        `weight.GROUP[NAME]`, `start[NAME]` and others, see docs/howto/program.md.
    """
    problem = _about_zero(problem)
    check_no_effect_changes_inputs(problem, "transcribe")
    start = problem.initial_unknowns if initial_unknowns is None else np.asarray(initial_unknowns, float)
    with CASADI_LOCK:
        return _Maker(problem).program(start)


def _about_zero(problem: EstimationProblem) -> EstimationProblem:
    """The problem without subtracted torque offsets, because the offsets are unknowns of the program."""
    known = [episode.input_errors for episode in problem.episodes]
    if not any(e is not None and np.any(e.torque_bias) for e in known):
        return problem
    zero = [e and replace(e, torque_bias=0.0 * e.torque_bias) for e in known]
    episodes = [replace(episode, input_errors=e) for episode, e in zip(problem.episodes, zero, strict=True)]
    return problem.with_episodes(episodes, problem.held_out)


def check_no_effect_changes_inputs(problem: EstimationProblem, where: str) -> None:
    """Check that no effect changes recorded inputs or times, as node-state solvers require. Raises `SolverError`."""
    neutral = problem.predictor.are_input_corrections_neutral_and_fixed
    if not all(neutral(episode, problem.theta) for episode in problem.episodes):
        names = ", ".join(effect.label for effect in problem.system.effects)
        message = f"{where} cannot handle an effect that changes recorded inputs, times or the tracking filter"
        allowed, hint = "effects on mechanics or sensor readings", "set solver.name: gauss_newton, or remove the effect"
        raise SolverError(message, where=f"one of the effects {names}", allowed=allowed, hint=hint)


def problem_unknowns_from_program(problem: EstimationProblem, program: NonlinearProgram, w: Array) -> Array:
    """Convert the program's variables `w` to the unknown vector (nx,) of the estimation problem."""
    x = problem.initial_unknowns.copy()
    shared, own = len(problem.shared_parameters), len(problem.local_parameters)
    x[:shared] = w[program.variables["theta"].index.ravel()] if shared else 0.0
    predictor, n = problem.predictor, problem.step.sizes["n"]
    rows = list(predictor.estimated_initial_state_indices)
    for i, episode in enumerate(problem.episodes):
        columns = problem.unknowns.unknown_indices_affecting_recording(i)[shared:]
        if own:
            x[columns[:own]] = w[program.variables[f"local[{episode.name}]"].index.ravel()]
        if rows:
            blocks = (program.variables.get(f"{part}[{episode.name}]") for part in "qpz")
            first = w[np.concatenate([block.index[:, 0] for block in blocks if block is not None])]
            begin = predictor.initial_state_and_derivative(episode, problem.theta_of_episode(x, i), guess=first[:n])
            x[columns[own:]] = (first - begin.state)[rows]
    return x


class _Places(NamedTuple):
    """Indices of a recording's unknowns (up to `first`) and parameters in the vectors of the program."""

    free: IntArray  # free parameters of the recording
    rest: IntArray
    state: IntArray
    multipliers: IntArray
    errors: IntArray  # torque and angle errors of each step
    first: IntArray  # errors of the first angles
    theta: IntArray
    torque: IntArray
    gain: IntArray
    reference: IntArray

    def stages(self) -> IntArray:
        """(free, x_k, x_{k+1}, lam_k, errors) of every step, (N, nv)."""
        free = np.broadcast_to(self.free, (len(self.multipliers), len(self.free)))
        return np.hstack([free, self.state[:-1], self.state[1:], self.multipliers, self.errors])

    def inputs(self) -> IntArray:
        """(torque, gain, reference) of every step, (N, nd)."""
        return np.hstack([self.torque.T, self.gain.T, self.reference.T])


class _DrivenStage(NamedTuple):
    """The equations of step k as a function of v = (free, x_k, x_{k+1}, lam_k, errors) and data (ubar, K, xbar).

    `effort` (of prescribed joints) and `torque` (of driven joints) are pairs of value and derivative by v.
    """

    function: LocalVariableFunction
    v: ca.SX
    data: ca.SX
    state_before: ca.SX
    state_after: ca.SX
    effort: tuple[ca.SX, ca.SX]
    torque: tuple[ca.SX, ca.SX]


class _Maker:
    """A builder of the program: it lays out the unknowns and parameters of a problem, and makes the terms."""

    def __init__(self, problem: EstimationProblem) -> None:
        self._problem = problem
        self._step, self._sizes = problem.step, problem.step.sizes
        self._names = problem.unknowns.free_parameter_names
        self._w, self._p = ProgramVectorLayout(), ProgramVectorLayout()
        system = problem.system
        # symbols of the free parameters, of nominal values of all, and all with the free symbols inserted
        self._free, self._nominal = ca.SX.sym("free", len(self._names)), ca.SX.sym("theta", len(system.parameters))
        self._theta = ca.SX(self._nominal)
        self._theta[[system.parameters.index(name) for name in self._names]] = self._free
        self._stage = one_step_nlp_constraints(self._step.equations, self._step.time_step)
        self._stages: dict[tuple[bool, bool], _DrivenStage] = {}
        self._sensors: dict[tuple[Sensor, bool, bool], tuple[LocalVariableFunction, bool]] = {}

    def program(self, x: Array) -> NonlinearProgram:
        """The program, with an initial guess near the problem's unknown vector `x`."""
        problem, low, high = self._problem, *self._problem.bounds
        nodes = [np.arange(episode.grid.steps + 1) for episode in problem.episodes]
        found = guess_unknowns_and_node_states(problem, nodes, x, partial(mean_square_of_non_effort_residuals, problem))
        x, shared = found.x, len(problem.shared_parameters)
        theta = self._w.append_values(x[:shared], low[:shared], high[:shared])
        self._w.assign_block_name("theta", theta[:, None], problem.shared_parameters)
        constraints, residuals = list[MappedFunctionTerm](), list[ResidualTerm]()
        at_ridge, columns = [theta], {k: int(place) for k, place in enumerate(theta)}
        for i, episode in enumerate(problem.episodes):
            last = shared + len(problem.local_parameters)
            at = problem.unknowns.unknown_indices_affecting_recording(i)[shared:last]
            local = self._w.append_values(x[at], low[at], high[at])
            self._w.assign_block_name(f"local[{episode.name}]", local[:, None], problem.local_parameters)
            columns |= {int(k): int(place) for k, place in zip(at, local, strict=True)}
            at_ridge.append(local)
            places, errors = self._laid_out(i, found, np.concatenate([theta, local]))
            begun, prior = self._begun(episode, places)
            named, at_steps = self._stage.residual_names, (places.stages(), places.inputs(), places.theta)
            stages = MappedFunctionTerm(f"step[{episode.name}]", named, self._driven(episode).function, *at_steps)
            constraints += [begun, stages]
            used = [samples for samples in episode.measurements if samples.n_residuals]
            residuals += [*(self._sampled(episode, samples, places) for samples in used), *prior, *errors]
        residuals += self._priors(columns)
        order = [k for k, _ in sorted(columns.items(), key=lambda entry: entry[1])]
        lower, upper, start = (np.concatenate(part) for part in (self._w.lower, self._w.upper, self._w.values))
        ridge = GaussNewtonHessianRidge(np.concatenate(at_ridge), problem.unknown_scales[order], MIN_RIDGE_FACTOR)
        vectors = lower, upper, start, np.concatenate([np.zeros(0), *self._p.values])
        terms = tuple(constraints), tuple(residuals)
        symbols = ca.MX.sym("w", self._w.size), ca.MX.sym("p", self._p.size)
        return NonlinearProgram(self._w.blocks, self._p.blocks, *terms, *vectors, ridge, *symbols)

    def _laid_out(self, i: int, found: UnknownsAndNodeStateGuess, free: IntArray) -> tuple[_Places, list[ResidualTerm]]:
        """The unknowns of a recording at their guess, its inputs, and the priors of its errors."""
        problem, episode = self._problem, self._problem.episodes[i]
        system, name, (n, nx, m) = problem.system, episode.name, (self._sizes[key] for key in ("n", "nx", "m"))
        begin, state, pull = found.initial_states[i], found.node_states[i], found.multipliers[i]
        theta = problem.theta_of_episode(found.x, i)
        rest = np.zeros(0)
        sought = list(problem.model_functions.equilibrium_solver.free_coordinates)
        if (known := begin.equilibrium) is not None:
            rest = np.concatenate([known.state[sought], known.state[2 * n :], known.constraint_reactions])
        joints = system.mechanism.joint_names
        grasped = [name for grasp in system.grasps for name in grasp.constraint_equation_names]
        at_rest = [*(joints[k] for k in sought), *system.effect_internal_coordinate_symbols, *grasped]
        rest_at = self._w.append_values(rest)
        self._w.assign_block_name(f"rest[{name}]", rest_at[:, None], at_rest if len(rest) else ())
        table = np.zeros((3, len(state), nx + m))
        table[0, :, :nx], table[0, :-1, nx:] = state, pull
        table[1], table[2] = -np.inf, np.inf
        table[:, :, list(system.prescribed_coordinate_indices)] = episode.prescribed_path
        # the last node has no multipliers
        at = self._w.append_values(*(part.ravel()[: part.size - m] for part in table))
        index = np.append(at, np.zeros(m, np.int64)).reshape(len(state), nx + m)
        states, multipliers = index[:, :nx], index[:-1, nx:]
        for label, part, rows in (("q", states[:, :n], joints), ("p", states[:, n : 2 * n], joints)):
            self._w.assign_block_name(f"{label}[{name}]", part.T, rows)
        self._w.assign_block_name(f"z[{name}]", states[:, 2 * n :].T, tuple(system.effect_internal_coordinate_symbols))
        self._w.assign_block_name(f"lam[{name}]", multipliers.T, grasped)
        theta_at = self._p.append_block(f"theta[{name}]", theta, system.parameters.names)
        torque = self._p.append_block(f"torque[{name}]", episode.torque.T, system.driven, "N m")
        gain, reference = self._followed(episode)
        errors, first, priors = self._erring(episode)
        places = _Places(free, rest_at, states, multipliers, errors, first, theta_at[:, 0], torque, gain, reference)
        return places, priors

    def _followed(self, episode: Episode) -> tuple[IntArray, IntArray]:
        """Gains (row by row) and reference of the tracking filter at every step."""
        feedback, steps = episode.tracking_feedback, episode.grid.steps
        if feedback is None or not _kind(episode)[0]:
            return (np.zeros((0, steps), np.int64),) * 2
        driven, joints, n = self._problem.system.driven, self._problem.system.mechanism.joint_names, self._sizes["n"]
        followed = [f"{'q' if row < n else 'p'}.{joints[row % n]}" for row in feedback.state_indices]
        pairs = [f"{joint}, {other}" for joint in driven for other in followed]
        gain = self._p.append_block(f"gain[{episode.name}]", feedback.gain.reshape(steps, -1).T, pairs)
        return gain, self._p.append_block(f"reference[{episode.name}]", feedback.reference.T, followed)

    def _driven(self, episode: Episode) -> _DrivenStage:
        key = is_followed, is_noisy = _kind(episode)
        if key not in self._stages:
            feedback, shift = episode.tracking_feedback, self._problem.model_functions.effect_momentum_calculator
            followed = feedback.state_indices.tolist() if is_followed and feedback is not None else []
            momentum = shift.momentum_derivative_by_previous_torque(self._problem.theta)
            self._stages[key] = self._driven_stage(followed, momentum, is_noisy)
        return self._stages[key]

    def _driven_stage(self, followed: Sequence[int], momentum: Array, noisy: bool) -> _DrivenStage:
        """The equations of a step, with its tracking filter and torque errors, if it has them.

        The applied torque is u_k = ubar_k - w_k - b - K_k (x_k[followed] - xbar_k) - K_k v_k. The gain K_k is absent if
        encoders are measurements; torque errors w_k, b and angle errors v_k are absent if torques are exact. `followed`
        are indices of the state. `momentum` (nu, nu) is the derivative of the followed momenta by the previous torque.
        """
        stage = self._stage
        nx, nu, m, index = stage.x0.numel(), stage.u.numel(), stage.lam.numel(), list(followed)
        before, after, lam = ca.SX.sym("x0", nx), ca.SX.sym("x1", nx), ca.SX.sym("lam", m)
        nominal, gain = ca.SX.sym("torque", nu), ca.SX.sym("gain", nu * len(index))
        reference, matrix = ca.SX.sym("reference", len(index)), ca.reshape(gain, len(index), nu).T
        by_errors = ca.SX(nu, 0)
        if noisy:
            # the measured momentum contains half the impulse of the previous step, whose w is replaced by this step's
            late = ca.mtimes(matrix[:, nu:], momentum) if len(index) > nu else 0.0
            by_errors = ca.horzcat(*([-ca.SX.eye(nu) - late] * 2), *([-matrix[:, :nu]] if index else []))
        errors, by_before = ca.SX.sym("errors", by_errors.shape[1]), ca.SX(nu, nx)
        torque = nominal + ca.mtimes(by_errors, errors)
        if index:
            torque -= ca.mtimes(matrix, before[index] - reference)
            by_before[:, index] = -matrix
        symbols = [stage.x0, stage.x1, stage.lam, stage.u, stage.theta]
        expressions = [before, after, lam, torque, self._theta]
        by_free = stage.residual_and_effort_jacobians_by_parameters(self._names)
        slopes = (stage.residual_jacobians, stage.effort_jacobians)
        made = []
        for value, own, by in zip((stage.residual, stage.prescribed_effort), by_free, slopes, strict=True):
            parts = [value, own, *(by[name] for name in ("x0", "x1", "lam", "u"))]
            value, own, first, second, pull, by_u = ca.substitute(parts, symbols, expressions)
            driven = ca.mtimes(by_u, by_before), ca.mtimes(by_u, by_errors)
            made.append((value, ca.horzcat(own, first + driven[0], second, pull, driven[1])))
        (rows, by_v), effort = made
        by_torque = ca.horzcat(ca.SX(nu, len(self._names)), by_before, ca.SX(nu, nx + m), by_errors)
        v, data = ca.vertcat(self._free, before, after, lam, errors), ca.vertcat(nominal, gain, reference)
        function = LocalVariableFunction("step", [v, data, self._nominal], rows, by_v, self._step.is_compiled)
        return _DrivenStage(function, v, data, before, after, effort, (torque, by_torque))

    def _erring(self, episode: Episode) -> tuple[IntArray, IntArray, list[ResidualTerm]]:
        """Indices of each step's torque errors and of the errors of the first angles, and their priors."""
        errors, steps, name = episode.input_errors, episode.grid.steps, episode.name
        if errors is None:
            return np.zeros((steps, 0), np.int64), np.zeros(0, np.int64), []
        driven, nu, v = self._problem.system.driven, self._sizes["nu"], ca.SX.sym("v", self._sizes["nu"])
        itself = LocalVariableFunction("itself", [v, ca.SX(0, 1), ca.SX(0, 1)], v)
        sample, of_step = np.unique(errors.sample_of_step, return_inverse=True)
        spread = errors.angle_std * np.sqrt(errors.encoder_noise_steps)
        wanted = [("torque_error", errors.torque_std, len(sample)), ("torque_offset", errors.torque_bias_std, 1)]
        wanted += [("angle_error", spread, steps)] if _kind(episode)[0] else []
        wanted += [("first_angle_error", errors.angle_std, 1)] if episode.fixed_initial_state is None else []
        places, priors = {}, []
        for label, std, count in wanted:
            none = np.tile(std <= 0, count)
            at = self._w.append_values(np.zeros(nu * count), np.where(none, 0.0, -np.inf), np.where(none, 0.0, np.inf))
            places[label] = at.reshape(count, nu)
            self._w.assign_block_name(f"{label}[{name}]", places[label].T, driven)
            weight = self._p.append_block(f"weight.{label}[{name}]", 1.0 / np.where(std > 0, std, 1.0), driven)
            data = np.zeros((count, 0), np.int64)
            term = MappedFunctionTerm(f"{label}[{name}]", driven, itself, places[label], data, weight[:0, 0])
            priors.append(ResidualTerm(term, ca.DM.eye(nu * count), np.tile(weight[:, 0], count)))
        per_step = [places["torque_error"][of_step.ravel()], np.broadcast_to(places["torque_offset"], (steps, nu))]
        per_step += [places["angle_error"]] if "angle_error" in places else []
        return np.hstack(per_step), places.get("first_angle_error", np.zeros((1, 0), np.int64))[0], priors

    def _begun(self, episode: Episode, places: _Places) -> tuple[MappedFunctionTerm, list[ResidualTerm]]:
        """Constraints of the first state, and the prior of its free part."""
        problem, name, nx = self._problem, episode.name, self._sizes["nx"]
        loose = list(problem.predictor.estimated_initial_state_indices)
        fixed = [k for k in range(nx) if k not in {*problem.system.prescribed_coordinate_indices, *loose}]
        rows = [
            *(f"{part}.{joint}" for part in "qp" for joint in problem.system.mechanism.joint_names),
            *problem.system.effect_internal_coordinate_symbols,
        ]
        first = ca.SX.sym("x0", nx)
        if episode.fixed_initial_state is not None:
            given = self._p.append_block(f"start[{name}]", episode.fixed_initial_state.state, rows)
            state, balance = ca.SX.sym("given", nx), ca.SX(0, 1)
            inputs = [first, state, ca.SX(0, 1)]
            at, data, shared = places.state[:1], given.T, np.zeros(0, np.int64)
        else:
            statics = problem.model_functions.equilibrium_solver
            rest = statics.symbolic_equations
            sought, held = rest.inputs[0], rest.inputs[2]
            stiffness = joint_hold_spring_stiffness(problem.system, bool(problem.system.driven))
            values = [ca.SX(stiffness), self._theta, ca.SX(self._step.time_step)]
            balance, state = ca.substitute([rest.residual, rest.state], rest.inputs[3:], values)
            posture, nu = rest.inputs[1], held.numel()
            errors = ca.SX.sym("errors", 3 * len(places.first))
            if len(places.first):
                # (of the first angles, w of the first step, b)
                moved = posture - ca.vertcat(errors[:nu], ca.SX(ca.DM.zeros(posture.numel() - nu)))
                true = held - errors[nu : 2 * nu] - errors[2 * nu :]
                balance, state = ca.substitute([balance, state], [posture, held], [moved, true])
            v = ca.vertcat(self._free, sought, first, errors)
            inputs = [v, ca.vertcat(posture, held), self._nominal]
            known = [problem.system.mechanism.joint_names[k] for k in statics.known_coordinates]
            given = self._p.append_block(f"posture[{name}]", episode.initial_known_coordinates, known)
            wrong = [places.first, places.errors[0, : 2 * nu]] if len(places.first) else []
            at = np.concatenate([places.free, places.rest, places.state[0], *wrong])[None, :]
            data, shared = np.concatenate([given[:, 0], places.torque[:, 0]])[None, :], places.theta
        labels = (*(f"rest.{k}" for k in range(balance.numel())), *(f"start.{rows[k]}" for k in fixed))
        function = LocalVariableFunction("start", inputs, ca.densify(ca.vertcat(balance, (first - state)[fixed])))
        term = MappedFunctionTerm(f"start[{name}]", labels, function, at, data, shared)
        if not loose:
            return term, []
        offset = LocalVariableFunction("offset", inputs, ca.densify((first - state)[loose]))
        weights = 1.0 / problem.priors.initial_state_stds
        weight = self._p.append_block(f"weight.start[{name}]", weights, [rows[k] for k in loose])
        named = tuple(f"offset.{rows[k]}" for k in loose)
        free = MappedFunctionTerm(f"offset[{name}]", named, offset, at, data, shared)
        return term, [ResidualTerm(free, ca.DM.eye(len(loose)), weight[:, 0])]

    def _sampled(self, episode: Episode, samples: SensorMeasurements, places: _Places) -> ResidualTerm:
        """Samples of one sensor, predicted by linear interpolation between the two adjacent nodes."""
        sensor, nodes, n = samples.sensor, samples.evaluation_node_indices, self._sizes["n"]
        (read, loaded), smooth = self._reading(sensor, episode), None
        if sensor.effort_joints:
            smooth = self._problem.predictor.predicted_effort_smoother(episode, self._problem.theta)
        if smooth is not None:
            nodes = np.arange(episode.grid.steps)
        if loaded:
            # after the last step the effort is that of this step
            step = np.minimum(nodes, len(places.multipliers) - 1)
            is_last = (nodes > step).astype(float)[None, :]
            ends = self._p.append_block(f"last.{sensor.group_name}[{episode.name}]", is_last, ["last"])
            at, data = places.stages()[step], np.hstack([places.inputs()[step], ends.T])
        else:
            free = np.broadcast_to(places.free, (len(nodes), len(places.free)))
            states = places.state[nodes]
            at, data = np.hstack([free, states[:, :n], states[:, 2 * n :]]), np.zeros((len(nodes), 0), np.int64)
        rows = sensor.output_names
        term = MappedFunctionTerm(f"{sensor.group_name}[{episode.name}]", rows, read, at, data, places.theta)
        seen, between = samples.positive_weight_mask, _between(samples, nodes if smooth is None else smooth.nodes)
        if smooth is not None:
            between = between @ scipy.sparse.kron(smooth.matrix, scipy.sparse.eye_array(seen.shape[1]))
        threshold = self._problem.options.huber_threshold
        if samples.noise_correlation is not None:
            mixed = np.zeros(seen.shape)
            mixed[seen] = samples.decorrelate_residual_rows(samples.weight[seen] * samples.value[seen])
            target = self._p.append_block(f"value.{term.name}", mixed.T, rows, "")
            combination = samples.decorrelate_residual_rows(scipy.sparse.diags_array(samples.weight[seen]) @ between)
            return ResidualTerm(term, _constant(combination), None, target.T[seen], threshold)
        value = self._p.append_block(f"value.{term.name}", np.where(seen, samples.value, 0.0).T, rows, sensor.unit)
        weight = self._p.append_block(f"weight.{term.name}", samples.weight.T, rows)
        return ResidualTerm(term, _constant(between), weight.T[seen], value.T[seen], threshold)

    def _reading(self, sensor: Sensor, episode: Episode) -> tuple[LocalVariableFunction, bool]:
        """Function of a sensor's reading at a node, and whether the reading depends on efforts, hence on a step."""
        key = (sensor, *_kind(episode))
        if key not in self._sensors:
            function = sensor_function_with_jacobians(self._problem.system, sensor, self._names)
            if any(function.size2_out(name) for name in ("by_v", "by_a", "by_lam")):
                raise sensor_not_predictable_at_nodes_error(sensor.group_name)
            loaded = function.nnz_out("by_load") > 0
            if loaded:
                made = self._loaded(function, self._driven(episode))
            else:
                q, z = ca.SX.sym("q", self._sizes["n"]), ca.SX.sym("z", self._sizes["nz"])
                read = function(q=q, z=z, theta=self._theta)
                inputs = [ca.vertcat(self._free, q, z), ca.SX(0, 1), self._nominal]
                slopes = ca.horzcat(read["by_theta"], read["by_q"], read["by_z"])
                made = LocalVariableFunction("reading", inputs, read["y"], slopes)
            self._sensors[key] = made, loaded
        return self._sensors[key]

    def _loaded(self, function: ca.Function, step: _DrivenStage) -> LocalVariableFunction:
        system, n, nx = self._problem.system, self._sizes["n"], self._sizes["nx"]
        last, size = ca.SX.sym("last"), step.v.numel()
        node = (1 - last) * step.state_before + last * step.state_after
        load, by_v = ca.SX(ca.DM.zeros(n)), ca.SX(n, size)
        at = system.prescribed_coordinate_indices, system.actuated_coordinate_indices
        for index, (values, by_these) in zip(at, (step.effort, step.torque), strict=True):
            for k, row in enumerate(index):
                load[row], by_v[row, :] = values[k], by_these[k, :]
        read = function(q=node[:n], z=node[2 * n :], load=load, theta=self._theta)
        y = read["y"]
        at_node = ca.horzcat(read["by_q"], ca.SX(y.numel(), n), read["by_z"])
        rest = ca.SX(y.numel(), size - len(self._names) - 2 * nx)
        slopes = ca.horzcat(read["by_theta"], (1 - last) * at_node, last * at_node, rest)
        slopes += ca.mtimes(read["by_load"], by_v)
        inputs = [step.v, ca.vertcat(step.data, last), self._nominal]
        return LocalVariableFunction("reading_under_load", inputs, y, slopes)

    def _priors(self, columns: dict[int, int]) -> list[ResidualTerm]:
        """Stated priors of parameters, and the weak ones."""
        problem = self._problem
        _, slopes = problem.priors.residual_and_jacobian(problem.initial_unknowns)
        v, about = ca.SX.sym("v"), ca.SX.sym("about")
        ratio = v / about
        below = (ratio - LOG_PRIOR_PARABOLA_RATIO) / LOG_PRIOR_PARABOLA_RATIO
        bent = ca.if_else(ratio < LOG_PRIOR_PARABOLA_RATIO, below - below**2 / 2, 0)
        soft = ca.log(ca.fmax(ratio, LOG_PRIOR_PARABOLA_RATIO)) + bent
        stated = problem.residual_rows.stated_priors.stop - problem.residual_rows.stated_priors.start
        found = []
        kinds = (("prior", slice(0, stated), v - about), ("weak_prior", slice(stated, None), soft))
        for name, part, value in kinds:
            own = slopes[part]
            unknown = np.array([k for k in np.flatnonzero(own.any(axis=0)) if int(k) in columns], int)
            own = own[own[:, unknown].any(axis=1)][:, unknown]
            if not len(unknown):
                continue
            # rows of a joint prior mix their own unknown, the last one, with those before it
            last = own.shape[1] - 1 - np.argmax(own[:, ::-1] != 0, axis=1)
            weight = own[np.arange(len(own)), last]
            mixed = ca.sparsify(ca.DM(own / weight[:, None]))
            if name == "weak_prior":
                weight = weight * problem.initial_unknowns[unknown[last]]
            names = [problem.unknown_names[k] for k in unknown]
            start = self._p.append_block(f"{name}.start", problem.initial_unknowns[unknown], names)
            weights = self._p.append_block(f"{name}.weight", weight, [names[k] for k in last])
            local = LocalVariableFunction(name, [v, about, ca.SX(0, 1)], value)
            at = np.array([[columns[int(k)]] for k in unknown])
            term = MappedFunctionTerm(name, (name,), local, at, start, np.zeros(0, np.int64))
            found.append(ResidualTerm(term, mixed, weights[:, 0]))
        return found


def _kind(episode: Episode) -> tuple[bool, bool]:
    """Whether the steps of a recording have the tracking filter, and whether torque errors are unknowns."""
    feedback, errors = episode.tracking_feedback, episode.input_errors
    return feedback is not None and not (errors and errors.has_encoder_measurements), errors is not None


def _constant(matrix: scipy.sparse.sparray | scipy.sparse.spmatrix) -> ca.DM:
    columns = scipy.sparse.csc_matrix(matrix)
    columns.sum_duplicates()  # which also sorts
    return ca.DM(columns)


def _between(samples: SensorMeasurements, nodes: IntArray) -> scipy.sparse.csc_matrix:
    """Interpolation matrix from readings at nodes to the used samples."""
    width = samples.value.shape[1]
    sample, column = np.nonzero(samples.positive_weight_mask)
    row, before = np.arange(len(sample)), np.searchsorted(nodes, samples.node[sample])
    fraction, after = samples.fraction[sample], np.minimum(before + 1, len(nodes) - 1)
    entries = np.concatenate([1 - fraction, fraction])
    at = np.concatenate([before * width + column, after * width + column])
    matrix = scipy.sparse.csc_matrix((entries, (np.tile(row, 2), at)), shape=(len(sample), width * len(nodes)))
    matrix.eliminate_zeros()
    return matrix
