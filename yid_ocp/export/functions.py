"""Export of the equations of a step as CasADi functions: `.casadi` files, C, and names of inputs and outputs."""

from __future__ import annotations

import json
import os
from pathlib import Path

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from yid_ocp.analysis.formulas import operations
from yid_ocp.analysis.symbols import StepSymbols
from yid_ocp.errors import OutputError
from yid_ocp.files import new_file, write_text
from yid_ocp.integrator.codegen import functions_source, theta_function
from yid_ocp.model.kinematics import forward_kinematics, mass_matrix, rigid_body

Array = NDArray[np.float64]

FORMAT = "yid-equations/1"
LARGEST_JACOBIAN = 60_000  # operations; longer C keeps a compiler busy for minutes
ARGUMENTS = ("q0", "q1", "p0", "z0", "z1", "lam", "u", "theta", "time_step")


def step_exports(symbols: StepSymbols) -> tuple[ca.Function, ...]:
    """The CasADi functions of a step that `export_functions` writes.

    Parameters
    ----------
    symbols : StepSymbols

    Returns
    -------
    tuple of casadi.Function
        `rows` (del, internal, constraint, p1) and `rows_by_theta` of (q0, q1, p0, z0, z1, lam, u, theta, time_step),
        `rows_by_unknowns` (by q1, z1, lam) where it is not too large, `points` (q, theta) to the places of the sensors'
        points [m], and `mechanics` (q, v, theta) to mass matrix, dL/dq and dL/dv of the bodies. Placements and masses
        that depend on internal coordinates take them at zero in the last two.
    """
    e, system = symbols.equations, symbols.equations.system
    blocks = [block.values for block in symbols.rows]
    names = [block.name for block in symbols.rows]
    rows = ca.Function("rows", e.arguments, ca.cse(blocks), list(ARGUMENTS), names)
    by_rows, by_p1, _ = theta_function(e, system.parameters.names)(*e.arguments)
    theta = ca.Function("rows_by_theta", e.arguments, [ca.vertcat(by_rows, by_p1)], list(ARGUMENTS), ["slope"])
    slope = ca.cse([ca.jacobian(ca.vertcat(*blocks), ca.vertcat(e.q1, e.z1, e.lam))])
    made = [rows, theta]
    if operations([slope[0].nz[:]], ca.vertcat(*e.arguments)) <= LARGEST_JACOBIAN:
        made.append(ca.Function("rows_by_unknowns", e.arguments, slope, list(ARGUMENTS), ["slope"]))
    q, v = ca.SX.sym("q", system.size), ca.SX.sym("v", system.size)
    kinematics = forward_kinematics(system.mechanism, q)
    rigid = rigid_body(kinematics, v, system.gravity)
    places = [kinematics.position(name) for name in system.points]
    mechanics = [mass_matrix(rigid, system.mechanism), rigid.by_q, rigid.by_v]
    internal = ca.vertcat(*system.internal.values()) if system.internal else ca.SX(0, 1)
    still = [ca.substitute(x, internal, ca.SX.zeros(internal.numel())) for x in (*places, *mechanics)]
    if places:
        outputs = [name.replace(":", "_").replace("%", "") for name in system.points]
        made.append(ca.Function("points", [q, e.theta], ca.cse(still[: len(places)]), ["q", "theta"], outputs))
    matrices = ca.cse(still[len(places) :])
    made.append(ca.Function("mechanics", [q, v, e.theta], matrices, ["q", "v", "theta"], ["mass", "L_q", "L_v"]))
    return tuple(made)


def export_functions(
    symbols: StepSymbols, folder: str | os.PathLike[str], theta: Array, time_step: float
) -> tuple[Path, ...]:
    """Write `NAME.casadi` for each of `step_exports`, all of them as `equations.c`, and `names.json`.

    Parameters
    ----------
    symbols : StepSymbols
    folder : path-like
        Where to; made where absent.
    theta : ndarray, shape (ntheta,)
        Values that `names.json` gives beside the parameters' names.
    time_step : float
        [s], likewise.

    Returns
    -------
    tuple of Path
        The files written.

    Raises
    ------
    OutputError
        The folder or a file cannot be written.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"the folder cannot be made ({error.strerror})", where=str(folder)) from error
    functions = step_exports(symbols)
    written = []
    for function in functions:
        written.append(folder / f"{function.name()}.casadi")
        with new_file(written[-1]) as temporary:
            function.save(str(temporary))
    source = folder / "equations.c"
    write_text(source, functions_source("equations", functions))
    parameters = symbols.equations.system.parameters
    values = {p.name: {"value": float(value), "unit": p.unit} for p, value in zip(parameters, theta, strict=True)}
    names = {
        "format": FORMAT,
        "functions": {f.name(): {"arguments": f.name_in(), "results": f.name_out()} for f in functions},
        "rows": {block.name: list(block.names) for block in symbols.rows},
        "columns": {block.name: list(block.names) for block in symbols.columns},
        "parameters": values,
        "time_step": time_step,
    }
    listed = folder / "names.json"
    write_text(listed, json.dumps(names, indent=1) + "\n")
    return (*written, source, listed)
