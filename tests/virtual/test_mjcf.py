from __future__ import annotations

from dataclasses import replace

import casadi as ca
import pytest
from virtual_examples import SYSTEMS, TRUTH, assert_same_mechanics, clamped_beam

from yid_ocp.errors import ConfigError, ModelError
from yid_ocp.model.flexible import Segment, flexible_object
from yid_ocp.model.mechanism import Frame, Placement
from yid_ocp.model.parameters import Parameter, Parameters
from yid_ocp.model.system import Effect, Grasp, MidpointState, StepTerms, System, floating_clamp
from yid_ocp.virtual.mjcf import mujoco_xml


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
    assert_same_mechanics(system, values)


class Pull(Effect):
    def step_terms(self, state: MidpointState) -> StepTerms:
        return StepTerms(generalized_force=self.parameters["pull@T1.force"].symbol * state.v)


def test_what_mujoco_cannot_express_is_refused() -> None:
    system = clamped_beam()
    with_effect = system.with_effects([Pull("pull", "T1", Parameters([Parameter("pull@T1.force", 0.0, "N m")]))])
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
