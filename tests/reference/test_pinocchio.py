"""Kinematics, mass matrix, gravity and inverse dynamics against Pinocchio, joints and frames matched by name."""

from dataclasses import dataclass

import casadi as ca
import numpy as np
import pytest

from yid_ocp.model import Mechanism, forward_kinematics
from yid_ocp.model import mechanism as mechanism_module
from yid_ocp.model.kinematics import lagrangian_first_derivatives, lagrangian_second_derivatives, mass_matrix
from yid_ocp.model.objects.foam_y import foam_y_object
from yid_ocp.model.urdf import read_urdf, urdf_path_from_robot_name

pin = pytest.importorskip("pinocchio", reason="the reference needs Pinocchio: pip install pin")

GRAVITY = np.array([0.4, -0.3, -9.81])
TOLERANCE = 1e-10
ARMS = [f"{side}_{joint}" for side in ("left", "right") for joint in ("s0", "s1", "e0", "e1", "w0", "w1", "w2")]
LOCKED = {"nod": 0.7, "slide": -0.15}

# name: (file, joints kept, values of locked joints)
ROBOTS = {
    "baxter": ("package:baxter", ARMS, {"head_pan": 0.4}),
    # its second finger follows the first, which Pinocchio does not know of: both locked, and one kept
    "panda": ("package:panda", [*(f"panda_joint{i}" for i in range(1, 8)), "panda_finger_joint1"], {}),
    "ur5": ("package:ur5", None, {}),
    "y_generated": (None, None, {}),
    "mixed_joints": ("mixed_joints.urdf", None, {}),
    "mixed_joints_locked": ("mixed_joints.urdf", ["extend", "hinge", "spin", "swing"], LOCKED),
}


@dataclass(frozen=True)
class Twin:
    """The same mechanism here and in Pinocchio."""

    mechanism: Mechanism
    model: object

    def functions(self):
        n = len(self.mechanism.joints)
        q, v, a = (ca.SX.sym(name, n) for name in "qva")
        kinematics = forward_kinematics(self.mechanism, q)
        rigid = lagrangian_first_derivatives(kinematics, v, ca.SX(ca.DM(GRAVITY)))
        by_qv = lagrangian_second_derivatives(rigid, self.mechanism)[1]
        M = mass_matrix(rigid, self.mechanism)
        effort = M @ a + by_qv.T @ v - rigid.lagrangian_by_q
        frames = list(self.mechanism.frames)
        poses = [kinematics.frame_pose(name).homogeneous_matrix() for name in frames]
        by_q = [(kinematics.position_jacobian(name), kinematics.angular_jacobian(name)) for name in frames]
        jacobians = [ca.vertcat(*pair) for pair in by_q]
        values = [M, rigid.lagrangian_by_q, effort, ca.dot(v, rigid.lagrangian_by_v) / 2, rigid.potential_energy]
        dynamics = ca.Function("dynamics", [q, v, a], values)
        return frames, ca.Function("poses", [q], poses), ca.Function("jacobians", [q], jacobians), dynamics

    @property
    def columns(self) -> list[int]:
        """Velocity index in Pinocchio of each of our coordinates."""
        return [self.model.joints[self.model.getJointId(name)].idx_v for name in self.mechanism.joint_names]

    def configuration(self, q) -> np.ndarray:
        """Pinocchio's q, in which a continuous joint is a cosine and a sine."""
        result = pin.neutral(self.model)
        for name, value in zip(self.mechanism.joint_names, q, strict=True):
            joint = self.model.joints[self.model.getJointId(name)]
            result[joint.idx_q : joint.idx_q + joint.nq] = [value] if joint.nq == 1 else [np.cos(value), np.sin(value)]
        return result

    def tangent(self, v) -> np.ndarray:
        result = np.zeros(self.model.nv)
        result[self.columns] = v
        return result


@pytest.fixture(scope="module", params=list(ROBOTS))
def twin(request, urdf_folder):
    """Read without rounding nearly exact entries, which Pinocchio does not do either."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mechanism_module, "_SNAP_TOLERANCE", 0.0)
        return make_twin(urdf_folder, *ROBOTS[request.param])


def make_twin(urdf_folder, file, joints, locked):
    if file is None:
        path = urdf_folder / "y_object.urdf"
    elif file.startswith("package:"):
        path = urdf_path_from_robot_name(file)
    else:
        path = urdf_folder / file
    if file is None:
        mechanism = foam_y_object().mechanism.with_numeric_values()
    else:
        mechanism = read_urdf(path, joints=joints, locked=locked).with_numeric_values()
    full = pin.buildModelFromUrdf(str(path))
    full.gravity.linear = GRAVITY
    if joints is None:
        return Twin(mechanism, full)
    whole = Twin(read_urdf(path).with_numeric_values(), full)
    values = [locked.get(name, 0.0) for name in whole.mechanism.joint_names]
    out = [i for i in range(1, full.njoints) if full.names[i] not in joints]
    return Twin(mechanism, pin.buildReducedModel(full, out, whole.configuration(values)))


def states(twin, count, seed):
    rng = np.random.default_rng(seed)
    n = len(twin.mechanism.joints)
    for _ in range(count):
        yield rng.uniform(-1.5, 1.5, n), rng.normal(size=n), rng.normal(size=n)


def close(actual, expected, scale=1.0):
    assert np.max(np.abs(actual - expected), initial=0.0) <= TOLERANCE * max(1.0, scale)


def test_frames_and_their_jacobians(twin):
    frames, poses, jacobians, _ = twin.functions()
    data = twin.model.createData()
    for q, _, _ in states(twin, 3, seed=1):
        pin.computeJointJacobians(twin.model, data, twin.configuration(q))
        pin.updateFramePlacements(twin.model, data)
        for name, pose, jacobian in zip(frames, poses.call([q]), jacobians.call([q]), strict=True):
            assert twin.model.existFrame(name) or name == "object_root"
            if not twin.model.existFrame(name):
                continue
            index = twin.model.getFrameId(name)
            close(np.array(pose), data.oMf[index].homogeneous)
            reference = pin.getFrameJacobian(twin.model, data, index, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
            close(np.array(ca.densify(jacobian)), reference[:, twin.columns])


def test_mass_matrix_gravity_and_inverse_dynamics(twin):
    _, _, _, dynamics = twin.functions()
    data = twin.model.createData()
    order = np.ix_(twin.columns, twin.columns)
    for q, v, a in states(twin, 5, seed=2):
        at, speed, acceleration = twin.configuration(q), twin.tangent(v), twin.tangent(a)
        M, _, effort, kinetic, potential = (np.array(ca.densify(x)).squeeze() for x in dynamics.call([q, v, a]))
        at_rest = np.array(dynamics.call([q, 0 * v, a])[1]).ravel()
        upper = np.triu(pin.crba(twin.model, data, at))
        reference = upper + np.triu(upper, 1).T
        close(M, reference[order], np.max(np.abs(reference)))
        weight = pin.computeGeneralizedGravity(twin.model, data, at)[twin.columns]
        close(-at_rest, weight, np.max(np.abs(weight)))
        needed = pin.rnea(twin.model, data, at, speed, acceleration)[twin.columns]
        close(effort, needed, np.max(np.abs(needed)))
        energy = pin.computeKineticEnergy(twin.model, data, at, speed)
        close(kinetic, energy, abs(energy))
        height = pin.computePotentialEnergy(twin.model, data, at)
        close(potential, height, abs(height))
