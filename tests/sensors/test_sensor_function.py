from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import casadi as ca
import numpy as np
import pytest

from yid_ocp.effects import make_effect
from yid_ocp.model.parameters import Parameter, Parameters
from yid_ocp.model.system import MidpointState, NodeState, StepTerms, System
from yid_ocp.sensors import EffortSensor, PointSensor, Sensor, sensor_function

LABEL = "drift@left"


@dataclass(frozen=True)
class Drift:
    """Adds gain (memory + effort of the first joint) to every reading: what depends on all that a sensor may see."""

    kind: str = "drift"
    location: str = "left"
    parameters: Parameters = field(default_factory=lambda: Parameters([Parameter(f"{LABEL}.gain", 0.2, "1")]))
    internal_coordinates: Mapping[str, ca.SX] = field(
        default_factory=lambda: {f"{LABEL}.memory": ca.SX.sym(f"{LABEL}.memory")}
    )

    def apply_to_system(self, system: System) -> System:
        return system

    def step_terms(self, state: MidpointState) -> StepTerms:
        return StepTerms()

    def distorted_reading(self, channel: str, output: ca.SX, state: NodeState) -> ca.SX:
        memory = self.internal_coordinates[f"{LABEL}.memory"]
        return output + self.parameters[f"{LABEL}.gain"].symbol * (memory**2 + ca.sin(state.effort[0]))


CAMERA = PointSensor("points_camera", ("w_T1", "w_T2"), ("w_T1", "w_T2"), tuple(map(tuple, np.eye(4))))
EFFORT = EffortSensor(("left_a", "left_b"))
NAMES = ("T1.length", "drift@left.gain", "camera_scale@camera.scale", "effort_gain@left_b.inverse")


@pytest.fixture(scope="module")
def whole(system: System) -> System:
    scale = make_effect("camera_scale", "camera", system, {"scale": 1.1})
    gain = make_effect("effort_gain", "left_b", system, {"scale": 0.8})
    return system.with_effects([scale, gain, Drift()])


@pytest.mark.parametrize("sensor", [CAMERA, EFFORT], ids=["points", "effort"])
def test_outputs_have_a_row_for_every_reading(whole: System, sensor: Sensor) -> None:
    function = sensor_function(whole, sensor, NAMES)
    rows = sensor.outputs_per_channel * len(sensor.channel_names)
    shapes = [function.size_out(i) for i in range(5)]
    assert shapes == [
        (rows, 1),
        (rows, whole.n_coordinates),
        (rows, 1),
        (rows, whole.n_coordinates),
        (rows, len(NAMES)),
    ]
    assert sensor_function(whole, sensor, ()).size_out(4) == (rows, 0)


@pytest.mark.parametrize("sensor", [CAMERA, EFFORT], ids=["points", "effort"])
def test_derivatives_agree_with_differences(whole: System, sensor: Sensor) -> None:
    rng = np.random.default_rng(1)
    function = sensor_function(whole, sensor, NAMES)
    at = [
        rng.uniform(-0.6, 0.6, whole.n_coordinates),
        np.array([0.4]),
        rng.uniform(-1, 1, whole.n_coordinates),
        whole.parameters.vector(),
    ]
    exact = [np.array(ca.densify(value)) for value in function(*at)[1:]]
    columns = [
        range(whole.n_coordinates),
        range(1),
        range(whole.n_coordinates),
        [whole.parameters.index(name) for name in NAMES],
    ]
    step = 1e-6
    for which, indices in enumerate(columns):
        differences = []
        for index in indices:
            above, below = ([x.copy() for x in at] for _ in range(2))
            above[which][index] += step
            below[which][index] -= step
            ahead, behind = (np.array(function(*x)[0]).ravel() for x in (above, below))
            differences.append((ahead - behind) / (2 * step))
        np.testing.assert_allclose(exact[which], np.transpose(differences), rtol=1e-7, atol=1e-8)
    assert np.abs(exact[1]).max() > 0.01, "the memory of an effect is seen"


def test_effects_act_one_after_the_other_on_every_channel(whole: System) -> None:
    """effort 3 N m at left_b: gain 0.8, then the drift 0.2 (0.5^2 + sin 2), which left_a gets alone."""
    effort = np.zeros(whole.n_coordinates)
    a, b = (whole.mechanism.joint_index(name) for name in ("left_a", "left_b"))
    effort[a], effort[b] = 2.0, 3.0
    assert a == 0
    function = sensor_function(whole, EFFORT, ())
    read = np.array(function(np.zeros(whole.n_coordinates), [0.5], effort, whole.parameters.vector())[0]).ravel()
    drift = 0.2 * (0.25 + np.sin(2.0))
    assert read == pytest.approx([2.0 + drift, 0.8 * 3.0 + drift])
