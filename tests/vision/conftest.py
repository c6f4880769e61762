"""Virtual frames of one arm moving the foam Y, its joints' recording, its tracks, and a few frames from disk."""

import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from yid_ocp import vision
from yid_ocp.data.recording import JointGroup, Recording
from yid_ocp.data.recording_hdf5 import read_recording
from yid_ocp.errors import DataError
from yid_ocp.model.objects.foam_y import foam_y_object
from yid_ocp.model.system import System
from yid_ocp.vision.fit import ShapeFitter
from yid_ocp.vision.frame_reading import read_frames
from yid_ocp.vision.frames import CameraIntrinsics, import_open3d
from yid_ocp.vision.track import track_object

DATA = Path(__file__).parent / "data"
TRUTH = {"T1.bend": 22.0, "T1.twist": 13.6, "T2.bend": 10.7, "T2.twist": 8.2, "T3.bend": 11.5, "T3.twist": 9.7}
POSE = vision.look_at_pose([2.6, 0.0, 0.45], [0.85, 0.0, -0.1])


@pytest.fixture(scope="session", autouse=True)
def open3d():
    try:
        return import_open3d()
    except DataError as error:
        pytest.skip(f"vision is not installed: {error.what}")


@pytest.fixture(scope="session")
def system(single_arm):
    return single_arm


@pytest.fixture(scope="session")
def alone():
    """The Y without a robot."""
    return System.build(objects=[(foam_y_object(), None, None)])


@pytest.fixture(scope="session")
def shape(system):
    return ShapeFitter(system)


@pytest.fixture(scope="session")
def run(system):
    """Three seconds in MuJoCo."""
    pytest.importorskip("mujoco", reason="virtual experiments need MuJoCo")
    from yid_ocp.virtual.joint_motion import MultisineOptions, grasping_joint_angles, random_multisine_motion
    from yid_ocp.virtual.mujoco_simulation import SimulationOptions, simulate_in_mujoco

    start = {"initial_joint_angles": grasping_joint_angles(system, TRUTH)}
    motion = random_multisine_motion(system, TRUTH, seed=1, excitation=MultisineOptions(gripper_travel=0.15), **start)
    return simulate_in_mujoco(system, TRUTH, motion, SimulationOptions(3.0, time_step=2.5e-4), **start)


@pytest.fixture(scope="session")
def recording(system, run):
    rng = np.random.default_rng(5)
    position = run.q[:, list(system.actuated_coordinate_indices)]
    noisy = position + 2e-4 * rng.standard_normal(position.shape)
    return Recording(JointGroup(system.driven, run.t, noisy, position_std=2e-4), source="test", name="virtual")


# a quarter of an Xtion's pixels, each as good: a test has four times as many frames in the time
COARSE = vision.DepthCameraModel(
    CameraIntrinsics.from_field_of_view(320, 240, math.radians(58.0)), disparity_std=1 / 32, disparity_step=1 / 16
)


@pytest.fixture(scope="session")
def tracked(system, run, recording, shape):
    """tracked(**camera and timing): frames, their track, the errors of all points in the good ones [m].

    Stamps are 60 ms late, those of some frames 0.15 s more, and four frames are compared with the arm.
    """

    def make(outliers=0.0, seed=0, late=(), **timing):
        scene = vision.SceneDescription(system, "package:baxter")
        sensor = replace(COARSE, outlier_probability=outliers)
        camera = vision.VirtualCameraSetup(POSE, sensor, mean_rate=3.0, latency=0.06, seed=seed, **timing)
        made = vision.render_virtual_frames(scene, run.t, run.q, camera)
        options = vision.TrackOptions(
            calibration=vision.ArmBasedCameraCalibrationOptions(n_frames=4), tracked_points=system.point_frames
        )
        made.sequence.stamps[list(late)] += 0.15
        found = track_object(scene, recording, made.sequence, options)

        def truth(times):
            return np.array([shape.point_positions_at_configuration(made.true_configuration_at(t)) for t in times])

        errors = np.linalg.norm(found.position - truth(found.t), axis=2)
        return SimpleNamespace(made=made, track=found, truth=truth, errors=errors)

    return make


@pytest.fixture(scope="session")
def clean(tracked):
    return tracked()


@pytest.fixture(scope="session")
def small(system):
    """Three small clouds from disk, the joints' recording and where the points really were."""
    truth = json.loads((DATA / "truth.json").read_text())
    assert tuple(truth["points"]) == system.point_frames
    return SimpleNamespace(
        sequence=read_frames(DATA / "frames"),
        recording=read_recording(DATA / "joints.h5"),
        truth=np.array(truth["position"]),
        clouds=[read_frames(DATA / "frames").load_cloud(i) for i in range(3)],
    )
