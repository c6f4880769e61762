"""A cross of flexible branches turned by a wrist, played in MuJoCo as a chain several times as fine as the model's."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from yid_ocp.config.reader import load_config
from yid_ocp.data import write_recording
from yid_ocp.data.recording import PointGroup, Recording
from yid_ocp.virtual.experiment import ArmSensorNoise, PointCamera, VirtualExperimentSettings
from yid_ocp.virtual.injected import InjectedEffect, run_experiment_with_injected_effects
from yid_ocp.virtual.mujoco_simulation import SimulationOptions
from yid_ocp.workflow.build import build_system

TRUTH = {"north.bend": 0.5, "east.bend": 0.3}
"""Of a chain of four links [N m/rad]."""

URDF = """<robot name="wrist"><link name="wall"/>
<joint name="roll" type="continuous"><parent link="wall"/><child link="fork"/><axis xyz="1 0 0"/>
<limit effort="50" velocity="9"/></joint>
<link name="fork"><inertial><mass value="1"/><inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/>
</inertial></link><joint name="pitch" type="continuous"><parent link="fork"/><child link="hub"/><axis xyz="0 1 0"/>
<limit effort="50" velocity="9"/></joint>
<link name="hub"><inertial><mass value="1"/><inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/>
</inertial></link></robot>"""

CONFIG = """\
description: A cross of two long and two short branches.
model:
  robot: {urdf}
  arms: {{mode: {mode}}}
  damping: {{roll: 0.1, pitch: 0.1, object: 0.002}}
  object:
    kind: segments
    mount: {{parent_frame: hub}}
    named_segments:
{segments}
  measured_points: [{points}]
recordings:
  estimate: [{recording}]
parameters:
{parameters}
problem: {{path_cutoff: .inf}}
output: {{write_report: false}}
"""


BRANCHES = {"north": (0.5, 0.0), "south": (0.5, 3.14159265), "east": (0.4, 1.57079633), "west": (0.4, -1.57079633)}
"""Length [m] and turn about the wrist's first axis [rad]."""


def configuration(
    folder: Path, links: int, branches: Sequence[str], start: float = 1.0, mode: str = "prescribed"
) -> Path:
    """A file with so many links a branch; north and east are seen and free, and start at so many times the truth."""
    (folder / "wrist.urdf").write_text(URDF)
    segments, parameters, points = [], [], []
    for name in branches:
        length, turn = BRANCHES[name]
        shape = f"length: {length}, mass: {0.08 * length}, radius: 0.008, links: {links}, joint_axes: xy"
        segments.append(f"      {name}: {{{shape}, rpy: [{turn}, 0, 0]}}")
        seen = f"{name}.bend" in TRUTH
        value = links / 4 * TRUTH[f"{'north' if length == 0.5 else 'east'}.bend"]
        own = f"free: true, initial: {start * value}" if seen else f"initial: {value}"
        parameters.append(f"  {name}.bend: {{{own}}}")
        points += [f"w_{name}", f'"{name}:50%"'] if seen else []
    text = CONFIG.format(
        urdf="wrist.urdf",
        mode=mode,
        segments="\n".join(segments),
        points=", ".join(points),
        parameters="\n".join(parameters),
        recording="cross.h5" if mode == "prescribed" else "",
    )
    file = folder / f"cross_{links}_{mode}.yaml"
    file.write_text(text)
    return file


def record(
    folder: Path, branches: Sequence[str], links: int = 12, duration: float = 1.5, *withheld: InjectedEffect
) -> None:
    """`cross.h5`: joint angles, and four points seen at 50 Hz to half a millimetre."""
    run = load_config(configuration(folder, links, branches, mode="driven"))
    camera = PointCamera(point_std=5e-4, frame_rate=50.0, has_dropouts=False, hidden_probability=0.0, pose=np.eye(4))
    experiment = VirtualExperimentSettings(
        initial_joint_angles={"roll": 0.0, "pitch": 0.0},
        simulation=SimulationOptions(duration, time_step=2e-4),
        arm_noise=ArmSensorNoise(position_std=0.0),
        camera=camera,
        seed=5,
        recording_name="cross",
    )
    made = run_experiment_with_injected_effects(build_system(run), None, withheld, experiment)
    points = tuple(PointGroup("points_mocap", g.names, g.t, g.position, g.std, "mocap") for g in made.points)
    joints = replace(made.joints, effort=None, effort_std=None)
    write_recording(Recording(joints, points, source="test", name="cross"), folder / "cross.h5")
