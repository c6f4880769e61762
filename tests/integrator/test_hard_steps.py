"""Steps that are hard to solve: both kernels reach the same point, its derivatives and, where there is none, the same
status. The kernels share nothing but the equations."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import pytest

from yid_ocp.integrator.step import compile_step
from yid_ocp.integrator.step_model import NewtonStatusCode, RolloutInputs, RolloutNewtonSummary, SensitivityDirections
from yid_ocp.model import Grasp, System
from yid_ocp.model.system import six_joint_floating_mechanism
from yid_ocp.model.urdf import read_urdf

BENT = np.array([0.3, -0.2, 0.1, 0.4, 0.2, -0.1, 0.2, 0.3, 0.15])
NEARLY_STRAIGHT = np.array([1, -1, 0.5, 0.3, 1, 0.2, -1, 0.5, 0.1])


@dataclass(frozen=True)
class Hard:
    """A motion of `steps` steps from (q, p), with prescribed coordinates moved in the first step.

    `damped` says that Newton's first correction is too large to be taken whole; `conditioning` by how much the
    equations magnify rounding in the multipliers.
    """

    system: System
    q: np.ndarray
    time_step: float
    p: np.ndarray | float = 0.0
    torque: float = 0.0
    moved: np.ndarray | float = 0.0
    steps: int = 1
    code: NewtonStatusCode = NewtonStatusCode.OK
    damped: bool = False
    conditioning: float = 1.0
    tolerance: float | None = None

    def step(self, use_compiler: bool):
        return compile_step(self.system, self.time_step, use_compiler=use_compiler, tolerance=self.tolerance)

    def inputs(self):
        n, nz = self.system.n_coordinates, len(self.system.effect_internal_coordinate_symbols)
        start = np.concatenate([self.q, np.broadcast_to(self.p, n), np.zeros(nz)])
        torque = np.full((self.steps, len(self.system.driven)), self.torque)
        path = np.tile(self.q[list(self.system.prescribed_coordinate_indices)], (self.steps + 1, 1))
        path[1:] += self.moved
        return self.system.parameters.vector(), start, torque, path


def gripped_cable(parts, shape):
    """The cable in a shape, its end held by a prescribed clamp."""
    clamp, end = six_joint_floating_mechanism("clamp"), parts.tip(parts.cable().mechanism, "w_C", shape)[:3, 3]
    objects, grasps = [(parts.cable_object(), None, None)], [Grasp("end", "clamp", "w_C")]
    system = System.build(clamp, objects=objects, grasps=grasps, prescribed=clamp.joint_names)
    return system, np.concatenate([end, np.zeros(3), shape])


def pendulum(folder):
    return System.build(read_urdf(folder / "double_pendulum.urdf"), driven=["elbow"])


def out_of_reach(folder):
    """The pendulum, free to turn, grasped at a point 3 m away."""
    turn = read_urdf(folder / "turntable.urdf", joints=["turn"])
    carrier = replace(turn, frames={"disc": turn.frames["disc"]})
    far = Grasp("far", "ceiling", "tip", holder_offset=ca.SX(ca.DM([0.0, 3.0, 0.0])))
    hung = carrier.with_attached_mechanism(read_urdf(folder / "double_pendulum.urdf"), "disc")
    return System.build(hung, grasps=[far])


def redundant(folder):
    grasps = tuple(Grasp(name, "floor", "disc") for name in ("one", "two"))
    return replace(System.build(read_urdf(folder / "turntable.urdf")), grasps=grasps)


CLAMP_TURNED = np.array([-0.2, 0.1, -0.2, 0.2, 0.2, 0.2])
PULLED_BACK = np.array([0.0, 0.0, -1e-4, 0.0, 0.0, 0.0])
HANGING, CODE = np.array([0.3, -0.2]), NewtonStatusCode
CASES: dict[str, Callable[..., Hard]] = {
    "fast_pendulum": lambda p, f: Hard(pendulum(f), HANGING, 0.2, p=np.array([30.0, 20.0]), torque=5.0, damped=True),
    "closed_loop_moved_far": lambda p, f: Hard(*p.closed_loop(f), 0.05, torque=60.0, moved=1.0, steps=2, damped=True),
    "internal_coordinates": lambda p, f: Hard(
        p.cable(effects=[p.maxwell_branch("C_0_x", 30.0, 0.02), p.soft_joint("C_1_y", 0.2)]),
        2 * BENT,
        0.05,
        p=0.3 * BENT,
        steps=2,
        damped=True,
    ),
    "creeping_grasp": lambda p, f: Hard(
        *p.clamped_cable("point", [p.creeping_grasp("clamp", 0.05), p.soft_grasp("clamp", 1e-4, 2e-3)]),
        0.005,
        moved=CLAMP_TURNED / 2,
        damped=True,
    ),
    "almost_at_full_stretch": lambda p, f: Hard(*gripped_cable(p, 1e-4 * NEARLY_STRAIGHT), 1e-3, conditioning=1e5),
    "short_steps_to_the_last_digit": lambda p, f: Hard(p.cable(), BENT, 5e-6, p=0.1 * BENT, steps=300, tolerance=1e-17),
    "at_full_stretch": lambda p, f: Hard(*gripped_cable(p, 0 * BENT), 1e-3, moved=PULLED_BACK, code=CODE.SINGULAR),
    "redundant_grasps": lambda p, f: Hard(redundant(f), np.array([0.1, 0.2, 0.3]), 0.01, code=CODE.SINGULAR),
    "out_of_reach": lambda p, f: Hard(out_of_reach(f), np.array([0.1, 0.3, 0.4]), 0.01, code=CODE.NOT_CONVERGED),
    "much_too_fast": lambda p, f: Hard(
        pendulum(f), HANGING, 1.0, p=np.array([10.0, -4.0]), torque=5.0, code=CODE.NOT_CONVERGED
    ),
    "not_a_number": lambda p, f: Hard(pendulum(f), HANGING, 0.01, torque=np.nan, code=CODE.NOT_FINITE),
}


@pytest.fixture(scope="module", params=list(CASES))
def hard(request, parts, urdf_folder) -> Hard:
    return CASES[request.param](parts, urdf_folder)


def first_correction(hard: Hard) -> float:
    """Newton's first correction of the coordinates, from the state before as the guess."""
    step, (theta, start, torque, path) = hard.step(use_compiler=False), hard.inputs()
    after = start.copy()
    after[list(hard.system.prescribed_coordinate_indices)] = path[1]
    sizes, unknown = step.sizes, step.model.index_tables.unknown_rows
    pair = np.stack([start, after])
    found = step.kernel.step_residuals_and_jacobians(theta, pair, np.zeros((1, sizes["m"])), torque[:1], (), True)
    change = np.linalg.solve(found.residual_by_new[0][np.ix_(unknown, unknown)], found.residual[0][unknown])
    return float(np.max(np.abs(change[: len(unknown) - sizes["m"]])))


def test_both_kernels_agree(parts, hard):
    if not hard.step(use_compiler=True).is_compiled:
        pytest.skip("this machine has no C compiler to compare with")
    steps = [hard.step(use_compiler) for use_compiler in (True, False)]
    theta, start, torque, path = hard.inputs()
    names = tuple(hard.system.parameters.names)
    directions = SensitivityDirections(names, np.random.default_rng(1).normal(size=(len(start), len(names))))
    directions.initial_state_tangents[list(hard.system.prescribed_coordinate_indices)] = 0.0
    inputs = RolloutInputs(theta, start, torque, path, None, directions)
    one, two = (step.kernel.rollout(inputs) for step in steps)
    assert (one.status.code, two.status.code) == (hard.code, hard.code)
    done = hard.steps if hard.code == NewtonStatusCode.OK else 0
    assert one.status.completed_steps == two.status.completed_steps == done
    assert one.status.message.partition("(")[0] == two.status.message.partition("(")[0]
    if hard.code != NewtonStatusCode.OK:
        assert all(np.all(np.isnan(r.state_sensitivity[1:])) and np.all(np.isnan(r.multipliers)) for r in (one, two))
        return
    if hard.damped:
        assert first_correction(hard) > 0.5
    parts.assert_kernels_agree(steps, inputs, hard.conditioning)


@pytest.mark.parametrize("code", list(NewtonStatusCode))
@pytest.mark.parametrize("step", [3, 700])
def test_a_failure_after_hundreds_of_steps_names_the_methods_limit(code, step):
    late = step == 700 and code in (NewtonStatusCode.NOT_CONVERGED, NewtonStatusCode.NOT_FINITE)
    assert ("midpoint rule has no numerical damping" in RolloutNewtonSummary(code, step, 0.1, 5).message) is late
