"""Make the recordings that ship as embedded defaults, in MuJoCo, the same every time.

    python benchmarks/make_recordings.py [FOLDER]

The motions (seeds) are such that no torque exceeds Baxter's limits and the Y does not snap from one shape to another.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import h5py

import yid_ocp
from yid_ocp.data.hdf5 import write_recording
from yid_ocp.files import new_file
from yid_ocp.virtual.engine import Simulation
from yid_ocp.virtual.experiment import PointCamera, VirtualExperiment, paper_system, virtual_experiment
from yid_ocp.virtual.motion import Excitation, multisine
from yid_ocp.virtual.posture import initial_posture

TRUTH = {
    "T1.bend": 22.0,
    "T1.twist": 13.6,
    "T2.bend": 10.7,
    "T2.twist": 8.2,
    "T3.bend": 11.5,
    "T3.twist": 9.7,
}
MOTION_SEEDS = {(1, "estimate"): 1, (1, "held_out"): 7, (2, "estimate"): 7, (2, "held_out"): 2}
NOISE_SEEDS = {(1, "estimate"): 101, (1, "held_out"): 102, (2, "estimate"): 201, (2, "held_out"): 202}
INNER_STEP = 5e-5
# How far the grippers travel, and where they stand at the start beside the ends of the undeformed Y [m]: with two arms
# the Y is pushed together and forward, because at its full stretch it snaps from shape to shape.
TRAVEL = {1: 0.15, 2: 0.13}
TOGETHER, FORWARD = 0.05 * 0.5**0.5, 0.08
OFFSETS = {
    1: {},
    2: {"left": (FORWARD, -TOGETHER, -TOGETHER), "right": (FORWARD, TOGETHER, -TOGETHER)},
}


def compress(path: Path) -> None:
    with new_file(path) as temporary, h5py.File(path) as source, h5py.File(temporary, "x") as target:
        target.attrs.update(source.attrs)

        def copy(name: str, item: h5py.Group | h5py.Dataset) -> None:
            if isinstance(item, h5py.Dataset):
                made = target.create_dataset(name, data=item[()], compression="gzip", compression_opts=9, shuffle=True)
            else:
                made = target.create_group(name)
            made.attrs.update(item.attrs)

        source.visititems(copy)


def make(folder: Path) -> None:
    for arms, word, hands in ((1, "single", "one arm"), (2, "dual", "two arms")):
        system = paper_system(arms)
        posture = initial_posture(system, TRUTH, offsets=OFFSETS[arms])
        for purpose in ("estimate", "held_out"):
            seed = MOTION_SEEDS[arms, purpose]
            excitation = Excitation(travel=TRAVEL[arms])
            motion = multisine(system, TRUTH, seed=seed, posture=posture, excitation=excitation)
            for vision in (False, True):
                name = f"{word}_arm_{'vision' if vision else 'no_vision'}_{purpose}"
                experiment = VirtualExperiment(
                    motion=motion,
                    posture=posture,
                    simulation=Simulation(time_step=INNER_STEP),
                    camera=PointCamera() if vision else None,
                    seed=NOISE_SEEDS[arms, purpose],
                    name=name,
                    description=f"Baxter moves the foam Y with {hands} (motion seed {seed}).",
                )
                recording = virtual_experiment(system, TRUTH, experiment)
                path = folder / f"{name}.h5"
                write_recording(recording, path)
                compress(path)
                print(f"{path.name}: {path.stat().st_size / 1e3:.0f} kB, {recording.duration:g} s")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Make the recordings that ship as embedded defaults.")
    default = Path(yid_ocp.__file__).parent / "data" / "defaults"
    parser.add_argument("folder", nargs="?", type=Path, default=default)
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    make(arguments.folder)
