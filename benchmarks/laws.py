"""Laws that are in no library, injected in MuJoCo: is the place, the quantity and the curve found?

    python benchmarks/laws.py [CASE ...] [--json FILE] [--candidates all] [--withheld]

One arm moves the foam Y (43 variables, 5 s to estimate on, 5 s of another motion held out, arm and camera points).
Every other case has torque noise of 0.05 N m and offsets of 0.1 N m, both stated. The torque is added in the
simulator's own terms; the library is `--candidates` (all, or kinds separated by commas). A case is right where the
verdict is `unknown` with a law of the true quantity, or of quantities of which it is one; `band` is the part of the
visited range in which the true curve lies within two standard deviations and a twentieth of its largest torque.

`--withheld` takes effects of the library instead, each left out of it in turn. There the true curve has to lie in the
band as it is; of the others, what is linear is left to stiffness, damping and offsets.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from make_recordings import TRAVEL, TRUTH

from yid_ocp.arrays import Array
from yid_ocp.config.reader import SHIPPED_DIAGNOSIS_CONFIG_FILE_NAME, load_config
from yid_ocp.data.recording import Recording
from yid_ocp.diagnosis.diagnose import diagnose
from yid_ocp.diagnosis.hypotheses import make_candidate_effects
from yid_ocp.effects.base import elastic_joints_of_segment
from yid_ocp.problem import EstimationProblem
from yid_ocp.virtual.experiment import ArmSensorNoise, VirtualExperimentSettings, run_virtual_experiment
from yid_ocp.virtual.injected import InjectedEffect, run_experiment_with_injected_effects
from yid_ocp.virtual.joint_motion import MultisineOptions, grasping_joint_angles, random_multisine_motion
from yid_ocp.workflow.build import build_system
from yid_ocp.workflow.build_problem import build_problem

MOTION_SEEDS, NOISE_SEEDS = (1, 7), (401, 402)
EFFORT_STD, EFFORT_BIAS_STD = 0.05, 0.1  # of every other case [N m]
Torque = Callable[[Any, Any], Any]


@dataclass(frozen=True)
class Case:
    """A torque at a joint, or at every joint that bends a segment, as a function of its angle and speed."""

    location: str
    quantity: str
    torque: Torque
    withheld: InjectedEffect | None = None  # of the library, which makes this torque


def detent(q: Any, v: Any) -> Any:
    return -60.0 * (q - 1.2) * np.exp(-(((q - 1.2) / 0.05) ** 2))


CASES: Mapping[str, Case] = {
    "ripple": Case("left_e1", "angle", lambda q, v: 1.0 * np.sin(60.0 * q)),
    "one_way_damping": Case("T1", "speed", lambda q, v: -0.6 * np.maximum(v, 0.0)),
    "lopsided_spring": Case("T1", "angle", lambda q, v: -60.0 * q**2),
    "quadratic_drag": Case("left_w1", "speed", lambda q, v: -4.0 * v * np.abs(v)),
    "soft_stop": Case("left_s1", "angle", lambda q, v: -600.0 * np.maximum(q + 1.15, 0.0) ** 2),
    "detent": Case("left_e1", "angle", detent),
    "falling_friction": Case("left_w1", "speed", lambda q, v: -3.0 * v / (1.0 + (v / 0.15) ** 2)),
    "slack_spring": Case("T2", "angle", lambda q, v: 8.0 * np.clip(q, -0.03, 0.03)),
    "quadratic_loss": Case("T1", "speed", lambda q, v: -1.5 * v * np.abs(v)),
    "crooked_spring": Case("left_w0", "angle", lambda q, v: 6.0 * np.abs(q + 0.1)),
    "one_way_gear": Case("left_e1", "speed", lambda q, v: -3.0 * np.maximum(v, 0.0)),
    "stop_and_drag": Case(
        "left_e1", "angle+speed", lambda q, v: -60.0 * np.maximum(q - 1.2, 0.0) ** 2 - 4.0 * v * np.abs(v)
    ),
}


def withheld(kind: str, location: str, quantity: str, torque: Torque, **values: float) -> Case:
    return Case(location, quantity, torque, InjectedEffect(kind, location, values))


BEND = {segment: TRUTH[f"{segment}.bend"] for segment in ("T1", "T2")}
STICTION_SPEED = 0.02  # over which the sign of friction is rounded off [rad/s]
WITHHELD: Mapping[str, Case] = {
    "viscous_elbow": withheld("joint_viscous", "left_e1", "speed", lambda q, v: -1.0 * v, b=1.0),
    "viscous_wrist": withheld("joint_viscous", "left_w1", "speed", lambda q, v: -1.0 * v, b=1.0),
    "dry_elbow": withheld("joint_coulomb", "left_e1", "speed", lambda q, v: -np.tanh(v / STICTION_SPEED), tau_c=1.0),
    "stribeck_wrist": withheld(
        "joint_stribeck",
        "left_w1",
        "speed",
        lambda q, v: -np.exp(-((v / 0.2) ** 2)) * np.tanh(v / STICTION_SPEED),
        tau_s=1.0,
        v_stribeck=0.2,
    ),
    "shoulder_spring": withheld(
        "joint_spring", "left_s1", "angle", lambda q, v: -15.0 * (q + 0.5), stiffness=15.0, rest_angle=-0.5
    ),
    "elbow_spring": withheld(
        "joint_spring", "left_e1", "angle", lambda q, v: -8.0 * (q - 1.0), stiffness=8.0, rest_angle=1.0
    ),
    "damped_trunk": withheld("kelvin_voigt", "T1", "speed", lambda q, v: -0.05 * BEND["T1"] * v, tau=0.05),
    "damped_branch": withheld("kelvin_voigt", "T2", "speed", lambda q, v: -0.05 * BEND["T2"] * v, tau=0.05),
    "stiffening_trunk": withheld("cubic_stiffness", "T1", "angle", lambda q, v: -400.0 * q**3, k3=400.0),
    "stiffening_branch": withheld("cubic_stiffness", "T2", "angle", lambda q, v: -400.0 * q**3, k3=400.0),
    "bent_trunk": withheld(
        "rest_curvature", "T1", "angle", lambda q, v: BEND["T1"] * 0.03 + 0 * q, qx=0.03, qy=0.03
    ),
    "biased_torque": withheld("effort_offset", "left_e1", "angle", lambda q, v: -0.8 + 0 * q, offset=0.8),
}  # fmt: skip


class Injected:
    """The torque of a case as `InjectedSimulatorTerms`."""

    def __init__(self, case: Case, system: Any) -> None:
        springs = elastic_joints_of_segment(system, case.location)
        self.joints = [s.joint_name for s in springs if s.deformation == "bend"] or [case.location]
        self.torque, self.has_begun = case.torque, False

    def edit_model(self, model: Any) -> None:
        self.at = np.array([model.joint(name).id for name in self.joints])

    def begin_motion(self, data: Any) -> None:
        self.has_begun = True

    def add_forces(self, model: Any, data: Any) -> None:
        data.qfrc_passive[self.at] += self.torque(data.qpos[self.at], data.qvel[self.at])


def record(case: Case, motion_seed: int, noise_seed: int, noisy: bool) -> Recording:
    system = build_system(load_config(None, (), SHIPPED_DIAGNOSIS_CONFIG_FILE_NAME))
    posture = grasping_joint_angles(system, TRUTH)
    excitation = MultisineOptions(gripper_travel=TRAVEL[1])
    motion = random_multisine_motion(
        system, TRUTH, seed=motion_seed, initial_joint_angles=posture, excitation=excitation
    )
    noise = ArmSensorNoise(effort_std=EFFORT_STD, effort_bias_std=EFFORT_BIAS_STD) if noisy else ArmSensorNoise()
    experiment = VirtualExperimentSettings(
        motion=motion,
        initial_joint_angles=posture,
        seed=noise_seed,
        recording_name=f"motion_{motion_seed}",
        arm_noise=noise,
        injected_terms=None if case.withheld else Injected(case, system),
    )
    if case.withheld:
        return run_experiment_with_injected_effects(system, TRUTH, [case.withheld], experiment)
    return run_virtual_experiment(system, TRUTH, experiment)


def in_band(case: Case, table: Any, visited: tuple[float, float]) -> float:
    """Part of the visited range in which the true curve lies in the band; NaN for a sum of two."""
    at = np.linspace(*visited, 200)
    zeros = np.zeros(200)
    true = case.torque(at, zeros) if table.quantity == "angle" else case.torque(zeros, at)
    found, std = table.interpolated_torque(at), np.interp(at, table.knots, table.torque_std)
    shift: Array = np.zeros(200)
    if case.withheld is None:
        # what is linear or constant is the stiffness's, the damping's or an offset's as much as the law's
        columns = np.column_stack([np.ones(200), at])
        weight: Array = 1 / np.maximum(std, 1e-9)
        shift = columns @ np.linalg.lstsq(columns * weight[:, None], (true - found) * weight, rcond=None)[0]
    room = 2 * std + 0.05 * float(np.max(np.abs(true)))
    return float(np.mean(np.abs(true - found - shift) <= room))


def run(name: str, candidates: Any) -> dict[str, Any]:
    case = ALL_CASES[name]
    noisy = case.withheld is None and list(CASES).index(name) % 2 == 1
    estimate, held_out = (record(case, *pair, noisy) for pair in zip(MOTION_SEEDS, NOISE_SEEDS, strict=True))
    nominal = build_problem(load_config(None, (), SHIPPED_DIAGNOSIS_CONFIG_FILE_NAME))
    problem = EstimationProblem(nominal.step, [estimate], nominal.free, nominal.options)
    if case.withheld is not None:
        library = make_candidate_effects(problem.system, [estimate], candidates)
        candidates = [effect.label for effect in library if effect.kind != case.withheld.kind]
    begun = time.process_time()
    found = diagnose(problem, candidates, [held_out])
    law = found.law
    row: dict[str, Any] = {"case": name, "place": case.location, "quantity": case.quantity, "torque noise": noisy}
    row |= {"verdict": found.verdict, "named": " + ".join(e.label for e in found.accepted_effects) or "-"}
    row |= {"law": "-" if law is None else f"{law.depends_on}@{law.location}"}
    row |= {"closure": None if law is None else round(law.closure.fraction, 3)}
    single = law is not None and len(law.tables) == 1 and law.depends_on in ("angle", "speed")
    row["band"] = None
    if law is not None and single and "+" not in case.quantity:
        [table] = law.tables
        row["band"] = round(in_band(case, table, law.visited_range[table.quantity]), 2)
    row["right"] = (
        law is not None
        and found.verdict == "unknown"
        and set(law.depends_on.split("+")) >= set(case.quantity.split("+"))
    )
    row["CPU [s]"] = round(time.process_time() - begun)
    return row


ALL_CASES = {**CASES, **WITHHELD}


def main() -> int:
    parser = argparse.ArgumentParser(description="Laws that are in no library, injected in MuJoCo.")
    parser.add_argument("cases", nargs="*", help=", ".join(ALL_CASES))
    parser.add_argument("--withheld", action="store_true", help="effects of the library, each left out in turn")
    parser.add_argument("--candidates", default="all", help="all, or kinds separated by commas")
    parser.add_argument("--json", type=Path, metavar="FILE", help="answers, added to those that it has")
    arguments = parser.parse_args()
    library = "all" if arguments.candidates == "all" else arguments.candidates.split(",")
    file: Path | None = arguments.json
    rows: dict[str, Any] = json.loads(file.read_text()) if file is not None and file.exists() else {}
    for i, name in enumerate(arguments.cases or (WITHHELD if arguments.withheld else CASES)):
        rows[name] = row = run(name, library)
        if i == 0:
            print("| " + " | ".join(row) + " |")
            print("|" + "---|" * len(row))
        print("| " + " | ".join(map(str, row.values())) + " |", flush=True)
        if file is not None:
            file.write_text(json.dumps(rows, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
