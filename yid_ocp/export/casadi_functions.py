"""Export of the equations of a step as CasADi functions: `.casadi` files, C, and names of inputs and outputs."""

from __future__ import annotations

import json
import os
from pathlib import Path

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from yid_ocp.analysis.formula_text import count_operations
from yid_ocp.analysis.step_symbols import StepSymbols
from yid_ocp.errors import OutputError
from yid_ocp.files import atomic_write, write_text
from yid_ocp.integrator.codegen import casadi_c_source, parameter_jacobian_function
from yid_ocp.model.kinematics import forward_kinematics, mass_matrix, rigid_body_derivatives

Array = NDArray[np.float64]

_FORMAT = "yid-equations/1"
_MAX_JACOBIAN_OPERATIONS = 60_000  # operations; longer C keeps a compiler busy for minutes
_ARGUMENT_NAMES = ("q0", "q1", "p0", "z0", "z1", "lam", "u", "theta", "time_step")


def _exported_step_functions(symbols: StepSymbols) -> tuple[ca.Function, ...]:
    """The CasADi functions of a step that `export_step_functions` writes.

    Parameters
    ----------
    symbols : StepSymbols

    Returns
    -------
    tuple of casadi.Function
        `rows` (del, internal, constraint, p1) and `rows_by_theta` of (q0, q1, p0, z0, z1, lam, u, theta, time_step),
        `rows_by_unknowns` (by q1, z1, lam) where it is not too large, `points` (q, theta) to the places of the sensors'
        points [m], and `mechanical_change` (q, v, theta) to mass matrix, dL/dq and dL/dv of the bodies. Placements and masses
        that depend on internal coordinates take them at zero in the last two.
    """
    e, system = symbols.equations, symbols.equations.system
    blocks = [block.expressions for block in symbols.row_blocks]
    names = [block.name for block in symbols.row_blocks]
    rows = ca.Function("rows", e.arguments, ca.cse(blocks), list(_ARGUMENT_NAMES), names)
    by_rows, by_p1, _ = parameter_jacobian_function(e, system.parameters.names)(*e.arguments)
    theta = ca.Function("rows_by_theta", e.arguments, [ca.vertcat(by_rows, by_p1)], list(_ARGUMENT_NAMES), ["slope"])
    slope = ca.cse([ca.jacobian(ca.vertcat(*blocks), ca.vertcat(e.q1, e.z1, e.lam))])
    made = [rows, theta]
    if count_operations([slope[0].nz[:]], ca.vertcat(*e.arguments)) <= _MAX_JACOBIAN_OPERATIONS:
        made.append(ca.Function("rows_by_unknowns", e.arguments, slope, list(_ARGUMENT_NAMES), ["slope"]))
    q, v = ca.SX.sym("q", system.n_coordinates), ca.SX.sym("v", system.n_coordinates)
    kinematics = forward_kinematics(system.mechanism, q)
    rigid = rigid_body_derivatives(kinematics, v, system.gravity)
    places = [kinematics.frame_position(name) for name in system.point_frames]
    mechanics = [mass_matrix(rigid, system.mechanism), rigid.lagrangian_by_q, rigid.lagrangian_by_v]
    internal = ca.vertcat(*system.internal_coordinates.values()) if system.internal_coordinates else ca.SX(0, 1)
    still = [ca.substitute(x, internal, ca.SX.zeros(internal.numel())) for x in (*places, *mechanics)]
    if places:
        outputs = [name.replace(":", "_").replace("%", "") for name in system.point_frames]
        made.append(ca.Function("points", [q, e.theta], ca.cse(still[: len(places)]), ["q", "theta"], outputs))
    matrices = ca.cse(still[len(places) :])
    made.append(ca.Function("mechanics", [q, v, e.theta], matrices, ["q", "v", "theta"], ["mass", "L_q", "L_v"]))
    return tuple(made)


def export_step_functions(
    symbols: StepSymbols, folder: str | os.PathLike[str], theta: Array, time_step: float
) -> tuple[Path, ...]:
    """Write `NAME.casadi` for each of `_exported_step_functions`, all of them as `equations.c`, and `names.json`.

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
    functions = _exported_step_functions(symbols)
    written = []
    for function in functions:
        written.append(folder / f"{function.name()}.casadi")
        with atomic_write(written[-1]) as temporary:
            function.save(str(temporary))
    source = folder / "equations.c"
    write_text(source, casadi_c_source("equations", functions))
    parameters = symbols.equations.system.parameters
    values = {p.name: {"value": float(value), "unit": p.unit} for p, value in zip(parameters, theta, strict=True)}
    names = {
        "format": _FORMAT,
        "functions": {f.name(): {"arguments": f.name_in(), "results": f.name_out()} for f in functions},
        "rows": {block.name: list(block.full_names) for block in symbols.row_blocks},
        "columns": {block.name: list(block.full_names) for block in symbols.column_blocks},
        "parameters": values,
        "time_step": time_step,
    }
    listed = folder / "names.json"
    write_text(listed, json.dumps(names, indent=1) + "\n")
    return (*written, source, listed)
