"""Plans carried out in MuJoCo with the true stiffness: ten goals, three models, one table.

    python benchmarks/planning.py [GOALS]

The free tip of the foam Y that one arm of Baxter holds is to be brought to ten places. Compared are the plan with the
true stiffness (what an identification that succeeds gives), the plan with 3 N m/rad everywhere, and no model: the
gripper is moved along a straight line by as much as the tip is to move, with the smoothest timing. Reported are the
largest distance of the tip from its place and its largest speed in the half second after the arm stands still.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from yid_ocp.integrator.step import Step, compile_step
from yid_ocp.planning.ends import end_at, first_rest
from yid_ocp.planning.options import PlanOptions
from yid_ocp.planning.path import SplinePath
from yid_ocp.planning.plan import PlannedMovement, plan
from yid_ocp.planning.points import Points
from yid_ocp.virtual.engine import Simulation, simulate_in_mujoco
from yid_ocp.virtual.experiment import paper_system
from yid_ocp.virtual.posture import initial_posture

Array = NDArray[np.float64]

TRUE: Mapping[str, float] = {
    "T1.bend": 22.0, "T1.twist": 14.0, "T2.bend": 11.0, "T2.twist": 8.0, "T3.bend": 11.5, "T3.twist": 9.7,
}  # fmt: skip
"""Of the order of the source paper's answer for one arm with vision [N m/rad]."""
GUESS: Mapping[str, float] = dict.fromkeys(TRUE, 3.0)
TIP, GRIPPER = "w_T3", "left_gripper"
DURATION, SETTLE, TRAVEL = 0.8, 0.5, 0.6  # [s], [s], [rad]


def goals(step: Step, count: int = 10) -> list[tuple[float, float, float]]:
    """Shifts of the tip by 4 to 8 cm in directions drawn once [m], of those that the arm can bring about in the time.

    Most are not: the arm reaches the tip through two tubes only. Kept are those at which the tip can rest with no joint
    turned by more than `TRAVEL`.
    """
    system, rng = step.system, np.random.default_rng(11)
    theta, tip = system.parameters.vector(TRUE), Points(system, [TIP])
    posture = initial_posture(system, TRUE)
    start = first_rest(step, theta, np.array([posture[name] for name in system.prescribed]))
    begin = tip.at(start.state[None, : system.size], theta)[0][0]
    found: list[tuple[float, float, float]] = []
    while len(found) < count:
        way = rng.normal(size=3)
        x, y, z = way / np.linalg.norm(way) * rng.uniform(0.04, 0.08)
        end = end_at(step, theta, start, tip, begin + np.array((x, y, z)), 1e-3)
        if end.distance < 1e-4 and np.abs(end.posture - start.state[list(system.prescribed_indices)]).max() < TRAVEL:
            found.append((float(x), float(y), float(z)))
    return found


def planning_step() -> Step:
    """One arm, prescribed, that holds the Y."""
    system = paper_system(1)
    return compile_step(replace(system, driven=(), prescribed=system.driven), 0.01)


def straight(step: Step, posture: Array, shift: Array, path: SplinePath) -> PlannedMovement:
    """The gripper along a straight line, its orientation as little changed as the arm allows."""
    system = step.system
    gripper, n = Points(system, [GRIPPER]), system.size
    joints = list(system.prescribed_indices)
    theta = system.parameters.vector()

    def at(x: Array) -> tuple[Array, Array]:
        q = np.zeros((1, n))
        q[0, joints] = x
        where, slope = gripper.at(q, theta)
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
    unknowns = np.linalg.lstsq(path.basis(times), np.array(way), rcond=None)[0]
    return PlannedMovement(system.prescribed, path, unknowns)


class Servo:
    """Position control beside the virtual robot's own torques, as stiff as that of an industrial arm.

    The torque-controlled arm of the virtual experiments gives way under the object's load by some milliradians, which
    says nothing of a plan.
    """

    STIFFNESS, DAMPING = 5e3, 60.0  # [N m/rad], [N m s/rad]

    def __init__(self, movement: PlannedMovement) -> None:
        self._movement = movement
        self._joints, self._first = np.zeros(0, int), np.zeros(0)
        self._kept: tuple[float, Array] | None = None

    def prepare(self, model: Any) -> None:
        """Find the joints' addresses."""
        self._joints = np.array([model.joint(name).id for name in self._movement.joints])

    def begin(self, data: Any) -> None:
        """Take the posture at rest as where the motion begins."""
        self._first, self._kept = data.qpos[self._joints].copy(), (-1.0, np.zeros((3, 7)))

    def force(self, _: Any, data: Any) -> None:
        """Pull towards the planned angles."""
        # the clock of the controller's own model, which is asked for torques, stands still
        t = float(data.time)
        if self._kept is None or t == 0.0:
            return
        if t - self._kept[0] >= 1e-3 - 1e-9 or t < self._kept[0]:
            self._kept = (t, np.array(self._movement.at(t)))
        offset, rate, _bend = self._kept[1]
        q, v = data.qpos[self._joints] - self._first, data.qvel[self._joints]
        data.qfrc_passive[self._joints] += self.STIFFNESS * (offset - q) + self.DAMPING * (rate - v)


def carried_out(movement: PlannedMovement, posture: Mapping[str, float], place: Array) -> tuple[float, float]:
    """Error [m] and swing [m/s] of the tip in the simulator."""
    system = paper_system(1)
    simulation = Simulation(DURATION + SETTLE, controller_rate=500.0, effort_kind="mean")
    run = simulate_in_mujoco(system, TRUE, movement, simulation, posture=posture, injected=Servo(movement))
    tip = run.points[run.t >= DURATION - 1e-9, system.points.index(TIP)]
    speed = np.linalg.norm(np.diff(tip, axis=0), axis=1) * 100.0
    return float(np.max(np.linalg.norm(tip - place, axis=1))), float(np.max(speed))


def compared(shift: tuple[float, float, float], step: Step) -> dict[str, tuple[float, float]]:
    """Error and swing of the three ways to one goal."""
    system = step.system
    posture = initial_posture(system)
    true, guess = (system.parameters.vector(values) for values in (TRUE, GUESS))
    options = PlanOptions(point=TIP, shift=shift, duration=DURATION, settle=SETTLE)
    best = plan(step, options, true)
    # the same place in the world, whatever the model believes of where the tip rests
    rough = plan(step, replace(options, shift=None, place=tuple(best.place)), guess)
    first = np.array([posture[name] for name in system.prescribed])
    ways = {
        "identified": PlannedMovement(best.joints, best.mover.path, best.unknowns),
        "3 N m/rad": PlannedMovement(rough.joints, rough.mover.path, rough.unknowns),
        "straight": straight(step, first, np.array(shift), best.mover.path),
    }
    return {name: carried_out(way, posture, best.place) for name, way in ways.items()}


def main(count: int) -> None:
    """Print the table."""
    step = planning_step()
    print("| goal | shift [mm] | identified: error [mm], swing [mm/s] | 3 N m/rad | straight |")
    print("|---|---|---|---|---|")
    ratios = []
    for i, shift in enumerate(goals(step, count)):
        found = compared(shift, step)
        cells = [f"{1e3 * error:.2f}, {1e3 * swing:.1f}" for error, swing in found.values()]
        print(f"| {i + 1} | {', '.join(f'{1e3 * x:.0f}' for x in shift)} | {' | '.join(cells)} |", flush=True)
        own = np.array(found["identified"])
        ratios.append([np.array(found[name]) / own for name in ("3 N m/rad", "straight")])
    for name, own in zip(("3 N m/rad", "straight"), np.array(ratios).transpose(1, 0, 2), strict=True):
        (error, swing), (most_error, most_swing) = own.min(0), own.max(0)
        print(f"{name}: error {error:.1f} to {most_error:.1f} times, swing {swing:.1f} to {most_swing:.1f}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10)
