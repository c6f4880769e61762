"""Plans carried out in MuJoCo with the true stiffness and damping: ten goals, four models, and one withheld effect.

    python benchmarks/planning.py [GOALS] [--only goals | effect | hands] [--noise SEED]

The free tip of the foam Y that one arm of Baxter holds is to be brought to ten places (`configs/plan_place.yaml`). The
model is identified first, by `solve` on two noisy recordings made in MuJoCo. Compared are the plan with what was found,
the plan with the true stiffness, the plan with 3 N m/rad everywhere, and no model: the gripper is moved along a
straight line by as much as the tip is to move, with the smoothest timing. Reported are the largest distance of the tip
from its place and its largest speed in the half second after the arm stands still.

Then something that the model lacks hangs on the tip: a plan before `diagnose` has found it, and one after. In the end
two arms move what they hold.
"""

from __future__ import annotations

import argparse
import contextlib
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from baxter import baxter_foam_y_system
from make_recordings import ROUGH, TRUTH, shaken_motion
from numpy.typing import NDArray
from scipy.optimize import least_squares

from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import EffectSettings, ParameterSettings, RunSettings
from yid_ocp.data.recording_hdf5 import write_recording
from yid_ocp.effects import make_effect
from yid_ocp.errors import ConfigError
from yid_ocp.integrator.step import Step, compile_step
from yid_ocp.model.system import System
from yid_ocp.planning.joint_paths import (
    FramePositionEvaluator,
    RestToRestSplineBasis,
    solve_equilibrium_at_point_target,
    solve_start_equilibrium,
)
from yid_ocp.planning.motion_plan import TargetMotionPlan, plan_motion_to_target
from yid_ocp.virtual.experiment import PointCamera, VirtualExperimentSettings
from yid_ocp.virtual.injected import InjectedEffect, run_experiment_with_injected_effects
from yid_ocp.virtual.joint_motion import MultisineOptions, grasping_joint_angles
from yid_ocp.virtual.mujoco_simulation import SimulationOptions, simulate_in_mujoco
from yid_ocp.workflow.build import build_step
from yid_ocp.workflow.diagnose import run_diagnose
from yid_ocp.workflow.plan import (
    _configured_or_recorded_start_positions,
    _run_with_prescribed_arms,
    identified_parameters_with_covariance,
)
from yid_ocp.workflow.solve import run_solve

Array = NDArray[np.float64]

CONFIG = Path(__file__).resolve().parents[1] / "configs" / "plan_place.yaml"
GUESS: Mapping[str, float] = dict.fromkeys(TRUTH, 3.0)
TIP, GRIPPER = "w_T3", "left_gripper"
TRAVEL = 0.6  # of a joint [rad]
CAMERA = PointCamera(frame_rate=30.0, has_dropouts=False)  # 5 mm of noise, one frame in ten without the point
MOTIONS = (7, 2)  # their seeds
NOISE = 501  # seed of the first recording's noise, the next one's is one more
RECORDED = 10.0  # [s]
HANGING_SHIFT = (-0.044, 0.0, 0.026)  # of the tip on which something hangs [m]
HANGING = InjectedEffect("point_mass", TIP, {"mass": 0.01})


def goals(step: Step, count: int = 10) -> list[tuple[float, float, float]]:
    """Shifts of the tip by 4 to 8 cm in directions drawn once [m], of those that the arm can bring about in the time.

    Most are not: the arm reaches the tip through two tubes only. Kept are those at which the tip can rest with no joint
    turned by more than `TRAVEL`.
    """
    system, rng = step.system, np.random.default_rng(11)
    theta, tip = system.parameters.vector(TRUTH), FramePositionEvaluator(system, [TIP])
    posture = grasping_joint_angles(system, TRUTH)
    start = solve_start_equilibrium(step, theta, np.array([posture[name] for name in system.prescribed]))
    begin = tip.positions_and_jacobian(start.state[None, : system.n_coordinates], theta)[0][0]
    found: list[tuple[float, float, float]] = []
    while len(found) < count:
        way = rng.normal(size=3)
        x, y, z = way / np.linalg.norm(way) * rng.uniform(0.04, 0.08)
        place = begin + np.array((x, y, z))
        with contextlib.suppress(ConfigError):
            end = solve_equilibrium_at_point_target(step, theta, start, tip, place, 1e-3)
            rest = tip.positions_and_jacobian(end.state[None, : system.n_coordinates], theta)[0][0]
            travel = (end.state - start.state)[list(system.prescribed_coordinate_indices)]
            if np.linalg.norm(rest - place) < 1e-4 and np.abs(travel).max() < TRAVEL:
                found.append((float(x), float(y), float(z)))
    return found


@dataclass(frozen=True, eq=False)
class PlannedMovement:
    """A planned joint motion as reference for the virtual robot's controller."""

    joints: tuple[str, ...]
    path: RestToRestSplineBasis
    spline_coefficients: Array

    def offset_and_derivatives(self, t: float) -> tuple[Array, Array, Array]:
        """Joint displacement from the start, velocity and acceleration at time t [s], three arrays of shape (nj,)."""
        bases = (self.path.basis_values(np.array([t]), order)[0] for order in range(3))
        offset, rate, bend = (basis @ self.spline_coefficients for basis in bases)
        return offset, rate, bend


def straight(step: Step, posture: Array, shift: Array, path: RestToRestSplineBasis) -> PlannedMovement:
    """The gripper along a straight line, its orientation as little changed as the arm allows."""
    system = step.system
    gripper, n = FramePositionEvaluator(system, [GRIPPER]), system.n_coordinates
    joints = list(system.prescribed_coordinate_indices)
    theta = system.parameters.vector()

    def at(x: Array) -> tuple[Array, Array]:
        q = np.zeros((1, n))
        q[0, joints] = x
        where, slope = gripper.positions_and_jacobian(q, theta)
        return where[0], slope[0][:, joints]

    first = at(posture)[0]
    times = np.linspace(0.0, path.duration, 60)
    s = times / path.duration
    smooth = s**3 * (10 - 15 * s + 6 * s**2)
    way, x = [], posture
    for share in smooth:
        place = first + share * shift
        x = least_squares(
            lambda y, place=place: np.append(1e3 * (at(y)[0] - place), 1e-2 * (y - posture)), x, xtol=1e-14, ftol=1e-14
        ).x
        way.append(x - posture)
    unknowns = np.linalg.lstsq(path.basis_values(times), np.array(way), rcond=None)[0]
    return PlannedMovement(system.prescribed, path, unknowns)


class Servo:
    """The robot's own position control: planned torques fed forward, and a servo as stiff as an industrial arm's.

    The torque-controlled arm of the virtual experiments gives way under the object's load by some milliradians, which
    says nothing of a plan. Without planned torques it is the virtual robot's own that are fed forward: of the arm
    alone, the object's load as it was at the start.
    """

    STIFFNESS, DAMPING = 5e3, 300.0  # [N m/rad], [N m s/rad]

    def __init__(self, movement: PlannedMovement, planned: TargetMotionPlan | None) -> None:
        self._movement, self._planned = movement, planned
        self._joints, self._first = np.zeros(0, int), np.zeros(0)
        self._kept: tuple[float, Array, Array | None] | None = None

    def edit_model(self, model: Any) -> None:
        """Find the joints' addresses; damping is the model's own, which the simulator integrates implicitly."""
        self._joints = np.array([model.joint(name).id for name in self._movement.joints])
        model.dof_damping[self._joints] += self.DAMPING

    def begin_motion(self, data: Any) -> None:
        """Take the posture at rest as where the motion begins."""
        self._first, self._kept = data.qpos[self._joints].copy(), (-1.0, np.zeros((3, len(self._joints))), None)

    def add_forces(self, _: Any, data: Any) -> None:
        """Pull towards the planned angles."""
        # the clock of the controller's own model, which is asked for torques, stands still
        t = float(data.time)
        if self._kept is None or t == 0.0:
            return
        if t - self._kept[0] >= 1e-3 - 1e-9 or t < self._kept[0]:
            self._kept = (t, np.array(self._movement.offset_and_derivatives(t)), self._fed_forward(t))
        (offset, rate, _bend), torque = self._kept[1:]
        push = self.STIFFNESS * (offset - data.qpos[self._joints] + self._first) + self.DAMPING * rate
        if torque is not None:
            push += torque - data.qfrc_applied[self._joints]
        data.qfrc_passive[self._joints] += push

    def _fed_forward(self, t: float) -> Array | None:
        if self._planned is None:
            return None
        # an effort is the mean over its step
        middle = self._planned.t[:-1] + self._planned.simulator.step.time_step / 2
        return np.array([np.interp(t, middle, one) for one in self._planned.joint_efforts[:-1].T])


def carried_out(
    system: System,
    values: Mapping[str, float],
    movement: PlannedMovement,
    planned: TargetMotionPlan | None,
    by: TargetMotionPlan,
) -> tuple[float, float]:
    """Error [m] and swing [m/s] of a plan's point in the simulator, where the plan begins and as long as it takes."""
    duration, settle = by.simulator.path.duration, by.simulator.hold_duration
    simulation = SimulationOptions(duration + settle, time_step=5e-5, controller_rate=500.0, effort_kind="mean")
    # all coordinates, so that what hangs between two hands is in their hold when it settles
    posture = dict(
        zip(system.mechanism.joint_names, map(float, by.rollout.state[0, : system.n_coordinates]), strict=True)
    )
    terms = Servo(movement, planned)
    run = simulate_in_mujoco(system, values, movement, simulation, initial_joint_angles=posture, injected=terms)
    tip = run.point_positions[run.t >= duration - 1e-9, system.point_frames.index(by.target_point)]
    speed = np.linalg.norm(np.diff(tip, axis=0), axis=1) * simulation.sample_rate
    return float(np.max(np.linalg.norm(tip - by.target_position, axis=1))), float(np.max(speed))


def movement(planned: TargetMotionPlan) -> PlannedMovement:
    return PlannedMovement(planned.joint_names, planned.simulator.path, planned.spline_coefficients)


def settings(**recordings: Sequence[Path]) -> RunSettings:
    """The configuration with recordings by purpose."""
    files = [f"recordings.{purpose}=[{', '.join(map(str, paths))}]" for purpose, paths in recordings.items()]
    return load_config(CONFIG, [*files, "output.write_report=false", "output.checked_discretisation=none"])


def record(folder: Path, noise: int = NOISE, effects: Sequence[InjectedEffect] = ()) -> list[Path]:
    """Two recordings of what the arm with its noisy torques and a camera see of the Y."""
    folder.mkdir(parents=True)
    system = baxter_foam_y_system(1)
    posture = grasping_joint_angles(system, TRUTH)
    simulation = replace(ROUGH.simulation, duration=RECORDED)
    files = []
    for i, motion_seed in enumerate(MOTIONS):
        excitation = MultisineOptions(gripper_travel=ROUGH.travel[1], duration=RECORDED)
        motion = shaken_motion(system, TRUTH, posture, motion_seed, excitation, ROUGH.shake)
        experiment = VirtualExperimentSettings(motion, posture, simulation, ROUGH.noise(1), CAMERA, seed=noise + i)
        files.append(folder / f"motion_{motion_seed}.h5")
        write_recording(run_experiment_with_injected_effects(system, TRUTH, effects, experiment), files[-1])
    return files


def found(run: RunSettings, folder: Path) -> tuple[Array, Step]:
    """Parameters that `solve` finds, as a plan takes them, and the step that plans."""
    solved = run_solve(run, folder)
    for name, entry in solved.result["parameters"].items():
        if entry["free"]:
            std = "unknown" if entry["std"] is None else f"{entry['std']:.2g}"
            print(f"  {name}: {entry['value']:.4g} +- {std} {entry['unit']} (true {TRUTH.get(name, HANGING.values)})")
    step = build_step(_run_with_prescribed_arms(run))
    return identified_parameters_with_covariance(
        replace(run, plan=replace(run.plan, parameter_run_folder=str(folder))), step
    )[0], step


def ten_goals(folder: Path, count: int, noise: int) -> None:
    """Print the table of goals."""
    run = settings(estimate=record(folder / "data", noise))
    print("found by solve:")
    theta, step = found(run, folder / "solved")
    true, guess = (step.system.parameters.vector(values) for values in (TRUTH, GUESS))
    twin, posture = baxter_foam_y_system(1), grasping_joint_angles(step.system)
    names = ("identified", "true stiffness", "3 N m/rad", "straight")
    print(f"| goal | shift [mm] | {names[0]}: error [mm], swing [mm/s] | {' | '.join(names[1:])} |")
    print("|" + "---|" * (2 + len(names)))
    ratios = []
    for i, shift in enumerate(goals(step, count)):
        options = replace(run.plan, point_target_offset_from_start=shift, start_joint_positions=posture)
        best = plan_motion_to_target(step, options, true)
        # the same place in the world, whatever a model believes of where the tip rests
        there = replace(options, point_target_offset_from_start=None, target_position=tuple(best.target_position))
        plans = [plan_motion_to_target(step, there, theta), best, plan_motion_to_target(step, there, guess)]
        cells = [carried_out(twin, TRUTH, movement(one), one, one) for one in plans]
        first = np.array([posture[name] for name in step.system.prescribed])
        cells.append(carried_out(twin, TRUTH, straight(step, first, np.array(shift), best.simulator.path), None, best))
        text = [f"{1e3 * error:.2f}, {1e3 * swing:.1f}" for error, swing in cells]
        print(f"| {i + 1} | {', '.join(f'{1e3 * x:.0f}' for x in shift)} | {' | '.join(text)} |", flush=True)
        ratios.append([np.array(cell) / np.array(cells[0]) for cell in cells[2:]])
    for name, own in zip(names[2:], np.array(ratios).transpose(1, 0, 2), strict=True):
        (error, swing), (most_error, most_swing) = own.min(0), own.max(0)
        print(f"{name}: error {error:.1f} to {most_error:.1f} times, swing {swing:.1f} to {most_swing:.1f}")


def with_effects(run: RunSettings, effects: Sequence[Mapping[str, Any]]) -> RunSettings:
    """The run whose model has effects, their parameters free."""
    said = tuple(EffectSettings(kind=one["kind"], location=one["location"]) for one in effects)
    own = {f"{one.kind}@{one.location}.*": ParameterSettings(free=True) for one in said}
    return replace(run, model=replace(run.model, effects=said), parameters={**run.parameters, **own})


def withheld_effect(folder: Path) -> None:
    """Print what becomes of one goal before and after the diagnosis."""
    estimate, held_out = record(folder / "data", effects=[HANGING])
    run = settings(estimate=[estimate], held_out=[held_out])
    result = run_diagnose(run, folder / "diagnosed").result
    print(f"diagnosis: {result['verdict']}, {result['effects']}, confusable {result['confusable']}")
    twin = baxter_foam_y_system(1).with_effects(
        [make_effect(HANGING.kind, HANGING.location, baxter_foam_y_system(1), HANGING.values)]
    )
    posture = grasping_joint_angles(twin, TRUTH)
    tip, theta = FramePositionEvaluator(twin, [TIP]), twin.parameters.vector(TRUTH)
    true = compile_step(replace(twin, driven=(), prescribed=twin.driven), 0.01)
    rest = solve_start_equilibrium(true, theta, np.array(list(posture.values()))).state[None, : twin.n_coordinates]
    x, y, z = map(float, tip.positions_and_jacobian(rest, theta)[0][0] + HANGING_SHIFT)
    print("| model | error [mm] | swing [mm/s] |\n|---|---|---|")
    for name, chosen in (("before", run), ("after", with_effects(run, result["effects"]))):
        values, step = found(chosen, folder / name)
        made = plan_motion_to_target(
            step,
            replace(
                run.plan, point_target_offset_from_start=None, target_position=(x, y, z), start_joint_positions=posture
            ),
            values,
        )
        error, swing = carried_out(twin, TRUTH, movement(made), made, made)
        print(f"| {name} | {1e3 * error:.2f} | {1e3 * swing:.1f} |", flush=True)


def two_hands() -> None:
    """Print what becomes of plans for two arms, beside a smooth motion of every joint to the same posture."""
    truth = ", ".join(f"{name}: {{initial: {value}}}" for name, value in TRUTH.items())
    way = "plan={point: w_T1, point_target_offset_from_start: [0.03, 0.03, 0.0], duration: 0.8}"
    print("| held by two arms | plan: error [mm], swing [mm/s] | same posture, smoothly |\n|---|---|---|")
    for name, config, more in (
        ("junction of the Y", "dual_arm_vision", ["parameters={}", f"parameters={{{truth}}}", way]),
        ("middle of a cable", "plan_cable", []),
    ):
        run = load_config(CONFIG.with_name(f"{config}.yaml"), more)
        step = build_step(_run_with_prescribed_arms(run))
        made = plan_motion_to_target(
            step, replace(run.plan, start_joint_positions=_configured_or_recorded_start_positions(run, step))
        )
        points = tuple(dict.fromkeys((*step.system.point_frames, made.target_point)))
        twin = replace(step.system, driven=step.system.prescribed, prescribed=(), point_frames=points)
        smooth = replace(
            movement(made),
            spline_coefficients=made.simulator.path.straight_line_coefficients(made.spline_coefficients[-1]),
        )
        cells = [carried_out(twin, {}, one, made, made) for one in (movement(made), smooth)]
        print(
            f"| {name} | {' | '.join(f'{1e3 * error:.2f}, {1e3 * swing:.1f}' for error, swing in cells)} |", flush=True
        )


def main() -> None:
    """Make what is asked for in a folder that is thrown away."""
    parser = argparse.ArgumentParser(description="Carry plans out in MuJoCo.")
    parser.add_argument("goals", nargs="?", type=int, default=10)
    parser.add_argument("--only", choices=("goals", "effect", "hands"))
    parser.add_argument("--noise", type=int, default=NOISE, help="seed of the recordings' noise")
    said = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        if said.only in (None, "goals"):
            ten_goals(Path(folder) / "goals", said.goals, said.noise)
        if said.only in (None, "effect"):
            withheld_effect(Path(folder) / "effect")
        if said.only in (None, "hands"):
            two_hands()


if __name__ == "__main__":
    main()
