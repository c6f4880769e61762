"""Time to solution of every method from the same start, as ratios to Gauss-Newton single shooting in the same run.

python benchmarks/methods.py [--arms N] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from baxter import baxter_foam_y_system
from rich.console import Console
from rich.table import Table
from workloads import CLEAN, STIFFNESSES, TIME_STEP

from yid_ocp.analysis.compare import compare_methods
from yid_ocp.data.recording_hdf5 import read_recording
from yid_ocp.integrator.step import compile_step
from yid_ocp.problem import EstimationProblem
from yid_ocp.solvers import GaussNewton, MultipleShooting, SingleShooting, SteepestDescent

RECORDINGS = {1: "single_arm_vision_estimate.h5", 2: "dual_arm_vision_estimate.h5"}


def main(arguments: list[str] | None = None) -> int:
    """Run every method from 3 N m/rad and print one table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--arms", type=int, choices=(1, 2), default=1)
    parser.add_argument("--json", type=Path, metavar="FILE", help="store the ratios of CPU time")
    options = parser.parse_args(arguments)
    recording = read_recording(CLEAN / RECORDINGS[options.arms])
    step = compile_step(baxter_foam_y_system(options.arms), TIME_STEP)
    problem = EstimationProblem(step, [recording], STIFFNESSES)
    problem.evaluate(problem.initial_unknowns * 4.0)  # compiles what is compiled once
    methods = {
        "gauss_newton": GaussNewton(),
        "single_shooting": SingleShooting(),
        "multiple_shooting, condensing": MultipleShooting(condensing=True),
        "multiple_shooting": MultipleShooting(),
        "multiple_shooting, exact": MultipleShooting(hessian="exact"),
        "steepest_descent, as in the paper": SteepestDescent(),
        "steepest_descent, spectral": SteepestDescent(
            first_trial_step_rule="spectral", nonmonotone_memory=10, max_iterations=800, gradient_tolerance=1e-4
        ),
    }
    table = Table(title=f"{recording.name}: 500 steps, from 3 N m/rad")
    titles = (
        "method",
        "status",
        "cost",
        "iterations",
        "rollouts",
        "wall [s]",
        "CPU [s]",
        "/ gauss_newton",
    )
    for title in titles:
        table.add_column(title, justify="left" if title in ("method", "status") else "right")
    ratios: dict[str, float] = {}
    reference = 0.0
    for name, method in methods.items():
        run = compare_methods(problem, [method]).method_results[0]
        reference = reference or run.cpu_seconds
        ratios[name] = run.cpu_seconds / reference
        table.add_row(
            name,
            run.solution.status.value,
            f"{run.whitened_cost:.2f}",
            str(run.solution.n_iterations),
            str(run.solution.n_evaluations),
            f"{run.wall_seconds:.2f}",
            f"{run.cpu_seconds:.2f}",
            f"{ratios[name]:.1f}",
        )
    Console(width=None if sys.stdout.isatty() else 120).print(table)
    if options.json is not None:
        options.json.write_text(json.dumps(ratios, indent=2) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
