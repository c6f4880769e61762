"""Kinematics, energies, mass matrix, gravity and inverse dynamics against Pinocchio, joints and frames by name."""

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest

from yid_ocp.analysis.pinocchio_comparison import compare_urdf_with_pinocchio
from yid_ocp.model import forward_kinematics
from yid_ocp.model import mechanism as mechanism_module
from yid_ocp.model.kinematics import lagrangian_first_derivatives
from yid_ocp.model.objects.foam_y import foam_y_object
from yid_ocp.model.urdf import read_urdf, urdf_path_from_robot_name

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


@pytest.fixture(params=list(ROBOTS))
def robot(request, urdf_folder, monkeypatch):
    """Read without rounding nearly exact entries, which Pinocchio does not do either."""
    monkeypatch.setattr(mechanism_module, "_SNAP_TOLERANCE", 0.0)
    file, joints, locked = ROBOTS[request.param]
    if file is None:
        return urdf_folder / "y_object.urdf", foam_y_object().mechanism.with_numeric_values(), joints, locked
    path = urdf_path_from_robot_name(file) if file.startswith("package:") else urdf_folder / file
    return path, read_urdf(path, joints=joints, locked=locked).with_numeric_values(), joints, locked


def configuration(model, values) -> np.ndarray:
    """Pinocchio's q, in which a continuous joint is a cosine and a sine."""
    result = pin.neutral(model)
    for name, value in values.items():
        joint = model.joints[model.getJointId(name)]
        result[joint.idx_q : joint.idx_q + joint.nq] = [value] if joint.nq == 1 else [np.cos(value), np.sin(value)]
    return result


def close(actual, expected, scale=1.0):
    assert np.max(np.abs(actual - expected), initial=0.0) <= TOLERANCE * max(1.0, scale)


def test_frames_their_jacobians_and_energies(robot):
    path, mechanism, joints, locked = robot
    model, names = pin.buildModelFromUrdf(str(path)), mechanism.joint_names
    if joints is not None:
        out = [i for i in range(1, model.njoints) if model.names[i] not in joints]
        model = pin.buildReducedModel(model, out, configuration(model, locked))
    model.gravity.linear = GRAVITY
    columns = [model.joints[model.getJointId(name)].idx_v for name in names]
    data, n, rng = model.createData(), len(names), np.random.default_rng(1)
    q, v = ca.SX.sym("q", n), ca.SX.sym("v", n)
    kinematics = forward_kinematics(mechanism, q)
    rigid = lagrangian_first_derivatives(kinematics, v, ca.SX(ca.DM(GRAVITY)))
    energies = ca.Function("energies", [q, v], [ca.dot(v, rigid.lagrangian_by_v) / 2, rigid.potential_energy])
    for here, speed in zip(rng.uniform(-1.5, 1.5, (3, n)), rng.normal(size=(3, n)), strict=True):
        at, there = configuration(model, dict(zip(names, here, strict=True))), np.zeros(n)
        there[columns] = speed
        pin.computeJointJacobians(model, data, at)
        pin.updateFramePlacements(model, data)
        for name in mechanism.frames:
            assert model.existFrame(name) or name == "object_root"
            if not model.existFrame(name):
                continue
            index = model.getFrameId(name)
            jacobian = ca.vertcat(kinematics.position_jacobian(name), kinematics.angular_jacobian(name))
            frame = ca.Function("frame", [q], [kinematics.frame_pose(name).homogeneous_matrix(), jacobian])
            pose, by_q = (np.array(ca.densify(part)) for part in frame(here))
            close(pose, data.oMf[index].homogeneous)
            reference = pin.getFrameJacobian(model, data, index, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
            close(by_q, reference[:, columns])
        energy = pin.computeKineticEnergy(model, data, at, there), pin.computePotentialEnergy(model, data, at)
        close(np.array(energies(here, speed)).ravel(), energy, min(map(abs, energy)))


def test_mass_matrix_gravity_and_inverse_dynamics(robot):
    path, mechanism, joints, locked = robot
    found = compare_urdf_with_pinocchio(path, mechanism, GRAVITY, joints, locked)
    assert max(found.mass, found.weight, found.motion) <= TOLERANCE
