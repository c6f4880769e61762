"""What is timed: each workload does its work once and says how many units (steps, calls, runs) that was.

To add one, write a function of a `Bench` and enter it in `WORKLOADS`; `run.py` times it and shows it beside the others.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pinocchio as pin
from baxter import baxter_foam_y_system
from numpy.typing import NDArray

from yid_ocp.data.recording import Recording
from yid_ocp.data.recording_hdf5 import read_recording
from yid_ocp.inference.linearized_residual import bounded_levenberg_marquardt_step
from yid_ocp.integrator import compiled
from yid_ocp.integrator.statics import EquilibriumSolver
from yid_ocp.integrator.step import Step, compile_step
from yid_ocp.integrator.step_model import Rollout, RolloutInputs, SensitivityDirections, TrackingFeedback
from yid_ocp.integrator.tracking_feedback import lqr_tracking_feedback
from yid_ocp.model import System
from yid_ocp.model.urdf import mechanism_to_urdf
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.evaluation import EquilibriumGuesses

Array = NDArray[np.float64]

TIME_STEP = 0.01
STIFFNESSES = ("T1.bend", "T1.twist", "T2.bend", "T2.twist", "T3.bend", "T3.twist")
VALUES = dict(zip(STIFFNESSES, (22.0, 13.6, 10.7, 8.2, 11.5, 9.7), strict=True))
# torques that are exact: an estimate is one pass, whose time is comparable from one version to the next
CLEAN = Path(__file__).resolve().parents[1] / "tests" / "data" / "clean"
# number of coordinates: arms and a recording of that system
SIZES = {43: (1, "single_arm_no_vision_estimate.h5"), 50: (2, "dual_arm_no_vision_estimate.h5")}


@dataclass
class Bench:
    """One of the paper's systems, tracking its recording of 500 steps, and the same tree in Pinocchio."""

    size: int
    recording: Recording
    system: System
    step: Step
    theta: Array
    start: Array
    torque: Array
    path: Array
    feedback: TrackingFeedback
    trajectory: Rollout
    model: Any
    data: Any
    points: list[tuple[Array, Array, Array]]
    keep: dict[str, Any] = field(default_factory=dict)

    @staticmethod
    def of(size: int) -> Bench:
        """Set up the system with 43 or 50 coordinates; nothing here is timed."""
        arms, name = SIZES[size]
        system = baxter_foam_y_system(arms)
        assert system.n_coordinates == size
        recording = read_recording(CLEAN / name)
        joints = recording.joints
        assert joints is not None
        assert joints.effort is not None
        assert joints.names == system.driven
        angles, torque = joints.position, np.ascontiguousarray(joints.effort[:-1])
        step = compile_step(system, TIME_STEP)
        theta = system.parameters.vector(VALUES)
        rest = EquilibriumSolver(step).solve(angles[0], theta)
        feedback = lqr_tracking_feedback(step, angles, torque, theta)
        path = np.zeros((len(torque) + 1, 0))
        trajectory = step.kernel.rollout(RolloutInputs(theta, rest.state, torque, path, feedback))
        assert trajectory.status.is_converged, trajectory.status.message
        values = dict(zip(system.parameters.names, theta, strict=True))
        tree = mechanism_to_urdf(system.mechanism, {name: values[name] for name in system.mechanism.parameters.names})
        model = pin.buildModelFromXML(tree)
        assert model.nv == size
        rng = np.random.default_rng(1)
        points = [
            (pin.integrate(model, pin.neutral(model), 0.3 * rng.normal(size=size)), *rng.normal(size=(2, size)))
            for _ in range(50)
        ]
        return Bench(
            size,
            recording,
            system,
            step,
            theta,
            rest.state,
            torque,
            path,
            feedback,
            trajectory,
            model,
            model.createData(),
            points,
        )

    def directions(self, key: str, names: tuple[str, ...], everything: bool) -> SensitivityDirections:
        """Sensitivity directions, made once: the named parameters, or all of the state and the torque."""
        if key not in self.keep:
            sizes = self.step.sizes
            nx, nu, d = sizes["nx"], sizes["nu"], len(names)
            if not everything:
                self.keep[key] = SensitivityDirections(names, np.zeros((nx, d)))
            else:
                start = np.hstack([np.eye(nx), np.zeros((nx, nu))])
                torque = np.zeros((len(self.torque), nu, nx + nu))
                torque[:, :, nx:] = np.eye(nu)
                self.keep[key] = SensitivityDirections((), start, torque)
        return self.keep[key]

    def problem(self) -> EstimationProblem:
        """The estimation of six stiffnesses from the recording, made once."""
        if "problem" not in self.keep:
            self.keep["problem"] = EstimationProblem(self.step, [self.recording], STIFFNESSES)
        return self.keep["problem"]

    def warm(self, x: Array) -> EquilibriumGuesses:
        """Where the equilibrium at `x` is, found once: solvers know it from the point before, so they do not search."""
        if "warm" not in self.keep:
            self.keep["warm"] = self.problem().evaluate(x, False).equilibrium_guesses
        return self.keep["warm"]

    def members(self, count: int, directions: SensitivityDirections | None = None) -> list[RolloutInputs]:
        """Members that differ in their stiffnesses, each from its own equilibrium, over all steps; made once."""
        key = f"members {count} {directions is None}"
        if key not in self.keep:
            rng, posture = np.random.default_rng(0), self.recording.joints
            assert posture is not None
            thetas = [
                self.system.parameters.vector({name: x * rng.uniform(0.6, 1.6) for name, x in VALUES.items()})
                for _ in range(count)
            ]
            starts = [EquilibriumSolver(self.step).solve(posture.position[0], theta).state for theta in thetas]
            common = self.torque, self.path, self.feedback, directions
            self.keep[key] = [RolloutInputs(*pair, *common) for pair in zip(thetas, starts, strict=True)]
        return self.keep[key]

    def rollout(self, steps: int, directions: SensitivityDirections | None = None) -> Rollout:
        """Track the recording over the first steps."""
        torque, path = self.torque[:steps], self.path[: steps + 1]
        return self.step.kernel.rollout(RolloutInputs(self.theta, self.start, torque, path, self.feedback, directions))


def step(bench: Bench) -> int:
    """One step in compiled code: a rollout of 100 of them."""
    bench.rollout(100)
    return 100


def step_with_a_and_b(bench: Bench) -> int:
    """One step with its derivatives by the whole state and the torque, in compiled code."""
    steps = 25
    directions = bench.directions("everything", (), everything=True)
    assert directions.torque_tangents is not None
    bench.rollout(
        steps, SensitivityDirections((), directions.initial_state_tangents, directions.torque_tangents[:steps])
    )
    return steps


def step_called_from_python(bench: Bench) -> int:
    """One call of the step from Python, as a user writes it; it starts without the rollout's extrapolation."""
    n, calls = bench.size, 50
    for k in range(100, 100 + calls):
        x = bench.trajectory.state[k]
        bench.step(x[:n], x[n : 2 * n], bench.trajectory.torque[k], bench.theta)
    return calls


def jacobians_called_from_python(bench: Bench) -> int:
    """One call of `jacobians` from Python: A, B_u and B_theta of the six stiffnesses."""
    n, calls = bench.size, 20
    for k in range(100, 100 + calls):
        x = bench.trajectory.state[k]
        bench.step.jacobians(x[:n], x[n : 2 * n], bench.trajectory.torque[k], bench.theta, names=STIFFNESSES)
    return calls


def rollout_500(bench: Bench) -> int:
    """A rollout of 500 steps that tracks a recording."""
    bench.rollout(500)
    return 1


def sensitivities_500(bench: Bench) -> int:
    """The same with forward sensitivities by six stiffnesses: what a Gauss-Newton iteration costs in the main."""
    bench.rollout(500, bench.directions("six", STIFFNESSES, everything=False))
    return 1


def step_of_eight(bench: Bench) -> int:
    """One step of one of eight members that march together: rollouts of 500."""
    return _together(bench, None)


def step_of_eight_with_sensitivities(bench: Bench) -> int:
    """The same with forward sensitivities by six stiffnesses."""
    return _together(bench, bench.directions("six", STIFFNESSES, everything=False))


def _together(bench: Bench, directions: SensitivityDirections | None) -> int:
    members = bench.members(8, directions)
    with mock.patch.object(
        compiled, "MIN_STEPS_TO_COMPILE_BATCH", 0
    ):  # so few steps would not be worth the compilation
        found = bench.step.kernel.rollout_batch(members)
    assert all(rollout.status.is_converged for rollout in found)
    return sum(len(member.torque) for member in members)


def sensitivities_of_one(bench: Bench) -> int:
    """One step with forward sensitivities by six stiffnesses of one member alone, which the above is compared with."""
    sensitivities_500(bench)
    return 500


def adjoint_500(bench: Bench) -> int:
    """The gradient by six stiffnesses from the adjoint sweep back over 500 steps (the rollout not included)."""
    cost = (bench.trajectory.state, None, None)
    bench.step.kernel.adjoint_gradient(bench.theta, bench.trajectory, bench.feedback, STIFFNESSES, cost)
    return 1


def gradient_500(bench: Bench) -> int:
    """Cost and gradient of an estimation problem of 500 steps: equilibrium, rollout, residual and adjoint sweep."""
    problem = bench.problem()
    x = problem.initial_unknowns * 4.0
    problem.cost_and_gradient(x, equilibrium_guesses=bench.warm(x))
    return 1


def gauss_newton_iteration(bench: Bench) -> int:
    """One iteration of Gauss-Newton over 500 steps: residual, Jacobian by six stiffnesses, and the bounded step."""
    problem = bench.problem()
    x = problem.initial_unknowns * 4.0
    now = problem.evaluate(x, equilibrium_guesses=bench.warm(x))
    assert now.jacobian is not None
    wide = np.full(len(problem.initial_unknowns), np.inf)
    bounded_levenberg_marquardt_step(now.jacobian, now.residual, 1e-6, -wide, wide)
    return 1


def rnea_derivatives(bench: Bench) -> int:
    """Pinocchio's derivatives of inverse dynamics on the same tree: the yardstick."""
    model, data, derivatives = bench.model, bench.data, pin.computeRNEADerivatives
    for q, v, a in bench.points:
        derivatives(model, data, q, v, a)
    return len(bench.points)


def rnea(bench: Bench) -> int:
    """Pinocchio's inverse dynamics on the same tree."""
    model, data, inverse = bench.model, bench.data, pin.rnea
    for q, v, a in bench.points:
        inverse(model, data, q, v, a)
    return len(bench.points)


def trivial_call(bench: Bench) -> int:
    """A call into Pinocchio that computes next to nothing: Python's share of the two above."""
    model, neutral = bench.model, pin.neutral
    for _ in bench.points:
        neutral(model)
    return len(bench.points)


@dataclass(frozen=True)
class Workload:
    """A function to time and the unit that it counts."""

    function: Callable[[Bench], int]
    unit: str

    @property
    def name(self) -> str:
        """Name in tables and keys."""
        return self.function.__name__


WORKLOADS: tuple[Workload, ...] = (
    Workload(rnea_derivatives, "call"),
    Workload(rnea, "call"),
    Workload(trivial_call, "call"),
    Workload(step, "step"),
    Workload(step_with_a_and_b, "step"),
    Workload(step_called_from_python, "call"),
    Workload(jacobians_called_from_python, "call"),
    Workload(rollout_500, "run"),
    Workload(sensitivities_500, "run"),
    Workload(step_of_eight, "step of a member"),
    Workload(step_of_eight_with_sensitivities, "step of a member"),
    Workload(sensitivities_of_one, "step"),
    Workload(adjoint_500, "run"),
    Workload(gradient_500, "run"),
    Workload(gauss_newton_iteration, "iteration"),
)

# key in the results: (workload, what it is divided by), for every size
RATIOS: dict[str, tuple[str, str]] = {
    "step_{n}_over_rnea_derivatives": ("step", "rnea_derivatives"),
    "step_ab_{n}_over_step": ("step_with_a_and_b", "step"),
    "step_called_from_python_{n}_over_step": ("step_called_from_python", "step"),
    "jacobians_called_from_python_{n}_over_step": ("jacobians_called_from_python", "step"),
    "rollout_500_{n}_over_step": ("rollout_500", "step"),
    "sensitivities_500_{n}_over_step": ("sensitivities_500", "step"),
    "step_of_eight_{n}_over_step": ("step_of_eight", "step"),
    "sensitivities_of_eight_{n}_over_alone": ("step_of_eight_with_sensitivities", "sensitivities_of_one"),
    "adjoint_{n}_over_step": ("adjoint_500", "step"),
    "gradient_500_{n}_over_step": ("gradient_500", "step"),
    "gauss_newton_iteration_{n}_over_step": ("gauss_newton_iteration", "step"),
}


def first_compile(bench: Bench) -> float:
    """Seconds from a system to a step and its derivatives by six stiffnesses, with an empty cache."""
    before = os.environ.get("YID_OCP_CACHE")
    with tempfile.TemporaryDirectory() as folder:
        os.environ["YID_OCP_CACHE"] = folder
        try:
            start = time.perf_counter()
            made = compile_step(bench.system, TIME_STEP)
            x, n = bench.start, bench.size
            made.jacobians(x[:n], x[n : 2 * n], bench.torque[0], bench.theta, names=STIFFNESSES)
            return time.perf_counter() - start
        finally:
            if before is None:
                del os.environ["YID_OCP_CACHE"]
            else:
                os.environ["YID_OCP_CACHE"] = before
