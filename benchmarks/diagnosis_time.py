"""Time of a whole diagnosis, stage by stage, with all candidates: of the embedded example, or of configurations.

    python benchmarks/diagnosis_time.py [CONFIG ...] [--runs N]

The embedded example has 43 variables, 5 s to estimate on and 5 s held out; `configs/dual_arm_vision.yaml` has 50.
Ratios are to the fit of the nominal model in the same run; the first run also compiles what is compiled once.
"""

from __future__ import annotations

import argparse
import sys
import time

from rich.console import Console
from rich.table import Table

from yid_ocp.config.reader import SHIPPED_DIAGNOSIS_CONFIG_FILE_NAME, load_config
from yid_ocp.diagnosis.diagnose import diagnose
from yid_ocp.problem import EstimationProblem
from yid_ocp.workflow.build_problem import build_problem


def main() -> int:
    """Diagnose every configuration and print one table each."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("configs", nargs="*", metavar="CONFIG", help="the embedded example when absent")
    parser.add_argument("--runs", type=int, default=2)
    given = parser.parse_args()
    for config in given.configs or [None]:
        show(build_problem(load_config(config, (), SHIPPED_DIAGNOSIS_CONFIG_FILE_NAME)), given.runs)
    return 0


def show(problem: EstimationProblem, runs: int) -> None:
    """Diagnose one problem so many times and print one table."""
    table = Table(
        title=f"{problem.system.n_coordinates} variables, {problem.episodes[0].grid.steps} steps, all candidates"
    )
    for title in ("run", "stage", "wall [s]", "/ nominal fit"):
        table.add_column(title, justify="left" if title == "stage" else "right")
    for run in range(runs):
        wall, cpu = time.perf_counter(), time.process_time()
        finding = diagnose(problem, "all")
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        reference = finding.stage_seconds["nominal"]
        stages = dict(finding.stage_seconds) | {"whole": wall, "whole, CPU": cpu}
        for stage, seconds in stages.items():
            table.add_row(str(run + 1), stage, f"{seconds:.2f}", f"{seconds / reference:.1f}")
        named = ", ".join(effect.label for effect in finding.accepted_effects)
        table.add_section()
        table.caption = f"{len(finding.screening.detectability)} candidates; {finding.verdict}: {named}"
    Console(width=None if sys.stdout.isatty() else 100).print(table)


if __name__ == "__main__":
    sys.exit(main())
