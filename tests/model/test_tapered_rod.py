"""A tapered rod: its mass, how far it hangs down, and the configuration and `init` words that describe it."""

from __future__ import annotations

from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from yid_ocp.config.reader import load_config
from yid_ocp.effects import make_effect
from yid_ocp.integrator.statics import EquilibriumSolver
from yid_ocp.integrator.step import compile_step
from yid_ocp.model import System, flexible_object, forward_kinematics
from yid_ocp.model.objects.base import init_command_object_templates
from yid_ocp.model.objects.tapered_rod import TaperedRod
from yid_ocp.workflow.build import build_system, divided_link_parameter_scale

LENGTH, MASS, BEND, TIP_MASS, GRAVITY = 1.2, 0.05, 40.0, 0.02, 9.81


def rod(links: int, tip_radius: float = 0.003) -> TaperedRod:
    sizes = {"length": LENGTH, "mass": MASS, "base_radius": 0.006, "tip_radius": tip_radius}
    return TaperedRod(**sizes, links=links, joint_axes="x", gravity_fraction=0.0)


def bodies(item) -> list:
    return [body for joint in item.mechanism.with_numeric_values().joints for body in joint.bodies]


def test_mass_and_centre_are_those_of_a_frustum() -> None:
    found, k = bodies(rod(5).build(0.0)), 0.5
    masses = np.array([float(body.mass) for body in found])
    centres = [LENGTH * i / 5 + float(body.center_of_mass[2]) for i, body in enumerate(found)]
    assert masses.sum() == pytest.approx(MASS)
    assert masses @ centres / MASS == pytest.approx(LENGTH / 4 * (1 + 2 * k + 3 * k**2) / (1 + k + k**2))


def test_without_taper_its_links_are_cylinders() -> None:
    item = rod(3, tip_radius=0.006)
    plain = flexible_object(item.model_segments(0.02), gravity_fraction=0.0)
    for one, other in zip(bodies(item.build(0.02)), bodies(plain), strict=True):
        tensors = [np.array(ca.DM(body.inertia_about_com).full()) for body in (one, other)]
        assert tensors[0] == pytest.approx(tensors[1], rel=1e-12, abs=1e-15)


@pytest.mark.parametrize("links", [12, 24])
def test_a_tip_load_bends_it_as_beam_theory_says(links: int) -> None:
    """A cone cut off at the tip, under a force F there, bends F L^3 / (3 B taper), B being the base's rigidity."""
    system = System.build(objects=[(rod(links).build(0.01), None, None)], gravity=(0.0, -GRAVITY, 0.0))
    system = system.with_effects([make_effect("point_mass", "w_rod", system, {"mass": TIP_MASS})])
    theta = system.parameters.vector({"rod.bend": BEND})
    rest = EquilibriumSolver(compile_step(system, 0.01, use_compiler=False)).solve([], theta)
    assert rest.is_converged
    q = ca.SX(ca.DM(rest.state[: system.n_coordinates]))
    place = forward_kinematics(system.mechanism, q).frame_position("w_rod")
    place = ca.Function("tip", [system.parameters.symbols], [place])(theta)
    expected = -TIP_MASS * GRAVITY * LENGTH**3 / (3 * BEND * 0.5)
    assert float(place[1]) == pytest.approx(expected, rel=3 / links**2 + 2e-3)


def test_a_configuration_and_init_describe_it(tmp_path: Path) -> None:
    text = "{kind: tapered_rod, length: 1.2, mass: 0.05, base_radius: 0.006, tip_radius: 0.003, links: 4}"
    (tmp_path / "run.yaml").write_text(f"model: {{object: {text}}}\nparameters: {{rod.taper: {{initial: 0.4}}}}\n")
    run = load_config(tmp_path / "run.yaml")
    system = build_system(run, link_division=2)
    assert system.parameters["rod.taper"].value == 0.4
    assert len(system.segment_layout("rod").link_joints) == 8
    assert divided_link_parameter_scale(run, "rod.bend", 2) == 1  # a rigidity
    numbers = {"length": LENGTH, "mass": MASS, "radius": 0.006, "tip_radius": 0.003}
    made = init_command_object_templates()["tapered_rod"].build(numbers, 4)
    assert made.settings == TaperedRod(
        length=LENGTH, mass=MASS, base_radius=0.006, tip_radius=0.003, links=4, joint_axes="xy"
    )
    assert set(made.start_values) == {"rod.bend", "rod.damping"}
