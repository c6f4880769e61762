"""Identify a beam from a recorded run with ever more links, and carry its rigidity on to infinitely many.

    python benchmarks/beam.py [CONFIG] [--segment beam] [--divisions 1 2 4 8 16]

Every link of the configuration is divided into this many. A chain of equal links with twice the stiffness at its
clamped first joint is a beam of some other rigidity, by a difference that falls with the square of the number of links:
EI_n = EI + c/n^2 is fitted to the last two. From EI follow Young's modulus, with the second moment of area of the
section, and the first frequency of a clamped beam, f = 1.8751^2 / (2 pi L^2) sqrt(EI L / m). Standard deviations are
those of the data; they know nothing of what the model misses.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from pathlib import Path

from rich.console import Console
from rich.table import Table

from yid_ocp.config.reader import load_config
from yid_ocp.solvers import fit_problem
from yid_ocp.workflow.build import build_step, build_system
from yid_ocp.workflow.build_problem import build_problem

CONFIG = Path(__file__).resolve().parents[1] / "configs" / "panda_beam.yaml"
FIRST_MODE = 1.875104  # smallest root of 1 + cos x cosh x


def main(arguments: list[str] | None = None) -> int:
    """Fit with every number of links and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("config", nargs="?", default=CONFIG, type=Path)
    parser.add_argument("--segment", default="beam")
    parser.add_argument(
        "--divisions", nargs="+", type=int, default=[1, 2, 4, 8, 16], help="links for each link of CONFIG"
    )
    chosen = parser.parse_args(arguments)
    run, name = load_config(chosen.config), chosen.segment
    table = Table(
        "links", "EI [N m^2]", "± std", "E [GPa]", "first frequency [Hz]", "damping [N m^2 s]", "cost", "time"
    )
    found: list[tuple[int, float]] = []
    for division in chosen.divisions:
        start = time.perf_counter()
        system = build_system(run, division)
        links = len(system.find_segment_layout(name).link_joints)
        problem = build_problem(run, build_step(run, system))
        solution = fit_problem(problem, run.solver)
        size = {key: solution.parameters[f"{name}.{key}"].value for key in ("length", "mass", "size_x", "size_y")}
        bend, damping = solution.parameters[f"{name}.bend"], solution.parameters[f"{name}.damping"]
        rigidity, moment = bend.value, second_moment(size["size_x"], size["size_y"])
        found.append((links, rigidity))
        table.add_row(
            str(links),
            f"{rigidity:.4f}",
            f"{bend.std:.4f}",
            f"{rigidity / moment / 1e9:.1f}",
            f"{first_frequency(rigidity, size['length'], size['mass']):.4f}",
            f"{damping.value:.3g}",
            f"{solution.cost:.5g}",
            f"{time.perf_counter() - start:.0f} s",
        )
    limit = extrapolated(found)
    frequency = first_frequency(limit, size["length"], size["mass"])
    table.add_row("∞", f"{limit:.4f}", "", f"{limit / moment / 1e9:.1f}", f"{frequency:.4f}", "", "", "")
    Console().print(table)
    return 0


def second_moment(x: float, y: float) -> float:
    """Second moment of area of a rectangle for bending about its longer side [m^4]."""
    return max(x, y) * min(x, y) ** 3 / 12


def first_frequency(rigidity: float, length: float, mass: float) -> float:
    """First frequency of a clamped uniform beam [Hz]."""
    return FIRST_MODE**2 / (2 * math.pi * length**2) * math.sqrt(rigidity * length / mass)


def extrapolated(found: list[tuple[int, float]]) -> float:
    """Limit of EI + c/n^2 through the last two values; the last one where there is only one."""
    if len(found) < 2:
        return found[-1][1]
    (n, coarse), (m, fine) = found[-2:]
    return (m**2 * fine - n**2 * coarse) / (m**2 - n**2)


if __name__ == "__main__":
    sys.exit(main())
