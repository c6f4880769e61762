"""Make the recordings of the embedded diagnosis in MuJoCo: a trunk that damps as a Kelvin-Voigt solid, which the model
does not know.

    python benchmarks/make_diagnosis_recordings.py [FOLDER]

MuJoCo expresses the effect by its own joint damping: tau kappa on every joint of the segment, beside the nominal one.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from make_recordings import TRAVEL, TRUTH, compress

import yid_ocp
from yid_ocp.data.recording_hdf5 import write_recording
from yid_ocp.model import Grasp, System, flexible_object
from yid_ocp.model.mechanism import transform_from_xyz_rpy
from yid_ocp.model.objects.foam_y import foam_y_segments
from yid_ocp.model.urdf import read_urdf
from yid_ocp.virtual.experiment import VirtualExperimentSettings, run_virtual_experiment
from yid_ocp.virtual.joint_motion import (
    BAXTER_JOINT_NAMES_WITHOUT_SIDE,
    MultisineOptions,
    grasping_joint_angles,
    random_multisine_motion,
)
from yid_ocp.virtual.mujoco_simulation import SimulationOptions

TAU = 0.05
NOMINAL_DAMPING = 0.05
SEGMENT = "T1"
MOTION_SEEDS = {"estimate": 1, "held_out": 7}
NOISE_SEEDS = {"estimate": 301, "held_out": 302}
INNER_STEP = 1e-4


def damped(segment: str, tau: float) -> dict[str, float]:
    """Parameter values of the Y whose segment has the damping tau kappa beside the nominal one."""
    own = {
        f"{segment}.damping": NOMINAL_DAMPING + tau * TRUTH[f"{segment}.bend"],
        f"{segment}.twist_damping": NOMINAL_DAMPING + tau * TRUTH[f"{segment}.twist"],
    }
    return TRUTH | own


def experiment() -> System:
    """The paper's single arm, with a damping of its own for the twists of every tube."""
    names = [f"left_{joint}" for joint in BAXTER_JOINT_NAMES_WITHOUT_SIDE]
    segments = [
        replace(segment, damping=NOMINAL_DAMPING, twist_damping=NOMINAL_DAMPING) for segment in foam_y_segments()
    ]
    return System.build(
        read_urdf("package:baxter", joints=names),
        objects=[(flexible_object(segments, transform_from_xyz_rpy((0.85, 0.0, -0.93))), None, None)],
        grasps=[Grasp("left", "left_gripper", "w_T2")],
        driven=names,
        damping=NOMINAL_DAMPING,
    )


def make(folder: Path) -> None:
    system = experiment()
    values = damped(SEGMENT, TAU)
    posture = grasping_joint_angles(system, TRUTH)
    for purpose, seed in MOTION_SEEDS.items():
        excitation = MultisineOptions(gripper_travel=TRAVEL[1])
        motion = random_multisine_motion(system, TRUTH, seed=seed, initial_joint_angles=posture, excitation=excitation)
        name = f"diagnosis_{purpose}"
        described = VirtualExperimentSettings(
            motion=motion,
            initial_joint_angles=posture,
            simulation=SimulationOptions(time_step=INNER_STEP),
            seed=NOISE_SEEDS[purpose],
            recording_name=name,
            description=f"Baxter moves a foam Y whose trunk damps more than the model says (motion seed {seed}).",
        )
        recording = run_virtual_experiment(system, values, described)
        path = folder / f"{name}.h5"
        write_recording(recording, path)
        compress(path)
        print(f"{path.name}: {path.stat().st_size / 1e3:.0f} kB, {recording.duration:g} s")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Make the recordings of the embedded diagnosis.")
    default = Path(yid_ocp.__file__).parent / "data" / "defaults"
    parser.add_argument("folder", nargs="?", type=Path, default=default)
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    make(arguments.folder)
