"""YAML examples of every configuration section, for the settings page."""

from __future__ import annotations

from collections.abc import Mapping

SETTINGS_EXAMPLES: Mapping[str, str] = {
    "The file": """\
description: A cable of 1 m, swung by a UR5
model: {robot: package:ur5, object: {kind: segments, segments: {cable: {length: 1.0, mass: 0.1, radius: 0.005}}}}
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
  points: [w_T3, T1:40%]
  effects:
    - {kind: kelvin_voigt, location: T1, values: {tau: 0.02}}
""",
    "model.clamps.NAME": """\
model:
  clamps:
    hand: {origin_point: marker_a, z_axis_point: marker_b, roll_convention: transported}
""",
    "model.extra_meshes": """\
model:
  extra_meshes:
    - {mesh: gripper.stl, parent_frame: left_hand}
    - {box: [0.8, 1.2, 0.05], xyz: [0.9, 0.0, -0.4]}  # a table [m]
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
    "model.frames.NAME": """\
model:
  frames:
    tool: {parent_frame: panda_link8, xyz: [0.0, 0.0, 0.12]}    # [m]
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
    "model.object, kind: segments": """\
model:
  object:
    kind: segments
    mount: {parent_frame: tool0}
    segments:
      trunk: {length: 0.5, mass: 0.05, radius: 0.01}                           # [m], [kg], [m]
      twig: {parent: trunk, length: 0.3, mass: 0.02, radius: 0.006, rpy: [0.5, 0.0, 0.0]}
""",
    "model.object.segments.NAME": """\
model:
  object:
    kind: segments
    segments:
      beam: {length: 0.52, mass: 0.33, cross_section: [0.001, 0.08], links: 8, joint_axes: y, stiffness_per_curvature: true, clamped_at_base: true}
""",
    "model.object, kind: cable": """\
model:
  object:
    kind: cable
    parent_vertices: [p0, p1, p2, p3, p4, p5]
    child_vertices: {side: [p2, s1, s2]}
    undeformed_shape_file: undeformed.csv
    end_clamp: axis
""",
    "model.object.branches.NAME": """\
model:
  object:
    kind: cable
    parent_vertices: [p0, p1, p2, p3, p4, p5]
    undeformed_shape_file: undeformed.csv
    child_vertices: {side: [p2, s1, s2]}
    branches:
      side: {linear_density: 0.03, separate_twist_damping: true}    # [kg/m]
""",
    "model.grasp.NAME": """\
model:
  grasp:
    right: {holder_frame: right_gripper, held_frame: w_T3, kind: axis, rpy: [0.0, 1.5708, 0.0]}    # [rad]
""",
    "model.springs.NAME": """\
model:
  springs:
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
  points: {/mocap/tip: cable:100%}
  units: {position: deg, points: mm}
""",
    "sensors.NAME": """\
sensors:
  points_camera: {std: 0.005, frames: {marker_7: w_T1}}    # [m]
  joints.effort: {std: 0.1, bias_std: 0.3, effort_kind: sample}   # [N m]
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
    "solver, name: lifted": """\
solver: {name: lifted, node_interval: 10}
""",
    "solver, name: multiple_shooting": """\
solver: {name: multiple_shooting, hessian: exact, ipopt: {max_cpu_time: 600}}
""",
    "solver, name: single_shooting": """\
solver: {name: single_shooting, max_iterations: 400}
""",
    "solver, name: steepest_descent": """\
solver: {name: steepest_descent, first_trial_step: spectral, nonmonotone_memory: 10}
""",
    "compare": """\
compare:
  methods:
    gauss_newton: {}
    multiple_shooting: {node_interval: 20}
""",
    "diagnosis": """\
diagnosis:
  candidates: [kelvin_voigt, joint_coulomb, payload@left_gripper]
  max_effects: 2
""",
    "track": """\
track:
  frames_path: clouds/                            # folder
  length_unit: mm
  n_drawn_frames: 5
""",
    "track.virtual_frames": """\
track:
  virtual_frames: {duration: 3.0, frame_rate: 5.0, latency: 0.04}    # [s], [Hz], [s]
""",
    "track.options": """\
track:
  options: {max_distance_in_radii: 0.7, tracked_points: [w_T1, w_T3]}
""",
    "track.options.filters": """\
track:
  options:
    filters: {box_lower: [0.2, -0.8, -0.9], box_upper: [1.5, 0.8, 0.8], robot_padding: 0.02}    # [m]
""",
    "track.options.skeleton": """\
track:
  options:
    skeleton: {neighbour_radius: 0.05, segment_neighbours: 30}     # [m]
""",
    "track.options.shape_fit": """\
track:
  options:
    shape_fit: {surface_loss_scales: [], surface_noise_std: 0.004}  # [m]
""",
    "track.options.calibration": """\
track:
  options:
    calibration: {fix_pose: true, translation_prior_std: 0.01}    # a hand-eye calibration, known to 1 cm [m]
""",
    "track.options.clock": """\
track:
  options:
    clock: {initial_offset: 0.08, search_half_width: 0.05}      # [s]
""",
    "plan": """\
plan:
  goal: place
  point: w_T3
  target_offset: [0.05, 0.0, 0.1]                    # [m]
  duration: 1.0                              # [s]
  parameter_run: runs/my_solve
""",
    "plan.limits": """\
plan:
  limits: {velocity_fraction: 0.5, max_acceleration: 10.0, max_spring_angle: 0.8}    # a part, [rad/s^2], [rad]
""",
    "output": """\
output: {runs_folder: /data/runs, write_report: false}
""",
}
"""YAML from the top of a file, by the title of its section in docs/settings.md."""
