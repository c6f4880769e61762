"""Names, places, bounds and reports of effects, and what is said to whoever asks for what there is not."""

import math
import re

import pytest
from baxter import baxter_foam_y_system

from yid_ocp.effects import EFFECTS, candidate_kinds_and_locations, make_effect
from yid_ocp.effects import base as places
from yid_ocp.effects.base import EffectBase
from yid_ocp.errors import ConfigError, ModelError
from yid_ocp.model import FlexibleSegment, System, flexible_object
from yid_ocp.model.servos_and_springs import MotorKindAndPreset, ServoModelOptions
from yid_ocp.model.urdf import read_urdf


@pytest.fixture(scope="module")
def one_arm() -> System:
    return baxter_foam_y_system(1)


@pytest.fixture(scope="module")
def beam() -> System:
    """Panda with a beam on its hand, its joints prescribed."""
    names = [f"panda_joint{i}" for i in range(1, 8)]
    robot = read_urdf("package:panda", joints=names)
    segment = FlexibleSegment("beam", 0.52, 0.33, 0.01, 3, clamped_at_base=True, values_given_as_rigidities=True)
    item = flexible_object([segment], name="beam")
    return System.build(robot, objects=[(item, "panda_hand", None)], prescribed=names)


# of arms that are moved by commanded positions
OF_SERVOS = {
    "servo_gain",
    "servo_delay",
    "servo_saturation",
    "supply_voltage",
    "back_emf",
    "current_limit",
    "joint_load_friction",
}


SIGNALS = ("joints.position", "joints.effort", "camera", "nominal_clock", "wrist:left_gripper")


def test_the_vocabulary_is_the_shared_one(shared) -> None:
    text = (shared / "reference" / "effects.md").read_text(encoding="utf-8")
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line.startswith("|")]
    table = {row[0]: row for row in rows[2:]}
    described = {kind.strip() for name in table for kind in name.split(",")}
    assert set(EFFECTS) <= described  # the vocabulary is ahead: kinds of later work stand there as well
    system, options = baxter_foam_y_system(1), ServoModelOptions(motor=MotorKindAndPreset("dc", "sts3215"))
    servos = System.build(system.mechanism, driven=system.driven, servos=options, grasps=system.grasps)
    places = {kind: (servos, place) for kind, place in candidate_kinds_and_locations(servos, SIGNALS)}
    places |= {kind: (system, place) for kind, place in candidate_kinds_and_locations(system, SIGNALS)}
    for kind in EFFECTS:
        row = next(cells for name, cells in table.items() if kind in map(str.strip, name.split(",")))
        system, place = places[kind]
        for quantity in make_effect(kind, place, system).definitions:
            name, _ = quantity.reported_name_and_unit
            name = "bias per component" if kind == "sensor_bias" else name
            assert re.search(rf"\b{name}\b", row[2]), f"{kind}: {name} not in {row[2]}"


def test_every_kind_describes_itself(one_arm) -> None:
    for kind in EFFECTS:
        assert EFFECTS[kind].equation
        assert EFFECTS[kind].__doc__
        assert EFFECTS[kind].required_excitation != EffectBase.required_excitation
    for kind, place in candidate_kinds_and_locations(one_arm, SIGNALS):
        effect = make_effect(kind, place, one_arm)
        assert effect.amplitude_parameter_names
        for quantity, entry in zip(effect.definitions, effect.parameters, strict=True):
            assert entry.name == f"{kind}@{place}.{quantity.name}"
            assert entry.value == quantity.neutral_value
            low, high = effect.prior_ranges[entry.name]
            assert entry.lower <= low < high <= entry.upper
            assert entry.unit == quantity.unit
            assert quantity.description


def test_candidates_of_the_papers_system(one_arm) -> None:
    found = candidate_kinds_and_locations(one_arm, SIGNALS)
    assert {kind for kind, _ in found} == set(EFFECTS) - OF_SERVOS
    assert len(found) == len(set(found))
    blind = candidate_kinds_and_locations(one_arm, ["joints.position"])
    assert not {kind for kind, _ in blind} & {"camera_scale", "effort_gain", "clock_scale", "sensor_bias"}
    assert ("kelvin_voigt", "T3") in blind
    assert ("junction_compliance", "w_T1") in blind
    assert ("grasp_slip", "left") in blind
    with pytest.raises(ModelError, match="camera"):
        candidate_kinds_and_locations(one_arm, ["kamera"])


def test_places_of_a_beam_on_a_gripper(beam) -> None:
    found = candidate_kinds_and_locations(beam, ["joints.position", "joints.effort"])
    assert ("mount_compliance", "base") in found
    assert ("effort_delay", "gripper") in found
    assert ("gravity_scale", "object") in found
    assert not [place for kind, place in found if kind.startswith(("grasp", "junction", "camera"))]
    # without efforts only its encoder shows what is wrong with a prescribed joint
    pairs = candidate_kinds_and_locations(beam, ["joints.position"])
    assert [kind for kind, place in pairs if place == "panda_joint4"] == ["encoder_offset"]
    bare = System.build(beam.mechanism, prescribed=beam.prescribed)
    of_bare = candidate_kinds_and_locations(bare, SIGNALS)
    assert {"point_mass", "camera_translation", "camera_latency"} <= {kind for kind, _ in of_bare}


def test_places_of_a_branched_cable(cable) -> None:
    _, _, cable = cable
    found = candidate_kinds_and_locations(cable, ["nominal_clock"])
    assert {("mount_compliance", "clamp_start"), ("junction_compliance", "junction_a")} <= set(found)
    assert {("grasp_compliance", "clamp_end"), ("grasp_slip", "clamp_end")} <= set(found)
    assert {("kelvin_voigt", "parent"), ("kelvin_voigt", "a"), ("point_mass", "junction_a")} <= set(found)
    assert not places.arm_joint_names(cable)
    changed = cable.with_effects([make_effect(kind, place, cable) for kind, place in found])
    assert changed.n_coordinates == cable.n_coordinates + 4
    assert changed.prescribed == cable.prescribed
    branch = changed.mechanism.joint("a_0_x")
    assert changed.mechanism.joints[branch.parent_index].name == "junction_compliance@junction_a_y"


@pytest.mark.parametrize(
    ("kind", "place", "error", "text"),
    [
        ("kelvin_vogt", "T3", ConfigError, "kelvin_voigt"),
        ("kelvin_voigt", "T4", ModelError, "T1, T2, T3"),
        ("kelvin_voigt", "left_w0", ModelError, "kelvin_voigt is not possible at"),
        ("joint_coulomb", "left_w3", ModelError, "left_w0"),
        ("grasp_slip", "right", ModelError, "allowed: left"),
        ("junction_compliance", "w_T2", ModelError, "w_T1"),
        ("point_mass", "w_T9", ModelError, "w_T"),
    ],
)
def test_a_place_that_does_not_fit(kind, place, error, text, one_arm) -> None:
    with pytest.raises(error, match=text):
        make_effect(kind, place, one_arm)


@pytest.mark.parametrize(
    ("values", "text"),
    [({"tao": 0.1}, "mean 'tau'"), ({"tau": -0.1}, "below its lower bound of 0"), ({"tau": math.nan}, "finite")],
)
def test_a_value_that_does_not_fit(values, text, one_arm) -> None:
    with pytest.raises(ConfigError, match=text):
        make_effect("kelvin_voigt", "T3", one_arm, values)


def test_a_compliance_is_given_and_reported_as_stiffness(one_arm) -> None:
    effect = make_effect("grasp_compliance", "left", one_arm, {"stiffness": 500.0})
    name = "grasp_compliance@left.compliance"
    assert effect.parameters[name].value == pytest.approx(2e-3)
    found = effect.to_reported_parameters({name: 4e-3}, {name: 4e-4})
    assert found["stiffness"].value == pytest.approx(250.0)
    assert found["stiffness"].std == pytest.approx(25.0)
    assert found["stiffness"].unit == "N/m"
    assert found["damping"].unit == "N s/m"
    rigid = effect.to_reported_parameters({name: 0.0}, {name: 1e-4})["stiffness"]
    assert math.isinf(rigid.value)
    assert math.isnan(rigid.std)
    with pytest.raises(ConfigError, match="positive"):
        make_effect("grasp_compliance", "left", one_arm, {"stiffness": 0.0})
    assert effect.shape_parameter_names == ("grasp_compliance@left.damping",)


def test_names_and_places_survive_added_joints(one_arm) -> None:
    effects = [make_effect(k, p, one_arm) for k, p in (("mount_compliance", "base"), ("junction_compliance", "w_T1"))]
    changed = one_arm.with_effects(effects)
    names = changed.mechanism.joint_names
    assert names[:7] == one_arm.driven
    assert [n for n in names if "@" not in n] == list(one_arm.mechanism.joint_names)
    for j, joint in enumerate(changed.mechanism.joints):
        assert joint.parent_index < j
    parent = changed.mechanism.joints[names.index("T3_0_x")].parent_index
    assert names[parent] == "junction_compliance@w_T1_y"
    assert names[changed.mechanism.joints[names.index("T2_0_x")].parent_index] == names[parent]
    assert places.arm_joint_names(changed) == places.arm_joint_names(one_arm)
    assert changed.mechanism.frame("w_T1").joint_index == names.index("T1_3_z")


def test_how_much_stiffening_to_expect_depends_on_how_far_joints_turn() -> None:
    effect = make_effect("cubic_stiffness", "T1", baxter_foam_y_system(1))
    low, high = effect.prior_ranges["cubic_stiffness@T1.k3"]
    told = effect.with_prior_ranges_for_largest_angles({"T1": 0.25, "T2": 1.0})
    assert told.prior_ranges["cubic_stiffness@T1.k3"] == pytest.approx((4 * low, 4 * high))
    assert effect.with_prior_ranges_for_largest_angles({"T2": 0.1}) is effect
