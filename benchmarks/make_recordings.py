"""Make the paper's four experiments, in MuJoCo, the same every time.

    python benchmarks/make_recordings.py [FOLDER] [--torques rough | clean]

The motions (seeds) are such that no torque exceeds Baxter's limits and the Y does not snap from one shape to another.

`rough` torques are like those of the real arm, as `torque_noise.py` finds them: a controller at 1 kHz of which every
tenth torque is recorded, white noise, a constant offset for each joint, and arms that shake until torques differ as
much from sample to sample, noise included. These recordings ship as the embedded defaults. `clean` torques are held
over each sample and recorded without an error; those are for tests, in `tests/data/clean`.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import casadi as ca
import h5py
import numpy as np
from baxter import baxter_foam_y_system

from yid_ocp.data.recording_hdf5 import write_recording
from yid_ocp.files import atomic_write
from yid_ocp.model.kinematics import forward_kinematics, lagrangian_first_derivatives, mass_matrix
from yid_ocp.model.system import System
from yid_ocp.virtual.experiment import ArmSensorNoise, PointCamera, VirtualExperimentSettings, run_virtual_experiment
from yid_ocp.virtual.joint_motion import (
    MultisineMotion,
    MultisineOptions,
    grasping_joint_angles,
    random_multisine_motion,
)
from yid_ocp.virtual.mujoco_simulation import SimulationOptions, SimulationResult

# the paper's answer for one arm with vision, the only one of its four in which no stiffness is zero, rounded
TRUTH = {
    "T1.bend": 22.0,
    "T1.twist": 13.6,
    "T2.bend": 10.7,
    "T2.twist": 8.2,
    "T3.bend": 11.5,
    "T3.twist": 9.7,
}
NOISE_SEEDS = {(1, "estimate"): 101, (1, "held_out"): 102, (2, "estimate"): 201, (2, "held_out"): 202}
INNER_STEP = 5e-5
# How far the grippers travel [m], and where they stand at the start beside the ends of the undeformed Y [m]: with two
# arms the Y is pushed together and forward, because at its full stretch it snaps from shape to shape.
TRAVEL = {1: 0.15, 2: 0.13}
TOGETHER, FORWARD = 0.05 * 0.5**0.5, 0.08
OFFSETS = {
    1: {},
    2: {"left": (FORWARD, -TOGETHER, -TOGETHER), "right": (FORWARD, TOGETHER, -TOGETHER)},
}


SNAP = 1.5  # a joint of the object that is faster has snapped or is about to [rad/s]

# White noise as measured on the real arm. The offsets fitted there, 0.06 to 2 N m, hold the model's errors of gravity
# as well; their spread from recording to recording is 0.01 to 0.15 N m. In between: the fitted ones kept within 0.1 to
# 0.3.
WHITE = (0.10, 0.075, 0.10, 0.06, 0.03, 0.04, 0.02)  # s0, s1, e0, e1, w0, w1, w2 [N m]
OFFSET = (0.3, 0.3, 0.3, 0.3, 0.1, 0.3, 0.2)


@dataclass(frozen=True)
class Torques:
    """How torques come about and what is recorded of them.

    Attributes
    ----------
    motion_seeds : mapping of (arms, purpose) to int
    travel : mapping of arms to float
        [m]
    shake : float
        [N m]
    simulation : Simulation
    white, offset : tuple of float, length 7 or none
        Standard deviations of the noise of one arm's torques [N m]; empty where there is none.
    """

    motion_seeds: Mapping[tuple[int, str], int]
    travel: Mapping[int, float]
    shake: float
    simulation: SimulationOptions
    white: tuple[float, ...]
    offset: tuple[float, ...]

    def noise(self, arms: int) -> ArmSensorNoise:
        """What the arms measure."""
        return ArmSensorNoise(effort_std=arms * self.white or 0.0, effort_bias_std=arms * self.offset or 0.0)


CLEAN = Torques(
    motion_seeds={(1, "estimate"): 1, (1, "held_out"): 7, (2, "estimate"): 7, (2, "held_out"): 2},
    travel=TRAVEL,
    shake=0.0,
    simulation=SimulationOptions(time_step=INNER_STEP),
    white=(),
    offset=(),
)
ROUGH = Torques(
    motion_seeds={(1, "estimate"): 7, (1, "held_out"): 2, (2, "estimate"): 7, (2, "held_out"): 2},
    travel={1: 0.11, 2: 0.13},
    shake=0.3,
    simulation=SimulationOptions(time_step=INNER_STEP, controller_rate=1000.0, effort_kind="sample"),
    white=WHITE,
    offset=OFFSET,
)


def within_limits(system: System, run: SimulationResult) -> bool:
    """Whether no arm joint exceeds its torque or velocity, and no joint of the object is as fast as in a snap."""
    driven = list(system.actuated_coordinate_indices)
    torque = np.array([system.mechanism.joints[j].effort_limit for j in driven])
    speed = np.array([system.mechanism.joints[j].velocity_limit for j in driven])
    of_object = np.setdiff1d(np.arange(system.n_coordinates), driven)
    strong = np.all(np.abs(run.effort) <= torque) and np.all(np.abs(run.v[:, driven]) <= speed)
    return bool(strong and np.abs(run.v[:, of_object]).max() <= SNAP)


def compress(path: Path) -> None:
    with atomic_write(path) as temporary, h5py.File(path) as source, h5py.File(temporary, "x") as target:
        target.attrs.update(source.attrs)

        def copy(name: str, item: h5py.Group | h5py.Dataset) -> None:
            if isinstance(item, h5py.Dataset):
                made = target.create_dataset(name, data=item[()], compression="gzip", compression_opts=9, shuffle=True)
            else:
                made = target.create_group(name)
            made.attrs.update(item.attrs)

        source.visititems(copy)


def shaken_motion(
    system: System,
    values: Mapping[str, float] | None,
    posture: Mapping[str, float],
    seed: int,
    excitation: MultisineOptions,
    torque_rms: float,
    band: tuple[float, float] = (4.0, 9.0),
    max_speed: float = 0.15,
) -> MultisineMotion:
    """A random multisine motion with fast sines added, which accelerate each joint's own inertia.

    Their torque has the root mean square `torque_rms` [N m]. Their frequencies `band` [Hz] should end well below half
    the torque's sample rate. None is faster than `max_speed` [rad/s], which light wrists reach first.
    """
    motion = random_multisine_motion(system, values, seed=seed, initial_joint_angles=posture, excitation=excitation)
    if torque_rms == 0.0:
        return motion
    q, start = ca.SX.sym("q", system.n_coordinates), [posture.get(name, 0.0) for name in system.mechanism.joint_names]
    tree, still = system.mechanism_with_values(values), ca.SX(ca.DM.zeros(system.n_coordinates))
    mass = mass_matrix(lagrangian_first_derivatives(forward_kinematics(tree, q), still, still[:3]), tree)
    inertia = np.diag(np.array(ca.densify(ca.Function("M", [q], [mass])(start))))
    shape, rng = motion.frequency.shape, np.random.default_rng(seed)
    rng.random((3, *shape))  # what the slow sines were drawn from
    edges = np.linspace(np.log(band[0]), np.log(band[1]), shape[1] + 1)
    frequency = np.exp(rng.uniform(edges[:-1], edges[1:], shape))
    omega, torque = 2 * np.pi * frequency, torque_rms * np.sqrt(2.0 / shape[1])
    own = inertia[list(system.actuated_coordinate_indices), None]
    amplitude = np.hstack([motion.amplitude, np.minimum(torque / (own * omega**2), max_speed / omega)])
    phase = np.hstack([motion.phase, rng.uniform(0.0, 2 * np.pi, shape)])
    return replace(motion, amplitude=amplitude, frequency=np.hstack([motion.frequency, frequency]), phase=phase)


def make(folder: Path, torques: Torques) -> None:
    for arms, word, hands in ((1, "single", "one arm"), (2, "dual", "two arms")):
        system = baxter_foam_y_system(arms)
        posture = grasping_joint_angles(system, TRUTH, offsets=OFFSETS[arms])
        for purpose in ("estimate", "held_out"):
            seed = torques.motion_seeds[arms, purpose]
            excitation = MultisineOptions(gripper_travel=torques.travel[arms])
            motion = shaken_motion(system, TRUTH, posture, seed, excitation, torques.shake)
            for vision in (False, True):
                name = f"{word}_arm_{'vision' if vision else 'no_vision'}_{purpose}"
                experiment = VirtualExperimentSettings(
                    motion=motion,
                    initial_joint_angles=posture,
                    simulation=torques.simulation,
                    arm_noise=torques.noise(arms),
                    camera=PointCamera() if vision else None,
                    seed=NOISE_SEEDS[arms, purpose],
                    recording_name=name,
                    description=f"Baxter moves the foam Y with {hands} (motion seed {seed}).",
                )
                recording = run_virtual_experiment(system, TRUTH, experiment)
                path = folder / f"{name}.h5"
                write_recording(recording, path)
                compress(path)
                print(f"{path.name}: {path.stat().st_size / 1e3:.0f} kB, {recording.duration:g} s")


if __name__ == "__main__":
    repository = Path(__file__).resolve().parents[1]
    kinds = {"rough": (ROUGH, repository / "yid_ocp/data/defaults"), "clean": (CLEAN, repository / "tests/data/clean")}
    parser = argparse.ArgumentParser(description="Make the recordings of the paper's four experiments.")
    parser.add_argument("folder", nargs="?", type=Path, help="the package's defaults or the tests' when absent")
    parser.add_argument("--torques", choices=list(kinds), default="rough")
    arguments = parser.parse_args()
    chosen, usual = kinds[arguments.torques]
    folder = arguments.folder or usual
    folder.mkdir(parents=True, exist_ok=True)
    make(folder, chosen)
