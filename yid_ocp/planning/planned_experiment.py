"""Prediction of the recording and sensitivities that a planned arm motion would give with the configured sensors.

In the problem of the search, the arm motion is prescribed, and its torques are measured with noise and a constant error
of each joint. The effect of errors of a driven arm's motion on all readings is computed once, at standstill, and
eliminated (Golub and Pereyra 1973, doi:10.1137/0710036). The motion found is judged with the configured estimation
problem, which is driven by these torques. A camera gives the same information per second at all times: its mean.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
import scipy.linalg
from scipy.interpolate import BSpline

from yid_ocp.analysis.experiment_design import ASSUMED_TORQUE_NOISE_STD
from yid_ocp.arrays import Array
from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.errors import ConfigError, failed_rollout_error
from yid_ocp.inference.linearized_residual import residual_and_jacobian_with_stated_priors
from yid_ocp.inference.whitening import problem_with_whitening_at
from yid_ocp.integrator.step import Step, compile_step_like
from yid_ocp.parallel import map_with_merged_calls
from yid_ocp.planning import joint_paths
from yid_ocp.problem import EstimationProblem, ProblemOptions
from yid_ocp.problem.evaluation import Evaluation
from yid_ocp.problem.measurements import SensorMeasurements
from yid_ocp.sensors.joints import JOINT_POSITION_GROUP_NAME
from yid_ocp.sensors.signal_filters import zero_phase_effort_filter

_PLANNED_RECORDING_NAME = "planned"
_MIN_POINT_RATE = 20.0  # lowest rate at which the information of a slow sensor is spread over the motion [Hz]
_MAX_SEARCH_POINT_RATE = 40.0  # of points in the search: three times the bandwidth of motion errors [Hz]
_PATH_ERROR_BANDWIDTH = 12.0  # bandwidth of motion errors: beyond it, efforts are filtered out [Hz]
_PATH_DIFFERENCE_STEP = 1e-6  # difference step of the arms' motion for the effect of its errors [rad or m]
_SPLINE_DIFFERENCE_STEP = 1e-5  # difference step of a motion's coefficient [rad or m]


class SplineMotionExperiment:
    """A planned experiment whose predicted recording and sensitivities depend on spline coefficients w (K, nc).

    The first recording of `problem`, the configured one, defines sensors, noise and rates. Sensitivities are computed
    at the parameter `values`, by default those of the problem. `names` are the free parameters of the problem, and the
    amplitudes of effects to discriminate. Raises `ConfigError` if no joint's motion can be planned, if the arms have
    servos, or if the motion is too short for the filter of efforts, and `ModelError` if no equilibrium is found.
    """

    def __init__(
        self,
        problem: EstimationProblem,
        values: Mapping[str, float],
        options: joint_paths.PlanOptions,
        names: Sequence[str] = (),
    ) -> None:
        system, episode = problem.system, problem.episodes[0]
        if problem.options.clamp_pose_point_names or not (system.driven or system.prescribed):
            said, hint = "the model has no robot arm that a plan can move", "set model.robot and model.arms"
            if problem.options.clamp_pose_point_names:
                said, hint = "a plan cannot move clamps that follow recorded points", "let a robot hold the object"
            raise ConfigError(said, where="plan", allowed="robot arms that move, without clamps", hint=hint)
        if system.servos:
            what = "an informative motion of servos cannot be planned, because their commands differ from their motion"
            hint = "set model.arms.mode: prescribed for the plan, and leave servo_* out of parameters"
            raise ConfigError(what, where="plan.goal", allowed="arms whose mode is driven or prescribed", hint=hint)
        moved = replace(system, driven=(), prescribed=(*system.driven, *system.prescribed))
        step = problem.step if not system.driven else compile_step_like(problem.step, moved)
        self.configured_problem, self.free_parameters = problem, tuple(names) or problem.free
        known = dict(zip(system.parameters.names, map(float, problem.theta), strict=True))
        self.parameter_values: Mapping[str, float] = known | dict(values)
        theta = step.system.parameters.vector(self.parameter_values)
        posture = options.start_joint_positions
        if posture is None:
            posture = dict(zip(step.system.prescribed, episode.initial_known_coordinates, strict=True))
        first = joint_paths.start_joint_positions_as_array(step.system, posture)
        path = joint_paths.RestToRestSplineBasis(options.duration, options.n_spline_coefficients)
        rest = joint_paths.solve_start_equilibrium(step, theta, first)
        # of the same system with prescribed arms
        self.simulator = joint_paths.PathSimulator(step, theta, rest, path, options.hold_duration)
        _check_long_enough(problem, float(self.simulator.node_times[-1]))

    def _noise_free_recording(self, w: Array, fastest: float = np.inf) -> Recording:
        """Noise-free predicted recording of a motion; points above the rate `fastest` [Hz] are thinned."""
        mover, base = self.simulator, self.configured_problem.episodes[0]
        rollout, system = mover.simulate_path(w), mover.step.system
        if not rollout.status.is_converged:
            raise failed_rollout_error(rollout.status.message, "planned motion")
        joints, duration = base.recording.joints, float(mover.node_times[-1])
        assert joints is not None
        period = float(np.median(np.diff(joints.t)))
        t = np.asarray(period * np.arange(int(np.floor(duration / period + 1e-9)) + 1), float)
        impulse = np.cumsum(np.vstack([np.zeros((1, len(mover.moved_joint_indices))), rollout.effort]), axis=0)
        impulse = impulse * mover.step.time_step
        nodes = mover.node_times
        begin, end = (np.stack([np.interp(at, nodes, x) for x in impulse.T], axis=1) for at in (t, t + period))
        effort = (end - begin) / period
        effort[t + period > duration + 1e-9] = rollout.effort[-1]  # the effort after the end is unknown
        columns = [joints.names.index(name) for name in system.prescribed]
        errors = base.input_errors
        known = (joints.position_std, joints.effort_std, joints.effort_bias_std)
        stds = [None if std is None else np.broadcast_to(std, (len(joints.names),))[columns] for std in known]
        if errors is not None:
            per_sample = errors.torque_std / min(1.0, np.sqrt(period / mover.step.time_step))
            stds = [errors.angle_std, per_sample, errors.torque_bias_std]
        group = JointGroup(
            system.prescribed, t, mover.moved_joint_start_positions + mover.path.basis_values(t) @ w,
            effort=None if joints.effort is None else effort, effort_kind="mean",
            position_std=stds[0], effort_std=stds[1], effort_bias_std=stds[2],
        )  # fmt: skip
        q = rollout.state[:, : system.n_coordinates]
        groups = [self._seen(samples, frames, q, fastest) for samples, frames in self._points]
        return Recording(group, tuple(groups), "a planned motion", "yid_ocp plan", _PLANNED_RECORDING_NAME)

    def _seen(
        self, samples: SensorMeasurements, frames: joint_paths.FramePositionEvaluator, q: Array, fastest: float
    ) -> PointGroup:
        """Points of one sensor along the motion, with the same information per second as in the recording."""
        mover, base = self.simulator, self.configured_problem.episodes[0]
        sensor, spent = samples.sensor, base.grid.steps * base.grid.time_step
        inverse = np.sum(np.where(samples.positive_weight_mask, samples.weight**2, 0.0), axis=0)
        rate = float(np.max(np.count_nonzero(samples.positive_weight_mask, axis=0))) / spent
        stride = max(1, round(1.0 / (mover.step.time_step * min(max(rate, _MIN_POINT_RATE), fastest))))
        at = np.arange(0, len(mover.node_times), stride)
        dense = 1.0 / (stride * mover.step.time_step)
        with np.errstate(divide="ignore"):
            std = np.sqrt(dense * spent / inverse)
        places = frames.positions_and_jacobian(q[at], mover.theta)[0]
        places = np.where(np.isfinite(std), places, np.nan).reshape(len(at), -1, 3)
        std = np.broadcast_to(np.where(np.isfinite(std), std, 1.0).reshape(-1, 3), places.shape)
        group = next(g for g in base.recording.points if g.name == sensor.group_name)
        points, times = (sensor.group_name, sensor.point_names), mover.node_times[at]
        return PointGroup(*points, times, places, std.copy(), group.sensor_name, camera_pose=group.camera_pose)

    @cached_property
    def _points(self) -> list[tuple[SensorMeasurements, joint_paths.FramePositionEvaluator]]:
        system, measured = self.simulator.step.system, self.configured_problem.episodes[0].measurements
        seen = [samples for samples in measured if samples.sensor.point_names]
        return [(samples, joint_paths.FramePositionEvaluator(system, samples.sensor.frame_names)) for samples in seen]

    def _options(self, **changes: object) -> ProblemOptions:
        """The problem's options for the planned recording alone, which holds the noise of its points."""
        options, base = self.configured_problem.options, self.configured_problem.episodes[0]
        seen = {samples.sensor.group_name for samples, _ in self._points}
        own = {name: replace(said, std=None) if name in seen else said for name, said in options.sensors.items()}
        given = options.parameters_by_recording
        named = {_PLANNED_RECORDING_NAME: dict(given[base.name])} if base.name in given else {}
        same = {"sensors": own, "duration": None, "known_initial_states": {}, "parameters_by_recording": named}
        return replace(options, **{**same, **changes})  # type: ignore[arg-type]

    @property
    def zero_coefficients(self) -> Array:
        """The zero spline coefficients (K, nc), with which the arms stay at their start."""
        return np.zeros((self.simulator.path.n_coefficients, len(self.simulator.moved_joint_indices)))

    def problem_with_planned_recording_only(self, w: Array) -> EstimationProblem:
        """Return the configured problem with the planned recording of coefficients `w` as its only recording."""
        return self._problem(self.configured_problem.step, self._noise_free_recording(w), self._options())

    def _problem(self, step: Step, recording: Recording, options: ProblemOptions) -> EstimationProblem:
        free = [name for name in self.free_parameters if name in self.configured_problem.free]
        extra = [name for name in self.free_parameters if name not in free]
        problem = EstimationProblem(step, [recording], free, options, self.parameter_values, (), extra)
        return problem.with_free_parameters_without_recompiling(self.free_parameters)

    def planned_recording_sensitivities(self, w: Array) -> Array:
        """Return derivatives (nr, nx) of whitened residuals of motion `w` per change of an unknown by its size."""
        return self._weighted(self.problem_with_planned_recording_only(w))

    @property
    def existing_recording_sensitivities(self) -> Array:
        """Derivatives (nr, nx) of the existing recordings' whitened residuals per change of an unknown by its size."""
        problem = self.configured_problem.with_parameter_values(self.parameter_values)
        return self._weighted(problem.with_free_parameters_without_recompiling(self.free_parameters))

    def _weighted(self, problem: EstimationProblem) -> Array:
        problem = problem_with_whitening_at(problem, problem.initial_unknowns)
        evaluation = problem.evaluate(problem.initial_unknowns)
        if not evaluation.ok:
            raise failed_rollout_error(evaluation.message, "planned motion, simulated by its torques")
        return self._relative(problem, evaluation)

    def _relative(self, problem: EstimationProblem, evaluation: Evaluation) -> Array:
        """Sensitivities to relative changes, without the prior information on parameters."""
        jacobian = residual_and_jacobian_with_stated_priors(problem, evaluation)[1] * _sizes(problem)
        own = np.array([name.split("[")[0] in self.free_parameters for name in problem.unknown_names])
        jacobian[problem.residual_rows.stated_priors] *= ~own
        return jacobian

    @cached_property
    def _known(self) -> EstimationProblem:
        """The estimation problem of the search, in which the motion is known and torques are measured."""
        recording = self._noise_free_recording(self.zero_coefficients, _MAX_SEARCH_POINT_RATE)
        joints = recording.joints
        assert joints is not None
        sensors = dict(self._options().sensors)
        if joints.effort is not None:
            std = np.zeros(len(joints.names)) if joints.effort_std is None else np.asarray(joints.effort_std)
            joints = replace(joints, effort_std=np.where(std > 0, std, ASSUMED_TORQUE_NOISE_STD))
        if self.configured_problem.system.driven:
            joints = replace(joints, position_std=None)  # `_blur` represents the error of the motion
            sensors.pop(JOINT_POSITION_GROUP_NAME, None)
        said = self._options(
            huber_threshold=np.inf, weak_prior_geometric_std=0.0, weighting="whitened", sensors=sensors
        )
        return self._problem(self.simulator.step, replace(recording, joints=joints), said)

    @cached_property
    def scales_of_estimated_unknowns(self) -> Array:
        """The sizes of the unknowns, in column order. Sensitivities are per change of an unknown by its size."""
        return _sizes(self._known)

    @cached_property
    def sensitivity_column_names(self) -> tuple[str, ...]:
        """The column names of `sensitivities_to_unknowns`: parameters, other unknowns, torque offsets."""
        return (*self._known.unknown_names, *(f"offset of {name}" for name in self._offset_std))

    @cached_property
    def _offset_std(self) -> dict[str, float]:
        errors = self.configured_problem.episodes[0].input_errors
        if errors is None:
            return {}
        known = zip(self.configured_problem.system.driven, errors.torque_bias_std, strict=True)
        return {name: float(std) for name, std in known if std > 0}

    @cached_property
    def _offsets(self) -> Array:
        """Sensitivities (nr + no, no) to constant errors in units of their stds; the last rows are priors."""
        problem, std = self._known, self._offset_std
        found = np.zeros((problem.residual_rows.slice_of_data_and_stated_priors.stop, len(std)))
        for samples, rows in zip(problem.episodes[0].measurements, problem.residual_rows.measurements[0], strict=True):
            if not samples.sensor.effort_joints:
                continue
            columns = np.broadcast_to(np.arange(samples.value.shape[1]), samples.value.shape)
            joint = columns[samples.positive_weight_mask]
            for i, (name, size) in enumerate(std.items()):
                own = np.where(joint == samples.sensor.effort_joints.index(name), size, 0.0)
                found[rows, i] = samples.decorrelate_residual_rows(own * samples.weight[samples.positive_weight_mask])
        return np.vstack([found, np.eye(len(std))])

    def sensitivities_to_unknowns(self, w: Array) -> Array | None:
        """Return derivatives of whitened residuals (nr + no, columns) by relative changes of unknowns, or None."""
        moved, evaluation = self._evaluated(np.asarray(self.simulator.joint_positions(w)))
        if not evaluation.ok:
            return None
        jacobian, offsets = self._relative(moved, evaluation), self._offsets
        whole = np.hstack([np.pad(jacobian, ((0, len(offsets) - len(jacobian)), (0, 0))), offsets])
        vectors, taken = self._blur
        data = len(vectors)
        whole[:data] -= vectors @ (taken[:, None] * (vectors.T @ whole[:data]))
        return whole

    def _evaluated(self, path: Array, derivatives: bool = True) -> tuple[EstimationProblem, Evaluation]:
        """The problem with the joints on a path (N + 1, nc), and its evaluation."""
        problem = self._known
        moved = problem.with_episodes([replace(problem.episodes[0], prescribed_path=path)], ())
        return moved, moved.evaluate(moved.initial_unknowns, derivatives, (self.simulator.system_start_configuration,))

    @cached_property
    def _blur(self) -> tuple[Array, Array]:
        """Directions of the data affected by motion errors of a driven arm, and the lost fraction of each (0 to 1)."""
        problem, mover, errors = self._known, self.simulator, self.configured_problem.episodes[0].input_errors
        data = problem.residual_rows.data.stop
        if not self.configured_problem.system.driven:
            return np.zeros((data, 0)), np.zeros(0)
        nc = len(mover.moved_joint_indices)
        waves = _splines(mover.node_times, _PATH_ERROR_BANDWIDTH)
        path = np.asarray(mover.joint_positions(self.zero_coefficients))

        def residual(i: int) -> Array:
            moved = path.copy()
            if i >= 0:
                moved[:, i % nc] += _PATH_DIFFERENCE_STEP * waves[:, i // nc]
            _, evaluation = self._evaluated(moved, False)
            if not evaluation.ok:
                raise failed_rollout_error(evaluation.message, "planned motion")
            return evaluation.residual[problem.residual_rows.data]

        still = residual(-1)
        columns = [found - still for found in map_with_merged_calls(residual, range(nc * waves.shape[1]))]
        blur = np.stack(columns, axis=1) / _PATH_DIFFERENCE_STEP
        known = blur.T @ blur
        if errors is not None and errors.has_encoder_measurements:
            known += np.kron(waves.T @ waves, np.diag(errors.angle_std**-2 * errors.encoder_noise_steps**-1))
        values, vectors = scipy.linalg.eigh(known)
        kept = values > 1e-10 * values[-1]
        u, s, _ = np.linalg.svd(blur @ (vectors[:, kept] / np.sqrt(values[kept])), full_matrices=False)
        return u, 1.0 - np.sqrt(np.clip(1.0 - s**2, 0.0, 1.0))

    def sensitivity_derivatives_by_coefficients(self, w: Array, rows: Array) -> Array | None:
        """Return the derivatives (w.size, nr, columns) of sensitivities `rows` by w; None if a rollout fails."""

        def one(i: int) -> Array | None:
            moved = w.ravel().copy()
            moved[i] += _SPLINE_DIFFERENCE_STEP
            there = self.sensitivities_to_unknowns(moved.reshape(w.shape))
            return None if there is None else (there - rows) / _SPLINE_DIFFERENCE_STEP

        found = map_with_merged_calls(one, range(w.size))
        return None if any(part is None for part in found) else np.array(found)


def _check_long_enough(problem: EstimationProblem, duration: float) -> None:
    """Raise `ConfigError` if the motion is too short for the low-pass filter of its efforts."""
    joints, low_pass = problem.episodes[0].recording.joints, zero_phase_effort_filter(problem.options.path_cutoff)
    step = problem.step.time_step
    least = 2.0 * low_pass.end_distortion_duration + low_pass.decorrelation_stride_for_step(step) * step
    if joints is not None and joints.effort is not None and duration <= least:
        what = f"a motion of {duration:g} s is too short for efforts low-pass filtered at {low_pass.cutoff:g} Hz"
        allowed = f"plan.duration + plan.hold_duration above {least:.2g} s"
        hint = "set a longer plan.duration, or raise problem.path_cutoff"
        raise ConfigError(what, where="plan.duration", allowed=allowed, hint=hint)


def _sizes(problem: EstimationProblem) -> Array:
    """Value of each unknown, or its typical size if the value is zero."""
    return np.where(problem.initial_unknowns != 0, np.abs(problem.initial_unknowns), problem.unknown_scales)


def _splines(times: Array, band: float) -> Array:
    """Cubic splines (N + 1, count) that start at zero, up to the frequency `band` [Hz]."""
    inner = np.linspace(times[0], times[-1], max(2, round((times[-1] - times[0]) * 2 * band)))
    knots = np.concatenate([np.full(3, inner[0]), inner, np.full(3, inner[-1])])
    # the first posture is known
    return np.asarray(BSpline.design_matrix(np.clip(times, inner[0], inner[-1]), knots, 3).toarray()[:, 1:])
