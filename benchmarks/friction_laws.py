"""Every law of joint friction in recordings of another engine: is its size found, and is it told from its neighbour?

    python benchmarks/friction_laws.py [--laws NAME ...] [--seeds FIRST LAST] [--size usual | small] [--set KEY=VALUE]
                                       [--file FILE]
    python benchmarks/friction_laws.py --effort [--seeds FIRST LAST]

One geared joint with a pendulum (`configs/servo_pendulum.yaml`) follows 3 s of commands in MuJoCo, whose own solver
holds and slides it: the size of its dry friction is set anew at every inner step (Dahl's law is a torque there). The
encoder counts 4096 steps a turn after 0.5 mrad of noise. The recording is fitted with its own law and with the
neighbour that lacks one amplitude of it. Found: that amplitude lies within two of the standard deviations that `solve`
states, which count what half of the time step changes; those of noise alone stand beside them. Told: the
neighbour is less likely by odds of 150 to 1, one parameter counting as one. `small` is three times what is detectable.
Results are appended to FILE as lines of JSON, so that slices of seeds add up; the table is of all that is there.
`--set` changes the settings of the fits, never of the recordings: such results need a FILE of their own.

`--effort` compares CPU time and evaluations of `solve` with and without dry friction in the model, on recordings
without it, with Coulomb friction and with load-dependent friction. The search begins at the published values.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from so101_twin import INNER_STEP

import yid_ocp
from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import ParameterSettings, RunSettings
from yid_ocp.data.recording import Recording
from yid_ocp.data.recording_hdf5 import write_recording
from yid_ocp.diagnosis.screening import DETECTABLE_AMPLITUDE_Z
from yid_ocp.diagnosis.thresholds import DEFAULT_THRESHOLDS
from yid_ocp.virtual.experiment import ArmSensorNoise, VirtualExperimentSettings
from yid_ocp.virtual.injected import InjectedEffect, run_experiment_with_injected_effects
from yid_ocp.virtual.joint_motion import MultisineOptions, random_multisine_motion
from yid_ocp.virtual.mujoco_simulation import SimulationOptions
from yid_ocp.workflow.build import build_system
from yid_ocp.workflow.build_problem import build_problem

CONFIG = Path(__file__).resolve().parents[1] / "configs" / "servo_pendulum.yaml"
DURATION, RATE = 3.0, 200.0  # [s], [Hz]
ANGLE_STD, COUNT = 5e-4, 2 * math.pi / 4096  # [rad]
YIELD_ANGLE, STRIBECK_SPEED, COUNTER_VOLTAGE = 0.01, 0.1, 0.04  # [rad], [rad/s], [N m s/rad]
KNOWN = {
    "joint.servo_damping": COUNTER_VOLTAGE, "joint.servo_torque_limit": 5.0, "joint.servo_delay": 0.0,
    "joint.servo_gain_factor": 400.0, "encoder_offset@joint.offset": 0.0,
}  # fmt: skip
FREE = {"joint.servo_gain": 0.005, "rotor_inertia@joint.armature": 0.0018, "joint.damping": 0.004}
USUAL = {
    "joint_coulomb@joint.tau_c": 0.03, "joint_load_friction@joint.share": 0.15,
    "joint_stribeck@joint.tau_s": 0.03, "joint_stribeck@joint.v_stribeck": STRIBECK_SPEED,
    "joint_presliding@joint.tau_c": 0.03, "joint_presliding@joint.yield_angle": YIELD_ANGLE,
}  # fmt: skip
# law: the amplitude that its neighbour on the ladder lacks, and the neighbour
LADDER = {
    "coulomb": ("joint_coulomb@joint.tau_c", "viscous"),
    "stribeck": ("joint_stribeck@joint.tau_s", "coulomb"),
    "presliding": ("joint_presliding@joint.tau_c", "viscous"),
    "load": ("joint_load_friction@joint.share", "coulomb"),
    "load_stribeck": ("joint_stribeck@joint.tau_s", "load"),
}


def settings(law: str, file: str | None, start: Mapping[str, float], changes: Sequence[str] = ()) -> RunSettings:
    """The shipped configuration with one law of friction, the motor's gain and the joint's inertia unknown."""
    own = [] if file is None else [file]
    changed = ["recordings.held_out=[]", f"recordings.estimate={json.dumps(own)}", "model.arms.servo.motor={kind: dc}"]
    changed += ["model.friction=null" if not law else f"model.friction={{law: {law}}}"]
    run = load_config(CONFIG, [*changed, *changes])
    given = {name: ParameterSettings(initial=value) for name, value in KNOWN.items()}
    given |= {name: ParameterSettings(initial=value, free=True) for name, value in FREE.items()}
    given |= {name: ParameterSettings(initial=value, free=True) for name, value in start.items()}
    sensor = replace(run.sensors["joints.position"], std=None)
    return replace(run, parameters=given, sensors={**run.sensors, "joints.position": sensor})


def recorded(seed: int, amplitudes: Mapping[str, float]) -> Recording:
    """One motion of the joint in MuJoCo: commands and counted angles."""
    system = build_system(settings("", None, {}))
    values = {name: value for name, value in {**KNOWN, **FREE}.items() if name in system.parameters}
    excitation = MultisineOptions(
        gripper_travel=0.25, max_joint_speed=6.0, duration=DURATION, frequency_band=(0.3, 2.0), ramp_time=0.5
    )
    start = {"joint": 0.3}
    experiment = VirtualExperimentSettings(
        motion=random_multisine_motion(system, values, seed=seed, initial_joint_angles=start, excitation=excitation),
        initial_joint_angles=start,
        simulation=SimulationOptions(DURATION, sample_rate=RATE, time_step=INNER_STEP),
        arm_noise=ArmSensorNoise(position_std=ANGLE_STD, position_resolution=COUNT),
        camera=None,
        seed=seed,
        recording_name=f"friction_{seed}",
    )
    sizes: dict[str, dict[str, float]] = {}
    for name, value in amplitudes.items():
        kind, _, quantity = name.partition("@joint.")
        sizes.setdefault(kind, {})[quantity] = value
    effects = [InjectedEffect(kind, "joint", size) for kind, size in sizes.items()]
    made = run_experiment_with_injected_effects(system, values, effects, experiment, ())
    assert made.joints is not None
    return replace(made, joints=replace(made.joints, velocity=None, velocity_std=None), true_parameters={})


def of_law(law: str) -> dict[str, float]:
    """The usual amplitudes and shapes of a law."""
    parts = law.split("_")
    kinds = {f"joint_{own}" for own in parts} | ({"joint_coulomb"} if {"stribeck", "load"} & {*parts} else set())
    kinds |= {"joint_load_friction"} if "load" in parts else set()
    return {name: value for name, value in USUAL.items() if name.partition("@")[0] in kinds}


def fitted(
    law: str, file: str, start: Mapping[str, float], changes: Sequence[str], amplitude: str = ""
) -> tuple[float, float, float, float]:
    """Chi2 of a law's fit, an amplitude with the standard deviation that `solve` states, and that of noise alone."""
    run = settings(law, file, start, changes)
    found = yid_ocp.solve(build_problem(run), run.solver)
    chi2, entry, checks = 2 * found.cost, found.parameters.get(amplitude), found.checks
    if entry is None or checks is None:
        return chi2, math.nan, math.nan, math.nan
    return chi2, entry.value, entry.std, checks.data_std[amplitude]


def examined(law: str, seed: int, size: str, changes: Sequence[str]) -> dict[str, Any]:
    """One recording of a law, fitted with it and with its neighbour."""
    amplitude, neighbour = LADDER[law]
    truth = of_law(law)
    with tempfile.TemporaryDirectory() as folder:
        file = str(Path(folder) / "one.h5")
        write_recording(recorded(seed, truth), file)
        chi2, value, std, of_noise = fitted(law, file, truth, changes, amplitude)
        if size == "small":
            truth = {**truth, amplitude: 3 * DETECTABLE_AMPLITUDE_Z * of_noise}
            write_recording(recorded(seed, truth), file)
            chi2, value, std, of_noise = fitted(law, file, truth, changes, amplitude)
        simpler = {name: own for name, own in truth.items() if name in of_law(neighbour)}
        other, *_ = fitted(neighbour, file, simpler, changes)
    more = len(truth) - len(of_law(neighbour))
    told = other - chi2 - more > 2 * DEFAULT_THRESHOLDS.min_log_bayes_factor
    found = abs(value - truth[amplitude]) <= 2 * std
    kept = {"law": law, "seed": seed, "size": size, "truth": truth[amplitude], "value": value, "std": std}
    kept |= {"std_of_noise": of_noise}
    return {**kept, "chi2": chi2, "neighbour_chi2": other, "found": bool(found), "told": bool(told)}


def effort(seeds: Sequence[int]) -> None:
    """Print CPU time [s], evaluations and chi2 of `solve`, means over the seeds, by recording and law."""
    print("| recording | law of the model | CPU [s] | evaluations | chi2 |\n|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for made in ("viscous", "coulomb", "load"):
            rows: dict[str, list[tuple[float, float, float]]] = {}
            for seed in seeds:
                file = str(Path(folder) / f"{made}_{seed}.h5")
                write_recording(recorded(seed, of_law(made)), file)
                for law in ("viscous", "coulomb", "load"):
                    run = settings(law, file, {})
                    problem = build_problem(run)
                    yid_ocp.solve(problem, run.solver)  # it compiles what the second one measures
                    begun = time.process_time()
                    found = yid_ocp.solve(problem, run.solver)
                    own = time.process_time() - begun, found.n_evaluations, 2 * found.cost
                    rows.setdefault(law, []).append(own)
            for law, own_rows in rows.items():
                cpu, evaluations, chi2 = np.mean(own_rows, axis=0)
                print(f"| {made} | {law} | {cpu:.2f} | {evaluations:.1f} | {chi2:.0f} |")


def main() -> int:
    """Run a slice, append it, and print the table of all that is there."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--laws", nargs="*", choices=LADDER, default=[*LADDER])
    parser.add_argument("--seeds", nargs=2, type=int, default=(1, 20), metavar=("FIRST", "LAST"))
    parser.add_argument("--size", choices=("usual", "small"), default="usual")
    parser.add_argument("--set", dest="changes", action="append", default=[], metavar="KEY=VALUE", help="of the fits")
    parser.add_argument("--file", type=Path, default=Path("friction_laws.jsonl"))
    parser.add_argument("--effort", action="store_true", help="compare the effort of solve with and without friction")
    arguments = parser.parse_args()
    if arguments.effort:
        effort(range(arguments.seeds[0], arguments.seeds[1] + 1))
        return 0
    lines = arguments.file.read_text(encoding="utf-8").splitlines() if arguments.file.exists() else []
    done = {(own["law"], own["seed"], own["size"]): own for own in map(json.loads, lines)}
    for seed in range(arguments.seeds[0], arguments.seeds[1] + 1):
        for law in arguments.laws:
            if (law, seed, arguments.size) not in done:
                done[law, seed, arguments.size] = made = examined(law, seed, arguments.size, arguments.changes)
                with arguments.file.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(made) + "\n")
    print("| law | size | recordings | amplitude, true and median found | within two std | told from its neighbour |")
    print("|---|---|---|---|---|---|")
    for law, (_, neighbour) in LADDER.items():
        for size in ("usual", "small"):
            own = [entry for entry in done.values() if (entry["law"], entry["size"]) == (law, size)]
            if own:
                columns = ([entry[key] for entry in own] for key in ("truth", "value", "std", "std_of_noise"))
                middle = [float(np.median(column)) for column in columns]
                right, apart = (sum(entry[key] for entry in own) for key in ("found", "told"))
                amplitude = f"{middle[0]:.3g}, {middle[1]:.3g} ± {middle[2]:.2g} (noise {middle[3]:.2g})"
                print(f"| {law} | {size} | {len(own)} | {amplitude} | {right} | {apart} from {neighbour} |")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
