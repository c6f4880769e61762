"""Make the few frames in tests/vision/data: three clouds of the foam Y in one arm's hand, and the joints' recording.

PYTHONPATH=. python tests/vision/make_data.py
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from yid_ocp.data.hdf5 import write_recording
from yid_ocp.data.recording import JointGroup, Recording
from yid_ocp.virtual.engine import Simulation, simulate_in_mujoco
from yid_ocp.virtual.experiment import paper_system
from yid_ocp.virtual.motion import Excitation, multisine
from yid_ocp.virtual.posture import initial_posture
from yid_ocp.vision import (
    FilterOptions,
    FrameSequence,
    FrameTiming,
    Scene,
    VirtualCamera,
    look_at,
    virtual_frames,
    write_frames,
)
from yid_ocp.vision.filters import ObjectRegion, voxel_grid, without_outliers, without_robot
from yid_ocp.vision.fit import ShapeFit
from yid_ocp.vision.meshes import Surfaces, numeric_mechanism, robot_meshes

FOLDER = Path(__file__).parent / "data"
VOXEL = 0.011


def main() -> None:
    system = paper_system(1)
    posture = initial_posture(system)
    motion = multisine(system, seed=1, posture=posture, excitation=Excitation(travel=0.15))
    run = simulate_in_mujoco(system, None, motion, Simulation(1.5, time_step=2.5e-4), posture=posture)
    camera = VirtualCamera(look_at([2.6, 0.0, 0.45], [0.85, 0.0, -0.1]), timing=FrameTiming(rate=2.7), seed=5)
    made = virtual_frames(Scene(system, "package:baxter"), run.t, run.q, camera)
    tree = numeric_mechanism(system)
    robot = Surfaces(tree, robot_meshes("package:baxter", tree))
    region = ObjectRegion(system, FilterOptions())
    pose, clouds = made.sequence.pose, []
    for i, q in enumerate(made.q):
        points = made.sequence.world(i)
        cloud = voxel_grid(points[region.at(q, pose[:3, 3]).contains(points)], VOXEL)
        cloud = cloud.keep(without_outliers(cloud, 12, 4.0))
        cloud = cloud.keep(without_robot(cloud, robot, q, 0.03))
        clouds.append((cloud.points - pose[:3, 3]) @ pose[:3, :3])
    write_frames(FrameSequence.of(made.taken, clouds, pose), FOLDER / "frames")
    names = system.driven
    every = slice(None, None, 2)
    joints = JointGroup(names, run.t[every], np.round(run.q[every, : len(names)], 6), position_std=2e-4)
    write_recording(Recording(joints, description="Joints beside three clouds.", source="test"), FOLDER / "joints.h5")
    shape = ShapeFit(system)
    truth = {"points": system.points, "position": [np.round(shape.place(q), 5).tolist() for q in made.q]}
    (FOLDER / "truth.json").write_text(json.dumps(truth) + "\n")


if __name__ == "__main__":
    main()
