"""The fit of an initial state to the first measured points of a recording that does not start at equilibrium."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from yid_ocp.arrays import Array
from yid_ocp.display import grouped
from yid_ocp.errors import DataError
from yid_ocp.integrator.statics import steady_effect_internal_coordinates
from yid_ocp.integrator.step import Step, generalized_momentum_from_velocity
from yid_ocp.least_squares import levenberg_marquardt
from yid_ocp.model import forward_kinematics
from yid_ocp.model.objects.cable import INITIAL_ANGLE_AND_TORQUE_SUFFIXES, INITIAL_RMS_SPEED_PARAMETER
from yid_ocp.parallel import CasadiLockedCache
from yid_ocp.problem.measurements import SensorMeasurements
from yid_ocp.sensors import Sensor, sensor_function_with_jacobians

# Width of the elastic prior [rad]: this bend at a joint of mean stiffness costs as much as one standard deviation of a
# measured point. The cost of other joints is proportional to their stiffness.
_BEND_STD = 0.5
_MIN_STIFFNESS_RATIO = 1e-4  # Joints without a spring, or with a much softer one, still have a weak prior.
_RATE_STD = 3.0  # Standard deviation of a coordinate's velocity that the points do not determine [rad/s].
_CONSTRAINT_STD = 1e-5
# The fit starts with the noise of measurements multiplied by this factor: a stiff fit from the start ends in knots.
_NOISE_FACTORS = (1000.0, 100.0, 10.0, 1.0)
_SELECTION_STAGE = 2  # Stage before which the best trial is chosen: the object then has its pose, but not its details.
# Number of initial values, spread over its bounds, of a parameter fitted with the initial state.
_TRIALS_PER_PARAMETER = 4


@dataclass(frozen=True)
class FixedInitialState:
    """An initial state that does not depend on the unknowns. It is given or fitted to the first measured points."""

    state: Array  # (q, p, z) at node 0, (nx,)
    fitted_parameters: Mapping[str, float] = field(default_factory=dict)  # values fitted together with the state


@dataclass(frozen=True)
class _InitialStateTask:
    """The data of one fit of a configuration to the points of one frame."""

    measured: list[tuple[SensorMeasurements, int]]  # measurements of each sensor, and its row of this frame
    theta: Array
    rest: Array  # configuration at which the prior has its mean, (n,)
    prior: Array  # weight of each coordinate's deviation from `rest`, (n,)
    wanted: int  # number of parameters that are fitted as well
    softness: float  # factor on the noise of measurements and constraints


class InitialStateFitter:
    """A solver that fits an initial state, and optionally parameters, to the first measured points of an episode.

    At the first frame, a search over the configuration q (and the parameters `fitted_parameters`, which need finite
    bounds) minimises the misfit of points w(q) to measured points wbar, the elastic energy (stiffnesses kappa_i, rest
    angles q_rest,i) and the violation of the constraints phi(q):

        |(w(q) - wbar)/std|^2 + sum kappa_i/kappa_mean (q_i - q_rest,i)^2/BEND_STD^2 + |phi(q)/CONSTRAINT_STD|^2.

    The energy determines angles that points do not show, such as the roll of a clamp. The last frame of the window is
    fitted near the first (prior: small velocity). The velocity between both gives the momentum.
    """

    def __init__(self, step: Step, fitted_parameters: Sequence[str] = ()) -> None:
        self.step = step
        self.fitted_parameters = tuple(fitted_parameters)
        system, e = step.system, step.equations
        self._known = [*system.actuated_coordinate_indices, *system.prescribed_coordinate_indices]
        # compliant coordinates follow their load and have no initial state
        idle = {system.mechanism.joint_index(joint) for joint in system.joint_compliances}
        self._free = [i for i in range(system.n_coordinates) if i not in set(self._known) | idle]
        self._reading = CasadiLockedCache[Sensor, ca.Function](self._reading_function)
        chosen = ca.vertcat(ca.SX(0, 1), *(system.parameters[name].symbol for name in self.fitted_parameters))
        kinematics = forward_kinematics(system.mechanism, e.q1)
        apart = (grasp.holder_minus_held_axis_directions(kinematics) for grasp in system.grasps)
        aligned = ca.vertcat(ca.SX(0, 1), *apart)
        internal = ca.vertcat(ca.SX(0, 1), *system.effect_internal_coordinate_symbols.values())
        held = ca.vertcat(e.end_of_step_constraint_violation, ca.substitute(aligned, internal, e.z1))
        slopes = ca.horzcat(ca.jacobian(held, e.q1)[:, self._free], ca.jacobian(held, chosen))
        outputs = [ca.densify(held), ca.densify(slopes)]
        self._phi = ca.Function("phi", [e.q1, e.z1, e.lam, e.theta, e.time_step], outputs)
        names = [spring.joint_name for spring in system.elastic_joints]
        at = [system.mechanism.joint_index(name) for name in names]
        stiffness, rest = ca.SX(system.n_coordinates, 1), ca.SX(system.n_coordinates, 1)
        for index, spring in zip(at, system.elastic_joints, strict=True):
            stiffness[index] += spring.stiffness
            rest[index] = spring.rest_angle
        self._elastic = ca.Function("elastic", [e.theta], [ca.densify(stiffness), ca.densify(rest)])
        pairs, suffix = list(zip(at, names, strict=True)), INITIAL_ANGLE_AND_TORQUE_SUFFIXES[0]
        self._presets = tuple((index, name) for index, name in pairs if f"{name}.{suffix}" in system.parameters)
        loads = [e.rigid_body_terms.lagrangian_by_q, e.constraint_impulses.before_jacobian]
        self._load = ca.Function("load", e.arguments, loads)

    def fit_initial_state_to_points(
        self,
        configuration: Array,
        samples: Sequence[SensorMeasurements],
        theta: Array,
        window: float,
        path: Array,
        *,
        roughly: bool = False,
    ) -> FixedInitialState:
        """Fit the initial configuration and momentum to the points measured in the first `window` seconds.

        `configuration` (nk,) holds the driven, then the prescribed coordinates at node 0. Only points of `samples` are
        used, in the first `window` [s]. `path` (N + 1, nc) holds the prescribed coordinates at all nodes. `roughly`
        stops the fit at a coarse shape. Raises `DataError` if no point is measured within the window.
        """
        step, system = self.step, self.step.system
        last = max(round(window / step.time_step), 1)
        nearest = ((s, s.node + np.rint(s.fraction)) for s in samples if s.sensor.point_names)
        frames = grouped(
            (int(near[row]), (group, int(row)))
            for group, near in nearest
            for row in np.flatnonzero((near <= last) & group.positive_weight_mask.any(axis=1))
        )
        if not frames:
            what = f"no point is seen in the first {window:g} s of a recording, so its initial state cannot be fitted"
            where, allowed = "problem.initial_state_fit_window", "a window in which a point is measured [s]"
            hint = "set a longer window, or problem.initial_state: equilibrium"
            raise DataError(what, where=where, allowed=allowed, hint=hint)
        nodes = sorted(frames)
        first, then = nodes[0], nodes[-1]
        index = [system.parameters.index(name) for name in self.fitted_parameters]
        stiffness, rest = (np.array(x).ravel() for x in self._elastic(theta))
        typical = float(np.mean(stiffness[stiffness > 0])) if np.any(stiffness > 0) else 1.0
        ratio = np.where(stiffness > 0, np.maximum(stiffness / typical, _MIN_STIFFNESS_RATIO), 1.0)
        weight = np.sqrt(ratio) / _BEND_STD
        guess = rest.copy()
        guess[self._known] = configuration
        guess[list(system.prescribed_coordinate_indices)] = path[first]
        found = [(guess, trial, np.inf) for trial in self._trials(theta[index])]
        for stage, softness in enumerate(_NOISE_FACTORS):
            if stage == _SELECTION_STAGE:
                found = [min(found, key=lambda entry: entry[2])]
                if roughly:
                    break
            task = _InitialStateTask(frames[first], theta, rest, weight, len(index), softness)
            found = [self._fit(q, v, task) for q, v, _ in found]
        q, values, _ = found[0]
        theta = theta.copy()
        theta[index] = values
        velocity = np.zeros(system.n_coordinates)
        if then > first:
            guess = q.copy()
            guess[list(system.prescribed_coordinate_indices)] = path[then]
            span = (then - first) * step.time_step
            slow = np.full(system.n_coordinates, 1 / (_RATE_STD * span))
            task = _InitialStateTask(frames[then], theta, guess, slow, 0, 1.0)
            velocity = (self._fit(guess, values, task)[0] - q) / span
        q0 = q - velocity * first * step.time_step
        q0[list(system.prescribed_coordinate_indices)] = path[0]
        momentum = generalized_momentum_from_velocity(step, q0, velocity, theta)
        state = np.concatenate([q0, momentum, steady_effect_internal_coordinates(step, q0, theta)])
        own = dict(zip(self.fitted_parameters, values.tolist(), strict=True)) | self._preset(q, theta, stiffness)
        if INITIAL_RMS_SPEED_PARAMETER in system.parameters:
            own[INITIAL_RMS_SPEED_PARAMETER] = _speed(frames[first], frames[then], (then - first) * step.time_step)
        return FixedInitialState(state, own)

    def _reading_function(self, sensor: Sensor) -> ca.Function:
        """Function of a sensor's readings and their derivatives by the free coordinates and the fitted parameters."""
        e = self.step.equations
        read = sensor_function_with_jacobians(self.step.system, sensor, self.fitted_parameters)(q=e.q1, theta=e.theta)
        slopes = ca.horzcat(read["by_q"][:, self._free], read["by_theta"])
        return ca.Function("points", [e.q1, e.theta], [ca.densify(read["y"]), ca.densify(slopes)])

    def _preset(self, q: Array, theta: Array, stiffness: Array) -> dict[str, float]:
        """Values of the parameters for joints' initial angle and for their springs' torque at equilibrium there.

        The clamps' unknown reactions f have least elastic energy: min_f sum (kappa q - g - G' f)^2/kappa.
        """
        if not self._presets:
            return {}
        none = (np.zeros(self.step.sizes[key]) for key in ("n", "nz", "nz", "m", "nu"))
        by_q, pull = self._load(q, q, *none, theta, self.step.time_step)
        at = [index for index, _ in self._presets]
        weight = 1 / np.sqrt(np.maximum(stiffness[at], 1e-12))
        free, columns = np.array(by_q).ravel()[at], np.array(ca.densify(pull))[:, at].T
        reaction = np.linalg.lstsq(weight[:, None] * columns, weight * (stiffness[at] * q[at] - free), rcond=None)[0]
        load = free + columns @ reaction
        angle_suffix, load_suffix = INITIAL_ANGLE_AND_TORQUE_SUFFIXES
        angles = {f"{joint}.{angle_suffix}": float(q[index]) for index, joint in self._presets}
        loads = zip(self._presets, load, strict=True)
        return angles | {f"{joint}.{load_suffix}": float(value) for (_, joint), value in loads}

    def _trials(self, values: Array) -> list[Array]:
        if not self.fitted_parameters:
            return [values]
        lower, upper = self.step.system.parameters.lower_and_upper_bounds(self.fitted_parameters)
        shares = (np.arange(_TRIALS_PER_PARAMETER) + 0.5) / _TRIALS_PER_PARAMETER
        grids = [low + (high - low) * shares for low, high in zip(lower, upper, strict=True)]
        return [values, *(np.array(entry) for entry in itertools.product(*grids))]

    def _fit(self, guess: Array, values: Array, task: _InitialStateTask) -> tuple[Array, Array, float]:
        """Fitted configuration, fitted parameter values and the sum of squares."""
        free = self._free
        index = [self.step.system.parameters.index(name) for name in self.fitted_parameters]
        lower, upper = self.step.system.parameters.lower_and_upper_bounds(self.fitted_parameters)
        q, theta = guess.copy(), task.theta.copy()
        theta[index] = values
        wanted, span = index[: task.wanted], (upper - lower)[: task.wanted]
        turns = np.abs(span - 2 * np.pi) < 1e-9  # an angle is periodic, other parameters stop at their bounds

        def spread(x: Array) -> tuple[Array, Array]:
            whole, moved = q.copy(), theta.copy()
            whole[free], moved[wanted] = x[: len(free)], x[len(free) :]
            return whole, moved

        def allowed(x: Array) -> Array:
            own = x[len(free) :]
            low, high = lower[: task.wanted], upper[: task.wanted]
            own = np.where(turns, low + (own - low) % np.where(turns, span, 1.0), np.clip(own, low, high))
            return np.concatenate([x[: len(free)], own])

        begin = np.concatenate([q[free], theta[wanted]])
        x, final = levenberg_marquardt(lambda x: self._rows(*spread(x), task), begin, projection=allowed)
        q, theta = spread(x)
        return q, theta[index], final.cost

    def _rows(self, q: Array, theta: Array, task: _InitialStateTask) -> tuple[Array, Array]:
        """Residual of a fit and its derivative by the free coordinates and the fitted parameters."""
        step, free, wanted = self.step, self._free, task.wanted
        nz, m = step.sizes["nz"], step.sizes["m"]
        residuals, jacobians, width = [], [], len(free) + wanted
        for group, row in task.measured:
            reading, slopes = self._reading(group.sensor)(q, theta)
            weight = group.weight[row] / task.softness
            residuals.append(weight * (reading.full().ravel() - np.where(weight > 0, group.value[row], 0.0)))
            jacobians.append(weight[:, None] * slopes.full()[:, :width])
        if m:
            gap, slopes = self._phi(q, np.zeros(nz), np.zeros(m), theta, step.time_step)
            residuals.append(gap.full().ravel() / (_CONSTRAINT_STD * task.softness))
            jacobians.append(slopes.full()[:, :width] / (_CONSTRAINT_STD * task.softness))
        residuals.append(((q - task.rest) * task.prior)[free])
        jacobians.append(np.hstack([np.diag(task.prior[free]), np.zeros((len(free), wanted))]))
        return np.concatenate(residuals), np.vstack(jacobians)


def _speed(
    before: Sequence[tuple[SensorMeasurements, int]], after: Sequence[tuple[SensorMeasurements, int]], span: float
) -> float:
    """Root mean square speed of the points measured in both frames, zero if there is only one frame [m/s]."""
    squares = []
    for samples, row in before:
        for other, later in after:
            if other is samples and span > 0:
                moved = (samples.value[later] - samples.value[row]).reshape(-1, samples.sensor.outputs_per_channel)
                squares += np.sum(moved**2, axis=1).tolist()
    return float(np.sqrt(np.nanmean(squares))) / span if np.any(np.isfinite(squares)) else 0.0
