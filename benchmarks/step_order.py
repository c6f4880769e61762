"""How far estimates move when the time step is halved, on two-arm twins made in MuJoCo.

    python benchmarks/step_order.py [--seed N] [--duration S] [--json FILE]

The twin starts from the undeformed Y, a controller at 2 kHz moves both arms as roughly as the real Baxter's. Two
questions are asked of it. Without noise, with torque given every 0.5 ms, the error is the step's own: the changes of
the estimates from one halving to the next must shrink by about four. Recorded as a robot does it, every 10 ms and with
encoder and camera noise, the estimates with steps of 10 and 5 ms must agree within a fraction of their deviations.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from baxter import baxter_foam_y_system
from numpy.typing import NDArray

from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.integrator.step import compile_step
from yid_ocp.model.system import System
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.options import ProblemOptions
from yid_ocp.solvers import GaussNewton, fit_problem
from yid_ocp.virtual.joint_motion import MultisineOptions, grasping_joint_angles, random_multisine_motion
from yid_ocp.virtual.mujoco_simulation import SimulationOptions, SimulationResult, simulate_in_mujoco

Array = NDArray[np.float64]

TRUTH = {"T1.bend": 22.92, "T1.twist": 14.11, "T2.bend": 13.0, "T2.twist": 9.5, "T3.bend": 9.78, "T3.twist": 9.5}
FREE = ("T1.bend", "T1.twist", "T2.bend", "T3.bend")  # what two grasped tips and the junction inform
CONTROLLER = 2000.0  # [Hz]
STEPS = (0.01, 0.005, 0.0025, 0.00125)  # [s]
SMALL = 1e-4  # changes relative to the value below which nothing is asked
ENCODER, CAMERA, ARM = 2e-4, 5e-3, 1e-3  # [rad], [m], [m]


@dataclass(frozen=True)
class Estimate:
    """What one time step says: values and standard deviations in the order of `FREE`."""

    values: Array
    std: Array
    chi2_per_dof: float
    message: str


def played(system: System, seed: int, duration: float) -> SimulationResult:
    """The twin in MuJoCo, sampled at the controller's rate."""
    posture = grasping_joint_angles(system, TRUTH)
    motion = random_multisine_motion(
        system, TRUTH, seed=seed, initial_joint_angles=posture, excitation=MultisineOptions(duration=duration)
    )
    simulation = SimulationOptions(duration=duration, sample_rate=CONTROLLER, time_step=1e-4)
    return simulate_in_mujoco(system, TRUTH, motion, simulation, initial_joint_angles=posture)


def recorded(system: System, run: SimulationResult, every: int, noise: float, name: str) -> Recording:
    """Every n-th sample of joints, torque (its mean) and grasped points, and the junction ten times a second."""
    rng = np.random.default_rng(11)
    driven = list(system.actuated_coordinate_indices)
    rows = slice(None, None, every)
    whole = (len(run.t) - 1) // every
    torque = run.effort[: whole * every].reshape(whole, every, -1).mean(axis=1)

    def noisy(clean: Array, std: float) -> Array:
        return clean + noise * std * rng.standard_normal(clean.shape)

    joints = JointGroup(
        tuple(system.driven),
        run.t[rows],
        noisy(run.q[rows][:, driven], ENCODER),
        effort=np.vstack([torque, run.effort[-1:]]),
        position_std=ENCODER,
        effort_std=0.0,
        effort_kind="mean",
    )
    groups = []
    for group, points, pick, std in (("arm", ("w_T2", "w_T3"), 20, ARM), ("camera", ("w_T1",), 200, CAMERA)):
        clean = run.point_positions[::pick][:, [system.point_frames.index(point) for point in points]]
        spread = np.full(clean.shape, std)
        groups.append(PointGroup(f"points_{group}", points, run.t[::pick], noisy(clean, std), spread, group))
    return Recording(joints, tuple(groups), name=name)


def estimated(system: System, recording: Recording, time_step: float) -> Estimate:
    """Gauss-Newton from the truth; the unseen twists stay at theirs."""
    step = compile_step(system, time_step)
    problem = EstimationProblem(step, [recording], FREE, ProblemOptions(arm_tracking_feedback="lqr"), TRUTH)
    found = fit_problem(problem, GaussNewton(cost_tolerance=1e-12, max_iterations=15))
    std = np.array([found.std[name] for name in FREE])
    return Estimate(found.x[: len(FREE)], std, found.goodness_of_fit.chi2_per_dof, found.message)


def orders(estimates: Mapping[float, Estimate]) -> dict[str, list[float]]:
    """By parameter: by how much its change shrinks from each halving to the next; NaN where it is `SMALL` already."""
    values = np.array([estimate.values for estimate in estimates.values()])
    changes = np.abs(np.diff(values, axis=0)) / np.array([TRUTH[name] for name in FREE])
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = np.where(changes[:-1] > SMALL, changes[:-1] / changes[1:], np.nan)
    return {name: ratios[:, i].tolist() for i, name in enumerate(FREE)}


def moved(estimates: Mapping[float, Estimate]) -> dict[str, float]:
    """By parameter: how far it moves from 10 to 5 ms, in standard deviations."""
    coarse, fine = estimates[0.01], estimates[0.005]
    return dict(zip(FREE, (np.abs(coarse.values - fine.values) / fine.std).tolist(), strict=True))


def report(title: str, estimates: Mapping[float, Estimate]) -> None:
    print(title)
    print(f"{'step':>8} " + " ".join(f"{name:>20}" for name in FREE) + "   chi2/n")
    for step, found in estimates.items():
        cells = " ".join(f"{v:11.5f} ±{s:7.4f}" for v, s in zip(found.values, found.std, strict=True))
        print(f"{1e3 * step:5.4g} ms {cells}   {found.chi2_per_dof:.4g}  {found.message}", flush=True)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="How far estimates move when the time step is halved.")
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--duration", type=float, default=3.0)
    parser.add_argument("--json", type=Path)
    chosen = parser.parse_args(arguments)
    system = baxter_foam_y_system(2)
    run = played(system, chosen.seed, chosen.duration)
    fine = recorded(system, run, 1, 0.0, "fine")
    clean = {step: estimated(system, fine, step) for step in STEPS}
    report("noise-free, torque every 0.5 ms", clean)
    shrunk = orders(clean)
    for name, ratios in shrunk.items():
        print(f"  {name}: changes shrink by " + ", ".join("(small)" if np.isnan(r) else f"{r:.2f}" for r in ratios))
    coarse = recorded(system, run, 20, 1.0, "recorded")
    noisy = {step: estimated(system, coarse, step) for step in STEPS[:2]}
    report("recorded every 10 ms, with noise", noisy)
    shifts = moved(noisy)
    for name, shift in shifts.items():
        print(f"  {name}: moves by {shift:.2f} standard deviations from 10 to 5 ms")
    if chosen.json:
        chosen.json.write_text(json.dumps({"shrunk": shrunk, "moved": shifts}, indent=1), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
