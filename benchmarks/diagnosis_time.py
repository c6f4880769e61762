"""Time of a whole diagnosis, stage by stage: 43 variables, 5 s to estimate on, 5 s held out, all candidates.

    python benchmarks/diagnosis_time.py [--runs N]

Ratios are to the fit of the nominal model in the same run; the first run also compiles what is compiled once.
"""

from __future__ import annotations

import argparse
import sys
import time

from rich.console import Console
from rich.table import Table

from yid_ocp.config.reader import DIAGNOSIS_DEFAULT, load_config
from yid_ocp.diagnosis import diagnose
from yid_ocp.workflow.build import build_problem


def main() -> int:
    """Diagnose the embedded example and print one table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=int, default=2)
    problem = build_problem(load_config(None, (), DIAGNOSIS_DEFAULT))
    table = Table(title=f"{problem.system.size} variables, {problem.episodes[0].grid.steps} steps, all candidates")
    for title in ("run", "stage", "wall [s]", "/ nominal fit"):
        table.add_column(title, justify="left" if title == "stage" else "right")
    for run in range(parser.parse_args().runs):
        wall, cpu = time.perf_counter(), time.process_time()
        finding = diagnose(problem, "all")
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        reference = finding.seconds["nominal"]
        stages = dict(finding.seconds) | {"whole": wall, "whole, CPU": cpu}
        for stage, seconds in stages.items():
            table.add_row(str(run + 1), stage, f"{seconds:.2f}", f"{seconds / reference:.1f}")
        named = ", ".join(effect.label for effect in finding.effects)
        table.add_section()
        table.caption = f"{len(finding.visibility)} candidates; {finding.verdict}: {named}"
    Console(width=None if sys.stdout.isatty() else 100).print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
