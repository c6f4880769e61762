"""Makes `reference/settings.md`: every setting with meaning, allowed values, default, and an example a section."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import MISSING
from pathlib import Path
from typing import Any

from yid_ocp.config.schema import option_info_from_annotation, section_variants_from_annotation
from yid_ocp.config.settings import RunSettings
from yid_ocp.options import Option, class_options_by_key, describe_type, mapping_value_type, variadic_tuple_entry_type

HEAD = """\
# Settings

This page lists every key of a configuration file. NAME is a name that you choose, or a name in the model. Units are SI,
in brackets. Default `needed`: you must set the key. Empty default: `null`. Any key can be set on the command line, as
in `--set problem.time_step=0.005`. With `--set`, a section changes only the keys that it names, and `{}` clears it.
Links and time step: [choosing.md](../howto/choosing.md); held-out recordings: [held_out.md](../howto/held_out.md);
units of recordings: [recordings.md](recordings.md). Generated from the code; CONTRIBUTING.md has the command.
"""


def page() -> str:
    """Markdown page of all settings with meaning, allowed values and default."""
    lines = HEAD.splitlines()
    sections = {title: (text, rows) for title, text, rows in tables(RunSettings, "")}
    for title, (text, rows) in sections.items():
        lines += ["", f"## {title}", "", text, "", "| key | meaning | allowed | default |", "|---|---|---|---|", *rows]
        lines += ["", "```yaml", *EXAMPLES[title].splitlines(), "```"] if title in EXAMPLES else []
    return "\n".join(lines) + "\n"


def tables(hint: Any, path: str) -> Iterator[tuple[str, str, list[str]]]:
    """Title, first sentence and rows of a section and of all below it."""
    sections = section_variants_from_annotation(hint)
    for word, kind in sections.classes.items() if sections is not None else ():
        options = class_options_by_key(kind)
        title = (
            f"{path}, {sections.selector_key}: {word}"
            if sections is not None and sections.selector_key
            else path or "The file"
        )
        yield title, (kind.__doc__ or "").splitlines()[0], [row(*item) for item in options.items()]
        for name, option in options.items():
            yield from tables(option.type_hint, f"{path}.{name}" if path else name)
    values, entries = mapping_value_type(hint), variadic_tuple_entry_type(hint)
    named = section_variants_from_annotation(values)
    if values is not None and (named is None or named.selector_key != "name"):
        yield from tables(values, f"{path}.NAME")
    if entries is not None:
        yield from tables(entries, path)


def row(name: str, option: Option) -> str:
    """The row of one key in a section's table."""
    usual = "needed" if option.default_value is MISSING else default(option.default_value)
    cells = (
        f"`{name}`",
        option_info_from_annotation(option.type_hint).description,
        describe_type(option.type_hint),
        usual,
    )
    return "| " + " | ".join(cells) + " |"


def default(value: Any) -> str:
    """A default as it stands in a table; empty for none and for sections."""
    if value is None or value in ({}, "") or dataclasses.is_dataclass(value):
        return ""
    if isinstance(value, Mapping):
        return ", ".join(f"`{name}`" for name in value)
    return "`.inf`" if value == math.inf else f"`{json.dumps(value)}`"


EXAMPLES: Mapping[str, str] = {
    "virtual_arm": """\
virtual_arm: {friction_law: load, max_relative_link_mass_error: 0.03, encoder_counts_per_turn: 4096}
""",
    "model.object, kind: segments": """\
model:
  object:
    kind: segments
    mount: {parent_frame: tool0}
    named_segments:
      trunk: {length: 0.5, mass: 0.05, radius: 0.01}                           # [m], [kg], [m]
      twig: {parent: trunk, length: 0.3, mass: 0.02, radius: 0.006, rpy: [0.5, 0.0, 0.0]}
""",
    "model.object.named_segments.NAME": """\
model:
  object:
    kind: segments
    named_segments:
      beam: {length: 0.52, mass: 0.33, cross_section_size: [0.001, 0.08], links: 8, joint_axes: y, \
values_given_as_rigidities: true, clamped_at_base: true}
""",
    "model.object, kind: tapered_rod": """\
model:
  object: {kind: tapered_rod, length: 1.2, mass: 0.08, base_radius: 0.006, tip_radius: 0.002}    # [m], [kg]
parameters:
  rod.bend: {free: true, initial: 20.0}    # [N m^2]
""",
    "model.object, kind: cable": """\
model:
  object:
    kind: cable
    main_branch_vertex_names: [p0, p1, p2, p3, p4, p5]
    child_branch_vertex_names: {side: [p2, s1, s2]}
    undeformed_shape_file: undeformed.csv
    end_clamp_grasp_kind: axis
""",
    "model.object.branch_properties_by_name.NAME": """\
model:
  object:
    kind: cable
    main_branch_vertex_names: [p0, p1, p2, p3, p4, p5]
    undeformed_shape_file: undeformed.csv
    child_branch_vertex_names: {side: [p2, s1, s2]}
    branch_properties_by_name:
      side: {linear_density: 0.03, has_separate_twist_damping: true}    # [kg/m]
""",
    "model.object, kind: foam_y": """\
model:
  object: {kind: foam_y, links: 8}
""",
    "model.object.mount": """\
model:
  object:
    kind: foam_y
    mount: {parent_frame: base, xyz: [0.85, 0.0, -0.93], rpy: [0.0, 0.0, 1.5708]}    # [m], [rad]
""",
    "The file": """\
description: A cable of 1 m, swung by a UR5
model: {robot: package:ur5, object: {kind: segments, named_segments: {cable: {length: 1.0, mass: 0.1, radius: 0.005}}}}
recordings: {estimate: [swing.h5], held_out: [other_swing.h5]}
parameters: {cable.bend: {free: true, initial: 0.05}, cable.damping: {free: true}}
""",
    "model": """\
model:
  robot: package:baxter
  arms: {mode: driven}
  object: {kind: foam_y}
  grasp:
    left: {holder_frame: left_gripper, held_frame: w_T2}
  damping: {left_s0: 0.2, object: 0.05}    # [N m s/rad]
  measured_points: [w_T3, T1:40%]
  effects:
    - {kind: kelvin_voigt, location: T1, values: {tau: 0.02}}
""",
    "model.surfaces_missing_from_urdf": """\
model:
  surfaces_missing_from_urdf:
    - {mesh_file: gripper.stl, parent_frame: left_hand}
    - {box_size: [0.8, 1.2, 0.05], xyz: [0.9, 0.0, -0.4]}  # a table [m]
""",
    "model.arms": """\
model:
  arms:
    joints: [panda_joint1, panda_joint2, panda_joint4]
    mode: prescribed
    locked_joints: {panda_joint3: 0.4}              # [rad]
    exclude_links: [panda_hand]
""",
    "model.arms.servo": """\
model:
  arms:
    mode: servo
    servo: {command_interpolation: interpolated, has_gravity_compensation: true}
""",
    "model.arms.servo.motor": """\
model:
  arms:
    mode: servo
    servo:
      motor: {kind: dc, preset: sts3215}
""",
    "model.friction": """\
model:
  friction: {law: load, joints: [pan, lift, elbow]}
""",
    "model.frames.NAME": """\
model:
  frames:
    tool: {parent_frame: panda_link8, xyz: [0.0, 0.0, 0.12]}    # [m]
""",
    "model.grasp.NAME": """\
model:
  grasp:
    right: {holder_frame: right_gripper, held_frame: w_T3, kind: axis, held_frame_rpy: [0.0, 1.5708, 0.0]}    # [rad]
""",
    "model.joint_springs.NAME": """\
model:
  joint_springs:
    elbow: {stiffness: 12.0, rest_position: 0.3, damping: 0.1}    # [N m/rad], [rad], [N m s/rad]
""",
    "model.effects": """\
model:
  effects:
    - {kind: joint_coulomb, location: left_s0}
parameters:
  joint_coulomb@*: {free: true}
""",
    "recordings": """\
recordings:
  estimate: [day_1.h5, day_2.h5]
  held_out: [day_3.h5]
""",
    "import": """\
import:
  joint_topics: [/left/joint_states, /right/joint_states]
  point_names: {/mocap/tip: cable:100%}
  units: {position: deg, points: mm}
""",
    "sensors.NAME": """\
sensors:
  points_camera: {std: 0.005, frame_by_recorded_name: {marker_7: w_T1}}    # [m]
  joints.effort: {std: 0.1, bias_std: 0.3, effort_sampling_kind: sample}   # [N m]
""",
    "parameters.NAME": """\
parameters:
  "*.bend": {free: true, initial: 3.0}
  T1.bend: {bounds: [5.0, 50.0]}             # over what the pattern says
  T1.twist: {free: true, prior_std: 2.0}
""",
    "problem": """\
problem:
  time_step: 0.005                           # [s]
  initial_state: estimated
  path_cutoff: 15.0                          # [Hz]
""",
    "solver, name: gauss_newton": """\
solver: {name: gauss_newton, max_iterations: 100}
""",
    "solver, name: multiple_shooting": """\
solver: {name: multiple_shooting, hessian: exact, ipopt_options: {max_cpu_time: 600}}
""",
    "solver, name: single_shooting": """\
solver: {name: single_shooting, max_iterations: 400}
""",
    "solver, name: steepest_descent": """\
solver: {name: steepest_descent, first_trial_step_rule: spectral, nonmonotone_memory: 10}
""",
    "compare": """\
compare:
  methods:
    gauss_newton: {}
    multiple_shooting: {condensing: true}
""",
    "diagnosis": """\
diagnosis:
  candidates: [kelvin_voigt, joint_coulomb, payload@left_gripper]
  max_effects: 2
""",
    "track": """\
track:
  frames_path: clouds/                            # folder
  point_cloud_unit: mm
  n_drawn_frames: 5
""",
    "track.virtual_frames": """\
track:
  virtual_frames: {duration: 3.0, frame_rate: 5.0, latency: 0.04}    # [s], [Hz], [s]
""",
    "track.options": """\
track:
  options: {max_mean_surface_distance_in_radii: 0.7, tracked_points: [w_T1, w_T3]}
""",
    "track.options.filters": """\
track:
  options:
    filters: {box_lower: [0.2, -0.8, -0.9], box_upper: [1.5, 0.8, 0.8], robot_padding: 0.02}    # [m]
""",
    "track.options.calibration": """\
track:
  options:
    calibration: {fix_pose: true}    # a hand-eye calibration
""",
    "track.options.clock_offset_search": """\
track:
  options:
    clock_offset_search: {initial_stamp_minus_joint_time: 0.08, search_half_width: 0.05}      # [s]
""",
    "plan": """\
plan:
  goal: place
  point: w_T3
  point_target_offset_from_start: [0.05, 0.0, 0.1]              # [m]
  duration: 1.0                              # [s]
  parameter_run_folder: runs/my_solve
""",
    "plan.limits": """\
plan:
  limits: {velocity_fraction: 0.5, max_acceleration: 10.0, max_spring_angle: 0.8}    # a part, [rad/s^2], [rad]
""",
    "output": """\
output: {runs_folder: /data/runs, write_report: false}
""",
}
"""YAML from the top of a file, by the title of its section in docs/reference/settings.md."""

if __name__ == "__main__":
    (Path(__file__).parent / "reference" / "settings.md").write_text(page(), encoding="utf-8")
