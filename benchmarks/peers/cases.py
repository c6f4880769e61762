"""The cases: recordings, the model that every tool gets, and the true values.

MuJoCo makes the recordings of the foam Y, the payload and the scaled torque, from the same MJCF that the MuJoCo tools
are given: they have the advantage of the inverse crime there. The springs are statics in closed form and the servo
pendulum is real. A seed draws the noise; the motion stays.
"""

from __future__ import annotations

import functools
import json
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType

import casadi as ca
import mujoco
import numpy as np

from yid_ocp.config.reader import load_config
from yid_ocp.data.recording import Recording
from yid_ocp.data.recording_hdf5 import read_recording, write_recording
from yid_ocp.model.system import System
from yid_ocp.virtual.experiment import ArmSensorNoise, VirtualExperimentSettings, recording_from_simulation
from yid_ocp.virtual.joint_motion import MultisineOptions, grasping_joint_angles, random_multisine_motion
from yid_ocp.virtual.mjcf import mujoco_xml
from yid_ocp.virtual.mujoco_simulation import SimulationOptions, SimulationResult, simulate_in_mujoco
from yid_ocp.workflow.build import build_system

HERE = Path(__file__).resolve().parent
REPOSITORY = HERE.parents[1]
sys.path.insert(0, str(REPOSITORY / "benchmarks"))
import make_recordings as foam  # noqa: E402
import make_spring_recordings as springs  # noqa: E402

SERVO_FOLDER = REPOSITORY.parent / "shared" / "recordings" / "servo_pendulum"
SERVO_KINDS = ("sines", "sweep", "lift", "up_down")  # each is held out once; the drops stay in every fit
RECORDED_OVER_TRUE_TORQUE = 1.15
PAYLOAD = {"mass": 1.2, "mx": 0.03, "my": -0.02, "mz": 0.06}  # [kg], [kg m] in the hand's frame
PANDA_POSTURE = {
    "panda_joint1": 0.0, "panda_joint2": -0.4, "panda_joint3": 0.0, "panda_joint4": -2.0, "panda_joint5": 0.0,
    "panda_joint6": 1.7, "panda_joint7": 0.6,
}  # fmt: skip
PENDULUM_POSTURE = {"shoulder": 0.4, "elbow": 0.5}  # [rad]
PENDULUM_TRUTH = {
    "link_mass@shoulder.scale": 1.1, "link_mass@elbow.scale": 0.9, "shoulder.damping": 0.08, "elbow.damping": 0.05,
}  # fmt: skip


@dataclass(frozen=True)
class Unknown:
    """Where a search begins and between which bounds it stays; SI units."""

    start: float
    lower: float
    upper: float


@dataclass(frozen=True)
class Trial:
    """What every tool is given for one case and seed; `truth` is for the score alone.

    `mjcf` has the unknowns at their start; `config` is what `yid_ocp` reads with the settings `overrides`.
    `true_shape` are the true angles of a held object's joints as the first recording begins: the foam Y has several
    equilibria, and MuJoCo finds the right one only from nearby. `yid_ocp` is not given them.
    """

    case: str
    mjcf: str
    unknowns: Mapping[str, Unknown]
    estimate: tuple[Recording, ...]
    held_out: tuple[Recording, ...]
    config: Path
    overrides: tuple[str, ...] = ()
    truth: Mapping[str, float] = field(default_factory=dict)
    recorded_over_true_torque: float = 1.0
    true_shape: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Case:
    """A case: its title, how its recordings came about, seeds and the trial of a seed and a folder for its files."""

    title: str
    made_by: str
    seeds: tuple[int, ...]
    trial: Callable[[int, Path], Trial]
    needs_shared_recordings: bool = False


def _two_arm_foam(torques: foam.Torques, seed: int, folder: Path) -> Trial:
    config = REPOSITORY / "configs" / "dual_arm_no_vision.yaml"
    system, runs = _foam_runs(torques is foam.ROUGH)
    settings = [
        VirtualExperimentSettings(
            simulation=torques.simulation, arm_noise=torques.noise(2), camera=None, seed=1000 * seed + k
        )
        for k in range(2)
    ]
    recordings = [recording_from_simulation(system, foam.TRUTH, s, run) for s, run in zip(settings, runs, strict=True)]
    start = dict.fromkeys(foam.TRUTH, 3.0)
    return Trial(
        "foam_noise" if torques is foam.ROUGH else "foam",
        mujoco_xml(system, start, time_step=1e-3),
        {name: Unknown(3.0, 1.0, 60.0) for name in foam.TRUTH},
        (recordings[0],),
        (recordings[1],),
        config,
        _files(folder, recordings[:1], recordings[1:]),
        foam.TRUTH,
        true_shape=dict(zip(system.mechanism.joint_names, runs[0].q[0], strict=True)),
    )


@functools.cache
def _foam_runs(rough: bool) -> tuple[System, list[SimulationResult]]:
    torques, runs = foam.ROUGH if rough else foam.CLEAN, []
    system = foam.baxter_foam_y_system(2)
    posture = grasping_joint_angles(system, foam.TRUTH, offsets=foam.OFFSETS[2])
    excitation = MultisineOptions(gripper_travel=torques.travel[2])
    for purpose in ("estimate", "held_out"):
        seed = torques.motion_seeds[2, purpose]
        motion = foam.shaken_motion(system, foam.TRUTH, posture, seed, excitation, torques.shake)
        runs.append(simulate_in_mujoco(system, foam.TRUTH, motion, torques.simulation, initial_joint_angles=posture))
    return system, runs


def _payload(seed: int, folder: Path) -> Trial:
    config = HERE / "arm_with_payload.yaml"
    truth = {f"payload@panda_hand_tcp.{name}": value for name, value in PAYLOAD.items()}
    noise = ArmSensorNoise(
        position_std=1e-4, velocity_std=5e-3, effort_std=7 * (0.1,), effort_bias_std=7 * (0.2,), point_std=1e-3
    )
    system, runs = _arm_runs(config, tuple(PANDA_POSTURE.items()), tuple(truth.items()))
    recordings = _with_noise(system, truth, noise, seed, runs)
    # a finite difference about a place of zero is lost in MuJoCo's compiler
    unknowns = {name: Unknown(0.01, -0.5, 0.5) for name in truth}
    unknowns["payload@panda_hand_tcp.mass"] = Unknown(0.1, 0.01, 5.0)
    return Trial(
        "payload",
        _with_body_at_hand(system, unknowns["payload@panda_hand_tcp.mass"].start),
        unknowns,
        recordings[:1],
        recordings[1:],
        config,
        _files(folder, recordings[:1], recordings[1:]),
        truth,
    )


def _with_body_at_hand(system: System, mass: float) -> str:
    """MJCF of the bare arm, and a body `payload` at the hand's frame that holds the unknown mass."""
    root = ElementTree.fromstring(mujoco_xml(system, time_step=1e-3))
    frame = system.mechanism_with_values().frame("panda_hand_tcp")
    rotation, place = (np.array(ca.evalf(part)) for part in (frame.placement.rotation, frame.placement.translation))
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, rotation.reshape(9))
    carrier = f"{system.mechanism.joint_names[frame.joint_index]}_body"
    parent = next(body for body in root.iter("body") if body.get("name") == carrier)
    pose = {"pos": " ".join(map(str, place.ravel())), "quat": " ".join(map(str, quaternion))}
    body = ElementTree.SubElement(parent, "body", {"name": "payload", **pose})
    ElementTree.SubElement(body, "inertial", pos="0 0 0", mass=str(mass), diaginertia="1e-6 1e-6 1e-6")
    return ElementTree.tostring(root, encoding="unicode")


def _scaled_torque(seed: int, folder: Path) -> Trial:
    config = HERE / "scaled_torque.yaml"
    noise = ArmSensorNoise(position_std=1e-4, velocity_std=5e-3, effort_std=2 * (0.02,))
    system, runs = _arm_runs(config, tuple(PENDULUM_POSTURE.items()), tuple(PENDULUM_TRUTH.items()))
    recordings = []
    for recording in _with_noise(system, PENDULUM_TRUTH, noise, seed, runs):
        joints = recording.joints
        assert joints is not None
        assert joints.effort is not None
        factor = RECORDED_OVER_TRUE_TORQUE
        wrong = replace(joints, effort=factor * joints.effort, effort_std=factor * np.asarray(joints.effort_std))
        recordings.append(replace(recording, joints=wrong))
    start = {name: 1.0 if name.endswith("scale") else 0.1 for name in PENDULUM_TRUTH}
    return Trial(
        "scaled_torque",
        mujoco_xml(system, start, time_step=1e-3),
        {name: Unknown(value, 0.0 if value < 1 else 0.2, 3.0) for name, value in start.items()},
        tuple(recordings[:1]),
        tuple(recordings[1:]),
        config,
        _files(folder, recordings[:1], recordings[1:]),
        PENDULUM_TRUTH,
        RECORDED_OVER_TRUE_TORQUE,
    )


@functools.cache
def _arm_runs(
    config: Path, posture: tuple[tuple[str, float], ...], truth: tuple[tuple[str, float], ...]
) -> tuple[System, list[SimulationResult]]:
    """Two motions of an arm in MuJoCo, to estimate on and to hold out."""
    system = build_system(load_config(config, ["recordings.estimate=[]", "recordings.held_out=[]"]))
    options, runs = SimulationOptions(5.0, time_step=1e-4), []
    for seed in (1, 2):
        motion = random_multisine_motion(
            system, dict(truth), seed=seed, initial_joint_angles=dict(posture), excitation=MultisineOptions()
        )
        runs.append(simulate_in_mujoco(system, dict(truth), motion, options, initial_joint_angles=dict(posture)))
    return system, runs


def _with_noise(
    system: System, truth: Mapping[str, float], noise: ArmSensorNoise, seed: int, runs: list[SimulationResult]
) -> tuple[Recording, ...]:
    made = (VirtualExperimentSettings(arm_noise=noise, camera=None, seed=1000 * seed + k) for k in range(len(runs)))
    return tuple(recording_from_simulation(system, truth, entry, run) for entry, run in zip(made, runs, strict=True))


def _springs(seed: int, folder: Path) -> Trial:
    config = REPOSITORY / "configs" / "springs_series_ends.yaml"
    made = [
        springs.recording(f"springs_{k}", "tilt", ("joint", "end"), springs.SERIES_TRUTH, 1000 * seed + k)
        for k in range(2)
    ]
    system = build_system(load_config(config))
    start = dict.fromkeys(springs.SERIES_TRUTH, 100.0)
    return Trial(
        "springs",
        mujoco_xml(system, start, time_step=1e-3),
        {name: Unknown(value, 1.0, 1e4) for name, value in start.items()},
        (made[0],),
        (made[1],),
        config,
        _files(folder, made[:1], []),  # the same tilt without noise twice would be refused as one recording
        springs.SERIES_TRUTH,
    )


def servo_trial(held_out: str) -> Trial:
    """The real servo pendulum with one kind of motion held out, at both gains."""
    files = {path.stem: path for path in sorted(SERVO_FOLDER.glob("*.h5"))}
    apart = [path for name, path in files.items() if name.rpartition("_")[0] == held_out]
    fitted = [path for path in files.values() if path not in apart]
    overrides = tuple(
        f"recordings.{role}={json.dumps([str(path) for path in paths])}"
        for role, paths in (("estimate", fitted), ("held_out", apart))
    )
    estimate, held = (tuple(read_recording(path) for path in paths) for paths in (fitted, apart))
    mjcf = (HERE / "servo_pendulum.xml").read_text(encoding="utf-8")
    config = REPOSITORY / "configs" / "servo_pendulum.yaml"
    return Trial("servo", mjcf, SERVO_UNKNOWNS, estimate, held, config, overrides)


# published figures of the XL330 (arXiv:2410.08650) where the search begins; torques at the output
SERVO_UNKNOWNS: Mapping[str, Unknown] = MappingProxyType(
    {
        "gain": Unknown(0.002, 0.0002, 0.01),  # per unit of the firmware's gain [N m/rad]
        "counter_voltage": Unknown(0.037, 0.001, 0.3),  # [N m s/rad]
        "torque_limit": Unknown(0.71, 0.1, 3.0),  # [N m]
        "armature": Unknown(0.0018, 1e-4, 0.01),  # [kg m^2]
        "viscous": Unknown(0.0037, 0.0, 0.1),  # [N m s/rad]
        "coulomb": Unknown(0.0128, 0.0, 0.2),  # [N m]
        "offset": Unknown(-0.03, -0.1, 0.1),  # of the encoder [rad]
        "delay": Unknown(0.005, 0.0, 0.05),  # of commands [s]
    }
)


def _files(folder: Path, estimate: tuple | list, held_out: tuple | list) -> tuple[str, ...]:
    """Write recordings and return the settings that name them."""
    folder.mkdir(parents=True, exist_ok=True)
    given = []
    for role, recordings in (("estimate", estimate), ("held_out", held_out)):
        paths = [folder / f"{role}_{k}.h5" for k in range(len(recordings))]
        for path, recording in zip(paths, recordings, strict=True):
            path.unlink(missing_ok=True)
            write_recording(recording, path)
        given.append(f"recordings.{role}={json.dumps([str(path) for path in paths])}")
    return tuple(given)


CASES: Mapping[str, Case] = MappingProxyType(
    {
        "foam": Case(
            "two-arm foam Y, exact torques", "MuJoCo", (1, 2, 3), functools.partial(_two_arm_foam, foam.CLEAN)
        ),
        "foam_noise": Case(
            "two-arm foam Y, torque noise", "MuJoCo", (1, 2, 3), functools.partial(_two_arm_foam, foam.ROUGH)
        ),
        "payload": Case("arm with payload, torque noise", "MuJoCo", tuple(range(1, 11)), _payload),
        "servo": Case(
            "servo pendulum",
            "real",
            tuple(range(len(SERVO_KINDS))),
            lambda seed, folder: servo_trial(SERVO_KINDS[seed]),
            True,
        ),
        "springs": Case("two springs in series, only the end measured", "closed form", (1, 2, 3, 4, 5), _springs),
        "scaled_torque": Case("torques recorded 15 % too large", "MuJoCo", (1, 2, 3, 4, 5), _scaled_torque),
    }
)
