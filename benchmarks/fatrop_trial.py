"""fatrop against IPOPT on the same symbolic multiple-shooting problem, for the decision whether to keep it.

    python benchmarks/fatrop_trial.py [--links N] [--steps N]

A chain with an unknown stiffness in every joint swings from a bent start; the angles are measured. Stage states are
(q, p, stiffness), stage controls q_{k+1}; the path constraint is the DEL equation, the dynamics q_{k+1} = control and
p_{k+1} = D2 L_d, as fatrop's stage structure wants them.
"""

from __future__ import annotations

import argparse
import sys
import time

import casadi as ca
import numpy as np
from rich.console import Console
from rich.table import Table

from yid_ocp.integrator.discrete import discrete_equations
from yid_ocp.integrator.step import compile_step, simulate
from yid_ocp.model import FlexibleSegment, System, flexible_object

TIME_STEP = 0.01


def main(arguments: list[str] | None = None) -> int:
    """Build the problem once, solve it with both, print one table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--links", type=int, default=2)
    parser.add_argument("--steps", type=int, default=50)
    options = parser.parse_args(arguments)

    beam = flexible_object(
        [FlexibleSegment("B", 0.3, 0.1, 0.01, links=options.links, bend=0.5, twist=0.2, damping=2e-3)]
    )
    system = System.build(None, objects=[(beam, None, None)])
    names = ("B.bend", "B.twist")
    theta = system.parameters.vector()
    start = np.zeros(2 * system.n_coordinates)
    start[: system.n_coordinates] = 0.2
    step = compile_step(system, TIME_STEP)
    truth = simulate(step, theta, start, options.steps).state
    measured = truth[:, : system.n_coordinates]

    e = discrete_equations(system)
    n, count = system.n_coordinates, len(names)
    free = ca.vertcat(*(system.parameters[name].symbol for name in names))
    fixed = [entry for entry in system.parameters if entry.name not in names]
    known = ca.vertcat(*(entry.symbol for entry in fixed))
    balance, p1 = (
        ca.substitute(x, ca.vertcat(known, e.time_step), ca.vertcat(*(entry.value for entry in fixed), TIME_STEP))
        for x in (e.momentum_balance, e.p1)
    )
    stage = ca.Function("stage", [e.q0, e.p0, free, e.q1], [balance, p1])
    nx = 2 * n + count
    w, g, equality, guess, lower, cost = [], [], [], [], [], 0.0
    x = ca.MX.sym("x0", nx)
    w.append(x)
    guess.append(np.concatenate([truth[0], 2.0 * theta[[system.parameters.index(name) for name in names]]]))
    lower.append(np.concatenate([np.full(2 * n, -np.inf), np.full(count, 1e-3)]))
    for k in range(options.steps):
        control = ca.MX.sym(f"u{k}", n)
        after = ca.MX.sym(f"x{k + 1}", nx)
        q, p, s = x[:n], x[n : 2 * n], x[2 * n :]
        row, p_next = stage(q, p, s, control)
        g += [after - ca.vertcat(control, p_next, s), row / TIME_STEP]
        equality += [True] * (nx + n)
        if k == 0:
            g.append(x[: 2 * n] - truth[0])
            equality += [True] * (2 * n)
        w += [control, after]
        guess += [measured[k + 1], np.concatenate([truth[k + 1], guess[0][2 * n :]])]
        lower += [np.full(n, -np.inf), lower[0]]
        cost += 0.5 * ca.sumsqr((after[:n] - measured[k + 1]) / 1e-2)
        x = after
    nlp = {"x": ca.vertcat(*w), "f": cost, "g": ca.vertcat(*g)}
    table = Table(title=f"{n} coordinates, {options.steps} steps, {nlp['x'].numel()} unknowns")
    for title in ("solver", "status", "iterations", "solve [s]", *names):
        table.add_column(title)
    for name, settings in (
        ("ipopt", {"ipopt": {"print_level": 0, "sb": "yes", "max_iter": 100}}),
        (
            "fatrop",
            {
                "structure_detection": "auto",
                "equality": equality,
                "fatrop": {"print_level": 0, "max_iter": 100},
            },
        ),
    ):
        try:
            solver = ca.nlpsol("solver", name, nlp, {"expand": True, "print_time": False, **settings})
            begun = time.process_time()
            result = solver(x0=np.concatenate(guess), lbx=np.concatenate(lower), lbg=0.0, ubg=0.0)
            spent = time.process_time() - begun
            found = np.array(result["x"]).ravel()[-count:]
            stats = solver.stats()
            cells = (str(stats.get("return_status", stats.get("success"))), str(stats.get("iter_count", "")))
            table.add_row(name, *cells, f"{spent:.2f}", *(f"{value:.4f}" for value in found))
        except RuntimeError as error:
            table.add_row(name, str(error).strip().splitlines()[-1][:100], "", "", *[""] * count)
    Console(width=None if sys.stdout.isatty() else 120).print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
