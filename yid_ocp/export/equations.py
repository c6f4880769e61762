"""Export of a step's equations as CasADi functions with C code, and as a LaTeX document."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np

from yid_ocp.analysis.step_diagnostics import system_with_numeric_parameters
from yid_ocp.analysis.step_symbols import (
    NamedStepEquations,
    SymbolBlock,
    count_operations,
    escape_latex,
    format_expressions,
)
from yid_ocp.arrays import Array
from yid_ocp.files import atomic_write, make_folder, write_strict_json, write_text
from yid_ocp.integrator.codegen import casadi_c_source, parameter_jacobian_function
from yid_ocp.model.kinematics import forward_kinematics, mass_matrix, rigid_body_lagrangian_derivatives
from yid_ocp.model.mechanism import merge_bodies
from yid_ocp.model.system import System

_MAX_JACOBIAN_OPERATIONS = 60_000  # operations; longer C keeps a compiler busy for minutes
_ARGUMENT_NAMES = ("q0", "q1", "p0", "z0", "z1", "lam", "u", "theta", "time_step")
_MAX_ROW_OPERATIONS = 120  # operations up to which a row is written out; beyond, the bodies' part stays a letter
_LATEX_PREAMBLE = r"""\documentclass[a4paper,10pt]{article}
\usepackage[margin=18mm]{geometry}
\usepackage{amsmath,longtable}
\setlength{\parindent}{0pt}
\setlength{\parskip}{4pt}
\raggedright
\allowdisplaybreaks
\begin{document}
"""
_FORCE_AND_CONSTRAINT_TERMS = {
    "symmetric": (r" + \tfrac{h}{2} F", r" + \tfrac{h}{2} F"),
    "left": (" + h F", ""),
    "node": (r" - D\varphi(q_k)^{T} \lambda_k", ""),
    "midpoint": (
        r" - \tfrac12 \left( D\varphi(q_k) + D\varphi(q_m) \right)^{T} \lambda_k",
        r" - \tfrac12 \left( D\varphi(q_m) - D\varphi(q_{k+1}) \right)^{T} \lambda_k",
    ),
}
"""LaTeX of force and constraint terms in the balance and in p1, by `force_split` and `constraint_force`."""


def _exported_step_functions(symbols: NamedStepEquations) -> tuple[ca.Function, ...]:
    """The CasADi functions that `export_step_functions` writes.

    `rows` (del, internal, constraint, p1), `rows_by_theta` and, if not too large, `rows_by_unknowns` (q1, z1, lam) take
    `_ARGUMENT_NAMES`. `points` maps (q, theta) to positions of the sensors' points [m]. `mechanics` maps (q, v, theta)
    to mass matrix, dL/dq and dL/dv of the bodies. The last two set internal coordinates to zero.
    """
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
    rigid = rigid_body_lagrangian_derivatives(kinematics, v, system.gravity)
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

    `names.json` contains the parameters' names and values `theta`, and the time step [s]. `folder` is created if
    absent. Raises `OutputError` if the folder or a file cannot be written.
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


def write_equation_sheet(
    path: Path, symbols: NamedStepEquations, theta: Array, free: Sequence[str], time_step: float
) -> None:
    """Write a step's equations as a LaTeX document. Raises `OutputError` if the file cannot be written.

    Parameters in `free` stay symbols, and a table lists their values. All other parameters are replaced by their values
    in `theta`.
    """
    system = symbols.equations.system
    values = dict(zip(system.parameters.names, map(float, theta), strict=True))
    lines = [rf"\section*{{One step of {escape_latex(system.mechanism.name)}}}", *_rules(symbols, time_step)]
    if free:
        units = {n: system.parameters[n].unit.replace(" ", r"\,") for n in free}
        rows = [(escape_latex(n), f"${_value(values[n])}$", rf"$\mathrm{{{unit}}}$") for n, unit in units.items()]
        lines += [r"\section*{Letters that stay}", *_table("lrl", ("parameter", "value", "unit"), rows)]
    lines += [*_tree_tables(system, values), r"\section*{Rows}"]
    for block in symbols.row_blocks:
        lines += _rows(symbols, block, values, free) if block.labels else []
    write_text(path, _LATEX_PREAMBLE + "\n".join(lines) + "\n\\end{document}\n")


def _rules(symbols: NamedStepEquations, time_step: float) -> list[str]:
    e = symbols.equations
    held = e.lam.numel() > 0
    force = _FORCE_AND_CONSTRAINT_TERMS[e.force_split]
    pull = _FORCE_AND_CONSTRAINT_TERMS[e.constraint_force] if held else ("", "")
    slack = "" if e.constraint_relaxation_gain is None else r" + T \left( \varphi(q_{k+1}) - \varphi(q_k) \right) / h"
    rows = [
        rf"0 &= p_k + \tfrac{{h}}{{2}} L_q(q_m, v_m) - L_v(q_m, v_m){force[0]}{pull[0]}",
        rf"p_{{k+1}} &= \tfrac{{h}}{{2}} L_q(q_m, v_m) + L_v(q_m, v_m){force[1]}{pull[1]}",
        *([rf"0 &= \varphi(q_{{k+1}}){slack} - C \lambda_k / h"] if held else []),
    ]
    return [
        rf"Time step $h = {time_step:g}$ s, $q_m = (q_k + q_{{k+1}})/2$, $v_m = (q_{{k+1}} - q_k)/h$,",
        r"$L$ the Lagrangian of bodies, springs and energies, $F$ all other forces at the midpoint.",
        r"\begin{align*}",
        " \\\\\n".join(rows),
        r"\end{align*}",
        r"The first line holds at free coordinates; at a prescribed one its right side is $-h$ times the effort.",
        *(["Rows of coordinates that a compliance holds are multiplied by it."] if e.system.joint_compliances else []),
    ]


def _tree_tables(system: System, values: dict[str, float]) -> list[str]:
    """Joints with their placements, and bodies with their masses, as numbers."""
    built = system_with_numeric_parameters(system, system.parameters.vector(values))
    mechanism = built.mechanism
    roles = dict.fromkeys(system.driven, "driven") | dict.fromkeys(system.prescribed, "prescribed")
    joints, bodies = [], []
    for joint in mechanism.joints:
        name = escape_latex(joint.name)
        parent = escape_latex(mechanism.joints[joint.parent_index].name) if joint.parent_index >= 0 else "world"
        rotation = np.array(ca.DM(joint.placement.rotation))
        turned = "" if np.allclose(rotation, np.eye(3)) else _matrix(rotation)
        axis, place = _vector(joint.axis), _vector(joint.placement.translation)
        joints.append((name, joint.kind, parent, roles.get(joint.name, "free"), axis, place, turned))
        # weight may differ from mass times gravity; only inertia is listed
        body = merge_bodies(replace(b, gravity_fraction=None) for b in joint.bodies)
        if body is not None:
            tensor = _matrix(np.array(ca.DM(body.inertia_about_com)))
            bodies.append((name, f"${_value(float(body.mass))}$", _vector(body.center_of_mass), tensor))
    return [
        r"\section*{Joints}",
        *_table("lllllll", ("joint", "kind", "parent", "role", "axis", "place [m]", "rotation"), joints),
        r"\section*{Bodies}",
        rf"Gravity {_vector(built.gravity)} m/s$^2$. Centres and inertias (about the centre) in the joint's frame.",
        *_table("lrll", ("joint", "mass [kg]", "centre [m]", r"inertia [kg m$^2$]"), bodies),
    ]


def _rows(symbols: NamedStepEquations, block: SymbolBlock, values: dict[str, float], free: Sequence[str]) -> list[str]:
    """Every row of a block: in full if it is short, else with the bodies' part, or all of it, as a symbol."""
    e, system = symbols.equations, symbols.equations.system
    fixed = [p for p in system.parameters if p.name not in free]
    old = ca.vertcat(*(p.symbol for p in fixed)) if fixed else ca.SX(0, 1)
    new = ca.SX(ca.DM([values[p.name] for p in fixed])) if fixed else ca.SX(0, 1)
    rest = {"del": e.p0 + e.balance_remainder, "p1": e.p1_remainder}.get(block.name)
    lines = [rf"\subsection*{{{escape_latex(block.name)}: {block.meaning}}}"]

    def formula(letter: str, begin: str, expression: ca.SX) -> str:
        """A paragraph that TeX may break at any sign, its shared parts behind it."""
        made = format_expressions([expression], symbols.column_symbols, symbols.column_display_names, latex=True)
        [text] = made.expression_texts
        sign = "+ " if begin and not text.startswith("-") else ""
        where = ", ".join(f"${name} = {part}$" for name, part in made.shared_subexpressions)
        end = f" \\quad where {where}" if where else ""
        return rf"$\displaystyle {letter} = {begin}{sign}{text}$" + end + "\n"

    if rest is not None:
        sign = "-" if block.name == "del" else "+"
        pull = "" if not e.lam.numel() else ", $G$ the pull of the grasps"
        lines.append(
            rf"$B$ denotes $\tfrac{{h}}{{2}} \, \partial (T - V) / \partial q_m {sign} \partial T / \partial v_m$ "
            rf"of the bodies above{pull}."
        )
    for i, label in enumerate(block.labels):
        name = rf"\mathrm{{{escape_latex(label)}}}"
        letter = block.latex_template.replace("#", name)
        whole = ca.substitute(block.expressions[i], old, new)
        count = count_operations([whole], symbols.column_symbols)
        if count <= _MAX_ROW_OPERATIONS:
            lines.append(formula(letter, "", whole))
        elif rest is not None:
            pulled = "" if not e.lam.numel() else rf" - G_{{{name}}}"
            lost = "" if e.force_with_derivatives is None else r" + \text{drag}"
            lines.append(formula(letter, rf"B_{{{name}}}{pulled}{lost} ", ca.substitute(rest[i], old, new)))
        else:
            lines.append(rf"${letter}$: {count} operations, in \texttt{{rows.casadi}} and \texttt{{equations.c}}")
    return lines


def _table(columns: str, head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    body = [" & ".join(row) + r" \\" for row in rows]
    begin = rf"{{\footnotesize\begin{{longtable}}{{{columns}}}"
    return [begin, " & ".join(head) + r" \\ \hline", *body, r"\end{longtable}}"]


def _value(value: float) -> str:
    mantissa, _, exponent = f"{value:.6g}".partition("e")
    return rf"{mantissa} \cdot 10^{{{int(exponent)}}}" if exponent else mantissa


def _vector(values: ca.SX | Sequence[float]) -> str:
    return "$(" + r",\, ".join(_value(float(value)) for value in np.array(ca.DM(values)).ravel()) + ")$"


def _matrix(values: Array) -> str:
    rows = r" \\ ".join(" & ".join(_value(float(x)) for x in row) for row in values)
    return rf"$\left(\begin{{smallmatrix}} {rows} \end{{smallmatrix}}\right)$"
