"""Make the few frames in tests/vision/data: three clouds of the foam Y in one arm's hand, and the joints' recording.

PYTHONPATH=. python tests/vision/make_data.py
"""

import json
from pathlib import Path

import numpy as np
from baxter import baxter_foam_y_system
from smooth_rods import frames_of

from yid_ocp import vision
from yid_ocp.data.recording import JointGroup, Recording
from yid_ocp.data.recording_hdf5 import write_recording
from yid_ocp.virtual.joint_motion import MultisineOptions, grasping_joint_angles, random_multisine_motion
from yid_ocp.virtual.mujoco_simulation import SimulationOptions, simulate_in_mujoco
from yid_ocp.vision.fit import ShapeFitter
from yid_ocp.vision.point_cloud import ReachableObjectRegion, statistical_inlier_mask, voxel_averages
from yid_ocp.vision.surface_meshes import ArticulatedSurfaces, load_robot_meshes_by_joint

FOLDER = Path(__file__).parent / "data"
VOXEL = 0.011


def main() -> None:
    system = baxter_foam_y_system(1)
    start = {"initial_joint_angles": grasping_joint_angles(system)}
    motion = random_multisine_motion(system, seed=1, excitation=MultisineOptions(gripper_travel=0.15), **start)
    run = simulate_in_mujoco(system, None, motion, SimulationOptions(1.5, time_step=2.5e-4), **start)
    pose = vision.look_at_pose([2.6, 0.0, 0.45], [0.85, 0.0, -0.1])
    camera = vision.VirtualCameraSetup(pose, mean_rate=2.7, seed=5)
    made = vision.render_virtual_frames(vision.SceneDescription(system, "package:baxter"), run.t, run.q, camera)
    tree = system.mechanism_with_values()
    robot = ArticulatedSurfaces(tree, load_robot_meshes_by_joint("package:baxter", tree))
    region = ReachableObjectRegion(system, vision.CloudFilterOptions())
    pose, clouds = made.sequence.camera_pose, []
    true = [made.true_configuration_at(t) for t in made.capture_times]
    for i, q in enumerate(true):
        points = made.sequence.load_cloud(i) @ pose[:3, :3].T + pose[:3, 3]
        cloud = voxel_averages(points[region.membership_mask_function_at(q, pose[:3, 3])(points)], VOXEL)
        cloud = cloud.select(statistical_inlier_mask(cloud))
        cloud = cloud.select(~robot.within_surface_distance_mask(cloud.points, q, 0.03))
        clouds.append((cloud.points - pose[:3, 3]) @ pose[:3, :3])
    vision.write_frame_folder(frames_of(made.capture_times, clouds, pose), FOLDER / "frames")
    names = system.driven
    every = slice(None, None, 2)
    joints = JointGroup(names, run.t[every], np.round(run.q[every, : len(names)], 6), position_std=2e-4)
    write_recording(Recording(joints, description="Joints beside three clouds.", source="test"), FOLDER / "joints.h5")
    shape = ShapeFitter(system)
    truth = {
        "points": system.point_frames,
        "position": [np.round(shape.point_positions_at_configuration(q), 5).tolist() for q in true],
    }
    (FOLDER / "truth.json").write_text(json.dumps(truth) + "\n")


if __name__ == "__main__":
    main()
