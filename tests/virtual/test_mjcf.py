from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import pytest
from virtual_examples import SYSTEMS, TRUTH, clamped_beam

from yid_ocp.errors import ConfigError, ModelError
from yid_ocp.model.flexible import Segment, flexible_object
from yid_ocp.model.kinematics import forward_kinematics, mass_matrix, rigid_body_derivatives
from yid_ocp.model.mechanism import Frame, Placement
from yid_ocp.model.parameters import Parameter, Parameters
from yid_ocp.model.system import Grasp, MidpointState, StepTerms, System, floating_clamp
from yid_ocp.virtual.mjcf import mujoco_xml

mujoco = pytest.importorskip("mujoco", reason="virtual experiments need MuJoCo: pip install 'yid-ocp[blind]'")


@pytest.mark.parametrize(
    ("system", "values"),
    [
        (SYSTEMS[1], TRUTH),
        (SYSTEMS[2], {**TRUTH, "T2.mass": 0.03, "T3.length": 0.9, "left_w0.mass": 3.0}),
        (clamped_beam(), {"B.length": 0.6}),
        (replace(clamped_beam(), point_frames=("w_B", "B:40%")), {}),
    ],
    ids=["single", "dual", "clamp", "along"],
)
def test_mechanics_equals_the_symbolic_one(system: System, values: dict[str, float]) -> None:
    q, v = ca.SX.sym("q", system.n_coordinates), ca.SX.sym("v", system.n_coordinates)
    kinematics = forward_kinematics(system.mechanism, q)
    rigid = rigid_body_derivatives(kinematics, v, system.gravity)
    bias = ca.jtimes(rigid.lagrangian_by_v, q, v) - rigid.lagrangian_by_q
    passive = system.viscous_force(v) - ca.gradient(system.elastic_energy(q), q)
    points = ca.horzcat(*(kinematics.frame_position(name) for name in system.point_frames))
    ours = ca.Function(
        "ours", [q, v, system.parameters.symbols], [mass_matrix(rigid, system.mechanism), bias, passive, points]
    )
    model = mujoco.MjModel.from_xml_string(mujoco_xml(system, values))
    data = mujoco.MjData(model)
    order = [model.joint(name).id for name in system.mechanism.joint_names]
    assert model.nv == system.n_coordinates
    rng = np.random.default_rng(0)
    for _ in range(3):
        posture, velocity = rng.uniform(-1, 1, system.n_coordinates), rng.uniform(-1, 1, system.n_coordinates)
        data.qpos[order], data.qvel[order] = posture, velocity
        mujoco.mj_forward(model, data)
        mass = np.zeros((model.nv, model.nv))
        for column in range(model.nv):
            mujoco.mj_mulM(model, data, mass[column], np.eye(model.nv)[column])
        expected = [np.array(ca.densify(e)) for e in ours(posture, velocity, system.parameters.vector(values))]
        np.testing.assert_allclose(mass[np.ix_(order, order)], expected[0], rtol=0, atol=1e-9)
        np.testing.assert_allclose(data.qfrc_bias[order], expected[1].ravel(), rtol=0, atol=1e-9)
        np.testing.assert_allclose(data.qfrc_passive[order], expected[2].ravel(), rtol=0, atol=1e-9)
        seen = np.array([data.site(name).xpos for name in system.point_frames])
        np.testing.assert_allclose(seen, expected[3].T, rtol=0, atol=1e-9)


@dataclass(frozen=True)
class Pull:
    kind: str = "pull"
    location: str = "T1"

    def __post_init__(self) -> None:
        object.__setattr__(self, "parameters", Parameters([Parameter("pull@T1.force", 0.0, "N m")]))
        object.__setattr__(self, "internal_coordinates", {})

    def apply_to_system(self, system: System) -> System:
        return system

    def step_terms(self, state: MidpointState) -> StepTerms:
        return StepTerms(generalized_force=self.parameters["pull@T1.force"].symbol * state.v)  # type: ignore[attr-defined]


def test_what_mujoco_cannot_express_is_refused() -> None:
    system = clamped_beam()
    with_effect = system.with_effects([Pull()])  # type: ignore[list-item]
    assert mujoco_xml(with_effect) == mujoco_xml(system)
    with pytest.raises(ModelError, match="pull@T1"):
        mujoco_xml(with_effect, {"pull@T1.force": 1.0})
    grasp = Grasp("clamp", "clamp", "w_B", compliance=ca.SX(1e-3))
    with pytest.raises(ModelError, match="compliant"):
        mujoco_xml(replace(system, grasps=(grasp,)))
    with pytest.raises(ModelError, match="'B_0_x' is rigid"):
        mujoco_xml(replace(system, joint_compliances={"B_0_x": ca.SX(0)}))
    with pytest.raises(ModelError, match="has a mass"):
        mujoco_xml(System.build(floating_clamp("clamp")))
    beam = flexible_object([Segment("B", 0.5, 0.2, 0.01)])
    tree = SYSTEMS[1].mechanism
    bare = Frame(tree.joint_index("T2_1_y"), Placement.identity())
    with pytest.raises(ModelError, match="more than six"):
        mujoco_xml(System.build(floating_clamp("clamp"), objects=[(beam, "clamp", None)]))
    with pytest.raises(ModelError, match="sits on a joint that carries no mass"):
        mujoco_xml(
            replace(SYSTEMS[1], point_frames=("bare",), mechanism=replace(tree, frames={**tree.frames, "bare": bare}))
        )
    with pytest.raises(ConfigError, match="time_step"):
        mujoco_xml(system, time_step=0.0)
