"""Withheld effects in data from MuJoCo: what the diagnosis says of each, failures included.

    python benchmarks/diagnosis_cases.py [CASE ...] [--seeds 1 7]

Every case is one arm that moves the foam Y (43 variables, 5 s to estimate on, 5 s of another motion held out, arm and
camera points). Effects of the object and the arm are parameters of the simulated system; those of sensors and clocks
are done to the recording.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from make_diagnosis_recordings import NOMINAL_DAMPING, damped, experiment
from make_recordings import TRAVEL, TRUTH

from yid_ocp.config import DIAGNOSIS_DEFAULT, load_config
from yid_ocp.data.recording import Recording
from yid_ocp.data.synthetic import Motion, initial_posture, virtual_experiment
from yid_ocp.diagnosis import Thresholds, diagnose
from yid_ocp.problem import EstimationProblem
from yid_ocp.workflow.build import build_problem

KINDS = (
    "kelvin_voigt",
    "rest_curvature",
    "density",
    "point_mass",
    "mount_compliance",
    "grasp_offset",
    "gravity_tilt",
    "camera_translation",
    "camera_latency",
    "joint_viscous",
    "rotor_inertia",
    "encoder_offset",
    "effort_gain",
    "effort_delay",
)
NOISE_SEEDS = (401, 402)


def moved_camera(recording: Recording) -> Recording:
    groups = [
        replace(g, position=g.position + np.array([0.02, 0.0, 0.0])) if g.pose is not None else g
        for g in recording.points
    ]
    return replace(recording, points=tuple(groups))


def late_camera(recording: Recording) -> Recording:
    groups = [replace(g, t=g.t + 0.08) if g.pose is not None else g for g in recording.points]
    last = recording.joints.t[-1]
    kept = []
    for g in groups:
        inside = g.t <= last
        kept.append(replace(g, t=g.t[inside], position=g.position[inside], std=g.std[inside]))
    return replace(recording, points=tuple(kept))


def strong_sensor(recording: Recording) -> Recording:
    effort = recording.joints.effort.copy()
    effort[:, 1] *= 1.08
    return replace(recording, joints=replace(recording.joints, effort=effort))


def turned_encoder(recording: Recording) -> Recording:
    position = recording.joints.position.copy()
    position[:, 1] += 0.02
    return replace(recording, joints=replace(recording.joints, position=position))


@dataclass(frozen=True)
class Case:
    """A truth: parameter values of the simulated system, or what is done to its recordings."""

    truth: str
    location: str
    values: Mapping[str, float] = field(default_factory=dict)
    change: Callable[[Recording], Recording] = lambda recording: recording
    without: tuple[str, ...] = ()


CASES: Mapping[str, Case] = {
    "clean": Case("no_gap", ""),
    "damped_trunk": Case("kelvin_voigt@T1", "T1", damped("T1", 0.05)),
    "damped_branch": Case("kelvin_voigt@T2", "T2", damped("T2", 0.05)),
    "heavy_trunk": Case("density@T1", "T1", {"T1.mass": 0.064 * 1.3}),
    "heavy_branch": Case("density@T2", "T2", {"T2.mass": 0.015 * 2.0}),
    "heavy_free_branch": Case("density@T3", "T3", {"T3.mass": 0.016 * 2.0}),
    "stiff_gear": Case("joint_viscous@left_e1", "left_e1", {"left_e1.damping": NOMINAL_DAMPING + 1.0}),
    "moved_camera": Case("camera_translation@camera", "camera", change=moved_camera),
    "late_camera": Case("camera_latency@camera", "camera", change=late_camera),
    "strong_sensor": Case("effort_gain@left_s1", "left_s1", change=strong_sensor),
    "turned_encoder": Case("encoder_offset@left_s1", "left_s1", change=turned_encoder),
    "not_in_library": Case("unknown", "T1", damped("T1", 0.05), without=("kelvin_voigt",)),
}


def record(case: Case, motion_seed: int, noise_seed: int) -> Recording:
    system = experiment()
    values = {**TRUTH, **case.values}
    posture = initial_posture(system, TRUTH)
    motion = Motion.multisine(system, TRUTH, seed=motion_seed, posture=posture, travel=TRAVEL[1])
    made = virtual_experiment(
        system, values, motion=motion, seed=noise_seed, posture=posture, name=f"motion_{motion_seed}"
    )
    return case.change(made)


def run(name: str, seeds: tuple[int, int]) -> list[str]:
    case = CASES[name]
    estimate, held_out = (record(case, *pair) for pair in zip(seeds, NOISE_SEEDS, strict=True))
    nominal = build_problem(load_config(None, (), DIAGNOSIS_DEFAULT))
    problem = EstimationProblem(nominal.step, [estimate], nominal.free, nominal.options)
    begun = time.perf_counter()
    kinds = tuple(kind for kind in KINDS if kind not in case.without)
    finding = diagnose(problem, kinds, [held_out], thresholds=Thresholds(effects=2))
    seconds = time.perf_counter() - begun
    effects = ", ".join(effect.label for effect in finding.effects) or "-"
    rivals = "; ".join(", ".join(r.label for r in a.rivals) for a in finding.added if len(a.rivals) > 1) or "-"
    closed = f"{100 * finding.closure.value:.0f} %" if finding.effects else "-"
    where = finding.where[0].location if finding.verdict != "no_gap" else "-"
    gap = f"{finding.held_out_before.chi2_per_dof:.3g}"
    return [name, case.truth, finding.verdict, effects, rivals, where, gap, closed, f"{seconds:.0f} s"]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Diagnose withheld effects in data from MuJoCo.")
    parser.add_argument("cases", nargs="*", default=list(CASES), help=", ".join(CASES))
    parser.add_argument("--seeds", nargs=2, type=int, default=(1, 7), help="of the two motions")
    arguments = parser.parse_args()
    head = ["case", "truth", "verdict", "added", "not separable", "where", "chi2/n held out", "closure", "time"]
    print("| " + " | ".join(head) + " |")
    print("|" + "---|" * len(head), flush=True)
    for name in arguments.cases:
        print("| " + " | ".join(run(name, tuple(arguments.seeds))) + " |", flush=True)
