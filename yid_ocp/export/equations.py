"""Export of the equations of a time step as CasADi functions and as C code."""

from __future__ import annotations

import os
from pathlib import Path

import casadi as ca

from yid_ocp.analysis.step_symbols import NamedStepEquations, count_operations
from yid_ocp.arrays import Array
from yid_ocp.files import atomic_write, make_folder, write_strict_json, write_text
from yid_ocp.integrator.codegen import casadi_c_source, parameter_jacobian_function
from yid_ocp.model.kinematics import forward_kinematics, lagrangian_first_derivatives, mass_matrix

_MAX_JACOBIAN_OPERATIONS = 60_000  # operations; longer C code takes minutes to compile
_ARGUMENT_NAMES = ("q0", "q1", "p0", "z0", "z1", "lam", "u", "theta", "time_step")


def _exported_step_functions(symbols: NamedStepEquations) -> tuple[ca.Function, ...]:
    """Return the CasADi functions of docs/howto/inspection.md. Points and mechanics set internal coordinates to 0."""
    e, system = symbols.equations, symbols.equations.system
    names, blocks = zip(*((block.name, block.expressions) for block in symbols.row_blocks), strict=True)
    by_rows, by_p1, _ = parameter_jacobian_function(e, system.parameters.names)(*e.arguments)
    parts = {"rows": (ca.cse(list(blocks)), names), "rows_by_theta": ([ca.vertcat(by_rows, by_p1)], ["slope"])}
    slope = ca.cse([ca.jacobian(ca.vertcat(*blocks), ca.vertcat(e.q1, e.z1, e.lam))])
    if count_operations([slope[0].nz[:]], ca.vertcat(*e.arguments)) <= _MAX_JACOBIAN_OPERATIONS:
        parts["rows_by_unknowns"] = (slope, ["slope"])
    made = [ca.Function(name, e.arguments, out, list(_ARGUMENT_NAMES), list(o)) for name, (out, o) in parts.items()]
    q, v = ca.SX.sym("q", system.n_coordinates), ca.SX.sym("v", system.n_coordinates)
    kinematics = forward_kinematics(system.mechanism, q)
    rigid = lagrangian_first_derivatives(kinematics, v, system.gravity)
    places = [kinematics.frame_position(name) for name in system.point_frames]
    mechanics = [mass_matrix(rigid, system.mechanism), rigid.lagrangian_by_q, rigid.lagrangian_by_v]
    internal = ca.vertcat(ca.SX(0, 1), *system.effect_internal_coordinate_symbols.values())
    still = [ca.substitute(x, internal, ca.SX.zeros(internal.numel())) for x in (*places, *mechanics)]
    if places:
        outputs = [name.replace(":", "_").replace("%", "") for name in system.point_frames]
        made.append(ca.Function("points", [q, e.theta], ca.cse(still[: len(places)]), ["q", "theta"], outputs))
    matrices = ca.cse(still[len(places) :])
    made.append(ca.Function("mechanics", [q, v, e.theta], matrices, ["q", "v", "theta"], ["mass", "L_q", "L_v"]))
    return tuple(made)


def export_step_functions(
    symbols: NamedStepEquations, folder: str | os.PathLike[str], theta: Array, time_step: float
) -> tuple[Path, ...]:
    """Write a step's CasADi functions as `NAME.casadi` files and as `equations.c`, and return the written files.

    `names.json` contains all names, the values `theta` (ntheta,) of the parameters, and the time step [s]. `folder` is
    created if absent. Raises `OutputError` if the folder or a file cannot be written.
    """
    folder, functions, written = make_folder(folder), _exported_step_functions(symbols), []
    for function in functions:
        written.append(folder / f"{function.name()}.casadi")
        with atomic_write(written[-1]) as temporary:
            function.save(str(temporary))
    source, listed = folder / "equations.c", folder / "names.json"
    write_text(source, casadi_c_source("equations", functions))
    parameters = zip(symbols.equations.system.parameters, theta, strict=True)
    names = {
        "format": "yid-equations/1",
        "functions": {f.name(): {"arguments": f.name_in(), "results": f.name_out()} for f in functions},
        "rows": {block.name: list(block.full_names) for block in symbols.row_blocks},
        "columns": {block.name: list(block.full_names) for block in symbols.column_blocks},
        "parameters": {p.name: {"value": float(value), "unit": p.unit} for p, value in parameters},
        "time_step": time_step,
    }
    write_strict_json(listed, names)
    return (*written, source, listed)
