"""A desk arm of six geared servos (SO-101) in MuJoCo: what is found of its payload, friction and motors.

    python benchmarks/so101_twin.py [--seeds 1 2 3] [--json FILE]
    python benchmarks/so101_twin.py --recordings FOLDER

The servos are MuJoCo's own actuators with a buffer that delays commands, a clip, and the counter-voltage as a damper.
Friction is MuJoCo's own too, so that sticking is its solver's: Coulomb's part and what grows with the torque through
the gear are set anew at every inner step. Encoders count 4096 steps a turn, after white noise. The gripper is closed on
a payload that reaches to one side. `solve` of `configs/so101_servo.yaml`, whose last recording is held out, is to find
the payload and all friction of the five joints that move within two stated standard deviations.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from yid_ocp.config.reader import load_config
from yid_ocp.data.recording import Recording
from yid_ocp.data.recording_hdf5 import write_recording
from yid_ocp.model.system import System
from yid_ocp.virtual.experiment import ArmSensorNoise, VirtualExperimentSettings
from yid_ocp.virtual.injected import InjectedEffect, run_experiment_with_injected_effects
from yid_ocp.virtual.joint_motion import MultisineOptions, random_multisine_motion
from yid_ocp.virtual.mujoco_simulation import SimulationOptions
from yid_ocp.workflow.build import build_system
from yid_ocp.workflow.solve import run_solve

CONFIG = Path(__file__).resolve().parents[1] / "configs" / "so101_servo.yaml"
POSTURE = {
    "shoulder_pan": 0.0, "shoulder_lift": -0.4, "elbow_flex": 0.5,
    "wrist_flex": 0.4, "wrist_roll": 0.0, "gripper": 0.6,
}  # fmt: skip
GAIN = 16.0  # of the firmware
COULOMB, LOAD_SHARE = 0.06, 0.08  # [N m], [-]
PAYLOAD = {"mass": 0.15, "mx": 0.006, "my": 0.003, "mz": 0.003}  # [kg], [kg m]
DAMPING = 0.62  # that of the counter-voltage [N m s/rad]
BY_JOINT = {
    "{}.servo_gain": 0.6, "{}.servo_damping": DAMPING, "{}.servo_torque_limit": 3.1, "{}.servo_delay": 0.075,
    "{}.damping": 0.05, "rotor_inertia@{}.armature": 0.025, "joint_coulomb@{}.tau_c": COULOMB,
    "joint_load_friction@{}.share": LOAD_SHARE,
}  # fmt: skip
TRUTH = {f"payload@gripper_frame_link.{name}": value for name, value in PAYLOAD.items()} | {
    name.format(joint): value for name, value in BY_JOINT.items() for joint in POSTURE
}
JUDGED = ("payload@", "joint_coulomb@", "joint_load_friction@")
DURATION, RATE, INNER_STEP = 6.0, 50.0, 1e-4  # [s], [Hz], [s]
ANGLE_STD, COUNT = 5e-4, 2 * math.pi / 4096  # [rad]
SEEDS = (1, 2, 3)  # the last one is held out


def recorded(system: System, seed: int) -> Recording:
    """One motion of the arm in MuJoCo: commands and counted angles; `system` has no friction of its own."""
    values = {name: value for name, value in TRUTH.items() if name in system.parameters}
    values |= {f"{joint}.servo_gain_factor": GAIN for joint in POSTURE}
    excitation = MultisineOptions(max_joint_speed=3.0, duration=DURATION, frequency_band=(0.2, 1.5))
    motion = random_multisine_motion(system, values, seed=seed, initial_joint_angles=POSTURE, excitation=excitation)
    moves = np.array([[name != "gripper"] for name in motion.joints])
    experiment = VirtualExperimentSettings(
        motion=replace(motion, amplitude=motion.amplitude * moves),
        initial_joint_angles=POSTURE,
        simulation=SimulationOptions(DURATION, sample_rate=RATE, time_step=INNER_STEP),
        arm_noise=ArmSensorNoise(position_std=ANGLE_STD, position_resolution=COUNT),
        camera=None,
        seed=seed,
        recording_name=f"so101_{seed}",
    )
    laws = {"joint_coulomb": {"tau_c": COULOMB}, "joint_load_friction": {"share": LOAD_SHARE}}
    friction = [InjectedEffect(kind, joint, size) for joint in POSTURE for kind, size in laws.items()]
    made = run_experiment_with_injected_effects(system, values, [], experiment, friction)
    assert made.joints is not None
    return replace(made, joints=replace(made.joints, velocity=None, velocity_std=None), true_parameters=TRUTH)


def written(folder: Path, seeds: Sequence[int]) -> list[str]:
    """Recordings as files, one for each seed."""
    without = ("recordings.estimate=[]", "recordings.held_out=[]", "model.friction=null")
    system, files = build_system(load_config(CONFIG, without)), []
    for seed in seeds:
        file = folder / f"so101_{seed}.h5"
        write_recording(recorded(system, seed), file)
        files.append(str(file))
    return files


def main() -> int:
    """Print all figures; 1 where the payload or a friction is more than two standard deviations off."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", nargs="+", type=int, default=SEEDS, help="of the motions; the last is held out")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--recordings", type=Path, help="write the recordings of the shipped configuration, and stop")
    arguments = parser.parse_args()
    if arguments.recordings is not None:
        print("\n".join(written(arguments.recordings, arguments.seeds)))
        return 0
    with tempfile.TemporaryDirectory() as name:
        files, run = written(Path(name), arguments.seeds), load_config(CONFIG)
        recordings = replace(run.recordings, estimate=tuple(files[:-1]), held_out=tuple(files[-1:]))
        run = replace(run, recordings=recordings, output=replace(run.output, write_report=False))
        result = run_solve(run, Path(name) / "solved").result
    bad = 0
    for parameter, entry in result["parameters"].items():
        if entry["free"] and entry["std"]:
            apart = (entry["value"] - TRUTH[parameter]) / entry["std"]
            found = f"{entry['value']:.4g} ± {entry['std']:.2g}"
            print(f"{parameter:<42} true {TRUTH[parameter]:<7.4g} {found:<20} {apart:+.1f} std")
            bad += parameter.startswith(JUDGED) and abs(apart) > 2
    print(f"fit: {result['fit']}")
    print(
        f"held out: {max(result['held_out'][0]['rmse'].values()):.2g} rad; {bad} more than two standard deviations off"
    )
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    return int(bad > 0)


if __name__ == "__main__":
    raise SystemExit(main())
